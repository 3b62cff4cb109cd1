//! Cuts the ends off a trip: where a vehicle sets out and where it arrives stays out of every map.
//!
//! The rule has a distance and a time. A frame is **cut** while the vehicle has not gone both that far and that long
//! since it set out. A later frame is **held** until the vehicle has gone both that far and that long beyond it; if the
//! trip ends before, it is **erased**. A trip ends when the client says so, when a vehicle sends nothing for
//! [`TripCut::stop_s`], and when it does not leave the place for so long: what follows sets out anew.
//!
//! Far means as the crow flies, so that circling the block does not count, and no jump of the odometry counts for more
//! than a vehicle can drive. Decided from the frames alone, each against the frames before it: the same frames are cut
//! and held however they came, and again after a crash.
//!
//! Not promised: that a street near home is in no map. A vehicle that passes there in the middle of a trip maps it.

use std::collections::VecDeque;

use lanemap_core::{Frame, Sequence, TimestampNs};
use nalgebra::{Point3, Vector3};
use serde::{Deserialize, Serialize};

/// Fastest that a vehicle drives, m/s: a longer step of the odometry is a jump of its frame.
const FASTEST_M_PER_S: f64 = 70.0;

/// Most frames held, an hour at 10 Hz: a vehicle that sends more without leaving has stopped.
const MOST_HELD: usize = 36_000;

/// How much is cut off both ends of a trip. A drive keeps the rule with which it began.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct TripCut {
    /// Distance from either end, metres; 0: none.
    pub distance_m: f64,
    /// Time from either end, seconds; 0: none.
    pub time_s: f64,
    /// Time without a frame, or without leaving, that ends a trip, seconds.
    pub stop_s: f64,
}

/// Where a trip is between its ends.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct TripEnds {
    phase: Phase,
    track: Option<Track>,
}

/// What becomes of a frame, and of those held before it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Passage {
    /// The frame is to be forgotten; what was held before it too.
    Cut,
    /// The frame is to be kept. Frames held up to this one, inclusive, may be mapped.
    Held {
        /// `None`: no frame may be mapped yet.
        mapped_through: Option<Sequence>,
    },
}

#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
enum Phase {
    /// Before the first frame of a trip.
    #[default]
    Standing,
    /// Within the cut of the place where it set out.
    SettingOut { from: Place },
    /// Beyond it.
    UnderWay { held: VecDeque<(Sequence, Place)> },
}

/// A place on the way, and when the vehicle was there.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
struct Place {
    time: TimestampNs,
    position_m: Point3<f64>,
}

/// The way so far: odometry with its jumps taken out.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
struct Track {
    odometry_m: Point3<f64>,
    at: Place,
}

impl TripCut {
    /// Whether anything is cut.
    #[must_use]
    pub fn is_on(&self) -> bool {
        self.distance_m > 0.0 || self.time_s > 0.0
    }

    fn is_beyond(&self, from: &Place, at: &Place) -> bool {
        let far = (at.position_m - from.position_m).norm() >= self.distance_m;
        far && at.time.seconds_since(from.time) >= self.time_s
    }

    /// Whether a vehicle that sent nothing between has ended its trip.
    fn is_pause(&self, from: &Place, at: &Place) -> bool {
        at.time.seconds_since(from.time) > self.stop_s
    }

    /// Whether a vehicle that has not left has ended its trip.
    fn is_stay(&self, from: &Place, at: &Place) -> bool {
        at.time.seconds_since(from.time) > self.time_s + self.stop_s
    }
}

impl Track {
    fn advanced(before: Option<&Self>, frame: &Frame) -> Self {
        let odometry_m = Point3::from(frame.odometry().odometry_from_vehicle.translation.vector);
        let Some(before) = before else {
            return Self { odometry_m, at: Place { time: frame.time(), position_m: Point3::origin() } };
        };
        let longest_m = FASTEST_M_PER_S * frame.time().seconds_since(before.at.time).max(0.0);
        let step: Vector3<f64> = (odometry_m - before.odometry_m).cap_magnitude(longest_m);
        Self { odometry_m, at: Place { time: frame.time(), position_m: before.at.position_m + step } }
    }
}

