//! The page in a real browser, on pictures whose every pixel is known: `web/tests/live.spec.ts` and `token.spec.ts`.
#![cfg(feature = "service")]

#[path = "browser/playwright.rs"]
mod playwright;
#[path = "api/support.rs"]
mod support;

use gakp::api::CameraState;
use gakp::auth::{Gate, Role, TokenFile};
use gakp::types::BBox;
use serde_json::json;
use support::*;
use tokio::task::{JoinHandle, spawn_blocking};

const SIZE: (u32, u32) = (640, 480);

/// Where the made-up person is at report `seq`: it walks to the right, and again. `live.spec.ts` knows it too.
fn place(seq: u64) -> BBox {
    BBox::new(20.0 + (seq * 4 % 500) as f64, 120.0, 80.0, 200.0)
}

/// Shows 25 pictures a second until the camera is removed.
fn film(server: &Server, name: &'static str) -> JoinHandle<()> {
    let (cameras, hub) = (server.cameras.clone(), server.hub.clone());
    tokio::spawn(async move {
        for seq in 0.. {
            let picture = picture(tracks(name, 1, seq, SIZE, place(seq)));
            hub.publish(picture.tracks.clone());
            if !cameras.show(picture) {
                return;
            }
            tokio::time::sleep(std::time::Duration::from_millis(40)).await;
        }
    })
}

/// Runs a file of tests while the server goes on.
async fn look(file: &'static str, server: &Server, settings: Vec<(&'static str, String)>) {
    let url = format!("http://{}", server.addr);
    let run = spawn_blocking(move || {
        let settings: Vec<(&str, &str)> =
            settings.iter().map(|(name, value)| (*name, value.as_str())).collect();
        playwright::run(file, &url, &settings);
    });
    run.await.expect("the page's tests pass");
}

/// Boxes in step with the picture; text, never markup; nobody else's pages; a connection that breaks and comes back.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_page_shows_what_is_there() {
    if !playwright::ready() {
        return;
    }
    let server = Server::start().await;
    server.cameras.put("gate", "rtsp://host/gate");
    server.cameras.put("odd", "rtsp://host/<img src=x onerror=document.title='owned'>");
    server.cameras.change("odd", |camera| {
        camera.state = CameraState::Retrying;
        camera.last_error =
            Some("the camera refuses: <b>401</b><img src=x onerror=document.title='owned'>".to_owned());
        camera.next_retry_s = Some(3.2);
    });
    let filming = film(&server, "gate");
    look("live", &server, vec![]).await;
    filming.abort();
    server.stop().await;
}

/// Without a token nothing is shown; with one what its role may see, and nothing more to change.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_page_asks_for_a_token() {
    if !playwright::ready() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let file = TokenFile::path(folder.path());
    let mut tokens = TokenFile::default();
    let bearers = [
        ("GAKP_PLAIN", "plain", Role::Viewer, false),
        ("GAKP_WALL", "wall", Role::Viewer, true),
        ("GAKP_DESK", "desk", Role::Operator, true),
    ];
    let mut settings: Vec<(&str, String)> = bearers
        .into_iter()
        .map(|(setting, name, role, video)| {
            (setting, tokens.create(name, role, video).unwrap().reveal().to_owned())
        })
        .collect();
    settings.push(("GAKP_BINARY", env!("CARGO_BIN_EXE_gakp").to_owned()));
    settings.push(("GAKP_STATE", folder.path().to_str().unwrap().to_owned()));
    tokens.write(&file).unwrap();
    let server = Server::start_behind(Gate::new(file, true).unwrap(), None).await;
    server.cameras.put("gate", "rtsp://host/gate");
    let desk = format!("Bearer {}", settings[2].1);
    let door = json!({"id": "door", "points": [[0.5, 1.0], [0.5, 0.0]]}).to_string();
    let headers = [("Content-Type", "application/json"), ("Authorization", desk.as_str())];
    let drawn = server.request("POST", "/v1/cameras/gate/lines", &headers, door.as_bytes()).await;
    assert_eq!(drawn.status, 201, "{}", drawn.text());
    let filming = film(&server, "gate");
    look("token", &server, settings).await;
    filming.abort();
    server.stop().await;
}
