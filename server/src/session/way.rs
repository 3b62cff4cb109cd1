//! Where a drive has been, for readers: cheap to hand out while it grows.
//!
//! A copy shares all blocks that are full and copies the last one, so that publishing a long drive costs no more than
//! publishing a short one. Made of the drive's trace, which has what was mapped and nothing that a trip's ends keep back.

use std::sync::Arc;

use lanemap_core::{
    TimestampNs,
    fleet::{Trace, TrajectoryPoint},
};
use nalgebra::Point3;

/// Points of a block.
const BLOCK: usize = 64;

/// The vehicle at one moment.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct WayPoint {
    /// Time of measurement.
    pub time: TimestampNs,
    /// Position of the vehicle's origin, map frame, metres.
    pub position: Point3<f64>,
    /// Heading in the map frame, counter-clockwise from its x axis, radians.
    pub yaw_rad: f64,
}

/// The way of a drive so far: a point every few metres, in the order of travel.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Way {
    full: Vec<Arc<[WayPoint]>>,
    last: Vec<WayPoint>,
}

impl Way {
    /// The way of a trace.
    #[must_use]
    pub fn of(trace: &Trace) -> Self {
        let mut way = Self::default();
        way.follow(trace);
        way
    }

    /// Takes the points of a trace that came after those taken before.
    pub fn follow(&mut self, trace: &Trace) {
        for point in trace.points().iter().skip(self.len()) {
            self.push(point);
        }
    }

    fn push(&mut self, point: &TrajectoryPoint) {
        self.last.push(WayPoint { time: point.time, position: point.position, yaw_rad: point.yaw_rad });
        if self.last.len() == BLOCK {
            self.full.push(std::mem::take(&mut self.last).into());
        }
    }

    /// Number of points.
    #[must_use]
    pub fn len(&self) -> usize {
        self.full.len() * BLOCK + self.last.len()
    }

    /// Whether the drive has been nowhere yet.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The points in the order of travel.
    pub fn iter(&self) -> impl Iterator<Item = &WayPoint> {
        self.full.iter().flat_map(|block| block.iter()).chain(&self.last)
    }
}

#[cfg(test)]
mod tests {
    use lanemap_core::{Frame, FrameLimits, FrameParts, Odometry, Sequence, geometry::Pose};

    use super::*;

    fn driven(frames: u64) -> Trace {
        let mut trace = Trace::default();
        for number in 0..frames {
            let pose = Pose::translation(5.0 * number as f64, 0.0, 0.0);
            let odometry = Odometry { odometry_from_vehicle: pose, motion_covariance: None };
            let (sequence, time) = (Sequence(number), TimestampNs(i64::try_from(number).unwrap() * 100));
            let parts = FrameParts { sequence, time, odometry, gnss: None, detections: vec![], occlusions: vec![] };
            trace.observe(&Frame::new(parts, &FrameLimits::default()).unwrap(), &pose);
        }
        trace
    }

    #[test]
    fn a_way_has_every_point_of_its_trace_however_it_came_to_follow_it() {
        let (short, long) = (driven(70), driven(200));
        let mut way = Way::of(&short);
        let before = way.clone();
        way.follow(&long);
        assert_eq!((before.len(), way.len()), (70, 200));
        assert_eq!(way, Way::of(&long));
        assert!(
            way.iter().zip(long.points()).all(|(point, of)| point.position == of.position && point.time == of.time)
        );
    }

    #[test]
    fn a_copy_shares_the_blocks_that_are_full() {
        let way = Way::of(&driven(200));
        assert!(way.full.iter().zip(&way.clone().full).all(|(own, copied)| Arc::ptr_eq(own, copied)));
        assert!(way.last.len() < BLOCK);
    }
}
