#![expect(clippy::cast_possible_truncation, reason = "nanoseconds of a drive of seconds")]
//! Roads in closed form, and drives over them as contributions: lanes with smooth errors, a GNSS bias per drive, drift.

use lanemap_core::{
    Category, ControlPoint, EndRule, GnssFix, LaneId, MapLane, Sensor, TimestampNs,
    fleet::{Contribution, DriveId, PlacedBy, TrajectoryPoint},
    geometry::georeference::{Anchor, Wgs84},
};
use nalgebra::{Matrix3, Point3, Rotation2, Vector2};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

/// The anchor of all roads here.
pub fn anchor() -> Anchor {
    Anchor::new(Wgs84 { latitude_deg: 48.0, longitude_deg: 11.0, height_m: 500.0 })
}

/// A road along a circle of a large radius, with lines at fixed distances from its axis.
pub struct Road {
    pub length_m: f64,
    pub radius_m: f64,
    /// Distance to the left of the axis, metres, and what is painted there.
    pub lines: Vec<(f64, Category)>,
}

impl Road {
    pub fn bend(length_m: f64) -> Self {
        let lines = vec![
            (5.4, Category::LeftCurb),
            (1.8, Category::YellowSolid),
            (-1.7, Category::WhiteDashed),
            (-5.2, Category::WhiteSolid),
        ];
        Self { length_m, radius_m: 250.0, lines }
    }

    /// Place so far along the axis and to the left of it.
    pub fn place(&self, station_m: f64, left_m: f64) -> Vector2<f64> {
        let angle = station_m / self.radius_m;
        let radius_m = self.radius_m - left_m;
        Vector2::new(radius_m * angle.sin(), self.radius_m - radius_m * angle.cos())
    }

    /// Station and distance to the left of a place.
    pub fn locate(&self, place: Vector2<f64>) -> (f64, f64) {
        let from_centre = Vector2::new(place.x, self.radius_m - place.y);
        let angle = from_centre.x.atan2(from_centre.y);
        (angle * self.radius_m, self.radius_m - from_centre.norm())
    }

    /// Distance of a place from the nearest line.
    pub fn nearest_line_m(&self, _station_m: f64, left_m: f64) -> f64 {
        self.lines.iter().map(|(line_m, _)| (left_m - line_m).abs()).fold(f64::INFINITY, f64::min)
    }
}

/// What a drive over a road says of a stretch of it.
pub fn stretch(drive: &Contribution, from_m: f64, to_m: f64) -> Contribution {
    let is_on_it = |arc_m: f64| arc_m >= from_m && arc_m <= to_m;
    let trajectory = drive.trajectory.iter().filter(|point| is_on_it(point.arc_m)).cloned();
    let trajectory: Vec<TrajectoryPoint> = trajectory.collect();
    let lanes = drive.lanes.iter().map(|lane| {
        // Control points lie 3 m apart, the first at 12 m.
        let points = lane.control_points.iter().enumerate();
        let points = points.filter(|(index, _)| is_on_it(12.0 + 3.0 * *index as f64)).map(|(_, point)| *point);
        let control_points: Vec<ControlPoint> = points.collect();
        MapLane {
            drawn_to: (control_points.len() - 1) as f64,
            control_points,
            first_seen: trajectory[0].time,
            last_seen: trajectory[trajectory.len() - 1].time,
            ..lane.clone()
        }
    });
    Contribution { lanes: lanes.collect(), trajectory: trajectory.clone(), ..drive.clone() }
}

/// The same drive with a receiver that is off by so much more, east and north.
pub fn with_bias(mut drive: Contribution, bias_m: Vector2<f64>) -> Contribution {
    for fix in drive.trajectory.iter_mut().filter_map(|point| point.fix.as_mut()) {
        let place = Wgs84 { latitude_deg: fix.latitude_deg, longitude_deg: fix.longitude_deg, height_m: fix.height_m };
        let moved = anchor().enu_from_wgs84(&place) + nalgebra::Vector3::new(bias_m.x, bias_m.y, 0.0);
        let moved = anchor().wgs84_from_enu(&moved);
        (fix.latitude_deg, fix.longitude_deg) = (moved.latitude_deg, moved.longitude_deg);
    }
    drive
}

/// How drives are made.
pub struct Survey<'a> {
    pub road: &'a Road,
    pub seed: u64,
    /// Of each drive's GNSS, on each axis.
    pub bias_sigma_m: f64,
    /// Of a lane's smooth error across.
    pub lane_sigma_m: f64,
    /// Of the heading of a drive's own frame against odometry, per drive.
    pub heading_sigma_rad: f64,
}

