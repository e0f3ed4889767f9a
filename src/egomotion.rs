//! Camera motion seen in the picture: one shift between two frames.
//!
//! ```text
//! luma -> a small picture, one of half its size, one of a quarter
//! blocks of the earlier frame are looked for in the later one, coarse to fine (least sum of squared
//! differences, a parabola for the fraction)  ->  the median of the shifts that the most blocks agree on
//! ```
//!
//! People and cars move otherwise than the scene, so do captions burnt into the picture: it is not the mean
//! that counts but what most blocks with something to see in them do. Where too few agree (a zoom, a turn
//! about the optical axis, a cut, a blank wall) there is no answer.

use std::f64::consts::FRAC_PI_2;

use crate::track::shift::{Shift, median};
use crate::types::Image;

/// Width of the small picture, pixels, about.
const WIDTH: usize = 160;
/// Side of a block in the two smaller pictures; twice that in the largest.
const BLOCK: usize = 8;
/// Greatest shift that is looked for, pixels of the smallest picture: an eighth of the width.
const REACH: isize = 5;
/// Least mean absolute deviation of a block's luma: with less there is nothing to hold on to.
const TEXTURE: f32 = 4.0;
/// Blocks agree within this, pixels of the small picture.
const AGREE: f32 = 0.4;
/// Of three by three.
const CENTRE: usize = 4;
/// Steps of a level of luma.
const UNIT: u32 = 4;
/// Least number of blocks that agree.
const LEAST: usize = 6;
/// Least share of the blocks with texture that agree.
const SHARE: f32 = 0.3;
/// Standard deviation of a block's place beside what the blocks tell, pixels of the small picture.
const PRECISION: f64 = 0.05;
/// A shift within this many standard deviations of zero is none.
const STILL: f64 = 3.0;

/// A small picture in shades of grey, in units of 1 / [`UNIT`] of a level of luma. Integers, because their sums
/// can be made in any order: eight at a time.
#[derive(Clone, Debug, Default)]
struct Grey {
    width: usize,
    height: usize,
    pixels: Vec<i16>,
}

/// Means of cells of so many pixels, in units of 1 / [`UNIT`].
struct Mean {
    /// 2^48 times a unit's part of the sum, rounded up. Sums are below 2^26, so that nothing but the fraction is wrong.
    factor: u64,
}

impl Mean {
    /// Of `scale` x `scale` pixels, `scale` at most 256.
    fn of(scale: usize) -> Self {
        Self { factor: (u64::from(UNIT) << 48).div_ceil((scale * scale) as u64) }
    }

    fn of_cell(&self, columns: &[u16]) -> i16 {
        let sum: u32 = columns.iter().map(|v| u32::from(*v)).sum();
        ((u64::from(sum) * self.factor) >> 48) as i16
    }

    fn of_cells<const SCALE: usize>(&self, columns: &[u16]) -> impl Iterator<Item = i16> {
        columns.as_chunks::<SCALE>().0.iter().map(|cell| self.of_cell(cell))
    }
}

impl Grey {
    /// Means of `scale` x `scale` pixels of luma.
    fn of(image: &Image, scale: usize) -> Self {
        let (plane, stride) = image.plane(0);
        let (width, height) = (image.width as usize / scale, image.height as usize / scale);
        // Columns of a row of cells; 255 times a scale of up to 257 fits.
        let mut columns = vec![0u16; width * scale];
        let mut pixels = Vec::with_capacity(width * height);
        let mean = Mean::of(scale);
        for y in 0..height {
            columns.fill(0);
            for row in plane[y * scale * stride..].chunks(stride).take(scale) {
                columns.iter_mut().zip(row).for_each(|(sum, v)| *sum += u16::from(*v));
            }
            match scale {
                // The widths of most cameras, 640 to 1280: the compiler makes additions of these.
                4 => pixels.extend(mean.of_cells::<4>(&columns)),
                8 => pixels.extend(mean.of_cells::<8>(&columns)),
                12 => pixels.extend(mean.of_cells::<12>(&columns)),
                _ => pixels.extend(columns.chunks_exact(scale).map(|cell| mean.of_cell(cell))),
            }
        }
        Self { width, height, pixels }
    }

