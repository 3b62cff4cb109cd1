//! A drive: its mapper and how far it has come. Knows no network and no disk; the same frames give the same state.

mod loaded;

use std::sync::Arc;

use lanemap_core::{
    Frame, LaneMap, Mapper, Params, Sequence, SnapshotError, StepReport, TimestampNs,
    fleet::{DriveId, Trace},
};
use lanemap_proto::v1::RefusalReason;
use serde::{Deserialize, Serialize};
use thiserror::Error;

use super::{
    MapVersion, PublishedMap, SessionId, SessionRecord, SessionSetup, SessionState, SessionSummary,
    published::is_cleaned_up,
    recent::{REMEMBERED, RecentFrames, Recollection},
    way::Way,
};
use crate::{
    fuse::Offer,
    ingest::Refusal,
    journal::{JournalError, JournalFrame, frame_bytes},
    privacy::{
        TripCut,
        trip_cut::{Passage, TripEnds},
    },
};

pub(crate) use loaded::{Loaded, Unmapped};

/// The mapper of a drive, and which frames it has had.
#[derive(Debug)]
pub(crate) struct Drive {
    mapper: Mapper,
    /// The way so far, of what was mapped.
    trace: Arc<Trace>,
    /// The same for readers.
    way: Way,
    progress: Progress,
    cut: TripCut,
    ends: Ends,
    /// The last frame that was mapped, where nothing is cut; admitted ones may still wait for it.
    mapped: Option<(Sequence, TimestampNs)>,
    /// The map that was shown last, and of how many frames it was made.
    shown: Option<(MapVersion, Arc<LaneMap>)>,
}

/// Raise it where the bytes of a [`Trace`] change: what an earlier build wrote is then passed over.
const TRACE_FORMAT: u16 = 1;

/// The trace as a snapshot has it.
#[derive(Debug, Default, Serialize, Deserialize)]
struct TracePart {
    format: u16,
    bytes: Vec<u8>,
}

impl TracePart {
    /// The trace; an empty one where another build wrote it, for a drive can be mapped on without.
    fn read(&self) -> Trace {
        if self.format != TRACE_FORMAT {
            return Trace::default();
        }
        postcard::from_bytes(&self.bytes).unwrap_or_else(|error| {
            tracing::error!(%error, "a drive's trace does not decode, and is begun anew");
            Trace::default()
        })
    }
}

/// What is cut off the ends of a drive's trips. Stands still where nothing is cut.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
struct Ends {
    trip: TripEnds,
    /// The last frame that was cut.
    cut: Option<Sequence>,
    /// Every frame up to this one was mapped, cut or erased.
    settled: Option<Sequence>,
    /// The last frame that may be mapped.
    ready: Option<Sequence>,
    /// The last frame that was mapped.
    mapped: Option<(Sequence, TimestampNs)>,
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
    /// It is the next one, and is to be forgotten: it lies at an end of the trip.
    Cut,
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
    pub(crate) fn new(setup: &SessionSetup, cut: TripCut) -> Self {
        let mapper = Mapper::new(Params::preset(setup.preset), setup.sensor);
        let (progress, ends) = (Progress::default(), Ends::default());
        Self { mapper, trace: Arc::default(), way: Way::default(), progress, cut, ends, mapped: None, shown: None }
    }

    /// The drive of [`Drive::snapshot`]'s bytes.
    pub(crate) fn restore(bytes: &[u8], cut: TripCut) -> Result<Self, DriveError> {
        let ((progress, mapper), rest): ((Progress, Vec<u8>), _) = postcard::take_from_bytes(bytes)?;
        // Snapshots of earlier builds end here, or after the next part.
        let (ends, rest) = part_of(rest)?;
        let (trace, _) = part_of::<TracePart>(rest)?;
        let (trace, mapped) = (trace.read(), progress.last);
        let way = Way::of(&trace);
        let mapper = Mapper::restore(&mapper)?;
        Ok(Self { mapper, trace: Arc::new(trace), way, progress, cut, ends, mapped, shown: None })
    }

    /// The whole state as bytes. Call it only when every frame that may be mapped was mapped.
    pub(crate) fn snapshot(&self) -> Result<Vec<u8>, DriveError> {
        let trace = TracePart { format: TRACE_FORMAT, bytes: postcard::to_stdvec(&*self.trace)? };
        Ok(postcard::to_stdvec(&(&self.progress, self.mapper.snapshot(), &self.ends, trace))?)
    }

    /// How far the drive has come, as bytes, where every frame since the last snapshot was cut.
    pub(crate) fn cut_mark(&self) -> Result<Vec<u8>, DriveError> {
        Ok(postcard::to_stdvec(&(self.progress.last, &self.ends))?)
    }

    fn apply_cut_mark(&mut self, mark: &[u8]) -> Result<(), DriveError> {
        (self.progress.last, self.ends) = postcard::from_bytes(mark)?;
        Ok(())
    }

