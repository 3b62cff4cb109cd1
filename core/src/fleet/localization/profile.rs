//! The heading profile of a line: its heading as a function of the way along it. Whatever pose the line has, its profile
//! is the same but for a constant.

use std::f64::consts::{PI, TAU};

use nalgebra::{Point3, Vector2};

/// Way between two stations, metres.
pub(super) const STATION_M: f64 = 5.0;

/// A line at stations [`STATION_M`] apart; at least 3.
#[derive(Clone, Debug)]
pub(super) struct Profile {
    pub(super) places: Vec<Point3<f64>>,
    /// Heading at each station, radians, without jumps by a turn.
    pub(super) headings: Vec<f64>,
}

impl Profile {
    /// The profile of a polyline; `None` of one that is too short to have any.
    pub(super) fn of(points: &[Point3<f64>]) -> Option<Self> {
        let places = stations(points);
        if places.len() < 3 {
            return None;
        }
        let last = places.len() - 1;
        let mut headings: Vec<f64> = Vec::with_capacity(places.len());
        for index in 0..=last {
            let chord: Vector2<f64> = (places[(index + 1).min(last)] - places[index.saturating_sub(1)]).xy();
            let heading = chord.y.atan2(chord.x);
            headings.push(headings.last().map_or(heading, |before| before + half_turn(heading - before)));
        }
        Some(Self { places, headings })
    }

    /// The same line the other way.
    pub(super) fn reversed(&self) -> Self {
        Self {
            places: self.places.iter().rev().copied().collect(),
            headings: self.headings.iter().rev().map(|heading| heading + PI).collect(),
        }
    }
}

/// An angle in `(-pi, pi]`.
pub(super) fn half_turn(angle_rad: f64) -> f64 {
    let turned = angle_rad.rem_euclid(TAU);
    if turned > PI { turned - TAU } else { turned }
}

/// Points every [`STATION_M`] along a polyline, from its start.
fn stations(points: &[Point3<f64>]) -> Vec<Point3<f64>> {
    let mut places: Vec<Point3<f64>> = points.first().copied().into_iter().collect();
    let mut missing_m = STATION_M;
    for pair in points.windows(2) {
        let length_m = nalgebra::distance(&pair[0], &pair[1]);
        let mut from_m = 0.0;
        while length_m - from_m >= missing_m {
            from_m += missing_m;
            places.push(pair[0] + (pair[1] - pair[0]) * (from_m / length_m));
            missing_m = STATION_M;
        }
        missing_m -= length_m - from_m;
    }
    places
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_profile_knows_the_turn_of_a_bend_and_not_its_pose() {
        let bend = |turn: f64, shift: f64| -> Vec<Point3<f64>> {
            let point =
                |angle: f64| Point3::new(shift + 200.0 * (angle + turn).sin(), -200.0 * (angle + turn).cos(), 1.0);
            (0..60).map(|step| point(f64::from(step) * 3.0 / 200.0)).collect()
        };
        let (a, b) = (Profile::of(&bend(0.0, 0.0)).unwrap(), Profile::of(&bend(2.9, 70.0)).unwrap());
        assert_eq!(a.places.len(), 36);
        let turned = |profile: &Profile| profile.headings[30] - profile.headings[5];
        assert!((turned(&a) - 125.0 / 200.0).abs() < 1e-3 && (turned(&a) - turned(&b)).abs() < 1e-6);
        let back = b.reversed();
        assert!((back.headings[30] - back.headings[5] + 125.0 / 200.0).abs() < 1e-3);
    }
}