    fn halved(&self) -> Self {
        let (width, height) = (self.width / 2, self.height / 2);
        let mut pixels = Vec::with_capacity(width * height);
        for rows in self.pixels.chunks_exact((2 * self.width).max(1)).take(height) {
            let (upper, lower) = rows.split_at(self.width);
            let (upper, lower) = (upper.as_chunks::<2>().0, lower.as_chunks::<2>().0);
            pixels.extend(upper.iter().zip(lower).map(|([a, b], [c, d])| (a + b + c + d) / 4));
        }
        Self { width, height, pixels }
    }

    /// Sum of squared differences of the block of `SIDE` at `(x, y)` and that of `other` at `(ox, oy)`, each
    /// less its mean: lamps and exposure change. Both lie within.
    fn difference<const SIDE: usize>(&self, at: (usize, usize), other: &Grey, there: (usize, usize)) -> f32 {
        let rows = |grey: &Grey, (x, y): (usize, usize)| (y * grey.width + x, grey.width);
        let ([mut a, mut b], widths) = {
            let [(a, wa), (b, wb)] = [rows(self, at), rows(other, there)];
            ([&self.pixels[a..], &other.pixels[b..]], [wa, wb])
        };
        let (mut sum, mut squares) = (0i32, 0i32);
        for line in 0..SIDE {
            if let (Some(a), Some(b)) = (a.first_chunk::<SIDE>(), b.first_chunk::<SIDE>()) {
                for (a, b) in a.iter().zip(b) {
                    let difference = i32::from(a - b);
                    sum += difference;
                    squares += difference * difference;
                }
            }
            if line + 1 < SIDE {
                (a, b) = (&a[widths[0]..], &b[widths[1]..]);
            }
        }
        squares as f32 - (sum as f32).powi(2) / (SIDE * SIDE) as f32
    }

    /// Whether the mean absolute deviation within the block of `SIDE` at `(x, y)` is [`TEXTURE`] at least.
    fn has_texture<const SIDE: usize>(&self, (x, y): (usize, usize)) -> bool {
        let rows = || {
            let lines = self.pixels[y * self.width + x..].chunks(self.width).take(SIDE);
            lines.filter_map(|line| line.first_chunk::<SIDE>())
        };
        let area = (SIDE * SIDE) as i32;
        let sum = |row: &[i16; SIDE]| row.iter().map(|v| i32::from(*v)).sum::<i32>();
        let mean = (rows().map(sum).sum::<i32>() / area) as i16;
        let apart = |row: &[i16; SIDE]| row.iter().map(|v| i32::from((v - mean).abs())).sum::<i32>();
        let deviation = rows().map(apart).sum::<i32>();
        deviation as f32 / area as f32 / UNIT as f32 >= TEXTURE
    }

    /// Sum of squared differences to the block of `side` that lies by `(dx, dy)` from `at` in `later`; `None`
    /// where that is not within.
    fn cost<const SIDE: usize>(&self, at: (usize, usize), later: &Grey, [dx, dy]: [isize; 2]) -> Option<f32> {
        let (x, y) = (at.0.checked_add_signed(dx)?, at.1.checked_add_signed(dy)?);
        let inside = x + SIDE <= later.width && y + SIDE <= later.height;
        inside.then(|| self.difference::<SIDE>(at, later, (x, y)))
    }

    /// Displacement in `later` of the block of `SIDE` at `at`, of those at most `reach` around `guess`; `None`
    /// where all of these lie outside.
    fn find<const SIDE: usize>(
        &self,
        at: (usize, usize),
        later: &Grey,
        guess: [isize; 2],
        reach: isize,
    ) -> Option<[isize; 2]> {
        let around = |centre: isize| centre - reach..=centre + reach;
        let all = around(guess[1]).flat_map(|dy| around(guess[0]).map(move |dx| [dx, dy]));
        let costs = all.filter_map(|by| Some((self.cost::<SIDE>(at, later, by)?, by)));
        costs.min_by(|a, b| a.0.total_cmp(&b.0)).map(|(_, by)| by)
    }

