//! Fusion: contributions in, one map out. A pure function, whatever the order in which contributions arrived.
//!
//! Drives are taken in the order of their starts. Each is laid on the lines so far and adds to them; whenever their number
//! has doubled, what is known is spread over them. Then all corrections are solved together, and the lines are made again
//! from them, a few times over.
//!
//! So that a place that thousands of drives pass costs no more than one that a few do, the oldest are folded, a crowd at a
//! time, into a [`Base`]: lines that stay as they are, with the information of all of them, as one more drive that may
//! still be shifted as a whole. Which drives are folded depends on their order of seniority alone, so that the
//! map is the same function of the set of contributions.

mod kept_apart;
mod laying;
mod spreading;

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use super::{
    alignment::{Eliminations, RobustScales, Sighting, Target, align},
    base::Base,
    beginning::Beginning,
    bridging::Parts,
    change::MapChange,
    continuity::run_on,
    contribution::{Contribution, DriveId, PlacedBy},
    correction::{Correction, CorrectionWalk},
    credibility::{DOUBTED, learned_doubts},
    crowding::first_crowd,
    growth::{Growing, Pieces},
    line::{FusedLane, Lines},
    params::FleetParams,
    prepared::{PreparedDrive, PreparedPass, Restraints, normal_of},
    receivers::learned_shape_share,
    settled::Settled,
    ways::Ways,
};
pub(super) use laying::Laying;

use crate::geometry::georeference::Anchor;

/// How a drive lies in the map.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct FusedDrive {
    /// The drive.
    pub drive: DriveId,
    /// Its correction; `None` where it was kept apart: it fits nowhere, at more than one place, or has no fix.
    pub correction: Option<Correction>,
}

/// A map of many drives.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct FusedMap {
    /// Its lines, in the order of their names.
    pub lanes: Vec<FusedLane>,
    /// What happened to the road while drives watched, in the order in which it came to be believed.
    pub changes: Vec<MapChange>,
    /// Its drives that are not folded, in the order of their seniority.
    pub drives: Vec<FusedDrive>,
    /// Number of drives that are folded.
    pub folded_drives: u32,
}

/// Fuses contributions into one map, east-north-up metres at `anchor`.
///
/// Of two contributions of one drive the later in the slice counts.
#[must_use]
pub fn fuse(contributions: &[Contribution], anchor: &Anchor, params: &FleetParams) -> FusedMap {
    let ordered = by_seniority(contributions);
    let mut base = Base::default();
    let mut rest = ordered.as_slice();
    while let Some((oldest, younger)) = split_to_fold(rest, anchor, params) {
        base = fold(&base, oldest, anchor, params);
        rest = younger;
    }
    fuse_onto(&base, rest, anchor, params)
}

/// Contributions by seniority, one per drive.
#[must_use]
pub fn by_seniority(contributions: &[Contribution]) -> Vec<&Contribution> {
    let with_way = contributions.iter().filter(|contribution| !contribution.trajectory.is_empty());
    let by_drive: BTreeMap<DriveId, &Contribution> =
        with_way.map(|contribution| (contribution.drive, contribution)).collect();
    let mut ordered: Vec<&Contribution> = by_drive.into_values().collect();
    ordered.sort_by_key(|contribution| contribution.seniority());
    ordered
}

/// The drives that are folded next, and the others; `None` where none is to be. Both are crowds (`crowding`).
#[must_use]
pub fn split_to_fold<'a, 'c>(
    ordered: &'a [&'c Contribution],
    anchor: &Anchor,
    params: &FleetParams,
) -> Option<(&'a [&'c Contribution], &'a [&'c Contribution])> {
    let oldest = first_crowd(ordered, anchor, params.drives_per_fold)?;
    let (oldest, younger) = ordered.split_at(oldest);
    are_enough_apart(younger, anchor, params).then_some((oldest, younger))
}

/// Whether so many drives are kept apart that older ones may be folded.
#[must_use]
pub fn are_enough_apart(ordered: &[&Contribution], anchor: &Anchor, params: &FleetParams) -> bool {
    first_crowd(ordered, anchor, params.drives_apart).is_some()
}

