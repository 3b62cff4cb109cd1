//! From the wire to what a session takes, or a refusal that names the field.

use lanemap_core::{Frame, FrameLimits, Preset, Sequence};
pub use lanemap_proto::decode::PointFrame;
use lanemap_proto::{
    decode,
    v1::{self, RefusalReason},
};

use super::Refusal;
use crate::session::{SessionKey, SessionSetup, forget::Whom};

/// Most characters of an id.
const MAX_ID_CHARS: usize = 128;

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
    let sensor = decode::required(message.sensor.as_ref(), || "start.sensor".to_owned())?;
    let (sensor, point_frame) = decode::sensor(sensor)?;
    let setup = SessionSetup { preset: preset(message.preset)?, sensor };
    Ok(Start { key, setup, point_frame, wants_local_map: message.wants_local_map })
}

/// Decodes whom to forget.
///
/// # Errors
/// The first name that is missing or out of range.
pub fn forget(message: &v1::ForgetRequest) -> Result<Whom, Refusal> {
    let fleet = id(&message.fleet_id, "fleet_id")?;
    let vehicle = id(&message.vehicle_id, "vehicle_id")?;
    let drive = message.drive_id.as_ref().map(|drive| id(drive, "drive_id")).transpose()?;
    Ok(match drive {
        Some(drive) => Whom::Drive(SessionKey { fleet, vehicle, drive }),
        None => Whom::Vehicle { fleet, vehicle },
    })
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

/// Decodes and validates a frame.
///
/// # Errors
/// The first field that is missing, not finite, out of range, too long or too short; the refusal names the frame.
pub fn frame(message: &v1::Frame, points: &PointFrame, limits: &FrameLimits) -> Result<Frame, Refusal> {
    decode::frame(message, points, limits).map_err(|error| Refusal::from(error).of_frame(Sequence(message.sequence)))
}

#[cfg(test)]
mod tests {
    use lanemap_core::{
        Category, Detection, FrameParts, GnssFix, Occlusion, Odometry, TimestampNs,
        geometry::{Pose, TangentCovariance},
    };
    use lanemap_proto::encode;
    use nalgebra::{Point3, Translation3, UnitQuaternion};
    use proptest::prelude::*;
    use prost::Message;

    use super::*;
    use crate::journal::frame_bytes;

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
        let occlusion = (-3.1..3.1f64, 0.0..6.0f64, 0.0..500.0f64)
            .prop_map(|(from_rad, width_rad, range_m)| Occlusion { from_rad, to_rad: from_rad + width_rad, range_m });
        let occlusions = prop::collection::vec(occlusion, 0..4);
        (any::<u64>(), any::<i64>(), pose, variances, prop::option::of(fix), detections, occlusions).prop_map(
            |(sequence, time, odometry_from_vehicle, variances, gnss, detections, occlusions)| {
                let motion_covariance = variances.map(|v| TangentCovariance::from_diagonal(&v.into()));
                let odometry = Odometry { odometry_from_vehicle, motion_covariance };
                let (sequence, time) = (Sequence(sequence), TimestampNs(time));
                let parts = FrameParts { sequence, time, odometry, gnss, detections, occlusions };
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
            let kept = frame_bytes(&frame).unwrap();
            prop_assert_eq!(&frame_bytes(&decoded).unwrap(), &kept);
            prop_assert_eq!(Frame::from_bytes(&kept).unwrap(), frame);
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
    fn a_bad_occlusion_is_refused_by_field_value_and_limit() {
        let hidden = |from_rad, to_rad, range_m| {
            let occlusions = vec![v1::Occlusion { from_rad, to_rad, range_m }];
            let message = v1::Frame { occlusions, ..message(vec![1.0; 6]) };
            frame(&message, &PointFrame::Vehicle, &FrameLimits::default()).unwrap_err().to_string()
        };
        let field = "frame 7: frame.occlusions[0]";
        assert_eq!(hidden(0.0, f64::NAN, 9.0), format!("{field}.to_rad is NaN, limit: finite"));
        assert_eq!(hidden(0.0, 1.0, 501.0), format!("{field}.range_m is 501, limit: 0 ..= 500"));
        assert!(hidden(4.0, 5.0, 9.0).starts_with(&format!("{field}.from_rad is 4, limit: -3.14")));
    }

    #[test]
    fn a_frame_without_odometry_is_refused() {
        let bare = v1::Frame { odometry: None, ..message(vec![1.0; 6]) };
        let error = frame(&bare, &PointFrame::Vehicle, &FrameLimits::default()).unwrap_err();
        assert_eq!((error.reason, error.field.as_str()), (RefusalReason::Missing, "frame.odometry"));
    }
}
