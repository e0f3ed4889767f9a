//! The two networks that answer for a link: one gives the probability itself, the other the weights of
//! explicit features.

use std::collections::BTreeMap;

use super::{
    Checkpoint, Epoch, Examples, ExplicitModel, ExplicitScorer, Fit, GruScorer, LinkModel, Progress, Split,
    fit, fit_explicit, logits, logits_explicit, onnx,
};
use crate::track::{Association, Features, LinkRequest};

/// A trained network of either kind.
#[derive(Clone, Debug, PartialEq)]
pub enum Network {
    /// [`Association::Implicit`].
    Implicit(LinkModel),
    /// [`Association::Explicit`].
    Explicit(ExplicitModel),
}

impl Network {
    /// Trains the network of `association`: the explicit one when it is [`Association::Explicit`], else the
    /// implicit one. See [`fit()`].
    pub fn fit(
        association: Association,
        examples: &Split,
        settings: &Fit,
        from: Option<Checkpoint>,
        tell: impl FnMut(Progress<'_>),
    ) -> (Self, Vec<Epoch>) {
        match association {
            Association::Explicit => {
                let (model, epochs) = fit_explicit(examples, settings, from, tell);
                (Network::Explicit(model), epochs)
            }
            _ => {
                let (model, epochs) = fit(examples, settings, from, tell);
                (Network::Implicit(model), epochs)
            }
        }
    }

    /// What it answers for.
    pub fn association(&self) -> Association {
        match self {
            Network::Implicit(_) => Association::Implicit,
            Network::Explicit(_) => Association::Explicit,
        }
    }

    /// What it reads.
    pub fn features(&self) -> Features {
        match self {
            Network::Implicit(model) => model.features(),
            Network::Explicit(model) => model.shape.features,
        }
    }

    /// `family` in a manifest of models.
    pub fn family(&self) -> &'static str {
        match self {
            Network::Implicit(_) => "gru",
            Network::Explicit(_) => "explicit",
        }
    }

    /// Number of parameters.
    pub fn parameters(&self) -> usize {
        match self {
            Network::Implicit(model) => model.gru.theta.len(),
            Network::Explicit(model) => model.theta.len(),
        }
    }

    /// Logits of all `examples` (raw features).
    pub fn logits(&self, examples: &Examples) -> Vec<f32> {
        match self {
            Network::Implicit(model) => logits(model, examples),
            Network::Explicit(model) => logits_explicit(model, examples),
        }
    }

    /// The bytes of its ONNX file; see [`onnx::write`].
    pub fn write(&self, doc: &str, metadata: &BTreeMap<String, String>) -> Vec<u8> {
        match self {
            Network::Implicit(model) => onnx::write(model, doc, metadata),
            Network::Explicit(model) => onnx::write_explicit(model, doc, metadata),
        }
    }
}

/// Scores link requests by a [`Network`], without ONNX Runtime.
#[derive(Clone, Debug)]
pub enum Scorer {
    /// Of the implicit network.
    Implicit(GruScorer),
    /// Of the explicit one.
    Explicit(ExplicitScorer),
}

impl Scorer {
    /// A scorer of `network`.
    pub fn new(network: Network) -> Self {
        match network {
            Network::Implicit(model) => Scorer::Implicit(GruScorer::new(model)),
            Network::Explicit(model) => Scorer::Explicit(ExplicitScorer::new(model)),
        }
    }

    /// See [`GruScorer::score`].
    pub fn score(&mut self, request: &LinkRequest, probabilities: &mut Vec<f32>) {
        match self {
            Scorer::Implicit(scorer) => scorer.score(request, probabilities),
            Scorer::Explicit(scorer) => scorer.score(request, probabilities),
        }
    }
}
