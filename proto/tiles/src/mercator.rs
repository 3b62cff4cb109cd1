//! The web-mercator plane: a square of side 1 with the origin in the north-west, x to the east and y to the south
//! (EPSG:3857, scaled and turned as tiles are counted).

use std::f64::consts::PI;

use lanemap_core::geometry::georeference::Wgs84;
use nalgebra::Point2;

/// A place on the plane, x and y in `[0, 1]`; y lies beyond them within 5 degrees of a pole.
#[must_use]
pub fn world_from_wgs84(place: &Wgs84) -> Point2<f64> {
    let y = 0.5 - place.latitude_deg.to_radians().tan().asinh() / (2.0 * PI);
    Point2::new(place.longitude_deg / 360.0 + 0.5, y)
}

/// Longitude and latitude of a point of the plane, degrees.
#[must_use]
pub fn degrees_from_world(point: &Point2<f64>) -> [f64; 2] {
    [(point.x - 0.5) * 360.0, (PI * (1.0 - 2.0 * point.y)).sinh().atan().to_degrees()]
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn a_place_survives_the_way_over_the_plane(longitude_deg in -180.0..180.0f64, latitude_deg in -85.0..85.0f64) {
            let world = world_from_wgs84(&Wgs84 { latitude_deg, longitude_deg, height_m: 0.0 });
            let [longitude, latitude] = degrees_from_world(&world);
            prop_assert!((longitude - longitude_deg).abs() < 1e-12 * 180.0);
            prop_assert!((latitude - latitude_deg).abs() < 1e-10);
        }
    }

    #[test]
    fn the_corner_of_the_plane_is_where_web_mercator_ends() {
        let [longitude, latitude] = degrees_from_world(&Point2::origin());
        assert!((longitude + 180.0).abs() < 1e-12 && (latitude - 85.051_128_779_806_6).abs() < 1e-9);
    }
}
