//! What the mapper publishes: lanes as splines, and the local map that a vehicle sees ahead of it.

use nalgebra::{Matrix3, Point3};
use serde::{Deserialize, Serialize};

use crate::{category::Category, frame::TimestampNs};

/// Number of a lane within its drive, in the order of birth, from 1.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct LaneId(pub u64);

/// How a spline behaves at its two ends.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum EndRule {
    /// The paper's: the first and last control points only shape the curve, which runs between their neighbours.
    Open,
    /// A phantom control point beyond each end, the reflection of the end's neighbour: the curve reaches its ends.
    Reflected,
}

/// One control point of a lane.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct ControlPoint {
    /// Position in the map frame of the drive, metres.
    pub position: Point3<f64>,
    /// Covariance of the position, m^2, map frame axes.
    pub covariance: Matrix3<f64>,
}

/// A lane of the map: a Catmull-Rom spline with what is known of it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct MapLane {
    /// Number within the drive.
    pub id: LaneId,
    /// Most probable category.
    pub category: Category,
    /// Probability of each category, in the order of [`Category::ALL`]; sums to 1.
    pub category_posterior: Vec<f64>,
    /// Where it changes its category: its stretches in their order; empty where it is the same all along.
    pub category_stretches: Vec<CategoryStretch>,
    /// Control points in the direction of travel, about 3 m apart; at least 2.
    pub control_points: Vec<ControlPoint>,
    /// How the curve ends.
    pub ends: EndRule,
    /// Where the line begins, as spline parameter: control point `i` lies at parameter `i`.
    pub drawn_from: f64,
    /// Where the line ends, as spline parameter; above `drawn_from`.
    pub drawn_to: f64,
    /// Probability that the line exists, in `[0, 1]`.
    pub existence: f64,
    /// Frames that saw it.
    pub observations: u32,
    /// Time of the first frame that saw it.
    pub first_seen: TimestampNs,
    /// Time of the last frame that saw it.
    pub last_seen: TimestampNs,
}

/// A stretch of a lane that is painted alike.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct CategoryStretch {
    /// Where it ends, as spline parameter; it begins where the one before ends.
    pub to: f64,
    /// Probability of each category, in the order of [`Category::ALL`]; sums to 1.
    pub posterior: Vec<f64>,
}

impl MapLane {
    /// Probability of each category at a spline parameter, in the order of [`Category::ALL`].
    #[must_use]
    pub fn category_posterior_at(&self, parameter: f64) -> &[f64] {
        let stretch = self.category_stretches.iter().find(|stretch| parameter <= stretch.to);
        stretch.or(self.category_stretches.last()).map_or(&self.category_posterior, |stretch| &stretch.posterior)
    }

    /// Its stretches as a lane has them that is this one from one parameter to another.
    #[must_use]
    pub fn category_stretches_between(&self, from: f64, to: f64) -> Vec<CategoryStretch> {
        let Some(first) = self.category_stretches.iter().position(|stretch| stretch.to > from) else {
            return self.category_stretches.last().cloned().into_iter().collect();
        };
        let within = self.category_stretches[first..].iter();
        let last = within.clone().position(|stretch| stretch.to >= to).unwrap_or(usize::MAX);
        within
            .take(last.saturating_add(1))
            .map(|stretch| CategoryStretch { to: stretch.to - from, posterior: stretch.posterior.clone() })
            .collect()
    }
}

/// All lanes of a drive, in the order of their ids.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct LaneMap {
    /// The lanes.
    pub lanes: Vec<MapLane>,
}

/// The box ahead of the vehicle in which a local map is drawn, measured from below the camera, metres.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct LocalWindow {
    /// Near border.
    pub ahead_from_m: f64,
    /// Far border.
    pub ahead_to_m: f64,
    /// Left and right border.
    pub side_m: f64,
}

impl Default for LocalWindow {
    /// The paper's: 3 to 50 m ahead, 10 m to each side.
    fn default() -> Self {
        Self { ahead_from_m: 3.0, ahead_to_m: 50.0, side_m: 10.0 }
    }
}

/// A piece of a lane of the map, as the vehicle sees it now.
#[derive(Clone, Debug, PartialEq)]
pub struct LocalLane {
    /// Number within the drive.
    pub id: LaneId,
    /// Most probable category.
    pub category: Category,
    /// Points every 0.5 m or closer, near to far, vehicle frame at the corrected pose, metres.
    pub points_vehicle: Vec<Point3<f64>>,
}
