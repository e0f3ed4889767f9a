//! Pictures for people: I420 to RGB, smaller, JPEG.

use std::io;
use std::sync::Arc;

use fast_image_resize::images::{Image as Resized, ImageRef};
use fast_image_resize::{FilterType, PixelType, ResizeAlg, ResizeOptions, Resizer};
use jpeg_encoder::{ColorType, Encoder};
use yuv::{YuvPlanarImage, YuvStandardMatrix};

use super::mask::{Masks, hide};
use crate::analytics::Mask;
use crate::types::{Frame, FrameTracks, Image, YuvMatrix, YuvRange};

/// A frame together with what the tracker said about it. Its pixels are seen through its camera's masks alone.
#[derive(Clone, Debug)]
pub struct Picture {
    frame: Arc<Frame>,
    masks: Masks,
    /// Its tracks.
    pub tracks: Arc<FrameTracks>,
}

impl Picture {
    /// Of a camera with `masks`.
    pub fn new(frame: Arc<Frame>, tracks: Arc<FrameTracks>, masks: Masks) -> Self {
        Self { frame, masks, tracks }
    }

    /// Width and height of the frame.
    pub fn size(&self) -> (u32, u32) {
        (self.frame.image.width, self.frame.image.height)
    }

    /// The masks of its camera.
    pub fn masks(&self) -> &Masks {
        &self.masks
    }
}

/// A picture in packed RGB: 3 bytes a pixel, rows without padding.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Rgb {
    /// Width in pixels.
    pub width: usize,
    /// Height in pixels.
    pub height: usize,
    /// `width * height * 3` bytes.
    pub data: Vec<u8>,
}

/// Why a picture could not be made.
#[derive(Debug, thiserror::Error)]
pub enum PictureError {
    /// The planes do not make a picture.
    #[error("converting a {0}x{1} picture to RGB failed: {2}")]
    Convert(u32, u32, String),
    /// The picture could not be scaled.
    #[error("scaling a picture to {0}x{1} failed: {2}")]
    Scale(usize, usize, String),
    /// The picture is larger than JPEG can be, or empty.
    #[error("encoding a {0}x{1} picture as JPEG failed: {2}")]
    Encode(usize, usize, String),
}

impl Rgb {
    fn resize(&mut self, width: usize, height: usize) {
        (self.width, self.height) = (width, height);
        self.data.resize(width * height * 3, 0);
    }

    /// The pixel at `(x, y)`, which must be inside.
    pub fn pixel(&self, x: usize, y: usize) -> [u8; 3] {
        let at = (y * self.width + x) * 3;
        [self.data[at], self.data[at + 1], self.data[at + 2]]
    }

    /// What of it is between `left, top, right, bottom`; empty when that is outside.
    pub fn part(&self, [left, top, right, bottom]: [f64; 4]) -> Rgb {
        // `as` saturates: what is negative or NaN is 0.
        let clamp = |from: f64, to: f64, size: usize| {
            let from = (from.floor() as usize).min(size);
            from..(to.ceil() as usize).clamp(from, size)
        };
        let (columns, rows) = (clamp(left, right, self.width), clamp(top, bottom, self.height));
        let (width, height) = (columns.len(), rows.len());
        let row = |y: usize| {
            let start = (y * self.width + columns.start) * 3;
            &self.data[start..start + width * 3]
        };
        Rgb { width, height, data: rows.flat_map(row).copied().collect() }
    }

    /// This picture as JPEG (4:2:0 below quality 90).
    ///
    /// # Errors
    /// It is empty or has a side above 65535 pixels.
    pub fn to_jpeg(&self, quality: u8) -> Result<Vec<u8>, PictureError> {
        let fail = |why: String| PictureError::Encode(self.width, self.height, why);
        let side = |n: usize| u16::try_from(n).map_err(|_| fail("a side is above 65535 pixels".into()));
        // Surveillance pictures come out at about a tenth of their RGB size.
        let mut jpeg = Vec::with_capacity(self.data.len() / 8);
        Encoder::new(&mut jpeg, quality)
            .encode(&self.data, side(self.width)?, side(self.height)?, ColorType::Rgb)
            .map_err(|error| fail(error.to_string()))?;
        Ok(jpeg)
    }
}

/// Turns decoded pictures into RGB, keeping its buffers from one to the next.
#[derive(Default)]
pub struct RgbConverter {
    full: Rgb,
    resizer: Resizer,
}

impl RgbConverter {
    /// `picture` in full-range RGB at most `max_width` wide (its shape kept), into `out`. What its camera's masks
    /// hide now is hidden.
    ///
    /// # Errors
    /// [`PictureError::Convert`] or [`PictureError::Scale`]: the library refused the sizes.
    pub fn convert(
        &mut self,
        picture: &Picture,
        max_width: usize,
        out: &mut Rgb,
    ) -> Result<(), PictureError> {
        self.masked(&picture.frame.image, &picture.masks.now(), max_width, out)
    }

    fn masked(
        &mut self,
        image: &Image,
        masks: &[Mask],
        max_width: usize,
        out: &mut Rgb,
    ) -> Result<(), PictureError> {
        let (width, height) = (image.width as usize, image.height as usize);
        if width <= max_width {
            to_rgb(image, out)?;
            hide(out, masks);
            return Ok(());
        }
        to_rgb(image, &mut self.full)?;
        // Before it is scaled: scaling takes neighbours in.
        hide(&mut self.full, masks);
        let scaled = (height * max_width + width / 2) / width;
        out.resize(max_width, scaled.max(1));
        self.scale(out).map_err(|error| PictureError::Scale(out.width, out.height, error.to_string()))
    }

