//! `/changes`: what changes in the shared map, as it changes, as server-sent events (WHATWG HTML, 9.2).
//!
//! | event | data | what to do |
//! |---|---|---|
//! | `start` | `revision`, up to which the reader has all | take the map as a whole, if it is not there yet |
//! | `cell` | `cell`, `from_version`, `to_version`, `revision`, number of lines that differ | take the cell, or its changes since `from_version` |
//! | `change` | what happened to the road, or to the names of lines: a feature of `/cells/{id}/events` | the `cell` follows |
//! | `reset` | `revision`, and the `oldest` since which changes are known | take the map as a whole |
//!
//! Every event but `change` has an id with which it is the last that a reader has: `Last-Event-ID`, which browsers send by themselves, or
//! `since` go on after it. A reader that is slow is told of each cell once. Where `from_version` is not the version
//! that the reader has, it takes the cell as a whole, or its changes since its own version: `/cells/{id}/changes`.

use std::{
    collections::BTreeSet,
    convert::Infallible,
    sync::atomic::{AtomicU64, Ordering},
    time::Duration,
};

use axum::{
    extract::{Request, State},
    http::{HeaderMap, HeaderName, HeaderValue, header},
    response::{IntoResponse, Response, Sse, sse::Event},
};
use futures::StreamExt;
use lanemap_core::fleet::CellId;
use serde::Serialize;

use super::{
    ServeState,
    bounds::Bounds,
    cells::{ChangedLines, written},
    events::feature,
    problem::{Problem, repeated},
    query::Parameters,
};
use crate::{
    auth::layer::peer_of,
    change_feed::{Message, Wanted},
    fuse::{
        MapRevision,
        follow::{FollowError, Followed, Position},
        publications::CellChange,
    },
};

/// Most cells that a reader may name.
const MOST_CELLS: usize = 256;
/// Header by which a reader that was cut off goes on.
const LAST_EVENT_ID: HeaderName = HeaderName::from_static("last-event-id");
/// Header that has a proxy hand over every event at once.
const ACCEL_BUFFERING: HeaderName = HeaderName::from_static("x-accel-buffering");

/// What a request asks for, and whether by the header of a browser that comes again.
struct Query {
    wanted: Wanted,
    comes_again: bool,
}

/// Data of a `cell`.
#[derive(Serialize)]
struct CellData {
    revision: MapRevision,
    cell: String,
    from_version: u64,
    to_version: u64,
    lines_upserted: u32,
    lines_removed: u32,
    #[serde(flatten)]
    lines: Option<ChangedLines>,
}

/// Data of a `start`.
#[derive(Serialize)]
struct StartData {
    revision: MapRevision,
}

/// Data of a `reset`.
#[derive(Serialize)]
struct ResetData {
    revision: MapRevision,
    oldest: MapRevision,
}

/// `GET /changes`
pub(super) async fn changes(State(state): State<ServeState>, request: Request) -> Result<Response, Problem> {
    let peer = peer_of(request.extensions())?;
    let Query { wanted, comes_again } = Query::read(&request)?;
    let most_bytes = state.feeds.most_event_bytes();
    let encode = move |message| event(message, most_bytes);
    let opened = if comes_again {
        state.feeds.open_or_reset(peer, wanted, encode)
    } else {
        state.feeds.open(peer, wanted, encode)
    };
    let events = opened.map_err(|error| refused(error, &request))?;
    let mut answer = Sse::new(events.map(Ok::<_, Infallible>)).into_response();
    let headers = answer.headers_mut();
    headers.insert(header::CACHE_CONTROL, HeaderValue::from_static("no-cache, no-transform"));
    headers.insert(ACCEL_BUFFERING, HeaderValue::from_static("no"));
    Ok(answer)
}

fn refused(error: FollowError, request: &Request) -> Problem {
    match error {
        FollowError::TooMany { .. } => Problem::Busy { reason: error.to_string() },
        FollowError::InTheFuture { .. } => {
            let since = Parameters::read(request.uri(), &PARAMETERS);
            let since = since.ok().and_then(|given| given.get("since", |text| Ok(repeated(text))).ok().flatten());
            Problem::BadParameter { name: "since", value: since.unwrap_or_default(), reason: error.to_string() }
        }
    }
}

/// The parameters that there are.
const PARAMETERS: [&str; 4] = ["since", "bbox", "cell", "content"];

impl Query {
    fn read(request: &Request) -> Result<Self, Problem> {
        let parameters = Parameters::read(request.uri(), &PARAMETERS)?;
        let since = parameters.get("since", str::parse::<Position>)?;
        let last = last_event_id(request.headers())?;
        let bounds = parameters.get("bbox", Bounds::parse)?;
        let cells = parameters.get("cell", parse_cells)?;
        let followed = match (cells, bounds) {
            (Some(_), Some(_)) => {
                let reason = "it cannot stand beside cell: name the cells, or where they lie".to_owned();
                return Err(Problem::BadParameter { name: "bbox", value: String::new(), reason });
            }
            (Some(cells), None) => Followed::Cells(cells),
            (None, Some(bounds)) => Followed::Within(bounds.to_array()),
            (None, None) => Followed::All,
        };
        let lines = parameters.get("content", parse_content)?.unwrap_or(false);
        Ok(Self { wanted: Wanted { from: last.or(since), followed, lines }, comes_again: last.is_some() })
    }
}

