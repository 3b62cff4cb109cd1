//! Promise: bad input is refused with field, value and limit; its stream and its neighbours go on.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)] // A test's helpers fail loudly too.

use lanemap_proto::{encode, v1, v1::RefusalReason, v1::stream_observations_request::Message};
use lanemap_tests::{
    drives::{self, Drive},
    raw_stream::RawStream,
    servers,
};
use tonic::Code;

/// A good frame of the drive, to be spoiled.
fn good(drive: &Drive, index: usize) -> v1::Frame {
    let frame = encode::frame(&drive.frames[index]);
    assert!(!frame.detections.is_empty(), "frame {index} sees no line");
    frame
}

/// Sends a spoiled frame between two good ones, beside a neighbour on the same server; gives the refusal.
async fn refusal_of(spoil: impl FnOnce(&mut v1::Frame)) -> v1::Refusal {
    let folder = tempfile::tempdir().unwrap();
    let server = servers::start(folder.path()).await;
    let drive = drives::simulated(1, 5);
    let neighbour_drive = drives::simulated(2, 5);
    let (mut stream, _) = RawStream::started(&server.url(), drive.wire_start()).await;
    let (mut neighbour, _) = RawStream::started(&server.url(), neighbour_drive.wire_start()).await;

    stream.send_frame(good(&drive, 1)).await;
    stream.acked(2).await;
    let mut spoiled = good(&drive, 2);
    spoil(&mut spoiled);
    stream.send_frame(spoiled).await;
    let refusal = stream.refusal().await;

    stream.send_frame(good(&drive, 3)).await;
    stream.acked(4).await;
    neighbour.send_frame(good(&neighbour_drive, 0)).await;
    neighbour.acked(1).await;
    server.shutdown().await;
    refusal
}

fn first_line(frame: &mut v1::Frame) -> &mut v1::Detection {
    &mut frame.detections[0]
}

#[track_caller]
fn assert_names(refusal: &v1::Refusal, reason: RefusalReason, field: &str, value: &str, limit: &str) {
    assert_eq!(refusal.reason(), reason, "{refusal:?}");
    assert_eq!((&*refusal.field, &*refusal.value, &*refusal.limit), (field, value, limit), "{refusal:?}");
    assert!(refusal.message.contains(field) && refusal.message.contains(value) && refusal.message.contains(limit));
}

#[tokio::test]
async fn a_nan_in_one_detection_refuses_that_frame_only() {
    let refusal = refusal_of(|frame| first_line(frame).xyz[4] = f64::NAN).await;
    assert_names(&refusal, RefusalReason::NotFinite, "frame.detections[0].points[1].y", "NaN", "finite");
    assert_eq!(refusal.sequence, Some(3));
}

#[tokio::test]
async fn an_infinite_coordinate_refuses_that_frame_only() {
    let refusal = refusal_of(|frame| first_line(frame).xyz[0] = f64::NEG_INFINITY).await;
    assert_names(&refusal, RefusalReason::NotFinite, "frame.detections[0].points[0].x", "-inf", "finite");
}

#[tokio::test]
async fn a_coordinate_of_1e300_refuses_that_frame_only() {
    let refusal = refusal_of(|frame| first_line(frame).xyz[2] = 1e300).await;
    assert_eq!(refusal.reason(), RefusalReason::OutOfRange);
    assert_eq!((&*refusal.field, &*refusal.limit), ("frame.detections[0].points[0].z", "-500 ..= 500"));
    assert!(refusal.value.starts_with("1000000"), "{refusal:?}");
}

#[tokio::test]
async fn an_odometry_of_1e300_refuses_that_frame_only() {
    let far = v1::Point { x: 1e300, y: 0.0, z: 0.0 };
    let refusal = refusal_of(|frame| {
        frame.odometry.as_mut().unwrap().odometry_from_vehicle.as_mut().unwrap().position = Some(far);
    });
    let refusal = refusal.await;
    assert_eq!(refusal.reason(), RefusalReason::OutOfRange);
    assert_eq!((&*refusal.field, &*refusal.limit), ("frame.odometry.position.x", "-10000000 ..= 10000000"));
}

