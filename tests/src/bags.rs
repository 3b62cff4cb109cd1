//! Writes ROS 1 bags as the paper's authors do: a drive's poses and lanes, camera frame, `float32`.

use std::{fs, path::Path};

use lanemap_core::geometry::Pose;
use lanemap_openlane::DriveFolder;

/// The authors' message of lanes, with what it is made of.
pub const LANE_LIST: &str = "Header header\nLane[] lane_list\nint32 num_lanes\n\
    ================================================================================\nMSG: std_msgs/Header\n\
    uint32 seq\ntime stamp\nstring frame_id\n\
    ================================================================================\nMSG: openlane_bag/Lane\n\
    LanePoint[] lane\nint32 num_points\nint32 attribute\nint32 track_id\nint32 category\n\
    ================================================================================\nMSG: openlane_bag/LanePoint\n\
    float32 x\nfloat32 y\nfloat32 z\nfloat32 visibility\n";

/// A pose with its stamp.
pub const POSE_STAMPED: &str = "Header header\nPose pose\n\
    ================================================================================\nMSG: std_msgs/Header\n\
    uint32 seq\ntime stamp\nstring frame_id\n\
    ================================================================================\nMSG: geometry_msgs/Pose\n\
    Point position\nQuaternion orientation\n\
    ================================================================================\nMSG: geometry_msgs/Point\n\
    float64 x\nfloat64 y\nfloat64 z\n\
    ================================================================================\nMSG: geometry_msgs/Quaternion\n\
    float64 x\nfloat64 y\nfloat64 z\nfloat64 w\n";

/// A bag that is being written: one chunk, not compressed, and no index, as that of a writer that died.
#[derive(Debug, Default)]
pub struct BagWriter {
    chunk: Vec<u8>,
}

impl BagWriter {
    /// Declares a topic.
    pub fn connection(&mut self, id: u32, topic: &str, kind: &str, definition: &str) {
        let data = fields(&[
            ("topic", topic.as_bytes()),
            ("type", kind.as_bytes()),
            ("md5sum", b"*"),
            ("message_definition", definition.as_bytes()),
        ]);
        let header = [("op", &[7][..]), ("conn", &id.to_le_bytes()), ("topic", topic.as_bytes())];
        record(&mut self.chunk, &header, &data);
    }

    /// Adds a message.
    pub fn message(&mut self, connection: u32, time_ns: i64, data: &[u8]) {
        let header = [("op", &[2][..]), ("conn", &connection.to_le_bytes()), ("time", &stamp(time_ns))];
        record(&mut self.chunk, &header, data);
    }

    /// The file's bytes.
    #[must_use]
    pub fn into_bytes(self) -> Vec<u8> {
        let mut bag = b"#ROSBAG V2.0\n".to_vec();
        let zero = 0_u64.to_le_bytes();
        let none = 0_u32.to_le_bytes();
        record(&mut bag, &[("op", &[3]), ("index_pos", &zero), ("conn_count", &none), ("chunk_count", &none)], &[]);
        let size = u32::try_from(self.chunk.len()).unwrap().to_le_bytes();
        record(&mut bag, &[("op", &[5]), ("compression", b"none"), ("size", &size)], &self.chunk);
        bag
    }
}

/// The bag of a drive, with the detections as `/lanes_predict`.
#[must_use]
pub fn bag_of(drive: &DriveFolder) -> Vec<u8> {
    let mut bag = BagWriter::default();
    bag.connection(0, "/gt_pose_wc", "geometry_msgs/PoseStamped", POSE_STAMPED);
    bag.connection(1, "/lanes_predict", "openlane_bag/LaneList", LANE_LIST);
    for frame in drive.frames() {
        let frame = frame.unwrap();
        let time = frame.time.0;
        let mount = frame.annotation.vehicle_from_camera;
        bag.message(0, time, &pose_message(time, &(frame.annotation.pose().unwrap() * mount)));
        let lines: Vec<_> = frame
            .detections_vehicle()
            .into_iter()
            .map(|line| {
                let camera: Vec<[f32; 3]> = line
                    .points_vehicle
                    .iter()
                    .map(|point| {
                        let point = mount.inverse() * point;
                        #[expect(clippy::cast_possible_truncation, reason = "the message has float32")]
                        [point.x as f32, point.y as f32, point.z as f32]
                    })
                    .collect();
                (i32::from(line.category.openlane_code()), camera)
            })
            .collect();
        bag.message(1, time, &lanes_message(time, &lines));
    }
    bag.into_bytes()
}

/// Writes the bag of a drive.
pub fn write_bag(drive: &DriveFolder, path: &Path) {
    fs::write(path, bag_of(drive)).unwrap();
}

/// A `geometry_msgs/PoseStamped`.
#[must_use]
pub fn pose_message(time_ns: i64, pose: &Pose) -> Vec<u8> {
    let mut message = header(time_ns, "map");
    let (t, r) = (pose.translation, pose.rotation);
    for value in [t.x, t.y, t.z, r.i, r.j, r.k, r.w] {
        message.extend(value.to_le_bytes());
    }
    message
}

/// An `openlane_bag/LaneList`: category and points of each lane.
#[must_use]
pub fn lanes_message(time_ns: i64, lanes: &[(i32, Vec<[f32; 3]>)]) -> Vec<u8> {
    let mut message = header(time_ns, "camera");
    let count = |count: usize| u32::try_from(count).unwrap().to_le_bytes();
    message.extend(count(lanes.len()));
    for (category, points) in lanes {
        message.extend(count(points.len()));
        for point in points {
            for value in [point[0], point[1], point[2], 1.0] {
                message.extend(value.to_le_bytes());
            }
        }
        message.extend(count(points.len()));
        for value in [0, 7, *category] {
            message.extend(value.to_le_bytes());
        }
    }
    message.extend(count(lanes.len()));
    message
}

fn header(time_ns: i64, frame: &str) -> Vec<u8> {
    let mut header = 0_u32.to_le_bytes().to_vec();
    header.extend(stamp(time_ns));
    header.extend(u32::try_from(frame.len()).unwrap().to_le_bytes());
    header.extend(frame.as_bytes());
    header
}

fn stamp(time_ns: i64) -> [u8; 8] {
    let (seconds, ns) = (time_ns / 1_000_000_000, time_ns % 1_000_000_000);
    let halves = [u32::try_from(seconds).unwrap(), u32::try_from(ns).unwrap()].map(u32::to_le_bytes);
    halves.concat().try_into().unwrap()
}

fn record(to: &mut Vec<u8>, header: &[(&str, &[u8])], data: &[u8]) {
    let header = fields(header);
    for part in [header.as_slice(), data] {
        to.extend(u32::try_from(part.len()).unwrap().to_le_bytes());
        to.extend(part);
    }
}

fn fields(fields: &[(&str, &[u8])]) -> Vec<u8> {
    let mut bytes = Vec::new();
    for (name, value) in fields {
        bytes.extend(u32::try_from(name.len() + 1 + value.len()).unwrap().to_le_bytes());
        bytes.extend(name.as_bytes());
        bytes.push(b'=');
        bytes.extend(*value);
    }
    bytes
}
