//! What of a drive's contribution a cell is fused from.

use std::collections::BTreeMap;

use super::{CellId, TILES, TilePlace, tiles_of, whole};
use crate::{
    fleet::contribution::{Contribution, TrajectoryPoint},
    geometry::georeference::Georeference,
    lane_map::{LaneId, MapLane},
};

/// How far beyond its border a cell knows the lines, metres.
pub const MARGIN_M: f64 = 150.0;
/// Numbers of lanes are below 2 to the power of this: above them stands which stretch of the lane it is.
const LANE_BITS: u32 = 48;

/// Cuts a contribution into one per cell that the drive touches, in the order of the cells.
///
/// `georeference` is where the drive's own GNSS puts its map frame, good to the margin. Of the way and of each lane, every
/// stretch within the cell and [`MARGIN_M`] around it is kept, cut at points and control points. A lane keeps its number;
/// where it leaves and comes back, the second stretch has 2^48 added to it, the third twice that, and so on.
/// Cells in which the drive only comes within the margin are left out.
#[must_use]
pub fn cut(contribution: &Contribution, georeference: &Georeference) -> Vec<(CellId, Contribution)> {
    let cells_at = |points: &mut dyn Iterator<Item = nalgebra::Point3<f64>>| -> Vec<Vec<Nearby>> {
        points.map(|point| nearby(georeference, &point)).collect()
    };
    let along_way = cells_at(&mut contribution.trajectory.iter().map(|point| point.position));
    let along_lanes = contribution
        .lanes
        .iter()
        .map(|lane| cells_at(&mut lane.control_points.iter().map(|point| point.position)))
        .collect::<Vec<_>>();

    let shell = without_geometry(contribution);
    let mut cells: BTreeMap<CellId, Contribution> = BTreeMap::new();
    let within = along_way.iter().chain(along_lanes.iter().flatten()).flatten().filter(|nearby| nearby.within);
    for nearby in within {
        cells.entry(nearby.cell).or_insert_with(|| shell.clone());
    }
    for (cell, part) in &mut cells {
        part.trajectory = way_within(&contribution.trajectory, &along_way, *cell);
        for (lane, along) in contribution.lanes.iter().zip(&along_lanes) {
            part.lanes.extend(stretches_within(lane, along, *cell));
        }
    }
    cells.into_iter().filter(|(_, part)| !part.trajectory.is_empty()).collect()
}

/// A cell to which a point matters.
#[derive(Clone, Copy)]
struct Nearby {
    cell: CellId,
    /// The point lies in the cell, and not only within its margin.
    within: bool,
}

/// The contribution without what is cut.
fn without_geometry(contribution: &Contribution) -> Contribution {
    Contribution {
        drive: contribution.drive,
        started: contribution.started,
        sensor: contribution.sensor,
        placed_by: contribution.placed_by,
        trajectory: Vec::new(),
        lanes: Vec::new(),
    }
}

/// The cells within whose margin a point of the map frame lies; at most four.
fn nearby(georeference: &Georeference, point: &nalgebra::Point3<f64>) -> Vec<Nearby> {
    let place = georeference.to_wgs84(point);
    let (Some(at), Some(own)) = (TilePlace::of(&place), CellId::containing(&place)) else { return Vec::new() };
    let margin = tiles_of(MARGIN_M, place.latitude_deg).min(0.5);
    let across = [at.x - margin, at.x, at.x + margin].map(|x| whole(x.rem_euclid(f64::from(TILES))) % TILES);
    let down = [at.y - margin, at.y, at.y + margin].map(|y| whole(y).min(TILES - 1));
    let mut cells: Vec<CellId> =
        across.into_iter().flat_map(|x| down.into_iter().filter_map(move |y| CellId::new(x, y))).collect();
    cells.sort_unstable();
    cells.dedup();
    cells.into_iter().map(|cell| Nearby { cell, within: cell == own }).collect()
}

fn is_near(nearby: &[Nearby], cell: CellId) -> bool {
    nearby.iter().any(|nearby| nearby.cell == cell)
}

/// The points of the way near a cell; what odometry claims for the way between them is kept.
fn way_within(trajectory: &[TrajectoryPoint], along: &[Vec<Nearby>], cell: CellId) -> Vec<TrajectoryPoint> {
    let mut way = Vec::new();
    let (mut motion_m2, mut turn_rad2) = (0.0, 0.0);
    for (point, nearby) in trajectory.iter().zip(along) {
        motion_m2 += point.motion_variance_m2;
        turn_rad2 += point.turn_variance_rad2;
        if is_near(nearby, cell) {
            way.push(TrajectoryPoint {
                motion_variance_m2: std::mem::take(&mut motion_m2),
                turn_variance_rad2: std::mem::take(&mut turn_rad2),
                ..point.clone()
            });
        }
    }
    way
}

fn stretches_within(lane: &MapLane, along: &[Vec<Nearby>], cell: CellId) -> Vec<MapLane> {
    let mut stretches = Vec::new();
    let mut first = 0;
    for run in along.chunk_by(|a, b| is_near(a, cell) == is_near(b, cell)) {
        let points = first..first + run.len();
        first = points.end;
        if !is_near(&run[0], cell) || points.len() < 2 {
            continue;
        }
        let last = (points.len() - 1) as f64;
        let drawn_from = (lane.drawn_from - points.start as f64).clamp(0.0, last);
        let drawn_to = (lane.drawn_to - points.start as f64).clamp(0.0, last);
        if drawn_from < drawn_to {
            stretches.push(MapLane {
                id: LaneId(lane.id.0 + ((stretches.len() as u64) << LANE_BITS)),
                category_posterior: lane.category_posterior.clone(),
                category_stretches: lane.category_stretches_between(points.start as f64, (points.end - 1) as f64),
                control_points: lane.control_points[points].to_vec(),
                drawn_from,
                drawn_to,
                category: lane.category,
                ends: lane.ends,
                existence: lane.existence,
                observations: lane.observations,
                first_seen: lane.first_seen,
                last_seen: lane.last_seen,
            });
        }
    }
    stretches
}

