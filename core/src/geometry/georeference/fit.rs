//! Fit of a drive's map frame on its GNSS fixes: a turn about z and a shift (4 degrees of freedom).
//!
//! Weighted least squares in closed form (Umeyama 1991, in the plane, without scale), kept as running sums in Welford's
//! form, so that one fix costs O(1) and coordinates thousands of metres from the origin lose no digits:
//! `yaw = atan2(sum w (m x e), sum w (m . e))` over the map positions `m` and ENU positions `e` from their means, weights `1 / sigma^2`.
//! Headings, where fixes have them, are a second witness of the yaw, weighed with the first by their variances.
//!
//! Consecutive fixes share most of their error (multipath, atmosphere), so a thousand fixes are not a thousand witnesses:
//! both are deflated to [`INDEPENDENT_FIXES`]. Not robust: one gross outlier moves the fit by its share of the weight.

use nalgebra::{Translation3, UnitQuaternion, Vector2, Vector3};
use serde::{Deserialize, Serialize};

use super::{Anchor, Georeference, Wgs84};
use crate::{
    frame::GnssFix,
    geometry::pose::{Pose, yaw_rad},
};

/// How many independent fixes the fixes of a drive are worth, at most, for the yaw.
const INDEPENDENT_FIXES: f64 = 10.0;
/// Shortest way between fixes that tells a direction, metres.
const SHORTEST_BASELINE_M: f64 = 10.0;
/// Shortest way between fixes that tells a direction, in standard deviations of a fix.
const SHORTEST_BASELINE_SIGMAS: f64 = 5.0;
/// Standard deviation of a receiver's heading, radians.
const HEADING_SIGMA_RAD: f64 = 1.0 * std::f64::consts::PI / 180.0;

/// Running fit of the map frame on GNSS fixes. Its state has a constant size and depends only on the fixes in their order.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct GeoreferenceFit {
    anchor: Option<Anchor>,
    first_map: Vector2<f64>,
    farthest_m: f64,
    fixes: u64,
    horizontal: HorizontalSums,
    vertical: VerticalSums,
    heading: HeadingSums,
}

/// Weighted moments of map positions against ENU positions.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
struct HorizontalSums {
    weight: f64,
    mean_map: Vector2<f64>,
    mean_enu: Vector2<f64>,
    /// Sum of `w |m|^2` about the mean.
    spread: f64,
    /// Sum of `w (m . e)` about the means.
    dot: f64,
    /// Sum of `w (m x e)` about the means.
    cross: f64,
}

/// Weighted mean of the height of ENU above map.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
struct VerticalSums {
    weight: f64,
    mean_m: f64,
}

/// Sum of the turns from map to ENU that headings tell, as unit vectors.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
struct HeadingSums {
    count: f64,
    cos: f64,
    sin: f64,
}

/// An angle with the inverse of its variance.
#[derive(Clone, Copy)]
struct YawEstimate {
    yaw_rad: f64,
    information: f64,
}

impl GeoreferenceFit {
    /// Takes a fix of the vehicle's origin and the pose of the vehicle in the map frame at the same time.
    ///
    /// The first fix becomes the anchor. The fix is valid, as in a [`Frame`](crate::Frame).
    pub fn observe(&mut self, fix: &GnssFix, map_from_vehicle: &Pose) {
        let place = Wgs84 { latitude_deg: fix.latitude_deg, longitude_deg: fix.longitude_deg, height_m: fix.height_m };
        let map = map_from_vehicle.translation.vector;
        if self.anchor.is_none() {
            self.first_map = map.xy();
        }
        let anchor = *self.anchor.get_or_insert_with(|| Anchor::new(place));
        let enu = anchor.enu_from_wgs84(&place);
        self.fixes += 1;
        self.farthest_m = self.farthest_m.max((map.xy() - self.first_map).norm());
        self.horizontal.add(map.xy(), enu.coords.xy(), fix.horizontal_sigma_m.powi(-2));
        self.vertical.add(enu.z - map.z, fix.vertical_sigma_m.powi(-2));
        if let Some(yaw_enu) = fix.yaw_enu_rad {
            self.heading.add(yaw_enu - yaw_rad(map_from_vehicle));
        }
    }

    /// Number of fixes taken.
    #[must_use]
    pub fn fixes(&self) -> u64 {
        self.fixes
    }

