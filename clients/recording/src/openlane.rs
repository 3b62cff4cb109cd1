//! OpenLane folders as recordings.

use lanemap_core::{Sequence, TimestampNs};
use lanemap_openlane::{DriveFolder, OpenLaneError, timestamp_stem};

use crate::drive::{Camera, FrameFault, RecordedFrame};

/// The frames of a folder, numbered from 1 in the order of time; one that cannot be read keeps its number.
pub(crate) fn frames(folder: &DriveFolder) -> impl Iterator<Item = Result<RecordedFrame, FrameFault>> + '_ {
    folder.times().iter().enumerate().map(|(index, time)| {
        frame(folder, *time, Sequence(index as u64 + 1))
            .map_err(|error| FrameFault { frame: timestamp_stem(*time), error: error.into() })
    })
}

fn frame(folder: &DriveFolder, time: TimestampNs, sequence: Sequence) -> Result<RecordedFrame, OpenLaneError> {
    let frame = folder.frame(time)?;
    let pose = frame.annotation.pose()?;
    Ok(RecordedFrame {
        parts: frame.frame_parts(sequence, pose, None),
        poses_are_true: true,
        world_from_vehicle_gnss: frame.annotation.world_from_vehicle_gnss,
        camera: Camera {
            sensor: frame.annotation.sensor(),
            intrinsic: Some(frame.annotation.intrinsic),
            image: Some(frame.annotation.image),
        },
    })
}
