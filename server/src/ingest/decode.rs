//! From the wire to a validated frame: parsed once, trusted afterwards.
//!
//! Points come in the session's axis convention and leave in the vehicle frame. Counts are checked before anything is
//! copied, so that a message of a million points costs no more than its own bytes.

use lanemap_core::{
    Detection, FieldOfView, Frame, FrameLimits, FrameParts, GnssFix, Odometry, Preset, Sensor, Sequence, TimestampNs,
    geometry::Pose,
};
use lanemap_proto::{
    decode,
    v1::{self, AxisConvention, RefusalReason},
};
use nalgebra::{Point3, Vector3};

use super::Refusal;
use crate::session::{SessionKey, SessionSetup};

/// Least points of a lane line.
const MIN_POINTS: usize = 2;
/// Most characters of an id.
const MAX_ID_CHARS: usize = 128;
/// Farthest mount of a sensor from the vehicle's origin, metres, on each axis.
const MAX_MOUNT_M: f64 = 100.0;
/// Largest tangent of half an opening angle.
const MAX_TANGENT: f64 = 100.0;

/// Where the points of a session's detections are given.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum PointFrame {
    /// In the vehicle frame.
    Vehicle,
    /// In a sensor frame: x forward, y left, z up.
    Sensor {
        /// Mount of the sensor.
        vehicle_from_sensor: Pose,
    },
    /// In an optical frame: x right, y down, z forward.
    Optical {
        /// Mount of the sensor, whose axes are x forward, y left, z up.
        vehicle_from_sensor: Pose,
    },
    /// In OpenLane's ground frame: x right, y front, z up, straight below the sensor.
    OpenLaneGround {
        /// Horizontal position of the sensor in the vehicle frame, metres.
        offset: Vector3<f64>,
    },
}

impl PointFrame {
    /// The convention of a session whose sensor is mounted at `vehicle_from_sensor`.
    fn new(convention: AxisConvention, sensor: &Sensor) -> Option<Self> {
        let vehicle_from_sensor = sensor.vehicle_from_sensor;
        match convention {
            AxisConvention::Unspecified => None,
            AxisConvention::Vehicle => Some(Self::Vehicle),
            AxisConvention::SensorForwardLeftUp => Some(Self::Sensor { vehicle_from_sensor }),
            AxisConvention::SensorRightDownForward => Some(Self::Optical { vehicle_from_sensor }),
            AxisConvention::OpenlaneGround => Some(Self::OpenLaneGround { offset: sensor.ground_offset() }),
        }
    }

    /// A point of this frame in the vehicle frame.
    #[must_use]
    pub fn to_vehicle(&self, point: &Point3<f64>) -> Point3<f64> {
        match self {
            Self::Vehicle => *point,
            Self::Sensor { vehicle_from_sensor } => vehicle_from_sensor * point,
            Self::Optical { vehicle_from_sensor } => vehicle_from_sensor * Point3::new(point.z, -point.x, -point.y),
            Self::OpenLaneGround { offset } => Point3::new(point.y, -point.x, point.z) + offset,
        }
    }
}

/// What a session's start says, in our types.
#[derive(Clone, Debug)]
pub struct Start {
    /// Which drive.
    pub key: SessionKey,
    /// How it is mapped.
    pub setup: SessionSetup,
    /// Axes of its detections.
    pub point_frame: PointFrame,
    /// Whether local maps are wanted.
    pub wants_local_map: bool,
}

/// Decodes a session's start.
///
/// # Errors
/// The first field that is missing or out of range.
pub fn start(message: &v1::SessionStart) -> Result<Start, Refusal> {
    let key = SessionKey {
        fleet: id(&message.fleet_id, "start.fleet_id")?,
        vehicle: id(&message.vehicle_id, "start.vehicle_id")?,
        drive: id(&message.drive_id, "start.drive_id")?,
    };
    let wire_sensor = decode::required(message.sensor.as_ref(), || "start.sensor".to_owned())?;
    let sensor = sensor(wire_sensor)?;
    let listed = AxisConvention::try_from(wire_sensor.axis_convention);
    let point_frame = listed.ok().and_then(|convention| PointFrame::new(convention, &sensor)).ok_or_else(|| {
        let value = listed.map_or_else(|_| wire_sensor.axis_convention.to_string(), |c| c.as_str_name().to_owned());
        let limit = "a convention that the protocol lists, other than unspecified";
        Refusal::new(RefusalReason::OutOfRange, "start.sensor.axis_convention", value, limit)
    })?;
    let setup = SessionSetup { preset: preset(message.preset)?, sensor };
    Ok(Start { key, setup, point_frame, wants_local_map: message.wants_local_map })
}

