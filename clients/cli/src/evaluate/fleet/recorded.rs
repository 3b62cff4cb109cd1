//! Recorded roads that were driven more than once: drives with `road` and `traversal` in `index.json`.
//!
//! The mapper is given the receiver's poses alone, as odometry and as fixes. True poses are never read.

use std::{collections::BTreeMap, fs, path::Path};

use anyhow::Context;
use lanemap_core::{
    Frame, FrameLimits, Pose, Sequence, TimestampNs,
    fleet::DriveId,
    geometry::{
        georeference::{Anchor, Georeference, Wgs84},
        pose::covariance_from_sigmas,
    },
};
use lanemap_openlane::{DriveFolder, DriveFrame};
use nalgebra::{Point3, Translation3, Vector3};
use serde_json::Value;

use super::{Road, contributed::contribution};
use crate::evaluate::parallel;

/// What a fix is off by, as the receiver would state it, metres.
const FIX_SIGMA_M: f64 = 1.5;
/// What odometry states of each motion: it is the receiver's, which is smooth.
const MOTION_SIGMA_M: f64 = 1e-4;
const TURN_SIGMA_RAD: f64 = 2e-5;
/// Time between two traversals of a road, nanoseconds: the recorded times say nothing of it.
const DAY_NS: i64 = 86_400_000_000_000;

/// Every road of a folder, with its drives mapped.
pub fn roads(folder: &Path) -> anyhow::Result<Vec<Road>> {
    let names = roads_of_index(&folder.join("index.json"))?;
    anyhow::ensure!(!names.is_empty(), "{} names no road that was driven more than once", folder.display());
    let names: Vec<(String, Vec<String>)> = names.into_iter().collect();
    parallel::for_each(&names, |(name, drives)| road(folder, name, drives))
}

/// Names of the drives of each road, in the order of their traversals.
fn roads_of_index(path: &Path) -> anyhow::Result<BTreeMap<String, Vec<String>>> {
    let text = fs::read(path).with_context(|| format!("{}", path.display()))?;
    let index: Value = serde_json::from_slice(&text).with_context(|| format!("{}", path.display()))?;
    let mut roads: BTreeMap<String, BTreeMap<i64, String>> = BTreeMap::new();
    for drive in index["drives"].as_array().into_iter().flatten() {
        if let (Some(road), Some(traversal), Some(name)) =
            (drive["road"].as_str(), drive["traversal"].as_i64(), drive["name"].as_str())
        {
            roads.entry(road.to_owned()).or_default().insert(traversal, name.to_owned());
        }
    }
    Ok(roads.into_iter().map(|(road, drives)| (road, drives.into_values().collect())).collect())
}

fn road(folder: &Path, name: &str, drives: &[String]) -> anyhow::Result<Road> {
    let mut folders = drives.iter().map(|drive| DriveFolder::open(folder, drive)).collect::<Result<Vec<_>, _>>()?;
    folders.retain(|drive| !drive.is_empty());
    let first = folders.first().with_context(|| format!("road {name} has no drive with a frame"))?;
    let origin = receiver_pose(&first.frame(first.times()[0])?)?.translation.vector.map(f64::round);
    let anchor = Anchor::new(Wgs84 { latitude_deg: 48.0, longitude_deg: 11.0, height_m: 0.0 });
    let world = Georeference { anchor, enu_from_map: Pose::identity() };
    let mut contributions = Vec::new();
    let mut truth = Vec::new();
    for (number, drive) in folders.iter().enumerate() {
        let frames = frames(drive, &world, origin)?;
        let sensor = drive.frame(drive.times()[0])?.annotation.sensor();
        let mut contributed = contribution(DriveId(number as u64), sensor, frames.into_iter())
            .with_context(|| format!("{} has no frame", drive.name()))?;
        contributed.started = TimestampNs(contributed.started.0 + i64::try_from(number)? * DAY_NS);
        contributions.push(contributed);
        truth.extend(true_lines(&folder.join("maps").join(drive.name()).with_extension("geojson"), origin)?);
    }
    // What happened to a recorded road is not known.
    Ok(Road {
        name: name.to_owned(),
        contributions,
        truth,
        anchor,
        changes: Vec::new(),
        changes_asked: false,
        true_ways: Vec::new(),
    })
}

fn receiver_pose(frame: &DriveFrame) -> anyhow::Result<Pose> {
    let path = frame.annotation.path.display();
    frame.annotation.world_from_vehicle_gnss.with_context(|| format!("{path}: gnss_pose is missing"))
}

fn frames(drive: &DriveFolder, world: &Georeference, origin: Vector3<f64>) -> anyhow::Result<Vec<Frame>> {
    let covariance = covariance_from_sigmas([MOTION_SIGMA_M; 3], [TURN_SIGMA_RAD; 3]);
    let frames = drive.frames().enumerate().map(|(index, frame)| {
        let frame = frame?;
        let pose = Translation3::from(-origin) * receiver_pose(&frame)?;
        let mut parts = frame.frame_parts(Sequence(index as u64 + 1), pose, Some(covariance));
        parts.gnss = Some(world.fix_at(&pose, FIX_SIGMA_M, FIX_SIGMA_M));
        Frame::new(parts, &FrameLimits::default()).with_context(|| format!("{}", frame.annotation.path.display()))
    });
    frames.collect()
}

/// The lines of a true map, metres from an origin.
fn true_lines(path: &Path, origin: Vector3<f64>) -> anyhow::Result<Vec<Vec<Point3<f64>>>> {
    let text = fs::read(path).with_context(|| format!("{}", path.display()))?;
    let map: Value = serde_json::from_slice(&text).with_context(|| format!("{}", path.display()))?;
    let features = map["features"].as_array().with_context(|| format!("{}: no features", path.display()))?;
    let point = |point: &Value| {
        let at = |axis: usize| point[axis].as_f64();
        Some(Point3::new(at(0)?, at(1)?, at(2).unwrap_or(0.0)) - origin)
    };
    let line = |feature: &Value| {
        let points = feature["geometry"]["coordinates"].as_array()?;
        points.iter().map(point).collect::<Option<Vec<_>>>()
    };
    let lines: Option<Vec<Vec<Point3<f64>>>> = features.iter().map(line).collect();
    lines.with_context(|| format!("{}: a feature is not a line of numbers", path.display()))
}
