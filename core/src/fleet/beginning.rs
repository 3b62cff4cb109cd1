//! Beginnings: what became of laying the oldest of the drives that are kept apart.
//!
//! Drives are laid in the order of their starts, each on the lines of those before it. So what is made of the first few depends on
//! the base and on them alone, and a live drive, which is among the youngest, need not have all the others laid again whenever it
//! grows. A fusion that goes on from a beginning is the fusion of all drives, to the bit.

use super::{
    bridging::Parts,
    correction::Correction,
    fusion::{Fusion, Laying},
    line::{BASE, Lines},
    ways::Ways,
};

/// Drives that were laid on a base, and the lines that they made.
#[derive(Clone, Debug)]
pub struct Beginning {
    laying: Laying,
    /// Where GNSS and odometry alone put each of them.
    by_gnss: Vec<Option<Correction>>,
    corrections: Vec<Correction>,
    /// How the base was shifted where its place was solved for together with theirs.
    base_correction: Correction,
    placed: Vec<bool>,
    is_laid: Vec<bool>,
    lines: Lines,
    ways: Ways,
    parts: Parts,
    /// Number of the base among the corrections.
    base: usize,
}

impl Beginning {
    /// Number of drives in it.
    #[must_use]
    pub fn drives(&self) -> usize {
        self.laying.drives
    }

    /// Where GNSS and odometry alone put a drive; `None` of one that is not in it.
    pub(super) fn by_gnss(&self, drive: usize) -> Option<&Option<Correction>> {
        self.by_gnss.get(drive)
    }

    /// About how much memory it takes, bytes.
    #[must_use]
    pub fn bytes(&self) -> usize {
        self.lines.bytes()
    }
}

impl Fusion<'_> {
    /// How far the laying of drives has come.
    pub(super) fn beginning(&self, laying: &Laying) -> Beginning {
        let drives = ..laying.drives;
        Beginning {
            laying: laying.clone(),
            by_gnss: self.drives[drives].iter().map(|drive| drive.by_gnss.clone()).collect(),
            corrections: self.corrections[drives].to_vec(),
            base_correction: self.corrections[self.drives.len()].clone(),
            placed: self.placed[drives].to_vec(),
            is_laid: self.is_laid[drives].to_vec(),
            lines: self.lines.clone(),
            ways: self.ways.clone(),
            parts: self.parts.clone(),
            base: self.drives.len(),
        }
    }

    /// Goes on from a beginning of the same base and the same first drives, and fewer of them.
    pub(super) fn go_on(&mut self, from: &Beginning) -> Laying {
        let drives = ..from.drives();
        self.corrections[drives].clone_from_slice(&from.corrections);
        self.corrections[self.drives.len()].clone_from(&from.base_correction);
        self.placed[drives].copy_from_slice(&from.placed);
        self.is_laid[drives].copy_from_slice(&from.is_laid);
        self.lines = from.lines.clone();
        self.ways = from.ways.clone();
        self.parts = from.parts.renumbered(from.base, self.drives.len());
        let witnesses =
            self.lines.lines.iter_mut().flat_map(|line| &mut line.knots).flat_map(|knot| &mut knot.witnesses);
        for witness in witnesses.filter(|witness| witness.pass == BASE) {
            witness.drive = self.drives.len();
        }
        from.laying.clone()
    }
}
