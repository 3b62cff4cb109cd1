//! The bases of cells: what is left of their oldest drives, which need not be folded again while they say the same.
//!
//! A base is a pure function of the drives in it, so one that is found under their fingerprint is the one that folding
//! them anew would give. Those used last stay in memory; after a start each is made once more when its cell is dirty.

use std::{collections::BTreeMap, sync::Arc};

use lanemap_core::fleet::{
    Base, CellId, Contribution, DriveId, FleetParams, Fused, are_enough_apart, by_seniority, fold, split_to_fold,
};
use quick_cache::sync::Cache;

use super::{beginnings::Beginnings, cell_record::fingerprint};
use crate::{
    journal::{
        JournalError,
        cells::{ContributionFact, Facts},
    },
    session::SessionId,
};

/// Bases that are kept.
const MOST_BASES: usize = 32;

/// The bases used last, by cell and what was folded.
#[derive(Debug)]
pub(super) struct Bases {
    known: Cache<(CellId, u64), Arc<Base>>,
    beginnings: Beginnings,
}

impl Bases {
    pub(super) fn new() -> Self {
        Self { known: Cache::new(MOST_BASES), beginnings: Beginnings::new() }
    }

    /// Fuses a cell as `lanemap_core::fleet::fuse` does, and reads and folds no drive again that is in a base.
    pub(super) fn fuse(
        &self,
        cell: CellId,
        facts: &Facts,
        params: &FleetParams,
        read: impl Fn(SessionId) -> Result<Option<Contribution>, JournalError>,
    ) -> Result<Fused, JournalError> {
        let anchor = cell.anchor();
        let mut ordered: Vec<(ContributionFact, SessionId)> =
            facts.iter().map(|(session, fact)| (*fact, *session)).collect();
        ordered.sort_unstable();
        let mut known = self.known(cell, &ordered).into_iter();
        let (mut base, mut folded, contributions) = loop {
            let (base, folded) = known.next().unwrap_or_default();
            let younger = ordered[folded..].iter();
            let read = younger.map(|(_, session)| read(*session)?.ok_or_else(|| missing(cell)));
            let contributions = read.collect::<Result<Vec<Contribution>, JournalError>>()?;
            // A drive that was taken out may have been one of the crowd that let the older ones be folded.
            if folded == 0 || are_enough_apart(&by_seniority(&contributions), &anchor, params) {
                break (base, folded, contributions);
            }
        };
        let ordered_contributions = by_seniority(&contributions);
        let mut rest = ordered_contributions.as_slice();
        while let Some((oldest, younger)) = split_to_fold(rest, &anchor, params) {
            base = Arc::new(fold(&base, oldest, &anchor, params));
            folded += oldest.len();
            self.known.insert((cell, print_of(&ordered[..folded])), Arc::clone(&base));
            rest = younger;
        }
        let by_drive: BTreeMap<DriveId, ContributionFact> =
            ordered[folded..].iter().map(|(fact, _)| (fact.drive, *fact)).collect();
        let facts = rest.iter().filter_map(|drive| by_drive.get(&drive.drive).copied()).collect();
        Ok(self.beginnings.fuse(cell, (print_of(&ordered[..folded]), &base), (facts, rest), params))
    }

    /// The bases that are known, that of the most drives first, with their numbers.
    fn known(&self, cell: CellId, ordered: &[(ContributionFact, SessionId)]) -> Vec<(Arc<Base>, usize)> {
        let of = |folded: usize| Some((self.known.get(&(cell, print_of(&ordered[..folded])))?, folded));
        (1..=ordered.len()).rev().filter_map(of).collect()
    }
}

pub(super) fn missing(cell: CellId) -> JournalError {
    JournalError::Decode { what: format!("a contribution to cell {cell}"), reason: "it is not there".to_owned() }
}

fn print_of(ordered: &[(ContributionFact, SessionId)]) -> u64 {
    fingerprint(ordered.iter().map(|(fact, _)| fact))
}

