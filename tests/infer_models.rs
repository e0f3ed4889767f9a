//! The models through their handles: the small graphs of `fixtures/infer` with answers that can be
//! worked out, and the real detector on a real frame.
#![cfg(feature = "infer")]

mod infer_support;

use std::fs;
use std::sync::Arc;

use futures::executor::block_on;
use futures::future::join_all;
use gakp::infer::bench::{FrameWork, models_alone};
use gakp::infer::{InferError, ModelSettings, Models, ProviderChoice};
use gakp::track::features::relative;
use gakp::track::{AppearanceConfig, Features, HISTORY, LinkRequest, Pair, TrackerConfig};
use gakp::types::{BBox, ClassId, Image, YuvRange};
use infer_support::{decode, fixture, image, models, settings, sha256};

/// The three small graphs, with ONNX Runtime from the models' folder.
fn small() -> Option<(tempfile::TempDir, ModelSettings)> {
    let models = models()?;
    let folder = tempfile::tempdir().expect("a folder");
    let mut text = String::new();
    for (name, task, family, rest) in [
        (
            "yolox",
            "detect",
            "yolox",
            r#"[model.input]
            name = "images"
            shape = ["batch", 3, "height", "width"]
            width = 64
            height = 64
            multiple = 8
            colour = "rgb"
            mean = [0, 0, 0]
            std = [1, 1, 1]
            resize = "letterbox-centre"
            [model.output]
            name = "output"
            shape = ["batch", "anchors", 6]
            classes = ["person"]
            strides = [8]
            score_threshold = 0.3
            nms_iou = 0.6"#,
        ),
        (
            "reid",
            "reid",
            "embedding",
            r#"[model.input]
            name = "images"
            shape = ["batch", 3, 8, 4]
            width = 4
            height = 8
            colour = "bgr"
            mean = [0, 0, 0]
            std = [1, 1, 1]
            resize = "stretch"
            [model.output]
            name = "features"
            shape = ["batch", 3]
            width = 3"#,
        ),
        ("link", "link", "gru", ""),
    ] {
        let file = format!("{name}.onnx");
        fs::copy(fixture(&file), folder.path().join(&file)).expect("a copy");
        let hash = sha256(&fixture(&file));
        text += &format!(
            "[[model]]\nname = \"{name}\"\ntask = \"{task}\"\nfamily = \"{family}\"\nfile = \"{file}\"\n\
             sha256 = \"{hash}\"\nlicense = \"MIT\"\n{rest}\n"
        );
    }
    fs::write(folder.path().join("manifest.toml"), text).expect("a manifest");
    let settings = ModelSettings {
        onnxruntime: Some(models.join("cache/libonnxruntime.so")),
        detector: "yolox".into(),
        reid: "reid".into(),
        link: "link".into(),
        ..settings(folder.path())
    };
    Some((folder, settings))
}

fn load(settings: &ModelSettings) -> Models {
    Models::load(settings, Arc::new(())).expect("models")
}

/// A black frame with one yellow-green block; the small detector sees blocks that are red and green.
fn frame_with_block(width: u32, height: u32, block: [u32; 4]) -> Image {
    let (w, cw) = (width as usize, width.div_ceil(2) as usize);
    let mut planes = [
        vec![0; w * height as usize],
        vec![128; cw * height.div_ceil(2) as usize],
        vec![128; cw * height.div_ceil(2) as usize],
    ];
    let [x0, y0, x1, y1] = block;
    for y in y0..y1 {
        for x in x0..x1 {
            let at = (y / 2) as usize * cw + (x / 2) as usize;
            planes[0][y as usize * w + x as usize] = 226;
            planes[1][at] = 0;
            planes[2][at] = 148;
        }
    }
    image(width, height, YuvRange::Full, planes)
}

