//! `/differences?since=R`: where the map is another one than it was at a revision, as GeoJSON.
//!
//! Lines of both states are compared by where they lie, control point by control point, not by their names: a line that was
//! given another name is no change for whoever drives on it. A stretch of which no line lay within [`SAME_M`] before has
//! `appeared`; where the line of its name lay beside, at most [`MOVED_M`] away, it has `moved`; a stretch that no line
//! follows any more has `vanished`. Stretches of fewer than [`LEAST_POINTS`] control points are passed over.
//!
//! Not guaranteed: the state before where that version of a cell is not kept; the nearest one before it is taken.

use std::collections::{BTreeMap, HashMap};

use axum::{
    extract::State,
    http::{HeaderMap, Uri, header},
    response::Response,
};
use lanemap_core::{Category, fleet::CellId, geometry::georeference::Anchor};
use lanemap_proto::v1;
use nalgebra::Point3;
use serde::Serialize;

use super::{
    ServeState,
    bounds::Bounds,
    entity_tag::EntityTag,
    features::{LaneGeometry, category_name, on_the_earth},
    in_background,
    items::of_cell,
    line::{rounded, written},
    problem::Problem,
    query::Parameters,
    sessions::GEOJSON,
    timeline::not_at_revision,
};
use crate::{
    fuse::{CellVersion, MapRevision, SharedMap, wire::positions},
    journal::JournalError,
};

/// A line is the same within this distance of where it was, metres.
const SAME_M: f64 = 0.35;
/// Farther than this a line did not move, but went and came, metres.
const MOVED_M: f64 = 2.5;
/// Control points of a stretch that is told, about 3 m apart.
const LEAST_POINTS: usize = 3;
/// Most stretches of an answer.
const MOST_STRETCHES: usize = 5_000;

#[derive(Debug, Serialize)]
#[serde(tag = "type", rename = "FeatureCollection")]
struct Differences {
    since: MapRevision,
    revision: MapRevision,
    #[serde(rename = "numberReturned")]
    number_returned: usize,
    /// Whether there are more: ask for a smaller box.
    more: bool,
    features: Vec<Stretch>,
}

#[derive(Debug, PartialEq, Serialize)]
#[serde(tag = "type", rename = "Feature")]
struct Stretch {
    geometry: LaneGeometry,
    properties: Difference,
}

