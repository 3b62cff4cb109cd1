//! Reads a drive from an MCAP file.

use std::{
    collections::BTreeMap,
    io::{Read, Seek},
    path::Path,
};

use lanemap_core::{FrameLimits, FrameParts, Odometry, Sensor};
use lanemap_proto::{
    decode::{self, PointFrame},
    v1,
};
use mcap::records::Record;
use prost::Message;

use super::{FRAME_SCHEMA, START_SCHEMA, records::Records};
use crate::{
    drive::{Camera, FrameFault, RecordedFrame},
    error::RecordingError,
    input::Input,
};

/// Schemas and channels of a file, more than which no drive has.
const MAX_CHANNELS: usize = 4096;
/// Topics named in an error.
const MOST_NAMED: usize = 12;

/// A drive in an MCAP file.
#[derive(Debug)]
pub struct McapDrive<R> {
    input: Input<R>,
    name: String,
    sensor: Sensor,
    points: PointFrame,
    frames: usize,
}

impl<R: Read + Seek> McapDrive<R> {
    /// Opens a file, whose name is only for messages. It is walked through once, without decoding frames, for the drive's
    /// start and the number of its frames.
    ///
    /// # Errors
    /// No MCAP file, no drive in it, more than one, or a start that is not in order. A file that is cut short is opened;
    /// its frames end with the error that says so.
    pub fn open(path: &Path, source: R) -> Result<Self, RecordingError> {
        let mut input = Input::new(path, source)?;
        let survey = Survey::of(&mut input)?;
        let start = survey.start()?;
        let refuse = |problem: String| RecordingError::content(path, format!("{START_SCHEMA}: {problem}"));
        let start = v1::SessionStart::decode(start).map_err(|error| refuse(format!("does not decode: {error}")))?;
        let sensor = start.sensor.as_ref().ok_or_else(|| refuse("start.sensor is missing".to_owned()))?;
        let (sensor, points) = decode::sensor(sensor).map_err(|error| refuse(error.to_string()))?;
        let name = match start.drive_id.as_str() {
            "" => path.file_stem().unwrap_or_default().to_string_lossy().into_owned(),
            id => id.to_owned(),
        };
        Ok(Self { name, sensor, points, frames: survey.frames, input })
    }

    /// Name of the drive: the drive's id.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Number of frames.
    #[must_use]
    pub fn len(&self) -> usize {
        self.frames
    }

    /// Whether the drive has no frame.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.frames == 0
    }

    /// Reads the frames in the order of the file.
    pub fn frames(&mut self) -> impl Iterator<Item = Result<RecordedFrame, FrameFault>> + Send + '_
    where
        R: Send,
    {
        let camera = Camera { sensor: self.sensor, intrinsic: None, image: None };
        let points = self.points;
        let mut channels = Channels::default();
        let mut number = 0_usize;
        let mut last_good = None;
        let mut records = Some(Records::new(&mut self.input));
        std::iter::from_fn(move || {
            let Ok(walk) = records.as_mut()? else {
                let error = records.take()?.err()?;
                return Some(Err(FrameFault { frame: "start".to_owned(), error }));
            };
            let path = walk.path().to_owned();
            let message = walk.visit(|offset, record| match record {
                Record::Message { header, data } if channels.is(header.channel_id, FRAME_SCHEMA) => {
                    number += 1;
                    Some(frame(&data, &points).map_err(|problem| RecordingError::record(&path, offset, problem)))
                }
                record => {
                    channels.note(record);
                    None
                }
            });
            let fault = |error, what: String| Some(Err(FrameFault { frame: what, error }));
            match message {
                Ok(Some(Ok(parts))) => {
                    last_good = Some(parts.sequence.0);
                    let camera = camera.clone();
                    Some(Ok(RecordedFrame { parts, poses_are_true: false, world_from_vehicle_gnss: None, camera }))
                }
                Ok(Some(Err(error))) => fault(error, format!("message {number}")),
                Ok(None) => None,
                Err(error) => {
                    let after = last_good.map_or_else(|| "the start".to_owned(), |last: u64| format!("frame {last}"));
                    fault(error, format!("after {after}"))
                }
            }
        })
    }
}

