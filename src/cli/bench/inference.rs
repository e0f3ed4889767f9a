//! `gakp bench inference`: each model by itself, against the batch.

use std::time::Duration;

use anyhow::{Result, ensure};
use serde_json::json;

use super::super::models::ModelArgs;
use crate::infer::ModelConfig;
use crate::infer::rates::{Load, ModelRates, rates};

/// Frames, crops and pairs a second: pictures in, boxes and vectors out, on as many threads as the provider's arrangement
/// has, each with its own session. It needs no video, and builds without GStreamer:
/// `cargo build --release --no-default-features --features cli,infer`.
#[derive(Clone, Debug, clap::Args)]
pub struct Args {
    /// Size of a frame.
    #[arg(long, default_value = "768x576", value_name = "WxH", value_parser = super::super::models::size)]
    frame: (usize, usize),
    /// Frames that the detector is given at once.
    #[arg(long, value_name = "N", value_delimiter = ',', default_values_t = [1, 2, 4, 8, 16])]
    batches: Vec<usize>,
    /// Crops that the appearance model is given at once.
    #[arg(long, value_name = "N", value_delimiter = ',', default_values_t = [1, 4, 16, 64])]
    crops: Vec<usize>,
    /// Pairs that the link scorer is given at once.
    #[arg(long, value_name = "N", value_delimiter = ',', default_values_t = [16, 64, 256, 1024])]
    pairs: Vec<usize>,
    /// How long each is measured.
    #[arg(long, default_value_t = 2.0, value_name = "SECONDS")]
    seconds: f64,
    /// Print JSON.
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    models: ModelArgs,
}

/// Runs the command.
///
/// # Errors
/// A model fails, or a setting makes no sense.
pub fn run(args: Args) -> Result<()> {
    let sizes = [&args.batches, &args.crops, &args.pairs];
    ensure!(sizes.iter().all(|sizes| !sizes.contains(&0)), "--batches, --crops and --pairs are at least 1");
    ensure!(args.seconds > 0.0 && args.seconds < 1e6, "--seconds is above 0");
    let (width, height) = args.frame;
    ensure!(width >= 16 && height >= 16 && width <= 8192 && height <= 8192, "--frame is 16 to 8192 pixels");
    let load = Load {
        frame: (width as u32, height as u32),
        frames: args.batches,
        crops: args.crops,
        pairs: args.pairs,
        lasts: Duration::from_secs_f64(args.seconds),
    };
    let (provider, models) = rates(&ModelConfig::from(args.models).settings()?, &load)?;
    if args.json {
        println!("{}", serde_json::to_string_pretty(&json!({"provider": provider, "models": models}))?);
    } else {
        println!("provider {provider}, frames of {width}x{height}");
        models.iter().for_each(print);
    }
    Ok(())
}

fn print(model: &ModelRates) {
    let ModelRates { task, model: name, items, rates } = model;
    println!("{task}: {name}");
    println!("  batch  threads  {items:>6}/s  model alone  of its limit  call p50    p95    p99 ms");
    let limit = model.limit();
    for rate in rates {
        let alone = rate.alone().map_or("-".into(), |alone| format!("{alone:.0}"));
        let of_limit = limit.map_or("-".into(), |limit| format!("{:.2}", rate.per_second / limit));
        let [p50, p95, p99] = rate.call_ms;
        println!(
            "  {:5}  {:7}  {:8.0}  {alone:>11}  {of_limit:>12}  {p50:8.2}  {p95:5.2}  {p99:5.2}",
            rate.batch, rate.threads, rate.per_second
        );
    }
}
