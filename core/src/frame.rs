//! The input of the mapper: one frame of one vehicle, validated once and trusted afterwards.

mod bytes;
mod occlusion;

use nalgebra::Point3;
use serde::{Deserialize, Serialize};

use crate::{
    category::Category,
    error::FrameError,
    geometry::{Pose, TangentCovariance, pose::without_negative_zeros},
    sensor::Sensor,
};

pub use bytes::FrameBytesError;
pub use occlusion::{MAX_OCCLUSIONS, Occlusion};

/// Number of a frame in its stream; strictly increasing within a session.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct Sequence(pub u64);

/// Time of measurement, nanoseconds since the Unix epoch.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct TimestampNs(pub i64);

impl TimestampNs {
    /// Seconds from `earlier` to `self`; negative where `earlier` is later.
    #[must_use]
    pub fn seconds_since(self, earlier: Self) -> f64 {
        self.0.saturating_sub(earlier.0) as f64 * 1e-9
    }
}

/// One frame: where the vehicle believes it is, and the lanes that it sees.
///
/// Made only by [`Frame::new`], so that a frame that exists is valid.
#[derive(Clone, Debug, PartialEq)]
pub struct Frame {
    parts: FrameParts,
}

/// The fields of a [`Frame`] before validation.
#[derive(Clone, Debug, PartialEq)]
pub struct FrameParts {
    /// Number in the stream.
    pub sequence: Sequence,
    /// Time of measurement.
    pub time: TimestampNs,
    /// The vehicle's own estimate of its motion.
    pub odometry: Odometry,
    /// Position on the earth, where the vehicle has one for this frame.
    pub gnss: Option<GnssFix>,
    /// Lane lines seen in this frame.
    pub detections: Vec<Detection>,
    /// What is hidden behind other vehicles and the like, where the vehicle knows; none: it does not know.
    pub occlusions: Vec<Occlusion>,
}

/// Odometry: a pose in a frame that is smooth but drifts.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Odometry {
    /// Pose of the vehicle in the odometry frame of this drive (metres, z up).
    pub odometry_from_vehicle: Pose,
    /// Covariance of the motion since the previous frame, in this frame's vehicle axes; `None`: the mapper's default.
    pub motion_covariance: Option<TangentCovariance>,
}

/// A GNSS fix of the vehicle's origin.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct GnssFix {
    /// WGS84 latitude, degrees, in `[-90, 90]`.
    pub latitude_deg: f64,
    /// WGS84 longitude, degrees, in `[-180, 180]`.
    pub longitude_deg: f64,
    /// Height above the WGS84 ellipsoid, metres.
    pub height_m: f64,
    /// Standard deviation of the horizontal position, metres, above zero.
    pub horizontal_sigma_m: f64,
    /// Standard deviation of the height, metres, above zero.
    pub vertical_sigma_m: f64,
    /// Heading of the vehicle's x axis, radians counter-clockwise from east, where the receiver measures it.
    pub yaw_enu_rad: Option<f64>,
}

/// One detected lane line.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Detection {
    /// What the detector took it for.
    pub category: Category,
    /// Points on the line, vehicle frame (x forward, y left, z up), metres, in any order.
    pub points_vehicle: Vec<Point3<f64>>,
}

/// Bounds on a frame, checked by [`Frame::new`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FrameLimits {
    /// Most detections in a frame.
    pub max_detections: usize,
    /// Most points in one detection.
    pub max_points_per_detection: usize,
    /// Farthest point from the vehicle, metres, on each axis.
    pub max_point_range_m: f64,
    /// Farthest odometry position from the origin of its frame, metres, on each axis.
    pub max_odometry_range_m: f64,
}

impl Default for FrameLimits {
    fn default() -> Self {
        Self { max_detections: 64, max_points_per_detection: 4096, max_point_range_m: 500.0, max_odometry_range_m: 1e7 }
    }
}

