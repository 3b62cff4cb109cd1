//! Foot points of many samples of one lane: each search starts where the last one ended.
//!
//! `paper` looks for the nearest control points of every sample (`foot_point_coarse`), `default` walks on from the last foot
//! point by as much as the one before (`foot_point_refined`), which is right for samples in their order along the lane: they
//! are evenly spaced, and Newton begins a step nearer to its end.

use std::collections::VecDeque;

use nalgebra::Point3;

use super::{Landmark, information::Knot};
use crate::{
    lane_map::EndRule,
    params::LandmarkParams,
    spline::{Curve, FootPoint, foot_point_coarse, foot_point_refined},
};

/// Foot points of samples in the order along a lane, each search starting where the last one ended.
pub struct FootWalk<'a> {
    lane: &'a Landmark,
    curve: &'a Curve<'a, VecDeque<Point3<f64>>>,
    near: (usize, usize),
    ends: EndRule,
    chord_m: f64,
    /// The last foot point, and how far it lay from the one before.
    last: Option<(f64, f64)>,
}

impl<'a> FootWalk<'a> {
    /// A walk along a lane between two knots.
    #[must_use]
    pub fn new(
        lane: &'a Landmark,
        curve: &'a Curve<'a, VecDeque<Point3<f64>>>,
        near: (Knot, Knot),
        params: &LandmarkParams,
    ) -> Self {
        let near = (lane.index_of(near.0), lane.index_of(near.1));
        Self { lane, curve, near, ends: params.ends, chord_m: params.chord_m, last: None }
    }

    /// Foot point of the next sample; `None` beyond the lane's ends.
    pub fn foot_point(&mut self, query: &Point3<f64>) -> Option<FootPoint> {
        match self.ends {
            EndRule::Open => {
                let nearest = self.lane.nearest_index(query, self.near.0, self.near.1);
                foot_point_coarse(self.curve, query, nearest, self.chord_m)
            }
            EndRule::Reflected => {
                let start = self.start(query);
                let foot = foot_point_refined(self.curve, query, start)?;
                let stride = self.last.map_or(0.0, |(last, _)| foot.parameter - last);
                self.last = Some((foot.parameter, stride));
                Some(foot)
            }
        }
    }

    /// Parameter of the foot point, or of the end beyond which the query lies.
    pub fn nearest_parameter(&mut self, query: &Point3<f64>) -> f64 {
        let start = self.start(query);
        let (first, last) = (self.curve.first_parameter(), self.curve.last_parameter());
        foot_point_refined(self.curve, query, start).map_or_else(
            || {
                let to_first = (self.curve.point(first) - query).norm_squared();
                let to_last = (self.curve.point(last) - query).norm_squared();
                if to_first < to_last { first } else { last }
            },
            |foot| foot.parameter,
        )
    }

    fn start(&self, query: &Point3<f64>) -> f64 {
        self.last.map_or_else(
            || self.lane.nearest_index(query, self.near.0, self.near.1) as f64,
            |(last, stride)| last + stride,
        )
    }
}
