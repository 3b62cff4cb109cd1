//! Connections and messages of a bag in the order in which they lie there, in chunks or not.
//!
//! The index at the file's end is not used: a bag whose writer died has none.

use std::{
    collections::BTreeMap,
    io::{Read, Seek},
    ops::Range,
};

use super::{MAGIC, definition::shown};
use crate::{
    MAX_RECORD_BYTES,
    error::RecordingError,
    input::{Input, inflate},
};

/// Longest header of a record, bytes.
const MAX_HEADER_BYTES: usize = 1 << 20;

const OP_MESSAGE: u8 = 0x02;
const OP_CHUNK: u8 = 0x05;
const OP_CONNECTION: u8 = 0x07;

/// A connection: one publisher of one topic.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Connection {
    pub(crate) id: u32,
    pub(crate) topic: String,
    pub(crate) kind: String,
    pub(crate) definition: String,
}

/// What the walk meets.
pub(crate) enum Met<'a> {
    Connection(Connection),
    Message { connection: u32, place: Place, data: &'a [u8] },
}

/// Where a message lies.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct Place {
    /// Where its chunk begins in the file, or its own record where it is in none.
    pub(crate) offset: u64,
    /// Where its data begins in the chunk's content, and how long it is, bytes.
    pub(crate) start: u32,
    pub(crate) length: u32,
}

/// Time of a stamp: seconds and nanoseconds, as nanoseconds since the Unix epoch.
pub(crate) fn time_ns(bytes: [u8; 8]) -> i64 {
    let [s0, s1, s2, s3, n0, n1, n2, n3] = bytes;
    let (seconds, nanoseconds) = (u32::from_le_bytes([s0, s1, s2, s3]), u32::from_le_bytes([n0, n1, n2, n3]));
    i64::from(seconds) * 1_000_000_000 + i64::from(nanoseconds)
}

/// Walks through a bag once.
pub(crate) struct Records<'a, R> {
    input: &'a mut Input<R>,
    done: bool,
}

impl<'a, R: Read + Seek> Records<'a, R> {
    /// From the start of the file.
    pub(crate) fn new(input: &'a mut Input<R>) -> Result<Self, RecordingError> {
        input.seek(0)?;
        let magic = input.take_array::<{ MAGIC.len() }>("the magic of a bag")?;
        if magic != *MAGIC {
            let begins = String::from_utf8_lossy(&magic).into_owned();
            let problem = format!("begins with {begins:?}, not with the magic of a ROS 1 bag");
            return Err(RecordingError::record(input.path(), 0, problem));
        }
        Ok(Self { input, done: false })
    }

