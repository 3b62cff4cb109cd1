//! One append-only file of a spool.

use std::{
    fs::{File, OpenOptions},
    io::{self, Read, Seek, SeekFrom, Write},
    path::{Path, PathBuf},
};

use super::record::{self, Kind, MAGIC, NotARecord};

/// A segment file that is open.
#[derive(Debug)]
pub(crate) struct Segment {
    /// Its place among the segments: older ones have lower numbers.
    pub(crate) number: u64,
    /// Length of the file.
    pub(crate) bytes: u64,
    /// Frames in it that are neither acked nor refused.
    pub(crate) unresolved: usize,
    path: PathBuf,
    file: File,
}

/// A record that was found in a segment.
#[derive(Debug, PartialEq)]
pub(crate) struct Found {
    pub(crate) kind: Kind,
    pub(crate) body: Vec<u8>,
    /// Where the record begins, and its length with its header.
    pub(crate) place: Place,
}

/// Where a record lies in its file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Place {
    pub(crate) offset: u64,
    pub(crate) length: usize,
}

/// What a segment held when it was opened.
#[derive(Debug, Default)]
pub(crate) struct Contents {
    pub(crate) records: Vec<Found>,
    /// Bytes of a last record that its writer did not finish, cut off now.
    pub(crate) torn_bytes: u64,
    /// Bytes that are not what was written.
    pub(crate) damaged_bytes: u64,
}

impl Segment {
    /// A new segment.
    pub(crate) fn create(folder: &Path, number: u64) -> io::Result<Self> {
        let path = folder.join(file_name(number));
        let mut file = OpenOptions::new().read(true).write(true).create_new(true).open(&path)?;
        file.write_all(MAGIC)?;
        Ok(Self { number, bytes: MAGIC.len() as u64, unresolved: 0, path, file })
    }

    /// Opens a segment and reads what it holds. A torn last record is cut off; damage is stepped over.
    pub(crate) fn open(folder: &Path, number: u64) -> io::Result<(Self, Contents)> {
        let path = folder.join(file_name(number));
        let mut file = OpenOptions::new().read(true).write(true).open(&path)?;
        let mut bytes = Vec::new();
        file.read_to_end(&mut bytes)?;
        let contents = read_records(&bytes);
        let kept = bytes.len() as u64 - contents.torn_bytes;
        if contents.torn_bytes > 0 {
            file.set_len(kept)?;
        }
        if kept == 0 {
            // Cut off before its first bytes were whole.
            file.rewind()?;
            file.write_all(MAGIC)?;
        }
        Ok((Self { number, bytes: kept.max(MAGIC.len() as u64), unresolved: 0, path, file }, contents))
    }

    /// Appends a record. What could not be written whole is taken back, so that the file never ends within a record.
    pub(crate) fn append(&mut self, record: &[u8]) -> io::Result<Place> {
        let place = Place { offset: self.bytes, length: record.len() };
        self.file.seek(SeekFrom::Start(self.bytes))?;
        if let Err(error) = self.file.write_all(record) {
            // Where this fails too, the next append writes over it, and a reader takes it for torn.
            let _ = self.file.set_len(self.bytes);
            return Err(error);
        }
        self.bytes += record.len() as u64;
        Ok(place)
    }

    /// The body of a record that was found or appended here.
    pub(crate) fn read(&mut self, place: Place) -> io::Result<Vec<u8>> {
        let mut bytes = vec![0; place.length];
        self.file.seek(SeekFrom::Start(place.offset))?;
        self.file.read_exact(&mut bytes)?;
        match record::decode(&bytes) {
            Ok((_, body)) => Ok(body.to_vec()),
            Err(_) => Err(io::Error::new(
                io::ErrorKind::InvalidData,
                format!("the record at byte {} is not what was written", place.offset),
            )),
        }
    }

    /// The file, to be synced without holding up who appends.
    pub(crate) fn file(&self) -> io::Result<File> {
        self.file.try_clone()
    }

    /// Deletes the file.
    pub(crate) fn delete(self) -> io::Result<()> {
        std::fs::remove_file(&self.path)
    }
}

/// The numbers of the segments in a folder, oldest first.
pub(crate) fn numbers(folder: &Path) -> io::Result<Vec<u64>> {
    let mut numbers = Vec::new();
    for entry in std::fs::read_dir(folder)? {
        let name = entry?.file_name();
        let number = name.to_str().and_then(|name| name.strip_suffix(".spool")).and_then(|stem| stem.parse().ok());
        numbers.extend(number.filter(|&number| name == *file_name(number)));
    }
    numbers.sort_unstable();
    Ok(numbers)
}

/// Name of a segment's file: twenty digits, so that names sort as numbers do.
pub(crate) fn file_name(number: u64) -> String {
    format!("{number:020}.spool")
}

/// Every record of a segment's bytes.
pub(crate) fn read_records(bytes: &[u8]) -> Contents {
    let mut contents = Contents::default();
    if !bytes.starts_with(MAGIC) {
        let torn = MAGIC.starts_with(bytes);
        let all = bytes.len() as u64;
        return if torn {
            Contents { torn_bytes: all, ..contents }
        } else {
            Contents { damaged_bytes: all, ..contents }
        };
    }
    let mut at = MAGIC.len();
    while at < bytes.len() {
        let rest = &bytes[at..];
        match record::decode(rest) {
            Ok((kind, body)) => {
                let length = record::HEADER_BYTES + body.len();
                let place = Place { offset: at as u64, length };
                contents.records.push(Found { kind, body: body.to_vec(), place });
                at += length;
            }
            Err(fault) => match record::next_record(rest) {
                Some(next) => {
                    contents.damaged_bytes += next as u64;
                    at += next;
                }
                None if fault == NotARecord::Torn => {
                    contents.torn_bytes = rest.len() as u64;
                    break;
                }
                None => {
                    contents.damaged_bytes += rest.len() as u64;
                    break;
                }
            },
        }
    }
    contents
}
