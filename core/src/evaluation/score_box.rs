//! The box ahead of the camera in which lanes are compared.

use nalgebra::Point3;

/// An open rectangle of the ground frame (x right, y front), metres.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ScoreBox {
    /// Left border.
    pub x_from_m: f64,
    /// Right border.
    pub x_to_m: f64,
    /// Near border.
    pub y_from_m: f64,
    /// Far border.
    pub y_to_m: f64,
}

impl Default for ScoreBox {
    /// The paper's: 10 m to each side, 3 to 50 m ahead.
    fn default() -> Self {
        Self { x_from_m: -10.0, x_to_m: 10.0, y_from_m: 3.0, y_to_m: 50.0 }
    }
}

impl ScoreBox {
    /// Whether a point (ground frame, metres) lies inside, borders left out.
    #[must_use]
    pub fn contains(&self, point: &Point3<f64>) -> bool {
        point.x > self.x_from_m && point.x < self.x_to_m && point.y > self.y_from_m && point.y < self.y_to_m
    }

    /// The points that lie inside, in their order.
    #[must_use]
    pub fn crop(&self, line: &[Point3<f64>]) -> Vec<Point3<f64>> {
        line.iter().filter(|point| self.contains(point)).copied().collect()
    }

    /// A larger box: `side_m` more to each side, `ahead_m` more ahead.
    #[must_use]
    pub fn widened(&self, side_m: f64, ahead_m: f64) -> Self {
        Self { x_from_m: self.x_from_m - side_m, x_to_m: self.x_to_m + side_m, y_to_m: self.y_to_m + ahead_m, ..*self }
    }
}
