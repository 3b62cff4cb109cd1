//! Bridging: the first drive that goes from one part of the map to another joins them.
//!
//! Drives that share no road with others say nothing of how they lie to them but what their receivers say: two parts of
//! the map are off from each other by metres. A drive that goes over both lies on each by a shift of its own. With `s_A` the
//! shift that lays it on the part that it saw most of, `v_d` the variance of its receiver's bias, and `v_A`, `v_X` those of the parts
//! (a drive's by their number), the shift onto part `X` is to be expected at
//!
//! `s_A v_d / (v_d + v_A)`, with the variance `v_d + v_X - v_d^2 / (v_d + v_A)`:
//!
//! what all three receivers say, less what `s_A` says of the drive's. Is it found, then the part of fewer drives moves as a whole by
//! the difference, and the two are one. [`alignment`](super::alignment) then spreads what their receivers say over both.
//!
//! Not guaranteed: a part that is bent within itself stays so until the alignment.

use std::{cmp::Reverse, collections::BTreeSet, iter::repeat_n};

use nalgebra::{Vector2, Vector3};

use super::{
    alignment::Sighting,
    fusion::Fusion,
    placement::{LEAST_SAMPLES, Prior, Surroundings},
    prepared::PreparedPass,
};

/// What became of laying a pass on the map.
#[derive(Clone, Debug)]
pub(super) enum Placement {
    /// There is no line where the drive went: GNSS or odometry alone places it.
    Alone,
    /// It lies here, by these sightings of lines.
    Found(Vec<Sighting>),
    /// It fits nowhere, or at more places than one.
    Refused,
}

/// Which drives are joined by the roads that they share: a forest of drives, the base the last of them.
#[derive(Clone, Debug)]
pub(super) struct Parts {
    parent: Vec<usize>,
    /// Of the part whose root it is.
    drives: Vec<usize>,
}

impl Parts {
    /// Every drive alone, and a base of so many.
    pub(super) fn new(drives: usize, in_base: usize) -> Self {
        let sizes = repeat_n(1, drives).chain([in_base]);
        Self { parent: (0..=drives).collect(), drives: sizes.collect() }
    }

    /// The same where the base, which is the last, has another number: drives between the two are alone.
    pub(super) fn renumbered(&self, base: usize, to: usize) -> Self {
        let mut renumbered = Self::new(to, self.drives[base]);
        let number = |drive: usize| if drive == base { to } else { drive };
        for drive in (0..base.min(to)).chain([base]) {
            renumbered.parent[number(drive)] = number(self.parent[drive]);
            renumbered.drives[number(drive)] = self.drives[drive];
        }
        renumbered
    }

    /// The part of a drive.
    pub(super) fn of(&self, mut drive: usize) -> usize {
        while self.parent[drive] != drive {
            drive = self.parent[drive];
        }
        drive
    }

    fn join(&mut self, a: usize, b: usize) {
        let (a, b) = (self.of(a), self.of(b));
        if a != b {
            self.parent[b] = a;
            self.drives[a] += self.drives[b];
        }
    }

    /// Variance of where receivers put a part, by that of one drive.
    fn variance_m2(&self, part: usize, of_one_m2: f64) -> f64 {
        of_one_m2 / self.drives[part].max(1) as f64
    }
}

impl Prior {
    /// Where a drive that lies on one part is to be expected on another.
    fn on_another(found_m: Vector2<f64>, own_m2: f64, part_m2: f64, other_m2: f64) -> Self {
        let share = own_m2 / (own_m2 + part_m2);
        Self { shift_m: found_m * share, sigma_m: (own_m2 * (1.0 - share) + other_m2).sqrt() }
    }
}

