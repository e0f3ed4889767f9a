//! One plane of a picture, row by row at another size.
//!
//! A picture that shrinks more than twofold is first averaged over blocks of 2, 4, … pixels; between
//! what is left, the nearest two pixels each way are interpolated. Next to a general resizer this
//! leaves out what a detector's input does not need (on two videos with ground truth, interpolation,
//! area averaging and a triangle filter give the same average precision within 0.003), and it is
//! several times faster: rows are joined first, as whole vectors, and only the columns that the output
//! has are then picked.

use crate::types::Image;

/// Instructions that a row is made with; the results are the same to the bit.
pub(super) mod isa {
    /// What every machine has.
    pub const PLAIN: u8 = 0;
    /// AVX2.
    pub const AVX2: u8 = 1;
    /// AVX-512 F and BW.
    pub const AVX512: u8 = 2;
}

/// Output rows that the source is fetched ahead of its use: a frame comes from another core's cache.
const AHEAD: usize = 4;
/// Elements that may be read after the last block of a line: two vectors of AVX-512.
const SLACK: usize = 64;
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
    /// For every block of 16 output pixels, counted from the first one's place: place and next place of each.
    pairs: Vec<u16>,
    /// Whether every sixteen output pixels lie within [`SLACK`] blocks; a shrinkage of more than 512 is too far.
    dense: bool,
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
        self.pairs.clear();
        for group in self.at.chunks_exact(16) {
            self.pairs.extend(group.iter().map(|at| (at - group[0]) as u16).flat_map(|at| [at, at + 1]));
        }
        self.dense = self.pairs.iter().all(|&at| usize::from(at) < SLACK);
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
    /// Writes output row `row` of plane `index` to `out`, values `0.0..=255.0`. The machine must have
    /// the instructions `ISA` (see [`isa`]).
    #[inline(always)]
    pub(super) fn row<const ISA: u8>(&mut self, image: &Image, index: usize, row: usize, out: &mut [f32]) {
        let (bytes, stride) = image.plane(index);
        let Axis { level: across, first, blocks, .. } = self.across;
        let width = blocks << across;
        // The last block's neighbour has no weight, but is read; vectors read further.
        self.line.resize(width + SLACK, 0);
        let line = &mut self.line[..width];

        let rows = 1usize << self.down.level;
        let top = self.down.first + ((self.down.at[row] as usize) << self.down.level);
        let unit = UNIT >> self.down.level;
        let lower = (self.down.towards[row] * f32::from(unit) + 0.5) as u16;
        let upper = unit - lower;
        #[cfg(target_arch = "x86_64")]
        if let Some(&at) = self.down.at.get(row + AHEAD) {
            let top = self.down.first + ((at as usize) << self.down.level);
            for line in bytes[top * stride..].chunks(stride).take(rows) {
                prefetch(&line[first..][..width]);
            }
        }
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
        let line = &self.line[..blocks + SLACK];
        #[cfg(target_arch = "x86_64")]
        // SAFETY: the machine has the instructions, every place that `Axis::set` makes is one of a block,
        // and `line` goes on for SLACK elements after the last.
        match ISA {
            isa::AVX512 if self.across.dense => return unsafe { pick_avx512(line, &self.across, out) },
            isa::AVX2 => return unsafe { pick_avx2(line, &self.across, out) },
            _ => {}
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

/// Brings bytes into the cache.
#[cfg(target_arch = "x86_64")]
#[inline(always)]
fn prefetch(bytes: &[u8]) {
    use std::arch::x86_64::{_MM_HINT_T0, _mm_prefetch};
    for at in bytes.iter().step_by(64) {
        // SAFETY: every x86-64 machine has SSE, and a prefetch never faults.
        unsafe { _mm_prefetch::<_MM_HINT_T0>(std::ptr::from_ref(at).cast()) };
    }
}

/// [`pick`], sixteen at a time: a step is less than two blocks, so sixteen lie within two vectors, and one
/// permutation takes the blocks and their right neighbours out of them.
///
/// # Safety
/// `line` must have [`SLACK`] elements from every place of `across` on.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,avx512bw")]
unsafe fn pick_avx512(line: &[u16], across: &Axis, out: &mut [f32]) {
    use std::arch::x86_64::*;
    debug_assert!(across.at.iter().all(|&at| (at as usize) + SLACK <= line.len()));
    debug_assert!(across.dense);
    let (low, scale) = (_mm512_set1_epi32(0xffff), _mm512_set1_ps(1.0 / UNIT as f32));
    let groups = across.at.chunks_exact(16).zip(across.pairs.chunks_exact(32));
    let groups = groups.zip(across.towards.chunks_exact(16));
    for (out, ((at, pairs), towards)) in out.chunks_exact_mut(16).zip(groups) {
        // SAFETY: the slices hold sixteen or thirty-two each; 64 elements follow in `line`.
        unsafe {
            let from = line.as_ptr().add(at[0] as usize);
            let near = _mm512_loadu_si512(from.cast());
            let far = _mm512_loadu_si512(from.add(32).cast());
            let places = _mm512_loadu_si512(pairs.as_ptr().cast());
            let towards = _mm512_loadu_ps(towards.as_ptr());
            let pairs = _mm512_permutex2var_epi16(near, places, far);
            let left = _mm512_cvtepi32_ps(_mm512_and_si512(pairs, low));
            let right = _mm512_cvtepi32_ps(_mm512_srli_epi32::<16>(pairs));
            let between = _mm512_mul_ps(_mm512_sub_ps(right, left), towards);
            _mm512_storeu_ps(out.as_mut_ptr(), _mm512_mul_ps(_mm512_add_ps(left, between), scale));
        }
    }
    pick(line, across, out.len() / 16 * 16, out);
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
