//! Schemas, channels and messages of an MCAP file in the order in which they lie there, in chunks or not.
//!
//! The index at the file's end is not used: a file whose writer died has none.

use std::{
    io::{Read, Seek},
    path::Path,
};

use mcap::{
    MAGIC, parse_record,
    records::{ChunkHeader, Record, op},
};

use crate::{
    MAX_RECORD_BYTES,
    error::RecordingError,
    input::{Input, inflate},
};

/// Operation code and length of a record.
const RECORD_HEAD: usize = 9;
/// Window of zstd that is taken at most, as a power of 2: 64 MiB.
const MAX_ZSTD_WINDOW_LOG: u32 = 26;

/// Walks through a file once.
#[derive(Debug)]
pub(crate) struct Records<'a, R> {
    input: &'a mut Input<R>,
    chunk: Vec<u8>,
    /// Where the chunk begins in the file.
    chunk_offset: u64,
    /// Where the next record of the chunk begins in it.
    next_in_chunk: usize,
    done: bool,
}

impl<'a, R: Read + Seek> Records<'a, R> {
    /// From the start of the file.
    pub(crate) fn new(input: &'a mut Input<R>) -> Result<Self, RecordingError> {
        input.seek(0)?;
        let magic = input.take_array::<{ MAGIC.len() }>("the magic of an MCAP file")?;
        if magic != *MAGIC {
            let problem = format!("begins with {magic:02x?}, not with the magic of an MCAP file");
            return Err(RecordingError::record(input.path(), 0, problem));
        }
        Ok(Self { input, chunk: Vec::new(), chunk_offset: 0, next_in_chunk: 0, done: false })
    }

    /// The file's name.
    pub(crate) fn path(&self) -> &Path {
        self.input.path()
    }