impl Fusion<'_> {
    /// Lays a pass of a drive on the map, and joins the parts of it that the pass goes over. `sigma_m` is that of the drive's
    /// own place, and it must be told on which line it lies in every part, unless `is_last_chance`.
    pub(super) fn lay(
        &mut self,
        drive: usize,
        pass: &PreparedPass<'_>,
        sigma_m: f64,
        is_last_chance: bool,
    ) -> Placement {
        let own_m2 = sigma_m * sigma_m;
        loop {
            let reach_m = self.farthest_prior(own_m2).reach_m(self.params);
            let around = Surroundings::new(pass, &self.corrections[drive], &self.lines, &self.ways, reach_m);
            let mut parts = self.parts_of(&around).into_iter();
            let Some((main, on_main)) = parts.next() else { return Placement::Alone };
            let main_m2 = self.parts.variance_m2(main, own_m2);
            let prior = Prior { shift_m: Vector2::zeros(), sigma_m: (own_m2 + main_m2).sqrt() };
            let Some(shifts) = on_main.search(&prior, self.params) else { return Placement::Refused };
            let mut joined = false;
            for (other, on_other) in parts {
                let other_m2 = self.parts.variance_m2(other, own_m2);
                let prior = Prior::on_another(shifts.mean(), own_m2, main_m2, other_m2);
                match on_other.search(&prior, self.params) {
                    Some(onto_other) => {
                        let across = on_other.move_of_lines(&onto_other, &shifts);
                        let up_m = on_other.above_m(&onto_other) - on_main.above_m(&shifts);
                        self.bridge(main, other, Vector3::new(across.x, across.y, up_m));
                        joined = true;
                        break;
                    }
                    None if is_last_chance => {}
                    None => return Placement::Refused,
                }
            }
            if !joined {
                self.parts.join(main, drive);
                return Placement::Found(on_main.sightings(&shifts, drive, &self.lines));
            }
        }
    }

    /// What is known of a drive on the part that is known least.
    fn farthest_prior(&self, own_m2: f64) -> Prior {
        let laid = (0..self.drives.len()).filter(|drive| self.is_laid[*drive]);
        let parts = laid.map(|drive| self.parts.variance_m2(self.parts.of(drive), own_m2));
        let most_m2 = parts.fold(0.0, f64::max);
        Prior { shift_m: Vector2::zeros(), sigma_m: (own_m2 + most_m2).sqrt() }
    }

    /// What lies beside a pass, by the part of the map; the part that most of it sees first.
    fn parts_of<'s>(&self, around: &Surroundings<'s>) -> Vec<(usize, Surroundings<'s>)> {
        let part_of_line = |line: usize| self.parts.of(self.lines.lines[line].first_drive());
        let numbers: BTreeSet<usize> = around.lines().map(part_of_line).collect();
        let parts = numbers.into_iter().map(|part| (part, around.with_lines(|line| part_of_line(line) == part)));
        let mut parts: Vec<_> = parts.filter(|(_, on_it)| on_it.samples() >= LEAST_SAMPLES).collect();
        parts.sort_by_key(|(part, on_it)| (Reverse(on_it.samples()), *part));
        parts
    }

    /// Makes two parts one: where `other` moves by so much, they fit. The one of fewer drives moves; a base stays.
    fn bridge(&mut self, main: usize, other: usize, move_m: Vector3<f64>) {
        let base = self.drives.len();
        let is_heavier = |a: usize, b: usize| a == self.parts.of(base) || self.parts.drives[a] > self.parts.drives[b];
        if is_heavier(other, main) && main != self.parts.of(base) {
            self.move_part(main, -move_m);
        } else {
            self.move_part(other, move_m);
        }
        self.parts.join(main, other);
    }

    /// Moves a part as a whole: its drives, its lines, and its ways.
    fn move_part(&mut self, part: usize, by_m: Vector3<f64>) {
        for drive in (0..self.drives.len()).filter(|drive| self.parts.of(*drive) == part) {
            for knot in &mut self.corrections[drive].knots {
                knot.shared += by_m;
            }
        }
        for line in self.lines.lines.iter_mut().filter(|line| self.parts.of(line.first_drive()) == part) {
            line.move_by(&by_m);
        }
        self.lines.index();
        self.find_ways();
    }

    /// Finds anew where the drives went that are laid, from their corrections as they are.
    pub(super) fn find_ways(&mut self) {
        self.ways = self.base_ways().clone();
        for drive in (0..self.drives.len()).filter(|drive| self.is_laid[*drive]) {
            for pass in &self.drives[drive].passes {
                self.ways.add(pass.way, &self.corrections[drive]);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_that_are_joined_are_one_and_count_all_their_drives() {
        let mut parts = Parts::new(3, 16);
        assert_ne!(parts.of(0), parts.of(1));
        parts.join(0, 1);
        parts.join(3, 1);
        assert_eq!(parts.of(0), 3);
        assert_eq!(parts.of(2), 2);
        assert!((parts.variance_m2(parts.of(1), 2.25) - 2.25 / 18.0).abs() < 1e-12);
    }

    #[test]
    fn a_drive_is_expected_on_another_part_where_three_receivers_put_it() {
        // One drive each: half of the shift is its own bias, and 1 + 1 - 1/2 is left.
        let prior = Prior::on_another(Vector2::new(2.0, 0.0), 1.0, 1.0, 1.0);
        assert!((prior.shift_m.x - 1.0).abs() < 1e-12 && (prior.sigma_m.powi(2) - 1.5).abs() < 1e-12);
        // A part of very many drives tells the bias: only that of the other part is left.
        let prior = Prior::on_another(Vector2::new(2.0, 0.0), 1.0, 1e-9, 0.5);
        assert!((prior.shift_m.x - 2.0).abs() < 1e-6 && (prior.sigma_m.powi(2) - 0.5).abs() < 1e-6);
    }
}
