//! Laws of the MOTChallenge module: files round-trip, and scores do what they must for any input.

use std::collections::BTreeMap;

use gakp::mot::{
    Benchmark, Row, Score, evaluate, parse_detections, parse_results, parse_truth, write_detections,
    write_results, write_truth,
};
use gakp::types::BBox;
use proptest::prelude::*;

const LENGTH: u32 = 12;

/// Boxes by frame and identity: at most one of an identity in a frame, crowded enough to overlap.
fn boxes() -> impl Strategy<Value = BTreeMap<(u32, i64), BBox>> {
    let bbox =
        (-20.0..60.0, -20.0..60.0, 1.0..40.0, 1.0..40.0).prop_map(|(x, y, w, h)| BBox::new(x, y, w, h));
    prop::collection::btree_map((1..=LENGTH, 0..6i64), bbox, 0..50)
}

fn rows(boxes: &BTreeMap<(u32, i64), BBox>) -> Vec<Row> {
    let row =
        |(&(frame, id), &bbox)| Row { frame, id, bbox, conf: 1.0, class: Some(1), visibility: Some(1.0) };
    boxes.iter().map(row).collect()
}

fn score(truth: &[Row], results: &[Row]) -> Score {
    evaluate(truth, results, LENGTH, Benchmark::Mot17).unwrap()
}

/// Moves every identity to a place of its own, so that no two overlap.
fn apart(mut rows: Vec<Row>) -> Vec<Row> {
    rows.iter_mut().for_each(|row| row.bbox.x += 1000.0 * row.id as f64);
    rows
}

proptest! {
    #[test]
    fn perfect_results_score_everything(boxes in boxes()) {
        let truth = apart(rows(&boxes));
        let score = score(&truth, &truth);
        let boxes = truth.len() as u64;
        prop_assert_eq!((score.clear.tp, score.clear.fp, score.clear.fn_, score.clear.idsw), (boxes, 0, 0, 0));
        prop_assert_eq!((score.identity.tp, score.identity.fp, score.identity.fn_), (boxes, 0, 0));
        prop_assert_eq!((score.clear.pt, score.clear.ml), (0, 0));
        if boxes > 0 {
            for value in [score.hota.hota(), score.hota.det_a(), score.hota.ass_a(), score.hota.loc_a(),
                          score.clear.mota(), score.clear.motp(), score.identity.idf1()] {
                prop_assert!((value - 1.0).abs() < 1e-9, "{}", value);
            }
        }
    }

    #[test]
    fn names_of_identities_do_not_matter(truth in boxes(), results in boxes(), names in Just((100..106i64).collect::<Vec<_>>()).prop_shuffle()) {
        let (truth, results) = (rows(&truth), rows(&results));
        let renamed: Vec<Row> = results.iter().map(|row| Row { id: names[row.id as usize], ..*row }).collect();
        prop_assert_eq!(score(&truth, &results), score(&truth, &renamed));
    }

    #[test]
    fn counts_add_up(truth in boxes(), results in boxes()) {
        let (truth, results) = (rows(&truth), rows(&results));
        let Score { hota, clear, identity } = score(&truth, &results);
        let (boxes, tracked) = (truth.len() as u64, results.len() as u64);
        prop_assert_eq!((clear.tp + clear.fn_, clear.tp + clear.fp), (boxes, tracked));
        prop_assert_eq!((identity.tp + identity.fn_, identity.tp + identity.fp), (boxes, tracked));
        let identities = truth.iter().map(|row| row.id).collect::<std::collections::BTreeSet<_>>().len() as u64;
        prop_assert_eq!(clear.mt + clear.pt + clear.ml, identities);
        for a in 0..gakp::mot::ALPHAS {
            prop_assert_eq!((hota.tp[a] + hota.fn_[a], hota.tp[a] + hota.fp[a]), (boxes, tracked));
            prop_assert!(a == 0 || hota.tp[a] <= hota.tp[a - 1]);
        }
        for value in [hota.hota(), hota.det_a(), hota.ass_a(), hota.loc_a(), clear.motp(), identity.idf1()] {
            prop_assert!((0.0..=1.0 + 1e-9).contains(&value), "{}", value);
        }
        prop_assert!(clear.mota() <= 1.0);
    }

    #[test]
    fn results_on_distractors_are_neither_right_nor_wrong(truth in boxes(), results in boxes(), on in boxes()) {
        let (truth, results) = (rows(&truth), rows(&results));
        // Far away, so that they share nothing with what counts.
        let far = |row: &Row, id| Row { id: row.id + id, bbox: row.bbox.shifted(1e5 + 1000.0 * row.id as f64, 0.0), ..*row };
        let distractors = rows(&on);
        let more_truth = distractors.iter().map(|row| Row { class: Some(7), conf: 0.0, ..far(row, 50) });
        let more_results = distractors.iter().map(|row| far(row, 70));
        let all_truth: Vec<Row> = truth.iter().copied().chain(more_truth).collect();
        let all_results: Vec<Row> = results.iter().copied().chain(more_results).collect();
        prop_assert_eq!(score(&truth, &results), score(&all_truth, &all_results));
    }

    #[test]
    fn one_sequence_combined_is_itself(truth in boxes(), results in boxes()) {
        let one = score(&rows(&truth), &rows(&results));
        let combined = Score::combine(&[&one]);
        prop_assert_eq!((&combined.clear, &combined.identity), (&one.clear, &one.identity));
        prop_assert!((combined.hota.hota() - one.hota.hota()).abs() < 1e-12);
        prop_assert!((combined.hota.loc_a() - one.hota.loc_a()).abs() < 1e-12);
    }

    #[test]
    fn files_round_trip(boxes in boxes(), form in 0..3usize, conf in -3.0..120.0f64) {
        let mut all = rows(&boxes);
        for row in &mut all {
            row.conf = conf;
            row.class = [None, Some(7), Some(1)][form];
            row.visibility = [None, None, Some(0.123456)][form];
        }
        prop_assert_eq!(&parse_truth(&write_truth(&all), Some(LENGTH)).unwrap(), &all);
        all.iter_mut().for_each(|row| (row.class, row.visibility) = (None, None));
        let text = write_results(&all);
        let back = parse_results(&text, Some(LENGTH)).unwrap();
        prop_assert_eq!(write_results(&back), text);
        for (a, b) in all.iter().zip(&back) {
            prop_assert_eq!((a.frame, a.id), (b.frame, b.id));
            for (a, b) in [(a.bbox.x, b.bbox.x), (a.bbox.y, b.bbox.y), (a.bbox.w, b.bbox.w), (a.bbox.h, b.bbox.h)] {
                prop_assert!((a - b).abs() <= 0.005 + 1e-9);
            }
        }
        all.iter_mut().for_each(|row| row.id = -1);
        prop_assert_eq!(&parse_detections(&write_detections(&all), Some(LENGTH)).unwrap(), &all);
    }

    #[test]
    fn no_text_panics(text in "([0-9a-z.,+-]| |\n|\r|é){0,60}") {
        let _ = (parse_truth(&text, Some(9)), parse_results(&text, None), parse_detections(&text, Some(9)));
        let _ = gakp::mot::SequenceInfo::parse(&format!("[Sequence]\n{text}"));
    }
}