impl Frame {
    /// Validates the parts of a frame. A -0 in its pose, fix or occlusions becomes 0: the wire does not tell them apart, and a frame
    /// is to be the same to the last bit on both of its sides.
    ///
    /// # Errors
    /// The first field that is not finite, out of range, too long, or not a covariance; the error names it.
    pub fn new(mut parts: FrameParts, limits: &FrameLimits) -> Result<Self, FrameError> {
        check_odometry(&parts.odometry, limits)?;
        if let Some(fix) = &parts.gnss {
            check_gnss(fix)?;
        }
        check_detections(&parts.detections, limits)?;
        occlusion::check(&parts.occlusions, limits)?;
        parts.odometry.odometry_from_vehicle = without_negative_zeros(&parts.odometry.odometry_from_vehicle);
        parts.gnss = parts.gnss.map(GnssFix::without_negative_zeros);
        for occlusion in &mut parts.occlusions {
            *occlusion = occlusion.without_negative_zeros();
        }
        Ok(Self { parts })
    }

    /// Number in the stream.
    #[must_use]
    pub fn sequence(&self) -> Sequence {
        self.parts.sequence
    }

    /// Time of measurement.
    #[must_use]
    pub fn time(&self) -> TimestampNs {
        self.parts.time
    }

    /// The vehicle's own estimate of its motion.
    #[must_use]
    pub fn odometry(&self) -> &Odometry {
        &self.parts.odometry
    }

    /// Position on the earth, where there is one.
    #[must_use]
    pub fn gnss(&self) -> Option<&GnssFix> {
        self.parts.gnss.as_ref()
    }

    /// Lane lines seen in this frame.
    #[must_use]
    pub fn detections(&self) -> &[Detection] {
        &self.parts.detections
    }

    /// What is hidden behind other vehicles and the like; empty where the vehicle does not know.
    #[must_use]
    pub fn occlusions(&self) -> &[Occlusion] {
        &self.parts.occlusions
    }

    /// Whether the vehicle knows that a point on the road (vehicle frame, metres) is hidden from its camera.
    #[must_use]
    pub fn hides(&self, point_vehicle: &Point3<f64>, sensor: &Sensor) -> bool {
        self.parts.occlusions.iter().any(|occlusion| occlusion.hides(point_vehicle, sensor))
    }
}

impl GnssFix {
    fn without_negative_zeros(self) -> Self {
        Self {
            latitude_deg: self.latitude_deg + 0.0,
            longitude_deg: self.longitude_deg + 0.0,
            height_m: self.height_m + 0.0,
            // Not zero, or told apart by the wire.
            horizontal_sigma_m: self.horizontal_sigma_m,
            vertical_sigma_m: self.vertical_sigma_m,
            yaw_enu_rad: self.yaw_enu_rad,
        }
    }
}

fn check_odometry(odometry: &Odometry, limits: &FrameLimits) -> Result<(), FrameError> {
    let position = odometry.odometry_from_vehicle.translation.vector;
    let maximum = limits.max_odometry_range_m;
    for (axis, value) in ["x", "y", "z"].into_iter().zip(position.iter()) {
        in_range(*value, -maximum, maximum, || format!("odometry.position.{axis}"))?;
    }
    let rotation = odometry.odometry_from_vehicle.rotation.coords;
    for value in rotation.iter() {
        in_range(*value, -1.0 - 1e-6, 1.0 + 1e-6, || "odometry.rotation".to_owned())?;
    }
    match &odometry.motion_covariance {
        Some(covariance) => check_covariance(covariance, "odometry.motion_covariance"),
        None => Ok(()),
    }
}

/// Largest variance that a motion covariance may hold, m^2 or rad^2.
const MAX_VARIANCE: f64 = 1e4;

fn check_covariance(covariance: &TangentCovariance, field: &str) -> Result<(), FrameError> {
    for value in covariance.iter() {
        in_range(*value, -MAX_VARIANCE, MAX_VARIANCE, || field.to_owned())?;
    }
    let refuse = |reason| Err(FrameError::Covariance { field: field.to_owned(), reason });
    let scale = covariance.amax();
    if (covariance - covariance.transpose()).amax() > 1e-9 * scale {
        return refuse("it is not symmetric");
    }
    if covariance.diagonal().iter().any(|variance| *variance < 0.0) {
        return refuse("it has a negative variance");
    }
    if covariance.symmetric_eigenvalues().min() < -1e-9 * scale {
        return refuse("it has a negative eigenvalue");
    }
    Ok(())
}

