//! Drives with gross errors, as fleets have them, and drives that lie.
//!
//! A share of the drives have one gross error each: GNSS off by tens of metres, odometry with a scale 5 % wrong, a camera
//! turned 3 degrees from where it was declared to be. Another share are adversarial: whatever they report lies one lane
//! beside the truth, with nothing else to tell them by.

use std::f64::consts::TAU;

use nalgebra::{Point3, Rotation3, Vector3};

use crate::random::{SimRng, choose, happens, uniform};

/// What is wrong with a drive.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Poison {
    /// Its GNSS is off by this much all through, metres east and north.
    GnssOffset {
        /// To the east, metres.
        east_m: f64,
        /// To the north, metres.
        north_m: f64,
    },
    /// Its odometry has this much more of every way: 0.05 is 5 %.
    OdometryScale(f64),
    /// Its camera is turned to the left by this much from its declared mount, radians.
    MountYaw(f64),
    /// Every detection lies this far to the left of the truth, metres.
    LaneShift(f64),
}

/// How many drives are poisoned.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct PoisonPlan {
    /// Share of drives with a gross error.
    pub gross_share: f64,
    /// Share of adversarial drives.
    pub adversarial_share: f64,
}

/// Wrong scale of an odometry.
const SCALE: f64 = 0.05;
/// Wrong yaw of a mount, degrees.
const MOUNT_DEG: f64 = 3.0;

impl PoisonPlan {
    /// What is wrong with one drive, if anything.
    pub(crate) fn draw(&self, lane_width_m: f64, rng: &mut SimRng) -> Option<Poison> {
        let sign = |rng: &mut SimRng| if happens(rng, 0.5) { 1.0 } else { -1.0 };
        let drawn = uniform(rng, 0.0, 1.0);
        if drawn < self.adversarial_share {
            return Some(Poison::LaneShift(sign(rng) * lane_width_m));
        }
        if drawn >= self.adversarial_share + self.gross_share {
            return None;
        }
        Some(match choose(rng, 3) {
            0 => {
                let (direction_rad, size_m) = (uniform(rng, 0.0, TAU), uniform(rng, 20.0, 60.0));
                Poison::GnssOffset { east_m: size_m * direction_rad.cos(), north_m: size_m * direction_rad.sin() }
            }
            1 => Poison::OdometryScale(sign(rng) * SCALE),
            _ => Poison::MountYaw(sign(rng) * MOUNT_DEG.to_radians()),
        })
    }
}

impl Poison {
    /// Whether the drive lies rather than errs.
    #[must_use]
    pub fn is_adversarial(&self) -> bool {
        matches!(self, Self::LaneShift(_))
    }

    /// A wrong shift of GNSS, metres east, north, up.
    pub(crate) fn gnss_offset(&self) -> Vector3<f64> {
        match *self {
            Self::GnssOffset { east_m, north_m } => Vector3::new(east_m, north_m, 0.0),
            _ => Vector3::zeros(),
        }
    }

    /// A wrong scale of the odometry, beyond 1.
    pub(crate) fn odometry_scale(&self) -> f64 {
        if let Self::OdometryScale(more) = *self { more } else { 0.0 }
    }

    /// What becomes of a detected point (vehicle frame) where the camera sits at `camera`.
    pub(crate) fn displace(&self, point: Point3<f64>, camera: &Vector3<f64>) -> Point3<f64> {
        match *self {
            // Turned to the left, the camera has everything farther to the right.
            Self::MountYaw(yaw_rad) => {
                Rotation3::from_axis_angle(&Vector3::z_axis(), -yaw_rad) * (point - camera) + camera
            }
            Self::LaneShift(left_m) => point + Vector3::y() * left_m,
            _ => point,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::{Purpose, Seed};

    #[test]
    fn as_many_drives_are_poisoned_as_asked_for() {
        let plan = PoisonPlan { gross_share: 0.3, adversarial_share: 0.05 };
        let drawn: Vec<_> =
            (0..4_000).map(|drive| plan.draw(3.5, &mut Seed(1).stream(Purpose::Poison, drive))).collect();
        let share = |is: fn(&Poison) -> bool| drawn.iter().flatten().filter(|p| is(p)).count() as f64 / 4_000.0;
        assert!((share(Poison::is_adversarial) - 0.05).abs() < 0.015);
        assert!((share(|poison| !poison.is_adversarial()) - 0.3).abs() < 0.03);
        assert!(PoisonPlan::default().draw(3.5, &mut Seed(1).stream(Purpose::Poison, 0)).is_none());
    }

    #[test]
    fn a_turned_camera_moves_far_points_more_than_near_ones() {
        let poison = Poison::MountYaw(3_f64.to_radians());
        let shift = |x| (poison.displace(Point3::new(x, 0.0, 0.0), &Vector3::zeros()).y).abs();
        assert!((shift(50.0) - 2.6).abs() < 0.05 && (shift(5.0) - 0.26).abs() < 0.01);
    }
}
