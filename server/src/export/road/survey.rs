//! The survey of a map for its roads: what lies beside a line, station by station, and where that changes.

use std::{
    collections::{BTreeMap, HashMap},
    ops::Range,
};

use lanemap_core::Category;
use nalgebra::{Point3, Vector2};

use super::{Border, Gap, GapKind, LEAST_EXISTENCE, NARROWEST_LANE_M, Road, Section, Travel, WIDEST_LANE_M};
use crate::export::map_line::MapLine;

/// Stations of one segment of a reference, about a metre apart.
const STATIONS: usize = 3;
/// How far from the reference lines are looked for, metres.
const REACH_M: f64 = 30.0;
/// Greatest difference in height of lines of one road, metres, per metre between them and at least.
const MOST_SLOPE: f64 = 0.15;
const LEAST_HEIGHT_M: f64 = 1.0;
/// Least cosine of the angle between lines of one road.
const LEAST_COS: f64 = 0.9;
/// Shortest section between two others, in segments of about 3 m.
const SHORTEST_SECTION: f64 = 0.8;
/// How far a road reaches into what another one has of a line, to meet it, in segments of about 3 m.
const MEET: f64 = 0.6;
/// Longest segment that bounds lanes, metres: those of a map are 3 m long.
const LONGEST_SEGMENT_M: f64 = 200.0;
/// Side of the squares in which segments are looked up, metres.
const SQUARE_M: f64 = 12.0;

/// Where lines are, and what of them roads have.
pub(super) struct Survey<'a> {
    lines: &'a [MapLine],
    squares: HashMap<(i64, i64), Vec<(usize, usize)>>,
    /// Of each line, what roads have of it: stretches that do not overlap, in order.
    taken: Vec<Vec<(f64, f64)>>,
}

/// A line across a station of a reference.
#[derive(Clone, Copy, Debug)]
struct Hit {
    line: usize,
    parameter: f64,
    left_m: f64,
    along: bool,
}

/// The borders at a station, from left to right.
#[derive(Clone, Debug, Default)]
struct Across {
    hits: Vec<Hit>,
}

/// What makes two stations alike: the lines, whether they run along the reference, their kinds, and what lies between.
type Structure = Vec<(usize, bool, Category, GapKind)>;

impl Across {
    fn structure(&self, lines: &[MapLine]) -> Structure {
        let mut structure = Vec::with_capacity(self.hits.len());
        for (index, hit) in self.hits.iter().enumerate() {
            let width_m = self.hits.get(index + 1).map_or(0.0, |next| hit.left_m - next.left_m);
            let kind = if width_m >= NARROWEST_LANE_M { GapKind::Lane } else { GapKind::Narrow };
            structure.push((hit.line, hit.along, lines[hit.line].piece_at(hit.parameter).category, kind));
        }
        structure
    }
}

impl<'a> Survey<'a> {
    pub(super) fn of(lines: &'a [MapLine]) -> Self {
        let mut squares: HashMap<(i64, i64), Vec<(usize, usize)>> = HashMap::new();
        for (index, line) in lines.iter().enumerate() {
            for (segment, cubic) in line.segments.iter().enumerate() {
                let (start, end) = (cubic.point(0.0), cubic.point(1.0));
                if nalgebra::distance(&start, &end) > LONGEST_SEGMENT_M {
                    continue;
                }
                // A segment swings out of its chord by decimetres.
                let (low, high) = (start.inf(&end), start.sup(&end));
                for x in square(low.x - 0.5)..=square(high.x + 0.5) {
                    for y in square(low.y - 0.5)..=square(high.y + 0.5) {
                        squares.entry((x, y)).or_default().push((index, segment));
                    }
                }
            }
        }
        Self { lines, squares, taken: vec![Vec::new(); lines.len()] }
    }

    /// What no road has of a line.
    pub(super) fn free(&self, line: usize) -> Vec<(f64, f64)> {
        let mut free = Vec::new();
        let mut start = 0.0;
        for (from, to) in &self.taken[line] {
            if *from > start + 1e-6 {
                free.push((start, *from));
            }
            start = start.max(*to);
        }
        let end = self.lines[line].end();
        if end > start + 1e-6 {
            free.push((start, end));
        }
        free
    }

