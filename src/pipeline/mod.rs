//! The wiring: a camera's frames through the stages to the tracker's thread and out.
//!
//! ```text
//! a camera's own                        shared by all cameras
//! source ─▶ Mailbox ─▶ detect ─▶ embed ─▶ tracker thread ─▶ Outlet (hub, or a file)
//! (thread)  newest     (task)   (task)      │      ▲
//!           wins                            ▼      │
//!                                         link (task)
//! ```
//!
//! | queue | bound | when full |
//! | --- | --- | --- |
//! | `frames`, a camera's mailbox | 1 live, 8 offline | live: the older frame is dropped (`overload`); offline: the decoder waits |
//! | the detector, all live cameras together | what its workers take, and one worker's next (`turns.rs`) | the frame waits in its mailbox |
//! | `detected`, detect to embed | 2 a camera | the stage before waits |
//! | from the mailbox to the tracks | the detector's workers and 2, live; offline four times as many | the frame waits in its mailbox |
//! | `link`, pairs to be scored | 1 a camera | cannot be: a camera has one frame in hand |
//!
//! It is built sink first, so each stage owns its downstream mailbox. A frame carries a [`Ticket`]
//! from the decoder on, and the ticket is settled exactly once, whatever happens.

mod analyst;
mod camera;
mod detect;
mod embed;
mod link;
mod mailbox;
mod outlet;
mod set;
mod store;
mod ticket;
mod tracker;
mod turns;

pub use analyst::CameraAnalyst;
pub use camera::{Camera, CameraPlan, CameraState, CameraView, Condition, Lanes, MAX_CAMERAS, StartError};
pub use mailbox::{Mailbox, Policy};
pub use outlet::{Collector, LiveOutlet, Outlet};
pub use set::{CameraSet, SetConfig, source_spec};
pub use store::{Remembered, Store, StoreError};
pub use ticket::Ticket;
pub use tracker::TrackerGone;
