//! How well changes of the road were noticed: precision and recall per stretch of 10 m, and how many drives it took.
//!
//! Both the true changes and the reported ones are told as paint that went and paint that came: a line that moved went from one
//! place and came to another. They are cut into pieces of [`PIECE_M`] metres. A true piece is recalled if one of a report of the
//! same sense, made since, overlaps it, at most 1.5 m across; a reported piece is right if it so overlaps a true one of
//! the same sense and before it. Paint that is of another category now is a sense of its own, told rightly if the new category is. A report that a line moved speaks for both: where it is now, and, within 3 m, where it was.
//! The latency of a change is the number of drives with it in view that began after it, up to and with the one by which its
//! first report came to be believed.
//!
//! Changes that drives could hardly tell are given as not asked: reports of them are right, but none is missed.

use nalgebra::{Point3, Vector2};

use super::quantile;
use crate::{
    category::Category,
    fleet::{ChangeKind, MapChange},
    frame::TimestampNs,
};

/// Length of a piece, metres.
pub const PIECE_M: f64 = 10.0;
/// Distance at which a report and a change are the same place, metres.
const NEAR_M: f64 = 1.5;
/// The same to where a line was before it moved, metres.
const MOVED_M: f64 = 3.0;

/// Something that truly happened to a stretch of line.
#[derive(Clone, Debug, PartialEq)]
pub struct TrueChange {
    /// When.
    pub time: TimestampNs,
    /// Where paint was that is gone, metres in the frame of the map; empty where nothing went.
    pub went: Vec<Point3<f64>>,
    /// Where paint is that was not there; empty where nothing came.
    pub came: Vec<Point3<f64>>,
    /// Where paint is of another category than it was, and which; empty where nothing is.
    pub repainted: (Vec<Point3<f64>>, Category),
    /// Starts of the drives that had it in view, before it and since.
    pub in_view: Vec<TimestampNs>,
    /// Whether it is missed where it is not reported.
    pub asked: bool,
}

/// How well changes were noticed.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ChangeScore {
    /// True pieces that are asked.
    pub true_pieces: usize,
    /// Share of them that were reported.
    pub recall: f64,
    /// Reported pieces.
    pub reported_pieces: usize,
    /// Share of them that are true.
    pub precision: f64,
    /// Reported pieces of paint that went and did not.
    pub false_removals: usize,
    /// Median number of drives after which a change that was noticed was noticed; NaN where none was.
    pub latency_drives_p50: f64,
}

/// Whether paint went or came, or what it became.
#[derive(Clone, Copy, PartialEq)]
enum Sense {
    Went,
    Came,
    Became(Category),
}

struct Piece {
    middle: Point3<f64>,
    /// Along it, of length 1.
    direction: Vector2<f64>,
    sense: Sense,
    time: TimestampNs,
    /// Distance at which it is the same place as another.
    reach_m: f64,
    of: usize,
}

/// Scores reports against what happened.
#[must_use]
pub fn score_changes(reported: &[MapChange], truth: &[TrueChange]) -> ChangeScore {
    let true_pieces: Vec<Piece> =
        truth.iter().enumerate().flat_map(|(of, change)| pieces_of_truth(of, change)).collect();
    let reports: Vec<Piece> =
        reported.iter().enumerate().flat_map(|(of, change)| pieces_of_report(of, change)).collect();
    let asked: Vec<&Piece> = true_pieces.iter().filter(|piece| truth[piece.of].asked).collect();
    let recalled = asked.iter().filter(|piece| reports.iter().any(|report| tells_of(report, piece)));
    // A move is one report of two senses; its old place is not told, and only the new one can be wrong.
    let told: Vec<&Piece> = reports.iter().filter(|report| report.reach_m <= NEAR_M).collect();
    let wrong: Vec<&&Piece> =
        told.iter().filter(|report| !true_pieces.iter().any(|piece| tells_of(report, piece))).collect();
    let mut latencies: Vec<f64> = truth
        .iter()
        .enumerate()
        .filter(|(_, change)| change.asked)
        .filter_map(|(of, change)| {
            let own = true_pieces.iter().filter(|piece| piece.of == of);
            let noticed = own.flat_map(|piece| reports.iter().filter(|report| tells_of(report, piece)));
            let first = noticed.map(|report| report.time).min()?;
            Some(change.in_view.iter().filter(|start| **start > change.time && **start <= first).count() as f64)
        })
        .collect();
    ChangeScore {
        true_pieces: asked.len(),
        recall: share(recalled.count(), asked.len()),
        reported_pieces: told.len(),
        precision: share(told.len() - wrong.len(), told.len()),
        false_removals: wrong.iter().filter(|report| report.sense == Sense::Went).count(),
        latency_drives_p50: if latencies.is_empty() { f64::NAN } else { quantile(&mut latencies, 0.5) },
    }
}

