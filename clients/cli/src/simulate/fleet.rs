//! Fleets of `lanemap simulate`: which world, which traffic, what changes, what is wrong.

use std::{ops::Range, str::FromStr};

use anyhow::bail;
use clap::Args;
use lanemap_simulator::{
    FleetScenario,
    drive::MotionModel,
    fleet::{ChangePlan, FleetRoads, FleetRoutes, PoisonPlan, TrafficModel},
    road::{Course, SingleRoad, TownPlan},
};

use super::not_negative;

/// An hour, nanoseconds.
const HOUR_NS: i64 = 3_600_000_000_000;

/// What a fleet has that drives by themselves do not: for `--roads city`, `straight`, `winding` and `loop`.
#[derive(Args, Debug)]
#[command(next_help_heading = "Fleets (--roads city, straight, winding, loop)")]
pub struct FleetArgs {
    /// Side of the city with its motorway, km: 3.2 is about 10 km^2 [default: 1.6]
    #[arg(long, value_name = "KM", value_parser = city_km)]
    city_km: Option<f64>,
    /// Hours from the start of one drive to that of the next [default: 24; 6 in the city]
    #[arg(long, value_name = "H", value_parser = clap::value_parser!(i64).range(1..=8760))]
    interval_h: Option<i64>,
    /// On a shared route let every second drive go the other way
    #[arg(long)]
    both_directions: bool,
    /// Other vehicles on a kilometre of each lane, which hide parts of the road [default: 0; 10 in the city]
    #[arg(long, value_name = "N", value_parser = vehicles_per_km)]
    traffic_per_km: Option<f64>,
    /// Standard deviation of the GNSS bias of a drive, east and north, metres [default: 1.5]
    #[arg(long, value_name = "M", value_parser = not_negative)]
    gnss_bias_m: Option<f64>,
    /// Share of streets with a place where GNSS jumps by metres, percent [default: 0; 15 in the city]
    #[arg(long, value_name = "PERCENT", value_parser = percent)]
    canyons_percent: Option<f64>,
    /// Changes of each kind between the first and the last drive: lines that vanish, appear, move, are repainted
    #[arg(long, value_name = "N", default_value_t = 0, value_parser = clap::value_parser!(u32).range(0..=1000))]
    changes: u32,
    /// Construction zones that come and go
    #[arg(long, value_name = "N", default_value_t = 0, value_parser = clap::value_parser!(u32).range(0..=1000))]
    zones: u32,
    /// Write only part I of N of the drives: a large fleet needs little disk where each part is replayed before the next
    #[arg(long, value_name = "I/N")]
    part: Option<Part>,
    /// Share of drives with a gross error of GNSS, odometry or camera mount, percent
    #[arg(long, value_name = "PERCENT", default_value_t = 0.0, value_parser = percent)]
    gross_percent: f64,
    /// Share of drives whose detections all lie one lane aside, percent
    #[arg(long, value_name = "PERCENT", default_value_t = 0.0, value_parser = percent)]
    adversarial_percent: f64,
}

/// A part of some parts, counted from 1.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Part {
    number: u32,
    of: u32,
}

impl FromStr for Part {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let numbers = text.split_once('/').and_then(|(number, of)| Some((number.parse().ok()?, of.parse().ok()?)));
        match numbers {
            Some((number, of)) if (1..=of).contains(&number) && of <= 1000 => Ok(Self { number, of }),
            _ => Err(format!("{text:?} is not I/N with I from 1 to N and N at most 1000")),
        }
    }
}

/// Where a fleet drives.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum World {
    /// A town.
    City,
    /// One road.
    Road(Course),
}

impl FleetArgs {
    /// Whether an option was given that only fleets have.
    pub fn is_given(&self) -> bool {
        let options = [self.city_km, self.traffic_per_km, self.gnss_bias_m, self.canyons_percent];
        options.iter().any(Option::is_some)
            || self.interval_h.is_some()
            || self.both_directions
            || self.part.is_some()
            || self.changes + self.zones > 0
            || self.gross_percent + self.adversarial_percent > 0.0
    }