fn check_gnss(fix: &GnssFix) -> Result<(), FrameError> {
    in_range(fix.latitude_deg, -90.0, 90.0, || "gnss.latitude_deg".to_owned())?;
    in_range(fix.longitude_deg, -180.0, 180.0, || "gnss.longitude_deg".to_owned())?;
    in_range(fix.height_m, -1_000.0, 10_000.0, || "gnss.height_m".to_owned())?;
    in_range(fix.horizontal_sigma_m, 1e-3, 1e4, || "gnss.horizontal_sigma_m".to_owned())?;
    in_range(fix.vertical_sigma_m, 1e-3, 1e4, || "gnss.vertical_sigma_m".to_owned())?;
    match fix.yaw_enu_rad {
        Some(yaw) => in_range(yaw, -7.0, 7.0, || "gnss.yaw_enu_rad".to_owned()),
        None => Ok(()),
    }
}

fn check_detections(detections: &[Detection], limits: &FrameLimits) -> Result<(), FrameError> {
    at_most(detections.len(), limits.max_detections, || "detections".to_owned())?;
    let maximum = limits.max_point_range_m;
    for (index, detection) in detections.iter().enumerate() {
        let points = &detection.points_vehicle;
        at_most(points.len(), limits.max_points_per_detection, || format!("detections[{index}].points"))?;
        for (k, point) in points.iter().enumerate() {
            for (axis, value) in ["x", "y", "z"].into_iter().zip(point.iter()) {
                in_range(*value, -maximum, maximum, || format!("detections[{index}].points[{k}].{axis}"))?;
            }
        }
    }
    Ok(())
}

fn in_range(value: f64, minimum: f64, maximum: f64, field: impl FnOnce() -> String) -> Result<(), FrameError> {
    if !value.is_finite() {
        return Err(FrameError::NotFinite { field: field(), value });
    }
    if value < minimum || value > maximum {
        return Err(FrameError::OutOfRange { field: field(), value, minimum, maximum });
    }
    Ok(())
}

fn at_most(count: usize, limit: usize, field: impl FnOnce() -> String) -> Result<(), FrameError> {
    if count > limit {
        return Err(FrameError::TooMany { field: field(), count, limit });
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parts() -> FrameParts {
        FrameParts {
            sequence: Sequence(1),
            time: TimestampNs(0),
            odometry: Odometry { odometry_from_vehicle: Pose::identity(), motion_covariance: None },
            gnss: None,
            detections: vec![Detection {
                category: Category::WhiteSolid,
                points_vehicle: vec![Point3::new(5.0, 1.0, 0.0)],
            }],
            occlusions: Vec::new(),
        }
    }

    fn refusal(parts: FrameParts) -> String {
        Frame::new(parts, &FrameLimits::default()).unwrap_err().to_string()
    }

    #[test]
    fn a_nan_is_refused_by_the_name_of_its_field() {
        let mut bad = parts();
        bad.detections[0].points_vehicle[0].y = f64::NAN;
        assert_eq!(refusal(bad), "detections[0].points[0].y is not finite: NaN");
    }

    #[test]
    fn a_point_beyond_the_limit_is_refused_with_value_and_limit() {
        let mut bad = parts();
        bad.detections[0].points_vehicle[0].x = 501.0;
        assert_eq!(refusal(bad), "detections[0].points[0].x = 501 is outside -500 ..= 500");
    }

    #[test]
    fn a_covariance_with_a_negative_eigenvalue_is_refused() {
        let mut bad = parts();
        let mut covariance = TangentCovariance::identity();
        covariance[(0, 1)] = 2.0;
        covariance[(1, 0)] = 2.0;
        bad.odometry.motion_covariance = Some(covariance);
        assert_eq!(refusal(bad), "odometry.motion_covariance is not a covariance: it has a negative eigenvalue");
    }

    #[test]
    fn too_many_points_are_refused_with_their_count() {
        let mut bad = parts();
        bad.detections[0].points_vehicle = vec![Point3::origin(); 5000];
        assert_eq!(refusal(bad), "detections[0].points has 5000 entries, limit 4096");
    }

    #[test]
    fn a_negative_zero_of_a_pose_is_a_zero() {
        let mut negative = parts();
        negative.odometry.odometry_from_vehicle = Pose::translation(-0.0, 3.0, -0.0);
        let frame = Frame::new(negative, &FrameLimits::default()).unwrap();
        let place = frame.odometry().odometry_from_vehicle.translation;
        assert!(place.x.is_sign_positive() && place.z.is_sign_positive(), "{place}");
    }

    #[test]
    fn a_frame_without_detections_is_a_frame() {
        let mut empty = parts();
        empty.detections.clear();
        assert!(Frame::new(empty, &FrameLimits::default()).is_ok());
    }
}
