//! Cells: the pieces in which the shared map is fused, stored and served.
//!
//! A cell is a web-mercator tile at zoom 14: about 2 km at middle latitudes. Its geometry is kept east-north-up at the tile's
//! centre, at height 0 of the ellipsoid. [`cut`] gives the part of a drive's contribution that a cell is fused from,
//! which reaches [`MARGIN_M`] beyond its border, so that the cells on both sides of a border know the same lines there.
//!
//! ```
//! use lanemap_core::{fleet::cell::CellId, geometry::georeference::Wgs84};
//!
//! let munich = Wgs84 { latitude_deg: 48.1374, longitude_deg: 11.5755, height_m: 519.0 };
//! let cell = CellId::containing(&munich).expect("it is far from the poles");
//! assert_eq!(cell.to_string(), "14-8718-5685");
//! ```

mod cut;

use std::{f64::consts::PI, fmt, str::FromStr};

use serde::{Deserialize, Serialize};
use thiserror::Error;

pub use cut::{MARGIN_M, cut};

use crate::geometry::georeference::{Anchor, Wgs84};

/// Zoom of the tiles that are cells.
pub const ZOOM: u8 = 14;
/// Tiles in a row.
const TILES: u32 = 1 << ZOOM;
/// Circumference of the web-mercator sphere, metres.
const CIRCUMFERENCE_M: f64 = 2.0 * PI * 6_378_137.0;

/// A cell: a web-mercator tile at zoom 14. The smaller of two neighbours owns their border.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct CellId {
    x: u32,
    y: u32,
}

/// The borders of a tile, degrees.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CellBounds {
    /// Western border.
    pub west: f64,
    /// Southern border.
    pub south: f64,
    /// Eastern border.
    pub east: f64,
    /// Northern border.
    pub north: f64,
}

/// Why a text names no cell.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
#[error("cell {text:?} is not 14-x-y, with x and y in 0 ..= 16383")]
pub struct CellIdError {
    /// The text.
    pub text: String,
}

/// A place in units of tiles, from the north-western corner of the map.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct TilePlace {
    pub(super) x: f64,
    pub(super) y: f64,
}

impl TilePlace {
    /// `None` beyond web mercator, within 5 degrees of a pole.
    pub(super) fn of(place: &Wgs84) -> Option<Self> {
        let tiles = f64::from(TILES);
        let x = (place.longitude_deg + 180.0) / 360.0 * tiles;
        let y = (1.0 - place.latitude_deg.to_radians().tan().asinh() / PI) / 2.0 * tiles;
        (x.is_finite() && y >= 0.0 && y < tiles).then_some(Self { x: x.rem_euclid(tiles), y })
    }
}

impl CellId {
    /// The cell in column `x` (from the antimeridian to the east) and row `y` (from the north); `None` beyond the last.
    #[must_use]
    pub fn new(x: u32, y: u32) -> Option<Self> {
        (x < TILES && y < TILES).then_some(Self { x, y })
    }

    /// The cell in which a place lies; `None` within 5 degrees of a pole, where web mercator ends.
    #[must_use]
    pub fn containing(place: &Wgs84) -> Option<Self> {
        let place = TilePlace::of(place)?;
        Self::new(whole(place.x).min(TILES - 1), whole(place.y))
    }

    /// Column, from the antimeridian to the east.
    #[must_use]
    pub fn x(self) -> u32 {
        self.x
    }

    /// Row, from the north.
    #[must_use]
    pub fn y(self) -> u32 {
        self.y
    }

    /// Big-endian bytes: keys of a store that sort as the cells do.
    #[must_use]
    pub fn to_key(self) -> [u8; 8] {
        let mut key = [0; 8];
        key[..4].copy_from_slice(&self.x.to_be_bytes());
        key[4..].copy_from_slice(&self.y.to_be_bytes());
        key
    }

    /// The cell of [`CellId::to_key`]'s bytes; `None` where they are no cell's.
    #[must_use]
    pub fn from_key(key: [u8; 8]) -> Option<Self> {
        let half = |at: usize| u32::from_be_bytes([key[at], key[at + 1], key[at + 2], key[at + 3]]);
        Self::new(half(0), half(4))
    }

    /// Its borders.
    #[must_use]
    pub fn bounds(self) -> CellBounds {
        let longitude = |x: f64| x / f64::from(TILES) * 360.0 - 180.0;
        let (x, y) = (f64::from(self.x), f64::from(self.y));
        CellBounds {
            west: longitude(x),
            south: latitude_deg(y + 1.0),
            east: longitude(x + 1.0),
            north: latitude_deg(y),
        }
    }

    /// Origin of its east-north-up frame: the middle of the tile, on the ellipsoid.
    #[must_use]
    pub fn anchor(self) -> Anchor {
        let CellBounds { west, east, .. } = self.bounds();
        let latitude_deg = latitude_deg(f64::from(self.y) + 0.5);
        Anchor::new(Wgs84 { latitude_deg, longitude_deg: 0.5 * (west + east), height_m: 0.0 })
    }

