//! Parameters of the mapper: two presets, every number with its unit and its source.

use serde::{Deserialize, Serialize};

use crate::lane_map::EndRule;

/// Which mapper to run.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub enum Preset {
    /// The paper's method as it is meant, misprints corrected, so that its tables can be reproduced.
    Paper,
    /// What a user gets: the paper's weaknesses mended.
    #[default]
    Default,
}

/// Parameters of the mapper. Start from [`Params::preset`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Params {
    /// The preset that these parameters came from.
    pub preset: Preset,
    /// From detection to observation.
    pub observation: ObservationParams,
    /// From observation to lane of the map.
    pub association: AssociationParams,
    /// Correction of the pose.
    pub tracking: TrackingParams,
    /// Growth and smoothing of a lane.
    pub landmark: LandmarkParams,
    /// The detector's own error along a line.
    pub line_error: LineErrorParams,
}

/// Parameters of [`crate::landmark::line_terms`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct LineErrorParams {
    /// Whether samples of a line are taken for correlated (`default`).
    pub enabled: bool,
    /// Range at which the sigmas are quoted, metres.
    pub reference_range_m: f64,
    /// Standard deviation of the constant, linear and quadratic part of a line's error at the reference range, metres.
    pub sigmas_m: [f64; 3],
    /// Time over which the error is correlated, seconds.
    pub correlation_s: f64,
    /// White noise of a sample, metres.
    pub white_sigma_m: f64,
    /// Distance of two samples, metres along the line.
    pub step_m: f64,
    /// Huber threshold of a whole line in one frame, in sigmas.
    pub huber_sigmas: f64,
}

/// Standard deviation of a detection: `near + growth * (range / reference_range)^power`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct RangeNoise {
    /// At the camera, metres.
    pub near_m: f64,
    /// Growth up to the reference range, metres.
    pub growth_m: f64,
    /// Range at which the growth is reached, metres.
    pub reference_range_m: f64,
    /// 1: linear in range.
    pub power: i32,
}

/// Parameters of [`crate::observation::observe`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ObservationParams {
    /// Near border of the crop box, metres ahead of the camera.
    pub ahead_from_m: f64,
    /// Far border of the crop box, metres ahead of the camera.
    pub ahead_to_m: f64,
    /// Left and right border of the crop box, metres.
    pub side_m: f64,
    /// Least distance of two points along the line, metres.
    pub thin_m: f64,
    /// Fewer measured points than this are no observation.
    pub least_points: usize,
    /// Fewer samples than this, after resampling, are no observation.
    pub least_samples: usize,
    /// A shorter line is no observation, metres.
    pub least_length_m: f64,
    /// Below this spread the line counts as flat in that axis, metres.
    pub flat_spread_m: f64,
    /// Order of a flat line.
    pub flat_order: usize,
    /// Below this spread the order is 2, above it 3, metres.
    pub curved_spread_m: f64,
    /// Whether points weigh by the inverse variance of their range.
    pub weighted_fit: bool,
    /// Residuals below this are never outliers, metres.
    pub outlier_floor_m: f64,
    /// Distance of two samples, metres.
    pub sample_step_m: f64,
    /// Noise of a detection.
    pub noise: RangeNoise,
}

/// Parameters of [`crate::association`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct AssociationParams {
    /// Least pose uncertainty that enters the bound on point distances, radians.
    pub least_sigma_rad: f64,
    /// Least pose uncertainty that enters the bound on point distances, metres.
    pub least_sigma_m: f64,
    /// Floor of the bound on a point's distance, metres (`paper`; the authors' code: 1.0).
    pub least_bound_m: f64,
    /// Detection noise in the bound, metres (`paper`; the authors' code: 0.5).
    pub bound_noise_m: f64,
    /// Lateral noise of a detection against the map (`default`).
    pub noise: RangeNoise,
    /// Independent witnesses in one detected line (`default`).
    pub witnesses: f64,
    /// Cost of leaving a detection without a lane, in units of half a squared sigma (`default`).
    pub unassigned_cost: f64,
    /// Cost of an expected lane that no detection takes (`default`).
    pub missed_cost: f64,
    /// Largest root mean square lateral distance of a match, metres (`default`).
    pub gate_m: f64,
    /// Largest mean height difference of a match, metres (`default`).
    pub gate_height_m: f64,
    /// Least overlap of a match, metres along the lane (`default`).
    pub least_overlap_m: f64,
    /// Overlap from which on a line counts as all its witnesses, metres (`default`).
    pub full_overlap_m: f64,
    /// How far a point may lie beyond the end of a lane and still be compared, metres (`default`).
    pub end_slack_m: f64,
    /// Range at which a yaw error counts as a shift, metres (`default`).
    pub play_range_m: f64,
    /// Below this play of the pose only the predicted pose is tried, metres (`default`).
    pub single_hypothesis_m: f64,
    /// Lanes of the map through this box should be seen: near border, metres ahead (`default`).
    pub expected_from_m: f64,
    /// Far border of that box, metres ahead (`default`).
    pub expected_to_m: f64,
    /// Half the width of that box, metres (`default`).
    pub expected_side_m: f64,
    /// Probability that a detector names a wrong category (`default`).
    pub category_confusion: f64,
}