/// Where a reader was that comes again.
fn last_event_id(headers: &HeaderMap) -> Result<Option<Position>, Problem> {
    let Some(value) = headers.get(LAST_EVENT_ID).filter(|value| !value.is_empty()) else { return Ok(None) };
    let text = value.to_str().unwrap_or("bytes that are no text");
    let position = text.parse();
    position.map(Some).map_err(|reason| Problem::BadParameter { name: "Last-Event-ID", value: repeated(text), reason })
}

fn parse_cells(text: &str) -> Result<BTreeSet<CellId>, String> {
    let cells = text.split(',').map(|name| name.parse::<CellId>().map_err(|error| error.to_string()));
    let cells = cells.collect::<Result<BTreeSet<_>, _>>()?;
    if cells.len() > MOST_CELLS {
        return Err(format!("it names {} cells, and may name {MOST_CELLS}: ask by bbox", cells.len()));
    }
    Ok(cells)
}

/// Whether the lines are to come.
fn parse_content(text: &str) -> Result<bool, String> {
    match text {
        "lines" => Ok(true),
        "counts" => Ok(false),
        _ => Err("it must be counts or lines".to_owned()),
    }
}

fn event(message: Message, most_bytes: usize) -> Event {
    match message {
        Message::Started(position) => {
            let (Position::At(revision) | Position::Within { since: revision, .. }) = position;
            named("start", position, &StartData { revision }).retry(retry())
        }
        Message::Alive(position) => Event::default().id(position.to_string()).comment("alive"),
        Message::Reset { newest, oldest } => {
            named("reset", Position::At(newest), &ResetData { revision: newest, oldest })
        }
        Message::Happened { cell, event, .. } => {
            let json = serde_json::to_string(&feature(cell, *event)).unwrap_or_default();
            // The change of the cell bears the id: one that is cut off before it is told of this again.
            Event::default().event("change").data(json)
        }
        Message::Cell { change, position, lines } => {
            let whole = lines.map(|lines| {
                let written = written(change.cell, lines);
                CellData { from_version: written.from_version, lines: Some(written.lines), ..cell_data(&change) }
            });
            let fits = whole.and_then(|data| serde_json::to_string(&data).ok()).filter(|json| json.len() <= most_bytes);
            match fits {
                Some(json) => Event::default().event("cell").id(position.to_string()).data(json),
                None => named("cell", position, &cell_data(&change)),
            }
        }
    }
}

fn cell_data(change: &CellChange) -> CellData {
    CellData {
        revision: change.revision,
        cell: change.cell.to_string(),
        from_version: change.from_version.0,
        to_version: change.to_version.0,
        lines_upserted: change.lines_upserted,
        lines_removed: change.lines_removed,
        lines: None,
    }
}

fn named(name: &str, position: Position, data: &impl Serialize) -> Event {
    // Numbers and names of cells: there is nothing in it that could not be written.
    let json = serde_json::to_string(data).unwrap_or_default();
    Event::default().event(name).id(position.to_string()).data(json)
}

/// Pause after which a reader that was cut off comes again: between 2 and 5 s, another for each, so that those that a
/// restart cuts off do not all come at once.
fn retry() -> Duration {
    static READERS: AtomicU64 = AtomicU64::new(0);
    Duration::from_millis(2_000 + READERS.fetch_add(1_237, Ordering::Relaxed) % 3_000)
}

#[cfg(test)]
mod tests {
    use axum::body::Body;

    use super::*;

    fn read(query: &str, last: Option<&str>) -> Result<Query, Problem> {
        let request = Request::get(format!("/changes?{query}"));
        let request = last.into_iter().fold(request, |request, last| request.header(LAST_EVENT_ID, last));
        Query::read(&request.body(Body::empty()).unwrap())
    }

    #[test]
    fn the_last_event_counts_for_more_than_since() {
        assert_eq!(read("since=5", None).unwrap().wanted.from, Some(Position::At(MapRevision(5))));
        let again = read("since=5", Some("5-9-7")).unwrap();
        assert_eq!(again.wanted.from, Some("5-9-7".parse().unwrap()));
        assert!(again.comes_again && read("", None).unwrap().wanted.from.is_none());
        assert!(read("since=5", Some("")).unwrap().wanted.from.is_some());
    }

    #[test]
    fn what_cannot_be_read_is_refused_by_its_name() {
        for (query, last, parameter) in [
            ("since=x", None, "since"),
            ("since=-1", None, "since"),
            ("bbox=1,2", None, "bbox"),
            ("cell=14-1", None, "cell"),
            ("cell=14-1-1&bbox=1,2,3,4", None, "bbox"),
            ("content=all", None, "content"),
            ("", Some("there"), "Last-Event-ID"),
        ] {
            let Err(Problem::BadParameter { name, .. }) = read(query, last) else { panic!("{query}") };
            assert_eq!(name, parameter, "{query}");
        }
        assert!(matches!(read("sinc=1", None), Err(Problem::UnknownParameter { .. })));
        let many: Vec<String> = (0..=MOST_CELLS).map(|x| format!("14-{x}-1")).collect();
        assert!(read(&format!("cell={}", many.join(",")), None).is_err());
    }
}