fn share(part: usize, of: usize) -> f64 {
    if of == 0 { 1.0 } else { part as f64 / of as f64 }
}

fn tells_of(report: &Piece, truth: &Piece) -> bool {
    let offset = (report.middle - truth.middle).xy();
    report.sense == truth.sense
        && report.time >= truth.time
        && offset.dot(&truth.direction).abs() < PIECE_M
        && offset.perp(&truth.direction).abs() <= report.reach_m
}

fn pieces_of_truth(of: usize, change: &TrueChange) -> Vec<Piece> {
    let piece =
        |sense| move |(middle, direction)| Piece { middle, direction, sense, time: change.time, reach_m: NEAR_M, of };
    let went = middles(&change.went).into_iter().map(piece(Sense::Went));
    let came = middles(&change.came).into_iter().map(piece(Sense::Came));
    let (repainted, category) = &change.repainted;
    went.chain(came).chain(middles(repainted).into_iter().map(piece(Sense::Became(*category)))).collect()
}

fn pieces_of_report(of: usize, change: &MapChange) -> Vec<Piece> {
    let senses = match change.kind {
        ChangeKind::Appeared => vec![(Sense::Came, NEAR_M)],
        ChangeKind::Vanished => vec![(Sense::Went, NEAR_M)],
        ChangeKind::Moved { .. } => vec![(Sense::Came, NEAR_M), (Sense::Went, MOVED_M)],
        ChangeKind::Repainted { to, .. } => vec![(Sense::Became(to), NEAR_M)],
    };
    let middles = middles(&change.points);
    let piece = |(sense, reach_m): &(Sense, f64)| {
        let (sense, reach_m) = (*sense, *reach_m);
        let piece = move |(middle, direction): &(Point3<f64>, Vector2<f64>)| Piece {
            middle: *middle,
            direction: *direction,
            sense,
            time: change.noticed,
            reach_m,
            of,
        };
        middles.iter().map(piece)
    };
    senses.iter().flat_map(piece).collect()
}

