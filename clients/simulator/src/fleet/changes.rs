//! How the road changes between drives: lines that vanish, appear, move, are repainted; construction zones that come and go.
//!
//! A [`ChangePlan`] says how many of each kind; they come to streets chosen by chance, each at a time of its own between
//! two drives. A drive sees the road as it is when the drive begins. A moved line leaves its old course and comes back to it
//! over [`TAPER_POINTS`] metres at both ends. In a construction zone every painted line of a stretch gives way to a
//! temporary yellow one 0.8 to 1.2 m beside it, and comes back when the zone goes. Curbs never change.

use std::{collections::BTreeMap, ops::Range};

use lanemap_core::{Category, TimestampNs};
use nalgebra::{Point3, Vector2};

use super::truth::{FleetTrueLine, FleetTruth};
use crate::{
    random::{SimRng, choose, happens, uniform},
    road::{LinkIndex, LinkKind, RoadLine, RoadLineId, RoadNetwork, cross_section::smooth_step},
};

/// How far a moved line takes to leave its old course, points (metres).
const TAPER_POINTS: usize = 12;
/// What stays as it is at both ends of a line, points (metres).
const KEPT_POINTS: usize = 25;
/// Pieces of a line have its number and, above these bits, one of their own.
const PIECE_BITS: u32 = 24;
/// Tries to find a line where a change fits, for each change asked for.
const TRIES: usize = 200;

/// How many changes of each kind there are, and when.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ChangePlan {
    /// Stretches of lines that vanish.
    pub vanished: u32,
    /// Stretches of lines that are painted where there was none.
    pub appeared: u32,
    /// Stretches of lines that move sideways by 0.5 to 1.5 m.
    pub moved: u32,
    /// Stretches of lines that get another category.
    pub repainted: u32,
    /// Construction zones.
    pub zones: u32,
    /// Least length of a change, metres.
    pub min_length_m: f64,
    /// Greatest length of a change, metres.
    pub max_length_m: f64,
    /// The first drive that may be the first to see a change.
    pub first_drive: u32,
    /// The last drive that may be the first to see a change.
    pub last_drive: u32,
    /// Number of drives that begin while a construction zone is there.
    pub zone_drives: u32,
}

impl ChangePlan {
    /// A road that stays as it is.
    #[must_use]
    pub fn none() -> Self {
        Self { vanished: 0, appeared: 0, moved: 0, repainted: 0, zones: 0, ..Self::some(0, 0) }
    }

    /// A few changes of each kind between two drives.
    #[must_use]
    pub fn some(first_drive: u32, last_drive: u32) -> Self {
        Self {
            vanished: 4,
            appeared: 4,
            moved: 4,
            repainted: 4,
            zones: 2,
            min_length_m: 60.0,
            max_length_m: 140.0,
            first_drive,
            last_drive,
            zone_drives: 10,
        }
    }
}

/// What happens to a stretch of a line.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum ChangeKind {
    /// It is there no more.
    Vanished,
    /// It is there from now on.
    Appeared,
    /// It lies elsewhere.
    Moved {
        /// How far to the left, in the direction of the line's points, metres.
        left_m: f64,
    },
    /// It has another category.
    Repainted {
        /// The old one.
        from: Category,
        /// The new one.
        to: Category,
    },
}

/// One change of one line.
#[derive(Clone, Debug, PartialEq)]
pub struct RoadChange {
    /// When it happens; drives that begin later see it.
    pub time: TimestampNs,
    /// What happens.
    pub kind: ChangeKind,
    /// The line; temporary lines have numbers beyond those of the network.
    pub line: RoadLineId,
    /// The construction zone that it belongs to, if any.
    pub zone: Option<u32>,
    /// The stretch as it was, metres in the world frame; empty where there was nothing.
    pub before: Vec<Point3<f64>>,
    /// The stretch as it is, metres in the world frame; empty where there is nothing.
    pub after: Vec<Point3<f64>>,
}

/// Everything that changes in a world.
#[derive(Clone, Debug, Default)]
pub(super) struct Timeline {
    edits: Vec<Edit>,
    temporary: Vec<Temporary>,
    changes: Vec<RoadChange>,
}

/// A stretch of a line that is not as it was built, for a time.
#[derive(Clone, Debug)]
struct Edit {
    line: RoadLineId,
    stretch: Range<usize>,
    time: Range<i64>,
    effect: Effect,
}

#[derive(Clone, Debug)]
enum Effect {
    Gone,
    Moved(Vec<Point3<f64>>),
    Painted(Category),
}

