//! Follows the shared map over gRPC: a copy of it that is kept exact.
//!
//! The copy takes what `WatchChanges` tells, and asks for the rest: changes that are too large to be told, and those of a
//! version that it does not have. Where the connection breaks, or is silent for too long, it is made anew and gone on
//! with where it was. Where the service does not know any more what changed since, the copy begins anew. Not noticed: that another store
//! is served at the same address whose map has come farther than the copy.

use std::{
    hash::{BuildHasher, RandomState},
    time::Duration,
};

use lanemap_proto::v1::{self, watch_changes_response::Told};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use tokio::time::{Instant, sleep_until, timeout};
use tonic::{Code, Status, Streaming};

use crate::{
    error::ClientError,
    link::{ConnectOptions, GrpcLink},
    map_copy::{MapCopy, Need},
    reconnect::Reconnect,
};

/// Which cells are followed.
#[derive(Clone, Debug, Default, PartialEq)]
pub enum Area {
    /// All of them, also those that are yet to come.
    #[default]
    All,
    /// These, by their names; at most 256.
    Cells(Vec<String>),
    /// Those within borders, degrees.
    Within(v1::Bounds),
}

/// What to follow, and how.
#[derive(Clone, Debug, PartialEq)]
pub struct WatchOptions {
    /// Which cells.
    pub area: Area,
    /// How a broken connection is tried again.
    pub reconnect: Reconnect,
    /// A connection over which nothing came for so long is given up; the service says every 15 s that it is alive.
    pub silence: Duration,
    /// Connections.
    pub connect: ConnectOptions,
}

impl Default for WatchOptions {
    /// All cells, for ever, with a minute of silence.
    fn default() -> Self {
        Self {
            area: Area::All,
            reconnect: Reconnect::forever(),
            silence: Duration::from_mins(1),
            connect: ConnectOptions::default(),
        }
    }
}

/// What happened.
#[derive(Clone, Debug, PartialEq)]
pub enum MapNews {
    /// The copy has another version of a cell.
    Cell {
        /// Name of the cell.
        cell: String,
        /// The version that the copy had; 0: none.
        from_version: u64,
        /// The version that it has.
        to_version: u64,
    },
    /// Something happened to the road, or to the names of lines; the change of the cell that tells of it follows. One that is told again
    /// replaces what was told under its cell and number.
    Event(Box<v1::MapEvent>),
    /// What changed meanwhile is not known: the copy is empty, and all cells follow.
    Reset,
    /// The connection broke; it is made anew.
    Disconnected {
        /// Why.
        reason: String,
        /// How long from now.
        retry_in: Duration,
    },
}

/// Follows the shared map: see [`MapWatch::next`].
#[derive(Debug)]
pub struct MapWatch {
    link: GrpcLink,
    options: WatchOptions,
    copy: MapCopy,
    stream: Option<Streaming<v1::WatchChangesResponse>>,
    /// A change that the copy has not taken yet, and the position after it.
    untaken: Option<(v1::CellChanged, String)>,
    /// When a broken connection is tried again.
    rest_until: Option<Instant>,
    tries: u32,
    random: ChaCha8Rng,
}

impl MapWatch {
    /// Follows the map of the service at `url` with an empty copy. Connects with the first [`next`](Self::next).
    ///
    /// # Errors
    /// An address that is none, or files that cannot be read.
    pub async fn new(url: &str, options: WatchOptions) -> Result<Self, ClientError> {
        Self::resume(url, options, MapCopy::default()).await
    }

    /// Goes on with a copy.
    ///
    /// # Errors
    /// An address that is none, or files that cannot be read.
    pub async fn resume(url: &str, options: WatchOptions, copy: MapCopy) -> Result<Self, ClientError> {
        let link = GrpcLink::new(url, &options.connect).await?;
        // Randomly seeded, as the standard library's hash maps are.
        let random = ChaCha8Rng::seed_from_u64(RandomState::new().hash_one(0));
        Ok(Self { link, options, copy, stream: None, untaken: None, rest_until: None, tries: 0, random })
    }

    /// The copy as it is now.
    #[must_use]
    pub fn copy(&self) -> &MapCopy {
        &self.copy
    }

    /// Ends it, and gives the copy, with which another may go on.
    #[must_use]
    pub fn into_copy(self) -> MapCopy {
        self.copy
    }

    /// What happens next; waits for it. May be dropped while it waits, and called again.
    ///
    /// # Errors
    /// What trying again does not mend, or more failures in a row than [`Reconnect::max_tries`].
    pub async fn next(&mut self) -> Result<MapNews, ClientError> {
        loop {
            match self.step().await {
                Ok(Some(news)) => return Ok(news),
                Ok(None) => {}
                Err(error) => return self.broken(&error).ok_or(error),
            }
        }
    }

