//! The rows of the table.

use crate::track::{AppearanceConfig, Association, PairScore, TrackerConfig};

/// One row: a name and the settings that it stands for.
pub struct Variant {
    /// As the table prints it.
    pub name: &'static str,
    /// Settings; only the association and what belongs to it differ between rows.
    pub config: TrackerConfig,
    /// Whether it is given embeddings, and means nothing without them.
    pub appearance: bool,
}

/// All rows, the paper's first and in its order.
pub fn all(base: &TrackerConfig) -> Vec<Variant> {
    use Association::*;
    let row = |name, method, appearance: bool| {
        let mut config = base.clone();
        config.association.method = method;
        if appearance && config.appearance.weight == 0.0 {
            config.appearance = AppearanceConfig::deep();
        }
        Variant { name, config, appearance }
    };
    let mut log_link = row("implicit, -ln P", Implicit, false);
    log_link.config.association.score = PairScore::LogLink;
    vec![
        row("IOU", Iou, false),
        row("IOU + motion (IoU cost)", IouMotion, false),
        row("IOU + motion + deep", Deep, true),
        row("explicit", Explicit, false),
        row("implicit", Implicit, false),
        row("Huang", Huang, true),
        row("explicit + deep", Explicit, true),
        row("implicit + deep", Implicit, true),
        row("explicit, fixed weights", ExplicitFixed, false),
        log_link,
        row("Mahalanobis cost", Mahalanobis, false),
    ]
}