/// A line that is there for a time only.
#[derive(Clone, Debug)]
struct Temporary {
    line: RoadLine,
    link: LinkIndex,
    time: Range<i64>,
}

/// The lines that are not as they were built, at one time.
#[derive(Clone, Debug, Default)]
pub(super) struct Epoch {
    /// What is left of changed lines.
    pieces: BTreeMap<RoadLineId, Vec<RoadLine>>,
    /// Temporary lines of links.
    temporary: BTreeMap<LinkIndex, Vec<RoadLine>>,
}

/// The painted line of which a piece is part.
#[must_use]
pub fn whole_line(piece: RoadLineId) -> RoadLineId {
    RoadLineId(piece.0 & ((1 << PIECE_BITS) - 1))
}

impl Timeline {
    /// Draws the changes of a plan. `start_of` gives the time of a drive's first frame.
    pub(super) fn draw(
        plan: &ChangePlan,
        network: &RoadNetwork,
        start_of: impl Fn(u32) -> TimestampNs,
        rng: &mut SimRng,
    ) -> Self {
        let mut timeline = Self::default();
        // Half way between the start of a drive and the one before it.
        let before_drive = |drive: u32| {
            let (now, next) = (start_of(drive).0, start_of(drive + 1).0);
            now - (next - now) / 2
        };
        let span = plan.last_drive.saturating_sub(plan.first_drive) as usize + 1;
        let first_to_see = |rng: &mut SimRng| plan.first_drive + u32::try_from(choose(rng, span)).unwrap_or(0);
        for zone in 0..plan.zones {
            let drive = first_to_see(rng);
            let time = before_drive(drive)..before_drive(drive + plan.zone_drives);
            timeline.add_zone(zone, plan, network, time, rng);
        }
        let kinds = [
            (plan.vanished, ChangeKind::Vanished),
            (plan.appeared, ChangeKind::Appeared),
            (plan.moved, ChangeKind::Moved { left_m: 0.0 }),
            (plan.repainted, ChangeKind::Repainted { from: Category::Unknown, to: Category::Unknown }),
        ];
        for (count, kind) in kinds {
            for _ in 0..count {
                let time = before_drive(first_to_see(rng));
                timeline.add_change(kind, plan, network, time, rng);
            }
        }
        timeline.changes.sort_by_key(|change| (change.time, change.line));
        timeline
    }

    /// The changes in the order of time.
    pub(super) fn changes(&self) -> &[RoadChange] {
        &self.changes
    }

    /// The lines that are not as they were built, at a time.
    pub(super) fn epoch(&self, network: &RoadNetwork, time: TimestampNs) -> Epoch {
        let mut edits: BTreeMap<RoadLineId, Vec<&Edit>> = BTreeMap::new();
        for edit in self.edits.iter().filter(|edit| edit.time.contains(&time.0)) {
            edits.entry(edit.line).or_default().push(edit);
        }
        let pieces = edits.into_iter().map(|(line, edits)| (line, pieces_of(network.line(line), edits))).collect();
        let mut temporary: BTreeMap<LinkIndex, Vec<RoadLine>> = BTreeMap::new();
        for line in self.temporary.iter().filter(|line| line.time.contains(&time.0)) {
            temporary.entry(line.link).or_default().push(line.line.clone());
        }
        Epoch { pieces, temporary }
    }

    fn add_change(
        &mut self,
        kind: ChangeKind,
        plan: &ChangePlan,
        network: &RoadNetwork,
        time_ns: i64,
        rng: &mut SimRng,
    ) {
        let left_m = uniform(rng, 0.5, 1.5) * if happens(rng, 0.5) { 1.0 } else { -1.0 };
        for _ in 0..TRIES {
            let Some((link, stretch)) = self.free_street(plan, network, rng) else { continue };
            let lines = &network.link(link).lines;
            let line = network.line(lines[choose(rng, lines.len())]);
            if is_curb(line.category) {
                continue;
            }
            let old = line.points[stretch.clone()].to_vec();
            let (kind, effect, time, before, after) = match kind {
                ChangeKind::Vanished => (kind, Effect::Gone, time_ns..i64::MAX, old, Vec::new()),
                ChangeKind::Appeared => (kind, Effect::Gone, i64::MIN..time_ns, Vec::new(), old),
                ChangeKind::Moved { .. } => {
                    let moved = displaced(network, line, &stretch, left_m, true);
                    if !has_room(network, lines, line, &moved) {
                        continue;
                    }
                    let effect = Effect::Moved(moved.clone());
                    (ChangeKind::Moved { left_m }, effect, time_ns..i64::MAX, old, moved)
                }
                ChangeKind::Repainted { .. } => {
                    let to = repainted(line.category, rng);
                    let kind = ChangeKind::Repainted { from: line.category, to };
                    (kind, Effect::Painted(to), time_ns..i64::MAX, old.clone(), old)
                }
            };
            self.edits.push(Edit { line: line.id, stretch, time, effect });
            self.changes.push(RoadChange {
                time: TimestampNs(time_ns),
                kind,
                line: line.id,
                zone: None,
                before,
                after,
            });
            return;
        }
    }

