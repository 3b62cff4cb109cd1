//! Pose update: the pose at which the frame's lanes lie on the lanes of the map.
//!
//! Paper: "Pose Update": minimise `sum rho(|(I - d d^T)(T p_k - p(u_k))|^2) + |log(T_odo^-1 T)|^2_P` over SE(3), `d` the unit
//! tangent. Levenberg-Marquardt, foot points found anew at every iteration, Huber's kernel, the odometry term weighted
//! by its covariance, and the covariance of the result from the final Hessian.
//!
//! Where we differ: a hundred points along one line are not a hundred measurements. A line's error in one frame is
//! `B a + white`, `B = [1, r, (r / r_0)^2]` in the range `r`, `a ~ N(0, S)`, sideways and in height. The `a` are eliminated in closed
//! form (Woodbury): `H = J^T D J - J^T D B (S^-1 + B^T D B)^-1 B^T D J`. Yaw and pitch errors that all lines of a frame
//! share are eliminated likewise. What the lanes hardly constrain (a straight road says nothing along itself) is left to
//! odometry: where the normals of all lines are nearly parallel, the direction square to them is projected out.

use nalgebra::{Matrix2, Matrix3, Matrix6, Matrix6x3, Point3, Vector3, Vector6};

use super::{PoseEstimate, motion::Twist};
use crate::{
    geometry::{
        Pose, TangentCovariance,
        pose::{log, perturb},
    },
    params::TrackingParams,
};

/// Where an observed point lies on the map, at some pose.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Correspondence {
    /// Foot point, map frame, metres.
    pub foot_map: Point3<f64>,
    /// Unit tangent of the lane there, map frame.
    pub tangent_map: Vector3<f64>,
    /// Variance of the lane there, m^2.
    pub map_variance: f64,
}

/// Foot points of a detection's points at a pose, in their order; `None` for a point beyond the lane's ends.
pub type FootPoints<'a> = Box<dyn Fn(&Pose) -> Vec<Option<Correspondence>> + 'a>;

/// A detection that was taken for a lane: its points, and how to find their foot points.
pub struct MatchedLane<'a> {
    /// Points of the observation, vehicle frame, metres.
    pub points_vehicle: Vec<Point3<f64>>,
    /// How its points find their foot points.
    pub foot_points: FootPoints<'a>,
}

/// Range at which the bend of a line's error is quoted, metres.
const BEND_RANGE_M: f64 = 50.0;