    /// The fit, or `None` while the heading is open: no fix with a heading, and too short a way between fixes.
    #[must_use]
    pub fn georeference(&self) -> Option<Georeference> {
        let anchor = self.anchor?;
        let yaw = combine(self.yaw_from_positions(), self.heading.yaw())?;
        let rotation = UnitQuaternion::from_scaled_axis(Vector3::z() * yaw);
        let turned = rotation * Vector3::new(self.horizontal.mean_map.x, self.horizontal.mean_map.y, 0.0);
        let shift = self.horizontal.mean_enu - turned.xy();
        let translation = Translation3::new(shift.x, shift.y, self.vertical.mean_m);
        Some(Georeference { anchor, enu_from_map: Pose::from_parts(translation, rotation) })
    }

    /// The yaw that the positions tell, once the way between them is long against their error.
    fn yaw_from_positions(&self) -> Option<YawEstimate> {
        let sums = &self.horizontal;
        let sigma_m = (self.fixes as f64 / sums.weight).sqrt();
        if self.farthest_m < SHORTEST_BASELINE_M.max(SHORTEST_BASELINE_SIGMAS * sigma_m) {
            return None;
        }
        let deflation = (self.fixes as f64 / INDEPENDENT_FIXES).max(1.0);
        Some(YawEstimate { yaw_rad: sums.cross.atan2(sums.dot), information: sums.spread / deflation })
    }
}

impl HorizontalSums {
    fn add(&mut self, map: Vector2<f64>, enu: Vector2<f64>, weight: f64) {
        self.weight += weight;
        let share = weight / self.weight;
        let map_from_old_mean = map - self.mean_map;
        self.mean_map += map_from_old_mean * share;
        self.mean_enu += (enu - self.mean_enu) * share;
        let enu_from_new_mean = enu - self.mean_enu;
        self.spread += weight * map_from_old_mean.dot(&(map - self.mean_map));
        self.dot += weight * map_from_old_mean.dot(&enu_from_new_mean);
        self.cross += weight * map_from_old_mean.perp(&enu_from_new_mean);
    }
}

impl VerticalSums {
    fn add(&mut self, height_m: f64, weight: f64) {
        self.weight += weight;
        self.mean_m += (height_m - self.mean_m) * weight / self.weight;
    }
}

impl HeadingSums {
    fn add(&mut self, turn_rad: f64) {
        self.count += 1.0;
        self.cos += turn_rad.cos();
        self.sin += turn_rad.sin();
    }

    fn yaw(&self) -> Option<YawEstimate> {
        // Headings that contradict each other cancel out, and tell nothing.
        let agreement = self.cos.hypot(self.sin) / self.count.max(1.0);
        if agreement < 0.5 {
            return None;
        }
        let information = self.count.min(INDEPENDENT_FIXES) / (HEADING_SIGMA_RAD * HEADING_SIGMA_RAD);
        Some(YawEstimate { yaw_rad: self.sin.atan2(self.cos), information })
    }
}

