//! What a vehicle is told of a step.

use lanemap_core::{LocalWindow, StepReport};
use lanemap_proto::{encode, v1};

use crate::session::drive::Drive;

pub(super) fn pose_update(report: &StepReport) -> v1::PoseUpdate {
    v1::PoseUpdate {
        sequence: report.sequence.0,
        map_from_vehicle: Some(encode::pose(&report.map_from_vehicle)),
        covariance: Some(encode::tangent_covariance(&report.covariance)),
    }
}

pub(super) fn local_map_update(report: &StepReport, drive: &Drive) -> v1::LocalMapUpdate {
    let lanes = drive.mapper().local_map(&LocalWindow::default());
    v1::LocalMapUpdate {
        sequence: report.sequence.0,
        lanes: lanes.iter().map(encode::local_lane).collect(),
        born: report.born.iter().map(|born| born.lane.0).collect(),
        grown: report.grown.iter().map(|lane| lane.0).collect(),
        dropped: report.dropped.iter().map(|lane| lane.0).collect(),
    }
}