/// Folds the next drives into a base.
#[must_use]
pub fn fold(base: &Base, drives: &[&Contribution], anchor: &Anchor, params: &FleetParams) -> Base {
    let prepared: Vec<PreparedDrive<'_>> =
        drives.iter().map(|contribution| PreparedDrive::new(contribution, anchor, params)).collect();
    let mut fusion = Fusion::new(base, &prepared, params);
    fusion.place_all(Laying::default(), None);
    fusion.align_and_draw();
    fusion.folded_base(&fusion.beliefs(), &fusion.paints())
}

/// Fuses the drives that are kept apart onto a base.
#[must_use]
pub fn fuse_onto(base: &Base, drives: &[&Contribution], anchor: &Anchor, params: &FleetParams) -> FusedMap {
    fuse_from(None, base, drives, anchor, params, Keep::default()).map
}

/// What is to be kept of a fusion beside its map.
#[derive(Clone, Copy, Debug, Default)]
pub struct Keep {
    /// The beginning before this drive; there is none before the drives of the beginning that a fusion goes on from.
    pub beginning_before: Option<usize>,
    /// What live drives may be laid on.
    pub settled: bool,
}

/// A map, and what was kept of its fusion.
#[derive(Clone, Debug)]
pub struct Fused {
    /// The map.
    pub map: FusedMap,
    /// What became of its first drives, as asked for.
    pub beginning: Option<Beginning>,
    /// What live drives may be laid on, as asked for.
    pub settled: Option<Settled>,
}

/// As [`fuse_onto`], to the bit, going on from a beginning of the same base and the same first drives, if there is one.
#[must_use]
pub fn fuse_from(
    beginning: Option<&Beginning>,
    base: &Base,
    drives: &[&Contribution],
    anchor: &Anchor,
    params: &FleetParams,
    keep: Keep,
) -> Fused {
    // What is spread once so many lie is not where no other follows.
    let beginning = beginning.filter(|beginning| beginning.drives() < drives.len());
    let known = |drive: usize| beginning.and_then(|beginning| beginning.by_gnss(drive));
    let prepared = drives.iter().enumerate().map(|(number, contribution)| match known(number) {
        Some(by_gnss) => PreparedDrive::of(contribution, by_gnss.clone(), anchor, params),
        None => PreparedDrive::new(contribution, anchor, params),
    });
    let prepared: Vec<PreparedDrive<'_>> = prepared.collect();
    let mut fusion = Fusion::new(base, &prepared, params);
    let laying = beginning.map_or_else(Laying::default, |beginning| fusion.go_on(beginning));
    let beginning = fusion.place_all(laying, keep.beginning_before);
    fusion.align_and_draw();
    let (beliefs, paints) = (fusion.beliefs(), fusion.paints());
    let map = fusion.map(&beliefs, &paints);
    let settled = keep.settled.then(|| Settled {
        base: fusion.held_base(&beliefs, &paints),
        drives: map.drives.clone(),
        folded_drives: map.folded_drives,
    });
    Fused { map, beginning, settled }
}

/// Drives while they are fused.
pub(super) struct Fusion<'a> {
    pub(super) drives: &'a [PreparedDrive<'a>],
    pub(super) params: &'a FleetParams,
    pub(super) base: &'a Base,
    /// Of each drive, then of the base.
    pub(super) corrections: Vec<Correction>,
    restraints: Vec<Restraints>,
    /// By what factor the variances of what each drive says are too small.
    doubts: Vec<f64>,
    eliminations: Eliminations,
    pub(super) placed: Vec<bool>,
    pub(super) lines: Lines,
    /// Where drives went that are laid on the lines.
    pub(super) ways: Ways,
    /// Which those are.
    pub(super) is_laid: Vec<bool>,
    /// Which of them are joined by common roads.
    pub(super) parts: Parts,
}

/// Distance between two stations of a line in the alignment, knots.
const STATION_KNOTS: usize = 4;