    /// Calls `visit` with every schema, channel and message, and with where it lies, until it breaks off or the file's data
    /// ends. After an error the walk can go on with another call, at the record after it where its place is known.
    pub(crate) fn visit<T>(
        &mut self,
        mut visit: impl FnMut(u64, Record<'_>) -> Option<T>,
    ) -> Result<Option<T>, RecordingError> {
        while !self.done {
            if self.next_in_chunk < self.chunk.len() {
                if let Some(found) = self.visit_in_chunk(&mut visit)? {
                    return Ok(Some(found));
                }
            } else if let Some(found) = self.visit_in_file(&mut visit)? {
                return Ok(Some(found));
            }
        }
        Ok(None)
    }

    fn visit_in_chunk<T>(
        &mut self,
        visit: &mut impl FnMut(u64, Record<'_>) -> Option<T>,
    ) -> Result<Option<T>, RecordingError> {
        let start = self.next_in_chunk;
        let left = &self.chunk[start..];
        let refuse = |problem: String| {
            let problem = format!("the chunk's record at byte {start} of its content {problem}");
            RecordingError::record(self.input.path(), self.chunk_offset, problem)
        };
        let Some((head, rest)) = left.split_first_chunk::<RECORD_HEAD>() else {
            self.next_in_chunk = self.chunk.len();
            return Err(refuse(format!("has {} bytes, a record has at least {RECORD_HEAD}", left.len())));
        };
        let (code, length) = opcode_and_length(*head);
        let body = usize::try_from(length).ok().and_then(|length| rest.get(..length));
        let Some(body) = body else {
            self.next_in_chunk = self.chunk.len();
            return Err(refuse(format!("says that it has {length} bytes, the chunk has {} more", rest.len())));
        };
        self.next_in_chunk = start + RECORD_HEAD + body.len();
        match code {
            op::SCHEMA | op::CHANNEL | op::MESSAGE => {
                let record = parse_record(code, body).map_err(|error| refuse(format!("does not parse: {error}")))?;
                Ok(visit(self.chunk_offset, record))
            }
            _ => Ok(None),
        }
    }

    fn visit_in_file<T>(
        &mut self,
        visit: &mut impl FnMut(u64, Record<'_>) -> Option<T>,
    ) -> Result<Option<T>, RecordingError> {
        let offset = self.input.position();
        // Where even the head of a record is not in order, nothing says where the next one begins.
        self.done = true;
        let (code, length) = opcode_and_length(self.input.take_array("a record's head")?);
        let body = match code {
            op::DATA_END | op::FOOTER => return Ok(None),
            op::SCHEMA | op::CHANNEL | op::MESSAGE | op::CHUNK => self.input.take(length, name_of(code))?,
            _ => {
                self.input.skip(length, name_of(code))?;
                self.done = false;
                return Ok(None);
            }
        };
        self.done = false;
        let path = self.input.path();
        let record = parse_record(code, &body).map_err(|error| {
            RecordingError::record(path, offset, format!("{} does not parse: {error}", name_of(code)))
        })?;
        if let Record::Chunk { header, data } = record {
            let content = content(&header, &data);
            self.chunk =
                content.map_err(|problem| RecordingError::record(path, offset, format!("a chunk {problem}")))?;
            (self.chunk_offset, self.next_in_chunk) = (offset, 0);
            return Ok(None);
        }
        Ok(visit(offset, record))
    }
}

fn opcode_and_length(head: [u8; RECORD_HEAD]) -> (u8, u64) {
    let [code, length @ ..] = head;
    (code, u64::from_le_bytes(length))
}

fn name_of(code: u8) -> &'static str {
    match code {
        op::HEADER => "the header",
        op::SCHEMA => "a schema",
        op::CHANNEL => "a channel",
        op::MESSAGE => "a message",
        op::CHUNK => "a chunk",
        _ => "a record",
    }
}

/// The content of a chunk, its checksum verified.
fn content(header: &ChunkHeader, data: &[u8]) -> Result<Vec<u8>, String> {
    let bytes = header.uncompressed_size;
    if bytes > MAX_RECORD_BYTES {
        return Err(format!("says that it decompresses to {bytes} bytes, limit {MAX_RECORD_BYTES}"));
    }
    let content = match header.compression.as_str() {
        "" => inflate(data, bytes),
        "lz4" => inflate(lz4_flex::frame::FrameDecoder::new(data), bytes),
        "zstd" => zstd_decoder(data).and_then(|decoder| inflate(decoder, bytes)),
        other => {
            let other: String = other.chars().take(32).collect();
            return Err(format!("is compressed by {other:?}; zstd, lz4 and none are read here"));
        }
    };
    let content = content.map_err(|problem| format!("does not decompress: {problem}"))?;
    let checksum = crc32fast::hash(&content);
    if header.uncompressed_crc != 0 && checksum != header.uncompressed_crc {
        let stated = header.uncompressed_crc;
        return Err(format!("has the checksum {checksum:08x}, its header says {stated:08x}"));
    }
    Ok(content)
}

fn zstd_decoder(data: &[u8]) -> Result<impl Read + '_, String> {
    let mut decoder = zstd::stream::read::Decoder::with_buffer(data).map_err(|error| error.to_string())?;
    decoder.window_log_max(MAX_ZSTD_WINDOW_LOG).map_err(|error| error.to_string())?;
    Ok(decoder)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn chunk_of(compression: &str, says_bytes: u64, data: &[u8]) -> Result<Vec<u8>, String> {
        let header = ChunkHeader {
            message_start_time: 0,
            message_end_time: 0,
            uncompressed_size: says_bytes,
            uncompressed_crc: 0,
            compression: compression.to_owned(),
            compressed_size: data.len() as u64,
        };
        content(&header, data)
    }

    #[test]
    fn a_chunk_that_is_a_bomb_costs_what_its_header_says_and_no_more() {
        let bomb = zstd::encode_all(std::io::repeat(0).take(32 << 20), 3).unwrap();
        assert!(bomb.len() < 32 * 1024, "{}", bomb.len());
        let honest = chunk_of("zstd", 1 << 30, &bomb).unwrap_err();
        assert_eq!(honest, "says that it decompresses to 1073741824 bytes, limit 67108864");
        let lying = chunk_of("zstd", 1000, &bomb).unwrap_err();
        assert_eq!(lying, "does not decompress: more than the 1000 bytes that its header says");
    }

    #[test]
    fn a_chunk_that_does_not_decompress_or_holds_another_count_is_refused() {
        assert!(chunk_of("zstd", 10, b"no zstd").unwrap_err().starts_with("does not decompress"));
        assert!(chunk_of("lz4", 10, b"no lz4 ").unwrap_err().starts_with("does not decompress"));
        assert_eq!(chunk_of("", 9, b"eight by").unwrap_err(), "does not decompress: 8 bytes, its header says 9");
        assert!(chunk_of("snappy", 9, b"").unwrap_err().contains("\"snappy\""));
    }
}