fn frame(bytes: &[u8], points: &PointFrame) -> Result<FrameParts, String> {
    let message = v1::Frame::decode(bytes).map_err(|error| format!("{FRAME_SCHEMA} does not decode: {error}"))?;
    let frame = decode::frame(&message, points, &FrameLimits::default())
        .map_err(|error| format!("frame {}: {error}", message.sequence))?;
    Ok(FrameParts {
        sequence: frame.sequence(),
        time: frame.time(),
        odometry: Odometry::clone(frame.odometry()),
        gnss: frame.gnss().copied(),
        detections: frame.detections().to_vec(),
        occlusions: frame.occlusions().to_vec(),
    })
}

/// What was declared so far: which channel bears which schema.
#[derive(Debug, Default)]
struct Channels {
    schemas: BTreeMap<u16, String>,
    channels: BTreeMap<u16, (String, String)>,
}

impl Channels {
    fn note(&mut self, record: Record<'_>) {
        match record {
            Record::Schema { header, .. } if self.schemas.len() < MAX_CHANNELS => {
                self.schemas.insert(header.id, header.name);
            }
            Record::Channel(channel) if self.channels.len() < MAX_CHANNELS => {
                let schema = self.schemas.get(&channel.schema_id).cloned().unwrap_or_default();
                let schema = if channel.message_encoding == "protobuf" { schema } else { channel.message_encoding };
                self.channels.insert(channel.id, (channel.topic, schema));
            }
            _ => {}
        }
    }

    fn is(&self, id: u16, schema: &str) -> bool {
        self.channels.get(&id).is_some_and(|(_, name)| name == schema)
    }

    fn with_schema(&self, schema: &str) -> Vec<&str> {
        self.channels.values().filter(|(_, name)| name == schema).map(|(topic, _)| topic.as_str()).collect()
    }

    /// Every channel with its schema, in words.
    fn list(&self) -> String {
        let mut named: Vec<String> =
            self.channels.values().take(MOST_NAMED).map(|(topic, schema)| format!("{topic} ({schema})")).collect();
        if self.channels.len() > MOST_NAMED {
            named.push(format!("{} more", self.channels.len() - MOST_NAMED));
        }
        if named.is_empty() { "no channel at all".to_owned() } else { named.join(", ") }
    }
}

/// What a file holds.
struct Survey {
    path: std::path::PathBuf,
    channels: Channels,
    start: Option<Vec<u8>>,
    starts: usize,
    frames: usize,
    /// What the walk met, which may be why something is missing.
    first_error: Option<RecordingError>,
}

impl Survey {
    fn of<R: Read + Seek>(input: &mut Input<R>) -> Result<Self, RecordingError> {
        let path = input.path().to_owned();
        let channels = Channels::default();
        let mut survey = Self { path, channels, start: None, starts: 0, frames: 0, first_error: None };
        let mut records = Records::new(input)?;
        loop {
            match records.visit(|_, record| survey.note(record)) {
                Ok(_) => return Ok(survey),
                Err(error) => survey.first_error = survey.first_error.take().or(Some(error)),
            }
        }
    }

    /// Never breaks the walk off.
    fn note(&mut self, record: Record<'_>) -> Option<()> {
        match record {
            Record::Message { header, .. } if self.channels.is(header.channel_id, FRAME_SCHEMA) => self.frames += 1,
            Record::Message { header, data } if self.channels.is(header.channel_id, START_SCHEMA) => {
                self.starts += 1;
                self.start.get_or_insert_with(|| data.into_owned());
            }
            record => self.channels.note(record),
        }
        None
    }

    fn start(&self) -> Result<&[u8], RecordingError> {
        let refuse = |problem| Err(RecordingError::Content { path: self.path.clone(), problem });
        for schema in [START_SCHEMA, FRAME_SCHEMA] {
            match self.channels.with_schema(schema).as_slice() {
                [] => {
                    let because = self.first_error.as_ref().map(|error| format!(" (and: {error})")).unwrap_or_default();
                    let list = self.channels.list();
                    return refuse(format!("has no channel of {schema} in protobuf; it has {list}{because}"));
                }
                [_] => {}
                topics => {
                    let topics = topics.iter().take(MOST_NAMED).copied().collect::<Vec<_>>().join(", ");
                    return refuse(format!("has several channels of {schema} ({topics}); a file holds one drive"));
                }
            }
        }
        match &self.start {
            Some(start) if self.starts == 1 => Ok(start),
            Some(_) => refuse(format!("has {} messages of {START_SCHEMA}; a file holds one drive", self.starts)),
            None => refuse(format!("has no message of {START_SCHEMA}: nothing says what camera its frames are from")),
        }
    }
}
