//! The history as tables: CSV and MOTChallenge.

use std::fmt::Write;

use csv::WriterBuilder;
use jiff::Timestamp;
use serde::Deserialize;

use super::history::seconds;
use crate::history::{PastEvent, PastTrack, at};

const TRACK_COLUMNS: [&str; 11] =
    ["camera", "epoch", "id", "class", "first", "last", "seconds", "confidence", "ended", "width", "height"];
const EVENT_COLUMNS: [&str; 12] = [
    "id",
    "time",
    "type",
    "camera",
    "epoch",
    "track",
    "class",
    "line",
    "direction",
    "zone",
    "dwell_s",
    "occupancy",
];

/// Lines of tracks, with their names above if it is the `first` page.
pub(super) fn track_table(first: bool, tracks: &[PastTrack]) -> Vec<u8> {
    let lines = tracks.iter().map(|track| {
        let PastTrack { key, class, first_ns, last_ns, ended, confidence, size: [width, height], .. } = track;
        [
            key.camera.to_string(),
            key.epoch.0.to_string(),
            key.id.to_string(),
            class.clone(),
            time(*first_ns),
            time(*last_ns),
            seconds(*first_ns, *last_ns).to_string(),
            format!("{confidence:.4}"),
            ended.to_string(),
            width.to_string(),
            height.to_string(),
        ]
    });
    table(first.then_some(&TRACK_COLUMNS), lines)
}

/// An event as it was told.
#[derive(Default, Deserialize)]
#[serde(default)]
struct Told {
    #[serde(rename = "type")]
    kind: String,
    camera: String,
    epoch: u64,
    track: Option<u64>,
    class: Option<String>,
    line: Option<String>,
    direction: Option<String>,
    zone: Option<String>,
    dwell_s: Option<f64>,
    occupancy: Option<u32>,
}

/// Lines of events, likewise.
pub(super) fn event_table(first: bool, events: &[PastEvent]) -> Vec<u8> {
    let lines = events.iter().map(|event| {
        // One that cannot be read has its id and time all the same.
        let told: Told = serde_json::from_str(&event.json).unwrap_or_default();
        let text = |value: Option<String>| value.unwrap_or_default();
        [
            event.id.clone(),
            time(event.time_ns),
            told.kind,
            told.camera,
            told.epoch.to_string(),
            text(told.track.map(|id| id.to_string())),
            text(told.class),
            text(told.line),
            text(told.direction),
            text(told.zone),
            text(told.dwell_s.map(|s| s.to_string())),
            text(told.occupancy.map(|n| n.to_string())),
        ]
    });
    table(first.then_some(&EVENT_COLUMNS), lines)
}

fn table<const N: usize>(head: Option<&[&str; N]>, lines: impl Iterator<Item = [String; N]>) -> Vec<u8> {
    let mut writer = WriterBuilder::new().from_writer(vec![]);
    // Writing to memory does not fail, and every line has N fields.
    let _ = head.map(|head| writer.write_record(head));
    for line in lines {
        let _ = writer.write_record(line.map(harmless));
    }
    writer.into_inner().unwrap_or_default()
}

/// A spreadsheet takes a text that begins like a formula for one.
fn harmless(text: String) -> String {
    if text.starts_with(['=', '+', '@', '\t', '\r']) { format!("'{text}") } else { text }
}

fn time(unix_ns: i64) -> String {
    Timestamp::from_nanosecond(unix_ns.into()).map(|time| format!("{time:.3}")).unwrap_or_default()
}

/// `frame,id,x,y,w,h,confidence,-1,-1,-1`, frames from 1, track after track; boxes between key boxes are on the
/// straight line, gaps are left out.
pub(super) fn mot_lines(tracks: &[PastTrack]) -> Vec<u8> {
    let mut text = String::new();
    for PastTrack { key, path, confidence, .. } in tracks {
        let (Some(first), Some(last)) = (path.first(), path.last()) else { continue };
        for frame in first.frame..=last.frame {
            if let Some([x, y, w, h]) = at(path, frame) {
                // Writing to a text does not fail.
                let _ = writeln!(
                    text,
                    "{},{},{x:.2},{y:.2},{w:.2},{h:.2},{confidence:.4},-1,-1,-1",
                    frame + 1,
                    key.id
                );
            }
        }
    }
    text.into_bytes()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::history::{KeyBox, TrackKey};
    use crate::types::{CameraId, Epoch, TrackId};

    #[test]
    fn tables_are_exactly_this() {
        let key = TrackKey { camera: CameraId::new("gate").unwrap(), epoch: Epoch(2), id: TrackId(7) };
        let key_box = |frame, x, after_gap| KeyBox { frame, unix_ns: 0, bbox: [x, 0.0, 2.0, 4.0], after_gap };
        let track = PastTrack {
            key,
            class: "=1+1, \"or\"".into(),
            first_ns: 0,
            last_ns: 1_500_000_000,
            ended: true,
            confidence: 0.75,
            size: [640, 480],
            path: vec![key_box(0, 1.0, false), key_box(2, 3.0, false), key_box(9, 8.0, true)],
            snapshot: false,
        };
        let csv = String::from_utf8(track_table(true, std::slice::from_ref(&track))).unwrap();
        let expected = concat!(
            "camera,epoch,id,class,first,last,seconds,confidence,ended,width,height\n",
            "gate,2,7,\"'=1+1, \"\"or\"\"\",1970-01-01T00:00:00.000Z,1970-01-01T00:00:01.500Z,1.5,0.7500,true,640,480\n",
        );
        assert_eq!(csv, expected);
        let mot = String::from_utf8(mot_lines(&[track])).unwrap();
        let expected = concat!(
            "1,7,1.00,0.00,2.00,4.00,0.7500,-1,-1,-1\n",
            "2,7,2.00,0.00,2.00,4.00,0.7500,-1,-1,-1\n",
            "3,7,3.00,0.00,2.00,4.00,0.7500,-1,-1,-1\n",
            "10,7,8.00,0.00,2.00,4.00,0.7500,-1,-1,-1\n",
        );
        assert_eq!(mot, expected);
        let json = r#"{"type":"zone.left","camera":"gate","epoch":2,"track":7,"zone":"queue","dwell_s":2.5}"#;
        let event = PastEvent { id: "1-1".into(), time_ns: 0, json: json.into() };
        let csv = String::from_utf8(event_table(false, &[event])).unwrap();
        assert_eq!(csv, "1-1,1970-01-01T00:00:00.000Z,zone.left,gate,2,7,,,,queue,2.5,\n");
    }
}