    /// The numbers of the drives that are written, of so many.
    pub fn drives_of_part(&self, drives: u32) -> Range<u32> {
        let Part { number, of } = self.part.unwrap_or(Part { number: 1, of: 1 });
        // The products stay below a million.
        (number - 1) * drives / of..number * drives / of
    }

    /// What to simulate, but for the speeds of the drives.
    pub fn scenario(
        &self,
        world: World,
        drives: u32,
        length_m: f64,
        shared_route: bool,
        max_grade: f64,
    ) -> anyhow::Result<FleetScenario> {
        if self.gross_percent + self.adversarial_percent > 100.0 {
            bail!("--gross-percent and --adversarial-percent together are more than 100");
        }
        if self.both_directions && !shared_route {
            bail!("--both-directions needs --shared-route, since drives of their own take any direction");
        }
        let base = match world {
            World::City => {
                let plan = TownPlan::square_km(self.city_km.unwrap_or(1.6));
                FleetScenario { roads: FleetRoads::Town(plan), ..FleetScenario::town(drives) }
            }
            World::Road(_) if self.city_km.is_some() => bail!("--city-km needs --roads city"),
            World::Road(course) => {
                // A loop has its own length; another road is a little longer than its drives.
                let road_m = if course == Course::Loop { 2_000.0 } else { length_m + 200.0 };
                let roads = FleetRoads::Single(SingleRoad::new(course, road_m));
                FleetScenario { roads, ..FleetScenario::winding_road() }
            }
        };
        let routes = if shared_route {
            FleetRoutes::Shared { length_m, both_directions: self.both_directions }
        } else {
            FleetRoutes::Random { length_m }
        };
        let mut scenario = FleetScenario { drives, max_grade, routes, ..base };
        if let Some(hours) = self.interval_h {
            scenario.interval_ns = hours * HOUR_NS;
        }
        if let Some(vehicles_per_km) = self.traffic_per_km {
            scenario.traffic = TrafficModel { vehicles_per_km, ..TrafficModel::town() };
        }
        scenario.receiver.bias_sigma_m = self.gnss_bias_m.unwrap_or(scenario.receiver.bias_sigma_m);
        scenario.canyon_share = self.canyons_percent.map_or(scenario.canyon_share, |percent| percent / 100.0);
        scenario.poison =
            PoisonPlan { gross_share: self.gross_percent / 100.0, adversarial_share: self.adversarial_percent / 100.0 };
        let (first, last) = (drives / 4, (3 * drives / 4).max(1));
        scenario.changes = ChangePlan {
            vanished: self.changes,
            appeared: self.changes,
            moved: self.changes,
            repainted: self.changes,
            zones: self.zones,
            zone_drives: (drives / 4).max(1),
            ..ChangePlan::some(first.max(1), last)
        };
        Ok(scenario)
    }
}

/// A motion model of given speeds, where they are given.
pub fn with_speeds(
    motion: MotionModel,
    slowest_mps: Option<f64>,
    fastest_mps: Option<f64>,
) -> anyhow::Result<MotionModel> {
    let motion = MotionModel {
        min_speed_mps: slowest_mps.unwrap_or(motion.min_speed_mps),
        max_speed_mps: fastest_mps.unwrap_or(motion.max_speed_mps),
        ..motion
    };
    if motion.min_speed_mps > motion.max_speed_mps {
        let MotionModel { min_speed_mps, max_speed_mps, .. } = motion;
        bail!("--min-speed-mps {min_speed_mps} is above --max-speed-mps {max_speed_mps}; give both, the lower first");
    }
    Ok(motion)
}

fn within(text: &str, least: f64, most: f64) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(value) if (least..=most).contains(&value) => Ok(value),
        _ => Err(format!("{text:?} is not a number from {least} to {most}")),
    }
}

fn city_km(text: &str) -> Result<f64, String> {
    within(text, 0.8, 10.0)
}

fn vehicles_per_km(text: &str) -> Result<f64, String> {
    within(text, 0.0, 100.0)
}

fn percent(text: &str) -> Result<f64, String> {
    within(text, 0.0, 100.0)
}
