//! The camera side as the API sees it: what the pipeline implements and a test can fake.

use std::collections::BTreeMap;
use std::sync::Arc;

use futures::future::BoxFuture;
use jiff::Timestamp;
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use tokio::sync::watch;

use super::object::objects;
use super::rules::{EditError, Findings, LineSpec, MaskSpec, RuleEdit, RulesSpec, ZoneSpec};
use crate::analytics::{Heat, RuleError, Rules};
use crate::publish::Picture;
use crate::types::CameraId;

/// The cameras of the service: listing, adding, removing, and their newest tracked pictures.
pub trait Cameras: Send + Sync + 'static {
    /// All cameras, in the order of their names.
    fn list(&self) -> Vec<CameraStatus>;

    /// One camera; `None` when there is none of that name.
    fn get(&self, id: &CameraId) -> Option<CameraStatus>;

    /// Adds a camera and begins to connect. Returns once it is accepted and remembered, not once it
    /// is live.
    fn add(&self, request: NewCamera) -> BoxFuture<'_, Result<CameraStatus, CameraError>>;

    /// Changes a camera and remembers it. What it is now is stopped first; its counts go on, its track ids
    /// begin anew.
    fn patch(&self, id: &CameraId, patch: CameraPatch) -> BoxFuture<'_, Result<CameraStatus, CameraError>>;

    /// Stops a camera and forgets it. Returns once its threads have ended.
    fn remove(&self, id: &CameraId) -> BoxFuture<'_, Result<(), CameraError>>;

    /// The camera's newest tracked frame with its tracks; `None` inside until the first one. `None`
    /// when there is no such camera. The sender goes when the camera is removed.
    fn video(&self, id: &CameraId) -> Option<watch::Receiver<Option<Arc<Picture>>>>;

    /// The camera's lines, zones and masks; `None` when there is no such camera.
    fn rules(&self, id: &CameraId) -> Option<Rules>;

    /// Changes the camera's lines, zones and masks, and remembers them; gives all of them.
    fn edit_rules(&self, id: &CameraId, edit: RuleEdit) -> BoxFuture<'_, Result<Rules, CameraError>>;

    /// What the lines and zones have counted; `None` when there is no such camera.
    fn findings(&self, id: &CameraId) -> Option<Findings>;

    /// Where people were, and since when that is counted; `None` when there is no such camera.
    fn heat(&self, id: &CameraId) -> Option<(Timestamp, Heat)>;
}

/// The body of `POST /v1/cameras`. Unknown fields are refused.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct NewCamera {
    /// Its name, see [`CameraId`].
    #[serde(serialize_with = "write_id", deserialize_with = "read_id")]
    pub id: CameraId,
    /// Where it is: `rtsp://user:password@host/path`, `file:///...`, `http://...`. May hold a
    /// password: never log it as it is.
    pub url: String,
    /// How RTSP carries media; absent: the source chooses.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub transport: Option<Transport>,
    /// Whether a file begins again at its end.
    #[serde(rename = "loop", default)]
    pub looped: bool,
    /// Known, but not opened.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub paused: bool,
    /// Lines to begin with; those that were changed later are remembered instead.
    #[serde(default, deserialize_with = "objects", skip_serializing_if = "Vec::is_empty")]
    pub lines: Vec<LineSpec>,
    /// Zones to begin with, likewise.
    #[serde(default, deserialize_with = "objects", skip_serializing_if = "Vec::is_empty")]
    pub zones: Vec<ZoneSpec>,
    /// Masks to begin with, likewise.
    #[serde(default, deserialize_with = "objects", skip_serializing_if = "Vec::is_empty")]
    pub masks: Vec<MaskSpec>,
}

impl NewCamera {
    /// Its lines, zones and masks.
    ///
    /// # Errors
    /// One of them cannot be watched.
    pub fn rules(&self) -> Result<Rules, RuleError> {
        let (lines, zones, masks) = (self.lines.clone(), self.zones.clone(), self.masks.clone());
        RulesSpec { lines, zones, masks }.rules()
    }
}

/// The body of `PATCH /v1/cameras/{id}`: what is to change. Unknown fields are refused.
#[derive(Clone, Debug, Default, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CameraPatch {
    /// Another address.
    pub url: Option<String>,
    /// How RTSP carries media; `null`: the source chooses.
    #[serde(default, deserialize_with = "given")]
    pub transport: Option<Option<Transport>>,
    /// Whether a file begins again at its end.
    #[serde(rename = "loop")]
    pub looped: Option<bool>,
    /// Whether it rests.
    pub paused: Option<bool>,
}

