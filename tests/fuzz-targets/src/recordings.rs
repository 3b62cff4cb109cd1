//! Recordings: MCAP files, bags, and the definitions in bags.

use std::{io::Cursor, path::Path};

use lanemap_core::{Frame, FrameLimits};
use lanemap_recording::{BagDrive, BagOptions, FrameFault, McapDrive, RecordedFrame, bag::Definitions};

/// Opens `bytes` as an MCAP file and reads all of it.
pub fn mcap(bytes: &[u8]) {
    if let Ok(mut drive) = McapDrive::open(Path::new("fuzzed.mcap"), Cursor::new(bytes)) {
        let most = drive.len();
        let read = read_all(drive.frames());
        assert!(read <= most, "{read} frames were read, {most} were counted");
    }
}

/// Opens `bytes` as a bag and reads all of it.
pub fn bag(bytes: &[u8]) {
    if let Ok(mut drive) = BagDrive::open(Path::new("fuzzed.bag"), Cursor::new(bytes), &BagOptions::default()) {
        let most = drive.len();
        let read = read_all(drive.frames());
        assert!(read <= most, "{read} frames were read, {most} were counted");
    }
}

/// Parses the part of `bytes` before the first zero as a definition, and the rest as a message of it.
pub fn message_definition(bytes: &[u8]) {
    let zero = bytes.iter().position(|byte| *byte == 0).unwrap_or(bytes.len());
    let (text, message) = bytes.split_at(zero);
    let Ok(text) = std::str::from_utf8(text) else { return };
    if let Ok(definitions) = Definitions::parse("fuzz/Message", text) {
        let _ = definitions.check(message.get(1..).unwrap_or_default());
    }
}

/// Reads frames to their end, and counts those that are whole.
fn read_all(frames: impl Iterator<Item = Result<RecordedFrame, FrameFault>>) -> usize {
    let mut whole = 0;
    for frame in frames {
        match frame {
            Ok(frame) => {
                whole += 1;
                let _ = Frame::new(frame.parts, &FrameLimits::default());
            }
            Err(fault) => assert!(fault.error.to_string().len() < 8192, "an error repeats its input"),
        }
    }
    whole
}
