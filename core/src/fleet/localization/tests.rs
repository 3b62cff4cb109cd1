use nalgebra::{Matrix3, Point3, Rotation2, Vector2};
use proptest::prelude::*;

use super::*;
use crate::{
    category::Category,
    fleet::contribution::{DriveId, TrajectoryPoint},
    frame::TimestampNs,
    lane_map::{ControlPoint, EndRule, LaneId, MapLane},
    sensor::Sensor,
};

/// A road by its curvature: pieces of so many metres, each with a curvature, 1/m.
#[derive(Clone, Debug)]
struct Road {
    pieces: Vec<(f64, f64)>,
    /// How far to the left of its axis its lines are, metres, and what they are.
    lines: Vec<(f64, Category)>,
}

impl Road {
    fn new(pieces: &[(f64, f64)]) -> Self {
        let lines = vec![
            (7.0, Category::WhiteSolid),
            (3.5, Category::WhiteDashed),
            (0.0, Category::DoubleYellowSolid),
            (-3.5, Category::WhiteDashed),
            (-7.0, Category::WhiteSolid),
        ];
        Self { pieces: pieces.to_vec(), lines }
    }

    /// Two bends of different radius, one to each side.
    fn winding() -> Self {
        Self::new(&[(130.0, 0.0), (80.0, 1.0 / 90.0), (90.0, 0.0), (110.0, -1.0 / 150.0), (150.0, 0.0)])
    }

    fn length_m(&self) -> f64 {
        self.pieces.iter().map(|(length_m, _)| length_m).sum()
    }

    /// Place and heading so far along it.
    fn at(&self, station_m: f64) -> (Vector2<f64>, f64) {
        const STEP_M: f64 = 0.25;
        let (mut place, mut heading, mut done_m) = (Vector2::zeros(), 0.0_f64, 0.0);
        for (length_m, curvature) in &self.pieces {
            let mut left_m = length_m.min(station_m - done_m);
            while left_m > 1e-9 {
                let step_m = left_m.min(STEP_M);
                let middle = heading + 0.5 * step_m * curvature;
                place += Vector2::new(middle.cos(), middle.sin()) * step_m;
                heading += step_m * curvature;
                left_m -= step_m;
            }
            done_m += length_m;
            if done_m >= station_m {
                break;
            }
        }
        (place, heading)
    }

    fn beside(&self, station_m: f64, left_m: f64) -> Vector2<f64> {
        let (place, heading) = self.at(station_m);
        place + Vector2::new(-heading.sin(), heading.cos()) * left_m
    }

    fn stations(&self) -> impl Iterator<Item = f64> {
        let length_m = self.length_m();
        (0..).map(|step| 3.0 * f64::from(step)).take_while(move |station_m| *station_m <= length_m)
    }

    /// Its lines, as the map has them, shifted.
    fn on_the_map(&self, shift: Vector2<f64>) -> Vec<AtlasLine> {
        let line = |(left_m, category): &(f64, Category)| AtlasLine {
            points: self
                .stations()
                .map(|station_m| self.beside(station_m, *left_m) + shift)
                .map(|place| Point3::new(place.x, place.y, 0.0))
                .collect(),
            category_posterior: posterior(*category),
        };
        self.lines.iter().map(line).collect()
    }
}

fn posterior(category: Category) -> Vec<f64> {
    let mut posterior = vec![0.1 / 14.0; 15];
    posterior[category.index()] = 0.9;
    posterior
}

fn cell() -> CellId {
    CellId::new(8_718, 5_685).unwrap()
}

fn atlas(lines: Vec<AtlasLine>) -> LineAtlas {
    let mut atlas = LineAtlas::default();
    atlas.put(cell(), lines);
    atlas
}

/// How a drive sees a road.
#[derive(Clone, Copy, Debug)]
struct Seen {
    /// Pose of the drive's frame.
    turn_rad: f64,
    origin: Vector2<f64>,
    /// Odometry's error of scale, and of heading, radians per metre.
    scale: f64,
    bend: f64,
    /// Waves of its lanes across, metres.
    wave_m: f64,
}

