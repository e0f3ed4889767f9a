//! Where tracked frames go.

use std::sync::Arc;

use tokio::sync::{mpsc, watch};

use super::analyst::CameraAnalyst;
use crate::publish::{Hub, Masks, Picture};
use crate::types::{Frame, FrameTracks};

/// Takes tracked frames, on the tracker's thread.
pub trait Outlet: Send {
    /// Takes one frame with its tracks.
    fn emit(&mut self, frame: Arc<Frame>, tracks: Arc<FrameTracks>);
}

/// The service's outlet: never waits.
pub struct LiveOutlet {
    /// Subscribers to tracks.
    pub hub: Hub,
    /// Watchers of the picture see the newest.
    pub video: watch::Sender<Option<Arc<Picture>>>,
    /// Lines and zones.
    pub analyst: Arc<CameraAnalyst>,
}

impl Outlet for LiveOutlet {
    fn emit(&mut self, frame: Arc<Frame>, tracks: Arc<FrameTracks>) {
        self.hub.publish(tracks.clone());
        let picture = Picture::new(frame, tracks.clone(), self.analyst.masks());
        self.video.send_replace(Some(Arc::new(picture)));
        self.analyst.take(&tracks);
    }
}

/// The offline outlet: every frame, in order; the tracker waits for its reader.
pub struct Collector(pub mpsc::Sender<Picture>);

impl Outlet for Collector {
    fn emit(&mut self, frame: Arc<Frame>, tracks: Arc<FrameTracks>) {
        // A reader that went away wants no more; the source is being stopped.
        let _ = self.0.blocking_send(Picture::new(frame, tracks, Masks::none()));
    }
}
