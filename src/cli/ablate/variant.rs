//! The rows of the table.

use super::networks::Kind;
use crate::track::{AppearanceConfig, Association, PairScore, TrackerConfig};

/// One row: a name and the settings that it stands for.
pub struct Variant {
    /// As the table prints it.
    pub name: &'static str,
    /// Settings; only the association and what belongs to it differ between rows.
    pub config: TrackerConfig,
    /// Whether it is given embeddings, and means nothing without them.
    pub appearance: bool,
    /// The network that it asks.
    pub network: Option<Kind>,
}

/// All rows, the paper's first and in its order.
pub fn all(base: &TrackerConfig) -> Vec<Variant> {
    use Association::*;
    let row = |name, method, appearance: bool, network| {
        let mut config = base.clone();
        config.association.method = method;
        if appearance && config.appearance.weight == 0.0 {
            config.appearance = AppearanceConfig::deep();
        }
        Variant { name, config, appearance, network }
    };
    let mut log_link = row("implicit, -ln P", Implicit, false, Some(Kind::Implicit));
    log_link.config.association.score = PairScore::LogLink;
    vec![
        row("IOU", Iou, false, None),
        row("IOU + motion (IoU cost)", IouMotion, false, None),
        row("IOU + motion + deep", Deep, true, None),
        row("explicit", Explicit, false, Some(Kind::Explicit)),
        row("implicit", Implicit, false, Some(Kind::Implicit)),
        row("Huang", Huang, true, None),
        row("explicit + deep", Explicit, true, Some(Kind::Explicit)),
        row("implicit + deep", Implicit, true, Some(Kind::Implicit)),
        row("explicit, looks learned", Explicit, true, Some(Kind::ExplicitLooks)),
        row("implicit, looks learned", Implicit, true, Some(Kind::ImplicitLooks)),
        row("implicit, literal, boxes alone", Implicit, false, Some(Kind::Spatial)),
        row("implicit, literal", Implicit, true, Some(Kind::Literal)),
        row("explicit, fixed weights", ExplicitFixed, false, None),
        log_link,
        row("Mahalanobis cost", Mahalanobis, false, None),
    ]
}
