//! Drives without GNSS: they stay in their own frame until they are found on the shared map, in one place only.
//!
//! A drive is sought ([`lanemap_core::fleet::localization`]) once its way is long enough, again as it grows, and again when the
//! map has grown and it was not found. It is sought on all of the map or, where that has more line than
//! `max_localization_km`, not at all: what is unique in a part need not be so in the whole. What was found is kept, so that
//! a restart changes nothing; where a drive is deleted of a cell on which another lies that was found, that one is taken
//! off the map, and sought anew on what is left.
//!
//! Not guaranteed: the same place whenever a drive comes. It is laid on the map as it is then; where that moves by a
//! decimetre later, the drive moves with it when its cell is fused.

use std::collections::BTreeMap;

use lanemap_core::fleet::{
    CellId, Contribution, FleetParams, cell,
    localization::{Ambiguity, AtlasLine, LEAST_WAY_M, LineAtlas, Localization, MapPlace, localize},
};
use serde::{Deserialize, Serialize};

use super::{CellVersion, SharedMap, offer::stored, wire};
use crate::journal::{JournalError, cells::StoredContribution};

/// Growth of its way after which a drive is sought again, metres.
const WAY_GREW_M: f64 = 150.0;
/// Growth of the map after which one that was not found is, metres of line.
const MAP_GREW_M: f64 = 200.0;
/// The same as a share of the map.
const MAP_GREW: f64 = 0.05;

/// Where a drive without GNSS stands.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub enum Alignment {
    /// It is in its own frame, and too short to be sought.
    #[default]
    OwnFrame,
    /// The map has more line than is searched.
    MapTooLarge,
    /// It was found, and is part of the map.
    Aligned {
        /// Standard deviation of its place on the map in the worst direction, metres.
        sigma_m: f64,
        /// Way of it that lies on the map, metres.
        way_m: f64,
    },
    /// Its road does not bend enough to tell where along it the drive is.
    Straight,
    /// It fits in more places than one.
    NotUnique,
    /// It fits nowhere on the map.
    NoFit,
}

/// What is kept of the search for a drive.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct Sought {
    pub(crate) alignment: Alignment,
    /// Length of its way when it was sought last, metres.
    way_m: f64,
    /// Length of the map's lines then, metres.
    map_m: f64,
}

impl Sought {
    pub(crate) fn is_aligned(&self) -> bool {
        matches!(self.alignment, Alignment::Aligned { .. })
    }

    /// Whether a drive whose way is so long is to be sought again.
    fn is_due(&self, way_m: f64, map_m: f64) -> bool {
        way_m >= LEAST_WAY_M && (way_m >= self.way_m + WAY_GREW_M || self.map_grew(map_m))
    }

    /// Whether the map is another than the one on which the drive was not found.
    pub(super) fn map_grew(&self, map_m: f64) -> bool {
        !self.is_aligned() && (map_m - self.map_m).abs() >= MAP_GREW_M.max(MAP_GREW * self.map_m)
    }
}

/// The lines of the shared map as the search has them.
#[derive(Debug, Default)]
pub(super) struct SearchedMap {
    atlas: LineAtlas,
    versions: BTreeMap<CellId, CellVersion>,
}

/// What came of a search.
pub(super) struct Searched {
    pub(super) sought: Sought,
    /// What the drive says to the map, cell by cell, where it was found.
    pub(super) contributions: Vec<StoredContribution>,
}

impl SearchedMap {
    /// Takes what is new in the map.
    fn follow(&mut self, map: &SharedMap) -> Result<(), JournalError> {
        for (cell, record) in map.list() {
            if self.versions.get(&cell) == Some(&record.version) {
                continue;
            }
            let Some(published) = map.get(cell)? else { continue };
            let lines = published.map.lanes.iter().map(|lane| AtlasLine {
                points: wire::positions(lane),
                category_posterior: lane
                    .category_posterior_permille
                    .iter()
                    .map(|share| f64::from(*share) * 1e-3)
                    .collect(),
            });
            self.atlas.put(cell, lines.collect());
            self.versions.insert(cell, CellVersion(published.map.version));
        }
        Ok(())
    }

    /// Seeks a drive, where that is due; `None` where it is not.
    pub(super) fn seek(
        &mut self,
        drive: &Contribution,
        before: Option<Sought>,
        map: &SharedMap,
        most_map_m: f64,
    ) -> Result<Option<Searched>, JournalError> {
        let (way_m, map_m) = (drive.trajectory.last().map_or(0.0, |last| last.arc_m), map.line_m());
        let before = before.unwrap_or_default();
        if !before.is_due(way_m, map_m) {
            return Ok(None);
        }
        if map_m > most_map_m {
            *self = Self::default();
            return Ok(Some(Searched {
                sought: Sought { alignment: Alignment::MapTooLarge, way_m, map_m },
                contributions: Vec::new(),
            }));
        }
        self.follow(map)?;
        let found = localize(drive, &self.atlas, &FleetParams::default());
        let (alignment, contributions) = match found {
            Localization::Aligned(place) => {
                (Alignment::Aligned { sigma_m: place.sigma_m(), way_m: place.way_m }, by_cell(&place)?)
            }
            // Where it was found it stays.
            _ if before.is_aligned() => return Ok(None),
            Localization::NotUnique(Ambiguity::Straight) => (Alignment::Straight, Vec::new()),
            Localization::NotUnique(Ambiguity::Elsewhere) => (Alignment::NotUnique, Vec::new()),
            Localization::NoFit => (Alignment::NoFit, Vec::new()),
            Localization::TooShort => (Alignment::OwnFrame, Vec::new()),
        };
        Ok(Some(Searched { sought: Sought { alignment, way_m, map_m }, contributions }))
    }
}

fn by_cell(place: &MapPlace) -> Result<Vec<StoredContribution>, JournalError> {
    let cells = cell::cut(&place.contribution, &place.georeference).into_iter();
    cells.map(|(cell, part)| stored(cell, &part)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_drive_is_sought_when_it_is_long_enough_and_again_when_it_or_the_map_has_grown() {
        assert!(!Sought::default().is_due(LEAST_WAY_M - 1.0, 5_000.0));
        assert!(Sought::default().is_due(LEAST_WAY_M, 5_000.0));
        let not_found = Sought { alignment: Alignment::NoFit, way_m: 600.0, map_m: 10_000.0 };
        assert!(!not_found.is_due(740.0, 10_400.0));
        assert!(not_found.is_due(750.0, 10_400.0) && not_found.is_due(600.0, 10_500.0));
        let found = Sought { alignment: Alignment::Aligned { sigma_m: 0.2, way_m: 600.0 }, ..not_found };
        assert!(!found.is_due(600.0, 20_000.0), "it stays where it is");
        assert!(found.is_due(750.0, 10_000.0));
    }
}
