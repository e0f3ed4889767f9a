//! Picture to tensor: a part of an I420 frame, resized and normalised, straight into planar f32.
//!
//! The three planes are brought to the output's size row by row; colour conversion and normalisation
//! are one matrix, applied while the row is in the cache.

use super::manifest::{ColourOrder, InputSpec};
use super::scale::{PlaneScaler, isa};
use crate::types::{BBox, Image, YuvMatrix, YuvRange};

/// Resizes parts of frames; keeps its buffers between calls.
pub(crate) struct Rasteriser {
    planes: [PlaneScaler; 3],
    /// One row of each plane at the output's size.
    rows: [Vec<f32>; 3],
}

/// The normalisation of a model: raw channel values `0..=255` to `value * scale + shift`, in the
/// order of the model's channels.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Normalisation {
    order: ColourOrder,
    scale: [f32; 3],
    shift: [f32; 3],
    pad: [f32; 3],
}

impl Normalisation {
    pub(crate) fn new(spec: &InputSpec) -> Self {
        let scale = spec.std.map(|std| 1.0 / std);
        let shift = [0, 1, 2].map(|c| -spec.mean[c] / spec.std[c]);
        let pad = [0, 1, 2].map(|c| spec.pad * scale[c] + shift[c]);
        Self { order: spec.colour, scale, shift, pad }
    }
}

/// Where in a `[3, height, width]` tensor a picture lies.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Placement {
    /// The tensor's width.
    pub width: usize,
    /// The tensor's height.
    pub height: usize,
    /// Left edge of the picture.
    pub x: usize,
    /// Top edge of the picture.
    pub y: usize,
    /// The picture's width.
    pub w: usize,
    /// The picture's height.
    pub h: usize,
}

impl Rasteriser {
    pub(crate) fn new() -> Self {
        Self { planes: Default::default(), rows: Default::default() }
    }

    /// Writes the part `from` of `image` (pixels, inside the picture) to its place in `tensor`, and
    /// the padding around it.
    ///
    /// # Panics
    /// When `tensor` is not `3 * width * height` long or the place lies outside it.
    pub(crate) fn write(
        &mut self,
        image: &Image,
        from: BBox,
        place: Placement,
        normalisation: &Normalisation,
        tensor: &mut [f32],
    ) {
        let Placement { width, height, x, y, w, h } = place;
        assert_eq!(tensor.len(), 3 * width * height);
        assert!(x + w <= width && y + h <= height && w > 0 && h > 0);
        for (index, plane) in self.planes.iter_mut().enumerate() {
            let (plane_w, plane_h) = image.plane_size(index);
            let part = if index == 0 { 1.0 } else { 0.5 };
            plane.across.set((from.x * part, from.w * part), plane_w, w);
            plane.down.set((from.y * part, from.h * part), plane_h, h);
            self.rows[index].resize(w, 0.0);
        }
        let matrix = ColourMatrix::new(image, normalisation);
        for channel in tensor.chunks_exact_mut(width * height).zip(normalisation.pad) {
            let (channel, pad) = channel;
            channel[..y * width].fill(pad);
            channel[(y + h) * width..].fill(pad);
            if w < width {
                for row in channel[y * width..(y + h) * width].chunks_exact_mut(width) {
                    row[..x].fill(pad);
                    row[x + w..].fill(pad);
                }
            }
        }
        let mut target = Target { tensor, width, area: width * height };
        #[cfg(target_arch = "x86_64")]
        // SAFETY: the machine has the instructions.
        unsafe {
            if std::arch::is_x86_feature_detected!("avx512bw") {
                return self.convert_avx512(image, &matrix, place, &mut target);
            }
            if std::arch::is_x86_feature_detected!("avx2") {
                return self.convert_avx2(image, &matrix, place, &mut target);
            }
        }
        self.convert::<{ isa::PLAIN }>(image, &matrix, place, &mut target);
    }

    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx512f,avx512bw")]
    fn convert_avx512(
        &mut self,
        image: &Image,
        matrix: &ColourMatrix,
        place: Placement,
        target: &mut Target<'_>,
    ) {
        self.convert::<{ isa::AVX512 }>(image, matrix, place, target);
    }

    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2")]
    fn convert_avx2(
        &mut self,
        image: &Image,
        matrix: &ColourMatrix,
        place: Placement,
        target: &mut Target<'_>,
    ) {
        self.convert::<{ isa::AVX2 }>(image, matrix, place, target);
    }