    /// The displacement of the block of `SIDE` at `at` to a fraction of a pixel, at most two pixels from `guess`:
    /// where the paraboloid through the costs around the best place has its vertex, the best place where it has
    /// none. `None` where `guess` lies outside.
    fn refine<const SIDE: usize>(
        &self,
        at: (usize, usize),
        later: &Grey,
        guess: [isize; 2],
    ) -> Option<[f32; 2]> {
        let around = |by: [isize; 2]| -> [Option<f32>; 9] {
            std::array::from_fn(|i| {
                let [dx, dy] = [i as isize % 3 - 1, i as isize / 3 - 1];
                self.cost::<SIDE>(at, later, [by[0] + dx, by[1] + dy])
            })
        };
        let mut by = guess;
        let mut costs = around(by);
        costs[CENTRE]?;
        let cost = |i: usize| costs[i].unwrap_or(f32::INFINITY);
        let best = (0..9).fold(CENTRE, |best, i| if cost(i) < cost(best) { i } else { best });
        if best != CENTRE {
            by = [by[0] + best as isize % 3 - 1, by[1] + best as isize / 3 - 1];
            costs = around(by);
        }
        let vertex = || {
            let [a, b, c, d, e, f, g, h, i] = costs;
            let (left, here, right) = (d?, e?, f?);
            let (above, below) = (b?, h?);
            let [gx, gy] = [(right - left) / 2.0, (below - above) / 2.0];
            let [xx, yy] = [right - 2.0 * here + left, below - 2.0 * here + above];
            let xy = (i? - c? - g? + a?) / 4.0;
            let determinant = xx * yy - xy * xy;
            let step = [(xy * gy - yy * gx) / determinant, (xy * gx - xx * gy) / determinant];
            (xx > 0.0 && determinant > 0.0 && step.iter().all(|v| v.abs() <= 1.0)).then_some(step)
        };
        let step = vertex().unwrap_or_default();
        Some([by[0] as f32 + step[0], by[1] as f32 + step[1]])
    }

    /// Whether the block of `SIDE` at `at` fits `later` better where it is than a pixel beside it.
    fn stays<const SIDE: usize>(&self, at: (usize, usize), later: &Grey) -> bool {
        let cost = |dx, dy| self.cost::<SIDE>(at, later, [dx, dy]).unwrap_or(f32::INFINITY);
        let here = cost(0, 0);
        [(-1, 0), (1, 0), (0, -1), (0, 1)].iter().all(|(dx, dy)| here <= cost(*dx, *dy))
    }
}

/// A frame, small, of half that size and of a quarter of it.
#[derive(Clone, Debug)]
struct Pyramid {
    /// Of the picture.
    size: (u32, u32),
    levels: [Grey; 3],
}

/// Follows one camera: [`Egomotion::next`] is given its frames one by one.
#[derive(Clone, Debug, Default)]
pub struct Egomotion {
    last: Option<Pyramid>,
}

impl Egomotion {
    /// The camera's shift since the frame before, in pixels of the picture; `None` for the first frame, after
    /// a change of the size, and where too few blocks agree.
    pub fn next(&mut self, image: &Image) -> Option<Shift> {
        let scale = (image.width as usize / WIDTH).clamp(1, 256);
        let small = Grey::of(image, scale);
        let half = small.halved();
        let quarter = half.halved();
        let now = Pyramid { size: (image.width, image.height), levels: [small, half, quarter] };
        let before = self.last.replace(now);
        let now = self.last.as_ref()?;
        let before = before.filter(|before| before.size == now.size)?;
        agreed(&displacements(&before.levels, &now.levels)).map(|(by, variance)| {
            let scale = scale as f64;
            // Most cameras stand still: what may as well be nothing is nothing.
            let still = (0..2).all(|axis| by[axis].powi(2) < STILL * STILL * variance[axis]);
            if still {
                return Shift::default();
            }
            Shift { by: by.map(|v| v * scale), variance: variance.map(|v| v * scale * scale) }
        })
    }
}

/// Corners of the blocks of `SIDE`, one every `step`, that have texture.
fn blocks<const SIDE: usize>(grey: &Grey, step: usize) -> Vec<(usize, usize)> {
    let corners = |length: usize| (0..(length + 1).saturating_sub(SIDE)).step_by(step);
    let all = corners(grey.height).flat_map(|y| corners(grey.width).map(move |x| (x, y)));
    all.filter(|at| grey.has_texture::<SIDE>(*at)).collect()
}

