//! A drive: its mapper and how far it has come. Knows no network and no disk; the same frames give the same state.

use std::sync::Arc;

use lanemap_core::{Frame, Mapper, Params, Sequence, SnapshotError, StepReport, TimestampNs};
use lanemap_proto::v1::RefusalReason;
use serde::{Deserialize, Serialize};
use thiserror::Error;

use super::{
    MapVersion, PublishedMap, SessionId, SessionSetup, SessionState,
    recent::{REMEMBERED, RecentFrames, Recollection},
};
use crate::{ingest::Refusal, journal::frame_bytes};

/// The mapper of a drive, and which frames it has had.
#[derive(Debug)]
pub(crate) struct Drive {
    mapper: Mapper,
    progress: Progress,
}

/// How far a drive has come.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
struct Progress {
    /// Frames mapped.
    mapped: u64,
    /// Number and time of the last frame admitted.
    last: Option<(Sequence, TimestampNs)>,
    recent: RecentFrames,
}

/// What becomes of a frame.
#[derive(Debug, PartialEq)]
pub(crate) enum Admission {
    /// It is the next one.
    New,
    /// It came before: ack it again, do not map it again.
    Repeated,
    /// It does not follow.
    Refused(Refusal),
}

/// Why a drive's snapshot cannot be read.
#[derive(Debug, Error)]
pub(crate) enum DriveError {
    /// The frame of the snapshot does not decode.
    #[error("its snapshot does not decode: {0}")]
    Decode(#[from] postcard::Error),
    /// The mapper's part is of another version, or does not decode.
    #[error("its mapper's {0}")]
    Mapper(#[from] SnapshotError),
}

impl Drive {
    /// A drive that has had no frame.
    pub(crate) fn new(setup: &SessionSetup) -> Self {
        let mapper = Mapper::new(Params::preset(setup.preset), setup.sensor);
        Self { mapper, progress: Progress::default() }
    }

    /// The drive of [`Drive::snapshot`]'s bytes.
    pub(crate) fn restore(bytes: &[u8]) -> Result<Self, DriveError> {
        let (progress, mapper): (Progress, Vec<u8>) = postcard::from_bytes(bytes)?;
        Ok(Self { mapper: Mapper::restore(&mapper)?, progress })
    }

    /// The whole state as bytes. Call it only when every frame admitted was mapped.
    pub(crate) fn snapshot(&self) -> Result<Vec<u8>, DriveError> {
        Ok(postcard::to_stdvec(&(&self.progress, self.mapper.snapshot()))?)
    }

    /// Whether `frame`, kept as `bytes`, follows the frames before; if so, it counts as had.
    pub(crate) fn admit(&mut self, frame: &Frame, bytes: &[u8]) -> Admission {
        if let Some((last, last_time)) = self.progress.last {
            if frame.sequence() <= last {
                return self.admit_again(frame.sequence(), last, bytes);
            }
            if frame.time() <= last_time {
                let limit = format!("above {}, the time of frame {}", last_time.0, last.0);
                let refusal = Refusal::new(RefusalReason::Time, "frame.time_unix_ns", frame.time().0, limit);
                return Admission::Refused(refusal.of_frame(frame.sequence()));
            }
        }
        self.progress.last = Some((frame.sequence(), frame.time()));
        self.progress.recent.remember(frame.sequence(), bytes);
        Admission::New
    }

    fn admit_again(&self, sequence: Sequence, last: Sequence, bytes: &[u8]) -> Admission {
        let (value, limit) = match self.progress.recent.recall(sequence, bytes) {
            Recollection::Same => return Admission::Repeated,
            Recollection::Other => (format!("{} again, with other content", sequence.0), format!("above {}", last.0)),
            Recollection::Unknown => {
                let limit = format!("above {}, or one of the last {REMEMBERED} frames again", last.0);
                (sequence.0.to_string(), limit)
            }
        };
        let refusal = Refusal::new(RefusalReason::Sequence, "frame.sequence", value, limit);
        Admission::Refused(refusal.of_frame(sequence))
    }

    /// Maps a frame that was admitted.
    pub(crate) fn map(&mut self, frame: &Frame) -> StepReport {
        self.progress.mapped += 1;
        self.mapper.step(frame)
    }

    /// Takes a frame from the journal, which was admitted when it was put there.
    pub(crate) fn replay(&mut self, frame: &Frame) -> Result<(), Refusal> {
        let bytes = frame_bytes(frame).unwrap_or_default();
        match self.admit(frame, &bytes) {
            Admission::New => {
                self.map(frame);
                Ok(())
            }
            Admission::Repeated => Ok(()),
            Admission::Refused(refusal) => Err(refusal),
        }
    }

    /// The mapper, to read.
    pub(crate) fn mapper(&self) -> &Mapper {
        &self.mapper
    }

    /// The last frame admitted.
    pub(crate) fn last_sequence(&self) -> Option<Sequence> {
        self.progress.last.map(|(sequence, _)| sequence)
    }

    /// What readers are shown.
    pub(crate) fn published(&self, session: SessionId, state: SessionState) -> PublishedMap {
        PublishedMap {
            session,
            version: MapVersion(self.progress.mapped),
            state,
            preset: self.mapper.params().preset,
            map: Arc::new(self.mapper.lane_map()),
            map_from_vehicle: self.mapper.map_from_vehicle(),
            last_sequence: self.last_sequence(),
            last_time: self.progress.last.map_or(TimestampNs(0), |(_, time)| time),
            georeference: self.mapper.georeference(),
        }
    }
}

#[cfg(test)]
mod tests {
    use lanemap_core::{FrameLimits, FrameParts, Odometry, Preset, Sensor, geometry::Pose};

    use super::*;

    fn frame(sequence: u64, time_ns: i64) -> (Frame, Vec<u8>) {
        let odometry = Odometry { odometry_from_vehicle: Pose::identity(), motion_covariance: None };
        let (sequence, time) = (Sequence(sequence), TimestampNs(time_ns));
        let parts = FrameParts { sequence, time, odometry, gnss: None, detections: vec![] };
        let frame = Frame::new(parts, &FrameLimits::default()).unwrap();
        let bytes = frame_bytes(&frame).unwrap();
        (frame, bytes)
    }

    fn drive() -> Drive {
        Drive::new(&SessionSetup { preset: Preset::Default, sensor: Sensor::default() })
    }

    fn admit(drive: &mut Drive, sequence: u64, time_ns: i64) -> Admission {
        let (frame, bytes) = frame(sequence, time_ns);
        let admission = drive.admit(&frame, &bytes);
        if admission == Admission::New {
            drive.map(&frame);
        }
        admission
    }

    fn refusal(admission: Admission) -> String {
        match admission {
            Admission::Refused(refusal) => refusal.to_string(),
            other => panic!("{other:?}"),
        }
    }

    #[test]
    fn a_frame_sent_twice_is_repeated_and_a_number_given_twice_is_refused() {
        let mut drive = drive();
        assert_eq!(admit(&mut drive, 5, 100), Admission::New);
        assert_eq!(admit(&mut drive, 5, 100), Admission::Repeated);
        let text = "frame 5: frame.sequence is 5 again, with other content, limit: above 5";
        assert_eq!(refusal(admit(&mut drive, 5, 101)), text);
    }

    #[test]
    fn a_falling_number_and_a_time_that_runs_back_are_refused_with_value_and_limit() {
        let mut drive = drive();
        admit(&mut drive, 5, 100);
        let text = "frame 4: frame.sequence is 4, limit: above 5, or one of the last 256 frames again";
        assert_eq!(refusal(admit(&mut drive, 4, 200)), text);
        let text = "frame 6: frame.time_unix_ns is 100, limit: above 100, the time of frame 5";
        assert_eq!(refusal(admit(&mut drive, 6, 100)), text);
        assert_eq!(admit(&mut drive, 6, 101), Admission::New);
    }

    #[test]
    fn a_restored_drive_knows_which_frames_it_has_had() {
        let mut drive = drive();
        admit(&mut drive, 5, 100);
        let mut restored = Drive::restore(&drive.snapshot().unwrap()).unwrap();
        assert_eq!(admit(&mut restored, 5, 100), Admission::Repeated);
        assert_eq!(restored.progress.mapped, 1);
    }
}