    /// Whether [`Drive::admit`] would cut `frame` if it is the next one.
    pub(crate) fn would_cut(&self, frame: &Frame) -> bool {
        self.ends.trip.would_cut(&self.cut, frame)
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
        if self.cut.is_on() && !self.passes(frame) {
            return Admission::Cut;
        }
        self.progress.recent.remember(frame.sequence(), bytes);
        Admission::New
    }

    /// Whether the frame is to be kept.
    fn passes(&mut self, frame: &Frame) -> bool {
        match self.ends.trip.arrive(&self.cut, frame) {
            Passage::Cut => {
                self.ends.cut = Some(frame.sequence());
                self.ends.settled = self.ends.cut;
                false
            }
            Passage::Held { mapped_through } => {
                self.ends.ready = mapped_through.or(self.ends.ready);
                true
            }
        }
    }

    fn admit_again(&self, sequence: Sequence, last: Sequence, bytes: &[u8]) -> Admission {
        let (value, limit) = match self.progress.recent.recall(sequence, bytes) {
            Recollection::Same => return Admission::Repeated,
            Recollection::Other => (format!("{} again, with other content", sequence.0), format!("above {}", last.0)),
            // Nothing is known of a frame that was cut, but that it came.
            Recollection::Unknown if Some(sequence) <= self.ends.cut => return Admission::Repeated,
            Recollection::Unknown => {
                let limit = format!("above {}, or one of the last {REMEMBERED} frames again", last.0);
                (sequence.0.to_string(), limit)
            }
        };
        let refusal = Refusal::new(RefusalReason::Sequence, "frame.sequence", value, limit);
        Admission::Refused(refusal.of_frame(sequence))
    }

    /// Maps a frame that was admitted. Where frames are held back, those of [`Drive::ready`], in their order.
    pub(crate) fn map(&mut self, frame: &Frame) -> StepReport {
        self.progress.mapped += 1;
        self.mapped = Some((frame.sequence(), frame.time()));
        if self.cut.is_on() {
            self.ends.settled = Some(frame.sequence());
            self.ends.mapped = Some((frame.sequence(), frame.time()));
        }
        let report = self.mapper.step(frame);
        Arc::make_mut(&mut self.trace).observe(frame, &self.mapper.map_from_vehicle());
        self.way.follow(&self.trace);
        report
    }

    /// Whether frames are held back before they are mapped.
    pub(crate) fn holds_back(&self) -> bool {
        self.cut.is_on()
    }

    /// The last of the frames after [`Drive::covered`] that may be mapped now, where frames are held back.
    pub(crate) fn ready(&self) -> Option<Sequence> {
        self.ends.ready.filter(|_| self.ends.ready > self.ends.settled)
    }

    /// Whether frames are held, which are mapped or erased later.
    pub(crate) fn holds_frames(&self) -> bool {
        self.ends.trip.holds()
    }

    /// The trip is over: frames that are held are never mapped, and what comes sets out anew. Whether any were held.
    pub(crate) fn end_trip(&mut self) -> bool {
        let held = self.holds_frames();
        if self.cut.is_on() {
            self.ends.trip.stop();
            self.ends.settled = self.last_sequence();
        }
        held
    }

    /// Takes the last frames of the journal, which were admitted when they were put there, to be mapped later.
    fn admit_journaled(&mut self, frames: &[JournalFrame]) -> Result<(), JournalError> {
        for frame in frames {
            self.progress.recent.remember(frame.sequence, &frame.bytes);
        }
        if let Some(last) = frames.last() {
            let what = || format!("frame {}", last.sequence.0);
            let frame = Frame::from_bytes(&last.bytes)
                .map_err(|error| JournalError::Decode { what: what(), reason: error.to_string() })?;
            self.progress.last = Some((frame.sequence(), frame.time()));
        }
        Ok(())
    }