#[derive(Clone, Debug, PartialEq, Serialize)]
struct Difference {
    kind: Kind,
    cell: String,
    /// The line: as it is now, or as it was where it vanished.
    lane: String,
    category: &'static str,
    /// How far it moved at most, metres.
    #[serde(skip_serializing_if = "Option::is_none")]
    by_m: Option<f64>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
enum Kind {
    Appeared,
    Moved,
    Vanished,
}

/// `GET /differences`
pub(super) async fn differences(
    State(state): State<ServeState>,
    uri: Uri,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let parameters = Parameters::read(&uri, &["since", "bbox"])?;
    let bounds = parameters.get("bbox", Bounds::parse)?;
    let since = parameters.get("since", str::parse::<MapRevision>)?.unwrap_or_default();
    let map = state.map;
    let before = map.versions_at(since).map_err(|error| not_at_revision("since", error))?;
    let (revision, cells) = map.list_with_revision();
    let changed = cells.into_iter().filter_map(|(cell, record)| {
        let from = before.get(&cell).copied().unwrap_or_default();
        let is_wanted = bounds.is_none_or(|bounds| of_cell(cell).touches(&bounds));
        (from != record.version && is_wanted).then_some((cell, from, record.version))
    });
    let changed: Vec<_> = changed.collect();
    let tag = EntityTag::of((&changed, since, uri.query()));
    if tag.is_held_by(&headers) {
        return Ok(tag.not_modified());
    }
    let told = in_background(move || told(&map, &changed, since, revision, bounds.as_ref())).await??;
    let body = serde_json::to_vec(&told).map_err(|_| Problem::Internal)?;
    Ok(tag.on(([(header::CONTENT_TYPE, GEOJSON)], body)))
}

fn told(
    map: &SharedMap,
    changed: &[(CellId, CellVersion, CellVersion)],
    since: MapRevision,
    revision: MapRevision,
    bounds: Option<&Bounds>,
) -> Result<Differences, JournalError> {
    let mut features = Vec::new();
    for (cell, from, to) in changed {
        let (Some(before), Some(now)) = (map.version_near(*cell, *from)?, map.version_near(*cell, *to)?) else {
            continue;
        };
        let stretches = stretches(*cell, &before.map, &now.map);
        features.extend(stretches.into_iter().filter(|each| bounds.is_none_or(|bounds| each.geometry.enters(bounds))));
        if features.len() > MOST_STRETCHES {
            break;
        }
    }
    let more = features.len() > MOST_STRETCHES;
    features.truncate(MOST_STRETCHES);
    Ok(Differences { since, revision, number_returned: features.len(), more, features })
}

/// What differs between two versions of a cell.
fn stretches(cell: CellId, before: &v1::CellMap, now: &v1::CellMap) -> Vec<Stretch> {
    let (before, now) = (Lines::of(before), Lines::of(now));
    let anchor = cell.anchor();
    let came = now.all.iter().flat_map(|line| {
        runs(line, &anchor, |index| {
            let point = &line.points[index];
            if before.distance_m(point).is_some_and(|distance_m| distance_m <= SAME_M) {
                return None;
            }
            Some(match before.distance_to_lane_m(line.lane, point).filter(|distance_m| *distance_m <= MOVED_M) {
                Some(distance_m) => (Kind::Moved, distance_m),
                None => (Kind::Appeared, 0.0),
            })
        })
    });
    let went = before.all.iter().flat_map(|line| {
        runs(line, &anchor, |index| {
            let point = &line.points[index];
            let is_there = now.distance_m(point).is_some_and(|distance_m| distance_m <= SAME_M)
                || now.distance_to_lane_m(line.lane, point).is_some_and(|distance_m| distance_m <= MOVED_M);
            (!is_there).then_some((Kind::Vanished, 0.0))
        })
    });
    came.chain(went).collect()
}

/// Runs of a line's points of which one kind of change is told.
fn runs(line: &Line<'_>, anchor: &Anchor, change: impl Fn(usize) -> Option<(Kind, f64)>) -> Vec<Stretch> {
    let changes: Vec<_> = (0..line.points.len()).map(change).collect();
    let kinds = changes.iter().map(|change| change.map(|(kind, _)| kind)).collect::<Vec<_>>();
    let mut first = 0;
    let runs = kinds.chunk_by(|one, other| one == other).map(|run| {
        let range = first..first + run.len();
        first = range.end;
        (run[0], range)
    });
    let long = runs.filter_map(|(kind, range)| Some((kind.filter(|_| range.len() >= LEAST_POINTS)?, range)));
    long.map(|(kind, range)| {
        let by_m = changes[range.clone()].iter().flatten().map(|(_, by_m)| *by_m).fold(0.0, f64::max);
        let coordinates = line.points[range].iter().map(|point| written(anchor.wgs84_from_enu(point))).collect();
        let category = u8::try_from(line.category).ok().and_then(Category::from_openlane_code).unwrap_or_default();
        Stretch {
            geometry: on_the_earth(coordinates),
            properties: Difference {
                kind,
                cell: line.cell.to_owned(),
                lane: line.lane.to_owned(),
                category: category_name(category),
                by_m: (kind == Kind::Moved).then(|| rounded(by_m, 1e2)),
            },
        }
    })
    .collect()
}

struct Line<'a> {
    cell: &'a str,
    lane: &'a str,
    category: i32,
    points: Vec<Point3<f64>>,
}

/// Lines of a cell, and where they lie.
struct Lines<'a> {
    all: Vec<Line<'a>>,
    by_name: BTreeMap<&'a str, Vec<usize>>,
    /// Segments, a line's number and that of its first point, by the squares that they touch.
    squares: HashMap<[i64; 2], Vec<(usize, usize)>>,
}

/// Side of a square, metres: longer than segments are, so that each touches few.
const SQUARE_M: f64 = 5.0;

