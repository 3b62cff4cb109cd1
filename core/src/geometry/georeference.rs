//! Where on the earth a drive's own frame lies: WGS84, ECEF, a local east-north-up frame, and a fit of one on the other.
//!
//! ```
//! use lanemap_core::{GnssFix, Pose, geometry::georeference::GeoreferenceFit};
//! use nalgebra::Point3;
//!
//! let fix = GnssFix {
//!     latitude_deg: 22.3,
//!     longitude_deg: 114.2,
//!     height_m: 10.0,
//!     horizontal_sigma_m: 1.0,
//!     vertical_sigma_m: 2.0,
//!     yaw_enu_rad: Some(std::f64::consts::FRAC_PI_2), // north
//! };
//! let mut fit = GeoreferenceFit::default();
//! assert!(fit.georeference().is_none());
//! fit.observe(&fix, &Pose::identity());
//!
//! let georeference = fit.georeference().expect("a fix with a heading is enough");
//! let ahead = georeference.to_wgs84(&Point3::new(100.0, 0.0, 0.0));
//! assert!(ahead.latitude_deg > 22.3 && (ahead.longitude_deg - 114.2).abs() < 1e-9);
//! ```

mod earth;
mod fit;

pub use earth::{Anchor, Wgs84, ecef_from_wgs84, wgs84_from_ecef};
pub use fit::GeoreferenceFit;

use nalgebra::Point3;
use serde::{Deserialize, Serialize};

use super::pose::{Pose, yaw_rad};
use crate::frame::GnssFix;

/// Where the map frame of a drive lies on the earth.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Georeference {
    /// Origin of the local east-north-up frame.
    pub anchor: Anchor,
    /// The drive's map frame in that frame: a turn about z and a shift.
    pub enu_from_map: Pose,
}

impl Georeference {
    /// A point of the map frame (metres) on the earth.
    #[must_use]
    pub fn to_wgs84(&self, point_map: &Point3<f64>) -> Wgs84 {
        self.anchor.wgs84_from_enu(&(self.enu_from_map * point_map))
    }

    /// A point on the earth in the map frame, metres.
    #[must_use]
    pub fn to_map(&self, point: &Wgs84) -> Point3<f64> {
        self.enu_from_map.inverse_transform_point(&self.anchor.enu_from_wgs84(point))
    }

    /// The fix that a perfect receiver at a pose of the vehicle in the map frame would report, with these sigmas.
    #[must_use]
    pub fn fix_at(&self, map_from_vehicle: &Pose, horizontal_sigma_m: f64, vertical_sigma_m: f64) -> GnssFix {
        let place = self.to_wgs84(&Point3::from(map_from_vehicle.translation.vector));
        GnssFix {
            latitude_deg: place.latitude_deg,
            longitude_deg: place.longitude_deg,
            height_m: place.height_m,
            horizontal_sigma_m,
            vertical_sigma_m,
            yaw_enu_rad: Some(yaw_rad(&(self.enu_from_map * map_from_vehicle))),
        }
    }
}