    fn scale(&mut self, out: &mut Rgb) -> Result<(), Box<dyn std::error::Error>> {
        let side = |n: usize| u32::try_from(n).map_err(io::Error::other);
        let (width, height) = (side(self.full.width)?, side(self.full.height)?);
        let source = ImageRef::new(width, height, &self.full.data, PixelType::U8x3)?;
        let (width, height) = (side(out.width)?, side(out.height)?);
        let mut target = Resized::from_slice_u8(width, height, &mut out.data, PixelType::U8x3)?;
        // Convolution, not interpolation: interpolating to a third of the size skips pixels.
        let how = ResizeOptions::new().resize_alg(ResizeAlg::Convolution(FilterType::Bilinear));
        Ok(self.resizer.resize(&source, &mut target, &how)?)
    }
}

fn to_rgb(image: &Image, out: &mut Rgb) -> Result<(), PictureError> {
    let fail = |why: String| PictureError::Convert(image.width, image.height, why);
    let stride = |n: usize| u32::try_from(n).map_err(|_| fail("a row is too long".into()));
    let [(y_plane, y_stride), (u_plane, u_stride), (v_plane, v_stride)] = [0, 1, 2].map(|i| image.plane(i));
    let planes = YuvPlanarImage {
        y_plane,
        y_stride: stride(y_stride)?,
        u_plane,
        u_stride: stride(u_stride)?,
        v_plane,
        v_stride: stride(v_stride)?,
        width: image.width,
        height: image.height,
    };
    let range = match image.range {
        YuvRange::Limited => yuv::YuvRange::Limited,
        YuvRange::Full => yuv::YuvRange::Full,
    };
    let matrix = match image.matrix {
        YuvMatrix::Bt601 => YuvStandardMatrix::Bt601,
        YuvMatrix::Bt709 => YuvStandardMatrix::Bt709,
    };
    out.resize(image.width as usize, image.height as usize);
    let row = stride(out.width * 3)?;
    yuv::yuv420_to_rgb(&planes, &mut out.data, row, range, matrix).map_err(|error| fail(error.to_string()))
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::types::Plane;

    /// A plain picture, its rows padded with a value that must not show.
    fn plain((width, height): (u32, u32), yuv: [u8; 3], range: YuvRange, matrix: YuvMatrix) -> Image {
        let (w, h) = (width as usize, height as usize);
        let sizes = [(w, h), (w.div_ceil(2), h.div_ceil(2)), (w.div_ceil(2), h.div_ceil(2))];
        let mut bytes = Vec::new();
        let planes = std::array::from_fn(|i| {
            let (w, h) = sizes[i];
            let plane = Plane { offset: bytes.len(), stride: w + 5 };
            for row in 0..h {
                bytes.extend(vec![yuv[i]; w]);
                // The last row ends at its last pixel, as a cropped decoder buffer does.
                bytes.extend(vec![77; if row + 1 < h { 5 } else { 0 }]);
            }
            plane
        });
        Image::i420((width, height), range, matrix, planes, Arc::new(bytes)).unwrap()
    }

    #[test]
    fn range_and_matrix_are_honoured() {
        use {YuvMatrix::*, YuvRange::*};
        for (yuv, range, matrix, expected) in [
            ([16, 128, 128], Limited, Bt601, [0, 0, 0]),
            ([235, 128, 128], Limited, Bt709, [255, 255, 255]),
            ([0, 128, 128], Full, Bt601, [0, 0, 0]),
            ([255, 128, 128], Full, Bt709, [255, 255, 255]),
            ([81, 90, 240], Limited, Bt601, [254, 0, 0]),
            ([63, 102, 240], Limited, Bt709, [255, 0, 0]),
        ] {
            let mut out = Rgb::default();
            let image = plain((7, 5), yuv, range, matrix);
            RgbConverter::default().masked(&image, &[], 100, &mut out).unwrap();
            for (x, y) in [(0, 0), (6, 4), (6, 0)] {
                let near = out.pixel(x, y).iter().zip(expected).all(|(a, b)| a.abs_diff(b) <= 3);
                assert!(near, "{yuv:?} {range:?} {matrix:?}: {:?}, not {expected:?}", out.pixel(x, y));
            }
        }
    }

    #[test]
    fn scaling_keeps_the_shape() {
        for (size, max_width, expected) in [
            ((1920, 1080), 960, (960, 540)),
            ((640, 480), 960, (640, 480)),
            ((961, 3), 960, (960, 3)),
            ((4000, 1), 960, (960, 1)),
            ((1, 1), 960, (1, 1)),
        ] {
            let mut out = Rgb::default();
            let image = plain(size, [235, 128, 128], YuvRange::Limited, YuvMatrix::Bt601);
            RgbConverter::default().masked(&image, &[], max_width, &mut out).unwrap();
            assert_eq!((out.width, out.height), expected);
            assert_eq!(out.data.len(), out.width * out.height * 3);
            assert!(out.data.iter().all(|v| *v >= 254), "{size:?} is white");
        }
    }

    #[test]
    fn a_part_is_cut_at_the_border() {
        let data = (0..4 * 3 * 3).map(|i| i as u8 / 3).collect();
        let whole = Rgb { width: 4, height: 3, data };
        let part = whole.part([2.5, 1.0, 99.0, 2.2]);
        assert_eq!((part.width, part.height), (2, 2));
        assert_eq!((part.pixel(0, 0)[0], part.pixel(1, 1)[2]), (6, 11));
        for outside in [[-9.0, -9.0, -1.0, -1.0], [5.0, 0.0, 9.0, 3.0], [f64::NAN; 4]] {
            let part = whole.part(outside);
            assert!(part.width * part.height == 0 && part.data.is_empty(), "{outside:?}");
        }
    }

    #[test]
    fn an_empty_picture_is_no_jpeg() {
        assert!(Rgb::default().to_jpeg(70).is_err());
    }
}
