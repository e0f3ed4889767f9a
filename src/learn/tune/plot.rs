//! Consistency before and after, drawn.

use plotters::prelude::*;

use super::chi_square;
use super::measure::{GROUP_AXES, HORIZONS, Measured, Sample, Statistic};

/// Degrees of freedom of a whole box.
const BOX: usize = 2 * GROUP_AXES;
/// Width and height of a panel, pixels.
const PANEL: (u32, u32) = (640, 420);
/// Tracks older than this are not drawn, s.
const OLDEST: usize = 20;
/// Fewest samples of a point.
const FEWEST: usize = 20;

/// A picture that could not be drawn.
#[derive(Debug, thiserror::Error)]
#[error("cannot draw the plot: {0}")]
pub struct PlotError(String);

/// An SVG of the errors of the whole box (`n = 4`), a prediction of one frame and of a second, before and
/// after tuning. Left: the distribution beside the chi-square density. Right: their mean over the age of
/// the track, beside its 95 % bounds.
///
/// # Errors
/// Nothing that the data can cause; what the drawing library says.
pub fn consistency(statistic: Statistic, before: &Measured, after: &Measured) -> Result<String, PlotError> {
    let mut svg = String::new();
    let error = |e: &dyn std::fmt::Display| PlotError(e.to_string());
    {
        let root = SVGBackend::with_string(&mut svg, (2 * PANEL.0, 2 * PANEL.1)).into_drawing_area();
        root.fill(&WHITE).map_err(|e| error(&e))?;
        let panels = root.split_evenly((2, 2));
        for (row, horizon) in [1, HORIZONS.len() - 1].into_iter().enumerate() {
            let samples = [&before.samples[horizon], &after.samples[horizon]];
            let what = format!("{} after {}", statistic.name(), HORIZONS[horizon].name());
            distribution(&panels[2 * row], &what, samples).map_err(|e| error(&e))?;
            by_age(&panels[2 * row + 1], &what, samples).map_err(|e| error(&e))?;
        }
        root.present().map_err(|e| error(&e))?;
    }
    Ok(svg)
}

type Area<'a> = DrawingArea<SVGBackend<'a>, plotters::coord::Shift>;
type Drawn<'a> = Result<(), DrawingAreaErrorKind<<SVGBackend<'a> as DrawingBackend>::ErrorType>>;

const NAMES: [&str; 2] = ["before", "after"];
const COLOURS: [RGBColor; 2] = [RGBColor(200, 60, 40), RGBColor(20, 90, 180)];
const GREY: RGBColor = RGBColor(110, 110, 110);

fn squared(samples: &[Sample]) -> impl Iterator<Item = f64> {
    samples.iter().map(|s| s.squared.iter().sum())
}

fn distribution<'a>(area: &Area<'a>, what: &str, samples: [&Vec<Sample>; 2]) -> Drawn<'a> {
    let (bins, width) = (40, 0.4);
    let end = bins as f64 * width;
    let densities = samples.map(|samples| {
        let mut counts = vec![0.0; bins];
        for bin in squared(samples).map(|v| (v / width) as usize) {
            if let Some(count) = counts.get_mut(bin) {
                *count += 1.0 / (samples.len() as f64 * width);
            }
        }
        counts
    });
    let expected: Vec<(f64, f64)> =
        (1..=200).map(|i| f64::from(i) * end / 200.0).map(|x| (x, chi_square::density(BOX, x))).collect();
    let top = densities.iter().flatten().copied().chain(expected.iter().map(|p| p.1)).fold(0.0, f64::max);
    let mut chart = ChartBuilder::on(area)
        .caption(format!("{what}, distribution"), ("sans-serif", 18))
        .margin(10)
        .x_label_area_size(36)
        .y_label_area_size(52)
        .build_cartesian_2d(0.0..end, 0.0..top * 1.1)?;
    chart.configure_mesh().x_desc("squared normalised error").y_desc("density").draw()?;
    chart
        .draw_series(LineSeries::new(expected, GREY.stroke_width(2)))?
        .label("chi-square, 4 degrees")
        .legend(|(x, y)| PathElement::new([(x, y), (x + 20, y)], GREY.stroke_width(2)));
    for (i, counts) in densities.into_iter().enumerate() {
        let steps = counts
            .into_iter()
            .enumerate()
            .flat_map(|(bin, density)| [(bin as f64 * width, density), ((bin + 1) as f64 * width, density)]);
        chart
            .draw_series(LineSeries::new(steps, COLOURS[i].stroke_width(2)))?
            .label(NAMES[i])
            .legend(move |(x, y)| PathElement::new([(x, y), (x + 20, y)], COLOURS[i].stroke_width(2)));
    }
    chart.configure_series_labels().background_style(WHITE.mix(0.8)).border_style(GREY).draw()
}

fn by_age<'a>(area: &Area<'a>, what: &str, samples: [&Vec<Sample>; 2]) -> Drawn<'a> {
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
    let curves = means.each_ref().map(|bins| points(bins, &|count, sum| sum / count as f64));
    // As many samples before as after: the same looks at the same people.
    let bounds = [
        points(&means[1], &|count, _| chi_square::mean_bounds(BOX, count).0),
        points(&means[1], &|count, _| chi_square::mean_bounds(BOX, count).1),
    ];
    let all = curves.iter().chain(&bounds).flatten().map(|p| p.1).filter(|v| *v > 0.0);
    let (low, high) = all.fold((2.0, 8.0), |(low, high): (f64, f64), v| (low.min(v), high.max(v)));
    let end = curves.iter().flatten().map(|p| p.0).fold(1.0, f64::max) + 0.5;
    let mut chart = ChartBuilder::on(area)
        .caption(format!("{what}, mean over the age of the track"), ("sans-serif", 18))
        .margin(10)
        .x_label_area_size(36)
        .y_label_area_size(52)
        .build_cartesian_2d(0.0..end, (low / 1.2..high * 1.2).log_scale())?;
    chart.configure_mesh().x_desc("age, s").y_desc("mean").draw()?;
    for (i, bound) in bounds.into_iter().enumerate() {
        let drawn = chart.draw_series(LineSeries::new(bound, GREY.stroke_width(2)))?;
        if i == 0 {
            drawn
                .label("95 % bounds")
                .legend(|(x, y)| PathElement::new([(x, y), (x + 20, y)], GREY.stroke_width(2)));
        }
    }
    for (i, curve) in curves.into_iter().enumerate() {
        chart
            .draw_series(LineSeries::new(curve, COLOURS[i].stroke_width(2)))?
            .label(NAMES[i])
            .legend(move |(x, y)| PathElement::new([(x, y), (x + 20, y)], COLOURS[i].stroke_width(2)));
    }
    chart.configure_series_labels().background_style(WHITE.mix(0.8)).border_style(GREY).draw()
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
