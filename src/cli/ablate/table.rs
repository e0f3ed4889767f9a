//! The table: figures by set of detections, of all of them, and of the sequences with embeddings.

use std::fmt::Write as _;

use serde::Serialize;

use super::variant::Variant;
use super::world::World;
use crate::cli::eval::Figures;
use crate::mot::Score;

/// One row on one sequence.
pub enum Cell {
    /// Tracked.
    Scored {
        /// Its figures.
        score: Box<Score>,
        /// Time that tracking took.
        seconds: f64,
        /// Frames tracked.
        frames: u32,
    },
    /// Not tracked.
    Missing(Missing),
}

/// What a row lacks on a sequence.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Missing {
    /// No det/det_features.npy.
    Embeddings,
    /// No network that has not seen this footage.
    Network,
}

/// All blocks.
#[derive(Serialize)]
pub struct Report {
    blocks: Vec<Block>,
}

#[derive(Serialize)]
struct Block {
    /// Set of detections, or what else the sequences have in common.
    name: String,
    sequences: Vec<String>,
    rows: Vec<Line>,
}

#[derive(Serialize)]
struct Line {
    name: &'static str,
    /// The setting `tracker.association`.
    association: &'static str,
    /// None where something is missing.
    figures: Option<Figures>,
    /// Frames a second.
    #[serde(rename = "Hz")]
    hz: Option<f64>,
    /// What is missing.
    missing: Option<String>,
}

/// The blocks of `results`, a list a sequence of a cell a variant.
pub fn report(worlds: &[World], variants: &[Variant], results: &[Vec<Cell>]) -> Report {
    let mut sets: Vec<&str> = worlds.iter().map(|w| w.set.as_str()).collect();
    sets.dedup();
    let all = || 0..worlds.len();
    let block = |name: &str, chosen: Vec<usize>| block(name, &chosen, worlds, variants, results);
    let mut blocks: Vec<Block> = sets
        .iter()
        .map(|set| {
            let name = if set.is_empty() { "all" } else { set };
            block(name, all().filter(|&i| worlds[i].set == *set).collect())
        })
        .collect();
    if sets.len() > 1 {
        blocks.push(block("all sets", all().collect()));
    }
    let with: Vec<usize> = all().filter(|&i| worlds[i].embeddings.is_some()).collect();
    if !with.is_empty() && with.len() < worlds.len() {
        blocks.push(block("with appearance vectors", with));
    }
    Report { blocks }
}

fn block(
    name: &str,
    chosen: &[usize],
    worlds: &[World],
    variants: &[Variant],
    results: &[Vec<Cell>],
) -> Block {
    let sequences = chosen.iter().map(|&i| {
        let half = if worlds[i].half { " (second half)" } else { "" };
        format!("{}{half}", worlds[i].name)
    });
    let rows = variants.iter().enumerate().map(|(row, variant)| {
        let cells: Vec<(&str, &Cell)> =
            chosen.iter().map(|&i| (worlds[i].name.as_str(), &results[i][row])).collect();
        line(variant, &cells)
    });
    Block { name: name.into(), sequences: sequences.collect(), rows: rows.collect() }
}

fn line(variant: &Variant, cells: &[(&str, &Cell)]) -> Line {
    let lacking = |what: Missing| -> usize {
        cells.iter().filter(|(_, c)| matches!(c, Cell::Missing(missing) if *missing == what)).count()
    };
    let mut line = Line {
        name: variant.name,
        association: variant.config.association.method.as_str(),
        figures: None,
        hz: None,
        missing: None,
    };
    for (what, text) in
        [(Missing::Embeddings, "no appearance vectors"), (Missing::Network, "no network for this footage")]
    {
        let count = lacking(what);
        if count > 0 {
            line.missing = Some(format!("{text} in {count} of {} sequences", cells.len()));
            return line;
        }
    }
    let (mut scores, mut time, mut tracked) = (Vec::new(), 0.0, 0.0);
    for (_, cell) in cells {
        if let Cell::Scored { score, seconds, frames } = cell {
            scores.push(&**score);
            time += seconds;
            tracked += f64::from(*frames);
        }
    }
    line.figures = Some(Figures::from(&Score::combine(&scores)));
    line.hz = Some(tracked / time.max(1e-9));
    line
}

/// The blocks as text.
pub fn print(report: &Report) -> String {
    const HEAD: [&str; 10] = ["HOTA", "MOTA", "IDF1", "MT", "ML", "FP", "FN", "IDs", "Frag", "Hz"];
    let width = report.blocks.iter().flat_map(|b| &b.rows).map(|r| r.name.len()).max().unwrap_or(0);
    let mut out = String::new();
    for block in &report.blocks {
        let _ = writeln!(out, "{}: {}", block.name, block.sequences.join(" "));
        let _ = write!(out, "{:width$}", "");
        for title in HEAD {
            let _ = write!(out, " {title:>6}");
        }
        out.push('\n');
        for line in &block.rows {
            let _ = write!(out, "{:width$}", line.name);
            match (&line.figures, &line.missing) {
                (Some(f), _) => {
                    for score in [f.hota, f.mota, f.idf1] {
                        let _ = write!(out, " {score:6.1}");
                    }
                    for count in [f.mt, f.ml, f.fp, f.fn_, f.ids, f.frag] {
                        let _ = write!(out, " {count:6}");
                    }
                    let _ = write!(out, " {:6.0}", line.hz.unwrap_or_default());
                }
                (None, missing) => {
                    let _ = write!(out, "   {}", missing.as_deref().unwrap_or_default());
                }
            }
            out.push('\n');
        }
        out.push('\n');
    }
    out.pop();
    out
}
