//! `gakp ablate`: the paper's table, every association in one run.

mod networks;
mod table;
mod variant;
mod world;

use std::io::Write as _;
use std::path::PathBuf;
use std::time::Instant;

use anyhow::{Context, Result};

use super::models::ModelArgs;
use crate::config::{Config, ModelConfig};
use crate::mot::{evaluate, replay};
use crate::track::{LinkRequest, TrackerConfig};
use networks::{Kind, Networks};
use table::{Cell, Missing};
use variant::Variant;
use world::World;

/// Tracks every sequence under ROOT with every association of the paper, everything else equal, and
/// prints the paper's table: a block for each set of detections, one for all of them, and one for the
/// sequences that have appearance vectors (det/det_features.npy).
///
/// A row that needs what is not there (a network, appearance) says so instead of a figure. Hz is frames
/// a second of the tracker and the link network, one at a time, on this machine.
#[derive(Clone, Debug, clap::Args)]
pub struct Args {
    /// Folder of MOTChallenge sequences, each with gt/gt.txt, det/det.txt and seqinfo.ini.
    root: PathBuf,
    /// Folder of networks that leave one footage out, DIR/FOOTAGE.onnx, as `gakp train --loso` writes
    /// them; several times, for each kind of network (--association and --features of `gakp train`).
    /// Without, --link names one network for everything. All rows have the filter and the existence head of
    /// the first kind that there is for the footage: implicit, explicit, then those that see appearance.
    #[arg(long, value_name = "DIR")]
    links: Vec<PathBuf>,
    /// Only sequences whose names end in -SUFFIX; several, with commas between, in this order.
    #[arg(long, value_name = "SUFFIX", value_delimiter = ',')]
    det: Vec<String>,
    /// Track and score only the second half of sequences whose names end in -SUFFIX (their detector was
    /// trained on the first).
    #[arg(long, value_name = "SUFFIX", value_delimiter = ',')]
    second_half: Vec<String>,
    /// Configuration file: its [models] and [tracker] hold for every row.
    #[arg(long, short, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Print JSON: percentages at full precision.
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    models: ModelArgs,
}

/// Runs the command.
///
/// # Errors
/// A folder, file or setting that is wrong, or a network that cannot be loaded.
pub fn run(args: Args) -> Result<()> {
    let config = args.config.as_deref().map(Config::read).transpose()?.unwrap_or_default();
    let models = ModelConfig::from(args.models.clone()).or(config.models);
    let worlds = world::load(&args.root, &args.det, &args.second_half)?;
    let single = models.link.is_some();
    let mut settings = models.settings()?;
    settings.threads = Some(1);
    let mut networks = Networks::new(&args.links, settings, single)?;
    let variants = variant::all(&config.tracker.apply(TrackerConfig::default())?);
    let results = worlds
        .iter()
        .map(|world| {
            tracing::info!(sequence = world.name, "tracking");
            // The same filter and the same decision on what is output for every row, so that only the
            // association differs.
            let mut base = TrackerConfig::default();
            for kind in Kind::ALL {
                if let Some(linker) = networks.get(kind, &world.footage)? {
                    base = linker.calibrate(base);
                    break;
                }
            }
            let variants = variant::all(&config.tracker.apply(base)?);
            variants.iter().map(|variant| measure(world, variant, &mut networks)).collect()
        })
        .collect::<Result<Vec<Vec<Cell>>>>()?;
    networks.end();
    let report = table::report(&worlds, &variants, &results);
    let text = match args.json {
        true => serde_json::to_string_pretty(&report)? + "\n",
        false => table::print(&report),
    };
    std::io::stdout().write_all(text.as_bytes()).context("cannot write to standard output")
}

/// One row on one sequence.
fn measure(world: &World, variant: &Variant, networks: &mut Networks) -> Result<Cell> {
    if variant.appearance && world.embeddings.is_none() {
        return Ok(Cell::Missing(Missing::Embeddings));
    }
    let mut config = variant.config.clone();
    let linker = match variant.network {
        Some(kind) => match networks.get(kind, &world.footage)? {
            Some(linker) => Some(linker),
            None => return Ok(Cell::Missing(Missing::Network)),
        },
        None => None,
    };
    if let Some(linker) = &linker {
        config.association.features = linker.features();
        if let Some(embeddings) = world.embeddings.as_ref().filter(|_| variant.appearance) {
            linker.check_embeddings(embeddings.width()).with_context(|| world.name.clone())?;
        }
    }
    let embeddings = |frame: usize| match &world.embeddings {
        Some(embeddings) if variant.appearance => embeddings.frame(frame).to_vec(),
        _ => Vec::new(),
    };
    let links = |request: &LinkRequest| match &linker {
        Some(linker) => linker.score_blocking(request.clone()),
        None => Ok(Vec::new()),
    };
    let start = Instant::now();
    let rows = replay(&world.sequence, &config, embeddings, links)?;
    let seconds = start.elapsed().as_secs_f64();
    let frames = world.sequence.info.length;
    let score = evaluate(&world.truth, &rows, frames, world.benchmark).with_context(|| world.name.clone())?;
    Ok(Cell::Scored { score: Box::new(score), seconds, frames })
}