impl<'a> Lines<'a> {
    fn of(map: &'a v1::CellMap) -> Self {
        let lines = map.lanes.iter().map(|lane| Line {
            cell: &map.cell,
            lane: &lane.id,
            category: lane.category,
            points: positions(lane),
        });
        let all: Vec<Line<'a>> = lines.collect();
        let mut by_name: BTreeMap<&str, Vec<usize>> = BTreeMap::new();
        let mut squares: HashMap<[i64; 2], Vec<(usize, usize)>> = HashMap::new();
        for (number, line) in all.iter().enumerate() {
            by_name.entry(line.lane).or_default().push(number);
            for (first, pair) in line.points.windows(2).enumerate() {
                let (a, b) = (square(&pair[0]), square(&pair[1]));
                for x in a[0].min(b[0])..=a[0].max(b[0]) {
                    for y in a[1].min(b[1])..=a[1].max(b[1]) {
                        squares.entry([x, y]).or_default().push((number, first));
                    }
                }
            }
        }
        Self { all, by_name, squares }
    }

    /// Distance from the nearest line in the plane, where one is within [`SQUARE_M`].
    fn distance_m(&self, point: &Point3<f64>) -> Option<f64> {
        let [x, y] = square(point);
        let near =
            (x - 1..=x + 1).flat_map(|x| (y - 1..=y + 1).filter_map(move |y| self.squares.get(&[x, y]))).flatten();
        near.map(|(number, first)| segment_m(point, &self.all[*number].points[*first..first + 2]))
            .min_by(f64::total_cmp)
    }

    /// Distance from the line of a name in the plane.
    fn distance_to_lane_m(&self, lane: &str, point: &Point3<f64>) -> Option<f64> {
        let lines = self.by_name.get(lane)?.iter().map(|number| &self.all[*number]);
        lines.flat_map(|line| line.points.windows(2)).map(|pair| segment_m(point, pair)).min_by(f64::total_cmp)
    }
}

#[expect(clippy::cast_possible_truncation, reason = "a cell is a few kilometres wide")]
fn square(point: &Point3<f64>) -> [i64; 2] {
    [(point.x / SQUARE_M).floor() as i64, (point.y / SQUARE_M).floor() as i64]
}

/// Distance of a point from a segment in the plane, metres.
fn segment_m(point: &Point3<f64>, ends: &[Point3<f64>]) -> f64 {
    let (along, to) = ((ends[1] - ends[0]).xy(), (point - ends[0]).xy());
    let share = (along.dot(&to) / along.norm_squared().max(1e-12)).clamp(0.0, 1.0);
    (to - along * share).norm()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn map(lines: &[(&str, i32, usize)]) -> v1::CellMap {
        let lane = |(id, north_mm, points): &(&str, i32, usize)| {
            let mut xyz_mm = vec![0, *north_mm, 0];
            xyz_mm.extend((1..*points).flat_map(|_| [3_000, 0, 0]));
            v1::FusedLane { id: (*id).to_owned(), category: 2, xyz_mm, ..v1::FusedLane::default() }
        };
        v1::CellMap { cell: "14-8718-5685".into(), lanes: lines.iter().map(lane).collect(), ..v1::CellMap::default() }
    }

    fn told(before: &[(&str, i32, usize)], now: &[(&str, i32, usize)]) -> Vec<(Kind, String, usize, Option<f64>)> {
        let cell = CellId::new(8_718, 5_685).unwrap();
        let stretches = stretches(cell, &map(before), &map(now));
        let brief = |stretch: Stretch| {
            let Difference { kind, lane, by_m, .. } = stretch.properties;
            (kind, lane, stretch.geometry.size(), by_m)
        };
        stretches.into_iter().map(brief).collect()
    }

    #[test]
    fn a_line_that_grew_appeared_where_it_grew_and_one_that_was_renamed_is_no_change() {
        assert_eq!(told(&[("a", 0, 10)], &[("b", 100, 16)]), [(Kind::Appeared, "b".into(), 6, None)]);
    }

    #[test]
    fn a_line_that_lies_beside_moved_and_one_that_no_line_follows_vanished() {
        let told = told(&[("a", 0, 10), ("c", 20_000, 5)], &[("a", 1_200, 10)]);
        let expected = [(Kind::Moved, "a".to_owned(), 10, Some(1.2)), (Kind::Vanished, "c".to_owned(), 5, None)];
        assert_eq!(told, expected);
    }

    #[test]
    fn a_line_that_moved_by_centimetres_is_no_change() {
        assert_eq!(told(&[("a", 0, 10)], &[("a", 300, 10)]), []);
    }
}
