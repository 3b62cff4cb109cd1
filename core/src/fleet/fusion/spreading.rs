//! Spreading: what receivers and lanes say of the drives that lie so far is spread over all of them before others are laid.
//!
//! A drive is laid on lines that stay as they are, so each adds an error of its own to those before it, the more the longer the
//! chain of drives that leads there. Two ways through a town to one place may so come to lie a lane apart, and the first
//! drive that goes over both is laid one lane off on one of them, for good. So whenever the number of drives whose turn
//! it was has doubled, those that lie are solved for together as at the end ([`alignment`](crate::fleet::alignment)), and
//! lines and ways are moved with them. That is at the powers of two, whatever comes later: what is made of the first drives
//! stays a function of them alone.
//!
//! Where every drive shares a stretch of line with the oldest, as on one road, no error is handed on, and nothing is spread.
//!
//! Not guaranteed: two parts of a map that one drive joined over a straight road still lie to each other as their receivers say,
//! along that road. Where these are off by half a lane, the next drive between the two may be laid one lane off.

use super::{Eliminations, Fusion};

/// Drives below which nothing is spread: too few for two ways to one place.
const FEWEST: usize = 8;

impl Fusion<'_> {
    /// Whether what is known is spread once it was the turn of so many drives.
    pub(super) fn spreads_after(&self, drives: usize) -> bool {
        drives >= FEWEST && drives.is_power_of_two() && self.has_chains()
    }

    /// Whether some drive shares no stretch of line with what was laid first: the base, or else the oldest drive.
    fn has_chains(&self) -> bool {
        let base = self.drives.len();
        let oldest = self.is_laid.iter().position(|is_laid| *is_laid);
        let first = if self.base.drives() > 0 { Some(base) } else { oldest };
        let mut shares = vec![false; base + 1];
        for knot in self.lines.lines.iter().flat_map(|line| &line.knots) {
            if knot.witnesses.iter().any(|witness| Some(witness.drive) == first) {
                for witness in &knot.witnesses {
                    shares[witness.drive] = true;
                }
            }
        }
        self.is_laid.iter().zip(shares).any(|(is_laid, shares)| *is_laid && !shares)
    }

    /// Solves for the drives that are laid and the base together, and moves lines and ways with them. Drives that are not laid
    /// are not in it: they must not tell, not even by rounding, how the others lie.
    pub(super) fn spread(&mut self) {
        let base = self.drives.len();
        let laid: Vec<usize> = (0..base).filter(|drive| self.is_laid[*drive]).chain([base]).collect();
        self.align_some(&laid, &mut Eliminations::default());
        self.settle_lines();
        self.find_ways();
    }
}
