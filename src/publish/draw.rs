//! Boxes, ids and trails drawn into a picture: the live annotated stream and `gakp track --video`.
//!
//! A confirmed track has a solid box, its id on a plate and a trail of where it stood (the middle of
//! its box's lower edge) in the last seconds; a lost one a dashed box and its id; a tentative one a
//! thin dashed box. A track keeps its colour, here and on the web page (`web/src/live/draw.ts`).

use std::collections::{BTreeMap, VecDeque};

use super::Rgb;
use crate::types::{BBox, Epoch, FrameTracks, MediaTime, TrackId, TrackState};

/// How long trails are.
const TRAIL_SECONDS: f64 = 2.0;
/// Points a trail may have: bounds it whatever the frame rate.
const TRAIL_POINTS: usize = 128;
/// Length of a dash and of the gap after it, in strokes' widths.
const DASH: i64 = 4;

/// Where the tracks of one camera stood in the last seconds.
#[derive(Clone, Debug, Default)]
pub struct Trails {
    epoch: Epoch,
    points: BTreeMap<TrackId, VecDeque<(MediaTime, f64, f64)>>,
}

impl Trails {
    /// Takes a frame's tracks in. Frames may be left out; tracks that are gone lose their trail.
    pub fn push(&mut self, tracks: &FrameTracks) {
        if self.epoch != tracks.epoch {
            self.points.clear();
            self.epoch = tracks.epoch;
        }
        self.points.retain(|id, _| tracks.tracks.iter().any(|t| t.id == *id));
        for track in &tracks.tracks {
            let trail = self.points.entry(track.id).or_default();
            if track.state != TrackState::Lost {
                trail.push_back((tracks.time, track.bbox.cx(), track.bbox.bottom()));
            }
            while trail.len() > TRAIL_POINTS
                || trail.front().is_some_and(|(at, ..)| tracks.time.since(*at) > TRAIL_SECONDS)
            {
                trail.pop_front();
            }
        }
    }

    /// The points of a track's trail, oldest first, in pixels of the frame.
    fn of(&self, id: TrackId) -> impl Iterator<Item = (f64, f64)> + '_ {
        self.points.get(&id).into_iter().flatten().map(|&(_, x, y)| (x, y))
    }
}

/// Draws `tracks` with their `trails` into `canvas`, whatever its size: boxes are scaled from the
/// frame's pixels to the canvas's.
pub fn annotate(canvas: &mut Rgb, tracks: &FrameTracks, trails: &Trails) {
    if canvas.width == 0 || canvas.height == 0 || tracks.width == 0 || tracks.height == 0 {
        return;
    }
    let scale =
        [canvas.width as f64 / f64::from(tracks.width), canvas.height as f64 / f64::from(tracks.height)];
    let stroke = (canvas.height as i64 / 240).max(1);
    let mut pen = Pen { canvas, stroke, colour: [0; 3], dashed: false };
    for track in &tracks.tracks {
        let b = track.bbox;
        let b = BBox::new(b.x * scale[0], b.y * scale[1], b.w * scale[0], b.h * scale[1]);
        let Some(corners) = pen.reachable(&b) else { continue };
        pen.colour = colour(track.id);
        pen.stroke = if track.state == TrackState::Tentative { 1 } else { stroke };
        pen.dashed = track.state != TrackState::Confirmed;
        pen.rectangle(&corners);
        if track.state == TrackState::Confirmed {
            let mut last = None;
            for (x, y) in trails.of(track.id) {
                let point = (x * scale[0], y * scale[1]);
                if let Some(last) = last {
                    pen.line(last, point);
                }
                last = Some(point);
            }
        }
        if track.state != TrackState::Tentative {
            pen.plate(&corners, track.id);
        }
    }
}

/// A track's colour: hues a golden angle apart, so that neighbours in time look different, and light
/// enough for a black id on any of them.
pub fn colour(id: TrackId) -> [u8; 3] {
    let hue = (id.0 % 1_000_000) as f64 * 137.508 % 360.0;
    hsl(hue, 0.9, 0.7)
}

/// CSS's `hsl(hue, saturation, lightness)`.
fn hsl(hue: f64, saturation: f64, lightness: f64) -> [u8; 3] {
    let a = saturation * lightness.min(1.0 - lightness);
    [0.0, 8.0, 4.0].map(|n| {
        let k = (n + hue / 30.0) % 12.0;
        let v = lightness - a * (k - 3.0).min(9.0 - k).clamp(-1.0, 1.0);
        (v * 255.0).round() as u8
    })
}

struct Pen<'a> {
    canvas: &'a mut Rgb,
    stroke: i64,
    colour: [u8; 3],
    dashed: bool,
}