/// Corrects a predicted pose by the lanes matched in one frame, starting the search at `start`.
///
/// The lanes show the sum `s = x + c` of the pose and the detector's error (`prediction`); what is found of `s` is shared out by
/// their covariances: with `G = P [I I]^T M^-1`, `M = [I I] P [I I]^T`, both move by `G (s - s_predicted)`, and so does the twist.
#[must_use]
pub fn update_pose(
    predicted: &PoseEstimate,
    start: &Pose,
    lanes: &[MatchedLane<'_>],
    params: &TrackingParams,
) -> PoseEstimate {
    let shown = perturb(&predicted.map_from_vehicle, &predicted.detector_error);
    let start = perturb(start, &predicted.detector_error);
    let at_start = Normal::lanes_at(lanes, &start, params);
    let with_fresh_error = refresh_detector_error(predicted, &at_start.hessian, params);
    let Some(prior) = Prior::new(&with_fresh_error, &shown) else { return *predicted };
    let (found, found_covariance) = minimise(&prior, start, &at_start, lanes, params);
    share_out(&with_fresh_error, &prior, &found, &found_covariance)
}

/// Levenberg-Marquardt on the lanes and the prior; the minimum and its covariance.
fn minimise(
    prior: &Prior,
    start: Pose,
    at_start: &Normal,
    lanes: &[MatchedLane<'_>],
    params: &TrackingParams,
) -> (Pose, TangentCovariance) {
    let mut pose = start;
    let mut damping = 0.0;
    let mut current = at_start.with_prior(&pose, prior, params);
    for _ in 0..params.iterations {
        let Some(step) = current.step(damping) else { break };
        let moved = perturb(&pose, &step);
        // So small a step moves no foot point: the linearisation still holds.
        if is_settled(&step) {
            pose = moved;
            break;
        }
        let next = Normal::lanes_at(lanes, &moved, params).with_prior(&moved, prior, params);
        if next.cost > current.cost * (1.0 + 1e-9) {
            damping = (damping * 10.0f64).max(1e-3);
            continue;
        }
        pose = moved;
        current = next;
        damping *= 0.1;
    }
    (pose, current.hessian.cholesky().map_or(prior.covariance, |factor| factor.inverse()))
}

/// Below 5 mm and 0.1 mrad a step is not worth another look at the lanes.
fn is_settled(step: &Vector6<f64>) -> bool {
    step.fixed_rows::<3>(0).norm() < 5e-3 && step.fixed_rows::<3>(3).norm() < 1e-4
}

/// Brings the detector's error to its stationary covariance `C = H^-1` where the lanes say anything: `+ (1 - phi^2) C`.
///
/// What is left of the old covariance tells how much of it was forgotten.
fn refresh_detector_error(predicted: &PoseEstimate, hessian: &Matrix6<f64>, params: &TrackingParams) -> PoseEstimate {
    if params.correlation_s <= 0.0 {
        return *predicted;
    }
    // Metres and radians are made alike at a lever of some car lengths.
    let scale = Vector6::new(1.0, 1.0, 1.0, LEVER_M, LEVER_M, LEVER_M);
    let unit = Matrix6::from_diagonal(&scale.map(|s| 1.0 / s));
    let eigen = (unit * hessian * unit).symmetric_eigen();
    let mut stationary = Matrix6::zeros();
    for (value, vector) in eigen.eigenvalues.iter().zip(eigen.eigenvectors.column_iter()) {
        if *value > LEAST_INFORMATION {
            stationary += vector * vector.transpose() / *value;
        }
    }
    let stationary = unit * stationary * unit;
    let fresh = 1.0 - predicted.remembered * predicted.remembered;
    PoseEstimate { detector_covariance: predicted.detector_covariance + stationary * fresh, ..*predicted }
}

/// Lever at which a rotation is weighed against a translation, metres.
const LEVER_M: f64 = 10.0;
/// Directions of less information than this, 1/m^2, are not constrained by lanes at all.
const LEAST_INFORMATION: f64 = 1.0;

/// Shares a found sum out to the pose, the detector's error and the twist.
fn share_out(predicted: &PoseEstimate, prior: &Prior, found: &Pose, found_covariance: &Matrix6<f64>) -> PoseEstimate {
    let PoseEstimate { covariance, detector_covariance, cross_covariance: cross, .. } = predicted;
    let pose_gain = (covariance + cross) * prior.information;
    let error_gain = (detector_covariance + cross.transpose()) * prior.information;
    let Twist { with_pose, with_error, .. } = &predicted.twist;
    let twist_gain = (with_pose + with_error).transpose() * prior.information;
    let innovation = log(&(prior.predicted_from_map * found));
    let gone = prior.covariance - found_covariance;
    let symmetric = |matrix: Matrix6<f64>| (matrix + matrix.transpose()) * 0.5;
    PoseEstimate {
        map_from_vehicle: perturb(&predicted.map_from_vehicle, &(pose_gain * innovation)),
        covariance: symmetric(covariance - pose_gain * gone * pose_gain.transpose()),
        detector_error: predicted.detector_error + error_gain * innovation,
        detector_covariance: symmetric(detector_covariance - error_gain * gone * error_gain.transpose()),
        cross_covariance: cross - pose_gain * gone * error_gain.transpose(),
        remembered: predicted.remembered,
        twist: Twist {
            per_second: predicted.twist.per_second + twist_gain * innovation,
            covariance: symmetric(predicted.twist.covariance - twist_gain * gone * twist_gain.transpose()),
            with_pose: with_pose - pose_gain * gone * twist_gain.transpose(),
            with_error: with_error - error_gain * gone * twist_gain.transpose(),
        },
    }
}

/// What is believed of the sum `s` before the lanes are looked at.
struct Prior {
    predicted_from_map: Pose,
    covariance: Matrix6<f64>,
    information: Matrix6<f64>,
}

impl Prior {
    fn new(predicted: &PoseEstimate, shown: &Pose) -> Option<Self> {
        let cross = &predicted.cross_covariance;
        let sum = predicted.covariance + predicted.detector_covariance + cross + cross.transpose();
        // A variance of nothing at all (a first frame, odometry that claims to be exact) still needs an inverse.
        let covariance = (sum + sum.transpose()) * 0.5 + Matrix6::identity() * 1e-10;
        let information = covariance.cholesky()?.inverse();
        Some(Self { predicted_from_map: shown.inverse(), covariance, information })
    }
}

/// Normal equations of one linearisation.
struct Normal {
    hessian: Matrix6<f64>,
    gradient: Vector6<f64>,
    cost: f64,
}

impl Normal {
    /// The lanes at a pose, and the prior.
    fn with_prior(&self, pose: &Pose, prior: &Prior, params: &TrackingParams) -> Self {
        // With the lines' common error in the state, what is left in a frame is white and small.
        let sharpen = if params.correlation_s > 0.0 { params.sharpness } else { 1.0 };
        let deviation = log(&(prior.predicted_from_map * pose));
        let pull = prior.information * deviation;
        Self {
            hessian: self.hessian * sharpen + prior.information,
            gradient: self.gradient * sharpen + pull,
            cost: self.cost * sharpen + deviation.dot(&pull),
        }
    }

    /// The lanes alone.
    fn lanes_at(lanes: &[MatchedLane<'_>], pose: &Pose, params: &TrackingParams) -> Self {
        let (mut hessian, mut gradient, mut cost) = (Matrix6::zeros(), Vector6::zeros(), 0.0);
        let mut normals = Matrix2::zeros();
        for lane in lanes {
            let feet = (lane.foot_points)(pose);
            normals += normals_of(&feet, pose);
            for axis in [Axis::Lateral, Axis::Vertical] {
                let sums = LineSums::of(axis, &lane.points_vehicle, &feet, pose, params);
                let (h, g, c) = sums.without_line_error(params);
                hessian += h;
                gradient += g;
                cost += c;
            }
        }
        let (hessian, gradient, cost) = without_shared_rotation(&hessian, &gradient, cost, params);
        let (hessian, gradient) = match weak_direction(&normals, params) {
            Some(direction) => without_direction(&hessian, &gradient, &direction),
            None => (hessian, gradient),
        };
        Self { hessian, gradient, cost }
    }

    fn step(&self, damping: f64) -> Option<Vector6<f64>> {
        let damped = self.hessian + Matrix6::from_diagonal(&(self.hessian.diagonal() * damping));
        damped.cholesky().map(|factor| -factor.solve(&self.gradient))
    }
}

/// The two directions across a line.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Axis {
    Lateral,
    Vertical,
}

/// Weighted sums over the points of one line: `J^T D J`, `J^T D B`, `B^T D B`, and the residuals against both.
struct LineSums {
    jj: Matrix6<f64>,
    jb: Matrix6x3<f64>,
    bb: Matrix3<f64>,
    je: Vector6<f64>,
    be: Vector3<f64>,
    ee: f64,
}

impl LineSums {
    fn of(
        axis: Axis,
        points: &[Point3<f64>],
        feet: &[Option<Correspondence>],
        pose: &Pose,
        params: &TrackingParams,
    ) -> Self {
        let mut sums = Self {
            jj: Matrix6::zeros(),
            jb: Matrix6x3::zeros(),
            bb: Matrix3::zeros(),
            je: Vector6::zeros(),
            be: Vector3::zeros(),
            ee: 0.0,
        };
        for (point, foot) in points.iter().zip(feet) {
            let Some(foot) = foot else { continue };
            let variance = params.point_sigma_m * params.point_sigma_m + params.map_doubt * foot.map_variance;
            let direction = across(axis, &foot.tangent_map);
            let residual = direction.dot(&(pose * point - foot.foot_map));
            let jacobian = residual_jacobian(pose, point, &direction);
            let range = point.x;
            let line = Vector3::new(1.0, range, (range / BEND_RANGE_M).powi(2));
            // The kernel judges a residual by all that a sound line may be off there.
            let expected = variance + line_variance(range, params);
            let weight = huber_weight(residual / expected.sqrt(), params.huber_sigmas) / variance;
            sums.jj += jacobian * jacobian.transpose() * weight;
            sums.jb += jacobian * line.transpose() * weight;
            sums.bb += line * line.transpose() * weight;
            sums.je += jacobian * (residual * weight);
            sums.be += line * (residual * weight);
            sums.ee += residual * residual * weight;
        }
        sums
    }

    /// Hessian, gradient and cost with the line's own error polynomial eliminated.
    fn without_line_error(&self, params: &TrackingParams) -> (Matrix6<f64>, Vector6<f64>, f64) {
        let prior = line_sigmas(params).map(|sigma| 1.0 / (sigma * sigma).max(1e-12));
        let Some(factor) = (self.bb + Matrix3::from_diagonal(&prior)).cholesky() else {
            return (self.jj, self.je, self.ee);
        };
        let solved_b = factor.solve(&self.be);
        let hessian = self.jj - self.jb * factor.solve(&self.jb.transpose());
        (hessian, self.je - self.jb * solved_b, self.ee - self.be.dot(&solved_b))
    }
}

fn line_sigmas(params: &TrackingParams) -> Vector3<f64> {
    Vector3::new(params.line_offset_sigma_m, params.line_slope_sigma_rad, params.line_bend_sigma_m)
}

fn line_variance(range_m: f64, params: &TrackingParams) -> f64 {
    let sigmas = line_sigmas(params);
    let slope = sigmas.y * range_m;
    let bend = sigmas.z * (range_m / BEND_RANGE_M).powi(2);
    sigmas.x * sigmas.x + slope * slope + bend * bend
}

/// Unit vector across a line: to its left in plan, or upwards and square to both.
fn across(axis: Axis, tangent: &Vector3<f64>) -> Vector3<f64> {
    let left = Vector3::z().cross(tangent).try_normalize(1e-9).unwrap_or_else(Vector3::y);
    match axis {
        Axis::Lateral => left,
        Axis::Vertical => tangent.cross(&left),
    }
}

/// Derivative of `direction . (T exp(xi) p)` by `xi`.
fn residual_jacobian(pose: &Pose, point: &Point3<f64>, direction: &Vector3<f64>) -> Vector6<f64> {
    let in_vehicle = pose.rotation.inverse() * direction;
    let turning = point.coords.cross(&in_vehicle);
    Vector6::new(in_vehicle.x, in_vehicle.y, in_vehicle.z, turning.x, turning.y, turning.z)
}

fn huber_weight(sigmas: f64, threshold: f64) -> f64 {
    if sigmas.abs() <= threshold { 1.0 } else { threshold / sigmas.abs() }
}

/// Takes out what pitch and yaw errors of the whole frame, which look just like the vehicle's, may have done.
fn without_shared_rotation(
    hessian: &Matrix6<f64>,
    gradient: &Vector6<f64>,
    cost: f64,
    params: &TrackingParams,
) -> (Matrix6<f64>, Vector6<f64>, f64) {
    let (mut hessian, mut gradient, mut cost) = (*hessian, *gradient, cost);
    for (index, sigma) in [(4, params.frame_pitch_sigma_rad), (5, params.frame_yaw_sigma_rad)] {
        let column = hessian.column(index).into_owned();
        let pull = gradient[index];
        let total = hessian[(index, index)] + 1.0 / (sigma * sigma).max(1e-12);
        hessian -= column * column.transpose() / total;
        gradient -= column * (pull / total);
        cost -= pull * pull / total;
    }
    (hessian, gradient, cost)
}

/// The plan direction, in vehicle axes, about which the lanes say next to nothing: along a straight road.
///
/// The normals of all foot points are gathered; where their smallest spread is below a share of the largest, what is left
/// of it is the wiggle of the map and of the detector, which moves along with the vehicle and would hold it back.
fn weak_direction(normals: &Matrix2<f64>, params: &TrackingParams) -> Option<Vector6<f64>> {
    let eigen = normals.symmetric_eigen();
    let (least, most) = (eigen.eigenvalues.imin(), eigen.eigenvalues.imax());
    let is_weak = eigen.eigenvalues[least] < params.weak_direction * eigen.eigenvalues[most];
    let direction = eigen.eigenvectors.column(least);
    is_weak.then(|| Vector6::new(direction[0], direction[1], 0.0, 0.0, 0.0, 0.0))
}

/// Scatter of the normals of some foot points, in plan, vehicle axes.
fn normals_of(feet: &[Option<Correspondence>], pose: &Pose) -> Matrix2<f64> {
    let normal = |foot: &Correspondence| (pose.rotation.inverse() * across(Axis::Lateral, &foot.tangent_map)).xy();
    feet.iter().flatten().map(normal).map(|n| n * n.transpose()).sum()
}

/// Leaves a direction to odometry: `(I - v v^T) H (I - v v^T)`.
fn without_direction(
    hessian: &Matrix6<f64>,
    gradient: &Vector6<f64>,
    direction: &Vector6<f64>,
) -> (Matrix6<f64>, Vector6<f64>) {
    let project = Matrix6::identity() - direction * direction.transpose();
    (project * hessian * project, project * gradient)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        geometry::pose::{covariance_from_sigmas, exp},
        params::{Params, Preset},
    };
    use proptest::prelude::*;

    fn params() -> TrackingParams {
        Params::preset(Preset::Default).tracking
    }

    /// Three straight lines along x, seen from a vehicle whose true pose is `truth`.
    fn scene(truth: &Pose) -> Vec<MatchedLane<'static>> {
        [-3.5, 0.0, 3.5]
            .iter()
            .map(|y| {
                let points_vehicle: Vec<Point3<f64>> =
                    (2..16).map(|k| truth.inverse_transform_point(&Point3::new(3.0 * f64::from(k), *y, 0.0))).collect();
                let points = points_vehicle.clone();
                let y = *y;
                MatchedLane {
                    points_vehicle,
                    foot_points: Box::new(move |pose| {
                        points
                            .iter()
                            .map(|p| {
                                let placed = pose * p;
                                Some(Correspondence {
                                    foot_map: Point3::new(placed.x, y, 0.0),
                                    tangent_map: Vector3::x(),
                                    map_variance: 0.0,
                                })
                            })
                            .collect()
                    }),
                }
            })
            .collect()
    }

    proptest! {
        #[test]
        fn lateral_yaw_and_height_errors_are_found_and_the_way_along_the_road_is_left_to_odometry(
            y in -0.6..0.6f64, z in -0.2..0.2f64, yaw in -0.02..0.02f64, x in -0.5..0.5f64,
        ) {
            let truth = exp(&Vector6::new(x, y, z, 0.0, 0.0, yaw));
            let covariance = covariance_from_sigmas([0.5, 0.5, 0.3], [1e-3, 1e-3, 0.02]);
            let predicted = PoseEstimate { covariance, ..PoseEstimate::first(Pose::identity()) };
            // Errors that all lines share cannot be told from the vehicle's own: leave them out to see the geometry alone.
            let exact = TrackingParams {
                frame_yaw_sigma_rad: 0.0,
                frame_pitch_sigma_rad: 0.0,
                line_offset_sigma_m: 0.05,
                correlation_s: 0.0,
                iterations: 20,
                ..params()
            };
            let found = update_pose(&predicted, &predicted.map_from_vehicle, &scene(&truth), &exact);
            let error = log(&(truth.inverse() * found.map_from_vehicle));
            prop_assert!(error[1].abs() < 0.06 && error[2].abs() < 0.06 && error[5].abs() < 2e-3, "{error}");
            prop_assert!((found.map_from_vehicle.translation.x).abs() < 0.03);
            prop_assert!(found.covariance[(0, 0)] > 0.2 && found.covariance[(1, 1)] < 0.02);
        }

        #[test]
        fn the_jacobian_agrees_with_finite_differences(v in prop::array::uniform6(-0.5..0.5f64), p in prop::array::uniform3(-20.0..20.0f64)) {
            let pose = exp(&Vector6::from_row_slice(&v));
            let point = Point3::from(Vector3::from(p));
            let direction = Vector3::new(0.6, -0.64, 0.48);
            let jacobian = residual_jacobian(&pose, &point, &direction);
            let step = 1e-6;
            for axis in 0..6 {
                let mut xi = Vector6::zeros();
                xi[axis] = step;
                let ahead = direction.dot(&(perturb(&pose, &xi) * point).coords);
                let back = direction.dot(&(perturb(&pose, &-xi) * point).coords);
                prop_assert!(((ahead - back) / (2.0 * step) - jacobian[axis]).abs() < 1e-6);
            }
        }
    }

    #[test]
    fn eliminating_a_line_error_equals_inverting_the_full_covariance() {
        let params = params();
        let pose = Pose::identity();
        let points: Vec<Point3<f64>> = (1..9).map(|k| Point3::new(5.0 * f64::from(k), 1.0, 0.0)).collect();
        let feet: Vec<Option<Correspondence>> = points
            .iter()
            .map(|p| {
                Some(Correspondence {
                    foot_map: Point3::new(p.x, 0.9, 0.0),
                    tangent_map: Vector3::x(),
                    map_variance: 0.0,
                })
            })
            .collect();
        let (hessian, gradient, _) =
            LineSums::of(Axis::Lateral, &points, &feet, &pose, &params).without_line_error(&params);
        let n = points.len();
        let jacobian = nalgebra::DMatrix::from_fn(n, 6, |k, c| residual_jacobian(&pose, &points[k], &Vector3::y())[c]);
        let residual = nalgebra::DVector::from_element(n, 0.1);
        let sigma = line_sigmas(&params);
        let covariance = nalgebra::DMatrix::from_fn(n, n, |a, b| {
            let (ra, rb) = (points[a].x, points[b].x);
            let bend = sigma.z * sigma.z * (ra * rb / 2500.0).powi(2);
            let white = if a == b { params.point_sigma_m.powi(2) } else { 0.0 };
            sigma.x * sigma.x + sigma.y * sigma.y * ra * rb + bend + white
        });
        let information = covariance.try_inverse().unwrap();
        let expected = jacobian.transpose() * &information * &jacobian;
        let expected_gradient = jacobian.transpose() * &information * residual;
        for a in 0..6 {
            assert!((gradient[a] - expected_gradient[a]).abs() < 1e-6 * (1.0 + expected_gradient[a].abs()));
            for b in 0..6 {
                assert!((hessian[(a, b)] - expected[(a, b)]).abs() < 1e-6 * (1.0 + expected.amax()));
            }
        }
    }
}