impl<'a> Survey<'a> {
    pub fn of(road: &'a Road, seed: u64) -> Self {
        Self { road, seed, bias_sigma_m: 1.5, lane_sigma_m: 0.1, heading_sigma_rad: 0.003 }
    }

    pub fn drives(&self, count: usize) -> Vec<Contribution> {
        (0..count).map(|number| self.drive(number)).collect()
    }

    fn drive(&self, number: usize) -> Contribution {
        let mut rng = ChaCha8Rng::seed_from_u64(self.seed * 1000 + number as u64);
        let mut gauss = move |sigma: f64| -> f64 {
            let drawn: f64 = StandardNormal.sample(&mut rng);
            sigma * drawn
        };
        let started = TimestampNs(1_700_000_000_000_000_000 + i64::try_from(number).unwrap_or(0) * 86_400_000_000_000);
        // The drive's own frame: the road turned and moved, which the drive does not know.
        let turn = Rotation2::new(gauss(1.0));
        let origin = Vector2::new(gauss(50.0), gauss(50.0));
        let bend = gauss(self.heading_sigma_rad) / 100.0;
        let to_own = |place: Vector2<f64>, station_m: f64| {
            // Heading drifts along the way: a bend across it.
            let drift =
                self.road.place(station_m, 0.5 * bend * station_m * station_m) - self.road.place(station_m, 0.0);
            turn * (place + drift - origin)
        };
        let bias = Vector2::new(gauss(self.bias_sigma_m), gauss(self.bias_sigma_m));
        let left_m = -0.1 + gauss(0.2);
        let time = |station_m: f64| TimestampNs(started.0 + (station_m * 1e8) as i64);
        let trajectory =
            (0..).map(|step| 4.0 * f64::from(step)).take_while(|station_m| *station_m <= self.road.length_m);
        let trajectory = trajectory.map(|station_m| {
            let place = self.road.place(station_m, left_m);
            let own = to_own(place, station_m);
            let heading = station_m / self.road.radius_m + turn.angle();
            let fix = anchor().wgs84_from_enu(&Point3::new(place.x + bias.x, place.y + bias.y, 0.0));
            TrajectoryPoint {
                time: time(station_m),
                arc_m: station_m,
                position: Point3::new(own.x, own.y, 0.0),
                yaw_rad: heading,
                motion_variance_m2: 1e-4,
                turn_variance_rad2: 1e-7,
                fix: Some(GnssFix {
                    latitude_deg: fix.latitude_deg,
                    longitude_deg: fix.longitude_deg,
                    height_m: fix.height_m,
                    horizontal_sigma_m: 1.5,
                    vertical_sigma_m: 2.0,
                    yaw_enu_rad: None,
                }),
                hidden: Vec::new(),
            }
        });
        let trajectory: Vec<TrajectoryPoint> = trajectory.collect();
        let lanes = self.road.lines.iter().enumerate().map(|(index, (line_m, category))| {
            let phases = [gauss(1.0), gauss(1.0), gauss(1.0)];
            let amplitude = self.lane_sigma_m;
            let error = |station_m: f64| {
                amplitude * (0.7 * phases[0] + 0.7 * phases[1] * (station_m / 20.0 + phases[2] * 3.0).sin())
            };
            let points =
                (4..).map(|step| 3.0 * f64::from(step)).take_while(|station_m| *station_m <= self.road.length_m);
            let points = points.map(|station_m| {
                let own = to_own(self.road.place(station_m, line_m + error(station_m)), station_m);
                ControlPoint {
                    position: Point3::new(own.x, own.y, 0.0),
                    covariance: Matrix3::from_diagonal_element(amplitude * amplitude),
                }
            });
            let control_points: Vec<ControlPoint> = points.collect();
            let mut category_posterior = vec![0.02 / 14.0; 15];
            category_posterior[category.index()] = 0.98;
            MapLane {
                id: LaneId(index as u64 + 1),
                category: *category,
                category_posterior,
                category_stretches: vec![],
                ends: EndRule::Reflected,
                drawn_from: 0.0,
                drawn_to: (control_points.len() - 1) as f64,
                control_points,
                existence: 0.99,
                observations: 100,
                first_seen: time(0.0),
                last_seen: time(self.road.length_m),
            }
        });
        let lanes = lanes.collect();
        Contribution {
            drive: DriveId(number as u64 + 1),
            started,
            sensor: Sensor::default(),
            placed_by: PlacedBy::Receiver,
            trajectory,
            lanes,
        }
    }
}
