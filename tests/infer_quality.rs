//! How good the default models are on footage with ground truth. The data is not part of this
//! repository (its licence is non-commercial), so without it these tests say so and pass.
#![cfg(feature = "infer")]

mod infer_support;

use std::sync::Arc;

use gakp::infer::{ModelSettings, Models};
use gakp::types::{BBox, Detection, Embedding, Image};
use infer_support::{decode, models, settings, shared, truth};

type Truth = Vec<Vec<(u64, BBox)>>;

/// A video of the shared data, 640x480, and its ground truth.
fn footage(sequence: &str) -> Option<(Vec<Image>, Truth)> {
    let shared = shared()?;
    let frames = decode(&shared.join(format!("data/video/{sequence}.mp4")), 640, 480)?;
    let truth = truth(&shared.join("data/MOT15/train").join(sequence), frames.len());
    Some((frames, truth))
}

/// Average precision at IoU 0.5: the area under the precision envelope.
fn average_precision(found: &[Vec<Detection>], truth: &Truth) -> f64 {
    let mut all: Vec<(f64, usize, BBox)> =
        found.iter().enumerate().flat_map(|(f, ds)| ds.iter().map(move |d| (d.score, f, d.bbox))).collect();
    all.sort_by(|a, b| b.0.total_cmp(&a.0));
    let total: usize = truth.iter().map(Vec::len).sum();
    let mut taken: Vec<Vec<bool>> = truth.iter().map(|t| vec![false; t.len()]).collect();
    let (mut hits, mut points) = (0, vec![]);
    for (seen, (_, frame, bbox)) in all.iter().enumerate() {
        let best = truth[*frame]
            .iter()
            .enumerate()
            .filter(|(i, _)| !taken[*frame][*i])
            .map(|(i, (_, t))| (bbox.iou(t), i))
            .max_by(|a, b| a.0.total_cmp(&b.0));
        if let Some((iou, index)) = best
            && iou >= 0.5
        {
            taken[*frame][index] = true;
            hits += 1;
        }
        points.push((f64::from(hits) / total as f64, f64::from(hits) / (seen + 1) as f64));
    }
    let (mut area, mut recall) = (0.0, 0.0);
    for i in 0..points.len() {
        let precision = points[i..].iter().map(|p| p.1).fold(0.0, f64::max);
        area += (points[i].0 - recall) * precision;
        recall = points[i].0;
    }
    area
}

#[test]
fn the_detector_finds_people() {
    let Some(models) = models() else { return };
    let mut settings = settings(&models);
    settings.detection.score_threshold = Some(0.05);
    let models = Models::load(&settings, Arc::new(())).expect("models");
    for (sequence, least) in [("TUD-Stadtmitte", 0.88), ("TUD-Campus", 0.80)] {
        let Some((frames, truth)) = footage(sequence) else { return };
        let found: Vec<Vec<Detection>> = frames
            .iter()
            .map(|frame| models.detector.detect_blocking(frame.clone()).expect("detections"))
            .collect();
        let ap = average_precision(&found, &truth);
        println!("{sequence}: AP50 {ap:.4}");
        assert!(ap >= least, "{sequence}: AP50 {ap}");
    }
}

/// Mean average precision and rank-1 of retrieval: each crop asks for the crops of other frames.
fn retrieval(crops: &[(usize, u64, Embedding)], gap: usize) -> (f64, f64) {
    let (mut sum, mut first, mut queries) = (0.0, 0, 0);
    for (frame, id, query) in crops {
        let mut ranked: Vec<(f64, bool)> = crops
            .iter()
            .filter(|(f, _, _)| f.abs_diff(*frame) >= gap)
            .map(|(_, i, e)| (query.cosine(e), i == id))
            .collect();
        ranked.sort_by(|a, b| b.0.total_cmp(&a.0));
        let relevant = ranked.iter().filter(|r| r.1).count();
        if relevant == 0 {
            continue;
        }
        let (mut hits, mut precision) = (0, 0.0);
        for (rank, (_, same)) in ranked.iter().enumerate() {
            if *same {
                hits += 1;
                precision += f64::from(hits) / (rank + 1) as f64;
            }
        }
        sum += precision / relevant as f64;
        first += usize::from(ranked[0].1);
        queries += 1;
    }
    (sum / f64::from(queries), first as f64 / f64::from(queries))
}

#[test]
fn colours_tell_people_apart() {
    let Some(models) = models() else { return };
    let settings = ModelSettings { reid: "builtin".into(), ..settings(&models) };
    let models = Models::load(&settings, Arc::new(())).expect("models");
    let embedder = models.embedder.expect("an embedder");
    // A second between a query and what it is compared with; a crop every 4 frames.
    for (sequence, least) in [("TUD-Stadtmitte", (0.68, 0.80)), ("TUD-Campus", (0.74, 0.80))] {
        let Some((frames, truth)) = footage(sequence) else { return };
        let mut crops = vec![];
        for (index, (frame, truth)) in frames.iter().zip(&truth).enumerate().step_by(4) {
            let boxes: Vec<BBox> = truth.iter().map(|(_, bbox)| *bbox).collect();
            let found = embedder.embed_blocking(frame.clone(), boxes).expect("embeddings");
            for ((id, _), embedding) in truth.iter().zip(found) {
                crops.extend(embedding.map(|e| (index, *id, e)));
            }
        }
        let (map, rank1) = retrieval(&crops, 25);
        println!("{sequence}: mAP {map:.4}, rank-1 {rank1:.4}, {} crops", crops.len());
        assert!(map >= least.0 && rank1 >= least.1, "{sequence}: mAP {map}, rank-1 {rank1}");
    }
}
