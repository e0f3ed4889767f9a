//! What came of the training: losses by epoch, scores on held-out sequences.

use anyhow::Result;
use serde::{Deserialize, Serialize};

use crate::chart::{Line, Panel, svg};
use crate::learn::Epoch;
use crate::learn::card::Unseen;

/// What came of the training.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct Report {
    /// One entry a network: its file's name and its epochs.
    #[serde(default)]
    pub epochs: Vec<(String, Vec<Epoch>)>,
    /// One entry a held-out sequence.
    pub unseen: Vec<Unseen>,
}

impl Report {
    pub(super) fn add(&mut self, trained: Trained) {
        self.epochs.push((trained.name, trained.epochs));
        self.unseen.extend(trained.unseen);
    }
}

/// One network's part of the report.
pub(super) struct Trained {
    pub name: String,
    pub epochs: Vec<Epoch>,
    pub unseen: Vec<Unseen>,
}

/// Losses by epoch, a panel for each network.
pub(super) fn curves(networks: &[(String, Vec<Epoch>)]) -> Result<String> {
    let panel = |(name, epochs): &(String, Vec<Epoch>)| {
        let line = |name: &str, of: &dyn Fn(&Epoch) -> Option<f64>| {
            let points =
                epochs.iter().enumerate().filter_map(|(i, epoch)| Some((i as f64 + 1.0, of(epoch)?)));
            Line::new(name, points.collect())
        };
        Panel {
            caption: name.clone(),
            axes: ["epoch".into(), "weighted cross-entropy, nats".into()],
            log: false,
            lines: vec![line("training", &|e| Some(e.training)), line("validation", &|e| e.validation)],
        }
    };
    Ok(svg(&networks.iter().map(panel).collect::<Vec<_>>(), networks.len().clamp(1, 2))?)
}