#[cfg(test)]
mod tests {
    use nalgebra::{Matrix3, Point3};

    use super::*;
    use crate::{
        category::Category,
        fleet::contribution::{DriveId, PlacedBy},
        frame::TimestampNs,
        geometry::Pose,
        lane_map::{ControlPoint, EndRule},
        sensor::Sensor,
    };

    /// A drive to the east along `way` (metres from the middle of a cell), with a line 2 m to its left.
    fn drive(way: impl Iterator<Item = f64>) -> (Contribution, Georeference, CellId) {
        let cell = CellId::new(8_718, 5_685).unwrap();
        let way: Vec<f64> = way.collect();
        let point = |(index, x): (usize, &f64)| TrajectoryPoint {
            time: TimestampNs(i64::try_from(index).unwrap()),
            arc_m: 3.0 * index as f64,
            position: Point3::new(*x, 0.0, 0.0),
            yaw_rad: 0.0,
            motion_variance_m2: 1.0,
            turn_variance_rad2: 2.0,
            fix: None,
            hidden: vec![],
        };
        let control_points =
            way.iter().map(|x| ControlPoint { position: Point3::new(*x, 2.0, 0.0), covariance: Matrix3::identity() });
        let lane = MapLane {
            id: LaneId(7),
            category: Category::WhiteSolid,
            category_posterior: vec![],
            category_stretches: vec![],
            control_points: control_points.collect(),
            ends: EndRule::Reflected,
            drawn_from: 0.5,
            drawn_to: way.len() as f64 - 1.5,
            existence: 1.0,
            observations: 5,
            first_seen: TimestampNs(0),
            last_seen: TimestampNs(9),
        };
        let contribution = Contribution {
            drive: DriveId(1),
            started: TimestampNs(0),
            sensor: Sensor::default(),
            placed_by: PlacedBy::Receiver,
            trajectory: way.iter().enumerate().map(point).collect(),
            lanes: vec![lane],
        };
        (contribution, Georeference { anchor: cell.anchor(), enu_from_map: Pose::identity() }, cell)
    }

    fn metres(from: i32, to: i32) -> Vec<f64> {
        let step = if from < to { 1 } else { -1 };
        (0..=(to - from).abs() / 3).map(|i| f64::from(from + 3 * i * step)).collect()
    }

    #[test]
    fn a_drive_over_a_border_gives_both_cells_the_same_lines_around_it() {
        // At 48 degrees a cell is 1 635 m wide.
        let (contribution, georeference, cell) = drive(metres(-300, 1_500).into_iter());
        let cells = cut(&contribution, &georeference);
        let east = CellId::new(cell.x() + 1, cell.y()).unwrap();
        assert_eq!(cells.iter().map(|(cell, _)| *cell).collect::<Vec<_>>(), [cell, east]);
        let [(_, here), (_, there)] = cells.as_slice() else { panic!("two cells") };
        let (border_m, reach) = (here.trajectory.last().unwrap().position.x - MARGIN_M, MARGIN_M - 4.0);
        assert!((border_m - 817.0).abs() < 8.0, "{border_m}");
        assert!(there.trajectory[0].position.x < border_m - reach);
        assert!(here.trajectory.last().unwrap().position.x > border_m + reach);
        assert_eq!((here.lanes[0].id, there.lanes[0].id), (LaneId(7), LaneId(7)));
        assert!((here.lanes[0].drawn_from - 0.5).abs() < 1e-12 && there.lanes[0].drawn_from == 0.0);
        let length = there.lanes[0].control_points.len() as f64;
        assert!((there.lanes[0].drawn_to - (length - 1.5)).abs() < 1e-9);
    }

    #[test]
    fn a_drive_that_only_comes_near_a_cell_says_nothing_of_it() {
        let (contribution, georeference, cell) = drive(metres(-300, 750).into_iter());
        let cells = cut(&contribution, &georeference);
        assert_eq!(cells.iter().map(|(cell, _)| *cell).collect::<Vec<_>>(), [cell]);
        assert_eq!(cells[0].1, contribution);
    }

    #[test]
    fn a_lane_that_leaves_and_comes_back_is_two_with_names_of_their_own() {
        let way = metres(0, 1_500).into_iter().chain(metres(1_497, 0));
        let (contribution, georeference, cell) = drive(way);
        let cells = cut(&contribution, &georeference);
        let (_, here) = cells.iter().find(|(found, _)| *found == cell).unwrap();
        assert_eq!(here.lanes.iter().map(|lane| lane.id.0).collect::<Vec<_>>(), [7, 7 + (1 << 48)]);
        // Nothing of what odometry claims is lost on the way outside.
        let last_m2: f64 = here.trajectory.iter().map(|point| point.motion_variance_m2).sum();
        assert!((last_m2 - contribution.trajectory.len() as f64).abs() < 1e-9);
    }
}