    /// Follows until the copy is the map at `revision`, or at a later one.
    ///
    /// # Errors
    /// As [`next`](Self::next).
    pub async fn until(&mut self, revision: u64) -> Result<(), ClientError> {
        while self.copy.revision().is_none_or(|has| has < revision) {
            if let Err(error) = self.step().await {
                self.broken(&error).ok_or(error)?;
            }
        }
        Ok(())
    }

    /// Hears one message, or takes the one that was heard.
    async fn step(&mut self) -> Result<Option<MapNews>, ClientError> {
        if let Some(until) = self.rest_until {
            sleep_until(until).await;
            self.rest_until = None;
        }
        if let Some((changed, position)) = self.untaken.clone() {
            let from_version = self.copy.cell(&changed.cell).map_or(0, |cell| cell.version);
            self.take(&changed).await?;
            self.copy.has_come_to(position);
            self.untaken = None;
            let to_version = self.copy.cell(&changed.cell).map_or(0, |cell| cell.version);
            let is_news = to_version != from_version;
            return Ok(is_news.then_some(MapNews::Cell { cell: changed.cell, from_version, to_version }));
        }
        let message = self.message().await?;
        // The connection carries something: a next break starts counting anew.
        self.tries = 0;
        Ok(self.hear(message))
    }

    async fn message(&mut self) -> Result<v1::WatchChangesResponse, ClientError> {
        let silence = self.options.silence;
        let silent = |_| ClientError::Unreachable(format!("it said nothing for {silence:?}"));
        let stream = match &mut self.stream {
            Some(stream) => stream,
            none => none
                .insert(timeout(silence, self.link.watch(request(&self.copy, &self.options))).await.map_err(silent)??),
        };
        let message = timeout(silence, stream.message()).await.map_err(silent)??;
        message.ok_or_else(|| Status::unavailable("the stream ended").into())
    }

    fn hear(&mut self, message: v1::WatchChangesResponse) -> Option<MapNews> {
        let v1::WatchChangesResponse { position, told } = message;
        match told {
            Some(Told::Cell(changed)) => {
                self.untaken = Some((changed, position));
                None
            }
            Some(Told::Event(event)) => Some(MapNews::Event(Box::new(event))),
            Some(Told::Reset(_)) => {
                self.copy.reset();
                self.stream = None;
                Some(MapNews::Reset)
            }
            // What a newer service says, and this client does not know, moves the position all the same.
            Some(Told::Started(_) | Told::Alive(_)) | None => {
                self.copy.has_come_to(position);
                None
            }
        }
    }

    async fn take(&mut self, changed: &v1::CellChanged) -> Result<(), ClientError> {
        let Need::ChangesSince(since_version) = self.copy.hear(changed) else { return Ok(()) };
        let request = v1::GetChangesRequest { cell: changed.cell.clone(), since_version };
        match self.link.changes(request).await {
            Ok(changes) => self.copy.fetched(changed, &changes),
            // The version that the copy has is not kept.
            Err(ClientError::Status(status)) if status.code() == Code::OutOfRange => {
                let map = self.link.cell(v1::GetCellRequest { cell: changed.cell.clone() }).await?;
                self.copy.fetched_whole(changed, map);
            }
            Err(error) => return Err(error),
        }
        Ok(())
    }

    /// What is told of a failure; `None` where it is not tried again.
    fn broken(&mut self, error: &ClientError) -> Option<MapNews> {
        let renews = error.is_unauthenticated() && self.link.may_renew_token();
        if !(error.is_transient() || renews) || self.tries >= self.options.reconnect.max_tries {
            return None;
        }
        // A change that was not taken is told again.
        (self.stream, self.untaken) = (None, None);
        let retry_in = self.options.reconnect.pause(self.tries, error.retry_after(), &mut self.random);
        self.tries += 1;
        self.rest_until = Some(Instant::now() + retry_in);
        Some(MapNews::Disconnected { reason: error.to_string(), retry_in })
    }
}

fn request(copy: &MapCopy, options: &WatchOptions) -> v1::WatchChangesRequest {
    let (cells, within) = match &options.area {
        Area::All => (Vec::new(), None),
        Area::Cells(cells) => (cells.clone(), None),
        Area::Within(bounds) => (Vec::new(), Some(*bounds)),
    };
    v1::WatchChangesRequest {
        after_position: copy.position().to_owned(),
        since_revision: copy.position().is_empty().then_some(0),
        cells,
        within,
        with_lines: true,
    }
}