    /// Scales, converts and normalises row by row, while a row is in the cache.
    #[inline(always)]
    fn convert<const ISA: u8>(
        &mut self,
        image: &Image,
        matrix: &ColourMatrix,
        place: Placement,
        target: &mut Target<'_>,
    ) {
        let Placement { x, y, w, h, .. } = place;
        for row in 0..h {
            for (index, (plane, out)) in self.planes.iter_mut().zip(&mut self.rows).enumerate() {
                plane.row::<ISA>(image, index, row, out);
            }
            let [ys, us, vs] = &self.rows;
            for channel in 0..3 {
                let (ky, ku, kv) = (matrix.y[channel], matrix.u[channel], matrix.v[channel]);
                let (bias, low, high) = (matrix.bias[channel], matrix.low[channel], matrix.high[channel]);
                let at = channel * target.area + (y + row) * target.width + x;
                let out = &mut target.tensor[at..at + w];
                let (ys, us, vs) = (&ys[..w], &us[..w], &vs[..w]);
                for i in 0..w {
                    let value = ys[i] * ky + us[i] * ku + vs[i] * kv + bias;
                    // As comparisons these are one instruction each; `max` and `min` mind NaN.
                    let value = if value > low { value } else { low };
                    out[i] = if value < high { value } else { high };
                }
            }
        }
    }
}

/// A `[3, height, width]` tensor.
struct Target<'a> {
    tensor: &'a mut [f32],
    width: usize,
    /// `width * height`.
    area: usize,
}

/// YUV to the model's channels: `y * Y + u * U + v * V + bias`, held within `[low, high]`, which are
/// the channel's 0 and 255 after normalisation.
#[derive(Clone, Copy, Debug)]
struct ColourMatrix {
    y: [f32; 3],
    u: [f32; 3],
    v: [f32; 3],
    bias: [f32; 3],
    low: [f32; 3],
    high: [f32; 3],
}

/// Coefficients of `R, G, B = y (Y - black) + u (U - 128) + v (V - 128)` and `black`.
pub(crate) fn yuv_to_rgb(image: &Image) -> ([f32; 3], [f32; 3], [f32; 3], f32) {
    let (kr, kb) = match image.matrix {
        YuvMatrix::Bt601 => (0.299, 0.114),
        YuvMatrix::Bt709 => (0.2126, 0.0722),
    };
    let kg = 1.0 - kr - kb;
    let (luma, chroma, black) = match image.range {
        YuvRange::Limited => (255.0 / 219.0, 255.0 / 224.0, 16.0),
        YuvRange::Full => (1.0, 1.0, 0.0),
    };
    let (r, b) = (2.0 * (1.0 - kr), 2.0 * (1.0 - kb));
    ([luma; 3], [0.0, -chroma * b * kb / kg, chroma * b], [chroma * r, -chroma * r * kr / kg, 0.0], black)
}

