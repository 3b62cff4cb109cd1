//! The earth as the WGS84 ellipsoid: geodetic, earth-centred (ECEF) and local east-north-up (ENU) coordinates.
//!
//! Geodetic to ECEF is the textbook closed form; the way back is the fixed-point iteration on the latitude (e.g.
//! Hofmann-Wellenhof, *GNSS*, 2008, 8.2.1), exact to below a micrometre from 10 km under to 100 km above the ellipsoid, poles included.
//! Not for satellites, nor for the centre of the earth.

use nalgebra::{Matrix3, Point3, Vector3};
use serde::{Deserialize, Serialize};

/// Semi-major axis of WGS84, metres.
const SEMI_MAJOR_M: f64 = 6_378_137.0;
/// Flattening of WGS84.
const FLATTENING: f64 = 1.0 / 298.257_223_563;
/// First eccentricity, squared.
const ECCENTRICITY_SQUARED: f64 = FLATTENING * (2.0 - FLATTENING);

/// A place on the earth.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Wgs84 {
    /// Geodetic latitude, degrees, in `[-90, 90]`.
    pub latitude_deg: f64,
    /// Longitude, degrees, in `[-180, 180]`.
    pub longitude_deg: f64,
    /// Height above the ellipsoid, metres.
    pub height_m: f64,
}

/// Earth-centred, earth-fixed position of a place, metres.
#[must_use]
pub fn ecef_from_wgs84(place: &Wgs84) -> Point3<f64> {
    let (sin_latitude, cos_latitude) = place.latitude_deg.to_radians().sin_cos();
    let (sin_longitude, cos_longitude) = place.longitude_deg.to_radians().sin_cos();
    let normal_m = prime_vertical_radius_m(sin_latitude);
    let from_axis_m = (normal_m + place.height_m) * cos_latitude;
    let polar_m = (normal_m * (1.0 - ECCENTRICITY_SQUARED) + place.height_m) * sin_latitude;
    Point3::new(from_axis_m * cos_longitude, from_axis_m * sin_longitude, polar_m)
}

/// The place of an earth-centred, earth-fixed position (metres).
#[must_use]
pub fn wgs84_from_ecef(ecef: &Point3<f64>) -> Wgs84 {
    let from_axis_m = ecef.x.hypot(ecef.y);
    let mut latitude = ecef.z.atan2(from_axis_m * (1.0 - ECCENTRICITY_SQUARED));
    let mut height_m = 0.0;
    for _ in 0..8 {
        let (sin_latitude, cos_latitude) = latitude.sin_cos();
        let normal_m = prime_vertical_radius_m(sin_latitude);
        height_m = from_axis_m * cos_latitude + ecef.z * sin_latitude - SEMI_MAJOR_M * SEMI_MAJOR_M / normal_m;
        let next = ecef.z.atan2(from_axis_m * (1.0 - ECCENTRICITY_SQUARED * normal_m / (normal_m + height_m)));
        let settled = (next - latitude).abs() < 1e-16;
        latitude = next;
        if settled {
            break;
        }
    }
    Wgs84 { latitude_deg: latitude.to_degrees(), longitude_deg: ecef.y.atan2(ecef.x).to_degrees(), height_m }
}

/// Radius of curvature in the prime vertical, metres.
fn prime_vertical_radius_m(sin_latitude: f64) -> f64 {
    SEMI_MAJOR_M / (1.0 - ECCENTRICITY_SQUARED * sin_latitude * sin_latitude).sqrt()
}

/// Origin of a local east-north-up frame, metres. Stored and sent as its place alone.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(from = "Wgs84", into = "Wgs84")]
pub struct Anchor {
    place: Wgs84,
    ecef: Point3<f64>,
    ecef_from_enu: Matrix3<f64>,
}

impl Anchor {
    /// The frame whose origin lies at a place, with its axes to east, north and along the ellipsoid's normal.
    #[must_use]
    pub fn new(place: Wgs84) -> Self {
        let (sin_latitude, cos_latitude) = place.latitude_deg.to_radians().sin_cos();
        let (sin_longitude, cos_longitude) = place.longitude_deg.to_radians().sin_cos();
        let east = Vector3::new(-sin_longitude, cos_longitude, 0.0);
        let north = Vector3::new(-sin_latitude * cos_longitude, -sin_latitude * sin_longitude, cos_latitude);
        let up = Vector3::new(cos_latitude * cos_longitude, cos_latitude * sin_longitude, sin_latitude);
        Self { place, ecef: ecef_from_wgs84(&place), ecef_from_enu: Matrix3::from_columns(&[east, north, up]) }
    }

    /// Where the origin lies.
    #[must_use]
    pub fn place(&self) -> Wgs84 {
        self.place
    }