const EXACT: Seen = Seen { turn_rad: 0.0, origin: Vector2::new(0.0, 0.0), scale: 0.0, bend: 0.0, wave_m: 0.0 };

/// A drive along all of a road, in the lane to the right of the middle.
fn drive(road: &Road, seen: Seen) -> Contribution {
    let own = |place: Vector2<f64>, station_m: f64| {
        let (_, heading) = road.at(station_m);
        let drift = Vector2::new(-heading.sin(), heading.cos()) * (0.5 * seen.bend * station_m * station_m);
        let own = Rotation2::new(seen.turn_rad) * ((place + drift) * (1.0 + seen.scale) - seen.origin);
        Point3::new(own.x, own.y, 0.0)
    };
    #[expect(clippy::cast_possible_truncation, reason = "nanoseconds of half a minute")]
    let time = |station_m: f64| TimestampNs((station_m * 1e8) as i64);
    let way = road.stations().enumerate().map(|(index, station_m)| TrajectoryPoint {
        time: time(station_m),
        arc_m: 3.0 * index as f64,
        position: own(road.beside(station_m, -1.75), station_m),
        yaw_rad: road.at(station_m).1 + seen.turn_rad,
        motion_variance_m2: 1e-4,
        turn_variance_rad2: 1e-7,
        fix: None,
        hidden: vec![],
    });
    let lane = |(number, (left_m, category)): (usize, &(f64, Category))| {
        let wave = |station_m: f64| seen.wave_m * (station_m / 17.0 + 2.1 * number as f64).sin();
        let points = road.stations().map(|station_m| ControlPoint {
            position: own(road.beside(station_m, left_m + wave(station_m)), station_m),
            covariance: Matrix3::identity() * 0.01,
        });
        let control_points: Vec<ControlPoint> = points.collect();
        MapLane {
            id: LaneId(number as u64 + 1),
            category: *category,
            category_posterior: posterior(*category),
            category_stretches: vec![],
            drawn_from: 0.0,
            drawn_to: (control_points.len() - 1) as f64,
            control_points,
            ends: EndRule::Reflected,
            existence: 0.95,
            observations: 100,
            first_seen: time(0.0),
            last_seen: time(road.length_m()),
        }
    };
    Contribution {
        drive: DriveId(7),
        started: TimestampNs(0),
        sensor: Sensor::default(),
        placed_by: PlacedBy::Receiver,
        trajectory: way.collect(),
        lanes: road.lines.iter().enumerate().map(lane).collect(),
    }
}

fn found(contribution: &Contribution, lines: Vec<AtlasLine>) -> Localization {
    localize(contribution, &atlas(lines), &FleetParams::default())
}

/// Greatest distance of the fixes that the map gave from where the vehicle was.
fn worst_error_m(road: &Road, place: &MapPlace) -> f64 {
    let errors = place.contribution.trajectory.iter().map(|point| {
        let fix = point.fix.unwrap();
        let fix = crate::geometry::georeference::Wgs84 {
            latitude_deg: fix.latitude_deg,
            longitude_deg: fix.longitude_deg,
            height_m: fix.height_m,
        };
        let station_m = point.arc_m;
        (cell().anchor().enu_from_wgs84(&fix).coords.xy() - road.beside(station_m, -1.75)).norm()
    });
    errors.fold(0.0, f64::max)
}

#[test]
fn a_straight_road_is_refused_for_it_is_the_same_all_along() {
    let road = Road::new(&[(600.0, 0.0)]);
    let outcome = found(&drive(&road, EXACT), road.on_the_map(Vector2::zeros()));
    assert_eq!(outcome, Localization::NotUnique(Ambiguity::Straight));
}