/// The middles of the pieces of a line and its direction there; at least one where it has a length.
fn middles(line: &[Point3<f64>]) -> Vec<(Point3<f64>, Vector2<f64>)> {
    let mut middles = Vec::new();
    let mut next_m = 0.5 * PIECE_M;
    let mut way_m = 0.0;
    let direction = |pair: &[Point3<f64>]| (pair[1] - pair[0]).xy().try_normalize(1e-9).unwrap_or_default();
    for pair in line.windows(2) {
        let length_m = nalgebra::distance(&pair[0], &pair[1]);
        while length_m > 0.0 && next_m <= way_m + length_m {
            middles.push((pair[0] + (pair[1] - pair[0]) * ((next_m - way_m) / length_m), direction(pair)));
            next_m += PIECE_M;
        }
        way_m += length_m;
    }
    if middles.is_empty() && line.len() > 1 {
        let half = line.len() / 2;
        middles.push((line[half], direction(&line[half - 1..=half])));
    }
    middles
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        fleet::{DriveId, FusedLaneId},
        lane_map::LaneId,
    };

    fn along(from_m: i32, to_m: i32, left_m: f64) -> Vec<Point3<f64>> {
        (from_m..=to_m).map(|x| Point3::new(f64::from(x), left_m, 0.0)).collect()
    }

    fn truth(went: Vec<Point3<f64>>, came: Vec<Point3<f64>>) -> TrueChange {
        let in_view = (0..6).map(|drive| TimestampNs(10 * drive)).collect();
        let repainted = (Vec::new(), Category::Unknown);
        TrueChange { time: TimestampNs(15), went, came, repainted, in_view, asked: true }
    }

    fn report(kind: ChangeKind, points: Vec<Point3<f64>>, noticed: i64) -> MapChange {
        let id = FusedLaneId { started: TimestampNs(0), drive: DriveId(0), lane: LaneId(1), piece: 0, stretch: 0 };
        let noticed = TimestampNs(noticed);
        MapChange { kind, lane: id, points, noticed, noticed_by: DriveId(0), probability: 0.9 }
    }

    #[test]
    fn half_of_a_change_that_is_noticed_two_drives_later_is_half_recalled_at_full_precision() {
        let truth = [truth(along(0, 100, 3.5), Vec::new())];
        let score = score_changes(&[report(ChangeKind::Vanished, along(0, 50, 3.4), 30)], &truth);
        assert_eq!((score.true_pieces, score.reported_pieces), (10, 5));
        assert!((score.recall - 0.5).abs() < 1e-9 && (score.precision - 1.0).abs() < 1e-9, "{score:?}");
        assert!((score.latency_drives_p50 - 2.0).abs() < 1e-9, "{score:?}");
    }

    #[test]
    fn what_did_not_happen_or_had_not_yet_is_wrong() {
        let truth = [truth(along(0, 100, 3.5), Vec::new())];
        let reports = [
            report(ChangeKind::Vanished, along(0, 100, 3.5), 10),
            report(ChangeKind::Vanished, along(300, 400, 3.5), 30),
            report(ChangeKind::Appeared, along(0, 100, 3.5), 30),
        ];
        let score = score_changes(&reports, &truth);
        assert!(score.recall < 1e-9 && score.precision < 1e-9, "{score:?}");
        assert_eq!((score.reported_pieces, score.false_removals), (30, 20));
    }

    #[test]
    fn a_move_tells_where_paint_came_and_where_it_went() {
        let truth = [truth(along(0, 100, 0.0), along(0, 100, 1.0))];
        let score = score_changes(&[report(ChangeKind::Moved { by_m: 1.0 }, along(0, 100, 1.0), 30)], &truth);
        assert!((score.recall - 1.0).abs() < 1e-9 && (score.precision - 1.0).abs() < 1e-9, "{score:?}");
        assert_eq!(score.reported_pieces, 10);
    }

    #[test]
    fn what_is_not_asked_is_not_missed_and_may_be_reported() {
        let hardly_seen = TrueChange { asked: false, ..truth(along(0, 100, 3.5), Vec::new()) };
        let score = score_changes(&[report(ChangeKind::Vanished, along(0, 50, 3.4), 30)], &[hardly_seen]);
        assert_eq!((score.true_pieces, score.reported_pieces), (0, 5));
        assert!((score.recall - 1.0).abs() < 1e-9 && (score.precision - 1.0).abs() < 1e-9, "{score:?}");
    }

    #[test]
    fn paint_that_became_another_is_told_rightly_by_the_new_category_alone() {
        let repainted = (along(0, 100, 0.0), Category::WhiteSolid);
        let truth = [TrueChange { repainted, ..truth(Vec::new(), Vec::new()) }];
        let told = |to| ChangeKind::Repainted { from: Category::WhiteDashed, to };
        let right = score_changes(&[report(told(Category::WhiteSolid), along(0, 100, 0.1), 30)], &truth);
        assert!((right.recall - 1.0).abs() < 1e-9 && (right.precision - 1.0).abs() < 1e-9, "{right:?}");
        let wrong = score_changes(&[report(told(Category::YellowDashed), along(0, 100, 0.1), 30)], &truth);
        assert!(wrong.recall < 1e-9 && wrong.precision < 1e-9, "{wrong:?}");
        assert_eq!(wrong.false_removals, 0);
    }

    #[test]
    fn a_report_in_the_next_lane_is_wrong() {
        let truth = [truth(along(0, 100, 3.5), Vec::new())];
        let score = score_changes(&[report(ChangeKind::Vanished, along(0, 100, 0.0), 30)], &truth);
        assert!(score.recall < 1e-9 && score.precision < 1e-9, "{score:?}");
    }
}
