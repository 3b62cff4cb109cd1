//! A drive as the store has it: its last snapshot, and the frames that came after.

use lanemap_core::{Frame, Sequence};

use super::{Drive, DriveError};
use crate::{
    journal::{Journal, JournalError},
    session::{SessionId, SessionRecord, recent::REMEMBERED},
};

/// A drive as the store knows it.
#[derive(Debug)]
pub(crate) struct Loaded {
    pub(crate) record: SessionRecord,
    pub(crate) drive: Drive,
    /// The last frame in its snapshot.
    pub(crate) covered: Option<Sequence>,
    /// Frames after the snapshot, mapped again.
    pub(crate) replayed: u64,
    /// Frames after those, not mapped yet.
    pub(crate) unmapped: Option<Unmapped>,
}

/// Frames that the journal has and the map has not.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Unmapped {
    /// They come after this one.
    pub(crate) after: Option<Sequence>,
    /// The last of them, inclusive.
    pub(crate) through: Sequence,
}

impl Unmapped {
    /// Whether none is left.
    pub(crate) fn is_empty(&self) -> bool {
        self.after >= Some(self.through)
    }
}

impl Loaded {
    /// Reads a drive from the store: its snapshot, and which frames came after it. They are mapped again later, which takes
    /// a hundred times as long; where frames are held back, they are at once.
    pub(crate) fn read(journal: &Journal, record: SessionRecord) -> Result<Self, JournalError> {
        let damaged = |what: &str, reason: String| JournalError::Decode { what: what.to_owned(), reason };
        let damaged_state = |error: DriveError| damaged("the session's state", error.to_string());
        // It may have ended since the caller read it.
        let record = journal.record(record.id)?.unwrap_or(record);
        let mut drive = match journal.snapshot(record.id)? {
            Some(bytes) => Drive::restore(&bytes, record.cut).map_err(damaged_state)?,
            None => Drive::new(&record.setup, record.cut),
        };
        // Before the mark: frames that were held until the trip stopped may lie after it, and go with the next snapshot.
        let covered = drive.covered();
        if let Some(mark) = journal.cut_mark(record.id)? {
            drive.apply_cut_mark(&mark).map_err(damaged_state)?;
        }
        if !drive.holds_back() {
            let last = journal.last_frames(record.id, covered, REMEMBERED)?;
            drive.admit_journaled(&last)?;
            let through = last.last().map(|frame| frame.sequence);
            let unmapped = through.map(|through| Unmapped { after: covered, through });
            return Ok(Self { record, drive, covered, replayed: 0, unmapped });
        }
        let mut replayed = 0;
        for frame in journal.frames_after(record.id, drive.covered())? {
            let frame = frame?;
            replayed += 1;
            if drive.replay(&frame).map_err(|refusal| damaged("the session's journal", refusal.to_string()))? {
                drive.map(&frame);
            }
            for ready in ready_frames(journal, record.id, &drive)? {
                drive.map(&ready);
            }
        }
        Ok(Self { record, drive, covered, replayed, unmapped: None })
    }

    /// Maps what is not mapped yet.
    pub(crate) fn caught_up(mut self, journal: &Journal) -> Result<Self, JournalError> {
        if let Some(Unmapped { after, through }) = self.unmapped.take() {
            for frame in journal.frames_between(self.record.id, after, through)? {
                self.drive.map(&frame?);
                self.replayed += 1;
            }
        }
        Ok(self)
    }
}

/// The frames that were held back and may be mapped now. Reads the disk.
fn ready_frames(journal: &Journal, session: SessionId, drive: &Drive) -> Result<Vec<Frame>, JournalError> {
    let Some(through) = drive.ready() else { return Ok(Vec::new()) };
    journal.frames_between(session, drive.covered(), through)?.collect()
}
