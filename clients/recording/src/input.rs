//! A file that is not trusted: every length is held against what the file has.

use std::{
    io::{Read, Seek, SeekFrom},
    path::{Path, PathBuf},
};

use crate::{MAX_RECORD_BYTES, error::RecordingError};

/// An open file, read from its start, that knows where it is.
#[derive(Debug)]
pub(crate) struct Input<R> {
    path: PathBuf,
    source: R,
    position: u64,
    length: u64,
}

impl<R: Read + Seek> Input<R> {
    pub(crate) fn new(path: &Path, mut source: R) -> Result<Self, RecordingError> {
        let io = |source| RecordingError::io(path, source);
        let length = source.seek(SeekFrom::End(0)).map_err(io)?;
        source.seek(SeekFrom::Start(0)).map_err(io)?;
        Ok(Self { path: path.to_owned(), source, position: 0, length })
    }

    pub(crate) fn path(&self) -> &Path {
        &self.path
    }

    pub(crate) fn position(&self) -> u64 {
        self.position
    }

    /// Bytes from here to the end.
    pub(crate) fn left(&self) -> u64 {
        self.length.saturating_sub(self.position)
    }

    pub(crate) fn seek(&mut self, position: u64) -> Result<(), RecordingError> {
        self.source.seek(SeekFrom::Start(position)).map_err(|source| RecordingError::io(&self.path, source))?;
        self.position = position;
        Ok(())
    }

    /// Passes over `bytes` of `what`.
    pub(crate) fn skip(&mut self, bytes: u64, what: &str) -> Result<(), RecordingError> {
        self.has(bytes, what)?;
        self.seek(self.position + bytes)
    }

    /// Reads exactly `bytes` of `what`.
    pub(crate) fn take(&mut self, bytes: u64, what: &str) -> Result<Vec<u8>, RecordingError> {
        if bytes > MAX_RECORD_BYTES {
            let problem = format!("{what} says that it has {bytes} bytes, limit {MAX_RECORD_BYTES}");
            return Err(RecordingError::record(&self.path, self.position, problem));
        }
        self.has(bytes, what)?;
        let mut taken = Vec::new();
        let read = self.source.by_ref().take(bytes).read_to_end(&mut taken);
        let read = read.map_err(|source| RecordingError::io(&self.path, source))? as u64;
        if read < bytes {
            return Err(self.cut(what, bytes, read));
        }
        self.position += read;
        Ok(taken)
    }

    pub(crate) fn take_array<const N: usize>(&mut self, what: &str) -> Result<[u8; N], RecordingError> {
        self.has(N as u64, what)?;
        let mut taken = [0; N];
        self.source.read_exact(&mut taken).map_err(|source| RecordingError::io(&self.path, source))?;
        self.position += N as u64;
        Ok(taken)
    }

    fn has(&self, bytes: u64, what: &str) -> Result<(), RecordingError> {
        let left = self.left();
        if bytes > left { Err(self.cut(what, bytes, left)) } else { Ok(()) }
    }

    fn cut(&self, what: &str, wanted: u64, left: u64) -> RecordingError {
        let problem = format!("{what} wants {wanted} bytes, the file has {left} more,");
        RecordingError::Cut { path: self.path.clone(), offset: self.position, problem }
    }
}

/// Reads what a decompressor gives, which must be exactly `bytes`.
pub(crate) fn inflate(decompressor: impl Read, bytes: u64) -> Result<Vec<u8>, String> {
    let mut inflated = Vec::new();
    decompressor.take(bytes + 1).read_to_end(&mut inflated).map_err(|error| error.to_string())?;
    match inflated.len() as u64 {
        got if got == bytes => Ok(inflated),
        got if got > bytes => Err(format!("more than the {bytes} bytes that its header says")),
        got => Err(format!("{got} bytes, its header says {bytes}")),
    }
}
