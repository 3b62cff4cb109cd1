//! The shared map in zenoh: every cell under `lanemap/v1/map/{cell}`, its newest version whole, as a `CellMap`, and every
//! event under `lanemap/v1/map/{cell}/events/{number}`, as a `MapEvent`.
//!
//! Each new version is put on the key of its cell; a query of a key, or of several (`lanemap/v1/map/*`), is answered with
//! the versions that the cells have. A key so has one value: what is put replaces what was, and one that a slow subscriber
//! is spared (`CongestionControl::Drop`) is made up for by the next, or by a query. Versions and bytes are those of HTTP and
//! gRPC. Nobody who fuses waits for zenoh: a task follows the map as any reader does, and is told of a cell that changes
//! faster than it publishes once.

use std::sync::Arc;

use lanemap_core::fleet::CellId;
use lanemap_proto::zenoh_keys::{
    CELL_ENCODING, EVENT_ENCODING, EVERY_CELL, EVERY_EVENT, cell_key, event_key, parse_cell_key,
};
use prost::Message;
use tokio::sync::{Semaphore, mpsc};
use tokio_util::{sync::CancellationToken, task::TaskTracker};
use zenoh::{
    Session, Wait,
    bytes::ZBytes,
    qos::{CongestionControl, Priority},
    query::{Query, Queryable},
};

use super::{ZenohError, declaring};
use crate::{
    fuse::{
        CellVersion, PublishedCell, SharedMap,
        events::CellEvent,
        follow::{Followed, Follower, Followers, Told},
        publications::CellChange,
    },
    journal::JournalError,
    telemetry,
};

/// Queries that wait to be answered; more are turned away.
const MOST_QUERIES: usize = 64;
/// Queries that are answered at a time.
const AT_A_TIME: usize = 4;
/// Most cells in the answer to one query.
const MOST_CELLS: usize = 1_024;

/// Most events in the answer to one query.
const MOST_EVENTS: usize = 10_000;

/// The map's declarations in zenoh.
pub(super) struct MapInZenoh {
    _cells: Queryable<()>,
    _events: Queryable<()>,
}

/// What a query is answered with.
#[derive(Clone, Copy, Debug)]
enum Asked {
    Cells,
    Events,
}

/// Takes queries of some keys to where they wait.
fn queryable(
    session: &Session,
    key: &'static str,
    asked: Asked,
    wait: mpsc::Sender<(Asked, Query)>,
) -> Result<Queryable<()>, ZenohError> {
    let queries = session.declare_queryable(key).callback(move |query: Query| {
        // A callback of zenoh never waits; who is turned away hears the end of the answer at once.
        if wait.try_send((asked, query)).is_err() {
            metrics::counter!(telemetry::ZENOH_QUERIES_TURNED_AWAY).increment(1);
        }
    });
    queries.wait().map_err(declaring("the queries of the map"))
}

impl MapInZenoh {
    /// Publishes the map and answers queries of it until `shutdown`.
    pub(super) fn declare(
        session: &Session,
        map: &SharedMap,
        tracked: &TaskTracker,
        shutdown: CancellationToken,
    ) -> Result<Self, ZenohError> {
        let (wait, waiting) = mpsc::channel(MOST_QUERIES);
        let cells = queryable(session, EVERY_CELL, Asked::Cells, wait.clone())?;
        let events = queryable(session, EVERY_EVENT, Asked::Events, wait)?;
        // Its own followers: a reader over HTTP takes no place of it.
        let follower = Followers::new(map.clone(), 1).follow(None, Followed::All);
        if let Ok(follower) = follower {
            let (session, map, shutdown) = (session.clone(), map.clone(), shutdown.clone());
            tracked.spawn(async move {
                shutdown.run_until_cancelled(publish(session, map, follower)).await;
            });
        }
        let map = map.clone();
        tracked.spawn(async move {
            shutdown.run_until_cancelled(answer(map, waiting)).await;
        });
        Ok(Self { _cells: cells, _events: events })
    }
}

/// Puts every cell that changes.
async fn publish(session: Session, map: SharedMap, mut follower: Follower) {
    loop {
        // What a reset leaves out, nobody is told of who does not ask: a subscriber queries.
        let Told::Cell { change, .. } = follower.next().await else { continue };
        let found = read(&map, change.cell).await;
        let happened = happened(&map, change).await;
        let put = match (found, happened) {
            (Ok(Some(found)), Ok(happened)) => put(&session, change.cell, &found, &happened).await,
            (Ok(None), Ok(_)) => Ok(()),
            (Err(error), _) | (_, Err(error)) => {
                tracing::warn!(%error, "a cell cannot be read, and is not published over zenoh");
                Ok(())
            }
        };
        if let Err(error) = put {
            tracing::warn!(%error, "a cell is not published over zenoh");
        }
    }
}

