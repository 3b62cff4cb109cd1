//! The base: what is left of drives that were folded.
//!
//! Its lines keep the sum of the information of all of them at each knot, less what the final alignment costs: so the mean
//! of base and younger drives is nearly that of all. In alignment it is one more drive: it may be shifted as a whole,
//! held where it is by the GNSS biases of its drives, whose mean has the variance `1 / sum 1 / s_b^2`; it hardly turns.

use nalgebra::Point3;
use serde::{Deserialize, Serialize};

use super::{
    contribution::PlacedBy,
    correction::{Correction, CorrectionKnot},
    fusion::Fusion,
    history::Belief,
    line::{BASE, FusedLaneId, Knot, KnotRecord, Line, LineRecord, Lines, Witness},
    prepared::{DriftSigma, Restraints, SharedFix, normal_of},
    repainted::Paint,
    ways::Ways,
};

/// What the lines of a base are off by together, over tens of metres: the alignment that they were folded with is final,
/// and no longer gets better with younger drives. Metres.
const SHAPE_SIGMA_M: f64 = 0.06;

/// Drives that were folded.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Base {
    drives: u32,
    /// Sum of what the drives' receivers say of where it lies, horizontally and in height, 1/m^2.
    gnss_information: [f64; 2],
    lines: Vec<BaseLine>,
    /// Where its drives went.
    ways: Ways,
    /// Not to be shifted at all.
    pub(super) is_held: bool,
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct BaseLine {
    id: FusedLaneId,
    category_votes: Vec<f64>,
    record: LineRecord,
    knots: Vec<BaseKnot>,
}

#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
struct BaseKnot {
    place: Point3<f64>,
    lateral_variance_m2: f64,
    height_variance_m2: f64,
    record: KnotRecord,
}

impl Base {
    /// Number of drives in it.
    #[must_use]
    pub fn drives(&self) -> usize {
        self.drives as usize
    }

    /// Its lines where its correction puts them: younger drives are laid on them. It is number `drive` among the corrections.
    pub(super) fn lines(&self, drive: usize, correction: &Correction) -> Lines {
        let mut lines = Lines::default();
        for base in &self.lines {
            let mut line = Line::new(base.id);
            line.record = base.record;
            line.vote(&base.category_votes, 1.0);
            for knot in &base.knots {
                let shared = correction.apply(&knot.place, 0.0);
                let witness = Witness {
                    drive,
                    pass: BASE,
                    lane: 0,
                    parameter: 0.0,
                    map: knot.place,
                    arc_m: 0.0,
                    shared,
                    lateral_variance_m2: knot.lateral_variance_m2,
                    height_variance_m2: knot.height_variance_m2,
                    share: 1.0,
                };
                line.push(shared, Knot { witnesses: vec![witness], record: knot.record });
            }
            lines.lines.push(line);
        }
        lines.index();
        lines
    }

    /// Number of the knots of its lines.
    pub(super) fn knots(&self) -> usize {
        self.lines.iter().map(|line| line.knots.len()).sum()
    }

    /// About how much memory it takes, bytes.
    pub(super) fn bytes(&self) -> usize {
        self.knots() * size_of::<BaseKnot>() + self.lines.len() * size_of::<BaseLine>() + self.ways.bytes()
    }

    /// Where its drives went.
    pub(super) fn ways(&self) -> &Ways {
        &self.ways
    }