fn id(text: &str, field: &str) -> Result<String, Refusal> {
    let count = text.chars().count();
    match count {
        0 => Err(Refusal::new(RefusalReason::Missing, field, "empty", "1 to 128 characters")),
        1..=MAX_ID_CHARS => Ok(text.to_owned()),
        _ => Err(Refusal::new(RefusalReason::TooMany, field, format!("{count} characters"), "1 to 128 characters")),
    }
}

fn preset(code: i32) -> Result<Preset, Refusal> {
    match v1::MapperPreset::try_from(code) {
        Ok(v1::MapperPreset::Unspecified | v1::MapperPreset::Default) => Ok(Preset::Default),
        Ok(v1::MapperPreset::Paper) => Ok(Preset::Paper),
        Err(_) => {
            Err(Refusal::new(RefusalReason::OutOfRange, "start.preset", code, "a number that the protocol lists"))
        }
    }
}

fn sensor(message: &v1::Sensor) -> Result<Sensor, Refusal> {
    let field = "start.sensor.vehicle_from_sensor";
    let vehicle_from_sensor = decode::pose(message.vehicle_from_sensor.as_ref(), field)?;
    for (axis, value) in ["x", "y", "z"].into_iter().zip(vehicle_from_sensor.translation.vector.iter()) {
        if value.abs() > MAX_MOUNT_M {
            let limit = format!("-{MAX_MOUNT_M} ..= {MAX_MOUNT_M}");
            return Err(Refusal::new(RefusalReason::OutOfRange, format!("{field}.position.{axis}"), value, limit));
        }
    }
    let field_of_view = message.field_of_view.as_ref().map(field_of_view).transpose()?;
    Ok(Sensor { vehicle_from_sensor, field_of_view })
}

fn field_of_view(message: &v1::FieldOfView) -> Result<FieldOfView, Refusal> {
    let tangent = |value: f64, name: &str| {
        if value > 0.0 && value <= MAX_TANGENT {
            return Ok(value);
        }
        let field = format!("start.sensor.field_of_view.{name}");
        Err(Refusal::new(RefusalReason::OutOfRange, field, value, format!("above 0, at most {MAX_TANGENT}")))
    };
    Ok(FieldOfView {
        tan_left: tangent(message.tan_left, "tan_left")?,
        tan_right: tangent(message.tan_right, "tan_right")?,
        tan_up: tangent(message.tan_up, "tan_up")?,
        tan_down: tangent(message.tan_down, "tan_down")?,
    })
}

/// Decodes and validates a frame.
///
/// # Errors
/// The first field that is missing, not finite, out of range, too long or too short; the refusal names the frame.
pub fn frame(message: &v1::Frame, points: &PointFrame, limits: &FrameLimits) -> Result<Frame, Refusal> {
    let sequence = Sequence(message.sequence);
    frame_parts(message, points, limits)
        .and_then(|parts| Frame::new(parts, limits).map_err(Refusal::from_frame_error))
        .map_err(|refusal| refusal.of_frame(sequence))
}

fn frame_parts(message: &v1::Frame, points: &PointFrame, limits: &FrameLimits) -> Result<FrameParts, Refusal> {
    let count = message.detections.len();
    at_most(count, limits.max_detections, || "frame.detections".to_owned())?;
    let odometry = decode::required(message.odometry.as_ref(), || "frame.odometry".to_owned())?;
    let detections = message.detections.iter().enumerate();
    Ok(FrameParts {
        sequence: Sequence(message.sequence),
        time: TimestampNs(message.time_unix_ns),
        odometry: odometry_of(odometry)?,
        gnss: message.gnss.as_ref().map(gnss_fix).transpose()?,
        detections: detections
            .map(|(index, message)| detection(message, index, points, limits))
            .collect::<Result<_, _>>()?,
    })
}