impl TripEnds {
    /// Whether [`TripEnds::arrive`] would cut `frame`.
    #[must_use]
    pub fn would_cut(&self, rule: &TripCut, frame: &Frame) -> bool {
        rule.is_on() && self.stays(rule, &Track::advanced(self.track.as_ref(), frame).at)
    }

    fn stays(&self, rule: &TripCut, at: &Place) -> bool {
        let silent = self.track.is_some_and(|track| rule.is_pause(&track.at, at));
        silent
            || match &self.phase {
                Phase::Standing => true,
                Phase::SettingOut { from } => !rule.is_beyond(from, at),
                Phase::UnderWay { held } => {
                    let oldest = held.front().filter(|(_, from)| !rule.is_beyond(from, at));
                    oldest.is_some_and(|(_, from)| held.len() >= MOST_HELD || rule.is_stay(from, at))
                }
            }
    }

    /// Takes the next frame of the drive.
    pub fn arrive(&mut self, rule: &TripCut, frame: &Frame) -> Passage {
        let sequence = frame.sequence();
        if !rule.is_on() {
            return Passage::Held { mapped_through: Some(sequence) };
        }
        let track = Track::advanced(self.track.as_ref(), frame);
        let silent = self.track.is_some_and(|before| rule.is_pause(&before.at, &track.at));
        let stays = self.stays(rule, &track.at);
        self.track = Some(track);
        if stays {
            let still_setting_out = matches!(self.phase, Phase::SettingOut { .. }) && !silent;
            if !still_setting_out {
                self.phase = Phase::SettingOut { from: track.at };
            }
            return Passage::Cut;
        }
        let mut held = match std::mem::take(&mut self.phase) {
            Phase::UnderWay { held } => held,
            Phase::Standing | Phase::SettingOut { .. } => VecDeque::new(),
        };
        held.push_back((sequence, track.at));
        let mut mapped_through = None;
        while let Some((sequence, _)) = held.front().filter(|(_, from)| rule.is_beyond(from, &track.at)) {
            mapped_through = Some(*sequence);
            held.pop_front();
        }
        self.phase = Phase::UnderWay { held };
        Passage::Held { mapped_through }
    }

    /// The trip is over: what is held must be erased, and what comes sets out anew.
    pub fn stop(&mut self) {
        *self = Self::default();
    }

    /// Whether frames are held.
    #[must_use]
    pub fn holds(&self) -> bool {
        matches!(&self.phase, Phase::UnderWay { held } if !held.is_empty())
    }
}

#[cfg(test)]
mod tests {
    use lanemap_core::{FrameLimits, FrameParts, Odometry, geometry::Pose};

    use super::*;

    const RULE: TripCut = TripCut { distance_m: 50.0, time_s: 5.0, stop_s: 60.0 };

    /// A frame at `x_m` on a straight road; its number is its time in tenths of a second.
    fn frame(number: u64, x_m: f64) -> Frame {
        let pose = Pose::translation(x_m, 0.0, 0.0);
        let odometry = Odometry { odometry_from_vehicle: pose, motion_covariance: None };
        let time = TimestampNs(i64::try_from(number).unwrap() * 100_000_000);
        let parts = FrameParts {
            sequence: Sequence(number),
            time,
            odometry,
            gnss: None,
            detections: vec![],
            occlusions: vec![],
        };
        Frame::new(parts, &FrameLimits::default()).unwrap()
    }

    /// Sends frames; gives the numbers that were cut and the last that may be mapped.
    fn drive(
        ends: &mut TripEnds,
        rule: &TripCut,
        frames: impl IntoIterator<Item = (u64, f64)>,
    ) -> (Vec<u64>, Option<u64>) {
        let (mut cut, mut mapped) = (Vec::new(), None);
        for (number, x_m) in frames {
            let frame = frame(number, x_m);
            let foretold = ends.would_cut(rule, &frame);
            match ends.arrive(rule, &frame) {
                Passage::Cut => cut.push(number),
                Passage::Held { mapped_through } => mapped = mapped_through.map(|sequence| sequence.0).or(mapped),
            }
            assert_eq!(foretold, cut.last() == Some(&number));
        }
        (cut, mapped)
    }

