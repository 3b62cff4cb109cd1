//! A copy of the shared map: cells, and how far it has come.

use std::collections::BTreeMap;

use lanemap_proto::{cell_map::apply, v1};

/// The cells that were told, each in one version, and the position up to which all was told. Kept in memory: as large as what is followed.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct MapCopy {
    cells: BTreeMap<String, v1::CellMap>,
    position: String,
    /// Cells that were fetched in a version that has not been told yet.
    ahead: BTreeMap<String, u64>,
}

/// What a copy needs to take a change.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Need {
    /// Nothing: it has it.
    Nothing,
    /// What changed since the version that it has.
    ChangesSince(u64),
}

impl MapCopy {
    /// The cells, by their names; those without lines among them.
    #[must_use]
    pub fn cells(&self) -> &BTreeMap<String, v1::CellMap> {
        &self.cells
    }

    /// One cell, by its name.
    #[must_use]
    pub fn cell(&self, name: &str) -> Option<&v1::CellMap> {
        self.cells.get(name)
    }

    /// The revision of the map that this is, byte for byte (of the cells that are followed); `None` while it is between
    /// two.
    #[must_use]
    pub fn revision(&self) -> Option<u64> {
        self.ahead.is_empty().then(|| self.position.parse().ok()).flatten()
    }

    /// How far it has been told; empty: nothing yet.
    #[must_use]
    pub fn position(&self) -> &str {
        &self.position
    }

    pub(crate) fn has_come_to(&mut self, position: String) {
        self.position = position;
    }

    /// Takes a change with what comes with it, and says what it needs beside.
    pub(crate) fn hear(&mut self, changed: &v1::CellChanged) -> Need {
        let held = self.version(&changed.cell);
        if changed.to_version <= held {
            self.note_told(changed);
            return Need::Nothing;
        }
        match &changed.changes {
            Some(changes) if changes.from_version == 0 || changes.from_version == held => {
                self.take(changes);
                self.note_told(changed);
                Need::Nothing
            }
            _ => Need::ChangesSince(held),
        }
    }

    /// Takes what was fetched for a change.
    pub(crate) fn fetched(&mut self, changed: &v1::CellChanged, changes: &v1::CellChanges) {
        self.take(changes);
        self.note_told(changed);
    }

    /// Takes a cell whole, for a change.
    pub(crate) fn fetched_whole(&mut self, changed: &v1::CellChanged, map: v1::CellMap) {
        self.cells.insert(changed.cell.clone(), map);
        self.note_told(changed);
    }

    /// Forgets all: the map is told anew.
    pub(crate) fn reset(&mut self) {
        *self = Self::default();
    }

    fn version(&self, cell: &str) -> u64 {
        self.cells.get(cell).map_or(0, |cell| cell.version)
    }

    fn take(&mut self, changes: &v1::CellChanges) {
        let empty = v1::CellMap::default();
        let before = self.cells.get(&changes.cell).filter(|_| changes.from_version > 0).unwrap_or(&empty);
        let after = apply(before, changes);
        self.cells.insert(changes.cell.clone(), after);
    }

    fn note_told(&mut self, changed: &v1::CellChanged) {
        let held = self.version(&changed.cell);
        if held > changed.to_version {
            self.ahead.insert(changed.cell.clone(), held);
        } else {
            self.ahead.remove(&changed.cell);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn changes(from_version: u64, to_version: u64, upserted: &[&str], removed: &[&str]) -> v1::CellChanges {
        let lane = |id: &&str| v1::FusedLane { id: (*id).to_owned(), ..v1::FusedLane::default() };
        let name = |id: &&str| v1::LaneName { id: (*id).to_owned(), ..v1::LaneName::default() };
        v1::CellChanges {
            cell: "14-1-1".to_owned(),
            from_version,
            to_version,
            anchor: None,
            upserted: upserted.iter().map(lane).collect(),
            removed: removed.iter().map(name).collect(),
        }
    }

    fn changed(from_version: u64, to_version: u64, changes: Option<v1::CellChanges>) -> v1::CellChanged {
        v1::CellChanged { cell: "14-1-1".to_owned(), from_version, to_version, changes, ..v1::CellChanged::default() }
    }

    fn lanes(copy: &MapCopy) -> Vec<&str> {
        copy.cells()["14-1-1"].lanes.iter().map(|lane| lane.id.as_str()).collect()
    }

    #[test]
    fn changes_apply_to_the_version_that_they_were_made_from_and_to_no_other() {
        let mut copy = MapCopy::default();
        assert_eq!(copy.hear(&changed(0, 2, Some(changes(0, 2, &["b", "a"], &[])))), Need::Nothing);
        assert_eq!((lanes(&copy), copy.cells()["14-1-1"].version), (vec!["a", "b"], 2));
        assert_eq!(copy.hear(&changed(3, 4, Some(changes(3, 4, &["c"], &[])))), Need::ChangesSince(2));
        assert_eq!(lanes(&copy), ["a", "b"]);
        assert_eq!(copy.hear(&changed(2, 4, None)), Need::ChangesSince(2));
        assert_eq!(copy.hear(&changed(2, 4, Some(changes(2, 4, &["c"], &["a"])))), Need::Nothing);
        assert_eq!(lanes(&copy), ["b", "c"]);
        assert_eq!(copy.hear(&changed(2, 4, Some(changes(2, 4, &["x"], &[])))), Need::Nothing, "it is told again");
        assert_eq!(copy.hear(&changed(1, 9, Some(changes(0, 9, &["d"], &[])))), Need::Nothing, "it comes whole");
        assert_eq!(lanes(&copy), ["d"]);
    }

    #[test]
    fn a_copy_that_ran_ahead_is_no_revision_until_that_is_told() {
        let mut copy = MapCopy::default();
        copy.has_come_to("3".to_owned());
        assert_eq!(copy.revision(), Some(3));
        copy.fetched(&changed(0, 2, None), &changes(0, 5, &["a"], &[]));
        copy.has_come_to("7".to_owned());
        assert_eq!(copy.revision(), None);
        assert_eq!(copy.hear(&changed(2, 5, None)), Need::Nothing);
        assert_eq!(copy.revision(), Some(7));
        copy.has_come_to("7-12-9".to_owned());
        assert_eq!(copy.revision(), None, "several changes make the next");
    }
}
