//! Names of the shared map's lines as texts.

use lanemap_core::{
    LaneId, TimestampNs,
    fleet::{DriveId, FusedLaneId},
};

/// The text of a line's name. Sorts as bytes do; the times of one age before those of a later one.
#[must_use]
pub fn lane_id_text(id: &FusedLaneId) -> String {
    format!("{:016x}-{:016x}-{:x}-{}-{}", id.started.0, id.drive.0, id.lane.0, id.piece, id.stretch)
}

/// Reads [`lane_id_text`]; `None` where it is none.
#[must_use]
pub fn parse_lane_id(text: &str) -> Option<FusedLaneId> {
    let mut parts = text.split('-');
    let mut hexadecimal = || u64::from_str_radix(parts.next()?, 16).ok();
    let (started, drive, lane) = (hexadecimal()?, hexadecimal()?, hexadecimal()?);
    let (piece, stretch) = (parts.next()?.parse().ok()?, parts.next()?.parse().ok()?);
    let id = FusedLaneId {
        started: TimestampNs(started.cast_signed()),
        drive: DriveId(drive),
        lane: LaneId(lane),
        piece,
        stretch,
    };
    (parts.next().is_none() && lane_id_text(&id) == text).then_some(id)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn a_name_survives_its_text(started in any::<i64>(), drive in any::<u64>(), lane in any::<u64>(), piece in 0..9_u32) {
            let id = FusedLaneId {
                started: TimestampNs(started), drive: DriveId(drive), lane: LaneId(lane), piece, stretch: 1,
            };
            prop_assert_eq!(parse_lane_id(&lane_id_text(&id)), Some(id));
        }
    }

    #[test]
    fn a_text_that_is_no_name_is_refused() {
        for text in
            ["", "1-2-3-4-5", "0000000000000001-0000000000000002-3-4", "0000000000000001-0000000000000002-+3-4-5"]
        {
            assert_eq!(parse_lane_id(text), None, "{text}");
        }
    }
}
