//! Where a line begins and ends: estimated from what each frame saw and could have seen, not accumulated.
//!
//! Ours. A detector reports a line from the row before its visible part to the row after it, so one frame overshoots the
//! paint by up to a row spacing, and a union of frames keeps every overshoot. Each stretch of a quarter chord counts
//! votes: `seen` where the line certainly runs (between the second outermost reported points), a share that falls
//! linearly from 1 to 0 from there to the outermost point, and `absent` beyond it where the detector, which did see the line in
//! this frame, could have seen it. With rows at random phase the expected share crosses 1/2 exactly at the true end.
//! The line is drawn from the first to the last stretch with more than half of its votes.
//! Not guaranteed: gaps inside a line; a line is one stretch.

use std::collections::VecDeque;

use nalgebra::Point3;
use serde::{Deserialize, Serialize};

/// Stretches per control point.
const PER_KNOT: f64 = 4.0;

/// Votes on the stretches of one lane.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Extent {
    first: i64,
    stretches: VecDeque<Stretch>,
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
struct Stretch {
    seen: f32,
    absent: f32,
    /// Sum of the inverse variances with which it was seen, 1/m^2.
    information: f32,
}

impl Stretch {
    fn is_drawn(self, share: f64) -> bool {
        f64::from(self.seen) > share * f64::from(self.seen + self.absent)
    }
}

/// What one frame says of a lane's extent, in spline parameters counted by knot (may be negative).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sighting {
    /// Outermost reported places.
    pub reported: (f64, f64),
    /// Where the line certainly runs, within `reported`.
    pub certain: (f64, f64),
}

impl Sighting {
    /// Share of this frame's vote that a place is on the line, in `[0, 1]`.
    fn share(&self, parameter: f64) -> f64 {
        let ramp = |certain: f64, reported: f64| {
            let zone = (reported - certain).abs();
            let beyond = (parameter - certain) * (reported - certain).signum();
            if zone < 1e-6 { f64::from(beyond <= 0.0) } else { (1.0 - beyond / zone).clamp(0.0, 1.0) }
        };
        if parameter < self.certain.0 {
            ramp(self.certain.0, self.reported.0)
        } else if parameter > self.certain.1 {
            ramp(self.certain.1, self.reported.1)
        } else {
            1.0
        }
    }
}

#[allow(clippy::cast_possible_truncation)] // knots of a lane, far below 2^53
fn stretch_of(parameter: f64) -> i64 {
    (parameter * PER_KNOT).floor() as i64
}

fn middle_of(stretch: i64) -> f64 {
    (stretch as f64 + 0.5) / PER_KNOT
}

impl Extent {
    /// Counts one frame's votes on the stretches between two parameters, at which the line lies where `point_at` says.
    ///
    /// `visibility` says how surely the detector would have reported the line at a place if it ran there, in `[0, 1]`.
    ///
    /// `variance` is that of the detection there, m^2.
    pub fn vote(
        &mut self,
        sighting: &Sighting,
        (from, to): (f64, f64),
        mut point_at: impl FnMut(f64) -> Point3<f64>,
        visibility: impl Fn(&Point3<f64>) -> f64,
        variance: impl Fn(&Point3<f64>) -> f64,
    ) {
        for stretch in stretch_of(from)..=stretch_of(to) {
            let parameter = middle_of(stretch);
            let share = sighting.share(parameter);
            let point = point_at(parameter);
            let absent = if share < 1.0 { (1.0 - share) * visibility(&point) } else { 0.0 };
            if share == 0.0 && absent == 0.0 {
                continue;
            }
            let votes = self.at_mut(stretch);
            #[allow(clippy::cast_possible_truncation)] // votes need no more than seven digits
            {
                votes.seen += share as f32;
                votes.absent += absent as f32;
                if share > 0.0 {
                    votes.information += (share / variance(&point)) as f32;
                }
            }
        }
    }

