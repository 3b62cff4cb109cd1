//! Fusion: contributions in, one map out. A pure function, whatever the order in which contributions arrived.
//!
//! Drives are taken in the order of their starts. Each is laid on the lines so far and adds to them. Then all
//! corrections are solved together, and the lines are made again from them, a few times over.
//!
//! So that a place that thousands of drives pass costs no more than one that a few do, the oldest are folded, a crowd at a
//! time, into a [`Base`]: lines that stay as they are, with the information of all of them, as one more drive that may
//! still be shifted as a whole. Which drives are folded depends on their order of seniority alone, so that the
//! map is the same function of the set of contributions.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use super::{
    alignment::{Eliminations, RobustScales, Sighting, Target, align, align_one},
    base::Base,
    beginning::Beginning,
    bridging::{Parts, Placement},
    change::MapChange,
    continuity::run_on,
    contribution::{Contribution, DriveId, PlacedBy},
    correction::{Correction, CorrectionWalk},
    credibility::{DOUBTED, learned_doubts},
    crowding::first_crowd,
    georeferenced::UNBOUNDED_M,
    growth::{Growing, Pieces},
    line::{FusedLane, Lines},
    matching::match_lanes,
    params::FleetParams,
    prepared::{COARSE_STRIDE, PreparedDrive, PreparedPass, Restraints, normal_of},
    receivers::learned_shape_share,
    ways::Ways,
};
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
    fusion.into_base(base)
}

/// Fuses the drives that are kept apart onto a base.
#[must_use]
pub fn fuse_onto(base: &Base, drives: &[&Contribution], anchor: &Anchor, params: &FleetParams) -> FusedMap {
    fuse_from(None, base, drives, anchor, params, None).0
}

/// As [`fuse_onto`], to the bit, going on from a beginning of the same base and the same first drives, if there is one. `keep` asks for
/// the beginning before that drive; there is none before the beginning's own drives.
#[must_use]
pub fn fuse_from(
    beginning: Option<&Beginning>,
    base: &Base,
    drives: &[&Contribution],
    anchor: &Anchor,
    params: &FleetParams,
    keep: Option<usize>,
) -> (FusedMap, Option<Beginning>) {
    let known = |drive: usize| beginning.and_then(|beginning| beginning.by_gnss(drive));
    let prepared = drives.iter().enumerate().map(|(number, contribution)| match known(number) {
        Some(by_gnss) => PreparedDrive::of(contribution, by_gnss.clone(), anchor, params),
        None => PreparedDrive::new(contribution, anchor, params),
    });
    let prepared: Vec<PreparedDrive<'_>> = prepared.collect();
    let mut fusion = Fusion::new(base, &prepared, params);
    let laying = beginning.map_or_else(Laying::default, |beginning| fusion.go_on(beginning));
    let kept = fusion.place_all(laying, keep);
    fusion.align_and_draw();
    (fusion.into_map(base), kept)
}

/// How far the laying of drives has come.
#[derive(Clone, Debug, Default)]
pub(super) struct Laying {
    /// How many have been laid, and how many passes they have.
    pub(super) drives: usize,
    passes: usize,
    pieces: Pieces,
    /// Drives that fit nowhere as yet, with their first passes.
    later: Vec<(usize, usize)>,
}

