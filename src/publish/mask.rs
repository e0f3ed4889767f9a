//! Masks: what of a camera's picture nobody is to see.

use std::sync::Arc;

use tokio::sync::watch;

use super::Rgb;
use crate::analytics::{Mask, MaskStyle, Point};

/// Blocks of a pixelated mask in the height of the picture.
const BLOCKS: usize = 24;
/// Pixels of such a block's side at least.
const LEAST_BLOCK: usize = 8;

/// One camera's masks as they are now; clones follow the same camera.
#[derive(Clone, Debug)]
pub struct Masks(watch::Receiver<Arc<[Mask]>>);

impl Masks {
    /// Of a picture that hides nothing.
    pub fn none() -> Self {
        Self(watch::channel(Arc::default()).1)
    }

    /// What `masks` holds, whenever it is asked.
    pub fn follow(masks: &watch::Sender<Arc<[Mask]>>) -> Self {
        Self(masks.subscribe())
    }

    /// What is hidden now.
    pub fn now(&self) -> Arc<[Mask]> {
        self.0.borrow().clone()
    }

    /// What is hidden now counts as seen: [`Masks::changed`] waits for the next change.
    pub fn mark_seen(&mut self) {
        self.0.mark_unchanged();
    }

    /// Waits until other masks are set; for ever, once nobody sets any. Cancel safe.
    pub async fn changed(&mut self) {
        if self.0.changed().await.is_err() {
            std::future::pending().await
        }
    }
}

/// Hides what is under `masks`: each pixel that a mask touches.
pub(super) fn hide(canvas: &mut Rgb, masks: &[Mask]) {
    for mask in masks {
        let corners = corners(mask, canvas);
        match mask.style {
            MaskStyle::Fill => fill(canvas, &corners),
            MaskStyle::Pixelate => pixelate(canvas, &corners),
        }
    }
}

/// A mask's corners in pixels.
fn corners(mask: &Mask, canvas: &Rgb) -> Vec<Point> {
    let (width, height) = (canvas.width as f64, canvas.height as f64);
    mask.points.iter().map(|p| Point { x: p.x * width, y: p.y * height }).collect()
}

fn fill(canvas: &mut Rgb, corners: &[Point]) {
    for y in 0..canvas.height {
        for (from, to) in spans(corners, y, canvas.width) {
            let row = y * canvas.width;
            canvas.data[(row + from) * 3..(row + to) * 3].fill(0);
        }
    }
}

/// The mean of each block goes to those of its pixels that are under the mask.
fn pixelate(canvas: &mut Rgb, corners: &[Point]) {
    let side = canvas.height.div_ceil(BLOCKS).max(LEAST_BLOCK);
    for top in (0..canvas.height).step_by(side) {
        let rows = top..(top + side).min(canvas.height);
        let hidden: Vec<_> = rows.clone().map(|y| spans(corners, y, canvas.width)).collect();
        if hidden.iter().all(Vec::is_empty) {
            continue;
        }
        let means = means(canvas, rows.clone(), side);
        for (y, spans) in rows.zip(hidden) {
            for x in spans.into_iter().flat_map(|(from, to)| from..to) {
                let at = (y * canvas.width + x) * 3;
                canvas.data[at..at + 3].copy_from_slice(&means[x / side]);
            }
        }
    }
}

/// The mean colour of each block of a row of blocks.
fn means(canvas: &Rgb, rows: std::ops::Range<usize>, side: usize) -> Vec<[u8; 3]> {
    let blocks = canvas.width.div_ceil(side);
    let (mut sums, mut counts) = (vec![[0u64; 3]; blocks], vec![0u64; blocks]);
    for y in rows {
        let row = &canvas.data[y * canvas.width * 3..(y + 1) * canvas.width * 3];
        for (x, pixel) in row.chunks_exact(3).enumerate() {
            counts[x / side] += 1;
            for (sum, value) in sums[x / side].iter_mut().zip(pixel) {
                *sum += u64::from(*value);
            }
        }
    }
    sums.iter().zip(counts).map(|(sum, count)| sum.map(|s| (s / count.max(1)) as u8)).collect()
}