/// Parameters of [`crate::tracking`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TrackingParams {
    /// Most iterations of Levenberg-Marquardt.
    pub iterations: usize,
    /// Distance of two points that enter, along a line, metres.
    pub point_step_m: f64,
    /// Huber threshold, in sigmas.
    pub huber_sigmas: f64,
    /// Constant part of a line's lateral and vertical error in one frame, metres.
    pub line_offset_sigma_m: f64,
    /// Error of a line's direction in one frame, radians.
    pub line_slope_sigma_rad: f64,
    /// Error of a line's bend in one frame: deviation at the reference range, metres.
    pub line_bend_sigma_m: f64,
    /// Yaw error that all lines of a frame share, radians.
    pub frame_yaw_sigma_rad: f64,
    /// Pitch error that all lines of a frame share, radians.
    pub frame_pitch_sigma_rad: f64,
    /// Noise of a single point, metres.
    pub point_sigma_m: f64,
    /// Where the least spread of the lines' normals is below this share of the largest, that direction is left to odometry.
    pub weak_direction: f64,
    /// Time over which the error of the pose that lanes show is correlated, seconds; 0: not at all (`paper`).
    pub correlation_s: f64,
    /// How much the variance of the map counts in a point's noise: frames that made it were not independent.
    pub map_doubt: f64,
    /// How much sharper the lanes are in one frame, once that error is in the state.
    pub sharpness: f64,
    /// Bound on the uncertainty along the road, relative to the map around the vehicle, metres.
    pub map_memory_m: f64,
    /// How steadily a vehicle moves; `None`: odometry is taken as it comes (`paper`).
    pub steadiness: Option<Steadiness>,
    /// Odometry noise where the vehicle gives none: translation per frame, metres.
    pub odometry_sigma_m: f64,
    /// Odometry noise where the vehicle gives none: rotation per frame, radians.
    pub odometry_sigma_rad: f64,
}

/// How much a vehicle changes its motion in a second, as standard deviations ([`crate::tracking::motion`]).
///
/// Recorded vehicles (tracks of Argoverse 2 and PandaSet) change their turning by 0.1 to 1.5 deg/s where they do not turn, and by
/// 10 deg/s at a junction.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Steadiness {
    /// Of the speed ahead, m/s: so loose that odometry alone says how far the vehicle went.
    pub speed_mps: f64,
    /// Of the speed to the side, m/s.
    pub sway_mps: f64,
    /// Of the speed upwards, m/s: loose, as what is known of the height must not be taken for knowledge of the way ahead.
    pub heave_mps: f64,
    /// Of rolling and pitching, rad/s.
    pub tilt_rad_s: f64,
    /// Of turning, on a straight road, rad/s.
    pub turn_rad_s: f64,
    /// Of turning, more for each rad/s by which the vehicle turns, rad/s.
    pub turn_share: f64,
}

