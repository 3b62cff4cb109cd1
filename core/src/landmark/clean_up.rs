//! The authors' clean-up of a drive that is over: which of its lanes are given up (`paper` only).
//!
//! Not in the paper; `post_merge_lane` of its code. A lane is given up where it was seen too rarely,
//!
//! `n < 10` or `n / (last - first + 1) < 1/2`
//!
//! with `n` the frames that saw it, from its `first` to its `last`; or where it is the shorter of two, by its number of
//! control points, and more than 70 % of its points lie within 1.75 m, half the width of a road's lane, of the other's.
//!
//! All is judged on the map as it was before. Real neighbours closer than half a lane, as the two of a double line, die of
//! it, which is why `default` joins duplicates in its own way ([`duplicate`](super::duplicate)).

use std::collections::BTreeSet;

use kiddo::{ImmutableKdTree, SquaredEuclidean};
use nalgebra::Point3;

use super::Landmark;
use crate::{
    lane_map::LaneId,
    params::{CleanUpParams, LandmarkParams},
    spline::sampling::sample,
};

/// Points per chord of 3 m, as far apart as the authors thin a detection.
const PIECES_PER_CHORD: usize = 6;

/// The lanes that the clean-up gives up.
pub fn given_up<'a>(
    lanes: impl Iterator<Item = &'a Landmark>,
    rule: &CleanUpParams,
    params: &LandmarkParams,
) -> BTreeSet<LaneId> {
    let lines: Vec<Line> = lanes.map(|lane| Line::of(lane, rule, params)).collect();
    let is_given_up = |line: &&Line| {
        line.seen_rarely
            || lines.iter().any(|other| line.control_points < other.control_points && line.runs_along(other, rule))
    };
    lines.iter().filter(is_given_up).map(|line| line.id).collect()
}

/// What is asked of a lane.
struct Line {
    id: LaneId,
    seen_rarely: bool,
    control_points: usize,
    points: Vec<[f64; 3]>,
    /// `None` without points.
    tree: Option<ImmutableKdTree<f64, 3>>,
    /// Lowest and highest corner of its points.
    extent: [[f64; 3]; 2],
}

impl Line {
    fn of(lane: &Landmark, rule: &CleanUpParams, params: &LandmarkParams) -> Self {
        let span = (lane.seen_at_frame - lane.born_at_frame + 1) as f64;
        let seen = f64::from(lane.observations);
        let points: Vec<[f64; 3]> = sampled(lane, params).iter().map(|point| [point.x, point.y, point.z]).collect();
        let mut extent = [[f64::INFINITY; 3], [f64::NEG_INFINITY; 3]];
        for point in &points {
            for axis in 0..3 {
                extent[0][axis] = extent[0][axis].min(point[axis]);
                extent[1][axis] = extent[1][axis].max(point[axis]);
            }
        }
        Self {
            id: lane.id,
            seen_rarely: lane.observations < rule.least_observations || seen < rule.least_share_of_span * span,
            control_points: lane.positions().len(),
            tree: ImmutableKdTree::new_from_slice(&points).ok(),
            points,
            extent,
        }
    }

    /// Whether more of it lies near `other` than two lanes may share.
    fn runs_along(&self, other: &Self, rule: &CleanUpParams) -> bool {
        let Some(tree) = other.tree.as_ref().filter(|_| self.may_touch(other, rule.within_m)) else { return false };
        let is_near = |point: &&[f64; 3]| {
            let nearest = tree.query(point).nearest_one::<SquaredEuclidean<f64>>().execute();
            nearest.distance <= rule.within_m.powi(2)
        };
        self.points.iter().filter(is_near).count() as f64 > rule.most_overlap * self.points.len() as f64
    }

    fn may_touch(&self, other: &Self, within_m: f64) -> bool {
        let apart = |axis: usize| {
            self.extent[0][axis] > other.extent[1][axis] + within_m
                || other.extent[0][axis] > self.extent[1][axis] + within_m
        };
        !(0..3).any(apart)
    }
}

fn sampled(lane: &Landmark, params: &LandmarkParams) -> Vec<Point3<f64>> {
    let Some(curve) = lane.curve(params.ends) else { return Vec::new() };
    sample(&curve, curve.first_parameter(), curve.last_parameter(), PIECES_PER_CHORD)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Category, Detection, Pose, Preset, Sensor, frame::TimestampNs, observation::observe, params::Params};

    fn paper() -> (Params, CleanUpParams) {
        let params = Params::preset(Preset::Paper);
        let rule = params.landmark.clean_up.unwrap();
        (params, rule)
    }

    /// A straight line at `y`, `length_m` long, seen `observations` times in so many frames.
    fn lane(id: u64, y: f64, length_m: f64, observations: u32, frames: u64) -> Landmark {
        let (params, _) = paper();
        let points = (0..).map(|k| f64::from(k) * 0.5).take_while(|x| *x <= length_m);
        let points_vehicle = points.map(|x| Point3::new(4.0 + x, y, 0.0)).collect();
        let detection = Detection { category: Category::WhiteDashed, points_vehicle };
        let observation = observe(&detection, 0, &Sensor::default(), &params.observation).unwrap();
        let mut lane = Landmark::begin(LaneId(id), &observation, &Pose::identity(), TimestampNs(0), &params).unwrap();
        lane.observations = observations;
        (lane.born_at_frame, lane.seen_at_frame) = (5, 4 + frames);
        lane
    }

    fn left(lanes: &[Landmark]) -> Vec<u64> {
        let (params, rule) = paper();
        let given_up = given_up(lanes.iter(), &rule, &params.landmark);
        lanes.iter().map(|lane| lane.id).filter(|id| !given_up.contains(id)).map(|id| id.0).collect()
    }

    #[test]
    fn a_lane_seen_in_less_than_half_of_its_span_or_in_fewer_than_ten_frames_is_given_up() {
        let lanes = [lane(1, 0.0, 30.0, 10, 20), lane(2, 4.0, 30.0, 10, 21), lane(3, 8.0, 30.0, 9, 9)];
        assert_eq!(left(&lanes), [1]);
    }

    #[test]
    fn of_two_that_run_within_half_a_lane_the_one_of_fewer_control_points_is_given_up() {
        assert_eq!(left(&[lane(1, 0.0, 20.0, 20, 20), lane(2, 1.7, 40.0, 20, 20)]), [2]);
        assert_eq!(left(&[lane(1, 0.0, 20.0, 20, 20), lane(2, 1.8, 40.0, 20, 20)]), [1, 2]);
        // As long as each other: neither is.
        assert_eq!(left(&[lane(1, 0.0, 30.0, 20, 20), lane(2, 0.5, 30.0, 20, 20)]), [1, 2]);
    }

    #[test]
    fn what_is_itself_given_up_still_gives_up_others_for_all_is_judged_on_the_map_before() {
        let lanes = [lane(1, 0.0, 15.0, 20, 20), lane(2, 1.5, 25.0, 20, 20), lane(3, 3.0, 40.0, 20, 20)];
        assert_eq!(left(&lanes), [3]);
    }

    #[test]
    fn only_paper_cleans_up() {
        assert_eq!(Params::preset(Preset::Default).landmark.clean_up, None);
    }
}
