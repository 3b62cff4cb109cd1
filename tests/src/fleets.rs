//! Drives of many vehicles along one road, each with a receiver of its own, and the shared map that comes of them.

use std::{collections::BTreeMap, time::Duration};

use lanemap_core::{fleet::CellId, geometry::georeference::Georeference};
use lanemap_proto::{
    encode,
    v1::{self, ingest_service_client::IngestServiceClient},
};
use lanemap_server::{RunningServer, fuse::SharedMap};
use lanemap_simulator::{
    Fleet, FleetScenario, Seed,
    fleet::{ChangeKind, ChangePlan, FleetRoads, FleetRoutes, ReceiverModel},
    road::{Course, SingleRoad},
};
use nalgebra::Point3;
use prost::Message;
use serde_json::Value;
use tokio::time::{interval, timeout};

use crate::http;

/// Longest wait for what takes a second or two on an idle machine.
pub const PATIENCE: Duration = Duration::from_mins(2);
/// Fleet of all these drives.
pub const FLEET: &str = "test-fleet";

/// One drive of the fleet, as the wire has it.
#[derive(Clone, Debug)]
pub struct WireDrive {
    /// Number within the fleet; the vehicle is named after it.
    pub number: u32,
    /// What its session starts with.
    pub start: v1::SessionStart,
    /// Its frames.
    pub frames: Vec<v1::Frame>,
}

/// `count` drives, a day apart, of `length_m` along one straight road, each with a GNSS bias of its own. With `on_border`
/// the border of two cells runs across the middle of the way.
#[must_use]
pub fn along_a_road(seed: u64, count: u32, length_m: f64, on_border: bool) -> Vec<WireDrive> {
    let scenario = FleetScenario {
        drives: count,
        routes: FleetRoutes::Shared { length_m, both_directions: false },
        receiver: ReceiverModel { bias_sigma_m: 1.0, ..ReceiverModel::default() },
        ..FleetScenario::straight_road()
    };
    wire_drives(&in_one_place(scenario, seed, on_border))
}

/// `count` drives, a day apart, of `length_m` along one road that bends to both sides and nowhere twice alike, each with a
/// GNSS bias of its own.
#[must_use]
pub fn along_a_bending_road(seed: u64, count: u32, length_m: f64) -> Vec<WireDrive> {
    let scenario = FleetScenario {
        drives: count,
        roads: FleetRoads::Single(SingleRoad::new(Course::Loop, 2_500.0)),
        routes: FleetRoutes::Shared { length_m, both_directions: false },
        receiver: ReceiverModel { bias_sigma_m: 1.0, ..ReceiverModel::default() },
        ..FleetScenario::straight_road()
    };
    wire_drives(&in_one_place(scenario, seed, false))
}

/// A line on the earth: longitude and latitude of its points, degrees.
pub type Places = Vec<[f64; 2]>;

/// A road that changes while vehicles drive along it.
#[derive(Debug)]
pub struct ChangingRoad {
    /// The drives, every second one the other way.
    pub drives: Vec<WireDrive>,
    /// What changes, and where that was and is; empty where there was nothing, or is nothing.
    pub changes: Vec<(ChangeKind, Places, Places)>,
}

/// `count` drives, a day apart, both ways along all of one straight road of 700 m, while it changes as planned.
#[must_use]
pub fn along_a_changing_road(seed: u64, count: u32, plan: ChangePlan) -> ChangingRoad {
    let fleet = in_one_place(changing(count, plan), seed, false);
    let georeference = fleet.georeference();
    let places = |points: &[Point3<f64>]| -> Places {
        let places = points.iter().map(|point| Georeference::to_wgs84(georeference, point));
        places.map(|place| [place.longitude_deg, place.latitude_deg]).collect()
    };
    let changes = fleet.changes().iter().map(|change| (change.kind, places(&change.before), places(&change.after)));
    ChangingRoad { changes: changes.collect(), drives: wire_drives(&fleet) }
}

fn changing(count: u32, changes: ChangePlan) -> FleetScenario {
    FleetScenario {
        drives: count,
        roads: FleetRoads::Single(SingleRoad::new(Course::Straight, 700.0)),
        routes: FleetRoutes::Shared { length_m: 650.0, both_directions: true },
        receiver: ReceiverModel { bias_sigma_m: 1.0, ..ReceiverModel::default() },
        changes,
        ..FleetScenario::straight_road()
    }
}

