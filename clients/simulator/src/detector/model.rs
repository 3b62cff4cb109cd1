//! The figures of the detector, tuned so that its raw detections have an F1 of about 0.56 by the paper's measure.

use crate::noise::RangeSigmas;

/// Rows at which lines are reported, metres ahead in the ground frame: `PersFormer`'s.
pub const ROWS_M: [f64; 8] = [5.0, 10.0, 15.0, 20.0, 30.0, 40.0, 50.0, 60.0];

/// Every figure of the detector.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DetectorModel {
    /// Lateral error of a line of difficulty 1; 0.5 m at 50 m.
    pub lateral: RangeSigmas,
    /// Vertical error of a line of difficulty 1; 0.35 m at 50 m.
    pub vertical: RangeSigmas,
    /// Share of the errors' variance that is constant over the drive, in `[0, 1]`.
    pub constant_share: f64,
    /// Correlation time of the rest, seconds.
    pub correlation_s: f64,
    /// Noise of every single point, metres.
    pub white_sigma_m: f64,
    /// Pitch error of a frame, radians.
    pub pitch_sigma_rad: f64,
    /// Yaw error of a frame, radians.
    pub yaw_sigma_rad: f64,
    /// Spread of the difficulty of lines: standard deviation of its logarithm.
    pub difficulty_spread: f64,
    /// Misses.
    pub misses: Misses,
    /// Reach.
    pub reach: Reach,
    /// Ghosts.
    pub ghosts: Ghosts,
    /// Share of the time that a line is reported under a wrong category.
    pub flip_share: f64,
    /// Mean length of a burst of wrong categories, frames.
    pub flip_burst_frames: f64,
}

/// How lines are missed: a share of the time that grows with their distance to the side, in bursts.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Misses {
    /// Mean length of a burst, frames.
    pub burst_frames: f64,
    /// Share for the lines of the vehicle's own lane.
    pub ego_share: f64,
    /// Share for lines at `far_side_m` or beyond.
    pub far_share: f64,
    /// Up to this distance to the side a line counts as the vehicle's own, metres.
    pub ego_side_m: f64,
    /// From this distance to the side the share grows no more, metres.
    pub far_side_m: f64,
}

impl Misses {
    /// Share of the time that a line is missed at a distance to the side.
    #[must_use]
    pub fn share_at(&self, side_m: f64) -> f64 {
        let out = ((side_m.abs() - self.ego_side_m) / (self.far_side_m - self.ego_side_m)).clamp(0.0, 1.0);
        self.ego_share + (self.far_share - self.ego_share) * out
    }
}

/// How far lines are reported: `range - per_difficulty (d - 1) + N(0, sigma)`, metres.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Reach {
    /// Reach of a line of difficulty 1, metres.
    pub range_m: f64,
    /// Loss per unit of difficulty, metres.
    pub per_difficulty_m: f64,
    /// Spread from frame to frame, metres.
    pub sigma_m: f64,
}

/// Lines that are not there.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ghosts {
    /// Births per frame beside any true line.
    pub births_per_frame: f64,
    /// Mean life, frames.
    pub life_frames: f64,
    /// Nearest to the true line, metres to the side.
    pub min_offset_m: f64,
    /// Farthest from it, metres to the side.
    pub max_offset_m: f64,
}

impl Default for DetectorModel {
    fn default() -> Self {
        Self {
            lateral: RangeSigmas { offset_m: 0.10, slope_m: 0.30, bend_m: 0.38 },
            vertical: RangeSigmas { offset_m: 0.06, slope_m: 0.20, bend_m: 0.28 },
            constant_share: 0.15,
            correlation_s: 0.5,
            white_sigma_m: 0.03,
            pitch_sigma_rad: 0.29_f64.to_radians(),
            yaw_sigma_rad: 0.18_f64.to_radians(),
            difficulty_spread: 0.3,
            misses: Misses { burst_frames: 6.0, ego_share: 0.07, far_share: 0.55, ego_side_m: 2.5, far_side_m: 10.0 },
            reach: Reach { range_m: 59.0, per_difficulty_m: 12.0, sigma_m: 4.0 },
            ghosts: Ghosts { births_per_frame: 0.06, life_frames: 4.0, min_offset_m: 0.7, max_offset_m: 2.2 },
            flip_share: 0.07,
            flip_burst_frames: 5.0,
        }
    }
}