    /// Whether a place lies in it; of its borders, the northern and the western are its own.
    #[must_use]
    pub fn contains(self, place: &Wgs84) -> bool {
        Self::containing(place) == Some(self)
    }

    /// The cells around it, in their order; 5 in the first and the last row, else 8.
    #[must_use]
    pub fn neighbours(self) -> Vec<Self> {
        let columns = [TILES - 1, 0, 1].map(|step| (self.x + step) % TILES);
        let rows = self.y.saturating_sub(1)..=(self.y + 1).min(TILES - 1);
        let mut around: Vec<Self> = columns
            .into_iter()
            .flat_map(|x| rows.clone().map(move |y| Self { x, y }))
            .filter(|cell| *cell != self)
            .collect();
        around.sort_unstable();
        around
    }
}

impl fmt::Display for CellId {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(formatter, "{ZOOM}-{}-{}", self.x, self.y)
    }
}

impl FromStr for CellId {
    type Err = CellIdError;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let number =
            |digits: &str| digits.bytes().all(|byte| byte.is_ascii_digit()).then(|| digits.parse().ok()).flatten();
        let mut parts = text.split('-').map(number);
        let cell = match (parts.next(), parts.next(), parts.next(), parts.next()) {
            (Some(Some(zoom)), Some(Some(x)), Some(Some(y)), None) if zoom == u32::from(ZOOM) => Self::new(x, y),
            _ => None,
        };
        cell.ok_or_else(|| CellIdError { text: text.chars().take(64).collect() })
    }
}

/// Latitude of a row's northern border, degrees.
fn latitude_deg(y: f64) -> f64 {
    (PI * (1.0 - 2.0 * y / f64::from(TILES))).sinh().atan().to_degrees()
}

/// Metres as a share of a tile's side at a latitude.
fn tiles_of(metres: f64, latitude_deg: f64) -> f64 {
    metres * f64::from(TILES) / (CIRCUMFERENCE_M * latitude_deg.to_radians().cos())
}

#[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "the cast saturates, and NaN becomes 0")]
fn whole(tiles: f64) -> u32 {
    tiles as u32
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn at(latitude_deg: f64, longitude_deg: f64) -> Wgs84 {
        Wgs84 { latitude_deg, longitude_deg, height_m: 0.0 }
    }

    #[test]
    fn known_places_lie_in_the_tiles_in_which_every_slippy_map_has_them() {
        // Brandenburg Gate, Sydney Opera House, Christ the Redeemer, and the corner where the equator meets Greenwich.
        for (place, x, y) in [
            (at(52.516_272, 13.377_722), 8_800, 5_373),
            (at(-33.856_784, 151.215_297), 15_073, 9_831),
            (at(-22.951_916, -43.210_487), 6_225, 9_265),
            (at(0.0, 0.0), 8_192, 8_192),
        ] {
            assert_eq!(CellId::containing(&place), CellId::new(x, y), "{place:?}");
        }
    }

    #[test]
    fn beyond_web_mercator_there_is_no_cell() {
        assert_eq!(CellId::containing(&at(85.06, 0.0)), None);
        assert_eq!(CellId::containing(&at(-90.0, 0.0)), None);
        assert!(CellId::containing(&at(85.05, 180.0)).is_some());
    }

    #[test]
    fn a_cell_of_the_last_column_lies_beside_the_first() {
        let last = CellId::new(TILES - 1, 100).unwrap();
        assert!(last.neighbours().contains(&CellId::new(0, 100).unwrap()));
        assert_eq!(last.neighbours().len(), 8);
        assert_eq!(CellId::new(5, 0).unwrap().neighbours().len(), 5);
    }

    #[test]
    fn a_text_that_names_no_cell_is_refused() {
        for text in ["", "14-1", "13-1-1", "14-1-16384", "14-1-1-1", "14-+1-1", "14--1-1"] {
            assert!(text.parse::<CellId>().is_err(), "{text}");
        }
    }

    proptest! {
        #[test]
        fn a_cell_holds_its_anchor_and_survives_text_and_key(x in 0..TILES, y in 0..TILES) {
            let cell = CellId::new(x, y).unwrap();
            prop_assert!(cell.contains(&cell.anchor().place()));
            prop_assert_eq!(cell.to_string().parse::<CellId>(), Ok(cell));
            prop_assert_eq!(CellId::from_key(cell.to_key()), Some(cell));
        }

        #[test]
        fn every_place_within_its_borders_is_in_a_cell(
            x in 0..TILES, y in 0..TILES, across in 0.001..0.999f64, down in 0.001..0.999f64,
        ) {
            let cell = CellId::new(x, y).unwrap();
            let CellBounds { west, south, east, north } = cell.bounds();
            prop_assert!(cell.contains(&at(north + (south - north) * down, west + (east - west) * across)));
        }
    }
}
