//! Where a drive may lie: every place of the map along which a line bends as one of the drive's does, ranked by how many
//! of the drive's windows agree on it.
//!
//! A window of a drive's lane is slid along every line, both ways. At each station the mean difference of the headings is
//! the turn from the drive's frame to the map's, and what is left of the differences tells whether the shapes agree:
//!
//! `r^2 = mean_i (h_line(o + i) - h_lane(i))^2 - mean_i (h_line(o + i) - h_lane(i))^2`, the second mean squared.
//!
//! With the centroids of the two stretches that is a pose. Each pose says where the middle of the drive is: windows vote for
//! each other's poses where they put it to the same place, but for what odometry drifts in between.

use std::collections::{BTreeMap, HashMap};

use nalgebra::{Point3, Rotation2, Vector2};
use rustc_hash::FxBuildHasher;

use super::{
    atlas::LineAtlas,
    profile::{Profile, half_turn},
};
use crate::fleet::{
    cell::CellId,
    prepared::{PreparedLane, count_of},
};

/// Stations of a window: 100 m.
const STATIONS: usize = 21;
/// Standard deviation of the headings within a window that make it a shape, radians: about that of a bend of 1 km radius.
const LEAST_BEND_RAD: f64 = 0.028;
/// Standard deviation of what is left of the differences up to which two shapes agree, radians.
const TOLERANCE_RAD: f64 = 0.03;
/// Most windows of a drive.
const MOST_WINDOWS: usize = 16;
/// Way between the middles of two windows, metres.
const WINDOWS_APART_M: f64 = 35.0;
/// Stations to each side in which a better one stands for one that agrees.
const BESIDE: usize = 3;
/// Most places that are ranked.
const MOST_PLACES: usize = 20_000;
/// Side of the squares by which places are found again, metres.
const SQUARE_M: f64 = 16.0;
/// Distance within which two windows put the middle of the drive to one place, metres.
const SAME_M: f64 = 4.0;
/// What it grows by with the way between the two.
const SAME_PER_M: f64 = 0.02;
/// Turn within which they do, radians.
const SAME_RAD: f64 = 0.06;
/// Distance between two places that are tried each for itself, metres.
const APART_M: f64 = 2.0;

/// A stretch of a drive's lane that bends.
#[derive(Clone, Debug)]
pub(super) struct Window {
    /// From where on the way its middle was seen, metres.
    pub(super) arc_m: f64,
    /// Centre of its stations, map frame of the drive.
    centre: Point3<f64>,
    /// Headings of its stations, radians.
    headings: Vec<f64>,
    /// Standard deviation of the headings, radians.
    bend_rad: f64,
}

/// A place at which a drive may lie.
#[derive(Clone, Copy, Debug)]
pub(super) struct Hypothesis {
    /// The cell in whose frame it is.
    pub(super) cell: CellId,
    /// Turn from the drive's frame to that of the cell, radians.
    pub(super) yaw_rad: f64,
    /// A point of the drive's frame.
    pub(super) map: Point3<f64>,
    /// The same in the cell's.
    pub(super) enu: Point3<f64>,
    /// From where on the way it was found.
    pub(super) arc_m: f64,
    /// How many windows agree on it, those that agree well counting more.
    pub(super) votes: f64,
    window: usize,
    /// In `(0, 1]`: how well the shapes agree.
    quality: f64,
}

impl Hypothesis {
    /// A pose that a caller has in mind.
    pub(super) fn at(cell: CellId, yaw_rad: f64, map: Point3<f64>, enu: Point3<f64>, arc_m: f64) -> Self {
        Self { cell, yaw_rad, map, enu, arc_m, votes: 0.0, window: 0, quality: 1.0 }
    }

    /// A point of the drive's frame in that of the cell.
    pub(super) fn apply(&self, point: &Point3<f64>) -> Point3<f64> {
        let turned = Rotation2::new(self.yaw_rad) * (point - self.map).xy();
        Point3::new(self.enu.x + turned.x, self.enu.y + turned.y, self.enu.z + point.z - self.map.z)
    }
}

