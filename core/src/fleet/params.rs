//! Every number of alignment and fusion, with what it was chosen by.

/// Parameters of [`fuse`](super::fuse).
#[derive(Clone, Debug, PartialEq)]
pub struct FleetParams {
    /// Way between two knots of a drive's correction, metres.
    pub correction_knot_m: f64,
    /// Way between two samples of a drive's lane, metres.
    pub sample_m: f64,
    /// Way between two knots of a line, metres.
    pub line_knot_m: f64,
    /// Standard deviation of the scale of a drive's odometry: 0.01 is 1 %.
    pub odometry_scale_sigma: f64,
    /// Standard deviation of the turn that a drive's odometry has too much all the way, radians per metre.
    pub odometry_turn_sigma_rad_per_m: f64,
    /// Standard deviation of odometry's error in position over 1 m, beside its scale, which grows with the square root of the way, metres.
    pub odometry_sigma_m: f64,
    /// The same of its heading, radians.
    pub odometry_sigma_rad: f64,
    /// The same of its height, metres.
    pub odometry_sigma_height_m: f64,
    /// Least standard deviation of what all fixes of a drive have in common, metres.
    pub gnss_bias_sigma_m: f64,
    /// Standard deviation of what they have not in common, as a share of a fix's own sigma, until the drives tell it.
    pub gnss_shape_share: f64,
    /// Fixes closer together than this are one witness of the shape of the way, metres.
    pub gnss_correlation_m: f64,
    /// Offset from the median at which the robust weight of a fix has fallen to a quarter, metres.
    pub gnss_robust_scale_m: f64,
    /// Errors of a lane closer together than this are one witness, metres.
    pub lane_correlation_m: f64,
    /// Least standard deviation of a drive's lane beside its covariance, across, metres.
    pub lane_sigma_m: f64,
    /// The same for the height, metres.
    pub lane_sigma_height_m: f64,
    /// Distance across at which a lane is no longer taken for a line, in metres.
    pub gate_m: f64,
    /// Distance in height at which a lane is no longer taken for a line: another level of the road, metres.
    pub gate_height_m: f64,
    /// Residual at which a robust weight has fallen to a quarter, metres.
    pub robust_scale_m: f64,
    /// Median distance of a drive's lanes from the lines that they lie on above which it is kept apart, metres.
    pub most_misfit_m: f64,
    /// Share of its lanes that a drive must have in common with others, where it went where they did.
    pub least_shared: f64,
    /// Distance from others' lines at which a drive counts as having gone where they did, metres.
    pub strangers_within_m: f64,
    /// Crowd that is kept apart at least: on one road so many drives, in a town more (`crowding`); the younger ones.
    pub drives_apart: usize,
    /// Crowd that is folded at once; the oldest drives.
    pub drives_per_fold: usize,
    /// Rounds of solving and matching.
    pub rounds: usize,
    /// Existence of a drive's lane below which it says nothing.
    pub least_existence: f64,
    /// Greatest standard deviation across of a knot that is shown, metres.
    pub most_lateral_sigma_m: f64,
    /// Knots that may be missing from a line without cutting it in two.
    pub bridged_knots: usize,
    /// Shortest lane, metres.
    pub shortest_lane_m: f64,
    /// Farthest lateral shift that is searched, in standard deviations of the two GNSS biases.
    pub search_sigmas: f64,
}

impl Default for FleetParams {
    fn default() -> Self {
        Self {
            correction_knot_m: 20.0,
            sample_m: 3.0,
            line_knot_m: 3.0,
            odometry_scale_sigma: 0.01,
            odometry_turn_sigma_rad_per_m: 2e-5,
            odometry_sigma_m: 0.015,
            odometry_sigma_rad: 0.0005,
            odometry_sigma_height_m: 0.015,
            gnss_bias_sigma_m: 1.0,
            gnss_shape_share: 0.2,
            gnss_correlation_m: 100.0,
            gnss_robust_scale_m: 2.0,
            lane_correlation_m: 30.0,
            lane_sigma_m: 0.1,
            lane_sigma_height_m: 0.1,
            gate_m: 1.4,
            gate_height_m: 3.0,
            robust_scale_m: 0.3,
            most_misfit_m: 0.35,
            least_shared: 0.5,
            strangers_within_m: 70.0,
            drives_apart: 16,
            drives_per_fold: 16,
            rounds: 2,
            least_existence: 0.5,
            most_lateral_sigma_m: 0.4,
            bridged_knots: 2,
            shortest_lane_m: 8.0,
            search_sigmas: 4.0,
        }
    }
}
