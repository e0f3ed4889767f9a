//! How a frame lies in a detector's input, and the way back to frame pixels.

use crate::infer::{Fit, InputSpec, Placement};
use crate::types::BBox;

/// A frame's place in the input: `input = frame * scale + offset`, in pixels.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Letterbox {
    pub place: Placement,
    scale: [f64; 2],
    offset: [f64; 2],
}

impl Letterbox {
    /// Fits a `frame` (width, height) into at most `size` (width, height).
    ///
    /// With `shrink`, the input itself becomes as small as the frame's shape allows: a 16:9 frame in
    /// a 352x288 input covers 198 rows, and 352x224 saves a fifth of the work.
    pub(super) fn new(spec: &InputSpec, size: (usize, usize), frame: (u32, u32), shrink: bool) -> Self {
        let (width, height) = size;
        let (fw, fh) = (f64::from(frame.0), f64::from(frame.1));
        if spec.resize == Fit::Stretch {
            let place = Placement { width, height, x: 0, y: 0, w: width, h: height };
            return Self { place, scale: [width as f64 / fw, height as f64 / fh], offset: [0.0; 2] };
        }
        let scale = (width as f64 / fw).min(height as f64 / fh);
        let fitted = |length: f64, most: usize| ((length * scale).round() as usize).clamp(1, most);
        let (w, h) = (fitted(fw, width), fitted(fh, height));
        let (width, height) = if shrink {
            (w.next_multiple_of(spec.multiple).min(width), h.next_multiple_of(spec.multiple).min(height))
        } else {
            size
        };
        let (x, y) =
            if spec.resize == Fit::LetterboxCentre { ((width - w) / 2, (height - h) / 2) } else { (0, 0) };
        // The picture was stretched to whole pixels: the way back uses what really happened.
        Self {
            place: Placement { width, height, x, y, w, h },
            scale: [w as f64 / fw, h as f64 / fh],
            offset: [x as f64, y as f64],
        }
    }

    /// A box of the input, given by its corners, in pixels of the frame.
    pub(super) fn frame_box(&self, [x0, y0, x1, y1]: [f32; 4]) -> BBox {
        let back = |value: f32, axis: usize| (f64::from(value) - self.offset[axis]) / self.scale[axis];
        let (left, top) = (back(x0, 0), back(y0, 1));
        BBox::new(left, top, back(x1, 0) - left, back(y1, 1) - top)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::infer::{ColourOrder, Dim};

    fn spec(resize: Fit) -> InputSpec {
        InputSpec {
            name: "images".into(),
            shape: ["batch", "3", "height", "width"].map(|d| Dim::Dynamic(d.into())).to_vec(),
            width: 352,
            height: 288,
            multiple: 32,
            colour: ColourOrder::Bgr,
            mean: [0.0; 3],
            std: [1.0; 3],
            resize,
            pad: 0.0,
        }
    }

    #[test]
    fn places_of_known_frames() {
        use Fit::*;
        for (fit, frame, shrink, expected) in [
            (LetterboxTopLeft, (640, 480), true, [352, 288, 0, 0, 352, 264]),
            (LetterboxTopLeft, (1920, 1080), true, [352, 224, 0, 0, 352, 198]),
            (LetterboxTopLeft, (1920, 1080), false, [352, 288, 0, 0, 352, 198]),
            (LetterboxCentre, (1920, 1080), true, [352, 224, 0, 13, 352, 198]),
            (LetterboxTopLeft, (1080, 1920), true, [192, 288, 0, 0, 162, 288]),
            (LetterboxCentre, (1, 5000), true, [32, 288, 15, 0, 1, 288]),
            (Stretch, (640, 480), true, [352, 288, 0, 0, 352, 288]),
        ] {
            let Placement { width, height, x, y, w, h } =
                Letterbox::new(&spec(fit), (352, 288), frame, shrink).place;
            assert_eq!([width, height, x, y, w, h], expected, "{fit:?} {frame:?}");
        }
    }

    #[test]
    fn the_picture_goes_back_to_the_whole_frame() {
        for fit in [Fit::LetterboxTopLeft, Fit::LetterboxCentre, Fit::Stretch] {
            for frame in [(640, 480), (1919, 1079), (33, 777), (1, 1)] {
                let letterbox = Letterbox::new(&spec(fit), (352, 288), frame, true);
                let Placement { x, y, w, h, .. } = letterbox.place;
                let found = letterbox.frame_box([x, y, x + w, y + h].map(|v| v as f32));
                let expected = BBox::new(0.0, 0.0, frame.0.into(), frame.1.into());
                assert!(found.iou(&expected) > 1.0 - 1e-9, "{fit:?} {frame:?}: {found:?}");
            }
        }
    }
}