/// Windows of a drive's lanes that bend, the strongest first.
pub(super) fn windows<'a>(lanes: impl Iterator<Item = &'a PreparedLane<'a>>) -> Vec<Window> {
    let mut all: Vec<Window> = lanes.flat_map(windows_of).collect();
    all.sort_by(|a, b| b.bend_rad.total_cmp(&a.bend_rad).then(a.arc_m.total_cmp(&b.arc_m)));
    let mut chosen: Vec<Window> = Vec::new();
    for window in all {
        if chosen.len() == MOST_WINDOWS {
            break;
        }
        if chosen.iter().all(|other| (other.arc_m - window.arc_m).abs() >= WINDOWS_APART_M) {
            chosen.push(window);
        }
    }
    chosen
}

fn windows_of(lane: &PreparedLane<'_>) -> Vec<Window> {
    let points: Vec<Point3<f64>> = lane.samples.iter().map(|sample| sample.map).collect();
    let Some(profile) = Profile::of(&points) else { return Vec::new() };
    let per_station = (points.len() - 1) as f64 / (profile.places.len() - 1) as f64;
    // The end stations know their heading from one side only.
    let firsts = (1..profile.places.len().saturating_sub(STATIONS)).step_by(2);
    let window = |first: usize| {
        let headings = profile.headings[first..first + STATIONS].to_vec();
        let middle = count_of((first + STATIONS / 2) as f64 * per_station).min(points.len() - 1);
        Window {
            arc_m: lane.samples[middle].arc_m,
            centre: centre(&profile.places[first..first + STATIONS]),
            bend_rad: spread(headings.iter().copied()).1,
            headings,
        }
    };
    firsts.map(window).filter(|window| window.bend_rad >= LEAST_BEND_RAD).collect()
}

fn centre(places: &[Point3<f64>]) -> Point3<f64> {
    let sum: nalgebra::Vector3<f64> = places.iter().map(|place| place.coords).sum();
    Point3::from(sum / places.len() as f64)
}

/// Mean and standard deviation.
fn spread(values: impl ExactSizeIterator<Item = f64> + Clone) -> (f64, f64) {
    let count = values.len() as f64;
    let mean = values.clone().sum::<f64>() / count;
    let square = values.map(|value| (value - mean) * (value - mean)).sum::<f64>() / count;
    (mean, square.sqrt())
}

/// Places of the map at which a drive whose middle is `middle` (map frame of the drive) may lie, the likeliest first; at most
/// `most`. The windows are those of [`windows`].
pub(super) fn hypotheses(
    windows: &[Window],
    middle: (f64, Point3<f64>),
    atlas: &LineAtlas,
    most: usize,
) -> Vec<Hypothesis> {
    let mut found: Vec<Hypothesis> = Vec::new();
    for (cell, profile) in atlas.profiles() {
        for (number, window) in windows.iter().enumerate() {
            slide(window, number, cell, profile, &mut found);
        }
    }
    found.sort_by(|a, b| b.quality.total_cmp(&a.quality));
    found.truncate(MOST_PLACES);
    let seats: Vec<Seat> = found.iter().filter_map(|hypothesis| Seat::of(hypothesis, &middle.1)).collect();
    if seats.len() < found.len() {
        // Somewhere beyond the last row of cells.
        return Vec::new();
    }
    let mut squares: HashMap<(CellId, i32, i32), Vec<usize>, FxBuildHasher> = HashMap::default();
    for (index, seat) in seats.iter().enumerate() {
        squares.entry((seat.cell, square(seat.place.x), square(seat.place.y))).or_default().push(index);
    }
    let near = |seat: &Seat| {
        let (x, y, cell) = (square(seat.place.x), square(seat.place.y), seat.cell);
        let around = (-1..=1).flat_map(move |dx| (-1..=1).map(move |dy| (cell, x + dx, y + dy)));
        around.filter_map(|key| squares.get(&key)).flatten().copied().collect::<Vec<usize>>()
    };
    let votes: Vec<f64> = (0..seats.len())
        .map(|index| {
            let mut by_window: BTreeMap<usize, f64> = BTreeMap::new();
            for other in near(&seats[index]) {
                if agree(&found[index], &seats[index], &found[other], &seats[other]) {
                    let vote = by_window.entry(found[other].window).or_default();
                    *vote = vote.max(found[other].quality);
                }
            }
            by_window.values().sum()
        })
        .collect();
    let mut order: Vec<usize> = (0..found.len()).collect();
    order.sort_by(|a, b| votes[*b].total_cmp(&votes[*a]).then(a.cmp(b)));
    let mut chosen: Vec<usize> = Vec::new();
    for index in order {
        if chosen.len() == most {
            break;
        }
        let is_same = |other: &usize| {
            seats[*other].cell == seats[index].cell
                && (seats[*other].place - seats[index].place).norm() < APART_M
                && half_turn(seats[*other].yaw_rad - seats[index].yaw_rad).abs() < SAME_RAD
        };
        if !chosen.iter().any(is_same) {
            chosen.push(index);
        }
    }
    chosen.into_iter().map(|index| Hypothesis { votes: votes[index], ..found[index] }).collect()
}

