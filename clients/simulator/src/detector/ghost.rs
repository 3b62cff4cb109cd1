//! Ghosts: lines that are not there, beside lines that are, for a few frames.

use lanemap_core::Category;

use crate::{
    detector::{line_habits::LineErrors, model::DetectorModel},
    random::{SimRng, choose, happens, uniform},
    road::RoadLineId,
    view::LineView,
};

/// A line that is not there.
#[derive(Clone, Copy, Debug)]
pub struct Ghost {
    /// The true line beside which it lies.
    pub beside: RoadLineId,
    /// How far to the right of it, metres.
    pub offset_m: f64,
    /// What it is reported as.
    pub category: Category,
    /// Errors of its own.
    pub errors: LineErrors,
    /// How far it is reported, metres.
    pub reach_m: f64,
}

/// Moves on by one frame: some die (each with one over the mean life), those without their line go, one may be born.
pub fn renew(ghosts: &mut Vec<Ghost>, views: &[LineView], model: &DetectorModel, dt_s: f64, rng: &mut SimRng) {
    ghosts.retain(|ghost| views.iter().any(|view| view.line == ghost.beside));
    ghosts.retain(|_| !happens(rng, 1.0 / model.ghosts.life_frames));
    for ghost in ghosts.iter_mut() {
        ghost.errors.advance(model, dt_s, rng);
    }
    if !views.is_empty() && happens(rng, model.ghosts.births_per_frame) {
        let beside = &views[choose(rng, views.len())];
        let distance_m = uniform(rng, model.ghosts.min_offset_m, model.ghosts.max_offset_m);
        ghosts.push(Ghost {
            beside: beside.line,
            offset_m: if happens(rng, 0.5) { distance_m } else { -distance_m },
            category: beside.category,
            errors: LineErrors::draw(model, rng),
            reach_m: uniform(rng, 25.0, model.reach.range_m),
        });
    }
}
