//! Stretches: a line cut where what is known of it changes along it.
//!
//! From one control point to the next a line is known as the lesser known of both. A stretch grows until one value leaves
//! the others of the stretch by more than an eye would tell apart ([`Range::holds_together`]), and is at least [`LEAST`]
//! segments long, so that values that flicker around a limit make no confetti.

use std::ops::Range as Indices;

use lanemap_proto::v1;

use crate::projected::{mean, rounded_to_thousandths};

/// Least number of segments of a stretch: about 12 m.
const LEAST: usize = 4;

/// A stretch of a line.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Stretch {
    /// First and last control point.
    pub(crate) from: usize,
    pub(crate) to: usize,
    pub(crate) drives: u32,
    pub(crate) existence: f64,
    pub(crate) lateral_sigma_m: f64,
    pub(crate) height_sigma_m: f64,
    pub(crate) confirmed_s: i64,
}

/// Least and greatest value within a stretch.
#[derive(Clone, Copy, Debug)]
struct Range<T> {
    least: T,
    most: T,
}

impl<T: PartialOrd + Copy> Range<T> {
    fn of(value: T) -> Self {
        Self { least: value, most: value }
    }

    fn with(self, value: T) -> Self {
        Self {
            least: if value < self.least { value } else { self.least },
            most: if value > self.most { value } else { self.most },
        }
    }
}

/// What a stretch holds.
#[derive(Clone, Copy, Debug)]
struct Ranges {
    sigma_mm: Range<u32>,
    existence_permille: Range<u32>,
    drives: Range<u32>,
    confirmed_after_s: Range<i64>,
}

impl Ranges {
    fn of(lane: &v1::FusedLane, segment: usize) -> Self {
        let worst = |values: &[u32]| values.iter().skip(segment).take(2).copied().max().unwrap_or_default();
        let least = |values: &[u32]| values.iter().skip(segment).take(2).copied().min().unwrap_or_default();
        Self {
            sigma_mm: Range::of(worst(&lane.lateral_sigma_mm)),
            existence_permille: Range::of(least(&lane.existence_permille)),
            drives: Range::of(least(&lane.drives_at)),
            confirmed_after_s: Range::of(
                lane.confirmed_after_s.iter().skip(segment).take(2).copied().min().unwrap_or_default(),
            ),
        }
    }

    fn with(self, next: Self) -> Self {
        Self {
            sigma_mm: self.sigma_mm.with(next.sigma_mm.least),
            existence_permille: self.existence_permille.with(next.existence_permille.least),
            drives: self.drives.with(next.drives.least),
            confirmed_after_s: self.confirmed_after_s.with(next.confirmed_after_s.least),
        }
    }

    /// Whether all of it may be drawn alike: sigma to a factor of 1.5 or 2 cm, existence to a tenth, drives to one or a
    /// factor of 1.5, freshness to a minute.
    fn holds_together(&self) -> bool {
        let close =
            |range: Range<u32>, apart: u32| 2 * range.most <= 3 * range.least || range.most - range.least <= apart;
        close(self.sigma_mm, 20)
            && self.existence_permille.most - self.existence_permille.least <= 100
            && (self.drives.least > 1 || self.drives.most == self.drives.least)
            && close(self.drives, 1)
            && self.confirmed_after_s.most - self.confirmed_after_s.least <= 60
    }
}

/// Cuts a line of so many control points into stretches.
pub(crate) fn stretches(lane: &v1::FusedLane, points: usize) -> Vec<Stretch> {
    let segments = points - 1;
    let mut found = Vec::new();
    let (mut from, mut ranges) = (0, Ranges::of(lane, 0));
    for segment in 1..segments {
        let with = ranges.with(Ranges::of(lane, segment));
        if segment - from >= LEAST && segments - segment >= LEAST && !with.holds_together() {
            found.push(stretch(lane, from..segment));
            (from, ranges) = (segment, Ranges::of(lane, segment));
        } else {
            ranges = with;
        }
    }
    found.push(stretch(lane, from..segments));
    found
}

fn stretch(lane: &v1::FusedLane, segments: Indices<usize>) -> Stretch {
    let (from, to) = (segments.start, segments.end);
    let of = |values: &[u32]| mean(values.get(from..=to).unwrap_or_default());
    let confirmed_after_s = lane.confirmed_after_s.get(from..=to).unwrap_or_default().iter().min();
    Stretch {
        from,
        to,
        drives: lane.drives_at.get(from..=to).unwrap_or_default().iter().min().copied().unwrap_or_default(),
        existence: rounded_to_thousandths(of(&lane.existence_permille) / 1e3),
        lateral_sigma_m: rounded_to_thousandths(of(&lane.lateral_sigma_mm) / 1e3),
        height_sigma_m: rounded_to_thousandths(of(&lane.height_sigma_mm) / 1e3),
        confirmed_s: lane
            .first_seen_unix_ns
            .div_euclid(1_000_000_000)
            .saturating_add(confirmed_after_s.copied().unwrap_or_default()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A line of which only the standard deviation changes.
    fn line(lateral_sigma_mm: &[u32]) -> v1::FusedLane {
        let points = lateral_sigma_mm.len();
        v1::FusedLane {
            lateral_sigma_mm: lateral_sigma_mm.to_vec(),
            height_sigma_mm: vec![80; points],
            existence_permille: vec![950; points],
            drives_at: vec![2; points],
            confirmed_after_s: vec![10; points],
            first_seen_unix_ns: 5_000_000_000,
            ..v1::FusedLane::default()
        }
    }

    #[test]
    fn a_line_is_cut_where_its_uncertainty_grows() {
        let sigmas = [[50; 10], [200; 10]].concat();
        let found = stretches(&line(&sigmas), 20);
        assert_eq!(found.iter().map(|stretch| (stretch.from, stretch.to)).collect::<Vec<_>>(), [(0, 9), (9, 19)]);
        assert!(found[0].lateral_sigma_m <= 0.05 && found[1].lateral_sigma_m > 0.18);
        assert_eq!((found[0].existence, found[0].drives, found[0].confirmed_s), (0.95, 2, 15));
    }

    #[test]
    fn values_that_flicker_cut_no_stretch_shorter_than_four_segments() {
        let sigmas: Vec<u32> = (0..30).map(|index| if index % 2 == 0 { 50 } else { 300 }).collect();
        let found = stretches(&line(&sigmas), 30);
        assert!(found.iter().all(|stretch| stretch.to - stretch.from >= LEAST), "{found:?}");
        assert!(found.windows(2).all(|pair| pair[0].to == pair[1].from));
    }

    #[test]
    fn a_line_of_two_points_is_one_stretch() {
        assert_eq!(stretches(&line(&[50, 400]), 2).len(), 1);
    }
}