/// Drives while they are fused.
pub(super) struct Fusion<'a> {
    pub(super) drives: &'a [PreparedDrive<'a>],
    pub(super) params: &'a FleetParams,
    base: &'a Base,
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

    /// Lays every drive, pass by pass, on the lines of those before it; those that fit nowhere once more at the end. The
    /// beginning before the drive that is asked for.
    fn place_all(&mut self, mut laying: Laying, keep: Option<usize>) -> Option<Beginning> {
        let mut kept = None;
        for drive in laying.drives..self.drives.len() {
            if keep == Some(drive) {
                kept = Some(self.beginning(&laying));
            }
            if self.placed[drive] && !self.place_drive(drive, laying.passes, &mut laying.pieces, false) {
                laying.later.push((drive, laying.passes));
            }
            laying.passes += self.drives[drive].passes.len();
            laying.drives += 1;
        }
        if self.are_outvoted(&laying) {
            self.begin_with_refused(&mut laying);
        }
        for (drive, first_pass) in laying.later {
            self.placed[drive] = self.place_drive(drive, first_pass, &mut laying.pieces, true);
        }
        kept
    }

    /// Whether more drives fit nowhere than were laid: then those lie wrong, though they came first.
    fn are_outvoted(&self, laying: &Laying) -> bool {
        let laid = self.is_laid.iter().filter(|is_laid| **is_laid).count();
        laying.later.len() > laid + self.base.drives()
    }

    /// Begins anew with the drives that fitted nowhere; those that were laid are to fit what comes of them.
    fn begin_with_refused(&mut self, laying: &mut Laying) {
        let first_passes = self.drives.iter().scan(0, |next, drive| {
            let first = *next;
            *next += drive.passes.len();
            Some(first)
        });
        let laid = first_passes.enumerate().filter(|(drive, _)| self.is_laid[*drive]).collect::<Vec<_>>();
        let refused = std::mem::take(&mut laying.later);
        *self = Self::new(self.base, self.drives, self.params);
        laying.pieces = Pieces::new();
        for (drive, first_pass) in refused {
            if !self.place_drive(drive, first_pass, &mut laying.pieces, false) {
                laying.later.push((drive, first_pass));
            }
        }
        laying.later.extend(laid);
    }

    /// Lays one drive on the lines and adds it to them; whether it was found.
    fn place_drive(&mut self, drive: usize, first_pass: usize, pieces: &mut Pieces, is_last_chance: bool) -> bool {
        let prepared = &self.drives[drive];
        for (index, pass) in prepared.passes.iter().enumerate() {
            let sigma_m = if index == 0 { self.restraints[drive].place_sigma_m } else { self.params.gnss_bias_sigma_m };
            match self.lay(drive, pass, sigma_m, is_last_chance) {
                Placement::Refused if index == 0 => return false,
                // A later pass that fits nowhere lies where odometry puts it after the one before.
                Placement::Alone | Placement::Refused => {}
                Placement::Found(sightings) => {
                    let before = &prepared.passes[..index];
                    let mut all = self.sightings_of(drive, before);
                    all.extend(sightings);
                    self.fit_one(drive, all, UNBOUNDED_M);
                    for robust_scale_m in [3.0, 1.0].map(|factor| factor * self.params.robust_scale_m) {
                        let sightings = self.sightings_of(drive, &prepared.passes[..=index]);
                        self.fit_one(drive, sightings, robust_scale_m);
                    }
                }
            }
            self.grow(drive, first_pass + index, pass, pieces);
            self.ways.add(pass.way, &self.corrections[drive]);
            self.is_laid[drive] = true;
        }
        self.placed[drive] = true;
        true
    }

    fn grow(&mut self, drive: usize, number: usize, pass: &PreparedPass<'_>, pieces: &mut Pieces) {
        let contribution = self.drives[drive].contribution;
        let growing = Growing { contribution, pass, drive, number, params: self.params };
        growing.add_to(&mut self.lines, &self.corrections[drive], pieces);
    }

    /// Solves for one drive's correction while the lines stay.
    fn fit_one(&mut self, drive: usize, mut sightings: Vec<Sighting>, robust_scale_m: f64) {
        for sighting in &mut sightings {
            sighting.drive = 0;
        }
        let scales = RobustScales { lanes_m: robust_scale_m, fixes_m: self.params.gnss_robust_scale_m };
        align_one(&self.restraints[drive], &mut self.corrections[drive], &sightings, scales);
    }

    /// Where lanes of some passes of a drive lie on lines.
    fn sightings_of(&self, drive: usize, passes: &[PreparedPass<'_>]) -> Vec<Sighting> {
        let mut sightings = Vec::new();
        let deflation = self.params.lane_correlation_m / (COARSE_STRIDE as f64 * self.params.sample_m);
        for pass in passes {
            let matched = match_lanes(&pass.coarse_lanes, &self.corrections[drive], &self.lines, self.params);
            for (lane, run) in
                pass.coarse_lanes.iter().zip(&matched).flat_map(|(lane, runs)| runs.iter().map(move |run| (lane, run)))
            {
                let Some(curve) = self.lines.lines[run.line].curve() else { continue };
                let on_line = lane.samples[run.samples.clone()].iter().zip(&run.parameters);
                sightings.extend(on_line.map(|(sample, parameter)| {
                    let (place, normal) = (curve.point(*parameter), normal_of(&curve.derivative(*parameter)));
                    Sighting {
                        drive,
                        arc_m: sample.arc_m,
                        map: sample.map,
                        normal,
                        across: Target::Fixed(place.coords.xy().dot(&normal)),
                        height: Target::Fixed(place.z),
                        lateral_variance_m2: sample.lateral_variance_m2 * deflation,
                        height_variance_m2: sample.height_variance_m2 * deflation,
                    }
                }));
            }
        }
        sightings
    }

    /// Solves for all corrections and all lines together.
    fn align_all(&mut self) {
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
        let restraints: Vec<&Restraints> = self.restraints.iter().collect();
        let scales = RobustScales { lanes_m: self.params.robust_scale_m, fixes_m: self.params.gnss_robust_scale_m };
        align(&restraints, &mut self.corrections, &sightings, stations, scales, &mut self.eliminations);
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
        self.part_moved(&mut pieces);
        self.lines.index();
    }

    /// Takes out drives that went where others did, by what their receivers say, and share no line with them; whether any.
    ///
    /// A drive on a road of its own shares none either, but others are not near its way. Beside a road that is well known, two that
    /// share their lines with each other alone are not yet believed either: they may be wrong alike.
    fn keep_apart_strangers(&mut self) -> bool {
        const MANY: u32 = 6;
        let mut shared = vec![(0_usize, 0_usize, 0_usize); self.drives.len()];
        for knot in self.lines.lines.iter().flat_map(|line| &line.knots) {
            let (several, more) = (knot.drives() > 1, knot.drives() > 2);
            for witness in knot.witnesses.iter().filter(|witness| witness.drive < self.drives.len()) {
                let (with_others, with_more, all) = &mut shared[witness.drive];
                *with_others += usize::from(several);
                *with_more += usize::from(more);
                *all += 1;
            }
        }
        let strangers = shared.iter().enumerate().filter(|(drive, (with_others, with_more, all))| {
            let is_alone = (*with_others as f64) < self.params.least_shared * *all as f64;
            let has_few = (*with_more as f64) < self.params.least_shared * *all as f64;
            self.placed[*drive]
                && (is_alone && self.goes_where_others_do(*drive, 2)
                    || has_few && self.goes_where_others_do(*drive, MANY))
        });
        let strangers: Vec<usize> = strangers.map(|(drive, _)| drive).collect();
        for drive in &strangers {
            self.placed[*drive] = false;
        }
        !strangers.is_empty()
    }

    /// Whether most of a drive's way lies near lines that at least so many drives saw.
    fn goes_where_others_do(&self, drive: usize, least_drives: u32) -> bool {
        const STRIDE: usize = 5;
        let way: Vec<_> = self.drives[drive].contribution.trajectory.iter().step_by(STRIDE).collect();
        let near_others = way.iter().filter(|point| {
            let place = self.corrections[drive].apply(&point.position, point.arc_m);
            let near = self.lines.near(&place, self.params.strangers_within_m);
            near.into_iter().any(|(line, knot)| self.lines.lines[line].knots[knot].drives() >= least_drives)
        });
        2 * near_others.count() > way.len()
    }

    /// Takes out drives whose lanes do not lie where those of others do, though they were laid on them; whether any.
    fn keep_apart_misfits(&mut self) -> bool {
        let mut residuals: Vec<Vec<f64>> = vec![Vec::new(); self.drives.len()];
        for line in &self.lines.lines {
            for (knot, at) in line.knots.iter().enumerate().filter(|(_, at)| at.witnesses.len() >= 3) {
                let normal = normal_of(&line.tangent(knot));
                for witness in at.witnesses.iter().filter(|witness| witness.drive < self.drives.len()) {
                    residuals[witness.drive].push((witness.shared - line.points[knot]).xy().dot(&normal).abs());
                }
            }
        }
        let mut any = false;
        for (drive, residuals) in residuals.iter_mut().enumerate() {
            residuals.sort_by(f64::total_cmp);
            let middle = residuals.get(residuals.len() / 2).copied().unwrap_or(0.0);
            if self.placed[drive] && middle > self.params.most_misfit_m {
                self.placed[drive] = false;
                any = true;
            }
        }
        any
    }
}
