//! A session: frames in any order and of any content, crashes in between, against a model of the rules.

use std::collections::BTreeMap;

use lanemap_core::{
    Category, Detection, Frame, FrameLimits, FrameParts, Odometry, Pose, Preset, Sensor, Sequence, TimestampNs,
};
use lanemap_server::fuzzing::{FuzzedDrive, Offered, bytes_of};
use nalgebra::Point3;

/// Most commands of one run: a mapper's step is what costs.
const MOST_COMMANDS: usize = 96;

/// Reads commands from `bytes` and gives them to a drive: offer a frame, crash and come back from snapshot and journal.
pub fn session(bytes: &[u8]) {
    let mut input = Input(bytes);
    let preset = if input.byte() & 1 == 0 { Preset::Default } else { Preset::Paper };
    let mut session = Session::new(preset);
    for _ in 0..MOST_COMMANDS {
        if input.0.is_empty() {
            break;
        }
        match input.byte() % 8 {
            0 => session.save(),
            1 => session.crash(),
            2 => session.repeat(input.byte()),
            _ => session.offer(&frame(&mut input, session.last)),
        }
    }
    session.crash();
}

/// A drive, beside what the rules say that it must be.
struct Session {
    drive: FuzzedDrive,
    /// Every frame admitted.
    admitted: BTreeMap<Sequence, Frame>,
    last: (u64, i64),
    snapshot: Option<Vec<u8>>,
    /// Frames admitted since the snapshot.
    journal: Vec<Frame>,
    preset: Preset,
}

impl Session {
    fn new(preset: Preset) -> Self {
        let drive = FuzzedDrive::new(preset, Sensor::default());
        Self { drive, admitted: BTreeMap::new(), last: (0, i64::MIN), snapshot: None, journal: Vec::new(), preset }
    }

    fn offer(&mut self, frame: &Frame) {
        let offered = self.drive.offer(frame);
        let follows = self.admitted.is_empty() || (frame.sequence().0 > self.last.0 && frame.time().0 > self.last.1);
        match offered {
            Offered::New => {
                assert!(follows, "frame {:?} was admitted after {:?}", frame.sequence(), self.last);
                self.last = (frame.sequence().0, frame.time().0);
                self.admitted.insert(frame.sequence(), frame.clone());
                self.journal.push(frame.clone());
            }
            Offered::Repeated => {
                let before = self.admitted.get(&frame.sequence()).expect("a repeated frame was admitted before");
                assert_eq!(bytes_of(before), bytes_of(frame), "another frame of the same number is no repetition");
            }
            Offered::Refused => assert!(!follows, "frame {:?} follows and was refused", frame.sequence()),
        }
        assert_eq!(self.drive.last_sequence(), self.admitted.keys().next_back().copied());
    }

    /// Offers a frame that was admitted, as a client does that saw no ack.
    fn repeat(&mut self, which: u8) {
        let count = self.admitted.len();
        if count == 0 {
            return;
        }
        let frame = self.admitted.values().nth(usize::from(which) % count).expect("it is below the count").clone();
        assert_eq!(self.drive.offer(&frame), Offered::Repeated, "an admitted frame is a repetition");
    }

    fn save(&mut self) {
        self.snapshot = Some(self.drive.snapshot().expect("a drive has a snapshot"));
        self.journal.clear();
    }

    /// Comes back from the last snapshot and the journal after it: the same drive to the last bit.
    fn crash(&mut self) {
        let before = self.drive.snapshot().expect("a drive has a snapshot");
        let mut drive = match &self.snapshot {
            Some(bytes) => FuzzedDrive::restore(bytes).expect("a snapshot restores"),
            None => FuzzedDrive::new(self.preset, Sensor::default()),
        };
        for frame in &self.journal {
            drive.replay(frame).expect("what was admitted once is admitted again");
        }
        assert_eq!(drive.snapshot().expect("a drive has a snapshot"), before, "a crash changed the drive");
        self.drive = drive;
    }
}

/// Bytes that commands are made of; zeros behind the end.
struct Input<'a>(&'a [u8]);

impl Input<'_> {
    fn byte(&mut self) -> u8 {
        match self.0.split_first() {
            Some((first, rest)) => {
                self.0 = rest;
                *first
            }
            None => 0,
        }
    }

    fn short(&mut self) -> i16 {
        i16::from_le_bytes([self.byte(), self.byte()])
    }
}

/// A valid frame: its number and time near the last ones, or far away.
fn frame(input: &mut Input<'_>, (last, last_ns): (u64, i64)) -> Frame {
    let shape = input.byte();
    let step = i64::from(input.byte().cast_signed());
    let sequence = match shape & 3 {
        0 => last.saturating_add(1),
        1 | 2 => last.saturating_add_signed(step),
        _ => u64::MAX - u64::from(input.byte()),
    };
    let time = match (shape >> 2) & 3 {
        0 => last_ns.saturating_add(100_000_000),
        1 | 2 => last_ns.saturating_add(step * 10_000_000),
        _ => i64::MAX - i64::from(input.byte()),
    };
    let place = |input: &mut Input<'_>, scale: f64| f64::from(input.short()) * scale;
    let scale = if shape & 16 == 0 { 1e-2 } else { 300.0 };
    let odometry_from_vehicle = Pose::new(
        [place(input, scale), place(input, scale), place(input, 1e-3)].into(),
        [place(input, 1e-6), place(input, 1e-6), place(input, 1e-4)].into(),
    );
    let lines = if shape & 32 == 0 { input.byte() % 5 } else { 0 };
    let detections = (0..lines).map(|_| line(input)).collect();
    let odometry = Odometry { odometry_from_vehicle, motion_covariance: None };
    let (sequence, time) = (Sequence(sequence), TimestampNs(time));
    let parts = FrameParts { sequence, time, odometry, gnss: None, detections, occlusions: Vec::new() };
    Frame::new(parts, &FrameLimits::default()).expect("its numbers are within the limits")
}

fn line(input: &mut Input<'_>) -> Detection {
    let category = Category::ALL[usize::from(input.byte()) % Category::ALL.len()];
    let (from, step, lateral, bend) =
        (input.byte(), input.byte(), input.byte().cast_signed(), input.byte().cast_signed());
    let count = input.byte() % 40;
    let points_vehicle = (0..count)
        .map(|k| {
            let x = f64::from(from) * 0.2 + f64::from(k) * f64::from(step) * 0.02;
            let wild = if k & 7 == 7 { f64::from(input.short()) * 1e-3 } else { 0.0 };
            let y = f64::from(lateral) * 0.1 + f64::from(bend) * 1e-4 * x * x + wild;
            Point3::new(x, y.clamp(-499.0, 499.0), wild * 0.1)
        })
        .collect();
    Detection { category, points_vehicle }
}