impl ColourMatrix {
    fn new(image: &Image, normalisation: &Normalisation) -> Self {
        let (y, u, v, black) = yuv_to_rgb(image);
        let Normalisation { order, scale, shift, .. } = *normalisation;
        let source = |channel: usize| match order {
            ColourOrder::Rgb => channel,
            ColourOrder::Bgr => 2 - channel,
        };
        let part = |coefficients: [f32; 3]| [0, 1, 2].map(|c| coefficients[source(c)] * scale[c]);
        let (y, u, v) = (part(y), part(u), part(v));
        let bias = [0, 1, 2].map(|c| shift[c] - y[c] * black - (u[c] + v[c]) * 128.0);
        let high = [0, 1, 2].map(|c| 255.0 * scale[c] + shift[c]);
        Self { y, u, v, bias, low: shift, high }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::types::Plane;

    /// A picture with a smooth pattern, rows longer than the picture, and the last row cut off.
    fn picture(width: u32, height: u32, range: YuvRange, matrix: YuvMatrix) -> Image {
        let mut bytes = vec![];
        let planes = [
            (width, height, 7),
            (width.div_ceil(2), height.div_ceil(2), 5),
            (width.div_ceil(2), height.div_ceil(2), 3),
        ]
        .map(|(w, h, extra)| {
            let plane = Plane { offset: bytes.len(), stride: w as usize + extra };
            for y in 0..h {
                for x in 0..w {
                    let (x, y) = (f64::from(x), f64::from(y));
                    let wave = (x * 0.21 + extra as f64).sin() * 60.0 + (y * 0.17).cos() * 50.0;
                    bytes.push((128.0 + wave) as u8);
                }
                if y + 1 < h {
                    bytes.extend(vec![255; extra]);
                }
            }
            plane
        });
        Image::i420((width, height), range, matrix, planes, Arc::new(bytes)).expect("a picture")
    }

    /// A plane at output pixel `(i, j)`: the mean of blocks, interpolated.
    fn sample(
        image: &Image,
        index: usize,
        from: BBox,
        (w, h): (usize, usize),
        (i, j): (usize, usize),
    ) -> f64 {
        let (bytes, stride) = image.plane(index);
        let (plane_w, plane_h) = image.plane_size(index);
        let part = if index == 0 { 1.0 } else { 0.5 };
        let weights = |start: f64, length: f64, out: usize, outs: usize, size: usize| {
            let scale = length / outs as f64;
            let mut block = 1;
            while (2 * block) as f64 <= scale && block < 256 {
                block *= 2;
            }
            let blocks = size / block;
            let centre =
                ((start + (out as f64 + 0.5) * scale) / block as f64).clamp(0.5, blocks as f64 - 0.5);
            (0..blocks * block)
                .map(|x| (1.0 - ((x / block) as f64 + 0.5 - centre).abs()).max(0.0) / block as f64)
                .collect::<Vec<f64>>()
        };
        let across = weights(from.x * part, from.w * part, i, w, plane_w);
        let down = weights(from.y * part, from.h * part, j, h, plane_h);
        let mut sum = 0.0;
        for (y, wy) in down.iter().enumerate().filter(|(_, w)| **w > 0.0) {
            for (x, wx) in across.iter().enumerate().filter(|(_, w)| **w > 0.0) {
                sum += wx * wy * f64::from(bytes[y * stride + x]);
            }
        }
        sum
    }

    /// Red, green, blue by the textbook.
    fn rgb(image: &Image, y: f64, u: f64, v: f64) -> [f64; 3] {
        let (kr, kb) = if image.matrix == YuvMatrix::Bt601 { (0.299, 0.114) } else { (0.2126, 0.0722) };
        let (y, cb, cr) = match image.range {
            YuvRange::Full => (y, u - 128.0, v - 128.0),
            YuvRange::Limited => {
                ((y - 16.0) * 255.0 / 219.0, (u - 128.0) * 255.0 / 224.0, (v - 128.0) * 255.0 / 224.0)
            }
        };
        let r = y + 2.0 * (1.0 - kr) * cr;
        let b = y + 2.0 * (1.0 - kb) * cb;
        let g = (y - kr * r - kb * b) / (1.0 - kr - kb);
        [r, g, b].map(|value| value.clamp(0.0, 255.0))
    }

    #[test]
    fn equals_a_plain_implementation() {
        use {ColourOrder::*, YuvMatrix::*, YuvRange::*};
        let whole = |w: u32, h: u32| BBox::new(0.0, 0.0, w.into(), h.into());
        let wide = Placement { width: 40, height: 32, x: 4, y: 2, w: 32, h: 24 };
        let full = Placement { width: 24, height: 16, x: 0, y: 0, w: 24, h: 16 };
        let mut rasteriser = Rasteriser::new();
        for (size, range, matrix, from, place, order) in [
            ((64, 48), Limited, Bt601, whole(64, 48), wide, Bgr),
            ((64, 48), Full, Bt709, whole(64, 48), wide, Rgb),
            ((201, 151), Limited, Bt709, whole(201, 151), wide, Rgb),
            ((201, 151), Limited, Bt601, BBox::new(20.5, 30.25, 100.0, 60.0), full, Bgr),
            ((33, 17), Full, Bt601, whole(33, 17), wide, Bgr),
            ((90, 90), Limited, Bt601, BBox::new(10.0, 12.0, 15.0, 40.0), full, Rgb),
            ((90, 90), Limited, Bt601, BBox::new(80.0, 85.0, 10.0, 5.0), full, Rgb),
            ((500, 300), Full, Bt601, whole(500, 300), wide, Rgb),
            ((1, 1), Full, Bt601, whole(1, 1), wide, Rgb),
            ((3, 100), Limited, Bt601, whole(3, 100), full, Rgb),
            // Further apart than a vector reaches.
            ((30000, 2), Full, Bt601, whole(30000, 2), full, Rgb),
        ] {
            let image = picture(size.0, size.1, range, matrix);
            let normalisation = Normalisation::new(&InputSpec {
                name: "images".into(),
                shape: vec![],
                width: place.width,
                height: place.height,
                multiple: 1,
                colour: order,
                mean: [100.0, 110.0, 120.0],
                std: [50.0, 60.0, 70.0],
                resize: crate::infer::Fit::Stretch,
                pad: 114.0,
            });
            let mut tensor = vec![f32::NAN; 3 * place.width * place.height];
            rasteriser.write(&image, from, place, &normalisation, &mut tensor);
            // Whatever the machine has, the result is the same.
            let matrix = ColourMatrix::new(&image, &normalisation);
            let mut again =
                |convert: fn(&mut Rasteriser, &Image, &ColourMatrix, Placement, &mut Target<'_>)| {
                    let mut other = tensor.clone();
                    let mut target =
                        Target { tensor: &mut other, width: place.width, area: place.width * place.height };
                    convert(&mut rasteriser, &image, &matrix, place, &mut target);
                    assert_eq!(tensor, other);
                };
            again(Rasteriser::convert::<{ isa::PLAIN }>);
            #[cfg(target_arch = "x86_64")]
            if std::arch::is_x86_feature_detected!("avx2") {
                // SAFETY: the machine has the instructions.
                again(|this, image, matrix, place, target| unsafe {
                    this.convert_avx2(image, matrix, place, target);
                });
            }
            let (mut worst, mut total) = (0f64, 0f64);
            for y in 0..place.height {
                for x in 0..place.width {
                    let inside = (place.x..place.x + place.w).contains(&x)
                        && (place.y..place.y + place.h).contains(&y);
                    let expected = if inside {
                        let at = (x - place.x, y - place.y);
                        let [y, u, v] =
                            [0, 1, 2].map(|plane| sample(&image, plane, from, (place.w, place.h), at));
                        rgb(&image, y, u, v)
                    } else {
                        [114.0; 3]
                    };
                    for channel in 0..3 {
                        let colour = if order == Rgb { channel } else { 2 - channel };
                        let raw = f64::from(tensor[(channel * place.height + y) * place.width + x])
                            * [50.0, 60.0, 70.0][channel]
                            + [100.0, 110.0, 120.0][channel];
                        let error = (raw - expected[colour]).abs();
                        assert!(inside || error < 1e-3, "padding at {x},{y}: {raw}");
                        worst = worst.max(error);
                        total += error;
                    }
                }
            }
            // Rows are joined with weights of 8 bits.
            let mean = total / tensor.len() as f64;
            assert!(worst < 1.0 && mean < 0.2, "{size:?} {range:?} {matrix:?}: worst {worst}, mean {mean}");
        }
    }
}