    /// A place on a line that a road may have: itself, or where the line becomes free, where that is near.
    fn met(&self, line: usize, parameter: f64) -> Option<f64> {
        for (from, to) in &self.taken[line] {
            if parameter > *from && parameter < *to {
                let (back, on) = (parameter - from, to - parameter);
                return (back.min(on) <= MEET).then_some(if back <= on { *from } else { *to });
            }
        }
        Some(parameter)
    }

    pub(super) fn take(&mut self, road: &Road) {
        for section in &road.sections {
            for border in &section.borders {
                self.taken[border.line].push((border.from.min(border.to), border.from.max(border.to)));
            }
        }
        for section in &road.sections {
            for border in &section.borders {
                let taken = &mut self.taken[border.line];
                taken.sort_by(|a, b| a.0.total_cmp(&b.0));
                taken.dedup_by(|next, kept| {
                    let joins = next.0 <= kept.1 + 1e-6;
                    if joins {
                        kept.1 = kept.1.max(next.1);
                    }
                    joins
                });
            }
        }
    }

    /// The sections along a stretch of a reference.
    pub(super) fn sections(&self, line: usize, from: f64, to: f64) -> Vec<Section> {
        let parameters = stations(from, to);
        let across: Vec<Across> = parameters.iter().map(|parameter| self.across(line, *parameter)).collect();
        let structures: Vec<Structure> = across.iter().map(|across| across.structure(self.lines)).collect();
        let mut cuts = vec![from];
        let mut runs: Vec<Range<usize>> = std::iter::once(0..0).collect();
        for (index, pair) in structures.windows(2).enumerate() {
            if let Some(run) = runs.last_mut() {
                run.end = index + 1;
            }
            if pair[0] != pair[1] {
                cuts.push(self.change(line, parameters[index], parameters[index + 1], &pair[0]));
                runs.push(index + 1..index + 1);
            }
        }
        if let Some(run) = runs.last_mut() {
            run.end = across.len();
        }
        cuts.push(to);
        absorb_short(&structures, &mut runs, &mut cuts);
        // One parameter per line and cut, so that both sections share it to the bit.
        let mut at_cut: Vec<BTreeMap<usize, (f64, f64)>> = vec![BTreeMap::new(); cuts.len()];
        for (index, run) in runs.iter().enumerate() {
            for (cut, station) in [(index, run.start), (index + 1, run.end - 1)] {
                // The lines of a run are those of its first station: it may have taken in stations with more of them.
                let lines = &structures[run.start];
                let hits = across[station].hits.iter();
                for hit in hits.filter(|hit| lines.iter().any(|(line, ..)| *line == hit.line)) {
                    let place = || self.at_cut(line, cuts[cut], hit);
                    at_cut[cut].entry(hit.line).or_insert_with(place);
                }
            }
        }
        let mut sections = Vec::new();
        for (index, run) in runs.iter().enumerate() {
            let hits = &across[run.start].hits;
            let borders: Vec<Border> = hits
                .iter()
                .map(|hit| {
                    let ((from, from_left_m), (to, to_left_m)) =
                        (at_cut[index][&hit.line], at_cut[index + 1][&hit.line]);
                    Border { line: hit.line, along: hit.along, from, to, from_left_m, to_left_m }
                })
                .collect();
            let structure = &structures[run.start];
            let gap = |(_, _, _, kind): &(usize, bool, Category, GapKind)| Gap {
                kind: *kind,
                travel: Travel::Along,
                goes_on_in: None,
            };
            let gaps = structure[..structure.len() - 1].iter().map(gap);
            let gaps = gaps.enumerate().map(|(index, gap)| {
                // What another road has of a line up to here leaves nothing of it, or less.
                let is_whole =
                    |border: &Border| (border.to - border.from) * if border.along { 1.0 } else { -1.0 } > 0.02;
                let kind =
                    if is_whole(&borders[index]) && is_whole(&borders[index + 1]) { gap.kind } else { GapKind::Narrow };
                Gap { kind, ..gap }
            });
            let gaps = gaps.collect();
            let reference = borders.iter().position(|border| border.line == line).unwrap_or_default();
            sections.push(Section { from: cuts[index], to: cuts[index + 1], gaps, borders, reference });
        }
        sections
    }

