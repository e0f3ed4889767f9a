//! One plane of a picture, row by row at another size.
//!
//! A picture that shrinks more than twofold is first averaged over blocks of 2, 4, … pixels; between
//! what is left, the nearest two pixels each way are interpolated. Next to a general resizer this
//! leaves out what a detector's input does not need (on two videos with ground truth, interpolation,
//! area averaging and a triangle filter give the same average precision within 0.003), and it is
//! several times faster: rows are joined first, as whole vectors, and only the columns that the output
//! has are then picked.

use crate::types::Image;

/// Blocks are of at most `2^8` pixels, so that sums fit 16 bits.
const MAX_LEVEL: u32 = 8;
/// Sum of the integer weights of one output row.
const UNIT: u16 = 256;

/// Where the output's pixels lie along one axis of a plane.
#[derive(Clone, Debug, Default)]
pub(super) struct Axis {
    /// Blocks are of `2^level` pixels.
    level: u32,
    /// The first pixel that is looked at, and how many blocks from there on.
    first: usize,
    blocks: usize,
    /// For every output pixel its nearer block to the left (or above), and how near the next one is.
    at: Vec<u32>,
    towards: Vec<f32>,
}

impl Axis {
    /// Lays `out` pixels over `length` pixels from `start` on, of a plane with `size` pixels.
    pub(super) fn set(&mut self, (start, length): (f64, f64), size: usize, out: usize) {
        let scale = length / out as f64;
        let most = size.ilog2().min(MAX_LEVEL);
        self.level = if scale < 2.0 { 0 } else { (scale.log2() as u32).min(most) };
        let block = (1usize << self.level) as f64;
        let last = (size >> self.level) - 1;
        let position = |i: usize| {
            let centre = start + (i as f64 + 0.5) * scale;
            (centre / block - 0.5).clamp(0.0, last as f64)
        };
        let first = position(0) as usize;
        self.first = first << self.level;
        self.blocks = (position(out - 1) as usize + 1).min(last) - first + 1;
        self.at.clear();
        self.towards.clear();
        for position in (0..out).map(position) {
            let at = position as usize;
            self.at.push((at - first) as u32);
            self.towards.push((position - at as f64) as f32);
        }
    }
}

/// Reads the rows of one plane at another size.
#[derive(Default)]
pub(super) struct PlaneScaler {
    pub across: Axis,
    pub down: Axis,
    line: Vec<u16>,
    halved: Vec<u16>,
}

impl PlaneScaler {
    /// Writes output row `row` of plane `index` to `out`, values `0.0..=255.0`. With `AVX2` the machine
    /// must have it.
    #[inline(always)]
    pub(super) fn row<const AVX2: bool>(&mut self, image: &Image, index: usize, row: usize, out: &mut [f32]) {
        let (bytes, stride) = image.plane(index);
        let Axis { level: across, first, blocks, .. } = self.across;
        let width = blocks << across;
        // One more than there are blocks: the last one's neighbour has no weight, but is read.
        self.line.resize(width + 1, 0);
        let line = &mut self.line[..width];

        let rows = 1usize << self.down.level;
        let top = self.down.first + ((self.down.at[row] as usize) << self.down.level);
        let unit = UNIT >> self.down.level;
        let lower = (self.down.towards[row] * f32::from(unit) + 0.5) as u16;
        let upper = unit - lower;
        line.fill(0);
        // Two rows at a time read and write the line half as often. Plain loops: iterator adapters are
        // not inlined into code for another instruction set, and become a call a pixel.
        let count = if lower == 0 { rows } else { 2 * rows };
        let mut y = 0;
        while y < count {
            let next = (y + 1).min(count - 1);
            let weight = |y: usize| if y < rows { upper } else { lower };
            let (one, its) = (weight(y), if next > y { weight(next) } else { 0 });
            let a = &bytes[(top + y) * stride + first..][..width];
            let b = &bytes[(top + next) * stride + first..][..width];
            for i in 0..width {
                line[i] += u16::from(a[i]) * one + u16::from(b[i]) * its;
            }
            y += 2;
        }

        let mut length = width;
        self.halved.resize(width / 2, 0);
        for _ in 0..across {
            length /= 2;
            let pairs = self.line[..2 * length].chunks_exact(2);
            for (half, pair) in self.halved[..length].iter_mut().zip(pairs) {
                *half = ((u32::from(pair[0]) + u32::from(pair[1])) / 2) as u16;
            }
            self.line[..length].copy_from_slice(&self.halved[..length]);
        }
        self.line[blocks] = self.line[blocks - 1];
        let line = &self.line[..blocks + 1];
        #[cfg(target_arch = "x86_64")]
        if AVX2 {
            // SAFETY: the machine has AVX2, and every place has a block to its right in `line`, which is
            // what `Axis::set` makes and the extra block is for.
            return unsafe { pick_avx2(line, &self.across, out) };
        }
        pick(line, &self.across, 0, out);
    }
}

/// Interpolates between the blocks of a joined row, from output pixel `from` on.
#[inline(always)]
fn pick(line: &[u16], across: &Axis, from: usize, out: &mut [f32]) {
    let (at, towards) = (&across.at[..out.len()], &across.towards[..out.len()]);
    for i in from..out.len() {
        let place = at[i] as usize;
        let (left, right) = (f32::from(line[place]), f32::from(line[place + 1]));
        out[i] = (left + (right - left) * towards[i]) * (1.0 / UNIT as f32);
    }
}

/// [`pick`], eight at a time: one gather brings a block and its right neighbour.
///
/// # Safety
/// `line` must have an element after every place of `across`.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
unsafe fn pick_avx2(line: &[u16], across: &Axis, out: &mut [f32]) {
    use std::arch::x86_64::*;
    debug_assert!(across.at.iter().all(|&at| (at as usize) + 1 < line.len()));
    let (low, scale) = (_mm256_set1_epi32(0xffff), _mm256_set1_ps(1.0 / UNIT as f32));
    let places = across.at.chunks_exact(8).zip(across.towards.chunks_exact(8));
    for (out, (at, towards)) in out.chunks_exact_mut(8).zip(places) {
        // SAFETY: the slices hold eight each; the places are inside `line` with their neighbour.
        unsafe {
            let at = _mm256_loadu_si256(at.as_ptr().cast());
            let towards = _mm256_loadu_ps(towards.as_ptr());
            let pairs = _mm256_i32gather_epi32::<2>(line.as_ptr().cast(), at);
            let left = _mm256_cvtepi32_ps(_mm256_and_si256(pairs, low));
            let right = _mm256_cvtepi32_ps(_mm256_srli_epi32::<16>(pairs));
            let between = _mm256_mul_ps(_mm256_sub_ps(right, left), towards);
            _mm256_storeu_ps(out.as_mut_ptr(), _mm256_mul_ps(_mm256_add_ps(left, between), scale));
        }
    }
    pick(line, across, out.len() / 8 * 8, out);
}