#[test]
fn a_block_is_found_where_it_is() {
    let Some((_folder, settings)) = small() else { return };
    let models = load(&settings);
    // 128x64 goes into 64x64 at half size: cells of 8 input pixels are 16 frame pixels.
    for (size, block) in [
        ((64, 64), [16, 24, 24, 32]),
        ((128, 64), [64, 16, 80, 32]),
        ((64, 128), [16, 96, 32, 112]),
        ((32, 32), [4, 8, 8, 12]),
    ] {
        let frame = frame_with_block(size.0, size.1, block);
        let found = models.detector.detect_blocking(frame).expect("detections");
        let [x0, y0, x1, y1] = block.map(f64::from);
        let expected = BBox::new(x0, y0, x1 - x0, y1 - y0);
        assert_eq!(found.len(), 1, "{size:?}: {found:?}");
        assert!(found[0].bbox.iou(&expected) > 0.999, "{size:?}: {found:?}");
        assert_eq!(found[0].class, ClassId::PERSON);
        assert!(found[0].score > 0.7, "{found:?}");
    }
}

#[test]
fn frames_of_many_cameras_get_their_own_answers() {
    let Some((_folder, settings)) = small() else { return };
    let models = load(&settings);
    let blocks: Vec<[u32; 4]> =
        (0..40).map(|n| [n % 8 * 8, n / 8 * 8, n % 8 * 8 + 8, n / 8 * 8 + 8]).collect();
    let answers = block_on(join_all(
        blocks.iter().map(|&block| models.detector.detect(frame_with_block(64, 64, block))),
    ));
    for (block, answer) in blocks.iter().zip(answers) {
        let found = answer.expect("detections");
        assert_eq!(found.len(), 1);
        assert!((found[0].bbox.x - f64::from(block[0])).abs() < 1e-3, "{block:?}: {found:?}");
        assert!((found[0].bbox.y - f64::from(block[1])).abs() < 1e-3, "{block:?}: {found:?}");
    }
}

#[test]
fn appearance_is_that_of_the_box() {
    let Some((_folder, settings)) = small() else { return };
    let models = load(&settings);
    let embedder = models.embedder.expect("an embedder");
    assert_eq!(embedder.width(), 3);
    let frame = frame_with_block(64, 64, [16, 16, 48, 48]);
    let boxes = vec![
        BBox::new(16.0, 16.0, 32.0, 32.0),
        BBox::new(100.0, 0.0, 20.0, 20.0),  // outside
        BBox::new(16.0, -50.0, 32.0, 52.0), // shows 2 rows
        BBox::new(f64::NAN, 0.0, 1.0, 1.0),
        BBox::new(20.0, 20.0, 500.0, 500.0), // reaches out
        BBox::new(18.0, 18.0, 20.0, 24.0),
    ];
    let found = embedder.embed_blocking(frame, boxes).expect("embeddings");
    assert_eq!(
        found.iter().map(Option::is_some).collect::<Vec<_>>(),
        [true, false, false, false, true, true]
    );
    // Blue, green, red of Y 226, U 0, V 148: 0, 255 (226 + 44 - 14), 254.
    let block = found[0].as_ref().expect("the block");
    let expected = [0.0, 255f32, 254.0].map(|v| v / (255f32.powi(2) + 254f32.powi(2)).sqrt());
    for (value, expected) in block.as_slice().iter().zip(expected) {
        assert!((value - expected).abs() < 0.01, "{block:?}");
    }
    assert!(block.cosine(found[5].as_ref().expect("its middle")) > 0.9999);
}

#[test]
fn an_appearance_network_counts_though_nobody_calibrated_it() {
    let Some((folder, settings)) = small() else { return };
    let weight = |settings: &ModelSettings| {
        let models = load(settings);
        let appearance = models.calibrate(TrackerConfig::default()).appearance;
        models.shutdown();
        (appearance.weight, appearance.pivot)
    };
    let deep = AppearanceConfig::deep();
    assert_eq!(weight(&settings), (deep.weight, deep.pivot));
    assert_eq!(weight(&ModelSettings { reid: "none".into(), ..settings.clone() }).0, 0.0);
    let file = folder.path().join("manifest.toml");
    let text = fs::read_to_string(&file).expect("the manifest");
    let width = "            width = 3\n";
    assert!(text.contains(width));
    let calibrated = text.replace(width, "width = 3\n[model.output.tracking]\nappearance_weight = 3.5\n");
    fs::write(&file, calibrated).expect("written");
    assert_eq!(weight(&settings), (3.5, deep.pivot), "its own word counts");
}

