//! The spool: frames on disk until the service has made them durable.
//!
//! A drive has a folder of its own in the spool's folder, `FLEET/VEHICLE/DRIVE` (ids percent-encoded). In it are segment
//! files, `00000000000000000000.spool` and so on, to the last of which records are appended, and `lock`, which is locked
//! while a process uses the drive. Every segment begins with the drive's `SessionStart` and with the highest sequence
//! spooled before it. A segment whose frames are all acked or refused is deleted; an ack is not recorded, for after a
//! restart the service says where to go on. The Python client reads and writes the same files.

mod folder;
mod options;
mod record;
mod segment;

use std::{
    collections::VecDeque,
    fs::{self, File, TryLockError},
    io,
    path::{Path, PathBuf},
};

use lanemap_proto::v1;
use prost::Message;
use thiserror::Error;

use record::Kind;
use segment::{Contents, Found, Place, Segment};

pub use folder::SpooledDrive;
pub use options::{SpoolOptions, SpoolSync, WhenFull};

/// Why a spool does not do what was asked of it.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
pub enum SpoolError {
    /// There is no room for a frame now.
    #[error("the spool {} is full: {bytes} bytes of {max_bytes}", .folder.display())]
    Full {
        /// The drive's folder.
        folder: PathBuf,
        /// Bytes in use.
        bytes: u64,
        /// The bound.
        max_bytes: u64,
    },
    /// There is never room for such a frame.
    #[error("frame {sequence} has {bytes} bytes, more than the spool's max_bytes = {max_bytes} can ever hold")]
    TooLarge {
        /// The frame.
        sequence: u64,
        /// Bytes that it needs.
        bytes: u64,
        /// The bound.
        max_bytes: u64,
    },
    /// The bound is below the least one.
    #[error("the spool's max_bytes = {max_bytes} is below {}", SpoolOptions::MIN_BYTES)]
    Bound {
        /// The bound.
        max_bytes: u64,
    },
    /// Another process uses the drive.
    #[error("the spool {} is in use by another process", .0.display())]
    InUse(PathBuf),
    /// The disk failed.
    #[error("the spool {}: {reason}", .path.display())]
    Disk {
        /// The drive's folder.
        path: PathBuf,
        /// What the operating system says.
        reason: String,
    },
}

/// What a spool held when it was opened.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct SpoolRecovery {
    /// Frames found.
    pub frames: usize,
    /// Bytes of a last record that was not written whole: the frame that was being sent when the writer was cut off.
    pub torn_bytes: u64,
    /// Bytes that are not what was written: frames that are lost. Above 0 only where the disk, or a hand, changed them.
    pub damaged_bytes: u64,
}

/// The spool of one drive.
#[derive(Debug)]
pub(crate) struct Spool {
    folder: PathBuf,
    max_bytes: u64,
    segment_bytes: u64,
    /// Whether segments are forced to disk when they are left.
    syncs: bool,
    /// Bytes of other drives when this one was opened.
    others_bytes: u64,
    start: Vec<u8>,
    segments: VecDeque<Segment>,
    /// Frames neither acked nor refused, in the order of sending.
    frames: VecDeque<SpooledFrame>,
    last_sequence: Option<u64>,
    ended: bool,
    recovery: SpoolRecovery,
    _lock: File,
}

/// A file to be forced to disk while others go on appending to it.
#[derive(Debug)]
pub(crate) struct Unsynced {
    folder: PathBuf,
    file: Option<File>,
}

impl Unsynced {
    /// Forces it to disk.
    pub(crate) fn sync(self) -> Result<(), SpoolError> {
        let synced = self.file.map_or(Ok(()), |file| file.sync_data());
        synced.map_err(|error| disk(&self.folder, &error))
    }
}

#[derive(Clone, Copy, Debug)]
struct SpooledFrame {
    sequence: u64,
    segment: u64,
    place: Place,
}