    /// Reads the next record and calls `visit` for every connection and message in it; `false`: there is none. After an
    /// error the walk goes on at the record after it where its place is known.
    pub(crate) fn next(
        &mut self,
        visit: &mut impl FnMut(Met<'_>) -> Result<(), RecordingError>,
    ) -> Result<bool, RecordingError> {
        if self.done || self.input.left() == 0 {
            return Ok(false);
        }
        self.done = true;
        let offset = self.input.position();
        let record = FileRecord::read(self.input, offset)?;
        self.done = false;
        let path = self.input.path().to_owned();
        match record {
            FileRecord::Chunk(chunk) => {
                let refuse = |problem: String| RecordingError::record(&path, offset, format!("a chunk {problem}"));
                let content = chunk.content().map_err(refuse)?;
                for record in records_in(&content) {
                    let (header, data) = record.map_err(refuse)?;
                    meet(&header, &content, data, offset, visit, &refuse)?;
                }
            }
            FileRecord::Other { header, data } => {
                let refuse = |problem: String| RecordingError::record(&path, offset, format!("a record {problem}"));
                meet(&header, &data, 0..data.len(), offset, visit, &refuse)?;
            }
            FileRecord::Passed => {}
        }
        Ok(true)
    }
}

/// Content of the chunk, or of the record, that begins at `offset`, whose walk has been through it before.
pub(crate) fn content_at<R: Read + Seek>(input: &mut Input<R>, offset: u64) -> Result<Vec<u8>, RecordingError> {
    input.seek(offset)?;
    match FileRecord::read(input, offset)? {
        FileRecord::Chunk(chunk) => {
            chunk.content().map_err(|problem| RecordingError::record(input.path(), offset, problem))
        }
        FileRecord::Other { data, .. } => Ok(data),
        FileRecord::Passed => Err(RecordingError::record(input.path(), offset, "no longer holds a message")),
    }
}

/// Calls `visit` for a record that is a connection or a message.
fn meet(
    header: &Header,
    content: &[u8],
    data: Range<usize>,
    offset: u64,
    visit: &mut impl FnMut(Met<'_>) -> Result<(), RecordingError>,
    refuse: &impl Fn(String) -> RecordingError,
) -> Result<(), RecordingError> {
    let bytes = content.get(data.clone()).unwrap_or_default();
    match header.operation().map_err(refuse)? {
        OP_MESSAGE => {
            let connection = header.number("conn").map_err(refuse)?;
            let narrow = |value: usize| u32::try_from(value).unwrap_or(u32::MAX);
            let place = Place { offset, start: narrow(data.start), length: narrow(data.len()) };
            visit(Met::Message { connection, place, data: bytes })
        }
        OP_CONNECTION => visit(Met::Connection(connection(header, bytes).map_err(refuse)?)),
        _ => Ok(()),
    }
}

fn connection(header: &Header, data: &[u8]) -> Result<Connection, String> {
    let id = header.number("conn")?;
    let topic = header.text("topic")?;
    let inner = Header::parse(data).map_err(|problem| format!("is a connection whose data {problem}"))?;
    Ok(Connection { id, topic, kind: inner.text("type")?, definition: inner.text("message_definition")? })
}

/// A record of the file itself.
enum FileRecord {
    Chunk(Chunk),
    Other {
        header: Header,
        data: Vec<u8>,
    },
    /// An index, or another record that holds no message.
    Passed,
}

struct Chunk {
    compression: String,
    bytes: u64,
    data: Vec<u8>,
}

impl FileRecord {
    fn read<R: Read + Seek>(input: &mut Input<R>, offset: u64) -> Result<Self, RecordingError> {
        let length = u32::from_le_bytes(input.take_array("a record's head")?);
        if length as usize > MAX_HEADER_BYTES {
            let problem = format!("a record's header says that it has {length} bytes, limit {MAX_HEADER_BYTES}");
            return Err(RecordingError::record(input.path(), offset, problem));
        }
        let header = Header::parse(&input.take(length.into(), "a record's header")?);
        let length = u64::from(u32::from_le_bytes(input.take_array("a record's length")?));
        let refuse = |problem| RecordingError::record(input.path(), offset, format!("a record {problem}"));
        let header = header.map_err(refuse)?;
        match header.operation().map_err(refuse)? {
            OP_CHUNK => {
                let compression = header.text("compression").map_err(refuse)?;
                let bytes = header.number("size").map_err(refuse)?.into();
                let data = input.take(length, "a chunk")?;
                Ok(Self::Chunk(Chunk { compression, bytes, data }))
            }
            OP_MESSAGE | OP_CONNECTION => Ok(Self::Other { header, data: input.take(length, "a record")? }),
            _ => {
                input.skip(length, "a record")?;
                Ok(Self::Passed)
            }
        }
    }
}

impl Chunk {
    fn content(self) -> Result<Vec<u8>, String> {
        if self.bytes > MAX_RECORD_BYTES {
            return Err(format!("says that it decompresses to {} bytes, limit {MAX_RECORD_BYTES}", self.bytes));
        }
        let data = self.data.as_slice();
        let content = match self.compression.as_str() {
            "none" => inflate(data, self.bytes),
            "bz2" => inflate(bzip2::read::BzDecoder::new(data), self.bytes),
            "lz4" => inflate(lz4_flex::frame::FrameDecoder::new(data), self.bytes),
            other => return Err(format!("is compressed by {:?}; none, bz2 and lz4 are known", shown(other))),
        };
        content.map_err(|problem| format!("does not decompress: {problem}"))
    }
}

/// The records in the content of a chunk: each header, and where its data lies. Ends after the first error.
fn records_in(content: &[u8]) -> impl Iterator<Item = Result<(Header, Range<usize>), String>> + '_ {
    let mut at = 0;
    std::iter::from_fn(move || {
        if at >= content.len() {
            return None;
        }
        let start = at;
        at = content.len();
        let record = sized(content, start).and_then(|header| Some((header.clone(), sized(content, header.end)?)));
        let Some((header, data)) = record else {
            return Some(Err(format!("holds a record at byte {start} of its content that is longer than the rest")));
        };
        at = data.end;
        let header = Header::parse(&content[header]).map_err(|problem| {
            at = content.len();
            format!("holds a record at byte {start} of its content that {problem}")
        });
        Some(header.map(|header| (header, data)))
    })
}

/// Where bytes lie that their length stands before.
fn sized(content: &[u8], at: usize) -> Option<Range<usize>> {
    let length = u32::from_le_bytes(*content.get(at..)?.first_chunk()?) as usize;
    let start = at + 4;
    let end = start.checked_add(length)?;
    (end <= content.len()).then_some(start..end)
}

/// The header of a record: names and values.
#[derive(Debug)]
struct Header(BTreeMap<String, Vec<u8>>);

impl Header {
    fn parse(bytes: &[u8]) -> Result<Self, String> {
        let mut fields = BTreeMap::new();
        let mut at = 0;
        while at < bytes.len() {
            let field =
                sized(bytes, at).ok_or_else(|| format!("has a header field at byte {at} longer than the rest"))?;
            at = field.end;
            let field = &bytes[field];
            let equals = field.iter().position(|byte| *byte == b'=');
            let equals = equals.ok_or_else(|| format!("has a header field without = before byte {at}"))?;
            let (name, value) = (&field[..equals], &field[equals + 1..]);
            fields.insert(String::from_utf8_lossy(name).into_owned(), value.to_owned());
        }
        Ok(Self(fields))
    }

    fn field(&self, name: &str) -> Result<&[u8], String> {
        self.0.get(name).map(Vec::as_slice).ok_or_else(|| format!("has no header field {name}"))
    }

    fn operation(&self) -> Result<u8, String> {
        match self.field("op")? {
            [operation] => Ok(*operation),
            other => Err(format!("has an op of {} bytes, want 1", other.len())),
        }
    }

    fn number(&self, name: &str) -> Result<u32, String> {
        let value = self.field(name)?;
        let bytes = value.try_into().map_err(|_| format!("has a {name} of {} bytes, want 4", value.len()))?;
        Ok(u32::from_le_bytes(bytes))
    }

    fn text(&self, name: &str) -> Result<String, String> {
        Ok(String::from_utf8_lossy(self.field(name)?).into_owned())
    }
}