#[tokio::test]
async fn a_line_without_points_refuses_that_frame_only() {
    let refusal = refusal_of(|frame| first_line(frame).xyz.clear()).await;
    assert_names(&refusal, RefusalReason::TooFew, "frame.detections[0].points", "0 entries", "at least 2");
}

#[tokio::test]
async fn a_line_of_one_point_refuses_that_frame_only() {
    let refusal = refusal_of(|frame| first_line(frame).xyz.truncate(3)).await;
    assert_names(&refusal, RefusalReason::TooFew, "frame.detections[0].points", "1 entries", "at least 2");
}

#[tokio::test]
async fn a_line_of_a_million_points_refuses_that_frame_only() {
    let refusal = refusal_of(|frame| first_line(frame).xyz = vec![1.0; 3_000_000]).await;
    assert_names(&refusal, RefusalReason::TooMany, "frame.detections[0].points", "1000000 entries", "at most 4096");
}

#[tokio::test]
async fn a_torn_list_of_coordinates_refuses_that_frame_only() {
    let refusal = refusal_of(|frame| first_line(frame).xyz = vec![1.0; 7]).await;
    assert_names(&refusal, RefusalReason::OutOfRange, "frame.detections[0].xyz", "7 entries", "a multiple of 3");
}

#[tokio::test]
async fn a_category_that_is_not_listed_refuses_that_frame_only() {
    let refusal = refusal_of(|frame| first_line(frame).category = 13).await;
    let limit = "a number that the protocol lists";
    assert_names(&refusal, RefusalReason::OutOfRange, "frame.detections[0].category", "13", limit);
}

#[tokio::test]
async fn too_many_lines_refuse_that_frame_only() {
    let refusal = refusal_of(|frame| {
        let line = frame.detections[0].clone();
        frame.detections = vec![line; 65];
    });
    assert_names(&refusal.await, RefusalReason::TooMany, "frame.detections", "65 entries", "at most 64");
}

#[tokio::test]
async fn an_odometry_rotation_that_is_none_refuses_that_frame_only() {
    let refusal = refusal_of(|frame| {
        let twice = v1::Quaternion { x: 0.0, y: 0.0, z: 0.0, w: 2.0 };
        frame.odometry.as_mut().unwrap().odometry_from_vehicle.as_mut().unwrap().rotation = Some(twice);
    });
    let field = "frame.odometry.odometry_from_vehicle.rotation";
    assert_names(&refusal.await, RefusalReason::NotARotation, field, "norm 2", "1 +- 0.001");
}

#[tokio::test]
async fn a_covariance_that_is_none_refuses_that_frame_only() {
    let refusal = refusal_of(|frame| {
        let mut upper_triangle = vec![0.0; 21];
        upper_triangle[1] = 1.0;
        frame.odometry.as_mut().unwrap().motion_covariance = Some(v1::TangentCovariance { upper_triangle });
    });
    let (field, value) = ("frame.odometry.motion_covariance", "it has a negative eigenvalue");
    let limit = "symmetric and positive semi-definite";
    assert_names(&refusal.await, RefusalReason::NotACovariance, field, value, limit);
}

#[tokio::test]
async fn a_frame_without_odometry_is_refused_alone() {
    let refusal = refusal_of(|frame| frame.odometry = None).await;
    assert_names(&refusal, RefusalReason::Missing, "frame.odometry", "nothing", "required");
}

#[tokio::test]
async fn a_latitude_of_91_degrees_refuses_that_frame_only() {
    let refusal = refusal_of(|frame| {
        let position = v1::GeodeticPosition { latitude_deg: 91.0, longitude_deg: 0.0, height_m: 0.0 };
        let fix =
            v1::GnssFix { position: Some(position), horizontal_sigma_m: 1.0, vertical_sigma_m: 1.0, yaw_enu_rad: None };
        frame.gnss = Some(fix);
    });
    assert_names(&refusal.await, RefusalReason::OutOfRange, "frame.gnss.latitude_deg", "91", "-90 ..= 90");
}

