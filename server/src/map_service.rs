//! Reading maps over gRPC, and the lane map's wire form, which HTTP serves too.

mod watch;

use lanemap_core::{
    Sequence,
    fleet::cell::{CellId, CellIdError},
};
use lanemap_proto::{
    encode,
    v1::{self, map_service_server::MapService},
};
use tonic::{Request, Response, Status};

use crate::{
    auth::peer_of,
    change_feed::ChangeFeeds,
    error::Error,
    fuse::{ChangesError, SharedMap},
    session::{PublishedMap, SessionId, SessionState, SessionSummary, Sessions},
};

/// Sessions on a page where the request does not say.
const DEFAULT_PAGE: usize = 100;
/// Most sessions on a page.
const MAX_PAGE: usize = 1000;

/// The map service.
#[derive(Clone, Debug)]
pub struct MapGrpc {
    sessions: Sessions,
    map: SharedMap,
    feeds: ChangeFeeds,
}

impl MapGrpc {
    /// A service over the published maps.
    #[must_use]
    pub fn new(sessions: Sessions, map: SharedMap, feeds: ChangeFeeds) -> Self {
        Self { sessions, map, feeds }
    }
}

/// A published map as the wire's `LaneMap`: the same frames give the same message.
#[must_use]
pub fn lane_map(published: &PublishedMap) -> v1::LaneMap {
    v1::LaneMap {
        lanes: published.map.lanes.iter().map(encode::lane).collect(),
        map_from_vehicle: Some(encode::pose(&published.map_from_vehicle)),
        last_sequence_inclusive: published.last_sequence.map(|Sequence(number)| number),
        last_time_unix_ns: published.last_time.0,
        georeference: published.georeference.as_ref().map(encode::georeference),
    }
}

fn session(published: &SessionSummary) -> v1::Session {
    let state = match published.state {
        SessionState::Live => v1::SessionState::Live,
        SessionState::Idle => v1::SessionState::Idle,
        SessionState::Closed => v1::SessionState::Closed,
    };
    v1::Session {
        id: published.session.to_string(),
        state: state.into(),
        map_version: published.version.0,
        lanes: u32::try_from(published.lanes).unwrap_or(u32::MAX),
        last_sequence_inclusive: published.last_sequence.map(|Sequence(number)| number),
        last_time_unix_ns: published.last_time.0,
        preset: encode::preset(published.preset).into(),
    }
}

fn cell(name: &str) -> Result<CellId, Status> {
    name.parse().map_err(|error: CellIdError| Status::invalid_argument(error.to_string()))
}

/// Reads the shared map beside the runtime.
async fn read<T: Send + 'static>(work: impl FnOnce() -> Result<T, ChangesError> + Send + 'static) -> Result<T, Status> {
    let outcome = tokio::task::spawn_blocking(work).await;
    outcome.map_err(|error| Status::internal(format!("the map cannot be read: {error}")))?.map_err(refused)
}

fn refused(error: ChangesError) -> Status {
    match error {
        ChangesError::NoSuchCell { .. } => Status::not_found(error.to_string()),
        ChangesError::NotKept { .. } => Status::out_of_range(error.to_string()),
        ChangesError::Store(error) => Error::from(error).into(),
    }
}

#[tonic::async_trait]
impl MapService for MapGrpc {
    type WatchChangesStream = watch::Messages;

    async fn watch_changes(
        &self,
        request: Request<v1::WatchChangesRequest>,
    ) -> Result<Response<Self::WatchChangesStream>, Status> {
        let peer = peer_of(request.extensions())?;
        peer.may_read(None)?;
        watch::messages(&self.feeds, peer, &request.into_inner()).map(Response::new)
    }

    async fn list_sessions(
        &self,
        request: Request<v1::ListSessionsRequest>,
    ) -> Result<Response<v1::ListSessionsResponse>, Status> {
        peer_of(request.extensions())?.may_read(None)?;
        let v1::ListSessionsRequest { page_size, page_token } = request.into_inner();
        let size = match usize::try_from(page_size).unwrap_or(usize::MAX) {
            0 => DEFAULT_PAGE,
            size if size <= MAX_PAGE => size,
            size => return Err(Status::invalid_argument(format!("page_size = {size} is outside 0 ..= {MAX_PAGE}"))),
        };
        let after = match page_token.as_str() {
            "" => None,
            token => Some(token.parse::<SessionId>().map_err(|error| Status::invalid_argument(error.to_string()))?),
        };
        let listed = self.sessions.list();
        let mut rest = listed.iter().filter(|map| after.is_none_or(|after| map.session > after)).peekable();
        let sessions: Vec<_> = rest.by_ref().take(size).map(|map| session(map)).collect();
        let last = sessions.last().filter(|_| rest.peek().is_some());
        let next_page_token = last.map(|session| session.id.clone()).unwrap_or_default();
        Ok(Response::new(v1::ListSessionsResponse { sessions, next_page_token }))
    }

    async fn get_lane_map(
        &self,
        request: Request<v1::GetLaneMapRequest>,
    ) -> Result<Response<v1::GetLaneMapResponse>, Status> {
        peer_of(request.extensions())?.may_read(None)?;
        let name = request.into_inner().session_id;
        let id: SessionId =
            name.parse().map_err(|_| Error::NoSuchSession { session: name.chars().take(64).collect() })?;
        let sessions = self.sessions.clone();
        let found = tokio::task::spawn_blocking(move || sessions.get(&id)).await;
        let found = found.map_err(|error| Status::internal(format!("the map cannot be read: {error}")))?;
        let published = found.ok_or(Error::NoSuchSession { session: name })?;
        let (session, map) = (session(&published), lane_map(&published));
        Ok(Response::new(v1::GetLaneMapResponse { session: Some(session), map: Some(map) }))
    }

    async fn get_cell(&self, request: Request<v1::GetCellRequest>) -> Result<Response<v1::GetCellResponse>, Status> {
        peer_of(request.extensions())?.may_read(None)?;
        let (cell, shared) = (cell(&request.into_inner().cell)?, self.map.clone());
        let found = read(move || Ok(shared.get(cell)?)).await?;
        let found = found.ok_or(ChangesError::NoSuchCell { cell }).map_err(refused)?;
        Ok(Response::new(v1::GetCellResponse { map: Some(v1::CellMap::clone(&found.map)) }))
    }

    async fn get_changes(
        &self,
        request: Request<v1::GetChangesRequest>,
    ) -> Result<Response<v1::GetChangesResponse>, Status> {
        peer_of(request.extensions())?.may_read(None)?;
        let v1::GetChangesRequest { cell: name, since_version } = request.into_inner();
        let (cell, shared) = (cell(&name)?, self.map.clone());
        let changes = read(move || shared.changes_since(cell, since_version)).await?;
        Ok(Response::new(v1::GetChangesResponse { changes: Some(changes) }))
    }
}