/// Parameters of [`crate::landmark`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct LandmarkParams {
    /// Distance of two control points, metres (paper: 3).
    pub chord_m: f64,
    /// How a curve ends.
    pub ends: EndRule,
    /// Standard deviation of a chordal term, metres (paper: 1).
    pub chord_sigma_m: f64,
    /// Standard deviation of a second difference of control points, metres; a kilometre or more: no such term.
    pub bend_sigma_m: f64,
    /// Independent witnesses in one detected line: each sample's information is divided so that they sum to this.
    pub witnesses: f64,
    /// Huber threshold of a sample, metres (authors: 0.5).
    pub huber_m: f64,
    /// Frames whose weights and foot points are evaluated anew before they are folded for good.
    pub window_frames: usize,
    /// Factor on the variance of published control points. What a detector repeats in every frame of a line (a constant
    /// share of its error, a yaw that all lines share) is not averaged away by more frames, and the smoother, which knows
    /// only errors that fade, takes it for averaged. On 24 simulated drives on true poses (12 seeds, town and long road,
    /// 19,000 control points) the 95 % region across the line held the truth 73 % of the time without this factor, and
    /// 95.1 % with 6.25, which is 2.5 times the standard deviation.
    pub variance_inflation: f64,
    /// Lanes seen in fewer frames than this are not shown.
    pub least_observations: u32,
    /// Frames after its birth at which a lane must have that many (`paper`).
    pub trial_frames: u64,
    /// Noise of a detection, as it weighs in the map.
    pub noise: RangeNoise,
    /// A stretch of line is drawn where this share of its votes saw it.
    pub drawn_share: f64,
    /// Detections are sure up to this range, metres: a stretch nearer than this that is not reported is not there.
    pub sure_range_m: f64,
    /// From this range on a detector may report nothing, metres.
    pub blind_range_m: f64,
    /// Lanes are shown in the local map from this probability of existence on.
    pub shown_existence: f64,
    /// Lanes are published in the drive's map from this probability on: a map can wait for what a planner must know now.
    pub published_existence: f64,
    /// What no frame saw for so much way is no longer looked for, metres: odometry has lost it, and coming back is the
    /// fleet's matter, which closes loops.
    pub left_behind_m: f64,
    /// A lane that this frame missed is shown in the local map if this much of it lies in the image, metres.
    pub shown_in_image_m: f64,
    /// A lane is shown in the local map if this much of it lies in the window, metres.
    pub shown_in_window_m: f64,
    /// Which lanes are given up once the drive is over; `None`: none (`default`).
    pub clean_up: Option<CleanUpParams>,
}

/// Parameters of [`crate::landmark::clean_up`].
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct CleanUpParams {
    /// Lanes seen in fewer frames than this are given up (authors: 10).
    pub least_observations: u32,
    /// So are those that a smaller share of the frames saw, from their first to their last (authors: 0.5).
    pub least_share_of_span: f64,
    /// So is the shorter of two of which it shares more than this with the other (authors: 0.7).
    pub most_overlap: f64,
    /// Distance within which two lanes share a point, metres (authors: 1.75).
    pub within_m: f64,
}

impl Params {
    /// The parameters of a preset.
    #[must_use]
    pub fn preset(preset: Preset) -> Self {
        match preset {
            Preset::Paper => Self::paper(),
            Preset::Default => Self::mended(),
        }
    }

    /// The paper's numbers; where it gives none, its code's.
    fn paper() -> Self {
        // 0.1 m at the camera to 1.0 m at the far corner of the crop box, 51 m away.
        let noise = RangeNoise { near_m: 0.1, growth_m: 0.9, reference_range_m: 51.0, power: 1 };
        Self {
            preset: Preset::Paper,
            observation: ObservationParams {
                ahead_from_m: 3.0,
                ahead_to_m: 50.0,
                side_m: 10.0,
                thin_m: 0.5,
                least_points: 2,
                least_samples: 4,
                least_length_m: 0.5,
                flat_spread_m: 0.1,
                flat_order: 0,
                curved_spread_m: 1.0,
                weighted_fit: false,
                outlier_floor_m: 0.0,
                sample_step_m: 0.5,
                noise,
            },
            association: AssociationParams {
                least_sigma_rad: 0.0,
                least_sigma_m: 0.0,
                least_bound_m: 1.0,
                bound_noise_m: 0.5,
                ..Self::mended().association
            },
            tracking: TrackingParams {
                iterations: 10,
                point_step_m: 1.0,
                correlation_s: 0.0,
                steadiness: None,
                ..Self::mended().tracking
            },
            landmark: LandmarkParams {
                chord_m: 3.0,
                ends: EndRule::Open,
                chord_sigma_m: 1.0,
                bend_sigma_m: 1e6,
                witnesses: 1e6,
                huber_m: 0.5,
                window_frames: 0,
                variance_inflation: 1.0,
                least_observations: 4,
                trial_frames: 6,
                noise,
                drawn_share: 0.0,
                sure_range_m: 50.0,
                blind_range_m: 51.0,
                shown_existence: 0.0,
                published_existence: 0.0,
                left_behind_m: f64::INFINITY,
                shown_in_image_m: 0.0,
                shown_in_window_m: 0.0,
                clean_up: Some(CleanUpParams {
                    least_observations: 10,
                    least_share_of_span: 0.5,
                    most_overlap: 0.7,
                    within_m: 1.75,
                }),
            },
            line_error: LineErrorParams { enabled: false, step_m: 0.5, ..Self::mended().line_error },
        }
    }

