//! From a detection to a lane observation: crop, local frame, cubic fit, outlier cut, resampling, noise.
//!
//! Paper: "Lane Representation". A detection is unordered points with noise; an observation is the cubics `y(x)`, `z(x)`
//! in a local reference frame, sampled every 0.5 m, with a standard deviation for each sample.

pub mod cubic;
pub mod local_frame;

use nalgebra::Point3;

use crate::{
    category::Category,
    frame::Detection,
    params::{ObservationParams, RangeNoise},
    sensor::Sensor,
};
use cubic::Cubic;
use local_frame::LocalFrame;

/// A lane as one frame saw it.
#[derive(Clone, Debug, PartialEq)]
pub struct LaneObservation {
    /// Index of the detection in its frame.
    pub detection: usize,
    /// What the detector took it for.
    pub category: Category,
    /// The local reference frame in which the cubics live: x from the near end to the far end.
    pub local_frame: LocalFrame,
    /// Left deviation `y(x)` in the local frame.
    pub lateral: Cubic,
    /// Height `z(x)` in the local frame.
    pub vertical: Cubic,
    /// First and last abscissa reported, local frame, metres.
    pub reported: (f64, f64),
    /// First and last abscissa that the line certainly reaches: the reported points before the outermost.
    ///
    /// A detector that reports a line at fixed rows reports it from the row before its visible part to the row after.
    pub certain: (f64, f64),
    /// Points that were measured and entered the fit.
    pub measured: usize,
    /// Samples along the line from `reported.0` to `reported.1`, vehicle frame, metres; [`sigma_at`] their range is their noise.
    pub samples: Vec<Point3<f64>>,
}

impl LaneObservation {
    /// Point of the fitted line at an abscissa of the local frame, vehicle frame.
    #[must_use]
    pub fn point_at(&self, x: f64) -> Point3<f64> {
        self.local_frame.vehicle_from_local(&Point3::new(x, self.lateral.at(x), self.vertical.at(x)))
    }

    /// Length of the line along its local x axis, metres.
    #[must_use]
    pub fn length_m(&self) -> f64 {
        self.reported.1 - self.reported.0
    }
}

/// Standard deviation of a detection at a horizontal range from the camera.
#[must_use]
pub fn sigma_at(noise: &RangeNoise, range_m: f64) -> f64 {
    noise.near_m + noise.growth_m * (range_m / noise.reference_range_m).powi(noise.power)
}

/// Turns a detection into an observation; `None` where too little of it lies in the crop box.
#[must_use]
pub fn observe(
    detection: &Detection,
    index: usize,
    sensor: &Sensor,
    params: &ObservationParams,
) -> Option<LaneObservation> {
    let below_camera = Point3::from(sensor.ground_offset());
    let range_m = |point: &Point3<f64>| (point.xy() - below_camera.xy()).norm();
    let cropped = crop(&detection.points_vehicle, &below_camera, params);
    let local_frame = LocalFrame::along(&cropped)?;
    let mut points: Vec<Point3<f64>> = cropped.iter().map(|point| local_frame.local_from_vehicle(point)).collect();
    points.sort_by(|a, b| a.x.total_cmp(&b.x));
    thin(&mut points, params.thin_m);
    if points.len() < params.least_points {
        return None;
    }
    let weigh = |point: &Point3<f64>| {
        if params.weighted_fit {
            sigma_at(&params.noise, range_m(&local_frame.vehicle_from_local(point))).powi(-2)
        } else {
            1.0
        }
    };
    let fit = fit_without_outliers(&mut points, &weigh, params)?;
    let last = points.len() - 1;
    let reported = (points[0].x, points[last].x);
    let certain = if last >= 2 { (points[1].x, points[last - 1].x) } else { reported };
    if reported.1 - reported.0 < params.least_length_m {
        return None;
    }
    let mut observation = LaneObservation {
        detection: index,
        category: detection.category,
        local_frame,
        lateral: fit.lateral,
        vertical: fit.vertical,
        reported,
        certain,
        measured: points.len(),
        samples: Vec::new(),
    };
    observation.samples = resample(&observation, params.sample_step_m);
    (observation.samples.len() >= params.least_samples).then_some(observation)
}

fn crop(points: &[Point3<f64>], below_camera: &Point3<f64>, params: &ObservationParams) -> Vec<Point3<f64>> {
    let inside = |point: &&Point3<f64>| {
        let ahead = point.x - below_camera.x;
        (params.ahead_from_m..=params.ahead_to_m).contains(&ahead) && (point.y - below_camera.y).abs() <= params.side_m
    };
    points.iter().filter(inside).copied().collect()
}

/// Leaves out points that are nearer than `step_m` to the last kept one along the line.
fn thin(points: &mut Vec<Point3<f64>>, step_m: f64) {
    let mut last_kept = f64::NEG_INFINITY;
    points.retain(|point| {
        let keep = point.x - last_kept >= step_m;
        if keep {
            last_kept = point.x;
        }
        keep
    });
}

struct Fit {
    lateral: Cubic,
    vertical: Cubic,
}