async fn put(session: &Session, cell: CellId, found: &PublishedCell, happened: &[CellEvent]) -> zenoh::Result<()> {
    let name = cell.to_string();
    for event in happened {
        let message = event.message(cell).encode_to_vec();
        let put = session.put(event_key(&name, event.number), ZBytes::from(message));
        put.encoding(EVENT_ENCODING).congestion_control(CongestionControl::Drop).priority(Priority::DataLow).await?;
    }
    let put = session.put(cell_key(&name), ZBytes::from(found.bytes.to_vec()));
    put.encoding(CELL_ENCODING).congestion_control(CongestionControl::Drop).priority(Priority::DataLow).await
}

/// Answers queries, a few at a time.
async fn answer(map: SharedMap, mut waiting: mpsc::Receiver<(Asked, Query)>) {
    let places = Arc::new(Semaphore::new(AT_A_TIME));
    let answering = TaskTracker::new();
    while let Some((asked, query)) = waiting.recv().await {
        let Ok(place) = Arc::clone(&places).acquire_owned().await else { return };
        let map = map.clone();
        answering.spawn(async move {
            let replied = match asked {
                Asked::Cells => reply(&map, &query).await,
                Asked::Events => reply_with_events(&map, &query).await,
            };
            if let Err(error) = replied {
                tracing::debug!(%error, "a query of the map was not answered");
            }
            drop(place);
        });
    }
}

async fn reply(map: &SharedMap, query: &Query) -> zenoh::Result<()> {
    let asked = query.key_expr();
    let is_asked = |cell: &CellId| {
        zenoh::key_expr::KeyExpr::try_from(cell_key(&cell.to_string())).is_ok_and(|key| asked.intersects(&key))
    };
    let cells: Vec<CellId> = match parse_cell_key(asked.as_str()).and_then(|name| name.parse().ok()) {
        Some(cell) => vec![cell],
        None => map.list().into_iter().map(|(cell, _)| cell).filter(is_asked).collect(),
    };
    if cells.len() > MOST_CELLS {
        let refusal = format!("{} cells are asked for, and {MOST_CELLS} may be: ask for fewer at a time", cells.len());
        return query.reply_err(refusal).await;
    }
    for cell in cells {
        let Some(found) = read(map, cell).await? else { continue };
        query.reply(cell_key(&cell.to_string()), ZBytes::from(found.bytes.to_vec())).encoding(CELL_ENCODING).await?;
    }
    Ok(())
}

/// Answers with the events whose keys the query matches, cell by cell.
async fn reply_with_events(map: &SharedMap, query: &Query) -> zenoh::Result<()> {
    let asked = query.key_expr();
    let mut told = 0;
    for (cell, _) in map.list() {
        let name = cell.to_string();
        let of_cell = zenoh::key_expr::KeyExpr::try_from(format!("{}/events/*", cell_key(&name)))?;
        if !asked.intersects(&of_cell) {
            continue;
        }
        for event in
            read_beside(map, move |map| map.events_between(cell, CellVersion(0), CellVersion(u64::MAX))).await?
        {
            let key = zenoh::key_expr::KeyExpr::try_from(event_key(&name, event.number))?;
            if !asked.intersects(&key) {
                continue;
            }
            if told == MOST_EVENTS {
                let refusal = format!("more than {MOST_EVENTS} events are asked for: ask for fewer cells at a time");
                return query.reply_err(refusal).await;
            }
            told += 1;
            query.reply(key, ZBytes::from(event.message(cell).encode_to_vec())).encoding(EVENT_ENCODING).await?;
        }
    }
    Ok(())
}

/// What happened in a cell with a change.
async fn happened(map: &SharedMap, change: CellChange) -> Result<Vec<CellEvent>, JournalError> {
    read_beside(map, move |map| map.events_between(change.cell, change.from_version, change.to_version)).await
}

/// The newest version of a cell.
async fn read(map: &SharedMap, cell: CellId) -> Result<Option<Arc<PublishedCell>>, JournalError> {
    read_beside(map, move |map| map.get(cell)).await
}

/// Reads the map beside the runtime.
async fn read_beside<T: Send + 'static>(
    map: &SharedMap,
    read: impl FnOnce(&SharedMap) -> Result<T, JournalError> + Send + 'static,
) -> Result<T, JournalError> {
    let map = map.clone();
    let reading = tokio::task::spawn_blocking(move || read(&map));
    reading.await.map_err(|error| JournalError::Store(error.to_string()))?
}
