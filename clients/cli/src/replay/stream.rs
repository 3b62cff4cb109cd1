//! A drive on its way to a server.

use std::{
    sync::{Arc, Mutex, PoisonError},
    time::{SystemTime, UNIX_EPOCH},
};

use anyhow::Context;
use lanemap_client::{Event, Events, IngestClient, MapClient, Session, SessionStart};
use lanemap_core::{Frame, LaneMap, Preset, Sensor};
use serde::Serialize;
use tokio::task::JoinHandle;

use super::server::ServerArgs;

/// Refusals kept word by word; all of them are counted.
const MAX_REFUSALS: usize = 100;

/// A server to which drives are streamed.
pub struct ServerLink {
    url: String,
    fleet: String,
    vehicle: Option<String>,
    ingest: IngestClient,
    maps: MapClient,
}

/// One drive that is being streamed.
pub struct StreamedDrive<'a> {
    link: &'a ServerLink,
    session: Session,
    refusals: Arc<Mutex<Vec<String>>>,
    listener: JoinHandle<()>,
}

/// What became of a drive at the server.
#[derive(Debug, Serialize)]
pub struct SessionReport {
    /// The server's name of the session.
    pub id: String,
    /// Its map.
    pub lanes_url: String,
    /// Last durable frame, inclusive.
    pub acked_sequence: Option<u64>,
    /// Frames that the server refused.
    pub refused: u64,
    /// Why, the first hundred.
    pub refusals: Vec<String>,
    /// Connections that broke and were made anew.
    pub reconnections: u64,
    /// Whether the server's map is, bit by bit, the one that the mapper in this process made of the same frames.
    pub same_as_local: bool,
}

impl ServerLink {
    /// Connects to a server.
    pub async fn connect(server: &ServerArgs) -> anyhow::Result<Self> {
        let (ingest_url, options) = (server.ingest_url(), server.connect_options());
        let maps = MapClient::with(server.url.as_str(), &options.credentials).await?;
        let ingest = IngestClient::connect_with(ingest_url, options).await.with_context(|| {
            format!("no server at {ingest_url}; start one with lanemap serve, or replay with --local")
        })?;
        let url = server.url.trim_end_matches('/').to_owned();
        Ok(Self { maps, ingest, url, fleet: server.fleet.clone(), vehicle: server.vehicle.clone() })
    }

    /// Opens a session of its own for a drive: a drive replayed twice is two drives.
    pub async fn open(&self, drive: &str, preset: Preset, sensor: Sensor) -> anyhow::Result<StreamedDrive<'_>> {
        let now_ms = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default().as_millis();
        let (vehicle, drive_id) = match &self.vehicle {
            Some(vehicle) => (vehicle.as_str(), format!("{drive}-{now_ms}")),
            None => (drive, now_ms.to_string()),
        };
        let start = SessionStart { preset, sensor, ..SessionStart::new(&self.fleet, vehicle, drive_id) };
        let no_session = || format!("{drive}: no session");
        let (mut session, events) = self.ingest.begin_session(start).await.with_context(no_session)?;
        session.wait_opened().await.with_context(no_session)?;
        let refusals = Arc::new(Mutex::new(Vec::new()));
        let listener = tokio::spawn(collect_refusals(events, Arc::clone(&refusals)));
        Ok(StreamedDrive { link: self, session, refusals, listener })
    }
}

impl StreamedDrive<'_> {
    /// Sends a frame; waits while too many are unacked.
    pub async fn send(&mut self, frame: &Frame) -> anyhow::Result<()> {
        self.session.send(frame).await.context("the stream broke for good; the server's log says why")
    }

    /// Frames sent up to `frame` that are not known to be durable yet.
    pub fn unacked_at(&self, frame: &Frame) -> u64 {
        frame.sequence().0 - self.session.acked().map_or(0, |acked| acked.0)
    }

    /// Ends the drive, once all of it is durable and in the map, and compares that with the map made here.
    pub async fn finish(self, local: &LaneMap) -> anyhow::Result<SessionReport> {
        let id = self.session.id().to_owned();
        let summary =
            self.session.finish().await.context("the drive did not end cleanly; the server's log says why")?;
        let served = self.link.maps.lane_map(&id).await.context("the server's map cannot be read")?;
        // The listener ends with the session's events.
        let _ = self.listener.await;
        let refusals = std::mem::take(&mut *self.refusals.lock().unwrap_or_else(PoisonError::into_inner));
        Ok(SessionReport {
            lanes_url: format!("{}/sessions/{id}/lanes.geojson", self.link.url),
            id,
            acked_sequence: summary.acked.map(|sequence| sequence.0),
            refused: summary.refused,
            refusals,
            reconnections: summary.reconnections,
            same_as_local: served == *local,
        })
    }
}

async fn collect_refusals(mut events: Events, refusals: Arc<Mutex<Vec<String>>>) {
    while let Some(event) = events.next().await {
        match event {
            Event::Refused(refusal) => {
                tracing::error!("refused: {}", refusal.message);
                let mut refusals = refusals.lock().unwrap_or_else(PoisonError::into_inner);
                if refusals.len() < MAX_REFUSALS {
                    refusals.push(refusal.message);
                }
            }
            Event::Gap { first, last } => tracing::warn!("frames {} to {} did not come", first.0, last.0),
            Event::Disconnected { reason, retry_in } => {
                tracing::warn!("the connection broke, trying again in {} ms: {reason}", retry_in.as_millis());
            }
            _ => {}
        }
    }
}
