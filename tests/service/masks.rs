//! Masks of a running service: nobody sees what is under them, whichever way a picture leaves.

use serde_json::json;
use zune_jpeg::JpegDecoder;
use zune_jpeg::zune_core::bytestream::ZCursor;

use super::support::*;

/// The mean brightness of the left and of the right half of a JPEG.
fn halves(jpeg: &[u8]) -> [f64; 2] {
    let mut decoder = JpegDecoder::new(ZCursor::new(jpeg));
    let rgb = decoder.decode().expect("a JPEG");
    let (width, _) = decoder.dimensions().unwrap();
    // A little apart: JPEG's blocks bleed.
    [0..width / 2 - 16, width / 2 + 16..width].map(|columns| {
        let rows = rgb.chunks_exact(width * 3);
        let values = rows.flat_map(|row| &row[columns.start * 3..columns.end * 3]).map(|v| u64::from(*v));
        values.sum::<u64>() as f64 / (columns.len() * 3 * (rgb.len() / width / 3)) as f64
    })
}

const DARK: f64 = 2.0;
const BRIGHT: f64 = 40.0;

impl Service {
    fn seen(&self, path: &str) -> [f64; 2] {
        let picture = self.get(path);
        assert_eq!(picture.status, 200, "{}", picture.body);
        halves(&picture.bytes)
    }

    /// A picture of the camera's own WebSocket: a JSON head of so many bytes, then the JPEG.
    fn seen_live(&self) -> [f64; 2] {
        let message = self.socket("/v1/cameras/demo/live").binary();
        let head = u32::from_be_bytes(message[..4].try_into().unwrap()) as usize;
        halves(&message[4 + head..])
    }
}

#[test]
fn what_is_masked_leaves_in_no_picture() {
    let Some(film) = film() else { return };
    let folder = tempfile::tempdir().unwrap();
    let config = folder.path().join("gakp.toml");
    let text = format!(
        "[history]\nsnapshots = true\n[[camera]]\nid = \"demo\"\nurl = \"{}\"\nloop = true\n\
         [[camera.masks]]\nid = \"all\"\npoints = [[0, 0], [1, 0], [1, 1], [0, 1]]\n",
        film.display()
    );
    std::fs::write(&config, text).unwrap();
    let state = folder.path().join("state");
    let start = || Service::start(&state, &["--config", config.to_str().unwrap()]);
    let service = start();
    service.wait_for_frames("demo", 5);
    let plain = "/v1/cameras/demo/snapshot.jpg?annotate=false";
    assert!(service.seen(plain).iter().all(|v| *v < DARK), "{:?}", service.seen(plain));
    // Who is hidden is tracked all the same, and kept without a face.
    let kept = eventually("a kept picture", || {
        let tracks = service.get("/v1/history/tracks?limit=1000").json();
        let tracks = tracks["tracks"].as_array().unwrap();
        tracks.iter().find_map(|track| track["snapshot"].as_str().map(str::to_owned))
    });
    let picture = service.get(&kept);
    let mut decoder = JpegDecoder::new(ZCursor::new(&picture.bytes));
    assert!(decoder.decode().unwrap().iter().all(|v| *v < 8), "a kept picture shows somebody");

    // Moved while it runs: the next picture shows it.
    let left = json!({"id": "left", "points": [[0, 0], [0.5, 0], [0.5, 1], [0, 1]], "style": "fill"});
    assert_eq!(service.post("/v1/cameras/demo/masks", &left).status, 201);
    assert_eq!(service.delete("/v1/cameras/demo/masks/all").status, 204);
    for [hidden, shown] in [service.seen(plain), service.seen_live()] {
        assert!(hidden < DARK && shown > BRIGHT, "{hidden} {shown}");
    }
    let before = service.seen(plain)[1];
    let blocks = json!({"id": "left", "points": left["points"], "style": "pixelate"}).to_string();
    assert_eq!(service.request("PUT", "/v1/cameras/demo/masks/left", Some(&blocks)).status, 200);
    let [hidden, shown] = service.seen(plain);
    assert!(hidden > BRIGHT && (shown / before - 1.0).abs() < 0.1, "as bright as it is: {hidden} {shown}");
    assert_eq!(service.get("/v1/cameras/demo/masks").json()["masks"][0]["style"], "pixelate");
    let fill = left.to_string();
    assert_eq!(service.request("PUT", "/v1/cameras/demo/masks/left", Some(&fill)).status, 200);
    service.stop();

    // What was changed is remembered.
    let service = start();
    service.wait_for_frames("demo", 5);
    let [hidden, shown] = service.seen(plain);
    assert!(hidden < DARK && shown > BRIGHT, "{hidden} {shown}");
    service.stop();

    // What is remembered and cannot be used hides everything, not nothing.
    let remembered = state.join("cameras.json");
    let text = std::fs::read_to_string(&remembered).unwrap();
    let broken = text.replace("\"left\"", "\"a b\"");
    assert_ne!(text, broken);
    std::fs::write(&remembered, broken).unwrap();
    let service = start();
    service.wait_for_frames("demo", 5);
    assert!(service.seen(plain).iter().all(|v| *v < DARK), "{:?}", service.seen(plain));
    let masks = service.get("/v1/cameras/demo/masks").json();
    assert_eq!(masks["masks"].as_array().unwrap().len(), 1, "{masks}");
    assert_eq!(service.delete("/v1/cameras/demo/masks/unknown").status, 204);
    assert!(service.seen(plain).iter().all(|v| *v > BRIGHT), "{:?}", service.seen(plain));
    let log = service.stop();
    assert!(log.contains("its whole picture is hidden"), "{log}");
}