impl Pen<'_> {
    /// Fills `x0..x1` by `y0..y1` as far as it is on the canvas.
    fn fill(&mut self, (x0, y0): (i64, i64), (x1, y1): (i64, i64), colour: [u8; 3]) {
        let (width, height) = (self.canvas.width as i64, self.canvas.height as i64);
        let (x0, x1) = (x0.clamp(0, width) as usize, x1.clamp(0, width) as usize);
        for y in y0.clamp(0, height) as usize..y1.clamp(0, height) as usize {
            let row = y * self.canvas.width;
            for pixel in self.canvas.data[(row + x0) * 3..(row + x1.max(x0)) * 3].chunks_exact_mut(3) {
                pixel.copy_from_slice(&colour);
            }
        }
    }

    /// A box with its edges moved to at most a little outside the canvas, so that huge boxes cost no
    /// more than it; `None` when nothing of it is inside or it is no box.
    fn reachable(&self, b: &BBox) -> Option<BBox> {
        let (width, height) = (self.canvas.width as f64, self.canvas.height as f64);
        b.clipped(width, height).filter(|_| b.is_valid())?;
        let margin = 2.0 * self.stroke as f64;
        let [x0, x1] = [b.x, b.right()].map(|v| v.clamp(-margin, width + margin));
        let [y0, y1] = [b.y, b.bottom()].map(|v| v.clamp(-margin, height + margin));
        Some(BBox::new(x0, y0, x1 - x0, y1 - y0))
    }

    /// The outline of a box, the stroke on its inside.
    fn rectangle(&mut self, corners: &BBox) {
        let s = self.stroke;
        let [x0, x1] = [corners.x, corners.right()].map(|v| v.round() as i64);
        let [y0, y1] = [corners.y, corners.bottom()].map(|v| v.round() as i64);
        let (dash, period) = if self.dashed { (DASH * s, 2 * DASH * s) } else { (i64::MAX, i64::MAX) };
        for x in (x0..x1).step_by(period as usize) {
            let end = x.saturating_add(dash).min(x1);
            self.fill((x, y0), (end, y0 + s), self.colour);
            self.fill((x, y1 - s), (end, y1), self.colour);
        }
        for y in (y0..y1).step_by(period as usize) {
            let end = y.saturating_add(dash).min(y1);
            self.fill((x0, y), (x0 + s, end), self.colour);
            self.fill((x1 - s, y), (x1, end), self.colour);
        }
    }

    /// A straight line between two points, which may be outside.
    fn line(&mut self, (x0, y0): (f64, f64), (x1, y1): (f64, f64)) {
        let limit = (self.canvas.width + self.canvas.height) as f64;
        if [x0, y0, x1, y1].iter().any(|v| !v.is_finite() || v.abs() > 2.0 * limit) {
            return;
        }
        let steps = (x1 - x0).abs().max((y1 - y0).abs()).ceil().max(1.0);
        let (s, half) = (self.stroke, self.stroke / 2);
        for step in 0..=steps as i64 {
            let t = step as f64 / steps;
            let (x, y) = ((x0 + (x1 - x0) * t).round() as i64, (y0 + (y1 - y0) * t).round() as i64);
            self.fill((x - half, y - half), (x - half + s, y - half + s), self.colour);
        }
    }

    /// The id on a plate above the box's upper left corner, or inside where there is no room above.
    fn plate(&mut self, corners: &BBox, id: TrackId) {
        let (text, s) = (id.to_string(), self.stroke);
        let (width, height) = (text.len() as i64 * 6 * s + s, 9 * s);
        let x = (corners.x.round().max(0.0) as i64).min((self.canvas.width as i64 - width).max(0));
        let above = corners.y.round() as i64 - height;
        let y = if above >= 0 { above } else { corners.y.round().max(0.0) as i64 };
        self.fill((x, y), (x + width, y + height), self.colour);
        for (i, digit) in text.bytes().enumerate() {
            let left = x + s + i as i64 * 6 * s;
            for (row, bits) in DIGITS[usize::from(digit - b'0')].iter().enumerate() {
                for column in (0..5).filter(|column| bits & (0b10000 >> column) != 0) {
                    let (px, py) = (left + column * s, y + s + row as i64 * s);
                    self.fill((px, py), (px + s, py + s), [0; 3]);
                }
            }
        }
    }
}

/// Digits of 5x7 pixels, a row a byte, the leftmost pixel in bit 4.
#[rustfmt::skip]
const DIGITS: [[u8; 7]; 10] = [
    [0b01110, 0b10001, 0b10011, 0b10101, 0b11001, 0b10001, 0b01110],
    [0b00100, 0b01100, 0b00100, 0b00100, 0b00100, 0b00100, 0b01110],
    [0b01110, 0b10001, 0b00001, 0b00010, 0b00100, 0b01000, 0b11111],
    [0b11111, 0b00010, 0b00100, 0b00010, 0b00001, 0b10001, 0b01110],
    [0b00010, 0b00110, 0b01010, 0b10010, 0b11111, 0b00010, 0b00010],
    [0b11111, 0b10000, 0b11110, 0b00001, 0b00001, 0b10001, 0b01110],
    [0b00110, 0b01000, 0b10000, 0b11110, 0b10001, 0b10001, 0b01110],
    [0b11111, 0b00001, 0b00010, 0b00100, 0b01000, 0b01000, 0b01000],
    [0b01110, 0b10001, 0b10001, 0b01110, 0b10001, 0b10001, 0b01110],
    [0b01110, 0b10001, 0b10001, 0b01111, 0b00001, 0b00010, 0b01100],
];

#[cfg(test)]
#[path = "draw_tests.rs"]
mod tests;
