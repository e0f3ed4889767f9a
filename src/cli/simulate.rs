//! `gakp simulate`: writes a simulated world of pedestrians as MOTChallenge folders.

use std::fs;
use std::path::PathBuf;

use anyhow::{Context, Result, ensure};

use crate::mot::{write_detections, write_truth};
use crate::simulate::simulate;

/// Writes a seeded world of pedestrians as MOTChallenge sequences (seqinfo.ini, gt/gt.txt, det/det.txt).
///
/// Each sequence has a camera, a crowd and a detector of its own. Nobody holds rights to it: what is trained on it
/// alone carries no licence of data. `gakp tune`, `train`, `track`, `ablate` and `eval` take it like any
/// footage. The same arguments give the same files.
#[derive(Clone, Debug, clap::Args)]
pub struct Args {
    /// Folder to write to; the sequences are OUT/SIM-SEED-NN.
    pub out: PathBuf,
    /// Sequences.
    #[arg(long, default_value_t = 60, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=1000))]
    pub sequences: u32,
    /// Length of each, s.
    #[arg(long, default_value_t = 30, value_name = "SECONDS", value_parser = clap::value_parser!(u32).range(1..=3600))]
    pub seconds: u32,
    /// Seed of the world.
    #[arg(long, default_value_t = 1)]
    pub seed: u32,
}

/// Runs the command.
///
/// # Errors
/// Files that cannot be written.
pub fn run(args: Args) -> Result<()> {
    let names: Vec<String> =
        (1..=args.sequences).map(|index| format!("SIM-{}-{index:02}", args.seed)).collect();
    // Whoever trains on the folder trains on all that is in it.
    if args.out.is_dir() {
        let unreadable = || format!("cannot read folder {}", args.out.display());
        for entry in fs::read_dir(&args.out).with_context(unreadable)? {
            let name = entry.with_context(unreadable)?.file_name().to_string_lossy().into_owned();
            let foreign = name.starts_with("SIM-") && !names.contains(&name);
            ensure!(
                !foreign,
                "{} already holds {name} of another world: give an empty folder",
                args.out.display()
            );
        }
    }
    let (mut people, mut boxes) = (0, 0);
    for (index, name) in (1u64..).zip(&names) {
        let seed = u64::from(args.seed) << 32 | index;
        let world = simulate(name, f64::from(args.seconds), seed);
        let folder = args.out.join(name);
        for (file, text) in [
            ("seqinfo.ini", world.info.write()),
            ("gt/gt.txt", write_truth(&world.truth)),
            ("det/det.txt", write_detections(&world.detections)),
        ] {
            let path = folder.join(file);
            let within = path.parent().unwrap_or(&folder);
            fs::create_dir_all(within).with_context(|| format!("cannot create {}", within.display()))?;
            fs::write(&path, text).with_context(|| format!("cannot write {}", path.display()))?;
        }
        people += world.truth.iter().map(|row| row.id).max().unwrap_or(0);
        boxes += world.detections.len();
    }
    println!(
        "wrote {} sequences of {} s to {}: {people} people, {boxes} detections",
        args.sequences,
        args.seconds,
        args.out.display()
    );
    Ok(())
}