    #[test]
    fn frames_are_cut_until_both_distance_and_time_have_passed() {
        // 20 m/s: 50 m after 2.5 s, but 5 s come later, at frame 50.
        let (cut, _) = drive(&mut TripEnds::default(), &RULE, (0..60).map(|n| (n, 2.0 * n as f64)));
        assert_eq!(cut, (0..50).collect::<Vec<_>>());
        // 5 m/s: 5 s pass first, 50 m after 10 s.
        let (cut, _) = drive(&mut TripEnds::default(), &RULE, (0..120).map(|n| (n, 0.5 * n as f64)));
        assert_eq!(cut, (0..100).collect::<Vec<_>>());
    }

    #[test]
    fn a_frame_is_held_until_the_vehicle_has_gone_both_that_far_and_that_long_beyond_it() {
        // 20 m/s, 10 Hz: the time is the longer one, 50 frames.
        let (_, mapped) = drive(&mut TripEnds::default(), &RULE, (0..=150).map(|n| (n, 2.0 * n as f64)));
        assert_eq!(mapped, Some(100));
        let (_, mapped) = drive(&mut TripEnds::default(), &RULE, (0..=90).map(|n| (n, 2.0 * n as f64)));
        assert_eq!(mapped, None);
    }

    #[test]
    fn circling_the_block_and_a_jump_of_the_odometry_do_not_count_as_leaving() {
        let rule = TripCut { time_s: 0.0, ..RULE };
        let block = (0..300).map(|n| (n, 20.0 * (n as f64 / 20.0).sin()));
        assert_eq!(drive(&mut TripEnds::default(), &rule, block).0.len(), 300);
        let jump = (0..20).map(|n| (n, if n < 10 { 0.0 } else { 1e5 }));
        assert_eq!(drive(&mut TripEnds::default(), &rule, jump).0.len(), 20);
    }

    #[test]
    fn a_pause_is_the_end_of_a_trip_and_the_start_of_another() {
        let mut ends = TripEnds::default();
        drive(&mut ends, &RULE, (0..=150).map(|n| (n, 2.0 * n as f64)));
        assert!(ends.holds());
        let (cut, mapped) = drive(&mut ends, &RULE, (1000..=1200).map(|n| (n, 300.0 + 2.0 * (n - 1000) as f64)));
        assert_eq!(cut, (1000..1050).collect::<Vec<_>>());
        assert_eq!(mapped, Some(1150), "nothing of before the pause is mapped");
    }

    #[test]
    fn a_vehicle_that_does_not_leave_for_long_has_stopped() {
        let mut ends = TripEnds::default();
        drive(&mut ends, &RULE, (0..=100).map(|n| (n, 2.0 * n as f64)));
        let standing = (101..=1000).map(|n| (n, 200.0));
        let (cut, mapped) = drive(&mut ends, &RULE, standing);
        assert!(!ends.holds());
        assert_eq!(cut.last(), Some(&1000));
        assert_eq!(mapped, Some(75), "50 m before the place where it stands");
        let (cut, _) = drive(&mut ends, &RULE, (1001..=1100).map(|n| (n, 200.0 + 2.0 * (n - 1000) as f64)));
        assert_eq!(cut, (1001..1025).collect::<Vec<_>>(), "it sets out anew");
    }

    #[test]
    fn without_a_cut_every_frame_is_mapped_at_once() {
        let mut ends = TripEnds::default();
        let (cut, mapped) = drive(&mut ends, &TripCut::default(), [(1, 0.0), (2, 0.0)]);
        assert_eq!((cut, mapped), (vec![], Some(2)));
        assert_eq!(ends, TripEnds::default());
    }
}