impl<'a> Fusion<'a> {
    fn new(base: &'a Base, drives: &'a [PreparedDrive<'a>], params: &'a FleetParams) -> Self {
        let placed = drives.iter().map(|drive| drive.by_gnss.is_some()).collect();
        let own = drives.iter().map(|drive| {
            let unmoved = || Correction::rigid(&drive.contribution.trajectory, 0.0, |point| *point, params);
            drive.by_gnss.clone().unwrap_or_else(unmoved)
        });
        let corrections = own.chain([Correction::identity()]).collect();
        let lines = base.lines(drives.len(), &Correction::identity());
        let restraints = drives.iter().map(|drive| drive.restraints.clone());
        let restraints = restraints.chain([base.restraints()]).collect();
        let eliminations = Eliminations::default();
        let doubts = vec![1.0; drives.len()];
        let is_laid = vec![false; drives.len()];
        let parts = Parts::new(drives.len(), base.drives());
        let ways = base.ways().clone();
        Self {
            drives,
            params,
            base,
            corrections,
            restraints,
            doubts,
            eliminations,
            placed,
            lines,
            ways,
            is_laid,
            parts,
        }
    }

    /// Where folded drives went.
    pub(super) fn base_ways(&self) -> &'a Ways {
        self.base.ways()
    }

    /// Solves for all that were laid together, and makes the lines from that.
    fn align_and_draw(&mut self) {
        for _ in 1..self.params.rounds {
            self.align_all();
            self.learn_receivers();
            self.settle_lines();
            self.learn_credibility();
        }
        self.align_all();
        self.draw_lines();
        if self.keep_apart_misfits() | self.keep_apart_strangers() {
            self.align_all();
            self.draw_lines();
        }
    }