#[tokio::test]
async fn a_number_given_twice_is_refused() {
    let refusal = refusal_of(|frame| frame.sequence = 2).await;
    let value = "2 again, with other content";
    assert_names(&refusal, RefusalReason::Sequence, "frame.sequence", value, "above 2");
}

#[tokio::test]
async fn a_falling_number_is_refused() {
    let refusal = refusal_of(|frame| frame.sequence = 1).await;
    let limit = "above 2, or one of the last 256 frames again";
    assert_names(&refusal, RefusalReason::Sequence, "frame.sequence", "1", limit);
}

#[tokio::test]
async fn a_time_that_runs_back_is_refused() {
    let before = drives::simulated(1, 5).frames[1].time().0;
    let refusal = refusal_of(|frame| frame.time_unix_ns = before - 1).await;
    let limit = format!("above {before}, the time of frame 2");
    assert_names(&refusal, RefusalReason::Time, "frame.time_unix_ns", &(before - 1).to_string(), &limit);
}

#[tokio::test]
async fn a_frame_that_was_acked_is_acked_again_and_not_mapped_again() {
    let folder = tempfile::tempdir().unwrap();
    let server = servers::start(folder.path()).await;
    let drive = drives::simulated(1, 5);
    let (mut stream, accepted) = RawStream::started(&server.url(), drive.wire_start()).await;
    for _ in 0..3 {
        stream.send_frame(good(&drive, 1)).await;
        stream.acked(2).await;
    }
    stream.send(Message::End(v1::SessionEnd {})).await;
    stream.end().await.unwrap();
    let published = server.sessions().get(&accepted.session_id.parse().unwrap()).unwrap();
    assert_eq!(published.version.0, 1);
}

/// Sends a message in the place of a good start; gives the refusal, after which the stream takes a good start.
async fn refusal_before_start(message: Message) -> v1::Refusal {
    let folder = tempfile::tempdir().unwrap();
    let server = servers::start(folder.path()).await;
    let drive = drives::simulated(1, 5);
    let mut stream = RawStream::open(&server.url()).await;
    stream.send(message).await;
    let refusal = stream.refusal().await;
    stream.start(drive.wire_start()).await;
    stream.send_frame(good(&drive, 0)).await;
    stream.acked(1).await;
    refusal
}

fn spoiled_start(spoil: impl FnOnce(&mut v1::SessionStart)) -> Message {
    let mut start = drives::simulated(1, 5).wire_start();
    spoil(&mut start);
    Message::Start(start)
}

#[tokio::test]
async fn a_frame_before_the_start_is_refused_and_the_stream_still_starts() {
    let refusal = refusal_before_start(Message::Frame(good(&drives::simulated(1, 5), 0))).await;
    let limit = "start, then frames, then end";
    assert_names(&refusal, RefusalReason::OutOfTurn, "frame", "a frame before start", limit);
    assert_eq!(refusal.sequence, Some(1));
}

#[tokio::test]
async fn an_axis_convention_without_a_name_is_refused() {
    let refusal = refusal_before_start(spoiled_start(|start| {
        start.sensor.as_mut().unwrap().axis_convention = v1::AxisConvention::Unspecified.into();
    }));
    let refusal = refusal.await;
    assert_eq!(refusal.reason(), RefusalReason::OutOfRange);
    assert_eq!(refusal.field, "start.sensor.axis_convention");
    assert_eq!(refusal.value, "AXIS_CONVENTION_UNSPECIFIED");
}