impl Spool {
    /// Opens the spool of a drive, with what an earlier process left in it.
    pub(crate) fn open(options: &SpoolOptions, start: &v1::SessionStart) -> Result<Self, SpoolError> {
        if options.max_bytes < SpoolOptions::MIN_BYTES {
            return Err(SpoolError::Bound { max_bytes: options.max_bytes });
        }
        let folder = folder::of_drive(&options.folder, start);
        let disk = |error| disk(&folder, &error);
        fs::create_dir_all(&folder).map_err(disk)?;
        let lock = lock(&folder)?;
        let mut spool = Self {
            max_bytes: options.max_bytes,
            segment_bytes: options.segment_bytes(),
            syncs: options.sync != SpoolSync::System,
            others_bytes: folder::other_bytes(&options.folder, &folder).map_err(disk)?,
            start: start.encode_to_vec(),
            segments: VecDeque::new(),
            frames: VecDeque::new(),
            last_sequence: None,
            ended: false,
            recovery: SpoolRecovery::default(),
            _lock: lock,
            folder: folder.clone(),
        };
        spool.recover().map_err(disk)?;
        if spool.segments.is_empty() {
            spool.begin_segment(0).map_err(disk)?;
        }
        Ok(spool)
    }

    /// Reads every segment, oldest first.
    fn recover(&mut self) -> io::Result<()> {
        let numbers = segment::numbers(&self.folder)?;
        for &number in &numbers {
            let (segment, contents) = Segment::open(&self.folder, number)?;
            self.segments.push_back(segment);
            self.take_contents(contents, Some(&number) == numbers.last());
        }
        self.recovery.frames = self.frames.len();
        if let Some(&newest) = numbers.last()
            && self.recovery.damaged_bytes > 0
        {
            // What is appended to a damaged file might not be found again.
            self.begin_segment(newest + 1)?;
        }
        self.delete_resolved()
    }

    fn take_contents(&mut self, contents: Contents, newest: bool) {
        self.recovery.damaged_bytes += contents.damaged_bytes;
        // Only the newest segment was being written.
        let torn = if newest { &mut self.recovery.torn_bytes } else { &mut self.recovery.damaged_bytes };
        *torn += contents.torn_bytes;
        for found in contents.records {
            self.take_record(&found);
        }
    }

    fn take_record(&mut self, found: &Found) {
        match found.kind {
            Kind::Start => {}
            Kind::End => self.ended = true,
            Kind::Mark => match <[u8; 8]>::try_from(found.body.as_slice()) {
                Ok(mark) => self.last_sequence = self.last_sequence.max(Some(u64::from_le_bytes(mark))),
                Err(_) => self.recovery.damaged_bytes += found.place.length as u64,
            },
            Kind::Frame => match v1::Frame::decode(found.body.as_slice()) {
                Ok(frame) => self.note(frame.sequence, found.place),
                Err(_) => self.recovery.damaged_bytes += found.place.length as u64,
            },
        }
    }

    /// A frame lies in the newest segment.
    fn note(&mut self, sequence: u64, place: Place) {
        if let Some(segment) = self.segments.back_mut() {
            segment.unresolved += 1;
            self.frames.push_back(SpooledFrame { sequence, segment: segment.number, place });
            self.last_sequence = self.last_sequence.max(Some(sequence));
        }
    }

    /// What was found when the spool was opened.
    pub(crate) fn recovery(&self) -> &SpoolRecovery {
        &self.recovery
    }

    /// Highest sequence that was ever spooled for the drive.
    pub(crate) fn last_sequence(&self) -> Option<u64> {
        self.last_sequence
    }

    /// Whether the drive was ended.
    pub(crate) fn ended(&self) -> bool {
        self.ended
    }

    /// Frames neither acked nor refused.
    pub(crate) fn len(&self) -> usize {
        self.frames.len()
    }

    /// Bytes on disk.
    pub(crate) fn bytes(&self) -> u64 {
        self.segments.iter().map(|segment| segment.bytes).sum()
    }

    /// Appends a frame.
    pub(crate) fn append(&mut self, frame: &v1::Frame) -> Result<(), SpoolError> {
        let place = self.append_record(Kind::Frame, &frame.encode_to_vec(), frame.sequence)?;
        self.note(frame.sequence, place);
        Ok(())
    }

