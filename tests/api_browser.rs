//! The page in a real browser: boxes move in step with the picture, cameras come and go.
#![cfg(feature = "service")]

#[path = "browser/cdp.rs"]
mod cdp;
#[path = "api/support.rs"]
mod support;

use std::sync::Arc;
use std::time::Duration;

use cdp::{Browser, Page};
use gakp::api::KeepAlive;
use gakp::auth::{Gate, Role, TokenFile};
use gakp::publish::{HubConfig, colour};
use gakp::types::{BBox, TrackId};
use serde_json::json;
use support::*;
use tokio::task::JoinHandle;

const SIZE: (u32, u32) = (640, 480);

/// Where the made-up person is at report `seq`: it walks to the right, and again.
fn place(seq: u64) -> BBox {
    BBox::new(20.0 + (seq * 4 % 500) as f64, 120.0, 80.0, 200.0)
}

/// Shows 25 pictures a second until the camera is removed.
fn film(cameras: Arc<FakeCameras>, name: &'static str) -> JoinHandle<()> {
    tokio::spawn(async move {
        for seq in 0.. {
            if !cameras.show(picture(tracks(name, 1, seq, SIZE, place(seq)))) {
                return;
            }
            tokio::time::sleep(Duration::from_millis(40)).await;
        }
    })
}

fn card(name: &str) -> String {
    format!("document.querySelector('[data-camera=\"{name}\"]')")
}

/// In one moment of the page: `seq` shown, the listed box, and the canvas's pixels on the middle of
/// the box's left edge, inside of the box, and left of it.
async fn look(browser: &mut Browser, page: &Page) -> (u64, [f64; 4], [[u8; 3]; 3]) {
    let script = format!(
        "(() => {{
            const card = {}, canvas = card.querySelector('canvas');
            const box = card.querySelector('[data-track=\"7\"]').dataset.box.split(' ').map(Number);
            const context = canvas.getContext('2d');
            const at = (x, y) => [...context.getImageData(x, y, 1, 1).data].slice(0, 3);
            const [x, y, w, h] = box;
            return [Number(card.dataset.seq), box, [at(x, y + 30), at(x + w / 2, y + h / 2), at(x - 12, y + 30)]];
        }})()",
        card("gate")
    );
    let value = browser.eval(page, &script).await;
    serde_json::from_value(value).expect("what the page shows")
}

fn near(a: [u8; 3], b: [u8; 3]) -> bool {
    a.iter().zip(b).all(|(a, b)| a.abs_diff(b) < 50)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn boxes_move_in_step_with_the_picture() {
    let Some(mut browser) = Browser::start().await else { return };
    let server = Server::start().await;
    server.cameras.put("gate", "rtsp://host/gate");
    let filming = film(server.cameras.clone(), "gate");
    let page = browser.open(&format!("http://{}/", server.addr)).await;

    let gate = card("gate");
    browser.wait_for(&page, "ten pictures", &format!("{gate}.dataset.pictures >= 10")).await;
    assert_eq!(browser.eval(&page, &format!("{gate}.dataset.tracks")).await, json!("1"));
    let label =
        browser.eval(&page, &format!("{gate}.querySelector('canvas').getAttribute('aria-label')")).await;
    assert_eq!(label, json!("Camera gate: 1 confirmed tracks"));

    let mut seen = Vec::new();
    while seen.len() < 5 {
        let (seq, listed, [edge, inside, beside]) = look(&mut browser, &page).await;
        let b = place(seq);
        assert_eq!(listed, [b.x, b.y, b.w, b.h], "the list is of the picture with seq {seq}");
        // The white person of the picture itself is where the box is, so picture and box are of one frame.
        assert!(near(edge, colour(TrackId(7))), "the box's edge at seq {seq}: {edge:?}");
        assert!(near(inside, [255; 3]), "inside of the box at seq {seq}: {inside:?}");
        assert!(near(beside, [51; 3]), "beside the box at seq {seq}: {beside:?}");
        if seen.last() != Some(&seq) {
            seen.push(seq);
        }
        tokio::time::sleep(Duration::from_millis(100)).await;
    }
    assert!(seen.is_sorted(), "{seen:?}");
    keep("page.png", &browser.screenshot(&page).await);
    browser.emulate(&page, (390, 844), true).await;
    let wide = browser.eval(&page, "document.documentElement.scrollWidth <= 390").await;
    assert_eq!(wide, json!(true), "a phone scrolls only down");
    keep("page-phone-dark.png", &browser.screenshot(&page).await);
    assert_eq!(browser.take_errors(), Vec::<String>::new());
    filming.abort();
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn cameras_are_added_shown_as_text_and_deleted() {
    let Some(mut browser) = Browser::start().await else { return };
    let server = Server::start().await;
    let page = browser.open(&format!("http://{}/", server.addr)).await;
    browser.wait_for(&page, "the hint", "!document.querySelector('#none').hidden").await;

    let fill = |id: &str, url: &str| {
        format!(
            "(() => {{ const f = document.querySelector('#add'); f.elements.id.value = {}; f.elements.url.value = {};
             f.requestSubmit(); return true; }})()",
            json!(id),
            json!(url)
        )
    };
    let markup = "rtsp://host/<img src=x onerror=document.title='owned'>";
    browser.eval(&page, &fill("gate", markup)).await;
    let gate = card("gate");
    let url =
        browser.wait_for(&page, "the camera", &format!("{gate}.querySelector('.url').textContent")).await;
    assert_eq!(url, json!(markup));
    assert_eq!(browser.eval(&page, &format!("{gate}.querySelectorAll('img').length")).await, json!(0));
    assert_eq!(browser.eval(&page, "document.title").await, json!("gakp: cameras and tracks"));

    server.cameras.change("gate", |camera| {
        camera.state = gakp::api::CameraState::Retrying;
        camera.last_error = Some("the camera refuses: <b>401</b>".to_owned());
        camera.next_retry_s = Some(3.2);
    });
    let error = format!("{gate}.querySelector('.error').textContent");
    assert_eq!(browser.wait_for(&page, "the error", &error).await, json!("the camera refuses: <b>401</b>"));
    let state = browser.eval(&page, &format!("{gate}.querySelector('.state').textContent")).await;
    assert_eq!(state, json!("retrying in 4 s"));

    assert_eq!(browser.take_errors(), Vec::<String>::new());
    browser.eval(&page, &fill("gate", "rtsp://host/other")).await;
    let refused = "document.querySelector('#add-result.bad').textContent";
    let refused = browser.wait_for(&page, "the refusal", refused).await;
    assert!(refused.as_str().unwrap().contains("exists"), "{refused}");

    let click = format!("{gate}.querySelector('.delete').click() ?? true");
    browser.eval(&page, &click).await;
    let asked = browser.eval(&page, &format!("{gate}.querySelector('.delete').textContent")).await;
    assert_eq!(asked, json!("Really delete?"));
    assert_eq!(server.get("/v1/cameras/gate").await.status, 200, "one click only asks");
    browser.eval(&page, &click).await;
    browser.wait_for(&page, "the camera to go", &format!("{gate} === null")).await;
    assert_eq!(server.get("/v1/cameras/gate").await.status, 404);
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_page_comes_back_with_the_service() {
    let Some(mut browser) = Browser::start().await else { return };
    let server = Server::start().await;
    let (addr, cameras) = (server.addr, server.cameras.clone());
    cameras.put("gate", "rtsp://host/gate");
    let filming = film(cameras.clone(), "gate");
    let page = browser.open(&format!("http://{addr}/")).await;
    let gate = card("gate");
    browser.wait_for(&page, "a picture", &format!("{gate}.dataset.pictures > 0")).await;
    server.stop().await;
    browser.wait_for(&page, "the warning", "!document.querySelector('#offline').hidden").await;
    let before = browser.eval(&page, &format!("Number({gate}.dataset.seq)")).await.as_u64().unwrap();
    let server = Server::start_on(addr, cameras, HubConfig::default(), KeepAlive::default()).await;
    let later = format!("{gate}.dataset.seq > {} && document.querySelector('#offline').hidden", before + 5);
    browser.wait_for(&page, "pictures again", &later).await;
    filming.abort();
    server.stop().await;
}