    /// Takes a frame from the journal, which was admitted when it was put there; whether it may be mapped at once.
    pub(crate) fn replay(&mut self, frame: &Frame) -> Result<bool, Refusal> {
        if self.cut.is_on() && Some(frame.sequence()) <= self.last_sequence() {
            // It was held when the snapshot was made.
            return Ok(false);
        }
        let bytes = frame_bytes(frame).unwrap_or_default();
        match self.admit(frame, &bytes) {
            Admission::New => Ok(!self.cut.is_on()),
            Admission::Cut | Admission::Repeated => Ok(false),
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

    /// Every frame up to this one is in the mapper's state, or never will be.
    pub(crate) fn covered(&self) -> Option<Sequence> {
        if self.cut.is_on() { self.ends.settled } else { self.last_sequence() }
    }

    /// Whether readers are not to know of the drive: nothing of it lies beyond its start.
    pub(crate) fn is_hidden(&self) -> bool {
        self.cut.is_on() && self.progress.mapped == 0
    }

    /// The last frame that readers may know of.
    fn last_shown(&self) -> Option<(Sequence, TimestampNs)> {
        if self.cut.is_on() { self.ends.mapped } else { self.mapped }
    }

    /// What is told of the drive while it sleeps, as bytes; nothing where it is hidden.
    pub(crate) fn summary_bytes(&mut self, session: SessionId, state: SessionState) -> Result<Vec<u8>, DriveError> {
        let told = (!self.is_hidden()).then(|| self.published(session, state).summary);
        Ok(postcard::to_stdvec(&told)?)
    }

    /// What readers are shown.
    pub(crate) fn published(&mut self, session: SessionId, state: SessionState) -> PublishedMap {
        let is_cleaned_up = is_cleaned_up(self.mapper.params().preset, state);
        let version = MapVersion(self.progress.mapped + u64::from(is_cleaned_up));
        let summary = SessionSummary {
            session,
            version,
            state,
            preset: self.mapper.params().preset,
            map_from_vehicle: self.mapper.map_from_vehicle(),
            last_sequence: self.last_shown().map(|(sequence, _)| sequence),
            last_time: self.last_shown().map_or(TimestampNs(0), |(_, time)| time),
            georeference: self.mapper.georeference(),
            lanes: 0,
            extent: None,
        };
        PublishedMap::new(summary, self.lane_map(version, is_cleaned_up), self.way.clone())
    }

    /// The map of this version: made once, for its covariances cost as much as many steps of the mapper.
    fn lane_map(&mut self, version: MapVersion, is_cleaned_up: bool) -> Arc<LaneMap> {
        if let Some((shown, map)) = &self.shown
            && *shown == version
        {
            return Arc::clone(map);
        }
        let map = if is_cleaned_up { self.mapper.finished_lane_map() } else { self.mapper.lane_map() };
        let map = Arc::new(map);
        self.shown = Some((version, Arc::clone(&map)));
        map
    }

    /// What the drive, by this name, says to the shared map with what it publishes.
    pub(crate) fn offer(&self, drive: DriveId, record: &SessionRecord, published: &PublishedMap) -> Offer {
        Offer {
            session: record.id,
            drive,
            version: published.version,
            georeference: published.georeference,
            sensor: record.setup.sensor,
            trace: Arc::clone(&self.trace),
            map: Arc::clone(&published.map),
        }
    }
}

/// The next part of a snapshot, and what comes after it; the part's default where the snapshot ends before it.
fn part_of<'a, T: Deserialize<'a> + Default>(bytes: &'a [u8]) -> Result<(T, &'a [u8]), postcard::Error> {
    if bytes.is_empty() { Ok((T::default(), bytes)) } else { postcard::take_from_bytes(bytes) }
}

#[cfg(test)]
mod tests {
    use lanemap_core::{FrameLimits, FrameParts, Odometry, Preset, Sensor, geometry::Pose};

    use super::*;

    fn frame(sequence: u64, time_ns: i64) -> (Frame, Vec<u8>) {
        let odometry = Odometry { odometry_from_vehicle: Pose::identity(), motion_covariance: None };
        let (sequence, time) = (Sequence(sequence), TimestampNs(time_ns));
        let parts = FrameParts { sequence, time, odometry, gnss: None, detections: vec![], occlusions: vec![] };
        let frame = Frame::new(parts, &FrameLimits::default()).unwrap();
        let bytes = frame_bytes(&frame).unwrap();
        (frame, bytes)
    }

    fn drive() -> Drive {
        Drive::new(&SessionSetup { preset: Preset::Default, sensor: Sensor::default() }, TripCut::default())
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
        let mut restored = Drive::restore(&drive.snapshot().unwrap(), TripCut::default()).unwrap();
        assert_eq!(admit(&mut restored, 5, 100), Admission::Repeated);
        assert_eq!(restored.progress.mapped, 1);
        assert_eq!(restored.trace, drive.trace);
        assert_eq!(restored.trace.points().len(), 1);
    }

    #[test]
    fn snapshots_of_earlier_builds_are_restored_without_what_they_have_not() {
        let mut drive = drive();
        admit(&mut drive, 5, 100);
        let first = postcard::to_stdvec(&(&drive.progress, drive.mapper.snapshot())).unwrap();
        let second = postcard::to_stdvec(&(&drive.progress, drive.mapper.snapshot(), &drive.ends)).unwrap();
        for bytes in [first, second] {
            let mut restored = Drive::restore(&bytes, TripCut::default()).unwrap();
            assert_eq!(restored.trace.points().len(), 0);
            assert_eq!(admit(&mut restored, 6, 200), Admission::New);
            assert_eq!(restored.trace.points().len(), 1);
        }
    }
}