    /// What holds it where it is: fixes at the corners of its lines.
    pub(super) fn restraints(&self) -> Restraints {
        /// Of the corners to each other: the base is stiff.
        const STIFF_M: f64 = 0.01;
        /// The same where it is held, and of its bias.
        const HELD_M: f64 = 1e-4;
        let stiff_m = if self.is_held { HELD_M } else { STIFF_M };
        let places = || self.lines.iter().flat_map(|line| line.knots.iter().map(|knot| knot.place));
        let low = places().fold(Point3::from([f64::INFINITY; 3]), |low, place| low.inf(&place));
        let high = places().fold(Point3::from([f64::NEG_INFINITY; 3]), |high, place| high.sup(&place));
        let corners = [(low.x, low.y), (high.x, low.y), (low.x, high.y), (high.x, high.y)];
        let fix = |(x, y)| {
            let place = Point3::new(x, y, 0.0);
            SharedFix { arc_m: 0.0, map: place, shared: place, sigma_m: [stiff_m; 2] }
        };
        let fixes = if self.lines.is_empty() { Vec::new() } else { corners.into_iter().map(fix).collect() };
        // Without drives there are no fixes, and no bias is asked for.
        let bias_sigma_m = self
            .gnss_information
            .map(|information| if self.is_held { HELD_M } else { information.max(1e-9).powf(-0.5) });
        // It has no odometry: nothing asks for its drift.
        let drift_sigma = DriftSigma { scale: 1.0, turn_rad_per_m: 1.0 };
        Restraints {
            fixes,
            placed_by: PlacedBy::Receiver,
            bias_sigma_m,
            place_sigma_m: bias_sigma_m[0],
            stated_sigma_m: 0.0,
            drift_sigma,
            steps: Vec::new(),
        }
    }
}

impl Correction {
    /// The correction of what lies in the shared frame already.
    pub(super) fn identity() -> Self {
        let origin = Point3::origin();
        Self { knots: vec![CorrectionKnot { arc_m: 0.0, map: origin, shared: origin, yaw_rad: 0.0 }] }
    }
}

impl Fusion<'_> {
    /// The drives folded into the base.
    pub(super) fn folded_base(&self, beliefs: &[Vec<Belief>], paints: &[Vec<Paint>]) -> Base {
        self.new_base(beliefs, paints, SHAPE_SIGMA_M)
    }

    /// The same, to be held as it is until all are fused again.
    pub(super) fn held_base(&self, beliefs: &[Vec<Belief>], paints: &[Vec<Paint>]) -> Base {
        Base { is_held: true, ..self.new_base(beliefs, paints, 0.0) }
    }

    fn new_base(&self, beliefs: &[Vec<Belief>], paints: &[Vec<Paint>], shape_sigma_m: f64) -> Base {
        let before = self.base;
        let mut lines = Vec::with_capacity(self.lines.lines.len());
        for (index, ((line, beliefs), paints)) in self.lines.lines.iter().zip(beliefs).zip(paints).enumerate() {
            let knots = (0..line.points.len()).map(|knot| {
                let normal = normal_of(&line.tangent(knot));
                let mean = line.mean_offset(knot, &normal, self.params);
                BaseKnot {
                    place: line.points[knot],
                    lateral_variance_m2: 1.0 / mean.across_information.max(1e-6) + shape_sigma_m.powi(2),
                    height_variance_m2: 1.0 / mean.height_information.max(1e-6) + shape_sigma_m.powi(2),
                    record: KnotRecord {
                        drives: line.knots[knot].drives(),
                        belief: Some(beliefs[knot]),
                        paint: Some(paints[knot]),
                    },
                }
            });
            lines.push(BaseLine {
                id: line.id,
                category_votes: line.category_votes.clone(),
                record: self.record_of(index),
                knots: knots.collect(),
            });
        }
        let mut ways = before.ways.clone();
        for (drive, _, pass) in self.passes() {
            ways.add(pass.way, &self.corrections[drive]);
        }
        let mut base =
            Base { drives: before.drives, gnss_information: before.gnss_information, lines, ways, is_held: false };
        for (drive, _) in self.drives.iter().zip(&self.placed).filter(|(_, placed)| **placed) {
            base.drives += 1;
            for (sum, sigma_m) in base.gnss_information.iter_mut().zip(drive.restraints.bias_sigma_m) {
                *sum += sigma_m.powi(-2);
            }
        }
        base
    }
}
