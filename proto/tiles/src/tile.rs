//! Tiles of the web-mercator plane, and the cells whose lines they show.

use std::{fmt, str::FromStr};

use lanemap_core::{
    fleet::{CellId, cell},
    geometry::georeference::Wgs84,
};
use thiserror::Error;

use crate::{BUFFER, EXTENT, mercator::world_from_wgs84};

/// A tile: a square of the web-mercator plane, counted from its north-western corner.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct TileId {
    z: u8,
    x: u32,
    y: u32,
}

/// Why a text names no tile.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
#[error("tile {text:?} is not z/x/y, with z in 0 ..= {most_zoom}, x and y below 2^z", most_zoom = TileId::MOST_ZOOM)]
pub struct TileIdError {
    /// The text.
    pub text: String,
}

impl TileId {
    /// Largest zoom.
    pub const MOST_ZOOM: u8 = 22;

    /// The tile of a zoom in column `x` (from the antimeridian to the east) and row `y` (from the north); `None` beyond the
    /// last, or beyond [`TileId::MOST_ZOOM`].
    #[must_use]
    pub fn new(z: u8, x: u32, y: u32) -> Option<Self> {
        (z <= Self::MOST_ZOOM && x < 1 << z && y < 1 << z).then_some(Self { z, x, y })
    }

    /// The tile of a zoom in which a place lies; `None` within 5 degrees of a pole, where web mercator ends.
    #[must_use]
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "in 0 .. 2^22")]
    pub fn containing(z: u8, place: &Wgs84) -> Option<Self> {
        let tiles = f64::from(1_u32.checked_shl(z.into())?);
        let world = world_from_wgs84(place);
        let (x, y) = (world.x.rem_euclid(1.0) * tiles, world.y * tiles);
        (x.is_finite() && y >= 0.0 && y < tiles).then(|| Self::new(z, x as u32, y as u32))?
    }

    /// Zoom.
    #[must_use]
    pub fn z(self) -> u8 {
        self.z
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

    /// Its north-western corner on the lattice of its zoom: see [`crate::lattice`].
    #[must_use]
    pub fn corner(self) -> [i64; 2] {
        [self.x, self.y].map(|number| i64::from(number) * i64::from(EXTENT))
    }

    /// The cells whose lines may enter the tile or its buffer, in their order.
    #[must_use]
    pub fn cells_touched(self) -> Vec<CellId> {
        self.cells_within(i64::from(BUFFER))
    }

    /// The cells that have some of the tile's own area, in their order: one from zoom 14 on.
    #[must_use]
    pub fn cells_covered(self) -> Vec<CellId> {
        self.cells_within(0)
    }

    fn cells_within(self, buffer: i64) -> Vec<CellId> {
        let cells = 1_i64 << cell::ZOOM;
        // In units of the finer one of both grids, so that every border is a whole number.
        let cell_units = i64::from(EXTENT) << self.z.saturating_sub(cell::ZOOM);
        let tile_units = i64::from(EXTENT) << cell::ZOOM.saturating_sub(self.z);
        let buffer = buffer << cell::ZOOM.saturating_sub(self.z);
        let touched = |number: u32| {
            let from = i64::from(number) * tile_units;
            (from - buffer).div_euclid(cell_units)..=(from + tile_units + buffer - 1).div_euclid(cell_units)
        };
        let mut found: Vec<CellId> = touched(self.x)
            .flat_map(|x| touched(self.y).map(move |y| (x.rem_euclid(cells), y)))
            .filter_map(|(x, y)| CellId::new(u32::try_from(x).ok()?, u32::try_from(y).ok()?))
            .collect();
        found.sort_unstable();
        found.dedup();
        found
    }
}

impl fmt::Display for TileId {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(formatter, "{}/{}/{}", self.z, self.x, self.y)
    }
}

impl FromStr for TileId {
    type Err = TileIdError;

    fn from_str(text: &str) -> Result<Self, TileIdError> {
        let mut parts = text.split('/');
        let mut read = || {
            let (z, x, y) = (digits(parts.next()?)?, digits(parts.next()?)?, digits(parts.next()?)?);
            Self::new(u8::try_from(z).ok()?, x, y).filter(|_| parts.next().is_none())
        };
        read().ok_or_else(|| TileIdError { text: text.to_owned() })
    }
}

/// A number as addresses write it: digits only, without a sign.
fn digits(text: &str) -> Option<u32> {
    text.parse().ok().filter(|_| text.bytes().all(|byte| byte.is_ascii_digit()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_tile_of_the_cells_zoom_covers_its_cell_and_touches_all_around_it() {
        let (tile, cell) = (TileId::new(14, 8_718, 5_685).unwrap(), CellId::new(8_718, 5_685).unwrap());
        assert_eq!(tile.cells_covered(), [cell]);
        let mut around = cell.neighbours();
        around.push(cell);
        around.sort_unstable();
        assert_eq!(tile.cells_touched(), around);
    }

    #[test]
    fn a_tile_within_a_cell_touches_its_neighbours_only_at_their_border() {
        let inside = TileId::new(16, 8_718 * 4 + 1, 5_685 * 4 + 2).unwrap();
        assert_eq!(inside.cells_touched(), [CellId::new(8_718, 5_685).unwrap()]);
        let western = TileId::new(16, 8_718 * 4, 5_685 * 4 + 2).unwrap();
        let cells = [CellId::new(8_717, 5_685).unwrap(), CellId::new(8_718, 5_685).unwrap()];
        assert_eq!(western.cells_touched(), cells);
    }

    #[test]
    fn a_wide_tile_covers_sixteen_cells_and_touches_those_over_the_antimeridian() {
        let tile = TileId::new(12, 0, 1_421).unwrap();
        assert_eq!(tile.cells_covered().len(), 16);
        assert_eq!(tile.cells_touched().len(), 36);
        assert!(tile.cells_touched().contains(&CellId::new((1 << 14) - 1, 5_685).unwrap()));
    }

    #[test]
    fn a_place_lies_in_the_tile_of_its_cell() {
        let munich = Wgs84 { latitude_deg: 48.1374, longitude_deg: 11.5755, height_m: 519.0 };
        assert_eq!(TileId::containing(14, &munich), TileId::new(14, 8_718, 5_685));
        assert_eq!(TileId::containing(14, &Wgs84 { latitude_deg: 89.0, ..munich }), None);
        assert_eq!(TileId::containing(40, &munich), None);
    }

    #[test]
    fn a_text_that_names_no_tile_is_refused() {
        for text in ["", "14/1", "14/1/2/3", "14/16384/0", "14/0/16384", "23/0/0", "14/-1/0", "14/+1/0", "a/b/c"] {
            assert!(text.parse::<TileId>().is_err(), "{text}");
        }
        assert_eq!("14/16383/0".parse(), Ok(TileId::new(14, 16_383, 0).unwrap()));
    }
}
