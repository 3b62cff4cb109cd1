//! What of the lines is shown: stretches that are there, and whose place is known.

use std::{
    collections::{BTreeMap, BTreeSet},
    ops::Range,
};

use super::{
    fusion::{FusedDrive, FusedMap, Fusion},
    history::Belief,
    line::{BASE, FusedLane, FusedLaneId, FusedPoint, LineRecord},
    params::FleetParams,
    prepared::{PreparedPass, normal_of},
    repainted::Paint,
};
use crate::category::Category;

impl Fusion<'_> {
    /// What is known of a line from all drives, those that were folded among them.
    pub(super) fn record_of(&self, index: usize) -> LineRecord {
        let line = &self.lines.lines[index];
        let mut record = line.record;
        let lanes: BTreeSet<(usize, usize, usize)> = line
            .knots
            .iter()
            .flat_map(|knot| &knot.witnesses)
            .filter(|witness| witness.pass != BASE)
            .map(|witness| (witness.drive, witness.pass, witness.lane))
            .collect();
        let drives: BTreeSet<usize> = lanes.iter().map(|(drive, ..)| *drive).collect();
        record.drives += u32::try_from(drives.len()).unwrap_or(u32::MAX);
        let mut counted = BTreeSet::new();
        let passes: BTreeMap<usize, &PreparedPass<'_>> =
            self.passes().map(|(_, number, pass)| (number, pass)).collect();
        for (drive, number, lane) in lanes {
            let Some(pass) = passes.get(&number) else { continue };
            let lane = pass.lanes[lane].lane;
            if counted.insert((drive, lane.id)) {
                record.observations += u64::from(lane.observations);
            }
            record.first_seen = Some(record.first_seen.map_or(lane.first_seen, |first| first.min(lane.first_seen)));
            record.last_seen = Some(record.last_seen.map_or(lane.last_seen, |last| last.max(lane.last_seen)));
        }
        record
    }

    /// The map as it is shown.
    pub(super) fn map(&self, beliefs: &[Vec<Belief>], paints: &[Vec<Paint>]) -> FusedMap {
        let mut lanes: Vec<FusedLane> = Vec::new();
        for (index, beliefs) in beliefs.iter().enumerate() {
            let points = self.points_of(index, beliefs);
            let stretches = stretches(&points, self.params);
            if stretches.is_empty() {
                continue;
            }
            let record = self.record_of(index);
            let pieces = stretches.into_iter().enumerate();
            lanes.extend(pieces.map(|(stretch, knots)| self.fused_lane(index, stretch, &points[knots], &record)));
        }
        lanes.sort_by_key(|lane| lane.id);
        let changes = self.changes(beliefs, paints);
        let drives =
            self.drives.iter().zip(&self.placed).zip(&self.corrections).map(|((drive, placed), correction)| {
                FusedDrive { drive: drive.contribution.drive, correction: placed.then(|| correction.clone()) }
            });
        FusedMap {
            lanes,
            changes,
            drives: drives.collect(),
            folded_drives: u32::try_from(self.base.drives()).unwrap_or(u32::MAX),
        }
    }

    fn points_of(&self, index: usize, beliefs: &[Belief]) -> Vec<FusedPoint> {
        let line = &self.lines.lines[index];
        let points = (0..line.points.len()).map(|knot| {
            let normal = normal_of(&line.tangent(knot));
            let mean = line.mean_offset(knot, &normal, self.params);
            FusedPoint {
                position: line.points[knot],
                lateral_sigma_m: mean.across_information.max(1e-6).powf(-0.5),
                height_sigma_m: mean.height_information.max(1e-6).powf(-0.5),
                drives: line.knots[knot].drives(),
                existence: if beliefs[knot].doubled { 0.0 } else { beliefs[knot].probability },
                confirmed: beliefs[knot].confirmed.unwrap_or_default(),
            }
        });
        points.collect()
    }

    fn fused_lane(&self, index: usize, stretch: usize, points: &[FusedPoint], record: &LineRecord) -> FusedLane {
        let line = &self.lines.lines[index];
        let category_posterior = line.posterior().to_vec();
        let by_probability = |a: &usize, b: &usize| category_posterior[*a].total_cmp(&category_posterior[*b]);
        let best = (0..category_posterior.len()).max_by(by_probability).unwrap_or(0);
        FusedLane {
            id: FusedLaneId { stretch: u32::try_from(stretch).unwrap_or(u32::MAX), ..line.id },
            category: Category::ALL[best],
            category_posterior,
            points: points.to_vec(),
            drives: record.drives,
            observations: record.observations,
            first_seen: record.first_seen.unwrap_or_default(),
            last_seen: record.last_seen.unwrap_or_default(),
        }
    }
}

/// Runs of knots that are there and whose place is known, of at least the shortest length.
fn stretches(points: &[FusedPoint], params: &FleetParams) -> Vec<Range<usize>> {
    let mut stretches: Vec<Range<usize>> = Vec::new();
    let shown = |point: &FusedPoint| {
        point.existence >= params.least_existence && point.lateral_sigma_m <= params.most_lateral_sigma_m
    };
    for (knot, _) in points.iter().enumerate().filter(|(_, point)| shown(point)) {
        match stretches.last_mut() {
            Some(open) if open.end + params.bridged_knots >= knot => open.end = knot + 1,
            _ => stretches.push(knot..knot + 1),
        }
    }
    stretches.retain(|knots| (knots.len() as f64 - 1.0) * params.line_knot_m >= params.shortest_lane_m);
    stretches
}