    /// Notes that the drive is over. There is always room for that.
    pub(crate) fn append_end(&mut self) -> Result<(), SpoolError> {
        if !self.ended {
            let record = record::encode(Kind::End, &[]).unwrap_or_default();
            let newest = self.segments.back_mut().map(|segment| segment.append(&record));
            newest.transpose().map_err(|error| disk(&self.folder, &error))?;
            self.ended = true;
        }
        Ok(())
    }

    fn append_record(&mut self, kind: Kind, body: &[u8], sequence: u64) -> Result<Place, SpoolError> {
        let max_bytes = self.max_bytes;
        let too_large = |bytes: usize| SpoolError::TooLarge { sequence, bytes: bytes as u64, max_bytes };
        let record = record::encode(kind, body).ok_or_else(|| too_large(body.len()))?;
        if self.others_bytes + self.opening_bytes() + self.reserved_bytes() + record.len() as u64 > max_bytes {
            return Err(too_large(record.len()));
        }
        let on_disk = |spool: &Self, error: io::Error| spool.disk_or_full(&error);
        let newest_is_long = self.segments.back().is_none_or(|segment| segment.bytes >= self.segment_bytes);
        if newest_is_long || !self.has_room_for(record.len() as u64) {
            self.roll().map_err(|error| on_disk(self, error))?;
        }
        if !self.has_room_for(record.len() as u64) {
            return Err(SpoolError::Full { folder: self.folder.clone(), bytes: self.used_bytes(), max_bytes });
        }
        let Some(segment) = self.segments.back_mut() else {
            return Err(SpoolError::Disk { path: self.folder.clone(), reason: "holds no segment".to_owned() });
        };
        segment.append(&record).map_err(|error| on_disk(self, error))
    }

    fn used_bytes(&self) -> u64 {
        self.others_bytes + self.bytes()
    }

    fn has_room_for(&self, record_bytes: u64) -> bool {
        self.used_bytes() + record_bytes + self.reserved_bytes() <= self.max_bytes
    }

    /// Kept free for the opening of the next segment, which is written before an old one goes, and for an end.
    fn reserved_bytes(&self) -> u64 {
        self.opening_bytes() + record::HEADER_BYTES as u64
    }

    /// Length of a segment without frames.
    fn opening_bytes(&self) -> u64 {
        (record::MAGIC.len() + 3 * record::HEADER_BYTES + self.start.len() + size_of::<u64>()) as u64
    }

    /// Begins a new segment where that helps: the newest is long enough, or all of it is resolved and it can go.
    fn roll(&mut self) -> io::Result<()> {
        let Some(newest) = self.segments.back() else { return self.begin_segment(0) };
        let can_go = newest.unresolved == 0 && newest.bytes > self.opening_bytes();
        let room_for_one_more = newest.bytes >= self.segment_bytes && self.has_room_for(self.opening_bytes());
        if !can_go && !room_for_one_more {
            return Ok(());
        }
        let number = newest.number + 1;
        if self.syncs {
            newest.file()?.sync_data()?;
        }
        // The new one bears the mark before the old one goes: numbers are never given twice.
        self.begin_segment(number)?;
        self.delete_resolved()
    }

    fn begin_segment(&mut self, number: u64) -> io::Result<()> {
        let mut segment = Segment::create(&self.folder, number)?;
        let opened = self.open_segment(&mut segment);
        if let Err(error) = opened {
            segment.delete()?;
            return Err(error);
        }
        self.segments.push_back(segment);
        if self.syncs {
            // Without this, power loss could take the file's name.
            File::open(&self.folder)?.sync_all()?;
        }
        Ok(())
    }

    fn open_segment(&self, segment: &mut Segment) -> io::Result<()> {
        for (kind, body) in [
            (Kind::Start, Some(self.start.clone())),
            (Kind::Mark, self.last_sequence.map(|sequence| sequence.to_le_bytes().to_vec())),
            (Kind::End, self.ended.then(Vec::new)),
        ] {
            if let Some(record) = body.and_then(|body| record::encode(kind, &body)) {
                segment.append(&record)?;
            }
        }
        Ok(())
    }

