//! What a service says of itself at `/metrics`, read back.

use std::collections::BTreeMap;

use anyhow::Result;

use super::served::Served;

/// Samples by their names and labels as they are written.
pub struct Scrape(BTreeMap<String, f64>);

/// Upper bounds of buckets and how many are at most that.
type Buckets = Vec<(f64, f64)>;

impl Scrape {
    /// Of now.
    pub fn of(service: &Served) -> Result<Self> {
        let text = service.request("GET", "/metrics", "")?;
        let sample = |line: &str| {
            let (name, value) = line.rsplit_once(' ')?;
            Some((name.to_owned(), value.parse().ok()?))
        };
        Ok(Self(text.lines().filter(|line| !line.starts_with('#')).filter_map(sample).collect()))
    }

    /// Of all labels of a metric.
    pub fn sum(&self, metric: &str) -> f64 {
        self.of_metric(metric).map(|(_, value)| value).sum()
    }

    fn of_metric(&self, metric: &str) -> impl Iterator<Item = (&str, f64)> {
        let samples = self.0.iter();
        samples.filter_map(move |(name, value)| Some((name.strip_prefix(metric)?.strip_prefix('{')?, *value)))
    }

    /// Buckets of a histogram whose labels contain `label`, all such together.
    fn buckets(&self, metric: &str, label: &str) -> Buckets {
        let mut sums = BTreeMap::<u64, (f64, f64)>::new();
        for (labels, count) in
            self.of_metric(&format!("{metric}_bucket")).filter(|(labels, _)| labels.contains(label))
        {
            let bound =
                labels.split("le=\"").nth(1).and_then(|rest| rest.split('"').next()?.parse::<f64>().ok());
            // Bounds are not negative, so their bits are in the same order.
            if let Some(bound) = bound {
                sums.entry(bound.to_bits()).or_insert((bound, 0.0)).1 += count;
            }
        }
        sums.into_values().collect()
    }

    /// 50, 95 and 99 of 100 of each stage since `before`, milliseconds.
    pub fn stages_since(&self, before: &Self) -> Vec<(String, [f64; 3])> {
        let stages = ["wait", "detect", "embed", "link", "track"];
        let stages = stages.map(|stage| (stage, "gakp_stage_seconds", format!("stage=\"{stage}\"")));
        let whole = [
            ("decoded to published", "gakp_decode_to_publish_seconds", String::new()),
            ("capture to published", "gakp_capture_to_publish_seconds", String::new()),
        ];
        let quantiles = |metric: &str, label: &str| {
            let old = before.buckets(metric, label);
            let new = self.buckets(metric, label);
            let of = |bound: f64| old.iter().find(|(b, _)| *b == bound).map_or(0.0, |(_, count)| *count);
            let since: Buckets = new.iter().map(|&(bound, count)| (bound, count - of(bound))).collect();
            [0.5, 0.95, 0.99].map(|share| 1e3 * quantile(&since, share))
        };
        stages
            .into_iter()
            .chain(whole)
            .map(|(name, metric, label)| (name.to_owned(), quantiles(metric, &label)))
            .collect()
    }
}

/// As PromQL's `histogram_quantile`: linear within a bucket; of the last one its lower bound.
fn quantile(buckets: &Buckets, share: f64) -> f64 {
    let all = buckets.last().map_or(0.0, |(_, count)| *count);
    let rank = share * all;
    let (mut lower, mut below) = (0.0, 0.0);
    for &(bound, count) in buckets {
        if count >= rank && count > below {
            return if bound.is_finite() {
                lower + (bound - lower) * (rank - below) / (count - below)
            } else {
                lower
            };
        }
        (lower, below) = (bound, count);
    }
    f64::NAN
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_are_interpolated_as_promql_does() {
        let buckets = vec![(0.1, 0.0), (0.2, 50.0), (0.4, 90.0), (f64::INFINITY, 100.0)];
        assert_eq!(quantile(&buckets, 0.5), 0.2);
        assert!((quantile(&buckets, 0.7) - 0.3).abs() < 1e-12);
        assert_eq!(quantile(&buckets, 0.99), 0.4);
        assert!(quantile(&vec![], 0.5).is_nan());
    }

    #[test]
    fn samples_of_a_metric_are_added_up() {
        let sample = |(name, value): (&str, f64)| (name.to_owned(), value);
        let samples = [
            ("a_total{camera=\"x\"}", 1.0),
            ("a_total{camera=\"y\"}", 2.0),
            ("a_totals{camera=\"x\"}", 4.0),
            ("h_bucket{stage=\"one\",le=\"0.5\"}", 3.0),
            ("h_bucket{stage=\"one\",le=\"+Inf\"}", 5.0),
            ("h_bucket{stage=\"two\",le=\"0.5\"}", 7.0),
        ];
        let scrape = Scrape(samples.map(sample).into());
        assert_eq!(scrape.sum("a_total"), 3.0);
        assert_eq!(scrape.buckets("h", "stage=\"one\""), [(0.5, 3.0), (f64::INFINITY, 5.0)]);
    }
}
