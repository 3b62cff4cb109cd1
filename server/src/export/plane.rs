//! A plane for maps in metres: transverse Mercator around an anchor, heights above the ellipsoid.
//!
//! Krüger's series in the third flattening to its fourth order (Karney, *Transverse Mercator with an accuracy of a few
//! nanometers*, 2011, equations 7 to 11 and 35): exact to a micrometre within 3,000 km of the anchor's meridian. The scale is 1
//! on that meridian and grows by `x^2 / 2 R^2` beside it: 12 mm per 100 m are reached 100 km to the east.

use lanemap_core::geometry::georeference::Wgs84;
use nalgebra::Point3;

/// Semi-major axis of WGS84, metres.
const SEMI_MAJOR_M: f64 = 6_378_137.0;
/// Flattening of WGS84.
const FLATTENING: f64 = 1.0 / 298.257_223_563;
/// First eccentricity, squared.
const ECCENTRICITY_SQUARED: f64 = FLATTENING * (2.0 - FLATTENING);

/// A plane whose x axis points east and whose y axis points north at its anchor.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Plane {
    latitude_deg: f64,
    longitude_deg: f64,
    /// Way from the equator to the anchor, metres.
    anchor_north_m: f64,
}

impl Plane {
    /// The plane around a place, which is rounded to what its PROJ string says: 7 decimals of a degree.
    #[must_use]
    pub fn at(latitude_deg: f64, longitude_deg: f64) -> Self {
        let rounded = |degrees: f64| (degrees * 1e7).round() / 1e7;
        let (latitude_deg, longitude_deg) = (rounded(latitude_deg), rounded(longitude_deg));
        let [_, anchor_north_m] = projected(latitude_deg.to_radians(), 0.0);
        Self { latitude_deg, longitude_deg, anchor_north_m }
    }

    /// The anchor: latitude and longitude, degrees.
    #[must_use]
    pub fn anchor_deg(&self) -> [f64; 2] {
        [self.latitude_deg, self.longitude_deg]
    }

    /// A place in the plane: east, north, height above the ellipsoid, metres.
    #[must_use]
    pub fn project(&self, place: &Wgs84) -> Point3<f64> {
        let east_deg = (place.longitude_deg - self.longitude_deg + 180.0).rem_euclid(360.0) - 180.0;
        let [east_m, north_m] = projected(place.latitude_deg.to_radians(), east_deg.to_radians());
        Point3::new(east_m, north_m - self.anchor_north_m, place.height_m)
    }

    /// The place of a point of the plane: the inverse of [`Plane::project`].
    #[must_use]
    pub fn unproject(&self, point: &Point3<f64>) -> Wgs84 {
        let [latitude, longitude] = unprojected(point.x, point.y + self.anchor_north_m);
        let longitude_deg = longitude.to_degrees() + self.longitude_deg;
        Wgs84 {
            latitude_deg: latitude.to_degrees(),
            longitude_deg: (longitude_deg + 180.0).rem_euclid(360.0) - 180.0,
            height_m: point.z,
        }
    }

    /// The plane as PROJ writes it.
    #[must_use]
    pub fn proj_string(&self) -> String {
        format!(
            "+proj=tmerc +lat_0={:.7} +lon_0={:.7} +k=1 +x_0=0 +y_0=0 +datum=WGS84 +units=m +vunits=m +no_defs",
            self.latitude_deg, self.longitude_deg
        )
    }
}

/// East of the central meridian and north of the equator, metres, of a latitude and a longitude from that meridian, radians.
fn projected(latitude: f64, longitude: f64) -> [f64; 2] {
    let [n, n2, n3, n4] = powers();
    let series = [
        n / 2.0 - 2.0 * n2 / 3.0 + 5.0 * n3 / 16.0 + 41.0 * n4 / 180.0,
        13.0 * n2 / 48.0 - 3.0 * n3 / 5.0 + 557.0 * n4 / 1_440.0,
        61.0 * n3 / 240.0 - 103.0 * n4 / 140.0,
        49_561.0 * n4 / 161_280.0,
    ];
    let eccentricity = ECCENTRICITY_SQUARED.sqrt();
    let sin_latitude = latitude.sin().clamp(-1.0 + 1e-15, 1.0 - 1e-15);
    let conformal_tan = (sin_latitude.atanh() - eccentricity * (eccentricity * sin_latitude).atanh()).sinh();
    let (sin_longitude, cos_longitude) = longitude.sin_cos();
    let xi = conformal_tan.atan2(cos_longitude);
    let eta = (sin_longitude / conformal_tan.hypot(cos_longitude)).asinh();
    let (mut east, mut north) = (eta, xi);
    let mut order = 2.0;
    for coefficient in series {
        east += coefficient * (order * xi).cos() * (order * eta).sinh();
        north += coefficient * (order * xi).sin() * (order * eta).cosh();
        order += 2.0;
    }
    [rectifying_m() * east, rectifying_m() * north]
}

