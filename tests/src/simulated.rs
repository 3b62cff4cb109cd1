//! Simulated drives through a mapper in this process, and what of its map is true.

use lanemap_core::{
    Frame, FrameLimits, FrameParts, MapLane, Mapper, Params, Pose, Preset, StepReport, TangentCovariance,
};
use lanemap_simulator::{Scenario, Simulation, truth_map::TruthMap};
use nalgebra::{Point3, Vector3};

/// A drive, the frames that it streams, and the true lines in its odometry frame.
#[derive(Debug)]
pub struct Drive {
    /// The simulation that it comes from.
    pub simulation: Simulation,
    /// What the vehicle streams.
    pub frames: Vec<FrameParts>,
}

impl Drive {
    /// The only drive of a scenario.
    #[must_use]
    pub fn simulate(scenario: &Scenario) -> Self {
        let simulation = Simulation::run(&Scenario { drives: 1, ..*scenario });
        let drive = &simulation.drives[0];
        let frames = (0..drive.frames.len()).map(|index| drive.frame_parts(index, None)).collect();
        Self { simulation, frames }
    }

    /// The drive with its true poses for odometry, stated so surely that the mapper holds them.
    #[must_use]
    pub fn on_true_poses(mut self) -> Self {
        let drive = &self.simulation.drives[0];
        let odometry_from_world = drive.world_from_odometry.inverse();
        for (frame, simulated) in self.frames.iter_mut().zip(&drive.frames) {
            frame.odometry.odometry_from_vehicle = odometry_from_world * simulated.truth.world_from_vehicle;
            frame.odometry.motion_covariance = Some(TangentCovariance::identity() * 1e-12);
        }
        self
    }

    /// A mapper of this drive's sensor that knows nothing yet.
    #[must_use]
    pub fn mapper(&self, preset: Preset) -> Mapper {
        Mapper::new(Params::preset(preset), self.simulation.drives[0].camera.sensor())
    }

    /// The map of the whole drive.
    #[must_use]
    pub fn mapped(&self, preset: Preset) -> Mapper {
        let mut mapper = self.mapper(preset);
        for frame in &self.frames {
            step(&mut mapper, frame);
        }
        mapper
    }

    /// The true lines that the drive saw for a while, in its odometry frame.
    #[must_use]
    pub fn truth(&self) -> Vec<Vec<Point3<f64>>> {
        let drive = &self.simulation.drives[0];
        let mut truth = TruthMap::default();
        for frame in &drive.frames {
            truth.observe(frame);
        }
        let odometry_from_world = drive.world_from_odometry.inverse();
        let lines = truth.lines(&self.simulation.network);
        lines.iter().map(|line| line.points.iter().map(|point| odometry_from_world * point).collect()).collect()
    }
}

/// Takes one frame.
pub fn step(mapper: &mut Mapper, frame: &FrameParts) -> StepReport {
    mapper.step(&Frame::new(frame.clone(), &FrameLimits::default()).unwrap())
}

/// A frame as a vehicle streams it whose odometry frame lies elsewhere: `there_from_here`.
#[must_use]
pub fn moved(frame: &FrameParts, there_from_here: &Pose) -> FrameParts {
    let mut moved = frame.clone();
    moved.odometry.odometry_from_vehicle = there_from_here * frame.odometry.odometry_from_vehicle;
    moved
}

/// Where a polyline is nearest to a point in plan.
#[derive(Clone, Copy, Debug)]
pub struct NearestOnLine {
    /// The point of the polyline.
    pub point: Point3<f64>,
    /// Unit vector along it, in plan.
    pub along: Vector3<f64>,
    /// Distance in plan, metres.
    pub distance_m: f64,
    /// Whether it is one of the polyline's two ends.
    pub at_end: bool,
}

/// Where a polyline is nearest to a point in plan; `None` of fewer than two points.
#[must_use]
pub fn nearest_on_line(line: &[Point3<f64>], query: &Point3<f64>) -> Option<NearestOnLine> {
    let mut best: Option<NearestOnLine> = None;
    let last = line.len().saturating_sub(2);
    for (index, pair) in line.windows(2).enumerate() {
        let piece = pair[1] - pair[0];
        let flat = Vector3::new(piece.x, piece.y, 0.0);
        let share = ((query - pair[0]).dot(&flat) / flat.norm_squared().max(1e-12)).clamp(0.0, 1.0);
        let point = pair[0] + piece * share;
        let distance_m = (query - point).xy().norm();
        if best.is_none_or(|best| distance_m < best.distance_m) {
            let at_end = (index == 0 && share <= 0.0) || (index == last && share >= 1.0);
            best = Some(NearestOnLine { point, along: flat.normalize(), distance_m, at_end });
        }
    }
    best
}

/// The nearest place on any of several lines.
#[must_use]
pub fn nearest_on_lines(lines: &[Vec<Point3<f64>>], query: &Point3<f64>) -> Option<NearestOnLine> {
    lines.iter().filter_map(|line| nearest_on_line(line, query)).min_by(|a, b| a.distance_m.total_cmp(&b.distance_m))
}

/// The value below which a share of `values` lies; NaN of none.
#[must_use]
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)] // an index
pub fn quantile(values: &mut [f64], share: f64) -> f64 {
    values.sort_by(f64::total_cmp);
    values.get(((values.len() as f64 - 1.0) * share).round() as usize).copied().unwrap_or(f64::NAN)
}

/// Lateral errors of the drawn control points of lanes that are lines of the truth, in sigmas of what the map states.
///
/// A lane whose median distance from every true line is above 1 m is no line of the truth and is left out, and so are
/// control points beyond a true line's ends: whether those are drawn is another promise.
#[must_use]
pub fn lateral_errors(lanes: &[MapLane], truth: &[Vec<Point3<f64>>]) -> Vec<LateralError> {
    lanes.iter().filter_map(|lane| lane_errors(lane, truth)).flatten().collect()
}

/// How far a control point lies beside its true line.
#[derive(Clone, Copy, Debug)]
pub struct LateralError {
    /// To the left of the true line, metres.
    pub error_m: f64,
    /// Standard deviation that the map states across the line, metres.
    pub sigma_m: f64,
}

fn lane_errors(lane: &MapLane, truth: &[Vec<Point3<f64>>]) -> Option<Vec<LateralError>> {
    let drawn = lane.control_points.iter().enumerate().filter(|(index, _)| {
        let parameter = *index as f64;
        parameter >= lane.drawn_from && parameter <= lane.drawn_to
    });
    let placed: Vec<_> = drawn
        .filter_map(|(_, point)| nearest_on_lines(truth, &point.position).map(|nearest| (point, nearest)))
        .filter(|(_, nearest)| !nearest.at_end)
        .collect();
    let mut distances: Vec<f64> = placed.iter().map(|(_, nearest)| nearest.distance_m).collect();
    if placed.is_empty() || quantile(&mut distances, 0.5) > 1.0 {
        return None;
    }
    let errors = placed.iter().map(|(point, nearest)| {
        let left = Vector3::new(-nearest.along.y, nearest.along.x, 0.0);
        let sigma_m = left.dot(&(point.covariance * left)).sqrt();
        LateralError { error_m: (point.position - nearest.point).dot(&left), sigma_m }
    });
    Some(errors.collect())
}
