//! A decoded frame: planar YUV 4:2:0 as the decoder left it, shared without copying.

use std::fmt;
use std::sync::Arc;
use std::time::Instant;

use super::{CameraId, CaptureTime, Epoch, MediaTime};

/// Memory that holds a picture: a decoder's mapped buffer or a plain vector.
pub trait PixelBuffer: Send + Sync {
    /// All bytes of all planes.
    fn bytes(&self) -> &[u8];
}

impl PixelBuffer for Vec<u8> {
    fn bytes(&self) -> &[u8] {
        self
    }
}

/// One plane within a [`PixelBuffer`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Plane {
    /// Offset of the first row.
    pub offset: usize,
    /// Bytes from one row to the next (at least the width).
    pub stride: usize,
}

/// Whether luma uses 16..=235 or 0..=255.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum YuvRange {
    /// 16..=235, what video usually is.
    Limited,
    /// 0..=255.
    Full,
}

/// The YUV matrix.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum YuvMatrix {
    /// Standard definition.
    Bt601,
    /// High definition.
    Bt709,
}

/// A picture in I420 (planes Y, U, V; chroma halved both ways, rounded up). Cloning shares pixels.
#[derive(Clone)]
pub struct Image {
    /// Width in pixels, at least 1.
    pub width: u32,
    /// Height in pixels, at least 1.
    pub height: u32,
    /// Value range.
    pub range: YuvRange,
    /// Colour matrix.
    pub matrix: YuvMatrix,
    planes: [Plane; 3],
    buffer: Arc<dyn PixelBuffer>,
}

impl Image {
    /// Wraps I420 planes. `None` when a plane does not fit its buffer or the picture is empty.
    pub fn i420(
        (width, height): (u32, u32),
        range: YuvRange,
        matrix: YuvMatrix,
        planes: [Plane; 3],
        buffer: Arc<dyn PixelBuffer>,
    ) -> Option<Self> {
        let image = Self { width, height, range, matrix, planes, buffer };
        let fits = (0..3).all(|i| {
            let (w, h) = image.plane_size(i);
            let Plane { offset, stride } = planes[i];
            w > 0
                && h > 0
                && stride >= w
                && (h - 1)
                    .checked_mul(stride)
                    .and_then(|n| n.checked_add(offset + w))
                    .is_some_and(|end| end <= image.buffer.bytes().len())
        });
        fits.then_some(image)
    }

    /// Width and height of plane `index` (0 = Y, 1 = U, 2 = V).
    pub fn plane_size(&self, index: usize) -> (usize, usize) {
        let (w, h) = (self.width as usize, self.height as usize);
        if index == 0 { (w, h) } else { (w.div_ceil(2), h.div_ceil(2)) }
    }

    /// The bytes of plane `index` from its first row on, and its stride. The last row may end at
    /// its last pixel, short of a whole stride.
    pub fn plane(&self, index: usize) -> (&[u8], usize) {
        let Plane { offset, stride } = self.planes[index];
        let (w, h) = self.plane_size(index);
        (&self.buffer.bytes()[offset..offset + (h - 1) * stride + w], stride)
    }
}

impl fmt::Debug for Image {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Image({}x{} I420 {:?} {:?})", self.width, self.height, self.range, self.matrix)
    }
}

/// A decoded frame of a camera.
#[derive(Clone, Debug)]
pub struct Frame {
    /// Whose.
    pub camera: CameraId,
    /// The generation of track ids that it belongs to.
    pub epoch: Epoch,
    /// 0-based index of the decoded frame within the epoch; frames that are dropped later count.
    pub index: u64,
    /// Place on the camera's time line.
    pub time: MediaTime,
    /// When it was captured.
    pub capture: CaptureTime,
    /// When it left the decoder: the start of the latency measured here.
    pub decoded: Instant,
    /// The picture.
    pub image: Image,
}
