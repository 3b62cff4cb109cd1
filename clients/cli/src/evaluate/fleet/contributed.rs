//! A drive, mapped: what it contributes to the shared map.

use lanemap_core::{
    Frame, Mapper, Params, Preset, Sensor,
    fleet::{Contribution, DriveId, FusedMap, Trace},
};

/// Maps a drive and says what it contributes; `None` of a drive without a frame.
pub fn contribution(drive: DriveId, sensor: Sensor, frames: impl Iterator<Item = Frame>) -> Option<Contribution> {
    let mut mapper = Mapper::new(Params::preset(Preset::Default), sensor);
    let mut trace = Trace::default();
    for frame in frames {
        let report = mapper.step(&frame);
        trace.observe(&frame, &report.map_from_vehicle);
    }
    trace.contribution(drive, sensor, &mapper.lane_map())
}

/// Bytes of a map at a millimetre per coordinate, two bytes of sigma and one of existence and support per knot, and the
/// names: an estimate: no store packs it so yet.
pub fn packed_bytes(map: &FusedMap) -> usize {
    const KNOT: usize = 3 * 2 + 2 + 2;
    const LINE: usize = 32;
    map.lanes.iter().map(|lane| LINE + KNOT * lane.points.len()).sum()
}