/// The pixels `from..to` of row `y` that the polygon touches (even-odd).
fn spans(corners: &[Point], y: usize, width: usize) -> Vec<(usize, usize)> {
    let (top, bottom) = (y as f64, y as f64 + 1.0);
    let mut spans = vec![];
    let mut add = |from: f64, to: f64| {
        // `as` saturates: what is negative is 0.
        let (from, to) = (from.floor() as usize, (to.ceil() as usize).min(width));
        if from < to {
            spans.push((from, to));
        }
    };
    let edges = || corners.iter().zip(corners.iter().cycle().skip(1));
    // What lies inside, at three heights of the row.
    for level in [top, (top + bottom) / 2.0, bottom] {
        let mut crossings: Vec<f64> = edges()
            .filter(|(a, b)| (a.y <= level) != (b.y <= level))
            .map(|(a, b)| a.x + (level - a.y) / (b.y - a.y) * (b.x - a.x))
            .collect();
        crossings.sort_by(f64::total_cmp);
        crossings.as_chunks::<2>().0.iter().for_each(|[from, to]| add(*from, *to));
    }
    // What the edges pass: a corner between two heights is inside, too.
    for (a, b) in edges() {
        let (from, to) = (a.y.min(b.y).max(top), a.y.max(b.y).min(bottom));
        if from <= to {
            let at = |y: f64| if a.y == b.y { a.x } else { a.x + (y - a.y) / (b.y - a.y) * (b.x - a.x) };
            let (first, last) = if a.y == b.y { (a.x, b.x) } else { (at(from), at(to)) };
            add(first.min(last), first.max(last));
        }
    }
    spans
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::analytics::RuleId;

    /// Every pixel another colour, none of them black.
    fn picture(width: usize, height: usize) -> Rgb {
        let pixel = |i: usize| [1 + (i % 251) as u8, 1 + (i / 7 % 241) as u8, 1 + (i / 31 % 239) as u8];
        Rgb { width, height, data: (0..width * height).flat_map(pixel).collect() }
    }

    fn mask(points: &[(f64, f64)], style: MaskStyle) -> Mask {
        let points = points.iter().map(|&(x, y)| Point { x, y }).collect();
        Mask { id: RuleId::new("m").unwrap(), points, style }
    }

    /// Whether a point is inside, by its angle seen from all corners (another way than the fill's).
    fn winds(corners: &[(f64, f64)], (x, y): (f64, f64)) -> bool {
        let around: f64 = (0..corners.len())
            .map(|i| {
                let ((ax, ay), (bx, by)) = (corners[i], corners[(i + 1) % corners.len()]);
                let (a, b) = ((ay - y).atan2(ax - x), (by - y).atan2(bx - x));
                (b - a + 3.0 * std::f64::consts::PI).rem_euclid(2.0 * std::f64::consts::PI)
                    - std::f64::consts::PI
            })
            .sum();
        around.abs() > 1.0
    }

    /// How far a point is from the outline, pixels.
    fn away(corners: &[(f64, f64)], (w, h): (f64, f64), (x, y): (f64, f64)) -> f64 {
        let to_side = |i: usize| {
            let ((ax, ay), (bx, by)) = (corners[i], corners[(i + 1) % corners.len()]);
            let (ax, ay, dx, dy) = (ax * w, ay * h, (bx - ax) * w, (by - ay) * h);
            let along = (((x - ax) * dx + (y - ay) * dy) / (dx * dx + dy * dy)).clamp(0.0, 1.0);
            (ax + along * dx - x).hypot(ay + along * dy - y)
        };
        (0..corners.len()).map(to_side).fold(f64::INFINITY, f64::min)
    }

    #[test]
    fn what_is_under_a_mask_is_gone_and_the_rest_is_as_it_was() {
        for (width, height) in [(64, 48), (97, 31), (640, 360)] {
            for shape in [
                &[(0.1, 0.1), (0.6, 0.15), (0.3, 0.8)][..],
                // A horseshoe.
                &[
                    (0.1, 0.1),
                    (0.9, 0.1),
                    (0.9, 0.9),
                    (0.7, 0.9),
                    (0.7, 0.3),
                    (0.3, 0.3),
                    (0.3, 0.9),
                    (0.1, 0.9),
                ],
                &[(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)],
            ] {
                for style in [MaskStyle::Fill, MaskStyle::Pixelate] {
                    let before = picture(width, height);
                    let mut after = before.clone();
                    hide(&mut after, &[mask(shape, style)]);
                    let (mut hidden, mut shown) = (0, 0);
                    for y in 0..height {
                        for x in 0..width {
                            let (px, py) = (x as f64 + 0.5, y as f64 + 0.5);
                            let inside =
                                [(0.0, 0.0), (-0.49, -0.49), (0.49, -0.49), (-0.49, 0.49), (0.49, 0.49)].map(
                                    |(dx, dy)| {
                                        winds(shape, ((px + dx) / width as f64, (py + dy) / height as f64))
                                    },
                                );
                            let (was, is) = (before.pixel(x, y), after.pixel(x, y));
                            if inside.contains(&true) {
                                hidden += 1;
                                assert!(
                                    style == MaskStyle::Pixelate || is == [0; 3],
                                    "({x}, {y}) of {shape:?}: {is:?}"
                                );
                            } else if away(shape, (width as f64, height as f64), (px, py)) > 1.5 {
                                shown += 1;
                                assert_eq!(was, is, "({x}, {y}) of {shape:?}");
                            }
                        }
                    }
                    assert!(hidden > 100 && (shown > 100 || shape.len() == 4), "{hidden} {shown}");
                }
            }
        }
    }

    #[test]
    fn a_block_has_one_colour_however_fine_what_it_hides() {
        let mut canvas = picture(240, 240);
        let before = canvas.clone();
        hide(&mut canvas, &[mask(&[(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)], MaskStyle::Pixelate)]);
        let side = 240 / BLOCKS;
        for y in 0..240 {
            for x in 0..240 {
                assert_eq!(canvas.pixel(x, y), canvas.pixel(x / side * side, y / side * side));
            }
        }
        let sum = |rgb: &Rgb| -> f64 { rgb.data.iter().map(|v| f64::from(*v)).sum() };
        assert!((sum(&canvas) / sum(&before) - 1.0).abs() < 0.01, "as bright as before");
    }

    #[tokio::test]
    async fn a_picture_that_was_taken_before_follows_its_cameras_masks() {
        let masks = watch::channel(Arc::<[Mask]>::default()).0;
        let mut followed = Masks::follow(&masks);
        assert!(followed.now().is_empty());
        masks.send_replace([mask(&[(0.0, 0.0), (1.0, 0.0), (1.0, 1.0)], MaskStyle::Fill)].into());
        followed.changed().await;
        assert_eq!(followed.now().len(), 1);
        drop(masks);
        assert_eq!(followed.now().len(), 1, "a camera that is gone shows no more than before");
    }
}
