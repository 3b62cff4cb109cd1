//! What the detector makes of one line over a drive: its errors, its misses, its mistakes of category.

use lanemap_core::Category;

use crate::{
    detector::model::DetectorModel,
    noise::{Bursts, RangePolynomial},
    random::{SimRng, choose, normal},
    view::LineView,
};

/// Errors of a line, lateral and vertical.
#[derive(Clone, Copy, Debug)]
pub struct LineErrors {
    difficulty: f64,
    lateral: RangePolynomial,
    vertical: RangePolynomial,
}

impl LineErrors {
    /// Errors of a line of random difficulty, `exp(N(0, spread))`, cut at a factor of 2.2 either way.
    pub fn draw(model: &DetectorModel, rng: &mut SimRng) -> Self {
        let difficulty = (model.difficulty_spread * normal(rng)).exp().clamp(1.0 / 2.2, 2.2);
        Self {
            difficulty,
            lateral: RangePolynomial::stationary(model.constant_share, rng),
            vertical: RangePolynomial::stationary(model.constant_share, rng),
        }
    }

    /// Moves on by `dt_s` seconds.
    pub fn advance(&mut self, model: &DetectorModel, dt_s: f64, rng: &mut SimRng) {
        self.lateral.advance(dt_s, model.correlation_s, model.constant_share, rng);
        self.vertical.advance(dt_s, model.correlation_s, model.constant_share, rng);
    }

    /// Errors at a range: metres to the right and up.
    pub fn at(&self, range_m: f64, model: &DetectorModel) -> [f64; 2] {
        [
            self.difficulty * self.lateral.at_m(range_m, &model.lateral),
            self.difficulty * self.vertical.at_m(range_m, &model.vertical),
        ]
    }
}

/// The detector's habits with one line.
#[derive(Clone, Copy, Debug)]
pub struct LineHabits {
    errors: LineErrors,
    reach_noise: f64,
    missed: Bursts,
    misnamed: Bursts,
    taken_for: Option<Category>,
}

impl LineHabits {
    /// Habits with a line that comes into sight.
    pub fn draw(model: &DetectorModel, view: &LineView, rng: &mut SimRng) -> Self {
        Self {
            errors: LineErrors::draw(model, rng),
            reach_noise: 0.0,
            missed: Bursts::stationary(model.misses.share_at(view.side_m()), rng),
            misnamed: Bursts::stationary(model.flip_share, rng),
            taken_for: None,
        }
    }

    /// Moves on by one frame and says whether the line is missed in it.
    pub fn advance(&mut self, model: &DetectorModel, view: &LineView, dt_s: f64, rng: &mut SimRng) -> bool {
        self.errors.advance(model, dt_s, rng);
        self.reach_noise = normal(rng);
        self.taken_for = if self.misnamed.advance(model.flip_share, model.flip_burst_frames, rng) {
            self.taken_for.or_else(|| Some(mistaken(view.category, rng)))
        } else {
            None
        };
        self.missed.advance(model.misses.share_at(view.side_m()), model.misses.burst_frames, rng)
    }

    /// The category reported for a line of this true category.
    pub fn reported_category(&self, category: Category) -> Category {
        self.taken_for.unwrap_or(category)
    }

    /// The errors now.
    pub fn errors(&self) -> LineErrors {
        self.errors
    }

    /// How far the line is reported, metres.
    pub fn reach_m(&self, model: &DetectorModel) -> f64 {
        let reach = &model.reach;
        reach.range_m - reach.per_difficulty_m * (self.errors.difficulty - 1.0) + reach.sigma_m * self.reach_noise
    }
}

/// A category that a detector might take another for: dashed for solid, single for double, curb for edge line.
pub fn mistaken(category: Category, rng: &mut SimRng) -> Category {
    use Category as C;
    let likely: &[C] = match category {
        C::WhiteSolid => &[C::WhiteDashed, C::RightCurb, C::YellowSolid],
        C::YellowDashed => &[C::YellowSolid, C::WhiteDashed],
        C::YellowSolid => &[C::DoubleYellowSolid, C::YellowDashed, C::WhiteSolid],
        C::DoubleYellowSolid => &[C::YellowSolid, C::YellowLeftDashedRightSolid],
        _ => &[C::WhiteSolid],
    };
    likely[choose(rng, likely.len())]
}
