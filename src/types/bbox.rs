//! Axis-aligned boxes in pixels.

/// A box in pixels: top-left corner `(x, y)`, width `w` and height `h`, as MOTChallenge writes it.
///
/// The image's origin is its top-left corner; a box may reach outside the image.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct BBox {
    /// Left edge, pixels.
    pub x: f64,
    /// Top edge, pixels.
    pub y: f64,
    /// Width, pixels.
    pub w: f64,
    /// Height, pixels.
    pub h: f64,
}

impl BBox {
    /// A box from its top-left corner and size.
    pub const fn new(x: f64, y: f64, w: f64, h: f64) -> Self {
        Self { x, y, w, h }
    }

    /// A box from its centre and size.
    pub fn from_center(cx: f64, cy: f64, w: f64, h: f64) -> Self {
        Self::new(cx - w / 2.0, cy - h / 2.0, w, h)
    }

    /// Horizontal centre.
    pub fn cx(&self) -> f64 {
        self.x + self.w / 2.0
    }

    /// Vertical centre.
    pub fn cy(&self) -> f64 {
        self.y + self.h / 2.0
    }

    /// Right edge.
    pub fn right(&self) -> f64 {
        self.x + self.w
    }

    /// Bottom edge: where a standing person's feet are.
    pub fn bottom(&self) -> f64 {
        self.y + self.h
    }

    /// Area in square pixels; zero for an empty box.
    pub fn area(&self) -> f64 {
        self.w.max(0.0) * self.h.max(0.0)
    }

    /// Area shared with `other`.
    pub fn intersection(&self, other: &BBox) -> f64 {
        let w = self.right().min(other.right()) - self.x.max(other.x);
        let h = self.bottom().min(other.bottom()) - self.y.max(other.y);
        if w > 0.0 && h > 0.0 { w * h } else { 0.0 }
    }

    /// Intersection over union, in `[0, 1]`; zero when both boxes are empty.
    pub fn iou(&self, other: &BBox) -> f64 {
        let inter = self.intersection(other);
        if inter == 0.0 { 0.0 } else { inter / (self.area() + other.area() - inter) }
    }

    /// This box moved by `(dx, dy)`.
    pub fn shifted(&self, dx: f64, dy: f64) -> Self {
        Self { x: self.x + dx, y: self.y + dy, ..*self }
    }

    /// The part of this box inside a `width` x `height` image, `None` when nothing is.
    pub fn clipped(&self, width: f64, height: f64) -> Option<Self> {
        let (x0, y0) = (self.x.max(0.0), self.y.max(0.0));
        let (x1, y1) = (self.right().min(width), self.bottom().min(height));
        (x1 > x0 && y1 > y0).then(|| Self::new(x0, y0, x1 - x0, y1 - y0))
    }

    /// Whether every number is finite and the box has an area.
    pub fn is_valid(&self) -> bool {
        self.x.is_finite()
            && self.y.is_finite()
            && self.w.is_finite()
            && self.h.is_finite()
            && self.w > 0.0
            && self.h > 0.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn iou_of_known_boxes() {
        let a = BBox::new(0.0, 0.0, 10.0, 10.0);
        for (b, expected) in [
            (a, 1.0),
            (BBox::new(5.0, 0.0, 10.0, 10.0), 50.0 / 150.0),
            (BBox::new(10.0, 0.0, 10.0, 10.0), 0.0),
            (BBox::new(20.0, 20.0, 1.0, 1.0), 0.0),
            (BBox::new(0.0, 0.0, 0.0, 0.0), 0.0),
        ] {
            assert!((a.iou(&b) - expected).abs() < 1e-12, "{b:?}");
            assert_eq!(a.iou(&b), b.iou(&a));
        }
    }

    #[test]
    fn clipping_keeps_the_inside() {
        let b = BBox::new(-5.0, 2.0, 10.0, 100.0);
        assert_eq!(b.clipped(20.0, 10.0), Some(BBox::new(0.0, 2.0, 5.0, 8.0)));
        assert_eq!(b.clipped(20.0, 1.0), None);
        assert!(!BBox::new(f64::NAN, 0.0, 1.0, 1.0).is_valid());
        assert!(!BBox::new(0.0, 0.0, 0.0, 1.0).is_valid());
    }
}