    /// A place in this frame, metres.
    #[must_use]
    pub fn enu_from_wgs84(&self, place: &Wgs84) -> Point3<f64> {
        Point3::from(self.ecef_from_enu.tr_mul(&(ecef_from_wgs84(place) - self.ecef)))
    }

    /// The place of a point of this frame (metres).
    #[must_use]
    pub fn wgs84_from_enu(&self, point_enu: &Point3<f64>) -> Wgs84 {
        wgs84_from_ecef(&(self.ecef + self.ecef_from_enu * point_enu.coords))
    }
}

impl From<Wgs84> for Anchor {
    fn from(place: Wgs84) -> Self {
        Self::new(place)
    }
}

impl From<Anchor> for Wgs84 {
    fn from(anchor: Anchor) -> Self {
        anchor.place
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn any_place() -> impl Strategy<Value = Wgs84> {
        (-90.0..=90.0f64, -180.0..=180.0f64, -1e3..1e4f64).prop_map(|(latitude_deg, longitude_deg, height_m)| Wgs84 {
            latitude_deg,
            longitude_deg,
            height_m,
        })
    }

    #[test]
    fn the_ends_of_the_axes_lie_where_wgs84_puts_them() {
        let at = |latitude_deg, longitude_deg| ecef_from_wgs84(&Wgs84 { latitude_deg, longitude_deg, height_m: 0.0 });
        assert!((at(0.0, 0.0) - Point3::new(6_378_137.0, 0.0, 0.0)).norm() < 1e-8);
        assert!((at(0.0, 90.0) - Point3::new(0.0, 6_378_137.0, 0.0)).norm() < 1e-8);
        // The polar semi-axis as the standard prints it.
        assert!((at(90.0, 0.0) - Point3::new(0.0, 0.0, 6_356_752.314_245)).norm() < 1e-6);
    }

    #[test]
    fn a_hundred_metres_on_the_ground_are_a_hundred_metres_in_the_local_frame() {
        let anchor = Anchor::new(Wgs84 { latitude_deg: 45.0, longitude_deg: 7.0, height_m: 0.0 });
        // One degree of latitude at 45 degrees is 111 131.745 m long (meridian radius 6 367 381.816 m).
        let north = Wgs84 { latitude_deg: 45.0 + 100.0 / 111_131.745, longitude_deg: 7.0, height_m: 0.0 };
        let enu = anchor.enu_from_wgs84(&north);
        assert!((enu - Point3::new(0.0, 100.0, 0.0)).norm() < 2e-3, "{enu}");
    }

    #[test]
    fn an_anchor_is_stored_as_its_place() {
        let anchor = Anchor::new(Wgs84 { latitude_deg: 37.5, longitude_deg: -122.25, height_m: 12.0 });
        let json = serde_json::to_string(&anchor).unwrap();
        assert_eq!(json, r#"{"latitude_deg":37.5,"longitude_deg":-122.25,"height_m":12.0}"#);
        assert_eq!(serde_json::from_str::<Anchor>(&json).unwrap(), anchor);
    }

    proptest! {
        #[test]
        fn ecef_agrees_with_an_independent_library(place in any_place()) {
            let (latitude, longitude) = (place.latitude_deg.to_radians(), place.longitude_deg.to_radians());
            let (x, y, z) = map_3d::geodetic2ecef(latitude, longitude, place.height_m, map_3d::Ellipsoid::WGS84);
            prop_assert!((ecef_from_wgs84(&place) - Point3::new(x, y, z)).norm() < 1e-6);
        }

        #[test]
        fn the_local_frame_agrees_with_an_independent_library(
            place in any_place(),
            shift in prop::array::uniform3(-5e3..5e3f64),
        ) {
            let anchor = Anchor::new(place);
            let [east, north, up] = shift;
            let ours = ecef_from_wgs84(&anchor.wgs84_from_enu(&Point3::new(east, north, up)));
            let (latitude, longitude) = (place.latitude_deg.to_radians(), place.longitude_deg.to_radians());
            let (x, y, z) = map_3d::enu2ecef(
                east, north, up, latitude, longitude, place.height_m, map_3d::Ellipsoid::WGS84,
            );
            prop_assert!((ours - Point3::new(x, y, z)).norm() < 1e-6);
        }

        #[test]
        fn a_place_survives_the_way_through_ecef(place in any_place()) {
            let again = wgs84_from_ecef(&ecef_from_wgs84(&place));
            let moved = ecef_from_wgs84(&again) - ecef_from_wgs84(&place);
            prop_assert!(moved.norm() < 1e-6, "{again:?}");
            prop_assert!((again.height_m - place.height_m).abs() < 1e-6);
        }
    }
}