/// Displacements of the blocks with texture, pixels of the small picture. Each level says about where to look
/// in the next finer one.
fn displacements(before: &[Grey; 3], now: &[Grey; 3]) -> Vec<[f32; 2]> {
    let search = |level: usize, step: usize, guess: [isize; 2], reach: isize| -> Option<[isize; 2]> {
        let found = blocks::<BLOCK>(&before[level], step)
            .into_iter()
            .filter_map(|at| before[level].find::<BLOCK>(at, &now[level], guess, reach))
            .map(|by| by.map(|v| v as f32));
        let found: Vec<[f32; 2]> = found.collect();
        let centre = most_agreed(&found, 1.0)?;
        let inside: Vec<&[f32; 2]> = found.iter().filter(|by| near(&centre, by, 1.0)).collect();
        // Neighbours of the right place agree with it as well: their mean, not any of them.
        let mean = |axis: usize| inside.iter().map(|by| by[axis]).sum::<f32>() / inside.len() as f32;
        Some([0, 1].map(|axis| (2.0 * mean(axis)).round() as isize))
    };
    let all = blocks::<BLOCK>(&before[1], BLOCK);
    let staying = all.iter().filter(|at| before[1].stays::<BLOCK>(**at, &now[1])).count();
    let guess = if 2 * staying > all.len() {
        // A camera that stands still, or hardly moves: nothing has to be looked for.
        Some([0, 0])
    } else {
        search(2, BLOCK / 2, [0, 0], REACH).and_then(|guess| search(1, BLOCK, guess, 2))
    };
    let Some(guess) = guess else { return vec![] };
    const SIDE: usize = 2 * BLOCK;
    let moves = blocks::<SIDE>(&before[0], SIDE).into_iter();
    moves.filter_map(|at| before[0].refine::<SIDE>(at, &now[0], guess)).collect()
}

fn near(a: &[f32; 2], b: &[f32; 2], bound: f32) -> bool {
    (a[0] - b[0]).abs() <= bound && (a[1] - b[1]).abs() <= bound
}

/// That of the moves that the most others are near to.
fn most_agreed(moves: &[[f32; 2]], bound: f32) -> Option<[f32; 2]> {
    let friends = |a: &[f32; 2]| moves.iter().filter(|b| near(a, b, bound)).count();
    // The first of equals, whatever the order of comparison.
    moves.iter().rev().max_by_key(|a| friends(a)).copied()
}

