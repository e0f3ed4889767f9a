//! A crowd that walks at random: detections for `gakp bench core --plot`.

use crate::types::{BBox, Detection};

/// Sizes of the crowds.
pub const SIZES: [usize; 8] = [10, 25, 50, 100, 200, 300, 400, 500];
/// Size of the picture, pixels.
pub const SIZE: (f64, f64) = (1920.0, 1080.0);
/// Frames a second.
pub const FRAME_RATE: f64 = 25.0;
/// Frames until every person is a confirmed track with a full history.
pub const WARM_UP: usize = 10;
/// Frames after that.
const FRAMES: usize = 40;

/// Detections of `people` in every frame: each walks straight, turns back at the border, and is seen with
/// an error of 3 % of its height. Heights are 40 to 120 pixels, so 500 people cover one another as much as
/// a dense crowd does.
pub fn detections(people: usize) -> Vec<Vec<Detection>> {
    let mut rng = fastrand::Rng::with_seed(people as u64);
    let mut walkers: Vec<[f64; 5]> = (0..people)
        .map(|_| {
            let height = 40.0 + 80.0 * rng.f64();
            let (angle, speed) = (rng.f64() * std::f64::consts::TAU, height * 0.8 / FRAME_RATE);
            [rng.f64() * SIZE.0, rng.f64() * SIZE.1, height, angle.cos() * speed, angle.sin() * speed]
        })
        .collect();
    (0..WARM_UP + FRAMES)
        .map(|_| {
            let seen = |walker: &mut [f64; 5]| {
                let [x, y, height, vx, vy] = walker;
                (*x, *y) = (*x + *vx, *y + *vy);
                for (at, v, end) in [(&mut *x, vx, SIZE.0), (&mut *y, vy, SIZE.1)] {
                    if !(0.0..=end).contains(at) {
                        *v = -*v;
                        *at = at.clamp(0.0, end);
                    }
                }
                let mut error = || (rng.f64() - 0.5) * 0.1 * *height;
                let (cx, cy, h) = (*x + error(), *y + error(), *height + error());
                Detection::person(BBox::from_center(cx, cy, 0.4 * h, h), 0.9)
            };
            walkers.iter_mut().map(seen).collect()
        })
        .collect()
}

/// Pairs of overlapping people in a frame, on average: how crowded it is.
pub fn pairs(frames: &[Vec<Detection>]) -> f64 {
    let of_frame = |frame: &Vec<Detection>| {
        let pair =
            |(i, a): (usize, &Detection)| frame[..i].iter().filter(|b| a.bbox.iou(&b.bbox) > 0.0).count();
        frame.iter().enumerate().map(pair).sum::<usize>()
    };
    frames.iter().map(of_frame).sum::<usize>() as f64 / frames.len().max(1) as f64
}