#[cfg(test)]
pub(super) mod tests {
    use std::sync::atomic::{AtomicUsize, Ordering};

    use lanemap_core::{
        Category, ControlPoint, EndRule, GnssFix, LaneId, MapLane, Sensor, TimestampNs,
        fleet::{DriveId, PlacedBy, TrajectoryPoint, fuse},
    };
    use nalgebra::{Matrix3, Point3};

    use super::*;

    pub(in crate::fuse) const CELL: (u32, u32) = (8_718, 5_685);

    /// A drive of 90 m to the east with one line at its left.
    pub(in crate::fuse) fn drive(number: u64) -> Contribution {
        let anchor = CellId::new(CELL.0, CELL.1).unwrap().anchor();
        let way = (0..30_i32).map(|i| f64::from(i) * 3.0);
        let trajectory = way.clone().map(|x| {
            let place = anchor.wgs84_from_enu(&Point3::new(x, 0.1 * number as f64, 500.0));
            TrajectoryPoint {
                time: TimestampNs(0),
                arc_m: x,
                position: Point3::new(x, 0.0, 0.0),
                yaw_rad: 0.0,
                motion_variance_m2: 1e-4,
                turn_variance_rad2: 1e-6,
                fix: Some(GnssFix {
                    latitude_deg: place.latitude_deg,
                    longitude_deg: place.longitude_deg,
                    height_m: place.height_m,
                    horizontal_sigma_m: 1.0,
                    vertical_sigma_m: 2.0,
                    yaw_enu_rad: Some(0.0),
                }),
                hidden: vec![],
            }
        });
        let points =
            way.map(|x| ControlPoint { position: Point3::new(x, 1.75, 0.0), covariance: Matrix3::identity() * 1e-3 });
        let lane = MapLane {
            id: LaneId(1),
            category: Category::WhiteSolid,
            category_posterior: vec![1.0 / 15.0; 15],
            category_stretches: vec![],
            control_points: points.collect(),
            ends: EndRule::Reflected,
            drawn_from: 0.0,
            drawn_to: 29.0,
            existence: 0.9,
            observations: 30,
            first_seen: TimestampNs(0),
            last_seen: TimestampNs(9),
        };
        Contribution {
            drive: DriveId(number),
            started: TimestampNs(i64::try_from(number).unwrap()),
            sensor: Sensor::default(),
            placed_by: PlacedBy::Receiver,
            trajectory: trajectory.collect(),
            lanes: vec![lane],
        }
    }

    #[test]
    fn a_cell_fused_onto_a_known_base_is_the_cell_fused_from_all_and_reads_the_younger_only() {
        let (params, cell) = (FleetParams::default(), CellId::new(CELL.0, CELL.1).unwrap());
        let count = params.drives_apart + params.drives_per_fold + 2;
        let drives: Vec<Contribution> = (0..count as u64).map(drive).collect();
        let session = |number: usize| SessionId::from_key((number as u64).to_be_bytes());
        let facts: Facts = drives
            .iter()
            .enumerate()
            .map(|(number, drive)| {
                (session(number), ContributionFact { started: drive.started, drive: drive.drive, digest: 7 })
            })
            .collect();
        let reads = AtomicUsize::new(0);
        let read = |asked: SessionId| {
            reads.fetch_add(1, Ordering::Relaxed);
            Ok((0..count).find(|number| session(*number) == asked).map(|number| drives[number].clone()))
        };
        let bases = Bases::new();
        let whole = fuse(&drives, &cell.anchor(), &params);
        assert!(!whole.lanes.is_empty());
        assert_eq!(bases.fuse(cell, &facts, &params, read).unwrap().map, whole);
        assert_eq!(reads.swap(0, Ordering::Relaxed), count);
        assert_eq!(bases.fuse(cell, &facts, &params, read).unwrap().map, whole);
        assert_eq!(reads.load(Ordering::Relaxed), count - params.drives_per_fold);
    }
}
