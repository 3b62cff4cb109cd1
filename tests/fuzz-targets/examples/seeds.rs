//! Makes the seeds of the corpus from the simulator: `cargo run -p lanemap-fuzz-targets --example seeds`.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)] // a tool of the developers

use std::{
    collections::BTreeMap,
    fs,
    io::Cursor,
    path::{Path, PathBuf},
};

use lanemap_core::{Frame, FrameLimits, Preset};
use lanemap_openlane::{DriveFolder, Drives};
use lanemap_proto::{
    encode,
    v1::{self, stream_observations_request::Message as Request},
    zenoh_keys::{Attachment, StreamNonce, VehicleKeys},
};
use lanemap_recording::{DriveStart, McapRecorder};
use lanemap_simulator::{Scenario, openlane::write_simulation};
use lanemap_tests::{
    bags::{LANE_LIST, POSE_STAMPED, bag_of, pose_message},
    drives,
};
use mcap::{WriteOptions, records::MessageHeader};
use prost::Message;

fn main() {
    let corpus = Path::new(env!("CARGO_MANIFEST_DIR")).join("../fuzz/corpus");
    let put = |target: &str, name: &str, bytes: &[u8]| {
        let folder = corpus.join(target);
        fs::create_dir_all(&folder).unwrap();
        fs::write(folder.join(name), bytes).unwrap();
    };

    let drive = drives::simulated(3, 4);
    let start = Request::Start(drive.wire_start());
    let requests = drive.frames.iter().map(|frame| Request::Frame(encode::frame(frame)));
    for (index, message) in [start].into_iter().chain(requests).enumerate() {
        put(
            "frame",
            &format!("seed-{index}"),
            &v1::StreamObservationsRequest { message: Some(message) }.encode_to_vec(),
        );
    }
    let frames = drive.frames.iter().take(2).map(encode::frame).collect();
    let upload = v1::UploadObservationsRequest { start: Some(drive.wire_start()), frames, end: true };
    put("frame", "seed-upload", &upload.encode_to_vec());

    let keys = VehicleKeys::new("north", "car 1/\u{e4}*");
    put("zenoh_keys", "seed-observations", keys.observations().as_bytes());
    put("zenoh_keys", "seed-alive", keys.alive(StreamNonce(0xab)).as_bytes());
    put("zenoh_keys", "seed-attachment", Attachment { nonce: StreamNonce(7), number: 9 }.to_string().as_bytes());
    put("zenoh_keys", "seed-id", "car 1/\u{e4}*".as_bytes());

    put("order", "seed-in-order", &[4, 10].into_iter().chain([3, 1, 0].repeat(20)).collect::<Vec<u8>>());
    put("order", "seed-late", &[3, 5, 3, 4, 0, 3, 2, 9, 1, 5, 3, 1, 0, 2, 3, 250, 1, 0, 3, 7, 7, 2].repeat(3));

    put("session", "seed-in-order", &[[3, 0, 0].as_slice(), &[0; 30]].concat().repeat(6));
    put("session", "seed-lines", &(0..240).map(|k: u8| k.wrapping_mul(37)).collect::<Vec<_>>());
    put("session", "seed-crashes", &[3, 0, 0, 1, 2, 0, 0, 3, 0, 1, 2, 1].repeat(12));

    let folder = tempfile::tempdir().unwrap();
    write_simulation(folder.path(), &Scenario { drives: 1, ..Scenario::long_road(5, 12.0) }).unwrap();
    let folder_drive = Drives::list(folder.path(), &[]).unwrap().remove(0);
    openlane_seeds(folder.path(), &folder_drive, &put);

    put("bag", "seed-drive", &bag_of(&folder_drive));
    let message = pose_message(1_500_000_000, &lanemap_core::Pose::translation(1.0, 2.0, 3.0));
    put("message_definition", "seed-pose", &[POSE_STAMPED.as_bytes(), &[0], &message].concat());
    put("message_definition", "seed-lanes", &[LANE_LIST.as_bytes(), &[0], &[0; 24]].concat());
    put(
        "message_definition",
        "seed-constants",
        b"int32 A=1\nstring S=a # b\nuint8[4] four\ntime t\n\0\x01\x02\x03\x04",
    );

    put("mcap", "seed-drive", &recorded(&folder_drive));
    put("mcap", "seed-plain", &plain(&drive, false));
    put("mcap", "seed-chunk-without-checksum", &plain(&drive, true));
}

fn openlane_seeds(root: &Path, drive: &DriveFolder, put: &impl Fn(&str, &str, &[u8])) {
    let stem = lanemap_openlane::timestamp_stem(drive.times()[0]);
    let file = |folder: PathBuf| fs::read(folder.join(drive.name()).join(&stem).with_extension("json")).unwrap();
    put("openlane", "seed-annotation", &file(root.to_owned()));
    put("openlane", "seed-result", &file(root.join("results")));
    put("openlane", "seed-name", stem.as_bytes());
}

/// A drive as `lanemap record` writes it.
fn recorded(drive: &DriveFolder) -> Vec<u8> {
    let mut recorder: Option<McapRecorder<Cursor<Vec<u8>>>> = None;
    for (index, recorded) in drive.frames().enumerate() {
        let recorded = recorded.unwrap();
        let pose = recorded.annotation.pose().unwrap();
        let parts = recorded.frame_parts(lanemap_core::Sequence(index as u64 + 1), pose, None);
        let frame = Frame::new(parts, &FrameLimits::default()).unwrap();
        let recorder = recorder.get_or_insert_with(|| {
            let start = DriveStart {
                fleet: "f".to_owned(),
                vehicle: "v".to_owned(),
                drive: "d".to_owned(),
                preset: Preset::Default,
                sensor: recorded.annotation.sensor(),
            };
            McapRecorder::new(Path::new("seed.mcap"), Cursor::new(Vec::new()), start).unwrap()
        });
        recorder.frame(&frame).unwrap();
    }
    recorder.unwrap().finish().unwrap().into_inner()
}

/// A recording without compression, checksums and descriptors, so that a fuzzer finds its way behind them.
fn plain(drive: &drives::Drive, in_chunks: bool) -> Vec<u8> {
    let options = WriteOptions::new()
        .compression(None)
        .use_chunks(in_chunks)
        .calculate_chunk_crcs(false)
        .calculate_data_section_crc(false)
        .calculate_summary_section_crc(false);
    let mut writer = options.create(Cursor::new(Vec::new())).unwrap();
    let mut channel = |schema: &str, topic: &str| {
        let schema = writer.add_schema(schema, "protobuf", b"").unwrap();
        writer.add_channel(schema, topic, "protobuf", &BTreeMap::new()).unwrap()
    };
    let (starts, frames) = (channel("lanemap.v1.SessionStart", "/s"), channel("lanemap.v1.Frame", "/f"));
    let header = |channel_id| MessageHeader { channel_id, sequence: 0, log_time: 1, publish_time: 1 };
    writer.write_to_known_channel(&header(starts), &drive.wire_start().encode_to_vec()).unwrap();
    for frame in drive.frames.iter().take(2) {
        writer.write_to_known_channel(&header(frames), &encode::frame(frame).encode_to_vec()).unwrap();
    }
    writer.finish().unwrap();
    writer.into_inner().into_inner()
}