#[test]
fn colour_stripes_tell_colours_and_places_apart() {
    let Some((_folder, settings)) = small() else { return };
    let models = load(&ModelSettings { reid: "builtin".into(), ..settings });
    let embedder = models.embedder.expect("an embedder");
    let frame = |block| frame_with_block(200, 100, block);
    let embed = |image: Image, bbox: BBox| {
        let found = embedder.embed_blocking(image, vec![bbox]).expect("embeddings");
        found.into_iter().next().flatten().expect("an embedding")
    };
    let whole = BBox::new(20.0, 10.0, 30.0, 80.0);
    let upper = embed(frame([20, 10, 50, 50]), whole);
    let lower = embed(frame([20, 50, 50, 90]), whole);
    let moved = embed(frame([120, 20, 150, 60]), whole.shifted(100.0, 10.0));
    assert_eq!(upper.as_slice().len(), embedder.width());
    assert!(upper.cosine(&moved) > 0.999, "{}", upper.cosine(&moved));
    assert!(upper.cosine(&lower) < 0.5, "{}", upper.cosine(&lower));
}

fn link_request() -> LinkRequest {
    let pattern = |n: usize| (0..n).map(|i| (i % 7) as f32 / 10.0 - 0.3).collect();
    LinkRequest {
        features: Features::Relative,
        histories: pattern(2 * HISTORY * relative::STEP),
        lengths: vec![6, 2],
        candidates: pattern(3 * relative::CANDIDATE),
        pairs: [1, 0, 1].map(|track| Pair { track, detection: 0 }).to_vec(),
    }
}

#[test]
fn link_probabilities_are_the_graphs() {
    let Some((_folder, settings)) = small() else { return };
    let linker = load(&settings).linker.expect("a linker");
    let found = linker.score_blocking(link_request()).expect("probabilities");
    // What fixtures/infer/make.py prints.
    for (value, expected) in found.iter().zip([0.29341114, 0.31328583, 0.5093722]) {
        assert!((value - expected).abs() < 1e-5, "{found:?}");
    }
    assert_eq!(found.len(), 3);
    assert!(linker.score_blocking(LinkRequest::default()).expect("nothing").is_empty());
}

#[test]
fn link_requests_that_do_not_fit_are_refused() {
    let Some((_folder, settings)) = small() else { return };
    let linker = load(&settings).linker.expect("a linker");
    type Edit = fn(&mut LinkRequest);
    let cases: [(Edit, &str); 5] = [
        (|r| r.pairs[0].track = 2, "a pair of track 2 among 2 tracks"),
        (|r| r.lengths[1] = 7, "a history of 7 observations"),
        (|r| r.lengths[0] = 0, "a history of 0 observations"),
        (|r| r.histories.truncate(167), "167 history values for 2 tracks"),
        (|r| r.candidates.truncate(59), "59 candidate values for 3 pairs"),
    ];
    for (edit, message) in cases {
        let mut request = link_request();
        edit(&mut request);
        let error = linker.score_blocking(request).expect_err(message);
        assert!(matches!(error, InferError::Request { .. }));
        assert!(error.to_string().contains(message), "{message:?} is not in {error}");
    }
    // The worker still answers.
    assert_eq!(linker.score_blocking(link_request()).expect("probabilities").len(), 3);
}

