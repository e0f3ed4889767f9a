//! The sequences: detections, truth, and embeddings where there are some.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, ensure};

use crate::mot::{
    Benchmark, Row, Sequence, SequenceEmbeddings, SequenceInfo, footage, parse_truth, second_half,
};

/// A sequence with its truth.
pub struct World {
    /// Name of its folder.
    pub name: String,
    /// What copies by other detectors share.
    pub footage: String,
    /// Set of detections: what follows the footage in the name, or nothing.
    pub set: String,
    /// Whether only its second half is here.
    pub half: bool,
    /// Detections.
    pub sequence: Sequence,
    /// Their appearance.
    pub embeddings: Option<SequenceEmbeddings>,
    /// Truth.
    pub truth: Vec<Row>,
    /// Rules of scoring.
    pub benchmark: Benchmark,
}

/// Loads the sequences under `root`, of the sets in `det` when it names any: by set in that order
/// (else of their names), then by name.
pub fn load(root: &Path, det: &[String], halves: &[String]) -> Result<Vec<World>> {
    let entries =
        std::fs::read_dir(root).with_context(|| format!("cannot read folder {}", root.display()))?;
    let mut found = Vec::new();
    for entry in entries {
        let folder = entry.with_context(|| format!("cannot read folder {}", root.display()))?.path();
        let there = ["gt/gt.txt", "det/det.txt"].iter().all(|file| folder.join(file).is_file());
        let name = folder.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
        let place = match det.iter().position(|suffix| ends_in(&name, suffix)) {
            Some(place) => place,
            None if det.is_empty() => 0,
            None => continue,
        };
        if there {
            let set = match det.get(place) {
                Some(set) => set.clone(),
                None => name[footage(&name).len()..].trim_start_matches('-').to_string(),
            };
            found.push((place, set, name, folder));
        }
    }
    found.sort();
    let pattern = if det.is_empty() { "SEQ".into() } else { format!("SEQ-{}", det.join(", SEQ-")) };
    ensure!(
        !found.is_empty(),
        "no sequence in {}: expected folders {pattern}/ with gt/gt.txt, det/det.txt and seqinfo.ini",
        root.display()
    );
    for suffix in det {
        ensure!(
            found.iter().any(|(_, _, name, _)| ends_in(name, suffix)),
            "no sequence in {} ends in -{suffix}",
            root.display()
        );
    }
    found
        .into_iter()
        .map(|(_, set, name, folder)| {
            let half = halves.iter().any(|suffix| ends_in(&name, suffix));
            read(&folder, name, set, half)
        })
        .collect()
}

fn ends_in(name: &str, suffix: &str) -> bool {
    name.strip_suffix(suffix).is_some_and(|rest| rest.ends_with('-'))
}

fn read(folder: &Path, name: String, set: String, half: bool) -> Result<World> {
    let at = |file: &str| folder.join(file);
    let text = |file: &PathBuf| {
        std::fs::read_to_string(file).with_context(|| format!("cannot read {}", file.display()))
    };
    let (ini, det, gt) = (at("seqinfo.ini"), at("det/det.txt"), at("gt/gt.txt"));
    let info = SequenceInfo::parse(&text(&ini)?).with_context(|| ini.display().to_string())?;
    let rows = text(&det)?;
    let length = info.length;
    let features = at("det/det_features.npy");
    let mut embeddings = match features.is_file() {
        true => {
            let bytes =
                std::fs::read(&features).with_context(|| format!("cannot read {}", features.display()))?;
            let found = SequenceEmbeddings::parse(&bytes, &rows, &info);
            Some(found.with_context(|| features.display().to_string())?)
        }
        false => None,
    };
    let mut sequence = Sequence::parse(info, &rows).with_context(|| det.display().to_string())?;
    let mut truth = parse_truth(&text(&gt)?, Some(length)).with_context(|| gt.display().to_string())?;
    if half {
        sequence = sequence.second_half();
        embeddings = embeddings.map(SequenceEmbeddings::second_half);
        truth = second_half(&truth, length);
    }
    let benchmark = Benchmark::of(&name, &truth);
    Ok(World { footage: footage(&name).into(), name, set, half, sequence, embeddings, truth, benchmark })
}