/// Without a token nothing is shown; with a viewer's what a viewer may see, and nothing to change.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_page_asks_for_a_token() {
    let Some(mut browser) = Browser::start().await else { return };
    let folder = tempfile::tempdir().unwrap();
    let file = TokenFile::path(folder.path());
    let mut tokens = TokenFile::default();
    let [wall, desk] = [("wall", true), ("desk", false)]
        .map(|(name, video)| tokens.create(name, Role::Viewer, video).unwrap().reveal().to_owned());
    tokens.write(&file).unwrap();
    let server = Server::start_behind(Gate::new(file.clone(), true).unwrap(), None).await;
    server.cameras.put("gate", "rtsp://host/gate");
    let filming = film(server.cameras.clone(), "gate");
    let page = browser.open(&format!("http://{}/", server.addr)).await;
    browser.wait_for(&page, "the form", "!document.querySelector('#login').hidden").await;
    assert_eq!(browser.eval(&page, "document.querySelector('#main').hidden").await, json!(true));
    let sign_in = |token: &str| {
        format!(
            "(() => {{ const f = document.querySelector('#login'); f.elements.token.value = {}; f.requestSubmit();
             return true; }})()",
            json!(token)
        )
    };
    browser.eval(&page, &sign_in("gakp_wrong")).await;
    let refused =
        browser.wait_for(&page, "the refusal", "document.querySelector('#login-result').textContent").await;
    assert!(refused.as_str().unwrap().contains("not known"), "{refused}");

    browser.eval(&page, &sign_in(&desk)).await;
    let gate = card("gate");
    let note = format!("{gate}?.querySelector('.note').textContent");
    let note = browser.wait_for(&page, "the camera's note", &note).await;
    assert_eq!(note, json!("Your token may not see pictures."));
    browser.eval(&page, "document.querySelector('#sign-out').click() ?? true").await;
    browser.wait_for(&page, "the form again", "!document.querySelector('#login').hidden").await;

    browser.eval(&page, &sign_in(&wall)).await;
    browser.wait_for(&page, "a picture", &format!("{gate}?.dataset.pictures > 0")).await;
    assert_eq!(
        browser.eval(&page, "document.querySelector('#who span').textContent").await,
        json!("wall (viewer)")
    );
    for hidden in [
        "document.querySelector('.add').hidden".to_owned(),
        format!("{gate}.querySelector('.delete').hidden"),
    ] {
        assert_eq!(browser.eval(&page, &hidden).await, json!(true), "{hidden}");
    }
    // The cookie is out of the reach of scripts.
    assert_eq!(browser.eval(&page, "document.cookie").await, json!(""));
    tokens.revoke("wall").unwrap();
    tokens.write(&file).unwrap();
    browser
        .wait_for(&page, "the form after the token's end", "!document.querySelector('#login').hidden")
        .await;
    filming.abort();
    server.stop().await;
}

/// Leaves a picture for people to look at.
fn keep(name: &str, png: &[u8]) {
    assert!(png.starts_with(b"\x89PNG"), "a PNG");
    let path = std::path::Path::new(env!("CARGO_TARGET_TMPDIR")).join(name);
    std::fs::write(&path, png).unwrap();
    eprintln!("a picture of the page: {}", path.display());
}
