//! MOTChallenge sequence folders: detections in, rows out.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::{Context, Result};

use super::{Job, Output, progress};
use crate::infer::Linker;
use crate::mot::{Sequence, SequenceInfo, replay};
use crate::track::TrackerConfig;

/// Tracks several folders into `out/SEQ.txt`.
pub fn track_all(inputs: &[String], out: &Path, job: &Job) -> Result<()> {
    // Every input is read before the first output is written.
    let sequences = inputs.iter().map(|folder| read(Path::new(folder), job)).collect::<Result<Vec<_>>>()?;
    let linker = Linker::load(&job.models, Arc::new(()))?;
    for (sequence, folder) in sequences.iter().zip(inputs) {
        let name = folder_name(Path::new(folder));
        track_one(sequence, &linker, job, &mut Output::create(&out.join(format!("{name}.txt")))?)?;
    }
    linker.shutdown();
    Ok(())
}

/// Tracks one folder.
pub fn track(folder: &Path, job: &Job, out: &mut Output) -> Result<()> {
    let sequence = read(folder, job)?;
    let linker = Linker::load(&job.models, Arc::new(()))?;
    track_one(&sequence, &linker, job, out)?;
    linker.shutdown();
    Ok(())
}

fn track_one(sequence: &Sequence, linker: &Linker, job: &Job, out: &mut Output) -> Result<()> {
    let bar = progress::frames(Some(sequence.detections.len() as u64), &sequence.info.name);
    let embeddings = |frame: usize| {
        bar.set_position(frame as u64 + 1);
        Vec::new()
    };
    let config = job.tracker.apply(linker.calibrate(TrackerConfig::default()))?;
    let rows = replay(sequence, &config, embeddings, |request| linker.score_blocking(request.clone()))?;
    bar.finish_and_clear();
    out.write(&rows)?;
    out.finish()
}

fn read(folder: &Path, job: &Job) -> Result<Sequence> {
    let text = |file: &PathBuf| {
        std::fs::read_to_string(file).with_context(|| {
            format!("{} is no MOTChallenge sequence: cannot read {}", folder.display(), file.display())
        })
    };
    let (ini, det) = (folder.join("seqinfo.ini"), folder.join("det/det.txt"));
    let info = SequenceInfo::parse(&text(&ini)?).with_context(|| ini.display().to_string())?;
    let mut sequence = Sequence::parse(info, &text(&det)?).with_context(|| det.display().to_string())?;
    if job.second_half {
        sequence = sequence.second_half();
    }
    if let Some(frames) = job.frames {
        sequence.detections.truncate(usize::try_from(frames).unwrap_or(usize::MAX));
    }
    Ok(sequence)
}

fn folder_name(folder: &Path) -> String {
    let name = folder.components().next_back();
    name.map_or_else(|| "sequence".into(), |name| name.as_os_str().to_string_lossy().into_owned())
}
