//! What the tests of models share: where the models are, pictures, small manifests.
#![allow(dead_code)]

use std::io::Read;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::Arc;

use gakp::infer::{ModelSettings, ProviderChoice};
use gakp::types::{BBox, Image, Plane, YuvMatrix, YuvRange};
use sha2::{Digest, Sha256};

/// The folder with `manifest.toml` and what the set-up put into `cache`; says so where it is missing.
pub fn models() -> Option<PathBuf> {
    let folder = std::env::var_os("GAKP_MODELS")
        .map_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("models"), PathBuf::from);
    let there = folder.join("manifest.toml").exists() && folder.join("cache/libonnxruntime.so").exists();
    if !there {
        eprintln!("SKIPPED: no models in {}: run `bash deploy/setup.sh models`", folder.display());
    }
    there.then_some(folder)
}

/// The folder of shared data (videos and ground truth); says so where it is missing.
pub fn shared() -> Option<PathBuf> {
    let folder = std::env::var_os("GAKP_SHARED")
        .map_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared"), PathBuf::from);
    let there = folder.join("data/video").exists();
    if !there {
        eprintln!("SKIPPED: no data in {}: set GAKP_SHARED", folder.display());
    }
    there.then_some(folder)
}

/// Settings for the CPU that load the detector alone.
pub fn settings(models: &Path) -> ModelSettings {
    ModelSettings {
        manifest: models.into(),
        reid: "none".into(),
        link: "none".into(),
        provider: ProviderChoice::Cpu,
        threads: Some(2),
        ..ModelSettings::default()
    }
}

/// A picture from three planes without padding.
pub fn image(width: u32, height: u32, range: YuvRange, planes: [Vec<u8>; 3]) -> Image {
    let (w, cw) = (width as usize, width.div_ceil(2) as usize);
    let offsets = [0, planes[0].len(), planes[0].len() + planes[1].len()];
    let strides = [w, cw, cw];
    let at = [0, 1, 2].map(|i| Plane { offset: offsets[i], stride: strides[i] });
    Image::i420((width, height), range, YuvMatrix::Bt601, at, Arc::new(planes.concat())).expect("a picture")
}

/// Every frame of a video, decoded by ffmpeg; `None`, loudly, without it.
pub fn decode(video: &Path, width: u32, height: u32) -> Option<Vec<Image>> {
    let child = Command::new("ffmpeg")
        .args(["-v", "error", "-i"])
        .arg(video)
        .args(["-f", "rawvideo", "-pix_fmt", "yuv420p", "-"])
        .stdout(Stdio::piped())
        .spawn();
    let Ok(mut child) = child else {
        eprintln!("SKIPPED: no ffmpeg here");
        return None;
    };
    let mut bytes = vec![];
    child.stdout.take().expect("a pipe").read_to_end(&mut bytes).expect("frames");
    assert!(child.wait().expect("ffmpeg ends").success());
    let (w, h) = (width as usize, height as usize);
    let (luma, chroma) = (w * h, w.div_ceil(2) * h.div_ceil(2));
    let frames: Vec<Image> = bytes
        .chunks_exact(luma + 2 * chroma)
        .map(|frame| {
            let planes = [
                frame[..luma].to_vec(),
                frame[luma..luma + chroma].to_vec(),
                frame[luma + chroma..].to_vec(),
            ];
            image(width, height, YuvRange::Limited, planes)
        })
        .collect();
    assert!(!frames.is_empty());
    Some(frames)
}

/// Ground truth of a MOT15 sequence: for every frame (0-based) its identities and boxes.
pub fn truth(folder: &Path, frames: usize) -> Vec<Vec<(u64, BBox)>> {
    let text = std::fs::read_to_string(folder.join("gt/gt.txt")).expect("ground truth");
    let mut all = vec![vec![]; frames];
    for line in text.lines() {
        let n: Vec<f64> = line.split(',').map(|v| v.trim().parse().expect("a number")).collect();
        let frame = n[0] as usize - 1;
        if n[6] == 1.0 && frame < frames {
            // MOTChallenge counts pixels from 1.
            all[frame].push((n[1] as u64, BBox::new(n[2] - 1.0, n[3] - 1.0, n[4], n[5])));
        }
    }
    all
}

/// The SHA-256 of a file, as a manifest writes it.
pub fn sha256(file: &Path) -> String {
    Sha256::digest(std::fs::read(file).expect("a file")).iter().map(|b| format!("{b:02x}")).collect()
}

/// A small graph of this repository.
pub fn fixture(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/infer").join(name)
}
