//! How good probabilities are: area under the ROC curve, cross-entropy, calibration.

use super::gru::cross_entropy;

/// Scores of a set of labelled logits, each example weighted.
#[derive(Clone, Debug, PartialEq)]
pub struct Scores {
    /// Number of examples.
    pub examples: usize,
    /// Weighted share of positives.
    pub positive_share: f64,
    /// Area under the ROC curve; NaN when only one class is present.
    pub auc: f64,
    /// Mean binary cross-entropy, nats.
    pub loss: f64,
    /// Expected calibration error: mean distance between predicted and observed share, over bins.
    pub calibration_error: f64,
    /// Calibration table, probabilities in ten equal bins.
    pub bins: Vec<Bin>,
}

/// One row of the calibration table.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Bin {
    /// Sum of weights.
    pub weight: f64,
    /// Weighted mean of the predicted probability.
    pub predicted: f64,
    /// Weighted share of positives.
    pub observed: f64,
}

/// Scores `logits` against `labels` (0 or 1).
///
/// # Panics
/// When the three differ in length.
pub fn scores(logits: &[f32], labels: &[f32], weights: &[f32]) -> Scores {
    assert!(logits.len() == labels.len() && logits.len() == weights.len(), "one label and weight a logit");
    let mut bins = vec![Bin::default(); 10];
    let (mut total, mut positive, mut loss) = (0.0, 0.0, 0.0);
    for ((logit, label), weight) in logits.iter().zip(labels).zip(weights) {
        let (weight, label64) = (f64::from(*weight), f64::from(*label));
        let p = 1.0 / (1.0 + f64::from(-logit).exp());
        total += weight;
        positive += weight * label64;
        loss += weight * cross_entropy(*logit, *label);
        let bin = &mut bins[((p * 10.0) as usize).min(9)];
        bin.weight += weight;
        bin.predicted += weight * p;
        bin.observed += weight * label64;
    }
    for bin in bins.iter_mut().filter(|b| b.weight > 0.0) {
        bin.predicted /= bin.weight;
        bin.observed /= bin.weight;
    }
    let error: f64 = bins.iter().map(|b| b.weight * (b.predicted - b.observed).abs()).sum();
    Scores {
        examples: logits.len(),
        positive_share: positive / total,
        auc: auc(logits, labels, weights),
        loss: loss / total,
        calibration_error: error / total,
        bins,
    }
}

/// Probability that a positive scores above a negative, ties counted half; weighted.
fn auc(logits: &[f32], labels: &[f32], weights: &[f32]) -> f64 {
    let mut order: Vec<usize> = (0..logits.len()).collect();
    order.sort_by(|a, b| logits[*a].total_cmp(&logits[*b]));
    let (mut below, mut won, mut positive) = (0.0, 0.0, 0.0);
    for tied in order.chunk_by(|a, b| logits[*a] == logits[*b]) {
        let sum = |label: f32| -> f64 {
            tied.iter().filter(|i| labels[**i] == label).map(|i| f64::from(weights[*i])).sum()
        };
        let (p, n) = (sum(1.0), sum(0.0));
        won += p * (below + n / 2.0);
        below += n;
        positive += p;
    }
    won / (positive * below)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn auc_counts_pairs() {
        // Positives 3 and 1, negatives 2, 1 and 0: 3 beats all, 1 beats one and ties one.
        let found = auc(&[3.0, 1.0, 2.0, 1.0, 0.0], &[1.0, 1.0, 0.0, 0.0, 0.0], &[1.0; 5]);
        assert!((found - 4.5 / 6.0).abs() < 1e-12, "{found}");
        assert!(auc(&[0.0, 1.0], &[1.0, 1.0], &[1.0; 2]).is_nan());
    }

    #[test]
    fn calibrated_probabilities_have_no_calibration_error() {
        // At logit 0 half are positive; at ln 3 three quarters.
        let logits: Vec<f32> = [vec![0.0; 4], vec![3f32.ln(); 4]].concat();
        let labels = [0.0, 1.0, 0.0, 1.0, 1.0, 1.0, 1.0, 0.0];
        let found = scores(&logits, &labels, &[1.0; 8]);
        assert!(found.calibration_error < 1e-6, "{found:?}");
        let overconfident: Vec<f32> = logits.iter().map(|l| l + 3.0).collect();
        assert!(scores(&overconfident, &labels, &[1.0; 8]).calibration_error > 0.2);
    }
}
