//! Consistency before and after, drawn.

use super::chi_square;
use super::measure::{GROUP_AXES, HORIZONS, Measured, Sample, Statistic};
use crate::chart::{ChartError, Line, Panel, svg};

/// Degrees of freedom of a whole box.
const BOX: usize = 2 * GROUP_AXES;
/// Tracks older than this are not drawn, s.
const OLDEST: usize = 20;
/// Fewest samples of a point.
const FEWEST: usize = 20;
/// Bars of a distribution and the width of one.
const BINS: (usize, f64) = (40, 0.4);

const NAMES: [&str; 2] = ["before", "after"];

/// An SVG of the errors of the whole box (`n = 4`), a prediction of one frame and of a second, before and
/// after tuning. Left: the distribution beside the chi-square density. Right: their mean over the age of
/// the track, beside its 95 % bounds.
///
/// # Errors
/// Nothing that the data can cause; what the drawing library says.
pub fn consistency(statistic: Statistic, before: &Measured, after: &Measured) -> Result<String, ChartError> {
    let panels = [1, HORIZONS.len() - 1].into_iter().flat_map(|horizon| {
        let samples = [&before.samples[horizon], &after.samples[horizon]];
        let what = format!("{} after {}", statistic.name(), HORIZONS[horizon].name());
        [distribution(&what, samples), by_age(&what, samples)]
    });
    svg(&panels.collect::<Vec<_>>(), 2)
}

fn squared(samples: &[Sample]) -> impl Iterator<Item = f64> {
    samples.iter().map(|s| s.squared.iter().sum())
}

fn distribution(what: &str, samples: [&Vec<Sample>; 2]) -> Panel {
    let (bins, width) = BINS;
    let density = |samples: &[Sample]| -> Vec<(f64, f64)> {
        let mut counts = vec![0.0; bins];
        for bin in squared(samples).map(|v| (v / width) as usize) {
            if let Some(count) = counts.get_mut(bin) {
                *count += 1.0 / (samples.len() as f64 * width);
            }
        }
        let step = |(bin, density): (usize, f64)| {
            [(bin as f64 * width, density), ((bin + 1) as f64 * width, density)]
        };
        counts.into_iter().enumerate().flat_map(step).collect()
    };
    let end = bins as f64 * width;
    let expected = (1..=200).map(|i| f64::from(i) * end / 200.0).map(|x| (x, chi_square::density(BOX, x)));
    let mut lines = vec![Line::reference("chi-square, 4 degrees", expected.collect())];
    lines.extend(NAMES.iter().zip(samples).map(|(name, samples)| Line::new(*name, density(samples))));
    Panel {
        caption: format!("{what}, distribution"),
        axes: ["squared normalised error".into(), "density".into()],
        log: false,
        lines,
    }
}

fn by_age(what: &str, samples: [&Vec<Sample>; 2]) -> Panel {
    let means = samples.map(|samples| {
        let mut bins = vec![(0usize, 0.0); OLDEST];
        for sample in samples {
            if let Some((count, sum)) = bins.get_mut(sample.age as usize) {
                *count += 1;
                *sum += sample.squared.iter().sum::<f64>();
            }
        }
        bins
    });
    let points = |bins: &[(usize, f64)], value: &dyn Fn(usize, f64) -> f64| -> Vec<(f64, f64)> {
        let enough = bins.iter().enumerate().filter(|(_, (count, _))| *count >= FEWEST);
        enough.map(|(age, (count, sum))| (age as f64 + 0.5, value(*count, *sum))).collect()
    };
    // As many samples before as after: the same looks at the same people.
    let bound = |value: &dyn Fn(usize, f64) -> f64| points(&means[1], value);
    let mut lines = vec![
        Line::reference("95 % bounds", bound(&|count, _| chi_square::mean_bounds(BOX, count).0)),
        Line::reference("", bound(&|count, _| chi_square::mean_bounds(BOX, count).1)),
    ];
    let curves = means.iter().map(|bins| points(bins, &|count, sum| sum / count as f64));
    lines.extend(NAMES.iter().zip(curves).map(|(name, curve)| Line::new(*name, curve)));
    Panel {
        caption: format!("{what}, mean over the age of the track"),
        axes: ["age, s".into(), "mean".into()],
        log: true,
        lines,
    }
}

#[cfg(test)]
mod tests {
    use super::super::{World, measure, scaled};
    use super::*;

    #[test]
    fn draws_both_curves_and_their_bounds() {
        let world = World { people: 60, ..World::default() };
        let recording = world.record();
        let before = measure(&scaled(&world.filter, 10.0, 0.1), &[&recording], Statistic::Nees);
        let after = measure(&world.filter, &[&recording], Statistic::Nees);
        let svg = consistency(Statistic::Nees, &before, &after).expect("drawn");
        assert!(svg.starts_with("<svg") && svg.trim_end().ends_with("</svg>"));
        for text in ["before", "after", "95 % bounds", "chi-square", "NEES after 1 frame", "NEES after 1 s"] {
            assert!(svg.contains(text), "{text}");
        }
        assert!(!svg.contains("NaN"), "every point is a number");
        // Nothing to draw is no reason to fail.
        let nothing = Measured::default();
        assert!(consistency(Statistic::Nis, &nothing, &nothing).is_ok());
    }
}