    /// Every pass of every drive that is placed, with its drive and its number among all.
    pub(super) fn passes(&self) -> impl Iterator<Item = (usize, usize, &'a PreparedPass<'a>)> + use<'a> {
        let drives = self.drives;
        let placed = self.placed.clone();
        let all = drives
            .iter()
            .enumerate()
            .flat_map(|(drive, prepared)| prepared.passes.iter().map(move |pass| (drive, pass)));
        all.enumerate().map(|(number, (drive, pass))| (drive, number, pass)).filter(move |(drive, ..)| placed[*drive])
    }

    /// Adds a pass of a drive to the lines.
    fn grow(&mut self, drive: usize, number: usize, pass: &PreparedPass<'_>, pieces: &mut Pieces) {
        let contribution = self.drives[drive].contribution;
        let growing = Growing { contribution, pass, drive, number, params: self.params };
        growing.add_to(&mut self.lines, &self.corrections[drive], pieces);
    }

    /// Solves for all corrections and all lines together.
    fn align_all(&mut self) {
        let all: Vec<usize> = (0..self.corrections.len()).collect();
        let mut eliminations = std::mem::take(&mut self.eliminations);
        self.align_some(&all, &mut eliminations);
        self.eliminations = eliminations;
    }

    /// Solves for the corrections of some drives, among them all that lie on lines, and for all lines together. `drives` are in
    /// their order; the base counts as the last.
    fn align_some(&mut self, drives: &[usize], eliminations: &mut Eliminations) {
        let (mut sightings, stations) = self.sightings_of_lines();
        let mut positions = vec![0; self.corrections.len()];
        for (position, drive) in drives.iter().enumerate() {
            positions[*drive] = position;
        }
        for sighting in &mut sightings {
            sighting.drive = positions[sighting.drive];
        }
        let restraints: Vec<&Restraints> = drives.iter().map(|drive| &self.restraints[*drive]).collect();
        let mut corrections: Vec<Correction> = drives.iter().map(|drive| self.corrections[*drive].clone()).collect();
        let scales = RobustScales { lanes_m: self.params.robust_scale_m, fixes_m: self.params.gnss_robust_scale_m };
        align(&restraints, &mut corrections, &sightings, stations, scales, eliminations);
        for (drive, correction) in drives.iter().zip(corrections) {
            self.corrections[*drive] = correction;
        }
        // What its weights left of a shift.
        if self.base.is_held {
            self.corrections[self.drives.len()] = Correction::identity();
        }
    }

    /// What the witnesses of all lines saw, with how many stations; the lines' own places are unknown.
    fn sightings_of_lines(&self) -> (Vec<Sighting>, usize) {
        let mut sightings = Vec::new();
        let mut stations = 0;
        let deflation = self.params.lane_correlation_m / (STATION_KNOTS as f64 * self.params.line_knot_m);
        for line in &self.lines.lines {
            for knot in (0..line.points.len()).step_by(STATION_KNOTS) {
                let witnesses = &line.knots[knot].witnesses;
                if witnesses.len() < 2 {
                    continue;
                }
                let normal = normal_of(&line.tangent(knot));
                sightings.extend(witnesses.iter().map(|witness| Sighting {
                    drive: witness.drive,
                    arc_m: witness.arc_m,
                    map: witness.map,
                    normal,
                    across: Target::Station(stations),
                    height: Target::Station(stations),
                    lateral_variance_m2: witness.lateral_variance_m2 * deflation / witness.share,
                    height_variance_m2: witness.height_variance_m2 * deflation / witness.share,
                }));
                stations += 1;
            }
        }
        (sightings, stations)
    }

    /// Weighs the shape that receivers tell, from the next alignment on, by how far they disagree about it.
    fn learn_receivers(&mut self) {
        let drives = self.restraints.iter().zip(&self.corrections).zip(&self.placed);
        let placed = drives.filter(|(_, placed)| **placed).map(|(drive, _)| drive);
        let placed: Vec<_> = placed.filter(|(restraints, _)| restraints.placed_by == PlacedBy::Receiver).collect();
        let Some(share) = learned_shape_share(&placed, self.params) else { return };
        let by_receivers = self.restraints.iter_mut().zip(self.drives);
        for (restraints, drive) in by_receivers.filter(|(own, _)| own.placed_by == PlacedBy::Receiver) {
            restraints.fixes.clone_from(&drive.restraints.fixes);
            restraints.reweigh_shape(share, self.params);
        }
    }

    /// Believes drives less, from the next alignment on, whose lanes lie farther beside those of others than is usual.
    fn learn_credibility(&mut self) {
        let learned = learned_doubts(&self.lines.lines, self.drives.len());
        let by: Vec<f64> = learned.iter().zip(&self.doubts).map(|(now, before)| now / before).collect();
        self.raise_variances(&by);
        self.doubts = learned;
    }

    /// Multiplies the variance of all that each drive says by a factor.
    fn raise_variances(&mut self, by: &[f64]) {
        let knots = self.lines.lines.iter_mut().flat_map(|line| &mut line.knots);
        for witness in knots.flat_map(|knot| &mut knot.witnesses) {
            witness.lateral_variance_m2 *= by.get(witness.drive).copied().unwrap_or(1.0);
        }
    }

    /// Moves the lines with their witnesses, whose drives were corrected anew.
    fn settle_lines(&mut self) {
        let mut walks: Vec<CorrectionWalk<'_>> = self.corrections.iter().map(CorrectionWalk::new).collect();
        for line in &mut self.lines.lines {
            for witness in line.knots.iter_mut().flat_map(|knot| &mut knot.witnesses) {
                witness.shared = walks[witness.drive].place(&witness.map, witness.arc_m);
            }
            line.settle(self.params);
        }
        self.lines.index();
    }

    /// Makes the lines again from the corrections as they are.
    fn draw_lines(&mut self) {
        let base = self.drives.len();
        self.lines = self.base.lines(base, &self.corrections[base]);
        let mut pieces = Pieces::new();
        let (doubted, believed): (Vec<_>, Vec<_>) =
            self.passes().partition(|(drive, ..)| self.doubts[*drive] >= DOUBTED);
        for (drive, number, pass) in believed.into_iter().chain(doubted) {
            self.grow(drive, number, pass, &mut pieces);
        }
        let doubts = self.doubts.clone();
        self.raise_variances(&doubts);
        for line in &mut self.lines.lines {
            line.settle(self.params);
            run_on(line, self.params);
        }
        self.lines.index();
        self.gather_lone_sightings();
        self.lines.index();
        self.part_moved(&mut pieces);
        self.lines.index();
    }
}