fn fit(points: &[Point3<f64>], weigh: &impl Fn(&Point3<f64>) -> f64, params: &ObservationParams) -> Option<Fit> {
    let axis = |value: fn(&Point3<f64>) -> f64| {
        let order = order_for(points.iter().map(value), points.len(), params);
        Cubic::fit(points.iter().map(|point| (point.x, value(point), weigh(point))), order)
    };
    Some(Fit { lateral: axis(|point| point.y)?, vertical: axis(|point| point.z)? })
}

/// Falling order: a cubic through a straight noisy line extrapolates wildly.
fn order_for(values: impl Iterator<Item = f64> + Clone, count: usize, params: &ObservationParams) -> usize {
    let (low, high) = values.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), v| (low.min(v), high.max(v)));
    let order = match high - low {
        spread if spread < params.flat_spread_m => params.flat_order,
        spread if spread < params.curved_spread_m => 2,
        _ => 3,
    };
    order.min(count.saturating_sub(1))
}

/// Fits, drops the points farther than mean + 2 sigma of the residual, and fits again.
fn fit_without_outliers(
    points: &mut Vec<Point3<f64>>,
    weigh: &impl Fn(&Point3<f64>) -> f64,
    params: &ObservationParams,
) -> Option<Fit> {
    let first = fit(points, weigh, params)?;
    let residual =
        |point: &Point3<f64>| (first.lateral.at(point.x) - point.y).hypot(first.vertical.at(point.x) - point.z);
    let count = points.len() as f64;
    let mean = points.iter().map(residual).sum::<f64>() / count;
    let variance = points.iter().map(|point| (residual(point) - mean).powi(2)).sum::<f64>() / count;
    let bound = (mean + 2.0 * variance.sqrt()).max(params.outlier_floor_m);
    let kept: Vec<Point3<f64>> = points.iter().filter(|point| residual(point) <= bound).copied().collect();
    if kept.len() == points.len() {
        return Some(first);
    }
    if kept.len() < params.least_points {
        return None;
    }
    *points = kept;
    fit(points, weigh, params)
}

#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)] // a length within the crop box
fn resample(observation: &LaneObservation, step_m: f64) -> Vec<Point3<f64>> {
    let (from, to) = observation.reported;
    let pieces = ((to - from) / step_m).ceil().max(1.0) as usize;
    let step = (to - from) / pieces as f64;
    (0..=pieces).map(|k| observation.point_at(from + step * k as f64)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::params::{Params, Preset};

    fn params() -> ObservationParams {
        Params::preset(Preset::Default).observation
    }

    fn detection(points: Vec<Point3<f64>>) -> Detection {
        Detection { category: Category::WhiteSolid, points_vehicle: points }
    }

    fn rows(y: impl Fn(f64) -> f64) -> Vec<Point3<f64>> {
        [5.0, 10.0, 15.0, 20.0, 30.0, 40.0, 50.0].map(|x| Point3::new(x, y(x), 0.0)).to_vec()
    }

    #[test]
    fn a_cubic_line_is_recovered_in_any_order_of_its_points() {
        let curve = |x: f64| 1.0 + 0.02 * x + 3e-3 * x * x - 5e-6 * x * x * x;
        let mut points = rows(curve);
        points.reverse();
        points.swap(1, 4);
        let observation = observe(&detection(points), 0, &Sensor::default(), &params()).unwrap();
        for sample in &observation.samples {
            // The cubic lives in the turned local frame: the same curve to a few centimetres.
            assert!((sample.y - curve(sample.x)).abs() < 0.05);
        }
        assert!(observation.samples[0].x < observation.samples[1].x);
    }

    #[test]
    fn the_outermost_rows_are_reported_but_not_certain() {
        let observation = observe(&detection(rows(|_| 2.0)), 0, &Sensor::default(), &params()).unwrap();
        let near = observation.point_at(observation.certain.0).x;
        let far = observation.point_at(observation.certain.1).x;
        assert!((near - 10.0).abs() < 1e-9 && (far - 40.0).abs() < 1e-9);
    }

    #[test]
    fn a_gross_outlier_is_cut() {
        let mut points: Vec<Point3<f64>> = (0..40).map(|k| Point3::new(5.0 + f64::from(k), 2.0, 0.0)).collect();
        points[20].y = 5.0;
        let observation = observe(&detection(points), 0, &Sensor::default(), &params()).unwrap();
        assert!(observation.samples.iter().all(|sample| (sample.y - 2.0).abs() < 0.2));
    }

    #[test]
    fn too_few_points_in_the_box_are_no_observation() {
        let behind = (0..9).map(|k| Point3::new(-f64::from(k), 0.0, 0.0)).collect();
        assert!(observe(&detection(behind), 0, &Sensor::default(), &params()).is_none());
        assert!(observe(&detection(rows(|_| 0.0)[..1].to_vec()), 0, &Sensor::default(), &params()).is_none());
        assert!(observe(&detection(vec![Point3::new(9.0, 0.0, 0.0); 50]), 0, &Sensor::default(), &params()).is_none());
    }
}
