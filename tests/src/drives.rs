//! Drives to stream: simulated, so that a clone without recordings has them too.

use lanemap_client::SessionStart;
use lanemap_core::{Frame, FrameLimits, Mapper, Params, Preset, Sensor};
use lanemap_proto::{encode, v1};
use lanemap_simulator::{Scenario, Simulation};
use prost::Message;

/// A drive: its camera and its frames, sequences from 1.
#[derive(Clone, Debug)]
pub struct Drive {
    /// Name of the drive.
    pub name: String,
    /// The camera.
    pub sensor: Sensor,
    /// The frames.
    pub frames: Vec<Frame>,
}

/// A simulated drive of `frames` frames along a winding road.
#[must_use]
pub fn simulated(seed: u64, frames: usize) -> Drive {
    // 22 m/s at most: long enough even then.
    let length_m = 2.2 * frames as f64 + 50.0;
    let simulation = Simulation::run(&Scenario::long_road(seed, length_m));
    let drive = &simulation.drives[0];
    assert!(drive.frames.len() >= frames, "the road ends after {} frames", drive.frames.len());
    let limits = FrameLimits::default();
    let frames = (0..frames).map(|index| Frame::new(drive.frame_parts(index, None), &limits).unwrap()).collect();
    Drive { name: format!("drive-{seed}"), sensor: drive.camera.sensor(), frames }
}

impl Drive {
    /// The start of a session that streams this drive.
    #[must_use]
    pub fn start(&self) -> SessionStart {
        SessionStart { sensor: self.sensor, ..SessionStart::new("test-fleet", "vehicle-under-test", &self.name) }
    }

    /// The same, as the wire has it.
    #[must_use]
    pub fn wire_start(&self) -> v1::SessionStart {
        v1::SessionStart {
            fleet_id: "test-fleet".to_owned(),
            vehicle_id: "vehicle-under-test".to_owned(),
            drive_id: self.name.clone(),
            preset: v1::MapperPreset::Default.into(),
            sensor: Some(encode::sensor(&self.sensor)),
            wants_local_map: false,
        }
    }

    /// What a mapper makes of the drive, with no service between.
    #[must_use]
    pub fn mapped(&self) -> Mapper {
        self.mapped_by(Preset::Default)
    }

    /// The same by either mapper.
    #[must_use]
    pub fn mapped_by(&self, preset: Preset) -> Mapper {
        let mut mapper = Mapper::new(Params::preset(preset), self.sensor);
        for frame in &self.frames {
            mapper.step(frame);
        }
        mapper
    }

    /// The bytes of `lanes.pb` that the service must serve for this drive.
    #[must_use]
    pub fn expected_map_bytes(&self) -> Vec<u8> {
        let mapper = self.mapped();
        let last = self.frames.last().unwrap();
        let map = v1::LaneMap {
            lanes: mapper.lane_map().lanes.iter().map(encode::lane).collect(),
            map_from_vehicle: Some(encode::pose(&mapper.map_from_vehicle())),
            last_sequence_inclusive: Some(last.sequence().0),
            last_time_unix_ns: last.time().0,
            georeference: mapper.georeference().as_ref().map(encode::georeference),
        };
        assert!(!map.lanes.is_empty(), "a drive without lanes proves nothing");
        map.encode_to_vec()
    }
}

/// Asserts that served bytes are those that a local mapper makes of the drive; says in lanes where they differ.
#[track_caller]
pub fn assert_same_map(served: &[u8], drive: &Drive) {
    let expected = drive.expected_map_bytes();
    if served == expected {
        return;
    }
    let lanes = |bytes| v1::LaneMap::decode(bytes).unwrap().lanes;
    let (served, expected) = (lanes(served), lanes(&expected));
    let differ: Vec<_> = served.iter().zip(&expected).filter(|(a, b)| a != b).map(|(lane, _)| lane.id).collect();
    panic!("the maps differ: {} lanes served, {} expected, ids that differ {differ:?}", served.len(), expected.len());
}
