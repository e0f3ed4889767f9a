//! The time stamps of successive connections, joined to one line that only grows.

use std::time::{Duration, Instant};

use crate::types::MediaTime;

/// Joins presentation time stamps (PTS) to [`MediaTime`].
///
/// Within a connection the line follows the PTS exactly. Where it must not:
///
/// | what comes | what is made of it |
/// | --- | --- |
/// | the first frame of a later connection to a camera | the last time + the wall time that passed |
/// | the first frame of a file's next round | the last time + one frame |
/// | a PTS not later than the last, by less than 1 s | the last time + 1 ms, the PTS line goes on |
/// | a PTS further back, or further ahead than can be true | the last time + the wall time that passed (camera) or one frame (file); the line goes on from there |
/// | no PTS | likewise |
#[derive(Debug)]
pub(crate) struct TimeLine {
    mode: Mode,
    last: Option<Last>,
    /// Added to a PTS to give a time; `None` until the connection's first PTS.
    offset: Option<i64>,
    /// The usual distance of two frames.
    frame_ns: i64,
}

/// What time is when the time stamps do not tell.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Mode {
    /// The wall time between arrivals.
    Camera,
    /// One frame: the same file gives the same times, run after run.
    File,
}

#[derive(Clone, Copy, Debug)]
struct Last {
    time: i64,
    arrival: Instant,
}

const MS: i64 = 1_000_000;
/// How far a PTS may run ahead of the wall clock before it is taken for a jump.
const CAMERA_LEAD: i64 = 2_000 * MS;
/// The longest pause between two frames of a file.
const FILE_STEP: i64 = 60_000 * MS;

impl TimeLine {
    pub fn new(mode: Mode) -> Self {
        Self { mode, last: None, offset: None, frame_ns: 40 * MS }
    }

    /// A new connection or a new round of a file: PTS start anew.
    pub fn restart(&mut self) {
        self.offset = None;
    }

    /// The distance of frames that the stream announces.
    pub fn set_frame_duration(&mut self, duration: Duration) {
        self.frame_ns = i64::try_from(duration.as_nanos()).unwrap_or(40 * MS).clamp(MS, 60_000 * MS);
    }

    /// The place of a frame with this PTS (ns), if it has one, that arrived now.
    pub fn place(&mut self, pts: Option<u64>, arrival: Instant) -> MediaTime {
        // Half the range is 146 years; a larger PTS is garbage.
        let pts = pts.and_then(|p| i64::try_from(p).ok()).filter(|&p| p < i64::MAX / 2);
        let Some(last) = self.last else {
            self.offset = pts.map(|p| -p);
            return self.settle(0, arrival);
        };
        let passed =
            i64::try_from(arrival.saturating_duration_since(last.arrival).as_nanos()).unwrap_or(i64::MAX);
        let blind_step = match self.mode {
            Mode::Camera => passed.max(MS),
            Mode::File => self.frame_ns,
        };
        let longest = match self.mode {
            Mode::Camera => passed.saturating_add(CAMERA_LEAD),
            Mode::File => FILE_STEP,
        };
        let time = match (pts, self.offset) {
            (Some(pts), Some(offset)) => {
                let step = (offset + pts).saturating_sub(last.time);
                if (1..=longest).contains(&step) {
                    last.time + step
                } else if step <= 0 && step > -1_000 * MS {
                    last.time + MS
                } else {
                    self.offset = Some(last.time + blind_step - pts);
                    last.time + blind_step
                }
            }
            (Some(pts), None) => {
                self.offset = Some(last.time + blind_step - pts);
                last.time + blind_step
            }
            (None, _) => last.time + blind_step,
        };
        self.settle(time, arrival)
    }

    fn settle(&mut self, time: i64, arrival: Instant) -> MediaTime {
        self.last = Some(Last { time, arrival });
        MediaTime(time)
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// Feeds (PTS in ms or none, wall ms since the start; negative: a restart before it).
    fn run(mode: Mode, frames: &[(Option<u64>, i64)]) -> Vec<i64> {
        let (mut line, start) = (TimeLine::new(mode), Instant::now());
        frames
            .iter()
            .map(|&(pts, wall)| {
                if wall < 0 {
                    line.restart();
                }
                let at = start + Duration::from_millis(wall.unsigned_abs());
                line.place(pts.map(|ms| ms * 1_000_000), at).0 / MS
            })
            .collect()
    }

    #[test]
    fn follows_time_stamps_and_joins_connections() {
        let p = Some;
        for (name, mode, frames, expected) in [
            ("begins at 0", Mode::Camera, vec![(p(500), 0), (p(540), 41), (p(580), 79)], vec![0, 40, 80]),
            ("a pause is a pause", Mode::Camera, vec![(p(0), 0), (p(3000), 3010)], vec![0, 3000]),
            (
                "reconnection",
                Mode::Camera,
                vec![(p(0), 1), (p(40), 40), (p(7), -5040), (p(47), 5081)],
                vec![0, 40, 5040, 5080],
            ),
            (
                "next round",
                Mode::File,
                vec![(p(0), 0), (p(40), 0), (p(0), -1), (p(40), 1)],
                vec![0, 40, 80, 120],
            ),
            ("a step back", Mode::Camera, vec![(p(100), 0), (p(90), 40), (p(180), 80)], vec![0, 1, 80]),
            ("the same again", Mode::File, vec![(p(0), 0), (p(0), 0), (p(40), 0)], vec![0, 1, 40]),
            ("far back", Mode::Camera, vec![(p(9000), 0), (p(0), 40), (p(40), 80)], vec![0, 40, 80]),
            (
                "hours ahead",
                Mode::Camera,
                vec![(p(0), 0), (p(9_000_000), 40), (p(9_000_040), 80)],
                vec![0, 40, 80],
            ),
            (
                "hours ahead in a file",
                Mode::File,
                vec![(p(0), 0), (p(9_000_000), 0), (p(9_000_040), 0)],
                vec![0, 40, 80],
            ),
            ("no stamps", Mode::Camera, vec![(None, 0), (None, 33), (None, 70)], vec![0, 33, 70]),
            ("no stamps in a file", Mode::File, vec![(None, 0), (None, 5), (p(0), 9)], vec![0, 40, 80]),
            ("nonsense", Mode::File, vec![(p(0), 0), (Some(u64::MAX / 1_000_000), 0)], vec![0, 40]),
        ] {
            assert_eq!(run(mode, &frames), expected, "{name}");
        }
    }

    proptest! {
        #[test]
        fn only_grows_and_never_leaps(
            camera: bool,
            frames in prop::collection::vec((prop::option::of(any::<u64>()), 0u64..100, prop::bool::weighted(0.1)), 1..60),
        ) {
            let mode = if camera { Mode::Camera } else { Mode::File };
            let (mut line, mut at) = (TimeLine::new(mode), Instant::now());
            let mut last = -1;
            for (pts, passed, restart) in frames {
                at += Duration::from_millis(passed);
                if restart {
                    line.restart();
                }
                let time = line.place(pts, at).0;
                prop_assert!(time > last);
                prop_assert!(time - last <= 1 + FILE_STEP.max(CAMERA_LEAD + 100 * MS));
                last = time;
            }
        }
    }
}
