//! Drives as the bytes that a vehicle sends, encoded once and shared by all vehicles.
//!
//! A vehicle that comes to the end of a drive begins it again as a new drive, so that the bytes need no change.

use std::path::Path;

use anyhow::Context;
use bytes::Bytes;
use lanemap_core::{
    Frame, FrameError, FrameLimits, FrameParts, Preset, Sensor, Sequence, geometry::georeference::Georeference,
};
use lanemap_openlane::{DriveFolder, Drives};
use lanemap_proto::{
    encode,
    v1::{self, stream_observations_request::Message as Request},
};
use lanemap_simulator::{Scenario, Simulation};
use prost::Message;

/// Seed of the drives that are simulated where none were recorded.
const SEED: u64 = 1;
/// Number and length of those drives: about a minute each.
const SIMULATED_DRIVES: u32 = 8;
const SIMULATED_LENGTH_M: f64 = 600.0;

/// Standard deviation that the receiver states.
const GNSS_SIGMA_M: f64 = 1.0;

/// One drive.
#[derive(Debug)]
pub struct Tape {
    sensor: Sensor,
    /// `StreamObservationsRequest` messages; frame `i` has the sequence `i + 1`.
    frames: Vec<Bytes>,
}

/// The drive that a vehicle streams, by the names that it gives.
#[derive(Clone, Copy, Debug)]
pub struct DriveName<'a> {
    pub fleet: &'a str,
    pub vehicle: u32,
    /// Number of the vehicle's drive.
    pub drive: u32,
}

impl Tape {
    /// The drives of a folder in OpenLane's format, or simulated ones; with fixes where their world has an `origin`.
    pub fn load(drives: Option<&Path>, only: &[String], origin: Option<&Georeference>) -> anyhow::Result<Vec<Self>> {
        let tapes = match drives {
            Some(folder) => {
                let drives = Drives::list(folder, only)
                    .context("no drives to stream; --drives must name a folder of segment-* folders")?;
                drives.iter().map(|drive| Self::of_recording(drive, origin)).collect::<anyhow::Result<Vec<_>>>()?
            }
            None => Self::simulated(origin)?,
        };
        let tapes: Vec<_> = tapes.into_iter().filter(|tape| !tape.frames.is_empty()).collect();
        anyhow::ensure!(!tapes.is_empty(), "the drives hold no frame");
        Ok(tapes)
    }

    fn of_recording(drive: &DriveFolder, origin: Option<&Georeference>) -> anyhow::Result<Self> {
        let mut sensor = Sensor::default();
        let mut frames = Vec::with_capacity(drive.len());
        for (recorded, sequence) in drive.frames().zip(1..) {
            let recorded = recorded?;
            sensor = recorded.annotation.sensor();
            let parts = recorded.frame_parts(Sequence(sequence), recorded.annotation.pose()?, None);
            let frame = placed(parts, origin)
                .with_context(|| format!("{} and its result file", recorded.annotation.path.display()))?;
            frames.push(encoded(&frame));
        }
        Ok(Self { sensor, frames })
    }

    fn simulated(origin: Option<&Georeference>) -> anyhow::Result<Vec<Self>> {
        let scenario = Scenario { drives: SIMULATED_DRIVES, length_m: SIMULATED_LENGTH_M, ..Scenario::town(SEED) };
        let simulation = Simulation::run(&scenario);
        let tapes = simulation.drives.iter().map(|drive| {
            let frames = (0..drive.frames.len()).map(|index| {
                let frame = placed(drive.frame_parts(index, None), origin)?;
                Ok(encoded(&frame))
            });
            Ok(Self { sensor: drive.camera.sensor(), frames: frames.collect::<anyhow::Result<_>>()? })
        });
        tapes.collect()
    }

    /// Number of frames.
    pub fn len(&self) -> usize {
        self.frames.len()
    }

    /// The bytes of a frame, and its sequence.
    pub fn frame(&self, index: usize) -> Option<(Sequence, Bytes)> {
        Some((Sequence(index as u64 + 1), self.frames.get(index)?.clone()))
    }

    /// The message that opens a drive.
    pub fn start(&self, name: DriveName<'_>) -> Bytes {
        let DriveName { fleet, vehicle, drive } = name;
        request(Request::Start(v1::SessionStart {
            fleet_id: fleet.to_owned(),
            vehicle_id: vehicle_id(vehicle),
            drive_id: format!("drive-{drive}"),
            preset: encode::preset(Preset::Default).into(),
            sensor: Some(encode::sensor(&self.sensor)),
            wants_local_map: false,
        }))
    }

    /// The message that ends a drive.
    pub fn end() -> Bytes {
        request(Request::End(v1::SessionEnd {}))
    }
}

/// The name of a vehicle.
pub fn vehicle_id(vehicle: u32) -> String {
    format!("vehicle-{vehicle}")
}

/// A frame with the fix of a receiver at its pose, where the world has a place on the earth.
fn placed(parts: FrameParts, origin: Option<&Georeference>) -> Result<Frame, FrameError> {
    let pose = &parts.odometry.odometry_from_vehicle;
    let fix = origin.map(|origin| origin.fix_at(pose, GNSS_SIGMA_M, GNSS_SIGMA_M));
    Frame::new(FrameParts { gnss: fix.or(parts.gnss), ..parts }, &FrameLimits::default())
}

fn encoded(frame: &Frame) -> Bytes {
    request(Request::Frame(encode::frame(frame)))
}

fn request(message: Request) -> Bytes {
    v1::StreamObservationsRequest { message: Some(message) }.encode_to_vec().into()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_frame_is_found_by_its_place_and_bears_the_sequence_after_it() {
        let frames = vec![Bytes::from_static(b"a"), Bytes::from_static(b"b")];
        let tape = Tape { sensor: Sensor::default(), frames };
        assert_eq!(tape.frame(1), Some((Sequence(2), Bytes::from_static(b"b"))));
        assert_eq!(tape.frame(2), None);
    }
}