impl CameraPatch {
    /// `camera` with the changes.
    pub fn apply(self, camera: &NewCamera) -> NewCamera {
        NewCamera {
            id: camera.id.clone(),
            url: self.url.unwrap_or_else(|| camera.url.clone()),
            transport: self.transport.unwrap_or(camera.transport),
            looped: self.looped.unwrap_or(camera.looped),
            paused: self.paused.unwrap_or(camera.paused),
            lines: camera.lines.clone(),
            zones: camera.zones.clone(),
            masks: camera.masks.clone(),
        }
    }
}

/// Tells `null` from absent.
fn given<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Option<Option<Transport>>, D::Error> {
    Option::deserialize(deserializer).map(Some)
}

/// How RTSP carries media.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Transport {
    /// Within the RTSP connection: passes firewalls, loses nothing.
    Tcp,
    /// RTP over UDP: lower delay, may lose packets.
    Udp,
}

/// What a camera is doing.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum CameraState {
    /// First connection under way.
    Connecting,
    /// Frames arrive.
    Live,
    /// Lost or refused; the next attempt is planned.
    Retrying,
    /// A file played to its end.
    Ended,
    /// Gave up for good.
    Failed,
    /// Stopped by request, not forgotten.
    Paused,
}

/// Live tracks by state.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct TrackCounts {
    /// Just born.
    pub tentative: u64,
    /// Believed and in view.
    pub confirmed: u64,
    /// Believed, not seen now.
    pub lost: u64,
}

/// A camera as `GET /v1/cameras/{id}` shows it.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct CameraStatus {
    /// Its name.
    #[serde(serialize_with = "write_id")]
    pub id: CameraId,
    /// Where it is, passwords already taken out.
    pub url: String,
    /// What it is doing.
    pub state: CameraState,
    /// Since when it is in that state.
    #[serde(serialize_with = "write_time")]
    pub since: Timestamp,
    /// What last went wrong, in words; stays after recovery.
    pub last_error: Option<String>,
    /// The kind of the last error, for programs (`unauthorized`, `not_found`, `timeout`, ...).
    pub last_error_kind: Option<String>,
    /// Seconds until the next attempt, while retrying.
    pub next_retry_s: Option<f64>,
    /// How often the connection was made again after it had been live.
    pub reconnects: u64,
    /// The generation of track ids.
    pub epoch: u64,
    /// Width of the frames in pixels, once known.
    pub width: Option<u32>,
    /// Height of the frames in pixels, once known.
    pub height: Option<u32>,
    /// Decoded frames per second, over the last seconds.
    pub fps: Option<f64>,
    /// Frames decoded since the camera was added.
    pub frames_in: u64,
    /// Frames that were tracked.
    pub tracked: u64,
    /// Frames dropped, by reason. `frames_in = tracked + the sum of these` once nothing is in flight.
    pub dropped: BTreeMap<String, u64>,
    /// Live tracks by state.
    pub tracks: TrackCounts,
}

/// Why a camera could not be added or removed.
#[derive(Debug, thiserror::Error)]
pub enum CameraError {
    /// The name is taken.
    #[error("a camera of this name exists; delete it first or choose another name")]
    Exists,
    /// There is none of that name.
    #[error("no camera of this name")]
    NotFound,
    /// The request cannot work, whatever the network does.
    #[error("{0}")]
    Invalid(String),
    /// The service has as many cameras as it is allowed.
    #[error("the limit of {0} cameras is reached: delete one first, or raise max_cameras")]
    LimitReached(usize),
    /// A change of its lines or zones is refused.
    #[error(transparent)]
    Rules(#[from] EditError),
    /// The list of cameras could not be written.
    #[error("{0}")]
    Io(String),
}

fn write_id<S: Serializer>(id: &CameraId, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.serialize_str(id.as_str())
}

fn read_id<'de, D: Deserializer<'de>>(deserializer: D) -> Result<CameraId, D::Error> {
    let name = String::deserialize(deserializer)?;
    CameraId::new(&name).map_err(serde::de::Error::custom)
}

fn write_time<S: Serializer>(at: &Timestamp, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.collect_str(&format_args!("{at:.3}"))
}