/// Weighted mean of two angles, across the cut at half a turn.
fn combine(positions: Option<YawEstimate>, heading: Option<YawEstimate>) -> Option<f64> {
    match (positions, heading) {
        (Some(a), Some(b)) => {
            let turn = b.yaw_rad - a.yaw_rad;
            let wrapped = turn.sin().atan2(turn.cos());
            Some(a.yaw_rad + wrapped * b.information / (a.information + b.information))
        }
        (Some(one), None) | (None, Some(one)) => Some(one.yaw_rad),
        (None, None) => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Point3;
    use rand::Rng;
    use rand_chacha::{ChaCha8Rng, rand_core::SeedableRng};
    use rand_distr::StandardNormal;

    fn truth() -> Georeference {
        Georeference {
            anchor: Anchor::new(Wgs84 { latitude_deg: 48.1, longitude_deg: 11.6, height_m: 500.0 }),
            // The drive is near the anchor, and thousands of metres from the origin of its map, as city coordinates are.
            enu_from_map: Pose::rotation(Vector3::z() * 2.5) * Pose::translation(-5000.0, -2400.0, -57.0),
        }
    }

    fn drive(length_m: f64, frames: u32) -> Vec<Pose> {
        (0..=frames)
            .map(|frame| {
                let along = length_m * f64::from(frame) / f64::from(frames);
                Pose::new(
                    Vector3::new(5000.0 + along, 2400.0 + 0.001 * along * along, 60.0),
                    Vector3::z() * 0.002 * along,
                )
            })
            .collect()
    }

    fn error_m(fit: &GeoreferenceFit, at: &Point3<f64>) -> f64 {
        let found = ecef(&fit.georeference().unwrap().to_wgs84(at));
        (found - ecef(&truth().to_wgs84(at))).norm()
    }

    fn ecef(place: &Wgs84) -> Point3<f64> {
        super::super::ecef_from_wgs84(place)
    }

    #[test]
    fn fixes_without_error_give_the_map_frame_back() {
        let mut fit = GeoreferenceFit::default();
        for pose in drive(200.0, 200) {
            let fix = GnssFix { yaw_enu_rad: None, ..truth().fix_at(&pose, 1.0, 2.0) };
            fit.observe(&fix, &pose);
        }
        assert!(error_m(&fit, &Point3::new(5100.0, 2410.0, 60.0)) < 2e-3);
    }

    #[test]
    fn nothing_is_claimed_before_the_heading_is_known() {
        let mut fit = GeoreferenceFit::default();
        for pose in drive(9.0, 20) {
            fit.observe(&GnssFix { yaw_enu_rad: None, ..truth().fix_at(&pose, 1.0, 2.0) }, &pose);
            assert!(fit.georeference().is_none());
        }
    }

    #[test]
    fn poor_fixes_need_a_longer_way() {
        let seen_after = |sigma_m: f64| {
            let mut fit = GeoreferenceFit::default();
            drive(200.0, 200)
                .iter()
                .position(|pose| {
                    fit.observe(&GnssFix { yaw_enu_rad: None, ..truth().fix_at(pose, sigma_m, 2.0) }, pose);
                    fit.georeference().is_some()
                })
                .unwrap()
        };
        assert!((10..=11).contains(&seen_after(0.5)));
        assert!((48..=51).contains(&seen_after(10.0)));
    }

    #[test]
    fn one_fix_with_a_heading_is_enough() {
        let pose = drive(1.0, 1)[0];
        let mut fit = GeoreferenceFit::default();
        fit.observe(&truth().fix_at(&pose, 1.0, 2.0), &pose);
        assert!(error_m(&fit, &Point3::new(5010.0, 2400.0, 60.0)) < 1e-6);
    }

    #[test]
    fn white_noise_on_the_fixes_averages_out() {
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        let mut fit = GeoreferenceFit::default();
        for pose in drive(300.0, 400) {
            let noise: [f64; 3] = std::array::from_fn(|_| rng.sample(StandardNormal));
            let shifted = Pose::translation(noise[0], noise[1], noise[2]) * pose;
            let fix = truth().fix_at(&shifted, 1.0, 1.0);
            fit.observe(&GnssFix { yaw_enu_rad: None, ..fix }, &pose);
        }
        // 1 m of noise over 400 fixes: 0.05 m per axis at the middle.
        assert!(error_m(&fit, &Point3::new(5150.0, 2422.5, 60.0)) < 0.2);
    }

    #[test]
    fn a_heading_across_the_cut_at_half_a_turn_is_averaged_rightly() {
        let yaw = combine(
            Some(YawEstimate { yaw_rad: 3.1, information: 1.0 }),
            Some(YawEstimate { yaw_rad: -3.1, information: 1.0 }),
        );
        assert!((yaw.unwrap() - std::f64::consts::PI).abs() < 1e-9);
    }

    #[test]
    fn the_fit_survives_being_stored() {
        let mut fit = GeoreferenceFit::default();
        let poses = drive(50.0, 50);
        for pose in &poses[..25] {
            fit.observe(&truth().fix_at(pose, 1.0, 2.0), pose);
        }
        let mut restored: GeoreferenceFit = postcard::from_bytes(&postcard::to_stdvec(&fit).unwrap()).unwrap();
        for pose in &poses[25..] {
            fit.observe(&truth().fix_at(pose, 1.0, 2.0), pose);
            restored.observe(&truth().fix_at(pose, 1.0, 2.0), pose);
        }
        assert_eq!(fit, restored);
        assert_eq!(fit.fixes(), 51);
    }
}