/// The fleet of a scenario of one road, moved into the middle of a cell, or half way over its border.
fn in_one_place(mut scenario: FleetScenario, seed: u64, on_border: bool) -> Fleet {
    let fleet = scenario.fleet(Seed(seed));
    let drive = fleet.drive(0);
    let states = drive.states();
    let (first, last) = (states[0].world_from_vehicle, states[states.len() - 1].world_from_vehicle);
    let middle = first.translation.vector.lerp(&last.translation.vector, 0.5);
    let way = last.translation.vector - first.translation.vector;
    let place = Georeference::to_wgs84(fleet.georeference(), &middle.into());
    let cell = CellId::containing(&place).unwrap();
    let (bounds, centre) = (cell.bounds(), cell.anchor().place());
    let eastward = way.x.abs() > way.y.abs();
    let wanted = match (on_border, eastward) {
        (false, _) => (centre.longitude_deg, centre.latitude_deg),
        (true, true) => (bounds.east, centre.latitude_deg),
        (true, false) => (centre.longitude_deg, bounds.north),
    };
    scenario.anchor.longitude_deg += wanted.0 - place.longitude_deg;
    scenario.anchor.latitude_deg += wanted.1 - place.latitude_deg;
    scenario.fleet(Seed(seed))
}

fn wire_drives(fleet: &Fleet) -> Vec<WireDrive> {
    let wire = fleet.drives().map(|drive| WireDrive {
        number: drive.number(),
        start: v1::SessionStart {
            fleet_id: FLEET.to_owned(),
            vehicle_id: format!("vehicle-{}", drive.number()),
            drive_id: "a-drive".to_owned(),
            preset: v1::MapperPreset::Default.into(),
            sensor: Some(encode::sensor(&drive.sensor())),
            wants_local_map: false,
        },
        frames: drive.frames().map(|frame| encode::frame(&frame)).collect(),
    });
    wire.collect()
}

impl WireDrive {
    /// The same drive of a vehicle without a receiver.
    #[must_use]
    pub fn without_gnss(mut self) -> Self {
        self.frames.iter_mut().for_each(|frame| frame.gnss = None);
        self
    }

    /// Uploads the first frames, or all; gives the session's id.
    pub async fn upload(&self, url: &str, frames: usize, end: bool) -> String {
        let mut client = IngestServiceClient::connect(url.to_owned()).await.unwrap();
        let frames = self.frames[..frames.min(self.frames.len())].to_vec();
        let request = v1::UploadObservationsRequest { start: Some(self.start.clone()), frames, end };
        let answer = client.upload_observations(request).await.unwrap().into_inner();
        assert_eq!(answer.refusals, []);
        answer.accepted.unwrap().session_id
    }

    /// Uploads the whole drive and ends it; gives the session's id.
    pub async fn upload_whole(&self, url: &str) -> String {
        self.upload(url, self.frames.len(), true).await
    }
}

/// Waits until all that drives have said is in the shared map, and what is told of it is as it should be.
pub async fn settled(server: &RunningServer) {
    settled_where(server.map(), |_| true).await;
}

/// The same, and until `holds` says so.
pub async fn settled_where(map: &SharedMap, holds: impl Fn(&SharedMap) -> bool) {
    let mut publications = map.publications();
    let settling = async {
        while !(map.is_settled() && holds(map)) {
            publications.changed().await.unwrap();
        }
    };
    timeout(PATIENCE, settling).await.expect("the map settles");
}

/// Asks a server for its cells until all that drives have said is in them, and `holds` says so of the list.
pub async fn cells_until(url: &str, holds: impl Fn(&[Value]) -> bool) -> Vec<Value> {
    let mut ticks = interval(Duration::from_millis(50));
    let asking = async {
        loop {
            ticks.tick().await;
            let answer: Value = http::get(format!("{url}/cells")).await.unwrap().json().await.unwrap();
            let cells = answer["cells"].as_array().unwrap().clone();
            if answer["settled"] == true && holds(&cells) {
                return cells;
            }
        }
    };
    timeout(PATIENCE, asking).await.expect("the map settles")
}

/// The bytes of every cell, by its name.
pub async fn cell_bytes(url: &str) -> BTreeMap<String, Vec<u8>> {
    let list: Value = http::get(format!("{url}/cells")).await.unwrap().json().await.unwrap();
    let mut cells = BTreeMap::new();
    for cell in list["cells"].as_array().unwrap() {
        let id = cell["id"].as_str().unwrap();
        let answer = http::get(format!("{url}/cells/{id}/lanes.pb")).await.unwrap();
        cells.insert(id.to_owned(), answer.error_for_status().unwrap().bytes().await.unwrap().to_vec());
    }
    cells
}

/// Every cell as it is served.
pub async fn cell_maps(url: &str) -> Vec<v1::CellMap> {
    let cells = cell_bytes(url).await;
    cells.values().map(|bytes| v1::CellMap::decode(bytes.as_slice()).unwrap()).collect()
}

/// Has a map grow in many versions.
pub async fn grow(url: &str, drives: &[WireDrive]) {
    for drive in drives {
        for frames in (40..drive.frames.len()).step_by(40) {
            drive.upload(url, frames, false).await;
        }
        drive.upload_whole(url).await;
    }
}
