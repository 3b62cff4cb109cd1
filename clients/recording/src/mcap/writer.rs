//! Writes a drive to an MCAP file.

use std::{
    collections::BTreeMap,
    fs::File,
    io::{BufWriter, Seek, Write},
    path::{Path, PathBuf},
};

use lanemap_core::{Frame, Preset, Sensor, TimestampNs};
use lanemap_proto::{encode, v1};
use mcap::{Compression, McapError, WriteOptions, Writer, records::MessageHeader};
use prost::Message;

use super::{FRAME_SCHEMA, START_SCHEMA, descriptors::schema_of, scene};
use crate::error::RecordingError;

/// Size at which a chunk is closed, bytes before compression: what a crash can cost, beside [`FLUSH_AFTER_S`].
const CHUNK_BYTES: u64 = 256 * 1024;
/// A chunk is closed and handed to the system after so much of the drive, seconds.
const FLUSH_AFTER_S: f64 = 5.0;

/// The start of a recorded drive.
#[derive(Clone, Debug, PartialEq)]
pub struct DriveStart {
    /// The fleet.
    pub fleet: String,
    /// The vehicle.
    pub vehicle: String,
    /// The drive, which names the recording when it is read.
    pub drive: String,
    /// Which mapper the vehicle asked for.
    pub preset: Preset,
    /// The camera.
    pub sensor: Sensor,
}

impl DriveStart {
    fn to_wire(&self) -> v1::SessionStart {
        v1::SessionStart {
            fleet_id: self.fleet.clone(),
            vehicle_id: self.vehicle.clone(),
            drive_id: self.drive.clone(),
            preset: encode::preset(self.preset).into(),
            sensor: Some(encode::sensor(&self.sensor)),
            wants_local_map: false,
        }
    }
}

/// A drive that is being recorded. A process that dies leaves a file that can be read up to its last few seconds.
pub struct McapRecorder<W: Write + Seek> {
    path: PathBuf,
    writer: Writer<W>,
    start: DriveStart,
    channels: Channels,
    frames: u32,
    flushed_at: Option<TimestampNs>,
}

struct Channels {
    start: u16,
    frame: u16,
    lines: u16,
    transform: u16,
    fix: u16,
}

impl McapRecorder<BufWriter<File>> {
    /// Makes a file; one that is there already is not touched.
    ///
    /// # Errors
    /// A file that is there already or cannot be made.
    pub fn create(path: &Path, start: DriveStart) -> Result<Self, RecordingError> {
        let file = File::create_new(path).map_err(|source| RecordingError::io(path, source))?;
        Self::new(path, BufWriter::new(file), start)
    }
}

impl<W: Write + Seek> McapRecorder<W> {
    /// Records to `output`; `path` is only for messages.
    ///
    /// # Errors
    /// What `output` says.
    pub fn new(path: &Path, output: W, start: DriveStart) -> Result<Self, RecordingError> {
        let refuse = |error| failed(path, error);
        let options = WriteOptions::new()
            .compression(Some(Compression::Zstd))
            .compression_threads(0)
            .chunk_size(Some(CHUNK_BYTES))
            .library(concat!("lanemap ", env!("CARGO_PKG_VERSION")));
        let mut writer = options.create(output).map_err(refuse)?;
        let channels = Channels::declare(&mut writer).map_err(refuse)?;
        Ok(Self { path: path.to_owned(), writer, start, channels, frames: 0, flushed_at: None })
    }

    /// Records a frame.
    ///
    /// # Errors
    /// What the output says: there is no more room, for example.
    pub fn frame(&mut self, frame: &Frame) -> Result<(), RecordingError> {
        let time = frame.time();
        if self.frames == 0 {
            self.put_start(time)?;
        }
        self.frames = self.frames.saturating_add(1);
        self.put(self.channels.frame, time, &encode::frame(frame))?;
        self.put(self.channels.transform, time, &scene::transform(frame))?;
        self.put(self.channels.lines, time, &scene::scene(frame))?;
        if let Some(fix) = frame.gnss() {
            self.put(self.channels.fix, time, &scene::location(time, fix))?;
        }
        let flushed_at = *self.flushed_at.get_or_insert(time);
        if time.seconds_since(flushed_at) >= FLUSH_AFTER_S {
            self.writer.flush().map_err(|error| failed(&self.path, error))?;
            self.flushed_at = Some(time);
        }
        Ok(())
    }

    /// Writes the index and the end mark, and hands back the output.
    ///
    /// # Errors
    /// What the output says.
    pub fn finish(mut self) -> Result<W, RecordingError> {
        if self.frames == 0 {
            self.put_start(TimestampNs(0))?;
        }
        let finished = self.writer.finish().map_err(|error| failed(&self.path, error));
        finished?;
        let mut output = self.writer.into_inner();
        output.flush().map_err(|source| RecordingError::io(&self.path, source))?;
        Ok(output)
    }

    fn put_start(&mut self, time: TimestampNs) -> Result<(), RecordingError> {
        self.put(self.channels.start, time, &self.start.to_wire())
    }

    fn put(&mut self, channel_id: u16, time: TimestampNs, message: &impl Message) -> Result<(), RecordingError> {
        let time = u64::try_from(time.0).unwrap_or_default();
        let header = MessageHeader { channel_id, sequence: self.frames, log_time: time, publish_time: time };
        let written = self.writer.write_to_known_channel(&header, &message.encode_to_vec());
        written.map_err(|error| failed(&self.path, error))
    }
}

impl Channels {
    fn declare<W: Write + Seek>(writer: &mut Writer<W>) -> Result<Self, McapError> {
        let mut declare = |topic, schema, descriptors| {
            let schema = writer.add_schema(schema, "protobuf", &schema_of(schema, descriptors))?;
            writer.add_channel(schema, topic, "protobuf", &BTreeMap::new())
        };
        Ok(Self {
            start: declare("/lanemap/start", START_SCHEMA, v1::FILE_DESCRIPTOR_SET)?,
            frame: declare("/lanemap/frame", FRAME_SCHEMA, v1::FILE_DESCRIPTOR_SET)?,
            lines: declare("/lanemap/lines", "foxglove.SceneUpdate", scene::DESCRIPTORS)?,
            transform: declare("/tf", "foxglove.FrameTransform", scene::DESCRIPTORS)?,
            fix: declare("/gnss", "foxglove.LocationFix", scene::DESCRIPTORS)?,
        })
    }
}

fn failed(path: &Path, error: McapError) -> RecordingError {
    match error {
        McapError::Io(source) => RecordingError::io(path, source),
        other => RecordingError::content(path, format!("cannot be written: {other}")),
    }
}