    fn mended() -> Self {
        let noise = RangeNoise { near_m: 0.08, growth_m: 0.5, reference_range_m: 50.0, power: 2 };
        Self {
            preset: Preset::Default,
            observation: ObservationParams {
                ahead_from_m: 3.0,
                ahead_to_m: 62.0,
                side_m: 12.0,
                thin_m: 0.5,
                least_points: 3,
                least_samples: 4,
                least_length_m: 4.0,
                flat_spread_m: 0.1,
                flat_order: 1,
                curved_spread_m: 1.0,
                weighted_fit: true,
                outlier_floor_m: 0.3,
                sample_step_m: 0.5,
                noise,
            },
            association: AssociationParams {
                least_sigma_rad: 0.002,
                least_sigma_m: 0.05,
                least_bound_m: 1.0,
                bound_noise_m: 0.5,
                noise: RangeNoise { near_m: 0.15, growth_m: 0.5, reference_range_m: 50.0, power: 1 },
                witnesses: 3.0,
                unassigned_cost: 20.0,
                missed_cost: 1.0,
                gate_m: 1.2,
                gate_height_m: 2.0,
                least_overlap_m: 5.0,
                full_overlap_m: 20.0,
                end_slack_m: 1.0,
                play_range_m: 20.0,
                single_hypothesis_m: 0.8,
                expected_from_m: 8.0,
                expected_to_m: 40.0,
                expected_side_m: 8.0,
                category_confusion: 0.1,
            },
            tracking: TrackingParams {
                iterations: 4,
                point_step_m: 3.0,
                huber_sigmas: 2.0,
                line_offset_sigma_m: 0.2,
                line_slope_sigma_rad: 0.004,
                line_bend_sigma_m: 0.1,
                frame_yaw_sigma_rad: 0.003,
                frame_pitch_sigma_rad: 0.005,
                point_sigma_m: 0.1,
                weak_direction: 0.05,
                correlation_s: 0.5,
                sharpness: 2.0,
                map_doubt: 10.0,
                map_memory_m: 1.0,
                steadiness: Some(Steadiness {
                    speed_mps: 100.0,
                    sway_mps: 0.5,
                    heave_mps: 1.0,
                    tilt_rad_s: 0.5,
                    turn_rad_s: 0.02,
                    turn_share: 1.0,
                }),
                odometry_sigma_m: 0.01,
                odometry_sigma_rad: 0.0003,
            },
            landmark: LandmarkParams {
                chord_m: 3.0,
                ends: EndRule::Reflected,
                chord_sigma_m: 1.0,
                bend_sigma_m: 0.1,
                witnesses: 1.0,
                huber_m: 0.8,
                window_frames: 3,
                variance_inflation: 6.25,
                least_observations: 3,
                trial_frames: 6,
                noise,
                drawn_share: 0.5,
                sure_range_m: 25.0,
                blind_range_m: 41.0,
                shown_existence: 0.6,
                published_existence: 0.9,
                left_behind_m: 300.0,
                shown_in_image_m: 8.0,
                shown_in_window_m: 5.0,
                clean_up: None,
            },
            line_error: LineErrorParams {
                enabled: true,
                reference_range_m: 50.0,
                sigmas_m: [0.05, 0.25, 0.3],
                correlation_s: 0.3,
                white_sigma_m: 0.05,
                step_m: 3.0,
                huber_sigmas: 2.0,
            },
        }
    }
}
