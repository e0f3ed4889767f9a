//! The tracker with a network on labelled sequences: boxes for the existence head, scores of unseen footage.

use std::convert::Infallible;
use std::fs;
use std::sync::Arc;

use anyhow::{Context, Result};

use super::{Source, bar};
use crate::learn::card::Unseen;
use crate::learn::dataset::LabelledSequence;
use crate::learn::network::{Network, Scorer};
use crate::learn::{Boxes, Examples, Teacher, metrics};
use crate::mot::{Benchmark, Row, Sequence, SequenceInfo, evaluate, first_half_length, parse_truth, replay};
use crate::track::{ExistenceHead, TrackerConfig};

/// The frames of a sequence that count, and their truth, both from the first one on.
fn counted(source: &Source, second_half: &[String]) -> Result<(bool, LabelledSequence, Vec<Row>)> {
    let labelled = &source.labelled;
    let half = second_half.iter().any(|s| labelled.name.strip_suffix(s).is_some_and(|n| n.ends_with('-')));
    let length = labelled.frames.len() as u32;
    let skip = if half { first_half_length(length).min(length) } else { 0 };
    let mut sequence = labelled.clone();
    sequence.frames.drain(..skip as usize);
    let file = source.folder.join("gt/gt.txt");
    let text = fs::read_to_string(&file).with_context(|| format!("cannot read {}", file.display()))?;
    let mut truth = parse_truth(&text, Some(length)).with_context(|| file.display().to_string())?;
    if half {
        truth = crate::mot::second_half(&truth, length);
    }
    Ok((half, sequence, truth))
}

/// What the tracker puts out on the sequences that the network was trained on.
pub fn boxes(
    model: &Network,
    tracker: &TrackerConfig,
    seen: &[&Source],
    second_half: &[String],
    name: &str,
) -> Result<Boxes> {
    let bar = bar(seen.len() as u64, "{msg} {wide_bar} {pos}/{len}");
    bar.set_message(format!("{name}: boxes"));
    let mut scorer = Scorer::new(model.clone());
    let mut config = tracker.clone();
    config.association.method = model.association();
    config.association.features = model.features();
    let mut boxes = Boxes::default();
    for source in seen {
        let (_, sequence, truth) = counted(source, second_half)?;
        boxes.collect(&sequence, &truth, &config, |request| {
            let mut links = vec![];
            scorer.score(request, &mut links);
            links
        });
        bar.inc(1);
    }
    bar.finish_and_clear();
    Ok(boxes)
}

/// Pairs and tracks of a sequence under a network and a head that have not seen it.
pub fn score(
    model: &Network,
    tracker: &TrackerConfig,
    head: &Arc<ExistenceHead>,
    source: &Source,
    second_half: &[String],
) -> Result<Unseen> {
    let (half, counted, truth) = counted(source, second_half)?;
    let length = counted.frames.len() as u32;
    let mut pairs = Examples::of(model.features());
    let teacher = Teacher { filter: tracker.filter, features: model.features(), ..Teacher::natural() };
    teacher.collect(&counted, &mut fastrand::Rng::with_seed(0), &mut pairs);
    let link = metrics::scores(&model.logits(&pairs), pairs.labels(), pairs.weights());

    let sequence = Sequence {
        info: SequenceInfo {
            name: counted.name.clone(),
            frame_rate: counted.frame_rate,
            length,
            width: counted.width as u32,
            height: counted.height as u32,
        },
        detections: counted.frames.iter().map(|f| f.detections.clone()).collect(),
    };
    let mut scorer = Scorer::new(model.clone());
    let links = |request: &_| {
        let mut links = vec![];
        scorer.score(request, &mut links);
        Ok::<_, Infallible>(links)
    };
    let mut config = tracker.clone();
    config.association.method = model.association();
    config.association.features = model.features();
    config.existence.head = Some(head.clone());
    let embeddings = |frame: usize| counted.frames[frame].embeddings.clone();
    let rows = replay(&sequence, &config, embeddings, links)?;
    let tracks = evaluate(&truth, &rows, length, Benchmark::of(&counted.name, &truth))
        .with_context(|| counted.name.clone())?;
    Ok(Unseen {
        sequence: counted.name.clone(),
        second_half: half,
        pairs: pairs.len(),
        auc: link.auc,
        loss: link.loss,
        calibration_error: link.calibration_error,
        hota: 100.0 * tracks.hota.hota(),
        mota: 100.0 * tracks.clear.mota(),
        idf1: 100.0 * tracks.identity.idf1(),
        id_switches: tracks.clear.idsw,
    })
}