fn odometry_of(message: &v1::Odometry) -> Result<Odometry, Refusal> {
    let pose = decode::pose(message.odometry_from_vehicle.as_ref(), "frame.odometry.odometry_from_vehicle")?;
    let covariance = message.motion_covariance.as_ref();
    let covariance =
        covariance.map(|m| decode::tangent_covariance(m, "frame.odometry.motion_covariance")).transpose()?;
    Ok(Odometry { odometry_from_vehicle: pose, motion_covariance: covariance })
}

fn gnss_fix(message: &v1::GnssFix) -> Result<GnssFix, Refusal> {
    let position = decode::required(message.position.as_ref(), || "frame.gnss.position".to_owned())?;
    Ok(GnssFix {
        latitude_deg: position.latitude_deg,
        longitude_deg: position.longitude_deg,
        height_m: position.height_m,
        horizontal_sigma_m: message.horizontal_sigma_m,
        vertical_sigma_m: message.vertical_sigma_m,
        yaw_enu_rad: message.yaw_enu_rad,
    })
}

fn detection(
    message: &v1::Detection,
    index: usize,
    frame: &PointFrame,
    limits: &FrameLimits,
) -> Result<Detection, Refusal> {
    let field = || format!("frame.detections[{index}].points");
    let count = message.xyz.len() / 3;
    at_most(count, limits.max_points_per_detection, field)?;
    if count < MIN_POINTS {
        let (value, limit) = (format!("{count} entries"), format!("at least {MIN_POINTS}"));
        return Err(Refusal::new(RefusalReason::TooFew, field(), value, limit));
    }
    let mut points = decode::points(&message.xyz, || format!("frame.detections[{index}].xyz"))?;
    // Named before they are turned: a rotation would spread a NaN over all three axes.
    for (k, point) in points.iter().enumerate() {
        for (axis, value) in ["x", "y", "z"].into_iter().zip(point.iter()) {
            if !value.is_finite() {
                return Err(Refusal::new(
                    RefusalReason::NotFinite,
                    format!("{}[{k}].{axis}", field()),
                    value,
                    "finite",
                ));
            }
        }
    }
    for point in &mut points {
        *point = frame.to_vehicle(point);
    }
    let category = decode::category(message.category, || format!("frame.detections[{index}].category"))?;
    Ok(Detection { category, points_vehicle: points })
}

fn at_most(count: usize, limit: usize, field: impl FnOnce() -> String) -> Result<(), Refusal> {
    if count <= limit {
        return Ok(());
    }
    Err(Refusal::new(RefusalReason::TooMany, field(), format!("{count} entries"), format!("at most {limit}")))
}

#[cfg(test)]
mod tests {
    use lanemap_core::{Category, geometry::TangentCovariance};
    use lanemap_proto::encode;
    use nalgebra::{Translation3, UnitQuaternion};
    use proptest::prelude::*;
    use prost::Message;

    use super::*;
    use crate::journal::frame_bytes;

    fn mount() -> Pose {
        Pose::from_parts(Translation3::new(1.5, 0.1, 1.4), UnitQuaternion::from_euler_angles(0.0, 0.02, 0.01))
    }

    #[test]
    fn a_point_is_the_same_point_in_every_convention() {
        let in_vehicle = Point3::new(20.0, 3.0, -0.3);
        let in_sensor = mount().inverse() * in_vehicle;
        let optical = Point3::new(-in_sensor.y, -in_sensor.z, in_sensor.x);
        let ground = Point3::new(-(in_vehicle.y - 0.1), in_vehicle.x - 1.5, in_vehicle.z);
        let sensor = Sensor { vehicle_from_sensor: mount(), field_of_view: None };
        for (convention, point) in [
            (AxisConvention::Vehicle, in_vehicle),
            (AxisConvention::SensorForwardLeftUp, in_sensor),
            (AxisConvention::SensorRightDownForward, optical),
            (AxisConvention::OpenlaneGround, ground),
        ] {
            let frame = PointFrame::new(convention, &sensor).unwrap();
            assert!((frame.to_vehicle(&point) - in_vehicle).norm() < 1e-12, "{convention:?}");
        }
    }

    fn message(xyz: Vec<f64>) -> v1::Frame {
        v1::Frame {
            sequence: 7,
            odometry: Some(v1::Odometry {
                odometry_from_vehicle: Some(encode::pose(&Pose::identity())),
                motion_covariance: None,
            }),
            detections: vec![v1::Detection { category: 1, xyz }],
            ..v1::Frame::default()
        }
    }