    /// Where the structure ceases to be what it was, between two stations.
    fn change(&self, line: usize, mut before: f64, mut after: f64, structure: &Structure) -> f64 {
        for _ in 0..12 {
            let middle = 0.5 * (before + after);
            if self.across(line, middle).structure(self.lines) == *structure {
                before = middle;
            } else {
                after = middle;
            }
        }
        before
    }

    /// The place of a border at a cut: its parameter, and how far to the left of the reference it lies.
    fn at_cut(&self, line: usize, cut: f64, hit: &Hit) -> (f64, f64) {
        if hit.line == line {
            return (cut, 0.0);
        }
        let (origin, tangent) = (self.lines[line].point(cut), self.lines[line].tangent(cut));
        let (parameter, left_m) = abreast(&self.lines[hit.line], &origin, &tangent, hit.parameter);
        (self.met(hit.line, parameter).unwrap_or(parameter), left_m)
    }

    /// The borders at a station of a reference.
    fn across(&self, line: usize, parameter: f64) -> Across {
        let reference = &self.lines[line];
        let (origin, tangent) = (reference.point(parameter), reference.tangent(parameter));
        let own = Hit { line, parameter, left_m: 0.0, along: true };
        if reference.existence() < LEAST_EXISTENCE {
            return Across { hits: vec![own] };
        }
        let mut hits = self.hits(line, &origin, &tangent);
        hits.sort_by(|a, b| a.left_m.total_cmp(&b.left_m).then(a.line.cmp(&b.line)));
        let next = hits.partition_point(|hit| hit.left_m < 0.0);
        let right = self.walk(&hits[..next].iter().rev().copied().collect::<Vec<_>>());
        let mut borders = self.walk(&hits[next..]);
        borders.reverse();
        borders.push(own);
        borders.extend(
            right.into_iter().filter(|hit| borders.iter().all(|other| other.line != hit.line)).collect::<Vec<_>>(),
        );
        Across { hits: borders }
    }

    /// The borders on one side, outwards, until there is none within a lane's width, or one that another road has.
    fn walk(&self, outwards: &[Hit]) -> Vec<Hit> {
        let mut borders: Vec<Hit> = Vec::new();
        let mut at_m = 0.0;
        for hit in outwards {
            let is_known = borders.iter().any(|border| border.line == hit.line);
            let away_m = (hit.left_m - at_m).abs();
            if away_m > WIDEST_LANE_M || is_known {
                break;
            }
            // On the reference itself, or on the border before: a line drawn twice.
            let Some(_) = self.met(hit.line, hit.parameter).filter(|_| away_m > 0.03) else { break };
            at_m = hit.left_m;
            borders.push(*hit);
        }
        borders
    }

    /// Every line that crosses the plane across a reference, but the reference.
    fn hits(&self, line: usize, origin: &Point3<f64>, tangent: &Vector2<f64>) -> Vec<Hit> {
        let left = Vector2::new(-tangent.y, tangent.x);
        let (one, other) = (origin.xy() + left * REACH_M, origin.xy() - left * REACH_M);
        let mut hits: Vec<Hit> = Vec::new();
        for x in square(one.x.min(other.x))..=square(one.x.max(other.x)) {
            for y in square(one.y.min(other.y))..=square(one.y.max(other.y)) {
                for (index, segment) in self.squares.get(&(x, y)).into_iter().flatten() {
                    if *index != line && self.lines[*index].existence() >= LEAST_EXISTENCE {
                        hits.extend(self.hit(*index, *segment, origin, tangent));
                    }
                }
            }
        }
        // A line that is cut twice at the end of a segment, or found in two squares.
        hits.sort_by(|a, b| a.line.cmp(&b.line).then(a.left_m.total_cmp(&b.left_m)));
        hits.dedup_by(|a, b| a.line == b.line && (a.left_m - b.left_m).abs() < 1e-3);
        hits
    }

