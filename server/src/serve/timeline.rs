//! `/timeline`: when the shared map changed, as far back as its states are kept.
//!
//! Time is cut into equal steps; a step in which the map changed names the last revision of it, which `/tiles/lanes` takes
//! as `revision`. What a slider over the versions of the map needs, in an answer whose size knows no busy map.

use axum::{
    Json,
    extract::State,
    http::{HeaderMap, Uri},
    response::Response,
};
use lanemap_core::TimestampNs;
use serde::Serialize;

use super::{
    ServeState,
    entity_tag::EntityTag,
    features::rfc3339,
    in_background,
    problem::Problem,
    query::{Parameters, parse_limit},
};
use crate::fuse::{MapRevision, Publication, RevisionError, SharedMap};

/// Steps, where the query does not say.
const DEFAULT_STEPS: usize = 200;
/// Most steps.
const MOST_STEPS: usize = 1_000;

#[derive(Debug, PartialEq, Serialize)]
struct Timeline {
    /// The oldest revision that is kept.
    oldest: MapRevision,
    /// The newest revision.
    newest: MapRevision,
    /// The steps in which the map changed, the oldest first.
    steps: Vec<Step>,
}

#[derive(Debug, PartialEq, Serialize)]
struct Step {
    /// The map at the end of the step.
    revision: MapRevision,
    /// When that was published, RFC 3339.
    at: String,
    /// Versions of cells that were published in the step.
    publications: u32,
    #[serde(skip)]
    at_ms: u64,
}

/// `GET /timeline`
pub(super) async fn timeline(
    State(state): State<ServeState>,
    uri: Uri,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let steps = Parameters::read(&uri, &["steps"])?.get("steps", |text| parse_limit(text, MOST_STEPS))?;
    let steps = steps.unwrap_or(DEFAULT_STEPS);
    let tag = EntityTag::of((state.map.oldest_revision(), state.map.revision(), steps));
    if tag.is_held_by(&headers) {
        return Ok(tag.not_modified());
    }
    let map = state.map;
    Ok(tag.on(Json(in_background(move || told(&map, steps)).await?)))
}

/// Why nothing is told of the map at a revision, which the parameter `name` asks for.
pub(super) fn not_at_revision(name: &'static str, error: RevisionError) -> Problem {
    match error {
        RevisionError::NotKept { .. } => {
            Problem::VersionNotKept { reason: error.to_string(), whole: super::items::PATH.to_owned() }
        }
        RevisionError::InTheFuture { asked, .. } => {
            Problem::BadParameter { name, value: asked.to_string(), reason: error.to_string() }
        }
    }
}

fn told(map: &SharedMap, steps: usize) -> Timeline {
    let (oldest, newest) = (map.oldest_revision(), map.revision());
    // What was outdated since `oldest` was asked for is not told.
    let publications = map.publications_after(oldest, usize::MAX).unwrap_or_default();
    Timeline { oldest, newest, steps: steps_of(&publications, steps) }
}

fn steps_of(publications: &[Publication], steps: usize) -> Vec<Step> {
    let (Some(first), Some(last)) = (publications.first(), publications.last()) else { return Vec::new() };
    let (from, count) = (first.published_ms, steps as u64);
    let span = last.published_ms.saturating_sub(from) + 1;
    let step_of = |at_ms: u64| at_ms.saturating_sub(from) * count / span;
    let mut told: Vec<Step> = Vec::new();
    for publication in publications {
        // A clock that was set back makes no step end before it begins.
        let at_ms = publication.published_ms.max(told.last().map_or(from, |step| step.at_ms));
        let step = Step { revision: publication.revision, at: String::new(), publications: 1, at_ms };
        match told.last_mut() {
            Some(open) if step_of(open.at_ms) == step_of(at_ms) => {
                *open = Step { publications: open.publications + 1, ..step };
            }
            _ => told.push(step),
        }
    }
    for step in &mut told {
        let at_ns = i64::try_from(step.at_ms.saturating_mul(1_000_000)).unwrap_or(i64::MAX);
        step.at = rfc3339(TimestampNs(at_ns));
    }
    told
}

#[cfg(test)]
mod tests {
    use lanemap_core::fleet::CellId;

    use super::*;
    use crate::fuse::CellVersion;

    fn published(times_ms: &[u64]) -> Vec<Publication> {
        let numbered = (1..).zip(times_ms);
        let publication = |(number, at_ms): (u64, &u64)| Publication {
            revision: MapRevision(number),
            cell: CellId::new(1, 1).unwrap(),
            from_version: CellVersion(number - 1),
            to_version: CellVersion(number),
            published_ms: *at_ms,
            lines_upserted: 1,
            lines_removed: 0,
        };
        numbered.map(publication).collect()
    }

    #[test]
    fn a_step_names_the_last_revision_in_it_and_one_without_changes_is_left_out() {
        let steps = steps_of(&published(&[1_000, 1_001, 1_002, 1_900, 1_999]), 10);
        let told: Vec<_> = steps.iter().map(|step| (step.revision.0, step.publications, step.at_ms)).collect();
        assert_eq!(told, [(3, 3, 1_002), (5, 2, 1_999)]);
        assert_eq!(steps[0].at, "1970-01-01T00:00:01.002Z");
    }

    #[test]
    fn a_busy_map_has_no_more_steps_than_were_asked_for_and_the_last_is_the_newest() {
        let times: Vec<u64> = (0..10_000).map(|number| number * 7).collect();
        let steps = steps_of(&published(&times), 50);
        assert_eq!(steps.len(), 50);
        assert_eq!(steps.last().map(|step| step.revision), Some(MapRevision(10_000)));
        assert_eq!(steps.iter().map(|step| step.publications).sum::<u32>(), 10_000);
        assert_eq!(steps_of(&[], 50), []);
    }

    #[test]
    fn a_clock_that_was_set_back_makes_no_step_run_back() {
        let steps = steps_of(&published(&[5_000, 9_000, 2_000]), 4);
        assert!(steps.windows(2).all(|pair| pair[0].at_ms <= pair[1].at_ms && pair[0].revision < pair[1].revision));
        assert_eq!(steps.last().map(|step| step.revision), Some(MapRevision(3)));
    }
}