#[test]
fn a_long_bend_of_one_radius_is_refused_for_it_is_the_same_all_along() {
    let (road, long) = (Road::new(&[(550.0, 0.004)]), Road::new(&[(1_300.0, 0.004)]));
    let outcome = found(&drive(&road, EXACT), long.on_the_map(Vector2::zeros()));
    assert!(matches!(outcome, Localization::NotUnique(_)), "{outcome:?}");
}

#[test]
fn parallel_streets_of_equal_shape_are_refused_and_one_of_them_alone_is_found() {
    let road = Road::winding();
    let one = road.on_the_map(Vector2::zeros());
    let both = [one.clone(), road.on_the_map(Vector2::new(20.0, 120.0))].concat();
    let sought = drive(&road, EXACT);
    assert!(matches!(found(&sought, one), Localization::Aligned(_)));
    assert_eq!(found(&sought, both), Localization::NotUnique(Ambiguity::Elsewhere));
}

#[test]
fn a_drive_that_sees_equal_lines_only_may_be_a_lane_over_and_is_refused() {
    let mut wide = Road::winding();
    wide.lines = (0..7).map(|number| (10.5 - 3.5 * f64::from(number), Category::WhiteDashed)).collect();
    let mut narrow = wide.clone();
    narrow.lines = wide.lines[2..5].to_vec();
    let outcome = found(&drive(&narrow, EXACT), wide.on_the_map(Vector2::zeros()));
    assert!(matches!(outcome, Localization::NotUnique(_)), "{outcome:?}");
}

#[test]
fn a_road_that_the_map_does_not_have_is_found_nowhere() {
    let other = Road::new(&[(100.0, 0.0), (120.0, -1.0 / 70.0), (40.0, 0.0), (90.0, 1.0 / 110.0), (210.0, 0.0)]);
    let outcome = found(&drive(&other, EXACT), Road::winding().on_the_map(Vector2::zeros()));
    assert_eq!(outcome, Localization::NoFit);
}

#[test]
fn a_way_too_short_is_not_sought_and_a_map_without_lines_has_no_place() {
    let short = Road::new(&[(60.0, 0.0), (90.0, 0.01)]);
    let lines = short.on_the_map(Vector2::zeros());
    assert_eq!(found(&drive(&short, EXACT), lines), Localization::TooShort);
    assert_eq!(found(&drive(&Road::winding(), EXACT), vec![]), Localization::NoFit);
}

#[test]
fn what_is_placed_keeps_its_shape_and_says_nothing_of_where_the_map_lies() {
    let road = Road::winding();
    let Localization::Aligned(place) = found(&drive(&road, EXACT), road.on_the_map(Vector2::zeros())) else {
        panic!("it is the only one")
    };
    assert_eq!(place.contribution.placed_by, PlacedBy::Map);
    assert_eq!(place.contribution.lanes.len(), road.lines.len());
    assert!(place.contribution.trajectory.iter().all(|point| point.fix.is_some()));
    assert!(place.way_m > 400.0 && place.margin > LEAST_MARGIN && place.sigma_m() < 0.6, "{place:?}");
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    #[test]
    fn a_bend_is_found_to_decimetres_from_any_frame_and_with_the_drift_of_odometry(
        turn_rad in -3.1..3.1f64, east in -500.0..500.0f64, north in -500.0..500.0f64,
        scale in -0.01..0.01f64, bend in -2e-5..2e-5f64, wave_m in 0.0..0.1f64,
    ) {
        let road = Road::winding();
        let seen = Seen { turn_rad, origin: Vector2::new(east, north), scale, bend, wave_m };
        let sought = drive(&road, seen);
        let outcome = found(&sought, road.on_the_map(Vector2::zeros()));
        let Localization::Aligned(place) = &outcome else { panic!("{outcome:?}") };
        let error_m = worst_error_m(&road, place);
        // Along the straight ends only odometry tells.
        prop_assert!(error_m < 0.7 + 120.0 * scale.abs(), "{} m", error_m);
        prop_assert_eq!(found(&sought, road.on_the_map(Vector2::zeros())), outcome);
    }
}
