//! What a client sends: starts and frames, as the wire has them.

use lanemap_core::FrameLimits;
use lanemap_proto::{
    encode,
    v1::{self, stream_observations_request::Message as Request},
};
use lanemap_server::{
    fuzzing::bytes_of,
    ingest::decode::{self, PointFrame},
};
use prost::Message;

/// Decodes `bytes` as a message of a stream, and as a whole upload; a frame that is taken crosses the wire bit by bit.
pub fn frame(bytes: &[u8]) {
    if let Ok(request) = v1::StreamObservationsRequest::decode(bytes) {
        match request.message {
            Some(Request::Start(start)) => check_start(&start),
            Some(Request::Frame(frame)) => check_frame(&frame, &PointFrame::Vehicle),
            Some(Request::End(_)) | None => {}
        }
    }
    if let Ok(upload) = v1::UploadObservationsRequest::decode(bytes) {
        let point_frame = upload.start.as_ref().and_then(|start| decode::start(start).ok());
        let point_frame = point_frame.map_or(PointFrame::Vehicle, |start| start.point_frame);
        upload.frames.iter().for_each(|frame| check_frame(frame, &point_frame));
    }
}

fn check_start(start: &v1::SessionStart) {
    if let Err(refusal) = decode::start(start) {
        assert!(refusal.to_wire().message.len() < 4096, "a refusal repeats its input: {refusal}");
    }
}

fn check_frame(message: &v1::Frame, point_frame: &PointFrame) {
    let limits = FrameLimits::default();
    match decode::frame(message, point_frame, &limits) {
        Ok(frame) => {
            let wire = encode::frame(&frame).encode_to_vec();
            let again = v1::Frame::decode(wire.as_slice()).unwrap();
            // A lone point of the wire is refused; a frame's own lines have two at least.
            let again = decode::frame(&again, &PointFrame::Vehicle, &limits).unwrap();
            assert_eq!(bytes_of(&frame), bytes_of(&again), "a frame does not cross the wire bit by bit");
        }
        Err(refusal) => {
            assert_eq!(refusal.sequence.map(|sequence| sequence.0), Some(message.sequence));
            assert!(refusal.to_wire().message.len() < 4096, "a refusal repeats its input: {refusal}");
        }
    }
}