    fn hit(&self, index: usize, segment: usize, origin: &Point3<f64>, tangent: &Vector2<f64>) -> Option<Hit> {
        let cubic = &self.lines[index].segments[segment];
        let ahead = |u: f64| (cubic.point(u) - origin).xy().dot(tangent);
        let (at_start, at_end) = (ahead(0.0), ahead(1.0));
        // A plane through the joint of two segments may miss both by a rounding error.
        if at_start * at_end > 0.0 && at_start.abs().min(at_end.abs()) > 1e-6 {
            return None;
        }
        let mut u = if (at_start - at_end).abs() < 1e-12 { 0.5 } else { at_start / (at_start - at_end) };
        u = u.clamp(0.0, 1.0);
        for _ in 0..6 {
            let slope = cubic.derivative(u).xy().dot(tangent);
            if slope.abs() > 1e-9 {
                u = (u - ahead(u) / slope).clamp(0.0, 1.0);
            }
        }
        let point = cubic.point(u);
        let direction = cubic.derivative(u).xy().try_normalize(1e-9)?;
        let left_m = (point - origin).xy().dot(&Vector2::new(-tangent.y, tangent.x));
        let cos = direction.dot(tangent);
        let apart_m = (point.z - origin.z).abs();
        let is_beside = left_m.abs() <= REACH_M
            && cos.abs() >= LEAST_COS
            && apart_m <= (MOST_SLOPE * left_m.abs()).max(LEAST_HEIGHT_M);
        is_beside.then_some(Hit { line: index, parameter: segment as f64 + u, left_m, along: cos > 0.0 })
    }
}

/// Takes short runs into those beside them, where these have all their lines there: a line that begins or ends within them
/// bounds no lane for these few metres.
fn absorb_short(structures: &[Structure], runs: &mut Vec<Range<usize>>, cuts: &mut Vec<f64>) {
    let has_all = |of: usize, within: usize| {
        structures[of].iter().all(|(line, along, category, _)| {
            structures[within].iter().any(|other| (other.0, other.1, other.2) == (*line, *along, *category))
        })
    };
    let mut index = 1;
    while index + 1 < runs.len() {
        let short = runs[index].start;
        if cuts[index + 1] - cuts[index] < SHORTEST_SECTION {
            if has_all(runs[index - 1].start, short) {
                runs[index - 1].end = runs[index].end;
                runs.remove(index);
                cuts.remove(index);
                continue;
            }
            // The first station of a run tells its lines: the next run keeps its own.
            if has_all(runs[index + 1].start, short) {
                runs.remove(index);
                cuts.remove(index + 1);
                continue;
            }
        }
        index += 1;
    }
}

/// Where a line crosses the plane across a place, looked for from a parameter near it: its parameter, and how far to the left
/// it lies, metres. At the line's end, where it ends before the plane.
#[must_use]
pub fn abreast(line: &MapLine, origin: &Point3<f64>, tangent: &Vector2<f64>, near: f64) -> (f64, f64) {
    let mut parameter = near.clamp(0.0, line.end());
    for _ in 0..12 {
        let (segment, u) = line.locate(parameter);
        let cubic = &line.segments[segment];
        let ahead_m = (cubic.point(u) - origin).xy().dot(tangent);
        let slope = cubic.derivative(u).xy().dot(tangent);
        if slope.abs() < 1e-9 {
            break;
        }
        let next = (parameter - (ahead_m / slope).clamp(-1.0, 1.0)).clamp(0.0, line.end());
        let moved = (next - parameter).abs();
        parameter = next;
        if moved < 1e-12 {
            break;
        }
    }
    let left_m = (line.point(parameter) - origin).xy().dot(&Vector2::new(-tangent.y, tangent.x));
    (parameter, left_m)
}

#[expect(clippy::cast_possible_truncation, reason = "coordinates of a map are far below 2^63 metres")]
fn square(metres: f64) -> i64 {
    (metres / SQUARE_M).floor() as i64
}

/// Parameters from one to another, about a metre apart.
fn stations(from: f64, to: f64) -> Vec<f64> {
    let mut parameters = vec![from];
    let mut segment = from.floor();
    while segment < to {
        for station in 0..STATIONS {
            let parameter = segment + station as f64 / STATIONS as f64;
            if parameter > from + 0.05 && parameter < to - 0.05 {
                parameters.push(parameter);
            }
        }
        segment += 1.0;
    }
    parameters.push(to);
    parameters
}
