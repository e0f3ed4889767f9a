//! MOTChallenge sequence folders: detections in, rows out.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::{Context, Result};

use super::{Job, Output, progress};
use crate::infer::Linker;
use crate::mot::{Sequence, SequenceEmbeddings, SequenceInfo, replay};
use crate::track::{AppearanceConfig, TrackerConfig};

/// A folder's detections and, when they were asked for, their embeddings.
struct Input {
    sequence: Sequence,
    embeddings: SequenceEmbeddings,
}

/// Tracks several folders into `out/SEQ.txt`.
pub fn track_all(inputs: &[String], out: &Path, job: &Job) -> Result<()> {
    // Every input is read before the first output is written.
    let sequences = inputs.iter().map(|folder| read(Path::new(folder), job)).collect::<Result<Vec<_>>>()?;
    let work = Work::new(job)?;
    sequences.iter().try_for_each(|input| work.check(input))?;
    for (input, folder) in sequences.iter().zip(inputs) {
        let name = folder_name(Path::new(folder));
        work.track(input, &mut Output::create(&out.join(format!("{name}.txt")))?)?;
    }
    work.end();
    Ok(())
}

/// Tracks one folder.
pub fn track(folder: &Path, job: &Job, out: &mut Output) -> Result<()> {
    let input = read(folder, job)?;
    let work = Work::new(job)?;
    work.check(&input)?;
    work.track(&input, out)?;
    work.end();
    Ok(())
}

/// The tracker's settings, and the link scorer where the association asks one.
struct Work {
    config: TrackerConfig,
    linker: Option<Linker>,
}

impl Work {
    fn new(job: &Job) -> Result<Self> {
        let mut base = TrackerConfig::default();
        if job.features {
            base.appearance = AppearanceConfig::deep();
        }
        let method = job.tracker.apply(base.clone())?.association.method;
        let linker = match method.asks_scorer() {
            true => Some(Linker::load(&job.models, Arc::new(()))?),
            false => None,
        };
        if let Some(linker) = &linker {
            linker.check_suits(method)?;
            base = linker.calibrate(base);
        }
        let config = job.tracker.apply(base)?;
        if method.needs_appearance() && !job.features {
            tracing::warn!("association {method} without appearance: give --features where there are some");
        }
        Ok(Self { config, linker })
    }

    /// Whether the link scorer can read what there is.
    fn check(&self, Input { sequence, embeddings }: &Input) -> Result<()> {
        let check = |linker: &Linker| linker.check_embeddings(embeddings.width());
        self.linker.as_ref().map_or(Ok(()), check).with_context(|| sequence.info.name.clone())
    }

    fn track(&self, Input { sequence, embeddings }: &Input, out: &mut Output) -> Result<()> {
        let bar = progress::frames(Some(sequence.detections.len() as u64), &sequence.info.name);
        let embeddings = |frame: usize| {
            bar.set_position(frame as u64 + 1);
            embeddings.frame(frame).to_vec()
        };
        let links = |request: &_| match &self.linker {
            Some(linker) => linker.score_blocking(Clone::clone(request)),
            // An association that asks for nothing leaves every request empty.
            None => Ok(Vec::new()),
        };
        let rows = replay(sequence, &self.config, embeddings, links)?;
        bar.finish_and_clear();
        out.write(&rows)?;
        out.finish()
    }

    fn end(self) {
        self.linker.iter().for_each(Linker::shutdown);
    }
}

fn read(folder: &Path, job: &Job) -> Result<Input> {
    let text = |file: &PathBuf| {
        std::fs::read_to_string(file).with_context(|| {
            format!("{} is no MOTChallenge sequence: cannot read {}", folder.display(), file.display())
        })
    };
    let (ini, det) = (folder.join("seqinfo.ini"), folder.join("det/det.txt"));
    let info = SequenceInfo::parse(&text(&ini)?).with_context(|| ini.display().to_string())?;
    let rows = text(&det)?;
    let mut embeddings = SequenceEmbeddings::default();
    if job.features {
        let file = folder.join("det/det_features.npy");
        let bytes = std::fs::read(&file)
            .with_context(|| format!("cannot read {} (leave --features out without it)", file.display()))?;
        embeddings =
            SequenceEmbeddings::parse(&bytes, &rows, &info).with_context(|| file.display().to_string())?;
    }
    let mut sequence = Sequence::parse(info, &rows).with_context(|| det.display().to_string())?;
    if job.second_half {
        sequence = sequence.second_half();
        embeddings = embeddings.second_half();
    }
    if let Some(frames) = job.frames {
        sequence.detections.truncate(usize::try_from(frames).unwrap_or(usize::MAX));
    }
    Ok(Input { sequence, embeddings })
}

fn folder_name(folder: &Path) -> String {
    let name = folder.components().next_back();
    name.map_or_else(|| "sequence".into(), |name| name.as_os_str().to_string_lossy().into_owned())
}