/// Where a hypothesis puts the middle of the drive, in the frame of the cell in which that is.
struct Seat {
    cell: CellId,
    place: Vector2<f64>,
    yaw_rad: f64,
}

impl Seat {
    fn of(hypothesis: &Hypothesis, middle: &Point3<f64>) -> Option<Self> {
        let at = hypothesis.apply(middle);
        let place = hypothesis.cell.anchor().wgs84_from_enu(&at);
        let cell = CellId::containing(&place)?;
        let place = if cell == hypothesis.cell { at } else { cell.anchor().enu_from_wgs84(&place) };
        Some(Self { cell, place: place.coords.xy(), yaw_rad: hypothesis.yaw_rad })
    }
}

#[expect(clippy::cast_possible_truncation, reason = "a place within a cell, or the cast saturates")]
fn square(metres: f64) -> i32 {
    (metres / SQUARE_M).floor() as i32
}

/// Whether two windows put the middle of the drive to one place.
fn agree(a: &Hypothesis, a_seat: &Seat, b: &Hypothesis, b_seat: &Seat) -> bool {
    let reach_m = SAME_M + SAME_PER_M * (a.arc_m - b.arc_m).abs();
    (a_seat.place - b_seat.place).norm() <= reach_m.min(SQUARE_M)
        && half_turn(a_seat.yaw_rad - b_seat.yaw_rad).abs() <= SAME_RAD
}

/// Slides a window along a line.
fn slide(window: &Window, number: usize, cell: CellId, profile: &Profile, found: &mut Vec<Hypothesis>) {
    let Some(last) = profile.headings.len().checked_sub(STATIONS) else { return };
    let fits: Vec<(f64, f64)> = (0..=last)
        .map(|first| {
            let along = &profile.headings[first..first + STATIONS];
            let (mut sum, mut square) = (0.0, 0.0);
            for (line, lane) in along.iter().zip(&window.headings) {
                let difference = line - lane;
                sum += difference;
                square += difference * difference;
            }
            let (mean, count) = (sum / STATIONS as f64, STATIONS as f64);
            (mean, (square / count - mean * mean).max(0.0).sqrt())
        })
        .collect();
    for (first, (yaw_rad, rest_rad)) in fits.iter().enumerate() {
        let beside = &fits[first.saturating_sub(BESIDE)..(first + BESIDE + 1).min(fits.len())];
        if *rest_rad > TOLERANCE_RAD || beside.iter().any(|(_, other)| other < rest_rad) {
            continue;
        }
        found.push(Hypothesis {
            cell,
            yaw_rad: half_turn(*yaw_rad),
            map: window.centre,
            enu: centre(&profile.places[first..first + STATIONS]),
            arc_m: window.arc_m,
            votes: 0.0,
            window: number,
            quality: (-0.5 * (rest_rad / (0.5 * TOLERANCE_RAD)).powi(2)).exp().max(0.05),
        });
    }
}
