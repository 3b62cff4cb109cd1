//! A lane detector with the habits of a real one (`PersFormer` on `OpenLane`), frame by frame.
//!
//! A line in sight is reported at fixed rows of the ground frame (x right, y front, z up, below the camera), from the
//! row before its visible part to the row after it. Row `r` of line `l` in frame `t` comes out at
//!
//! `x = x_true(r) + d_l e_l(r, t) + r tan(yaw_t) + w`, `z = z_true(r) + d_l h_l(r, t) + r tan(pitch_t) + w`
//!
//! with range polynomials `e`, `h`, a difficulty `d` per line, yaw and pitch errors that all lines of a frame share, and
//! white noise `w`. Lines are missed and misnamed in bursts, reach is limited, ghosts live beside true lines.
//! Not simulated: occlusion by vehicles, errors tied to appearance, hallucinations inside junctions.

mod ghost;
mod line_habits;
pub mod model;
mod rows;

use std::collections::BTreeMap;

use lanemap_core::{Category, Detection, Sensor};
use nalgebra::Point3;

use crate::{
    detector::{ghost::Ghost, line_habits::LineHabits, rows::Row},
    noise::PartlyConstant,
    random::{SimRng, normal},
    road::RoadLineId,
    view::LineView,
};

pub use model::DetectorModel;

/// A detector in the middle of a drive.
#[derive(Debug)]
pub struct Detector {
    model: DetectorModel,
    sensor: Sensor,
    rng: SimRng,
    pitch: PartlyConstant,
    yaw: PartlyConstant,
    lines: BTreeMap<RoadLineId, LineHabits>,
    ghosts: Vec<Ghost>,
}

/// Errors of a frame that all its lines share, as tangents.
#[derive(Clone, Copy, Debug)]
struct FrameTilt {
    pitch: f64,
    yaw: f64,
}

impl Detector {
    /// A detector at the start of a drive.
    #[must_use]
    pub fn new(model: DetectorModel, sensor: Sensor, mut rng: SimRng) -> Self {
        let pitch = PartlyConstant::stationary(model.constant_share, &mut rng);
        let yaw = PartlyConstant::stationary(model.constant_share, &mut rng);
        Self { model, sensor, rng, pitch, yaw, lines: BTreeMap::new(), ghosts: Vec::new() }
    }

    /// What it reports of the lines in sight, `dt_s` seconds after its last frame. Points in the vehicle frame.
    pub fn observe(&mut self, views: &[LineView], dt_s: f64) -> Vec<Detection> {
        let tilt = self.advance_tilt(dt_s);
        let mut detections = Vec::new();
        for view in views {
            let habits =
                self.lines.entry(view.line).or_insert_with(|| LineHabits::draw(&self.model, view, &mut self.rng));
            let missed = habits.advance(&self.model, view, dt_s, &mut self.rng);
            if missed {
                continue;
            }
            let rows = rows::rows_of(view, self.sensor.ground_offset(), habits.reach_m(&self.model));
            let (category, errors) = (habits.reported_category(view.category), habits.errors());
            let displaced = rows.iter().map(|row| row.displaced(errors.at(row.range_m, &self.model))).collect();
            detections.extend(self.report(category, displaced, tilt));
        }
        detections.extend(self.observe_ghosts(views, dt_s, tilt));
        detections
    }

    fn advance_tilt(&mut self, dt_s: f64) -> FrameTilt {
        let (tau_s, share) = (self.model.correlation_s, self.model.constant_share);
        self.pitch.advance(dt_s, tau_s, share, &mut self.rng);
        self.yaw.advance(dt_s, tau_s, share, &mut self.rng);
        FrameTilt {
            pitch: (self.pitch.value() * self.model.pitch_sigma_rad).tan(),
            yaw: (self.yaw.value() * self.model.yaw_sigma_rad).tan(),
        }
    }

    fn observe_ghosts(&mut self, views: &[LineView], dt_s: f64, tilt: FrameTilt) -> Vec<Detection> {
        ghost::renew(&mut self.ghosts, views, &self.model, dt_s, &mut self.rng);
        let ghosts = std::mem::take(&mut self.ghosts);
        let ground_offset = self.sensor.ground_offset();
        let mut detections = Vec::new();
        for ghost in &ghosts {
            let Some(view) = views.iter().find(|view| view.line == ghost.beside) else { continue };
            let rows = rows::rows_of(view, ground_offset, ghost.reach_m);
            let error_m = |row: &Row| {
                let [right_m, up_m] = ghost.errors.at(row.range_m, &self.model);
                [right_m + ghost.offset_m, up_m]
            };
            let displaced = rows.iter().map(|row| row.displaced(error_m(row))).collect();
            detections.extend(self.report(ghost.category, displaced, tilt));
        }
        self.ghosts = ghosts;
        detections
    }

    /// A detection at rows that already bear the line's own errors; `None` of fewer than two rows.
    fn report(&mut self, category: Category, rows: Vec<Row>, tilt: FrameTilt) -> Option<Detection> {
        if rows.len() < 2 {
            return None;
        }
        let offset = self.sensor.ground_offset();
        let points_vehicle = rows
            .into_iter()
            .map(|row| {
                let white_m = [0; 2].map(|_| self.model.white_sigma_m * normal(&mut self.rng));
                let tilted_m = [row.range_m * tilt.yaw + white_m[0], row.range_m * tilt.pitch + white_m[1]];
                let row = row.displaced(tilted_m);
                Point3::new(row.range_m, -row.right_m, row.up_m) + offset
            })
            .collect();
        Some(Detection { category, points_vehicle })
    }
}

#[cfg(test)]
mod tests;
