//! Laying: drives are laid on the lines one after the other, in the order of their starts, and add to them.
//!
//! What comes first is what the others are laid on, right or wrong. So drives that fit nowhere are tried once more when all others
//! lie, and where they are more than those that were laid, laying begins anew with them: a first drive whose receiver is tens of
//! metres off keeps nobody else apart.
//!
//! Not guaranteed: the same lines in another order of starts; the order is that of the drives, not of their arrival.

use super::{Fusion, RobustScales, Sighting, Target};
use crate::fleet::{
    alignment::align_one,
    beginning::Beginning,
    bridging::Placement,
    georeferenced::UNBOUNDED_M,
    growth::Pieces,
    matching::match_lanes,
    prepared::{COARSE_STRIDE, PreparedPass, normal_of},
};

/// How far the laying of drives has come.
#[derive(Clone, Debug, Default)]
pub(in crate::fleet) struct Laying {
    /// How many have been laid, and how many passes they have.
    pub(in crate::fleet) drives: usize,
    passes: usize,
    pieces: Pieces,
    /// Drives that fit nowhere as yet, with their first passes.
    later: Vec<(usize, usize)>,
}

impl Fusion<'_> {
    /// Lays every drive, pass by pass, on the lines of those before it; those that fit nowhere once more at the end. The
    /// beginning before the drive that is asked for.
    pub(super) fn place_all(&mut self, mut laying: Laying, keep: Option<usize>) -> Option<Beginning> {
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
            if laying.drives < self.drives.len() && self.spreads_after(laying.drives) {
                self.spread();
            }
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
}