#[tokio::test]
async fn a_mount_that_is_no_rotation_is_refused() {
    let refusal = refusal_before_start(spoiled_start(|start| {
        let crooked = v1::Quaternion { x: 0.5, y: 0.5, z: 0.0, w: 0.5 };
        start.sensor.as_mut().unwrap().vehicle_from_sensor.as_mut().unwrap().rotation = Some(crooked);
    }));
    let refusal = refusal.await;
    assert_eq!(refusal.reason(), RefusalReason::NotARotation);
    assert_eq!(refusal.field, "start.sensor.vehicle_from_sensor.rotation");
    assert!(refusal.value.starts_with("norm 0.866"), "{refusal:?}");
}

#[tokio::test]
async fn a_start_without_a_sensor_or_with_an_endless_id_is_refused() {
    let refusal = refusal_before_start(spoiled_start(|start| start.sensor = None)).await;
    assert_names(&refusal, RefusalReason::Missing, "start.sensor", "nothing", "required");
    let refusal = refusal_before_start(spoiled_start(|start| start.vehicle_id = "x".repeat(129))).await;
    assert_names(&refusal, RefusalReason::TooMany, "start.vehicle_id", "129 characters", "1 to 128 characters");
}

#[tokio::test]
async fn a_drive_that_goes_on_with_another_sensor_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let server = servers::start(folder.path()).await;
    let drive = drives::simulated(1, 5);
    drop(RawStream::started(&server.url(), drive.wire_start()).await);
    let mut stream = RawStream::open(&server.url()).await;
    let mut start = drive.wire_start();
    start.sensor.as_mut().unwrap().field_of_view = None;
    stream.send(Message::Start(start)).await;
    assert_eq!(stream.refusal().await.reason(), RefusalReason::Contradiction);
}

#[tokio::test]
async fn a_stream_that_never_starts_is_ended_after_a_hundred_refusals() {
    let folder = tempfile::tempdir().unwrap();
    let server = servers::start(folder.path()).await;
    let mut stream = RawStream::open(&server.url()).await;
    for _ in 0..100 {
        stream.send(Message::End(v1::SessionEnd {})).await;
        stream.refusal().await;
    }
    assert_eq!(stream.end().await.unwrap_err().code(), Code::InvalidArgument);
}

#[tokio::test]
async fn a_message_beyond_the_limit_ends_its_stream_and_no_other() {
    let folder = tempfile::tempdir().unwrap();
    let server = servers::start(folder.path()).await;
    let (drive, neighbour_drive) = (drives::simulated(1, 5), drives::simulated(2, 5));
    let (mut stream, accepted) = RawStream::started(&server.url(), drive.wire_start()).await;
    let (mut neighbour, _) = RawStream::started(&server.url(), neighbour_drive.wire_start()).await;
    stream.send_frame(good(&drive, 0)).await;
    stream.acked(1).await;

    let mut huge = good(&drive, 1);
    let limit = usize::try_from(accepted.limits.unwrap().max_message_bytes).unwrap();
    first_line(&mut huge).xyz = vec![1.0; limit / 8 + 1];
    stream.send_frame(huge).await;
    let status = stream.end().await.unwrap_err();
    assert_eq!(status.code(), Code::OutOfRange, "{status:?}");

    neighbour.send_frame(good(&neighbour_drive, 0)).await;
    neighbour.acked(1).await;
    let (_, resumed) = RawStream::started(&server.url(), drive.wire_start()).await;
    assert_eq!(resumed.resume_after_sequence, Some(1));
}

#[tokio::test]
async fn a_drive_beyond_the_most_that_the_store_holds_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let config = lanemap_server::ServerConfig { max_sessions: 1, ..servers::config(folder.path()) };
    let server = lanemap_server::Server::start(config).await.unwrap();
    let (first, second) = (drives::simulated(1, 5), drives::simulated(2, 5));
    let _held = RawStream::started(&server.url(), first.wire_start()).await;
    let mut stream = RawStream::open(&server.url()).await;
    stream.send(Message::Start(second.wire_start())).await;
    let refusal = stream.refusal().await;
    assert_eq!((refusal.reason(), &*refusal.limit), (RefusalReason::Capacity, "at most 1"));
}
