//! The page in a real browser, on a real camera.

use std::path::Path;

use serde_json::{Value, json};

use super::cdp::Browser;
use super::support::*;

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn boxes_move_on_the_page() {
    let Some(clip) = clip() else { return };
    let Some(mut browser) = Browser::start().await else { return };
    let camera = CameraProcess::start(&clip, &[]);
    let state = tempfile::tempdir().unwrap();
    let service = Service::start(state.path(), &["--camera", &format!("demo={}", camera.url)]);
    let page = browser.open(&format!("http://{}/", service.address)).await;

    let card = "document.querySelector('[data-camera=\"demo\"]')";
    browser.wait_for(&page, "confirmed tracks", &format!("{card}.dataset.confirmed >= 2")).await;
    // One moment: a copy of the pixels is kept in the page, the boxes by id are what it tells.
    let look = format!(
        "(() => {{
            const card = {card}, canvas = card.querySelector('canvas');
            window.before = window.now;
            window.now = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data;
            const boxes = [...card.querySelectorAll('[data-state=\"confirmed\"]')].map(e => [e.dataset.track, e.dataset.box]);
            return [Number(card.dataset.seq), Object.fromEntries(boxes)];
        }})()"
    );
    let (first_seq, first) = moment(browser.eval(&page, &look).await);
    browser.wait_for(&page, "five more pictures", &format!("{card}.dataset.seq >= {}", first_seq + 5)).await;
    let (seq, later) = moment(browser.eval(&page, &look).await);
    assert!(seq >= first_seq + 5);
    let both: Vec<_> = first.keys().filter(|id| later.contains_key(*id)).collect();
    assert!(!both.is_empty(), "no id stayed: {first:?} then {later:?}");
    assert!(both.iter().any(|id| first[*id] != later[*id]), "no box moved: {first:?} then {later:?}");

    let changed = "window.now.reduce((n, v, i) => n + (Math.abs(v - window.before[i]) > 40), 0)";
    let changed = browser.eval(&page, changed).await.as_u64().unwrap();
    assert!(changed > 500, "only {changed} values of the picture changed");
    let state = browser.eval(&page, &format!("{card}.querySelector('.state').textContent")).await;
    assert_eq!(state, json!("live"));

    let png = browser.screenshot(&page).await;
    assert!(png.starts_with(b"\x89PNG"));
    let path = Path::new(env!("CARGO_TARGET_TMPDIR")).join("service-page.png");
    std::fs::write(&path, png).unwrap();
    eprintln!("a picture of the page: {}", path.display());
    assert_eq!(browser.take_errors(), Vec::<String>::new());
    drop(browser);
    service.stop();
}

fn moment(value: Value) -> (u64, serde_json::Map<String, Value>) {
    serde_json::from_value(value).expect("what the page shows")
}
