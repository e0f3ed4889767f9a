//! Pictures of a camera: a snapshot, MJPEG for anything that shows it, a WebSocket for the page.

use std::sync::Arc;

use axum::body::Bytes;
use axum::extract::ws::{Message, close_code};
use axum::extract::{Query, State};
use axum::http::header;
use axum::response::{IntoResponse, Response};
use tokio::sync::watch::Receiver;

use super::ApiState;
use super::drip::{self, Parts};
use super::extract::{Path, camera_id};
use super::problem::Problem;
use super::socket::{Opening, Outgoing, Ticket};
use super::video::{Shot, View};
use crate::publish::encode_json;

type Shots = Receiver<Option<Arc<Shot>>>;

/// `GET /v1/cameras/{id}/snapshot.jpg`: the newest tracked picture; `?annotate=false` without boxes.
pub(super) async fn snapshot(
    State(state): State<ApiState>,
    Path(name): Path<String>,
    Query(query): Query<Vec<(String, String)>>,
) -> Result<Response, Problem> {
    let view = view(&query)?;
    let video = state.cameras.video(&camera_id(&name)?).ok_or_else(|| Problem::unknown_camera(&name))?;
    let picture = video.borrow().clone().ok_or_else(|| {
        Problem::unavailable(format!("camera {name} has no picture yet; GET /v1/cameras/{name} says why"))
    })?;
    let shot = state.studio.snapshot(picture, view).await.map_err(|e| Problem::internal(e.to_string()))?;
    let headers = [(header::CONTENT_TYPE, "image/jpeg"), (header::CACHE_CONTROL, "no-store")];
    Ok((headers, shot.jpeg).into_response())
}

/// `?annotate=true|false`, true by default.
fn view(query: &[(String, String)]) -> Result<View, Problem> {
    let mut view = View::Annotated;
    for (key, value) in query {
        view = match (key.as_str(), value.as_str()) {
            ("annotate", "true") => View::Annotated,
            ("annotate", "false") => View::Plain,
            ("annotate", _) => {
                return Err(Problem::bad_request(format!("annotate={value:?} is neither true nor false")));
            }
            _ => return Err(Problem::bad_request(format!("unknown parameter {key:?}; there is `annotate`"))),
        };
    }
    Ok(view)
}

/// Separates the parts of an MJPEG stream.
const BOUNDARY: &str = "gakp-frame";

/// `GET /v1/cameras/{id}/stream.mjpeg`: pictures one after the other until the client goes, the
/// camera is removed or the service stops; `?annotate=false` without boxes.
pub(super) async fn mjpeg(
    State(state): State<ApiState>,
    Path(name): Path<String>,
    Query(query): Query<Vec<(String, String)>>,
    ticket: Ticket,
) -> Result<Response, Problem> {
    let shots = watch(&state, &name, view(&query)?)?;
    let headers = [
        (header::CONTENT_TYPE, format!("multipart/x-mixed-replace; boundary={BOUNDARY}")),
        (header::CACHE_CONTROL, "no-store".to_owned()),
    ];
    Ok((headers, drip::body(Film(shots), ticket)).into_response())
}

/// The parts of an MJPEG stream.
struct Film(Shots);

impl Parts for Film {
    async fn next(&mut self) -> Option<Bytes> {
        Some(part(&*newest(&mut self.0).await?))
    }
}

fn part(shot: &Shot) -> Bytes {
    let head = format!(
        "--{BOUNDARY}\r\nContent-Type: image/jpeg\r\nContent-Length: {}\r\nX-Gakp-Epoch: {}\r\nX-Gakp-Seq: {}\r\n\r\n",
        shot.jpeg.len(),
        shot.tracks.epoch.0,
        shot.tracks.seq,
    );
    [head.as_bytes(), &shot.jpeg, b"\r\n"].concat().into()
}

/// The next picture that was not seen yet; `None` when the camera is gone. Cancel safe.
async fn newest(shots: &mut Shots) -> Option<Arc<Shot>> {
    loop {
        shots.changed().await.ok()?;
        if let Some(shot) = shots.borrow_and_update().clone() {
            return Some(shot);
        }
    }
}

/// `GET /v1/cameras/{id}/live`: a WebSocket of binary messages, each a picture without boxes and the
/// tracks of that very frame: 4 bytes (big-endian) length of the JSON, the JSON message as on
/// `/v1/tracks`, the JPEG.
pub(super) async fn live(
    State(state): State<ApiState>,
    Path(name): Path<String>,
    opening: Opening,
) -> Result<Response, Problem> {
    let shots = watch(&state, &name, View::Plain)?;
    Ok(opening.run(PictureStream { shots, classes: state.hub.classes().clone() }))
}

fn watch(state: &ApiState, name: &str, view: View) -> Result<Shots, Problem> {
    let shots = state.studio.watch(&*state.cameras, &camera_id(name)?, view);
    shots.ok_or_else(|| Problem::unknown_camera(name))
}

struct PictureStream {
    shots: Shots,
    classes: Arc<[String]>,
}

impl Outgoing for PictureStream {
    async fn next(&mut self) -> Option<Message> {
        let shot = newest(&mut self.shots).await?;
        let json = encode_json(&shot.tracks, &self.classes);
        // A report's JSON has some 200 bytes a track: far below 4 GiB.
        let length = u32::try_from(json.len()).ok()?.to_be_bytes();
        Some(Message::Binary([&length[..], &json, &shot.jpeg].concat().into()))
    }

    fn farewell(&self) -> (u16, &'static str) {
        (close_code::NORMAL, "the camera was removed")
    }
}