    fn add_zone(&mut self, zone: u32, plan: &ChangePlan, network: &RoadNetwork, time: Range<i64>, rng: &mut SimRng) {
        let aside_m = uniform(rng, 0.8, 1.2) * if happens(rng, 0.5) { 1.0 } else { -1.0 };
        let Some((link, stretch)) = (0..TRIES).find_map(|_| self.free_street(plan, network, rng)) else { return };
        let painted = network.link(link).lines.iter().map(|id| network.line(*id));
        for line in painted.filter(|line| !is_curb(line.category)) {
            let number = network.lines().len() + self.temporary.len();
            let temporary = RoadLine {
                id: RoadLineId(u32::try_from(number).unwrap_or(u32::MAX)),
                category: if is_dashed(line.category) { Category::YellowDashed } else { Category::YellowSolid },
                points: displaced(network, line, &stretch, aside_m, false),
            };
            let old = line.points[stretch.clone()].to_vec();
            let comes_and_goes = [(time.start, true), (time.end, false)];
            for (at, comes) in comes_and_goes {
                let change = |line, appears: bool, points: &Vec<Point3<f64>>| RoadChange {
                    time: TimestampNs(at),
                    kind: if appears { ChangeKind::Appeared } else { ChangeKind::Vanished },
                    line,
                    zone: Some(zone),
                    before: if appears { Vec::new() } else { points.clone() },
                    after: if appears { points.clone() } else { Vec::new() },
                };
                self.changes.push(change(line.id, !comes, &old));
                self.changes.push(change(temporary.id, comes, &temporary.points));
            }
            self.edits.push(Edit { line: line.id, stretch: stretch.clone(), time: time.clone(), effect: Effect::Gone });
            self.temporary.push(Temporary { line: temporary, link, time: time.clone() });
        }
    }

    /// A stretch of a street that is long enough, and on which nothing changes yet near it.
    fn free_street(
        &self,
        plan: &ChangePlan,
        network: &RoadNetwork,
        rng: &mut SimRng,
    ) -> Option<(LinkIndex, Range<usize>)> {
        let link = LinkIndex(choose(rng, network.links().len()));
        let road = network.link(link);
        let length = crate::count_of(uniform(rng, plan.min_length_m, plan.max_length_m));
        let points = road.reference.len().checked_sub(length + 2 * KEPT_POINTS)?;
        let start = KEPT_POINTS + choose(rng, points);
        let stretch = start..start + length;
        let near = stretch.start.saturating_sub(KEPT_POINTS)..stretch.end + KEPT_POINTS;
        let is_taken = |edit: &Edit| {
            road.lines.contains(&edit.line) && edit.stretch.start < near.end && near.start < edit.stretch.end
        };
        let whole = road.lines.iter().all(|id| network.line(*id).points.len() >= stretch.end);
        (road.kind == LinkKind::Street && whole && !self.edits.iter().any(is_taken)).then_some((link, stretch))
    }
}

impl Epoch {
    /// A line as it is: whole, or what is left of it.
    pub(super) fn line<'a>(&'a self, network: &'a RoadNetwork, id: RoadLineId) -> &'a [RoadLine] {
        self.pieces.get(&id).map_or_else(|| std::slice::from_ref(network.line(id)), Vec::as_slice)
    }

    /// A line or piece of a line that is there, by its number.
    pub(super) fn find<'a>(&'a self, network: &'a RoadNetwork, id: RoadLineId) -> Option<&'a RoadLine> {
        let whole = whole_line(id);
        if (whole.0 as usize) < network.lines().len() {
            return self.line(network, whole).iter().find(|line| line.id == id);
        }
        self.temporary.values().flatten().find(|line| line.id == id)
    }

    /// The temporary lines of a link.
    pub(super) fn temporary(&self, link: LinkIndex) -> &[RoadLine] {
        self.temporary.get(&link).map_or(&[], Vec::as_slice)
    }

