//! Which drives are kept apart though they were laid: those whose lanes do not fit, and those that lie beside all others.

use super::Fusion;
use crate::fleet::credibility::offsets_m;

/// Drives that saw a line that is well known.
const MANY: u32 = 6;

impl Fusion<'_> {
    /// Takes out drives that went where others did, by what their receivers say, and share no line with them; whether any.
    ///
    /// A drive on a road of its own shares none either, but others are not near its way. Beside a road that is well known, two that
    /// share their lines with each other alone are not yet believed either: they may be wrong alike.
    pub(super) fn keep_apart_strangers(&mut self) -> bool {
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
    pub(super) fn keep_apart_misfits(&mut self) -> bool {
        let mut offsets_m = offsets_m(&self.lines.lines, self.drives.len());
        let mut any = false;
        for (drive, offsets_m) in offsets_m.iter_mut().enumerate() {
            offsets_m.sort_by(f64::total_cmp);
            let middle_m = offsets_m.get(offsets_m.len() / 2).copied().unwrap_or(0.0);
            if self.placed[drive] && middle_m > self.params.most_misfit_m {
                self.placed[drive] = false;
                any = true;
            }
        }
        any
    }
}
