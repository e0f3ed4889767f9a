//! Picture to tensor: a part of an I420 frame, resized and normalised, straight into planar f32.
//!
//! The three planes are resized as they are (a 352x288 tensor needs a tenth of the pixels of a
//! 1080p frame), then colour conversion and normalisation are one pass over the small picture.

use fast_image_resize as fir;
use fir::images::TypedImage;
use fir::pixels::U8;
use fir::{FilterType, ImageView, ResizeAlg, ResizeOptions, Resizer};

use super::manifest::{ColourOrder, InputSpec};
use crate::types::{BBox, Image, YuvMatrix, YuvRange};

/// How far a picture may shrink by interpolating between the four nearest pixels alone. Beyond it
/// whole pixels would be skipped, and a convolution over all of them is worth its time.
const INTERPOLATE_UP_TO: f64 = 2.0;

/// Resizes parts of frames; keeps its buffers between calls.
pub(crate) struct Rasteriser {
    resizer: Resizer,
    planes: [Vec<u8>; 3],
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
        Self { resizer: Resizer::new(), planes: [vec![], vec![], vec![]] }
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
        self.resize(image, from, w, h);
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
        let (first, rest) = tensor.split_at_mut(width * height);
        let (second, third) = rest.split_at_mut(width * height);
        for row in 0..h {
            let at = (y + row) * width + x;
            let [ys, us, vs] = self.planes.each_ref().map(|plane| &plane[row * w..(row + 1) * w]);
            convert_row(
                &matrix,
                [ys, us, vs],
                [&mut first[at..at + w], &mut second[at..at + w], &mut third[at..at + w]],
            );
        }
    }

    /// Brings the part `from` of every plane to `w` x `h`.
    fn resize(&mut self, image: &Image, from: BBox, w: usize, h: usize) {
        for index in 0..3 {
            let (bytes, stride) = image.plane(index);
            let (plane_w, plane_h) = image.plane_size(index);
            let view = StridedPlane { bytes, stride, width: plane_w as u32, height: plane_h as u32 };
            // Chroma has half the pixels; an odd last one is a whole pixel of the plane.
            let part = if index == 0 { 1.0 } else { 0.5 };
            let (left, top) = (from.x * part, from.y * part);
            let crop_w = (from.w * part).min(plane_w as f64 - left);
            let crop_h = (from.h * part).min(plane_h as f64 - top);
            let shrink = (crop_w / w as f64).max(crop_h / h as f64);
            let alg = if shrink <= INTERPOLATE_UP_TO {
                ResizeAlg::Interpolation(FilterType::Bilinear)
            } else {
                ResizeAlg::Convolution(FilterType::Bilinear)
            };
            let options = ResizeOptions::new().resize_alg(alg).crop(left, top, crop_w, crop_h);
            let plane = &mut self.planes[index];
            plane.resize(w * h, 0);
            let mut to = TypedImage::<U8>::from_buffer(w as u32, h as u32, plane)
                .expect("a buffer of the size that was just set");
            self.resizer.resize_typed(&view, &mut to, &options).expect("a part inside the plane");
        }
    }
}

/// A plane as the decoder left it.
struct StridedPlane<'a> {
    bytes: &'a [u8],
    stride: usize,
    width: u32,
    height: u32,
}

// SAFETY: every row is cut to exactly `width` pixels, or indexing panics.
unsafe impl ImageView for StridedPlane<'_> {
    type Pixel = U8;

    fn width(&self) -> u32 {
        self.width
    }

    fn height(&self) -> u32 {
        self.height
    }

    fn iter_rows(&self, start_row: u32) -> impl Iterator<Item = &[U8]> {
        let width = self.width as usize;
        (start_row as usize..self.height as usize).map(move |row| {
            let row = &self.bytes[row * self.stride..][..width];
            // SAFETY: `U8` is a transparent wrapper of one `u8`.
            unsafe { std::slice::from_raw_parts(row.as_ptr().cast::<U8>(), row.len()) }
        })
    }
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

#[inline(always)]
fn convert(matrix: &ColourMatrix, [ys, us, vs]: [&[u8]; 3], channels: [&mut [f32]; 3]) {
    for (c, out) in channels.into_iter().enumerate() {
        let (ky, ku, kv, bias) = (matrix.y[c], matrix.u[c], matrix.v[c], matrix.bias[c]);
        let (low, high) = (matrix.low[c], matrix.high[c]);
        for (((out, &y), &u), &v) in out.iter_mut().zip(ys).zip(us).zip(vs) {
            let value = f32::from(y) * ky + f32::from(u) * ku + f32::from(v) * kv + bias;
            *out = value.max(low).min(high);
        }
    }
}

/// One row; the same loop compiled for AVX2 where the machine has it.
fn convert_row(matrix: &ColourMatrix, planes: [&[u8]; 3], channels: [&mut [f32]; 3]) {
    #[cfg(target_arch = "x86_64")]
    {
        #[target_feature(enable = "avx2")]
        fn convert_avx2(matrix: &ColourMatrix, planes: [&[u8]; 3], channels: [&mut [f32]; 3]) {
            convert(matrix, planes, channels);
        }
        if std::arch::is_x86_feature_detected!("avx2") {
            // SAFETY: the machine has AVX2.
            return unsafe { convert_avx2(matrix, planes, channels) };
        }
    }
    convert(matrix, planes, channels);
}