    /// The frame at `index`, oldest first.
    pub(crate) fn read(&mut self, index: usize) -> Result<Option<v1::Frame>, SpoolError> {
        let Some(&SpooledFrame { segment: number, place, .. }) = self.frames.get(index) else { return Ok(None) };
        let folder = &self.folder;
        let damaged = |reason: String| SpoolError::Disk { path: folder.clone(), reason };
        let segment = self.segments.iter_mut().find(|segment| segment.number == number);
        let segment = segment.ok_or_else(|| damaged(format!("segment {number} is gone")))?;
        let body = segment.read(place).map_err(|error| disk(folder, &error))?;
        v1::Frame::decode(body.as_slice()).map(Some).map_err(|error| damaged(error.to_string()))
    }

    /// Forgets frames from the oldest on, up to `sequence`, inclusive; says how many.
    pub(crate) fn forget_up_to(&mut self, sequence: u64) -> Result<usize, SpoolError> {
        let mut forgotten = 0;
        while self.frames.front().is_some_and(|frame| frame.sequence <= sequence) {
            self.resolve(0);
            forgotten += 1;
        }
        self.delete_resolved().map_err(|error| disk(&self.folder, &error))?;
        Ok(forgotten)
    }

    /// Forgets the oldest frame of this number among the first `among`; says whether there was one.
    pub(crate) fn forget(&mut self, sequence: u64, among: usize) -> Result<bool, SpoolError> {
        let found = self.frames.iter().take(among).position(|frame| frame.sequence == sequence);
        if let Some(index) = found {
            self.resolve(index);
            self.delete_resolved().map_err(|error| disk(&self.folder, &error))?;
        }
        Ok(found.is_some())
    }

    fn resolve(&mut self, index: usize) {
        if let Some(frame) = self.frames.remove(index)
            && let Some(segment) = self.segments.iter_mut().find(|segment| segment.number == frame.segment)
        {
            segment.unresolved -= 1;
        }
    }

    /// Deletes segments of which nothing is left, from the oldest on; the newest stays, for its mark.
    fn delete_resolved(&mut self) -> io::Result<()> {
        while self.segments.len() > 1 && self.segments.front().is_some_and(|segment| segment.unresolved == 0) {
            if let Some(segment) = self.segments.pop_front() {
                segment.delete()?;
            }
        }
        Ok(())
    }

    /// What was appended and may not be on the disk yet: the newest segment, for older ones are synced when left.
    pub(crate) fn unsynced(&self) -> Result<Unsynced, SpoolError> {
        let file = self.segments.back().map(Segment::file).transpose();
        let file = file.map_err(|error| disk(&self.folder, &error))?;
        Ok(Unsynced { folder: self.folder.clone(), file })
    }

    /// Deletes the drive's folder: the drive has ended, and the service has all of it.
    pub(crate) fn remove(self) -> Result<(), SpoolError> {
        folder::remove(&self.folder).map_err(|error| disk(&self.folder, &error))
    }

    /// A disk without room is a full spool: it may have room again.
    fn disk_or_full(&self, error: &io::Error) -> SpoolError {
        match error.kind() {
            io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded => {
                SpoolError::Full { folder: self.folder.clone(), bytes: self.used_bytes(), max_bytes: self.max_bytes }
            }
            _ => disk(&self.folder, error),
        }
    }
}

fn lock(folder: &Path) -> Result<File, SpoolError> {
    let file = File::options().create(true).append(true).open(folder.join("lock"));
    let file = file.map_err(|error| disk(folder, &error))?;
    match file.try_lock() {
        Ok(()) => Ok(file),
        Err(TryLockError::WouldBlock) => Err(SpoolError::InUse(folder.to_owned())),
        Err(TryLockError::Error(error)) => Err(disk(folder, &error)),
    }
}

fn disk(folder: &Path, error: &io::Error) -> SpoolError {
    SpoolError::Disk { path: folder.to_owned(), reason: error.to_string() }
}

#[cfg(test)]
mod tests;
