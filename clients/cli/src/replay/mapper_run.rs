//! A mapper on the frames of one drive, timed.

use std::time::Instant;

use lanemap_core::{Frame, Mapper, Params, Pose, Sensor};
use nalgebra::Vector3;

use super::step_times::StepTimes;

/// Steps between two counts of the lanes for the progress bar.
const COUNT_EVERY: usize = 20;

/// A mapper with the times of its steps.
pub struct MapperRun {
    mapper: Mapper,
    times: StepTimes,
    steps: usize,
    lanes: usize,
    driven_m: f64,
    last_place: Option<Vector3<f64>>,
}

impl MapperRun {
    /// A mapper at the start of a drive.
    pub fn new(params: Params, sensor: Sensor) -> Self {
        let mapper = Mapper::new(params, sensor);
        Self { mapper, times: StepTimes::default(), steps: 0, lanes: 0, driven_m: 0.0, last_place: None }
    }

    /// Takes a frame, which was recorded at `pose`. Only `Mapper::step` itself is timed.
    pub fn step(&mut self, frame: &Frame, pose: &Pose) {
        let place = pose.translation.vector;
        self.driven_m += self.last_place.map_or(0.0, |last| (place - last).norm());
        self.last_place = Some(place);
        let started = Instant::now();
        let report = self.mapper.step(frame);
        let took = started.elapsed();
        std::hint::black_box(report);
        self.times.push(self.driven_m, took);
        if self.steps.is_multiple_of(COUNT_EVERY) {
            self.lanes = self.mapper.lane_map().lanes.len();
        }
        self.steps += 1;
    }

    /// The mapper.
    pub fn mapper(&self) -> &Mapper {
        &self.mapper
    }

    /// Times of the steps so far.
    pub fn times(&self) -> &StepTimes {
        &self.times
    }

    /// Frames taken so far.
    pub fn steps(&self) -> usize {
        self.steps
    }

    /// Lanes at the last count.
    pub fn lanes(&self) -> usize {
        self.lanes
    }

    /// Distance driven, metres.
    pub fn driven_m(&self) -> f64 {
        self.driven_m
    }
}
