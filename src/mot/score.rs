//! All figures of a sequence, and of several together.

use super::preprocess::scene;
use super::{Benchmark, Clear, EvalError, Hota, Identity, Row};

/// The figures of one sequence or of several combined.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Score {
    /// HOTA, DetA, AssA, LocA.
    pub hota: Hota,
    /// MOTA, MOTP, FP, FN, identity switches, fragmentations, MT, PT, ML.
    pub clear: Clear,
    /// IDF1, IDP, IDR.
    pub identity: Identity,
}

/// Scores `results` of a sequence of `length` frames against `truth`.
///
/// Equal to TrackEval 1.3.0's `MotChallenge2DBox` with its HOTA, CLEAR and Identity metrics at their
/// default settings.
///
/// # Errors
/// Rows that no parser of this module lets through: frames outside `1..=length`, an identity twice in
/// a frame, boxes that are not finite; and truth without classes where the benchmark needs them.
pub fn evaluate(
    truth: &[Row],
    results: &[Row],
    length: u32,
    benchmark: Benchmark,
) -> Result<Score, EvalError> {
    let scene = scene(truth, results, length, benchmark)?;
    Ok(Score { hota: Hota::of(&scene), clear: Clear::of(&scene), identity: Identity::of(&scene) })
}

impl Score {
    /// The figures of all `parts` together, as TrackEval's `COMBINED_SEQ` has them: counts are added,
    /// association and localisation are averaged by matches.
    pub fn combine(parts: &[&Score]) -> Self {
        Self {
            hota: Hota::combine(parts.iter().map(|part| &part.hota)),
            clear: Clear::combine(parts.iter().map(|part| &part.clear)),
            identity: Identity::combine(parts.iter().map(|part| &part.identity)),
        }
    }
}
