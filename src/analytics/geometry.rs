//! Points, segments, polygons.

/// A point: fractions of the picture (0 to 1 from the top left corner) in rules, pixels while watching.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Point {
    /// To the right.
    pub x: f64,
    /// Down.
    pub y: f64,
}

impl Point {
    /// Fractions as pixels of a picture of `size`.
    pub(super) fn pixels(self, (width, height): (u32, u32)) -> Self {
        Self { x: self.x * f64::from(width), y: self.y * f64::from(height) }
    }

    /// Pixels as fractions of a picture of `size`.
    pub(super) fn within(self, (width, height): (u32, u32)) -> Self {
        Self { x: self.x / f64::from(width.max(1)), y: self.y / f64::from(height.max(1)) }
    }

    fn minus(self, other: Self) -> Self {
        Self { x: self.x - other.x, y: self.y - other.y }
    }
}

/// Twice the signed area of the triangle: positive when `c` lies to the right of the way from `a` to `b`,
/// as the picture is seen (y grows downwards).
fn side(a: Point, b: Point, c: Point) -> f64 {
    let (u, v) = (b.minus(a), c.minus(a));
    u.x * v.y - u.y * v.x
}

/// Distance of `p` from the segment `a`, `b`.
fn distance_to_segment(p: Point, a: Point, b: Point) -> f64 {
    let (u, v) = (b.minus(a), p.minus(a));
    let length2 = u.x * u.x + u.y * u.y;
    let t = if length2 > 0.0 { ((u.x * v.x + u.y * v.y) / length2).clamp(0.0, 1.0) } else { 0.0 };
    (v.x - t * u.x).hypot(v.y - t * u.y)
}

/// Distance of `p` from a polyline.
pub(super) fn distance_to_path(p: Point, path: &[Point]) -> f64 {
    path.windows(2).map(|s| distance_to_segment(p, s[0], s[1])).fold(f64::INFINITY, f64::min)
}

/// How often the way from `from` to `to` crosses a polyline from its left to its right, less how often from
/// right to left. A point on the line counts as on its right, so that two ways that meet in it are one
/// crossing together; a corner belongs to the segment that begins there.
pub(super) fn crossings(from: Point, to: Point, path: &[Point]) -> i32 {
    let mut net = 0;
    for (index, segment) in path.windows(2).enumerate() {
        let (a, b) = (segment[0], segment[1]);
        let (before, after) = (side(a, b, from) >= 0.0, side(a, b, to) >= 0.0);
        if before == after {
            continue;
        }
        // The ends of the segment lie on different sides of the way; the last one closes the polyline.
        let (first, second) = (side(from, to, a), side(from, to, b));
        let last = index + 2 == path.len();
        let meets = if last {
            first * second <= 0.0
        } else {
            (first <= 0.0 && second > 0.0) || (first >= 0.0 && second < 0.0)
        };
        if meets {
            net += if after { 1 } else { -1 };
        }
    }
    net
}

/// Whether `p` is inside the polygon (even-odd rule).
pub(super) fn inside(p: Point, polygon: &[Point]) -> bool {
    let mut inside = false;
    for [a, b] in sides(polygon) {
        if (a.y > p.y) != (b.y > p.y) && p.x < a.x + (b.x - a.x) * (p.y - a.y) / (b.y - a.y) {
            inside = !inside;
        }
    }
    inside
}

/// Distance of `p` from the nearest of some sides; infinite without any.
pub(super) fn distance_to_sides(p: Point, sides: &[[Point; 2]]) -> f64 {
    sides.iter().map(|[a, b]| distance_to_segment(p, *a, *b)).fold(f64::INFINITY, f64::min)
}

/// Whether a side, in fractions of the picture, lies along the picture's edge.
pub(super) fn along_edge([a, b]: &[Point; 2]) -> bool {
    [0.0, 1.0].iter().any(|edge| (a.x == *edge && b.x == *edge) || (a.y == *edge && b.y == *edge))
}

/// Area of the polygon, by the shoelace formula.
pub(super) fn area(polygon: &[Point]) -> f64 {
    sides(polygon).map(|[a, b]| a.x * b.y - b.x * a.y).sum::<f64>().abs() / 2.0
}

/// The mean of the corners.
pub(super) fn middle(polygon: &[Point]) -> Point {
    let n = polygon.len().max(1) as f64;
    let sum = |of: fn(&Point) -> f64| polygon.iter().map(of).sum::<f64>() / n;
    Point { x: sum(|p| p.x), y: sum(|p| p.y) }
}

/// The polygon's sides.
pub(super) fn sides(polygon: &[Point]) -> impl Iterator<Item = [Point; 2]> {
    let last = polygon.last().copied();
    last.into_iter().chain(polygon.iter().copied()).zip(polygon.iter().copied()).map(|(a, b)| [a, b])
}

#[cfg(test)]
mod tests {
    use super::*;

    fn p(x: f64, y: f64) -> Point {
        Point { x, y }
    }

    #[test]
    fn crossings_have_a_direction() {
        // Downwards: the picture's left is to the right of who walks it.
        let line = [p(5.0, 0.0), p(5.0, 10.0)];
        for (from, to, expected) in [
            (p(8.0, 5.0), p(2.0, 5.0), 1),
            (p(2.0, 5.0), p(8.0, 5.0), -1),
            (p(2.0, 5.0), p(4.0, 9.0), 0),
            (p(2.0, 11.0), p(8.0, 11.0), 0),
            // Through both of its ends.
            (p(2.0, 0.0), p(8.0, 0.0), -1),
            (p(2.0, 10.0), p(8.0, 10.0), -1),
            // Onto it and on.
            (p(8.0, 5.0), p(5.0, 5.0), 1),
            (p(5.0, 5.0), p(2.0, 5.0), 0),
        ] {
            assert_eq!(crossings(from, to, &line), expected, "{from:?} {to:?}");
        }
    }

    #[test]
    fn a_corner_is_crossed_once() {
        let path = [p(0.0, 5.0), p(5.0, 5.0), p(10.0, 5.0)];
        assert_eq!(crossings(p(5.0, 0.0), p(5.0, 9.0), &path), 1);
        assert_eq!(crossings(p(5.0, 9.0), p(5.0, 0.0), &path), -1);
        // In at one flank of a V and out at the other.
        let v = [p(0.0, 0.0), p(5.0, 8.0), p(10.0, 0.0)];
        assert_eq!(crossings(p(-1.0, 4.0), p(11.0, 4.0), &v), 0);
    }

    #[test]
    fn polygons() {
        let l = [p(0.0, 0.0), p(4.0, 0.0), p(4.0, 4.0), p(2.0, 4.0), p(2.0, 2.0), p(0.0, 2.0)];
        for (at, expected) in
            [(p(1.0, 1.0), true), (p(3.0, 3.0), true), (p(1.0, 3.0), false), (p(5.0, 1.0), false)]
        {
            assert_eq!(inside(at, &l), expected, "{at:?}");
        }
        assert_eq!(area(&l), 12.0);
        let sides: Vec<_> = sides(&l).collect();
        assert_eq!(distance_to_sides(p(3.0, 3.0), &sides), 1.0);
        assert_eq!(sides.iter().filter(|side| along_edge(side)).count(), 2);
    }
}