/// The latitude and the longitude from the central meridian, radians, of a place east of it and north of the equator, metres.
fn unprojected(east_m: f64, north_m: f64) -> [f64; 2] {
    let [n, n2, n3, n4] = powers();
    let series = [
        n / 2.0 - 2.0 * n2 / 3.0 + 37.0 * n3 / 96.0 - n4 / 360.0,
        n2 / 48.0 + n3 / 15.0 - 437.0 * n4 / 1_440.0,
        17.0 * n3 / 480.0 - 37.0 * n4 / 840.0,
        4_397.0 * n4 / 161_280.0,
    ];
    let (xi, eta) = (north_m / rectifying_m(), east_m / rectifying_m());
    let (mut east, mut north) = (eta, xi);
    let mut order = 2.0;
    for coefficient in series {
        east -= coefficient * (order * xi).cos() * (order * eta).sinh();
        north -= coefficient * (order * xi).sin() * (order * eta).cosh();
        order += 2.0;
    }
    let conformal_tan = north.sin() / east.sinh().hypot(north.cos());
    let eccentricity = ECCENTRICITY_SQUARED.sqrt();
    // Newton on the tangent of the latitude (Karney, equations 19 to 21).
    let mut tan = conformal_tan / (1.0 - ECCENTRICITY_SQUARED);
    for _ in 0..4 {
        let secant = tan.hypot(1.0);
        let sigma = (eccentricity * (eccentricity * tan / secant).atanh()).sinh();
        let reached = tan * sigma.hypot(1.0) - sigma * secant;
        let slope = (1.0 - ECCENTRICITY_SQUARED) * secant / (1.0 + (1.0 - ECCENTRICITY_SQUARED) * tan * tan);
        tan += (conformal_tan - reached) / (reached.hypot(1.0) * slope);
    }
    [tan.atan(), east.sinh().atan2(north.cos())]
}

/// The third flattening and its powers.
fn powers() -> [f64; 4] {
    let n = FLATTENING / (2.0 - FLATTENING);
    [n, n * n, n * n * n, n * n * n * n]
}

/// Radius of the circle that is as long as a meridian, metres.
fn rectifying_m() -> f64 {
    let [n, n2, _, n4] = powers();
    SEMI_MAJOR_M / (1.0 + n) * (1.0 + n2 / 4.0 + n4 / 64.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(latitude_deg: f64, longitude_deg: f64) -> Wgs84 {
        Wgs84 { latitude_deg, longitude_deg, height_m: 12.5 }
    }

    #[test]
    fn places_lie_where_proj_puts_them() {
        // echo "11.6 48.2" | cs2cs -d 6 EPSG:4326 +to (the PROJ string below)
        let plane = Plane::at(48.1374, 11.5755);
        let place = plane.project(&at(48.2, 11.6));
        assert!((place - Point3::new(MUNICH[0], MUNICH[1], 12.5)).norm() < 2e-6, "{place}");
        let far = plane.project(&at(49.0, 13.0));
        assert!((far - Point3::new(FAR[0], FAR[1], 12.5)).norm() < 2e-6, "{far}");
        assert_eq!(
            plane.proj_string(),
            "+proj=tmerc +lat_0=48.1374000 +lon_0=11.5755000 +k=1 +x_0=0 +y_0=0 +datum=WGS84 +units=m +vunits=m +no_defs"
        );
    }

    /// What PROJ 9 gives, metres.
    const MUNICH: [f64; 2] = [1_821.243_286, 6_961.009_840];
    const FAR: [f64; 2] = [104_231.737_497, 96_900.286_268];

    #[test]
    fn a_place_survives_the_way_into_the_plane_and_back() {
        for (latitude_deg, longitude_deg) in [(0.0, 0.0), (48.0, 11.0), (-33.9, 151.2), (84.9, -179.9)] {
            let plane = Plane::at(latitude_deg, longitude_deg);
            for (north, east) in [(0.0, 0.0), (0.01, -0.02), (-0.3, 0.9)] {
                let place = at(latitude_deg + north * 0.1, longitude_deg + east);
                let back = plane.unproject(&plane.project(&place));
                assert!((back.latitude_deg - place.latitude_deg).abs() < 1e-11, "{place:?} {back:?}");
                let turn = (back.longitude_deg - place.longitude_deg).rem_euclid(360.0);
                assert!(turn.min(360.0 - turn) < 1e-11, "{place:?} {back:?}");
            }
        }
    }

    #[test]
    fn the_antimeridian_tears_nothing() {
        let plane = Plane::at(-17.0, 179.999);
        let (west, east) = (plane.project(&at(-17.0, 179.9995)), plane.project(&at(-17.0, -179.9995)));
        assert!((east.x - west.x - 106.5).abs() < 0.2, "{west} {east}");
    }
}
