//! How far each drive is believed, learned from the drives themselves.
//!
//! What a drive's own map says of its variance is true as long as its camera sits where it was declared and its detector is
//! as good as others'. A camera that is turned by some degrees bends every line it sees, by more than the drive knows. Once
//! drives lie on common lines, each can be compared with what all say together: with `r` the offsets of its witnesses from
//! their knots,
//!
//! `s_d = q80(|r|) / 1.28`, `f_d = max(1, s_d^2 / median(s)^2)`
//!
//! is the factor by which the variance of all it says is raised: a variance component per drive, by a quantile that a few
//! foreign lines do not move. Drives that are as good as most keep their weight. Lanes of one that
//! is [`DOUBTED`] are laid down after all others, so that no line begins and ends where it lost it.
//!
//! Not guaranteed: that most are right. Where most drives of a place are wrong in the same way, they are the yardstick.

use super::{
    line::Line,
    prepared::{count_of, normal_of},
};

/// Factor from which on a drive's lanes are laid down after those of all others.
pub(super) const DOUBTED: f64 = 2.0;
/// Witnesses at a knot below which none of them can be told to be wrong.
const LEAST_WITNESSES: usize = 3;
/// Offsets of a drive below which its scatter is not known.
const LEAST_OFFSETS: usize = 60;
/// Drives with a known scatter below which it is not known what is usual.
const LEAST_DRIVES: usize = 8;
/// The quantile that is looked at, and what it is of the absolute value of a normal variable, in standard deviations.
const QUANTILE: f64 = 0.8;
const QUANTILE_OF_NORMAL: f64 = 1.2816;

/// By what factor the variances of each drive are too small; 1 where that is not known.
pub(super) fn learned_doubts(lines: &[Line], drives: usize) -> Vec<f64> {
    let scatters = scatters_m(lines, drives);
    let mut known: Vec<f64> = scatters.iter().flatten().copied().collect();
    if known.len() < LEAST_DRIVES {
        return vec![1.0; drives];
    }
    known.sort_by(f64::total_cmp);
    let usual = known[known.len() / 2].max(f64::MIN_POSITIVE);
    let doubt = |scatter: Option<f64>| scatter.map_or(1.0, |scatter| (scatter / usual).powi(2).max(1.0));
    scatters.into_iter().map(doubt).collect()
}

/// How far what each drive says lies from where all say the line is, across, metres; its knots in any order.
pub(super) fn offsets_m(lines: &[Line], drives: usize) -> Vec<Vec<f64>> {
    let mut offsets: Vec<Vec<f64>> = vec![Vec::new(); drives];
    for line in lines {
        for (knot, at) in line.knots.iter().enumerate().filter(|(_, at)| at.witnesses.len() >= LEAST_WITNESSES) {
            let normal = normal_of(&line.tangent(knot));
            for witness in at.witnesses.iter().filter(|witness| witness.drive < drives) {
                offsets[witness.drive].push((witness.shared - line.points[knot]).xy().dot(&normal).abs());
            }
        }
    }
    offsets
}

/// Standard deviation of what each drive says across its lines, against what all say; `None` where too little is known.
fn scatters_m(lines: &[Line], drives: usize) -> Vec<Option<f64>> {
    let scatter = |mut offsets: Vec<f64>| {
        offsets.sort_by(f64::total_cmp);
        let at = count_of(offsets.len() as f64 * QUANTILE);
        (offsets.len() >= LEAST_OFFSETS).then(|| offsets[at] / QUANTILE_OF_NORMAL)
    };
    offsets_m(lines, drives).into_iter().map(scatter).collect()
}

#[cfg(test)]
mod tests {
    use nalgebra::Point3;

    use super::*;
    use crate::{
        fleet::{
            contribution::DriveId,
            line::{FusedLaneId, Knot, Witness},
        },
        frame::TimestampNs,
        lane_map::LaneId,
    };

    /// A straight line along x that each drive saw beside where it is by turns to the left and to the right, by so much, metres.
    fn line_seen_beside(offsets_m: &[f64], knots: usize) -> Line {
        let id = FusedLaneId { started: TimestampNs(0), drive: DriveId(1), lane: LaneId(1), piece: 0, stretch: 0 };
        let mut line = Line::new(id);
        for knot in 0..knots {
            let place = Point3::new(3.0 * knot as f64, 0.0, 0.0);
            let side = if knot % 2 == 0 { 1.0 } else { -1.0 };
            let witness = |(drive, offset_m): (usize, &f64)| Witness {
                drive,
                pass: drive,
                lane: 0,
                parameter: knot as f64,
                map: place,
                arc_m: place.x,
                shared: place + side * offset_m * nalgebra::Vector3::y(),
                lateral_variance_m2: 0.01,
                height_variance_m2: 0.01,
                share: 1.0,
            };
            let witnesses = offsets_m.iter().enumerate().map(witness).collect();
            line.push(place, Knot { witnesses, ..Knot::default() });
        }
        line
    }

    #[test]
    fn a_drive_with_twice_the_usual_scatter_is_believed_a_quarter() {
        let mut offsets_m = [0.1; 9];
        offsets_m[4] = 0.2;
        let doubts = learned_doubts(&[line_seen_beside(&offsets_m, 100)], 9);
        assert!((doubts[4] - 4.0).abs() < 1e-9, "{doubts:?}");
        assert!(doubts.iter().enumerate().all(|(drive, doubt)| drive == 4 || (doubt - 1.0).abs() < 1e-9), "{doubts:?}");
    }

    #[test]
    fn nobody_is_doubted_by_few_drives_or_on_a_short_line() {
        let few = learned_doubts(&[line_seen_beside(&[0.1, 0.1, 0.1, 0.4], 100)], 4);
        let mut offsets_m = [0.1; 9];
        offsets_m[4] = 0.4;
        let short = learned_doubts(&[line_seen_beside(&offsets_m, 20)], 9);
        assert!(few.into_iter().chain(short).all(|doubt| (doubt - 1.0).abs() < 1e-9));
    }
}