#[test]
fn models_alone_runs_every_frame() {
    let Some((_folder, settings)) = small() else { return };
    let work = FrameWork {
        image: frame_with_block(64, 64, [0, 0, 8, 8]),
        boxes: vec![BBox::new(0.0, 0.0, 20.0, 40.0), BBox::new(-50.0, 0.0, 20.0, 40.0)],
        link: link_request(),
    };
    let report = models_alone(&settings, &[work], 7).expect("a report");
    assert_eq!((report.frames, report.threads, report.batch), (7, 2, 1));
    assert!(report.frames_per_second() > 0.0);
    assert!(report.detect + report.reid + report.link <= 2 * report.wall);
    let nothing = models_alone(&settings, &[], 7).expect_err("no frames").to_string();
    assert!(nothing.contains("no frames"), "{nothing}");
}

/// The real detector on the demo footage: people where people are, and nowhere else.
#[test]
fn people_are_found_in_real_frames() {
    let Some(folder) = models() else { return };
    let video = folder.join("cache/vtest.avi");
    if !video.exists() {
        return eprintln!("SKIPPED: no {}: run `bash deploy/setup.sh models`", video.display());
    }
    let Some(frames) = decode(&video, 768, 576) else { return };
    let models = load(&settings(&folder));
    // Drawn by eye.
    let crossing = vec![[501, 158, 28, 74], [253, 221, 30, 86], [641, 241, 43, 80]];
    let square = vec![
        [187, 158, 31, 76],
        [244, 158, 28, 64],
        [297, 158, 25, 72],
        [314, 210, 30, 86],
        [582, 158, 28, 78],
        [621, 161, 23, 74],
    ];
    for (frame, people) in [(0, crossing), (300, square)] {
        let found = models.detector.detect_blocking(frames[frame].clone()).expect("detections");
        let boxes: Vec<BBox> = people
            .iter()
            .map(|&[x, y, w, h]: &[i32; 4]| BBox::new(x.into(), y.into(), w.into(), h.into()))
            .collect();
        for person in &boxes {
            assert!(found.iter().any(|d| d.bbox.iou(person) > 0.5), "{person:?} is not in {found:#?}");
        }
        assert_eq!(found.len(), boxes.len(), "frame {frame}: {found:#?}");
        assert!(found.windows(2).all(|pair| pair[0].score >= pair[1].score));
    }
}

/// What a user gets without a single setting.
#[test]
fn the_default_models_answer() {
    let Some(folder) = models() else { return };
    if !fs::read_to_string(folder.join("manifest.toml")).expect("the manifest").contains("\"gakp-gru\"") {
        return eprintln!("SKIPPED: the manifest has no entry for gakp-gru");
    }
    let settings =
        ModelSettings { manifest: folder, provider: ProviderChoice::Cpu, ..ModelSettings::default() };
    let models = load(&settings);
    let report = &models.report;
    assert_eq!(report.provider, "cpu");
    let names: Vec<&str> = report.models.iter().map(|(_, name, _)| name.as_str()).collect();
    assert_eq!(names, ["nanodet-g-int8", "builtin", "gakp-gru"]);
    let frame = frame_with_block(640, 480, [100, 100, 200, 300]);
    assert!(models.detector.detect_blocking(frame.clone()).expect("detections").is_empty());
    let embedder = models.embedder.as_ref().expect("an embedder");
    let boxes = vec![BBox::new(100.0, 100.0, 100.0, 200.0)];
    assert!(embedder.embed_blocking(frame, boxes).expect("an embedding")[0].is_some());
    let linker = models.linker.as_ref().expect("a linker");
    let alone = linker.score_blocking(link_request()).expect("probabilities");
    assert_eq!(alone.len(), 3);
    // Requests of several cameras at once are answered as each alone.
    let together = block_on(join_all((0..8).map(|_| linker.score(link_request()))));
    for answer in together {
        assert_eq!(answer.expect("probabilities"), alone);
    }
    models.shutdown();
    assert!(matches!(linker.score_blocking(link_request()), Err(InferError::Stopped { model: "link" })));
}