    /// Every line that is there.
    pub(super) fn truth(&self, network: &RoadNetwork) -> FleetTruth {
        let permanent = network.lines().iter().flat_map(|line| self.line(network, line.id));
        let lines = permanent.chain(self.temporary.values().flatten());
        let mut lines: Vec<_> = lines
            .map(|line| FleetTrueLine {
                line: whole_line(line.id),
                category: line.category,
                points: line.points.clone(),
            })
            .collect();
        lines.sort_by_key(|line| line.line);
        FleetTruth { lines }
    }
}

/// What is left of a line under edits, which do not overlap.
fn pieces_of(line: &RoadLine, mut edits: Vec<&Edit>) -> Vec<RoadLine> {
    edits.sort_by_key(|edit| edit.stretch.start);
    let mut runs: Vec<(Category, Vec<Point3<f64>>)> = vec![(line.category, Vec::new())];
    let mut from = 0;
    for edit in edits {
        let Range { start, end } = edit.stretch.clone();
        let (_, mut run) = runs.pop().unwrap_or((line.category, Vec::new()));
        run.extend(&line.points[from..start]);
        match &edit.effect {
            Effect::Gone => {
                runs.push((line.category, run));
                runs.push((line.category, Vec::new()));
            }
            Effect::Moved(points) => {
                run.extend(points);
                runs.push((line.category, run));
            }
            Effect::Painted(category) => {
                // Neighbouring pieces share the point where they meet.
                run.push(line.points[start]);
                runs.push((line.category, run));
                runs.push((*category, line.points[start..end].to_vec()));
                runs.push((line.category, vec![line.points[end - 1]]));
            }
        }
        from = end;
    }
    if let Some((_, run)) = runs.last_mut() {
        run.extend(&line.points[from..]);
    }
    join_ends(line, &mut runs);
    let pieces = runs.into_iter().filter(|(_, points)| points.len() >= 2).zip(0..);
    pieces
        .map(|((category, points), piece)| RoadLine {
            id: RoadLineId(line.id.0 | (piece << PIECE_BITS)),
            category,
            points,
        })
        .collect()
}

/// Of a closed line that was cut, the last piece runs on into the first.
fn join_ends(line: &RoadLine, runs: &mut Vec<(Category, Vec<Point3<f64>>)>) {
    if !line.is_closed() || runs.len() < 2 {
        return;
    }
    if let Some((_, mut last)) = runs.pop() {
        last.pop();
        last.append(&mut runs[0].1);
        runs[0].1 = last;
    }
}

/// A stretch of a line moved to the left, with or without a taper at its ends.
fn displaced(
    network: &RoadNetwork,
    line: &RoadLine,
    stretch: &Range<usize>,
    left_m: f64,
    tapered: bool,
) -> Vec<Point3<f64>> {
    stretch
        .clone()
        .map(|k| {
            let along = (line.points[k + 1] - line.points[k - 1]).xy().normalize();
            let in_m = |points: usize| smooth_step(points as f64 / TAPER_POINTS as f64);
            let share = if tapered { in_m(k - stretch.start) * in_m(stretch.end - 1 - k) } else { 1.0 };
            let place = line.points[k].xy() + Vector2::new(-along.y, along.x) * (left_m * share);
            Point3::new(place.x, place.y, network.terrain().height_m(&place))
        })
        .collect()
}

/// Whether a moved stretch keeps clear of the other lines of its link.
fn has_room(network: &RoadNetwork, lines: &[RoadLineId], moved_line: &RoadLine, moved: &[Point3<f64>]) -> bool {
    const CLEAR_M: f64 = 0.8;
    let others = lines.iter().filter(|id| **id != moved_line.id).map(|id| network.line(*id));
    let middle = moved[moved.len() / 2];
    others.flat_map(|line| &line.points).all(|point| (point - middle).xy().norm() > CLEAR_M)
}

fn is_curb(category: Category) -> bool {
    matches!(category, Category::LeftCurb | Category::RightCurb)
}

fn is_dashed(category: Category) -> bool {
    matches!(category, Category::WhiteDashed | Category::YellowDashed)
}

/// Another category for a line.
fn repainted(category: Category, rng: &mut SimRng) -> Category {
    use Category as C;
    let others: &[C] = match category {
        C::WhiteDashed => &[C::WhiteSolid, C::YellowDashed],
        C::WhiteSolid => &[C::WhiteDashed, C::YellowSolid],
        C::YellowDashed => &[C::YellowSolid, C::WhiteDashed],
        _ => &[C::YellowDashed, C::WhiteSolid],
    };
    others[choose(rng, others.len())]
}

#[cfg(test)]
mod tests;