    fn refusal(xyz: Vec<f64>) -> String {
        frame(&message(xyz), &PointFrame::Vehicle, &FrameLimits::default()).unwrap_err().to_string()
    }

    fn any_frame() -> impl Strategy<Value = Frame> {
        let number = -400.0..400.0f64;
        let point = prop::array::uniform3(number.clone()).prop_map(Point3::from);
        let category = prop::sample::select(&Category::ALL[..]);
        let detection = (category, prop::collection::vec(point, 2..9))
            .prop_map(|(category, points_vehicle)| Detection { category, points_vehicle });
        let fix = (-90.0..90.0f64, -180.0..180.0f64, number.clone(), prop::option::of(-3.0..3.0f64)).prop_map(
            |(latitude_deg, longitude_deg, height_m, yaw_enu_rad)| GnssFix {
                latitude_deg,
                longitude_deg,
                height_m,
                horizontal_sigma_m: 0.7,
                vertical_sigma_m: 1.3,
                yaw_enu_rad,
            },
        );
        let pose = (prop::array::uniform3(number), prop::array::uniform3(-3.0..3.0f64)).prop_map(|(t, r)| {
            Pose::from_parts(Translation3::new(t[0], t[1], t[2]), UnitQuaternion::from_scaled_axis(r.into()))
        });
        let variances = prop::option::of(prop::array::uniform6(0.0..1.0f64));
        let detections = prop::collection::vec(detection, 0..5);
        (any::<u64>(), any::<i64>(), pose, variances, prop::option::of(fix), detections).prop_map(
            |(sequence, time, odometry_from_vehicle, variances, gnss, detections)| {
                let motion_covariance = variances.map(|v| TangentCovariance::from_diagonal(&v.into()));
                let odometry = Odometry { odometry_from_vehicle, motion_covariance };
                let (sequence, time) = (Sequence(sequence), TimestampNs(time));
                let parts = FrameParts { sequence, time, odometry, gnss, detections };
                Frame::new(parts, &FrameLimits::default()).unwrap()
            },
        )
    }

    proptest! {
        #[test]
        fn a_frame_crosses_the_wire_bit_by_bit(frame in any_frame()) {
            let bytes = encode::frame(&frame).encode_to_vec();
            let message = v1::Frame::decode(bytes.as_slice()).unwrap();
            let decoded = super::frame(&message, &PointFrame::Vehicle, &FrameLimits::default()).unwrap();
            prop_assert_eq!(frame_bytes(&decoded).unwrap(), frame_bytes(&frame).unwrap());
        }

        #[test]
        fn no_bytes_panic_the_decoder(bytes in prop::collection::vec(any::<u8>(), 0..200)) {
            if let Ok(message) = v1::Frame::decode(bytes.as_slice()) {
                let _ = frame(&message, &PointFrame::Vehicle, &FrameLimits::default());
            }
            if let Ok(message) = v1::SessionStart::decode(bytes.as_slice()) {
                let _ = start(&message);
            }
        }
    }

    #[test]
    fn each_bad_line_is_refused_by_field_value_and_limit() {
        let field = "frame 7: frame.detections[0].points";
        assert_eq!(refusal(vec![]), format!("{field} is 0 entries, limit: at least 2"));
        assert_eq!(refusal(vec![1.0; 3]), format!("{field} is 1 entries, limit: at least 2"));
        assert_eq!(refusal(vec![1.0; 3_000_000]), format!("{field} is 1000000 entries, limit: at most 4096"));
        let nan = vec![1.0, 0.0, 0.0, 2.0, f64::NAN, 0.0];
        assert_eq!(refusal(nan), format!("{field}[1].y is NaN, limit: finite"));
        let huge = vec![1.0, 0.0, 0.0, 2.0, 0.0, 1e300];
        assert!(refusal(huge).starts_with(&format!("{field}[1].z is 1000000")));
        let torn = "frame 7: frame.detections[0].xyz is 7 entries, limit: a multiple of 3";
        assert_eq!(refusal(vec![1.0; 7]), torn);
    }

    #[test]
    fn a_frame_without_odometry_is_refused() {
        let bare = v1::Frame { odometry: None, ..message(vec![1.0; 6]) };
        let error = frame(&bare, &PointFrame::Vehicle, &FrameLimits::default()).unwrap_err();
        assert_eq!((error.reason, error.field.as_str()), (RefusalReason::Missing, "frame.odometry"));
    }
}
