//! Line charts as SVG.

use plotters::coord::Shift;
use plotters::coord::ranged1d::{AsRangedCoord, Ranged, ValueFormatter};
use plotters::prelude::*;

/// Width and height of a panel, pixels.
const PANEL: (u32, u32) = (640, 420);
/// Colours of the lines, in their order.
const COLOURS: [RGBColor; 6] = [
    RGBColor(200, 60, 40),
    RGBColor(20, 90, 180),
    RGBColor(30, 140, 70),
    RGBColor(150, 80, 170),
    RGBColor(210, 140, 20),
    RGBColor(60, 60, 60),
];
const GREY: RGBColor = RGBColor(110, 110, 110);

/// A picture that could not be drawn.
#[derive(Debug, thiserror::Error)]
#[error("cannot draw the chart: {0}")]
pub struct ChartError(String);

/// A line of a panel.
#[derive(Clone, Debug, Default)]
pub struct Line {
    /// Its name in the legend; lines without one are not listed.
    pub name: String,
    /// Its points, by x.
    pub points: Vec<(f64, f64)>,
    /// Grey: a limit or an expectation, not a measurement.
    pub reference: bool,
}

impl Line {
    /// A measured line.
    pub fn new(name: impl Into<String>, points: Vec<(f64, f64)>) -> Self {
        Self { name: name.into(), points, reference: false }
    }

    /// What a measurement is held against.
    pub fn reference(name: impl Into<String>, points: Vec<(f64, f64)>) -> Self {
        Self { name: name.into(), points, reference: true }
    }
}

/// One chart.
#[derive(Clone, Debug, Default)]
pub struct Panel {
    /// What it shows.
    pub caption: String,
    /// Names of the axes, with their units.
    pub axes: [String; 2],
    /// Whether y is logarithmic (points that are not positive are left out then). A linear axis begins at
    /// zero or at the least value if that is lower.
    pub log: bool,
    /// Its lines; measured ones take their colours in this order.
    pub lines: Vec<Line>,
}

/// An SVG of `panels`, row by row, `columns` of them side by side. Points that are not finite are left out.
///
/// # Errors
/// Nothing that the data can cause; what the drawing library says.
///
/// # Panics
/// When `columns` is zero.
pub fn svg(panels: &[Panel], columns: usize) -> Result<String, ChartError> {
    let rows = panels.len().div_ceil(columns);
    let size = (columns as u32 * PANEL.0, rows as u32 * PANEL.1);
    let mut svg = String::new();
    let error = |e: &dyn std::fmt::Display| ChartError(e.to_string());
    {
        let root = SVGBackend::with_string(&mut svg, size).into_drawing_area();
        root.fill(&WHITE).map_err(|e| error(&e))?;
        for (panel, area) in panels.iter().zip(root.split_evenly((rows, columns))) {
            draw(&area, panel).map_err(|e| error(&e))?;
        }
        root.present().map_err(|e| error(&e))?;
    }
    Ok(svg)
}

type Area<'a> = DrawingArea<SVGBackend<'a>, Shift>;
type Drawn<'a> = Result<(), DrawingAreaErrorKind<<SVGBackend<'a> as DrawingBackend>::ErrorType>>;

fn draw<'a>(area: &Area<'a>, panel: &Panel) -> Drawn<'a> {
    let usable = |p: &&(f64, f64)| p.0.is_finite() && p.1.is_finite() && (!panel.log || p.1 > 0.0);
    let points = || panel.lines.iter().flat_map(|line| &line.points).filter(usable);
    let ends = |of: fn(&(f64, f64)) -> f64| {
        points().map(of).fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), v| (low.min(v), high.max(v)))
    };
    let (mut x, mut y) = (ends(|p| p.0), ends(|p| p.1));
    if points().next().is_none() {
        (x, y) = ((0.0, 1.0), (if panel.log { 0.1 } else { 0.0 }, 1.0));
    }
    let x = x.0.min(0.0)..x.1.max(x.0 + 1e-9);
    if panel.log {
        on(area, panel, x, (y.0 / 1.2..y.1 * 1.2).log_scale())
    } else {
        let low = y.0.min(0.0);
        on(area, panel, x, low..low + ((y.1 - low) * 1.1).max(1e-9))
    }
}

fn on<'a, Y>(area: &Area<'a>, panel: &Panel, x: std::ops::Range<f64>, y: Y) -> Drawn<'a>
where
    Y: AsRangedCoord<Value = f64>,
    Y::CoordDescType: Ranged<ValueType = f64> + ValueFormatter<f64>,
{
    let mut chart = ChartBuilder::on(area)
        .caption(&panel.caption, ("sans-serif", 18))
        .margin(10)
        .x_label_area_size(36)
        .y_label_area_size(56)
        .build_cartesian_2d(x, y)?;
    chart.configure_mesh().x_desc(&panel.axes[0]).y_desc(&panel.axes[1]).draw()?;
    let mut colours = COLOURS.iter().cycle();
    for line in &panel.lines {
        let colour = if line.reference { GREY } else { *colours.next().unwrap_or(&GREY) };
        let style = colour.stroke_width(2);
        let points = line.points.iter().copied();
        let points = points.filter(|p| p.0.is_finite() && p.1.is_finite() && (!panel.log || p.1 > 0.0));
        let drawn = chart.draw_series(LineSeries::new(points, style))?;
        if !line.name.is_empty() {
            drawn.label(&line.name).legend(move |(x, y)| PathElement::new([(x, y), (x + 20, y)], style));
        }
    }
    chart.configure_series_labels().background_style(WHITE.mix(0.8)).border_style(GREY).draw()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn draws_every_line_and_survives_odd_points() {
        let odd = vec![(0.0, f64::NAN), (1.0, -1.0), (2.0, 3.0), (f64::INFINITY, 2.0)];
        let panel = |log| Panel {
            caption: "cost".into(),
            axes: ["people".into(), "us".into()],
            log,
            lines: vec![
                Line::new("first", odd.clone()),
                Line::reference("bound", vec![(0.0, 1.0), (3.0, 1.0)]),
            ],
        };
        let drawn = svg(&[panel(false), panel(true), Panel::default()], 2).expect("a picture");
        assert!(drawn.starts_with("<svg") && drawn.trim_end().ends_with("</svg>"));
        assert!(drawn.contains(r#"width="1280" height="840""#), "two rows of two: {}", &drawn[..120]);
        for text in ["first", "bound", "people", "cost"] {
            assert!(drawn.contains(text), "{text}");
        }
        assert!(!drawn.contains("NaN") && !drawn.contains("inf"), "every point is a number");
    }
}