    /// Counts so many frames that reported nothing against what they had in view between two parameters.
    pub fn vote_absent(&mut self, frames: u32, from: f64, to: f64, visibility: impl Fn(f64) -> f64) {
        for stretch in stretch_of(from)..=stretch_of(to) {
            let absent = f64::from(frames) * visibility(middle_of(stretch));
            if absent > 0.0 {
                #[allow(clippy::cast_possible_truncation)] // votes need no more than seven digits
                let absent = absent as f32;
                self.at_mut(stretch).absent += absent;
            }
        }
    }

    fn at_mut(&mut self, stretch: i64) -> &mut Stretch {
        if self.stretches.is_empty() {
            self.first = stretch;
        }
        while stretch < self.first {
            self.stretches.push_front(Stretch::default());
            self.first -= 1;
        }
        #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)] // not before the first
        let index = (stretch - self.first) as usize;
        if index >= self.stretches.len() {
            self.stretches.resize(index + 1, Stretch::default());
        }
        &mut self.stretches[index]
    }

    /// Adds the votes of another lane, whose parameter `p` lies at `to_mine(p)` of this one.
    pub fn absorb(&mut self, other: &Self, to_mine: impl Fn(f64) -> f64) {
        for (stretch, votes) in (other.first..).zip(&other.stretches) {
            let mine = self.at_mut(stretch_of(to_mine(middle_of(stretch))));
            mine.seen += votes.seen;
            mine.absent += votes.absent;
            mine.information += votes.information;
        }
    }

    /// Variance of the line's place as far as the frames that saw it were independent, m^2; infinite where none did.
    #[must_use]
    pub fn variance_at(&self, parameter: f64) -> f64 {
        let index = usize::try_from(stretch_of(parameter) - self.first).ok();
        let information = index.and_then(|index| self.stretches.get(index)).map_or(0.0, |stretch| stretch.information);
        1.0 / f64::from(information)
    }

    /// First and last parameter of the line, by knot: the outermost stretches that more than `share` of their votes saw.
    #[must_use]
    pub fn drawn(&self, share: f64) -> Option<(f64, f64)> {
        let first = self.stretches.iter().position(|stretch| stretch.is_drawn(share))?;
        let last = self.stretches.iter().rposition(|stretch| stretch.is_drawn(share))?;
        let border = |index: usize| (self.first as f64 + index as f64) / PER_KNOT;
        Some((border(first), border(last + 1)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn along(parameter: f64) -> Point3<f64> {
        Point3::new(3.0 * parameter, 0.0, 0.0)
    }

    proptest! {
        /// Rows of a detector sweep over a line that ends at parameter 10.3; both overshoot it by up to a row.
        #[test]
        fn the_end_is_found_to_a_stretch_though_every_frame_overshoots(phase in 0.0..1.0f64, spacing in 1.0..3.4f64) {
            let mut extent = Extent::default();
            let end = 10.3;
            for frame in 0..200 {
                let shift = phase + f64::from(frame) * 0.37;
                let rows_to_end = ((end - shift) / spacing).floor() * spacing + shift;
                let sighting = Sighting { reported: (0.0, rows_to_end + spacing), certain: (0.0, rows_to_end) };
                extent.vote(&sighting, (0.0, 20.0), along, |_| 1.0, |_| 1.0);
            }
            let (_, to) = extent.drawn(0.5).unwrap();
            prop_assert!((to - end).abs() < 0.4, "{to}");
        }
    }

    #[test]
    fn what_cannot_be_seen_is_not_voted_away() {
        let mut extent = Extent::default();
        let whole = Sighting { reported: (0.0, 12.0), certain: (0.0, 12.0) };
        extent.vote(&whole, (0.0, 12.0), along, |_| 1.0, |_| 1.0);
        for _ in 0..20 {
            let near = Sighting { reported: (0.0, 5.0), certain: (0.0, 5.0) };
            extent.vote(&near, (0.0, 12.0), along, |_| 0.0, |_| 1.0);
        }
        assert_eq!(extent.drawn(0.5), Some((0.0, 12.0)));
    }
}
