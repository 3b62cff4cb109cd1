//! From one control point to the next: a length along the chord before, an offset across it, and one upwards.
//!
//! A road goes on as it went, so the offsets are small; and since a control point may lie anywhere along its line, its
//! distance is one of a few lengths. All in whole millimetres, and by operations that IEEE 754 rounds in one way only (no
//! trigonometry), so that every reader comes to the same control points.

use nalgebra::Point3;

/// A control point, millimetres, in the cell's frame.
pub(super) type Millimetres = [i64; 3];

/// The lengths that steps along the chord before have as a rule, millimetres. As in `spline_tile.proto`.
pub(super) const LENGTHS_MM: [i32; 14] =
    [1_000, 1_500, 2_000, 3_000, 4_000, 5_000, 6_000, 7_500, 9_000, 11_000, 13_500, 16_500, 20_000, 25_000];

/// The chord before a control point.
#[derive(Clone, Copy, Debug)]
pub(super) struct Heading {
    here: Millimetres,
    /// Direction of the chord in plan, of length 1.
    along: [f64; 2],
    /// How far it climbs per millimetre in plan.
    climb: f64,
}

impl Heading {
    pub(super) fn new(before: Millimetres, here: Millimetres) -> Self {
        let [dx, dy, dz] = [0, 1, 2].map(|axis| (here[axis] - before[axis]) as f64);
        let length = (dx * dx + dy * dy).sqrt();
        if length == 0.0 {
            return Self { here, along: [1.0, 0.0], climb: 0.0 };
        }
        Self { here, along: [dx / length, dy / length], climb: dz / length }
    }

    /// The control point a length along, and so far to the left and above.
    pub(super) fn step(&self, length_mm: i32, left_mm: i64, up_mm: i64) -> Millimetres {
        let (length, left) = (f64::from(length_mm), left_mm as f64);
        let [ux, uy] = self.along;
        [
            self.here[0] + rounded(ux * length - uy * left),
            self.here[1] + rounded(uy * length + ux * left),
            self.here[2] + rounded(self.climb * length) + up_mm,
        ]
    }

    /// How far a point lies along the chord, millimetres from its end.
    pub(super) fn along_mm(&self, point: &Point3<f64>) -> f64 {
        let [dx, dy] = self.to(point);
        self.along[0] * dx + self.along[1] * dy
    }

    /// The offsets to the left and upwards that lead nearest to a point, after a length along.
    pub(super) fn offsets_mm(&self, length_mm: i32, point: &Point3<f64>) -> (i64, i64) {
        let [dx, dy] = self.to(point);
        let left = self.along[0] * dy - self.along[1] * dx;
        let level = self.here[2] + rounded(self.climb * f64::from(length_mm));
        (rounded(left), rounded(point.z * 1e3) - level)
    }

    fn to(&self, point: &Point3<f64>) -> [f64; 2] {
        [point.x * 1e3 - self.here[0] as f64, point.y * 1e3 - self.here[1] as f64]
    }
}

/// The nearest whole number; of two, the greater.
#[expect(clippy::cast_possible_truncation, reason = "saturates far beyond any cell")]
pub(super) fn rounded(value: f64) -> i64 {
    (value + 0.5).floor() as i64
}

/// A control point in metres.
pub(super) fn metres(point: Millimetres) -> Point3<f64> {
    Point3::from(point.map(|mm| mm as f64 * 1e-3))
}

/// A position to the millimetre.
pub(super) fn millimetres(point: &Point3<f64>) -> Millimetres {
    [point.x, point.y, point.z].map(|metres| rounded(metres * 1e3))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_step_leads_to_within_a_millimetre_of_where_it_was_aimed() {
        let heading = Heading::new([0, 0, 0], [4_000, 3_000, 50]);
        let target = Point3::new(4.0 + 0.8 * 9.0 - 0.6 * 0.25, 3.0 + 0.6 * 9.0 + 0.8 * 0.25, 0.2);
        assert!((heading.along_mm(&target) - 9_000.0).abs() < 1e-6);
        let (left, up) = heading.offsets_mm(9_000, &target);
        assert_eq!((left, up), (250, 60));
        assert_eq!(heading.step(9_000, left, up), [11_050, 8_600, 200]);
    }

    #[test]
    fn a_chord_without_length_leads_east() {
        assert_eq!(Heading::new([5, 5, 5], [5, 5, 5]).step(1_000, 10, 0), [1_005, 15, 5]);
    }
}