/// The displacement that the most agree on, and the variance of each of its parts.
fn agreed(moves: &[[f32; 2]]) -> Option<([f64; 2], [f64; 2])> {
    let centre = most_agreed(moves, AGREE)?;
    let inside: Vec<&[f32; 2]> = moves.iter().filter(|b| near(&centre, b, AGREE)).collect();
    if inside.len() < LEAST || (inside.len() as f32) < SHARE * moves.len() as f32 {
        return None;
    }
    let n = inside.len() as f64;
    let found = [0, 1].map(|axis| {
        let mut values: Vec<f64> = inside.iter().map(|m| f64::from(m[axis])).collect();
        let middle = median(&mut values);
        let mean_square = values.iter().map(|v| (v - middle).powi(2)).sum::<f64>() / n;
        (middle, FRAC_PI_2 * mean_square / n + PRECISION * PRECISION)
    });
    Some((found.map(|(middle, _)| middle), found.map(|(_, variance)| variance)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::types::{Plane, YuvMatrix, YuvRange};
    use std::sync::Arc;

    /// A window of 640 x 480 at `(x, y)` into a scene of smooth random texture, with `people` dark blocks that
    /// stay where they are in the picture.
    fn window(x: f64, y: f64, people: usize, brighter: f64) -> Image {
        let (width, height) = (640usize, 480usize);
        let wave = |u: f64, v: f64| {
            let waves =
                [(0.031, 0.017, 0.3), (0.011, -0.043, 1.1), (-0.053, 0.029, 2.0), (0.083, 0.061, 0.7)];
            waves.iter().map(|(a, b, c)| (a * u + b * v + c).sin()).sum::<f64>()
        };
        let mut bytes = vec![128u8; width * height * 3 / 2];
        for row in 0..height {
            for column in 0..width {
                let value = 120.0 + brighter + 22.0 * wave(column as f64 + x, row as f64 + y);
                bytes[row * width + column] = value.clamp(0.0, 255.0) as u8;
            }
        }
        for person in 0..people {
            let (left, top) = (60 + 110 * person, 150 + 20 * person);
            for row in top..top + 200 {
                for column in left..left + 70 {
                    bytes[row * width + column] = (40 + (row * 7 + column * 13) % 60) as u8;
                }
            }
        }
        let planes = [
            Plane { offset: 0, stride: width },
            Plane { offset: width * height, stride: width / 2 },
            Plane { offset: width * height * 5 / 4, stride: width / 2 },
        ];
        Image::i420((640, 480), YuvRange::Limited, YuvMatrix::Bt601, planes, Arc::new(bytes))
            .expect("a picture")
    }

    #[test]
    fn a_panning_camera_is_followed_whatever_moves_with_it() {
        for (dx, dy, people, brighter) in [
            (0.0, 0.0, 0, 0.0),
            (8.0, 0.0, 0, 0.0),
            (-13.5, 6.5, 3, 0.0),
            (1.5, -2.0, 3, 20.0),
            (60.0, 40.0, 0, 0.0),
        ] {
            let mut egomotion = Egomotion::default();
            assert_eq!(egomotion.next(&window(300.0, 300.0, people, 0.0)), None, "nothing to compare with");
            // The scene moves against the camera.
            let found = egomotion.next(&window(300.0 - dx, 300.0 - dy, people, brighter)).expect("a shift");
            let [fx, fy] = found.by;
            // Blocks that show a person in part pull towards where the person goes: nowhere.
            let bound = if people > 0 { 1.5 } else { 0.3 };
            assert!((fx - dx).hypot(fy - dy) < bound, "({fx}, {fy}), really ({dx}, {dy})");
            let still = dx == 0.0 && dy == 0.0;
            assert_eq!(still, found == Shift::default(), "{found:?}");
            assert!(still || found.variance.iter().all(|v| *v > 0.0 && *v < 1.0), "{found:?}");
        }
    }

    #[test]
    fn means_are_those_of_a_division() {
        for scale in [1, 2, 3, 4, 7, 8, 12, 24, 100, 256] {
            let (mean, area) = (Mean::of(scale), (scale * scale) as u32);
            for sum in (0..=255 * area).step_by(area.div_ceil(97) as usize).chain([255 * area, area - 1]) {
                // Spread over columns, whichever way.
                let mut columns = vec![(sum / scale as u32) as u16; scale];
                columns[0] += (sum % scale as u32) as u16;
                assert_eq!(mean.of_cell(&columns), (sum * UNIT / area) as i16, "{sum} / {area}");
            }
        }
    }

    #[test]
    fn where_little_is_to_be_seen_there_is_no_answer() {
        let mut egomotion = Egomotion::default();
        let blank = Image::i420(
            (640, 480),
            YuvRange::Limited,
            YuvMatrix::Bt601,
            [
                Plane { offset: 0, stride: 640 },
                Plane { offset: 0, stride: 320 },
                Plane { offset: 0, stride: 320 },
            ],
            Arc::new(vec![90u8; 640 * 480]),
        )
        .expect("a picture");
        egomotion.next(&blank);
        assert_eq!(egomotion.next(&blank), None, "a blank wall");
        egomotion.next(&window(0.0, 0.0, 0, 0.0));
        assert_eq!(egomotion.next(&window(9000.0, 5000.0, 0, 0.0)), None, "another scene");
        let tiny = Image::i420(
            (3, 2),
            YuvRange::Full,
            YuvMatrix::Bt601,
            [Plane { offset: 0, stride: 3 }, Plane { offset: 0, stride: 2 }, Plane { offset: 0, stride: 2 }],
            Arc::new(vec![9u8; 6]),
        )
        .expect("a picture");
        for _ in 0..2 {
            assert_eq!(egomotion.next(&tiny), None, "another size, and no block in it");
        }
    }
}
