//! Streams of changes to readers, whatever their wire: what each is told, how long it may take, when it ends.
//!
//! A feed is a task that waits for what its reader is told next ([`crate::fuse::follow`]) and hands it over when the reader
//! takes it. One message waits at most; what comes meanwhile is told as one. A quiet feed says every now and then that it
//! is alive, and how far the map has come. It ends when the service does, when what the reader showed runs out, when the
//! reader leaves, and when it takes nothing for long: its place is for others then.

use std::{sync::Arc, time::Duration};

use lanemap_core::fleet::CellId;
use lanemap_proto::v1;
use tokio::{
    sync::{Semaphore, mpsc},
    time::{sleep, timeout},
};
use tokio_stream::wrappers::ReceiverStream;
use tokio_util::sync::CancellationToken;

use crate::{
    auth::Peer,
    config::ServerConfig,
    fuse::{
        MapRevision, SharedMap,
        events::CellEvent,
        follow::{FollowError, Followed, Follower, Followers, Position, Told},
        publications::CellChange,
    },
    journal::JournalError,
};

/// Signs of life that a reader may miss before its place is given to others.
const MISSED_SIGNS: u32 = 4;
/// Most changes whose lines are being read at a time, for all readers.
const MOST_AT_A_TIME: usize = 8;

/// What a reader asks for.
#[derive(Clone, Debug, Default)]
pub(crate) struct Wanted {
    /// Where it goes on; `None`: from now.
    pub(crate) from: Option<Position>,
    pub(crate) followed: Followed,
    /// Whether changes come with their lines.
    pub(crate) lines: bool,
}

/// What goes to a reader.
#[derive(Clone, Debug)]
pub(crate) enum Message {
    /// The first one: from here on all is told.
    Started(Position),
    /// Something happened in a cell; the change of the cell follows. The position is that of the message before.
    Happened { cell: CellId, event: Box<CellEvent>, position: Position },
    /// A cell changed.
    Cell {
        change: CellChange,
        position: Position,
        /// The lines, where they were asked for and both versions can be read. They begin at version 0 where the
        /// reader's is not kept: all lines come.
        lines: Option<v1::CellChanges>,
    },
    /// What changed since the reader's revision is not known: it must take the map whole.
    Reset { newest: MapRevision, oldest: MapRevision },
    /// Nothing happened for a while.
    Alive(Position),
}

/// Gives readers their feeds; how a message is written is theirs. Clones share the places.
#[derive(Clone, Debug)]
pub struct ChangeFeeds {
    followers: Followers,
    reading: Arc<Semaphore>,
    heartbeat: Duration,
    most_event_bytes: usize,
    shutdown: CancellationToken,
}

impl ChangeFeeds {
    /// Feeds from `map` that end at `shutdown`.
    #[must_use]
    pub fn new(config: &ServerConfig, map: SharedMap, shutdown: CancellationToken) -> Self {
        Self {
            followers: Followers::new(map, config.max_change_readers),
            reading: Arc::new(Semaphore::new(MOST_AT_A_TIME)),
            heartbeat: config.change_heartbeat(),
            most_event_bytes: config.max_change_event_bytes,
            shutdown,
        }
    }

    /// Most bytes of a message; lines that make it larger are left out.
    pub(crate) fn most_event_bytes(&self) -> usize {
        self.most_event_bytes
    }

    /// Begins to tell `peer` what it asked for, each message as `encode` writes it.
    ///
    /// # Errors
    /// No place is free, or the reader asks for what lies in the future.
    pub(crate) fn open<T: Send + 'static>(
        &self,
        peer: Peer,
        wanted: Wanted,
        encode: impl Fn(Message) -> T + Send + Sync + 'static,
    ) -> Result<ReceiverStream<T>, FollowError> {
        let follower = self.followers.follow(wanted.from, wanted.followed)?;
        Ok(self.begin(peer, follower, wanted.lines, Vec::new(), encode))
    }

    /// The same for a reader that cannot be refused a position: one in the future is answered with a reset.
    ///
    /// # Errors
    /// No place is free.
    pub(crate) fn open_or_reset<T: Send + 'static>(
        &self,
        peer: Peer,
        wanted: Wanted,
        encode: impl Fn(Message) -> T + Send + Sync + 'static,
    ) -> Result<ReceiverStream<T>, FollowError> {
        match self.followers.follow(wanted.from, wanted.followed.clone()) {
            Ok(follower) => Ok(self.begin(peer, follower, wanted.lines, Vec::new(), encode)),
            Err(FollowError::InTheFuture { newest, .. }) => {
                let follower = self.followers.follow(Some(Position::At(newest)), wanted.followed)?;
                let reset = Message::Reset { newest, oldest: self.followers.map().oldest_revision() };
                Ok(self.begin(peer, follower, wanted.lines, vec![reset], encode))
            }
            Err(error) => Err(error),
        }
    }

    fn begin<T: Send + 'static>(
        &self,
        peer: Peer,
        follower: Follower,
        lines: bool,
        first: Vec<Message>,
        encode: impl Fn(Message) -> T + Send + Sync + 'static,
    ) -> ReceiverStream<T> {
        let (taken, messages) = mpsc::channel(1);
        let feed = Feed { feeds: self.clone(), follower, lines, encode: Arc::new(encode), taken };
        let shutdown = self.shutdown.clone();
        tokio::spawn(async move {
            tokio::select! {
                () = shutdown.cancelled() => {}
                () = peer.expired() => tracing::debug!("what a reader of changes showed has run out"),
                why = feed.run(first) => tracing::debug!(why, "a reader of changes has left"),
            }
        });
        ReceiverStream::new(messages)
    }
}

/// The feed of one reader.
struct Feed<T, E> {
    feeds: ChangeFeeds,
    follower: Follower,
    lines: bool,
    encode: Arc<E>,
    taken: mpsc::Sender<T>,
}

impl<T: Send + 'static, E: Fn(Message) -> T + Send + Sync + 'static> Feed<T, E> {
    /// Tells until the reader is gone, and why it is.
    async fn run(mut self, first: Vec<Message>) -> &'static str {
        let mut position = self.follower.position();
        let started = Message::Started(position);
        for message in std::iter::once(started).chain(first) {
            if let Err(why) = self.hand_over((self.encode)(message)).await {
                return why;
            }
        }
        loop {
            let heartbeat = self.feeds.heartbeat;
            let told = tokio::select! {
                () = self.taken.closed() => return "it closed the stream",
                told = self.follower.next() => Some(told),
                () = sleep(heartbeat) => None,
            };
            let message = match told {
                None => (self.encode)(Message::Alive(self.follower.position())),
                Some(Told::Reset { newest, oldest }) => (self.encode)(Message::Reset { newest, oldest }),
                Some(Told::Cell { change, position: after }) => match self.cell(change, after).await {
                    Ok((happened, message)) => {
                        for event in happened {
                            let event = Message::Happened { cell: change.cell, event: Box::new(event), position };
                            if let Err(why) = self.hand_over((self.encode)(event)).await {
                                return why;
                            }
                        }
                        message
                    }
                    Err(error) => {
                        tracing::warn!(%error, "a change cannot be read; its reader is to come again");
                        return "a change cannot be read";
                    }
                },
            };
            if let Err(why) = self.hand_over(message).await {
                return why;
            }
            position = self.follower.position();
        }
    }

    async fn hand_over(&self, message: T) -> Result<(), &'static str> {
        match timeout(self.feeds.heartbeat * MISSED_SIGNS, self.taken.send(message)).await {
            Ok(Ok(())) => Ok(()),
            Ok(Err(_)) => Err("it closed the stream"),
            Err(_) => Err("it took nothing for long"),
        }
    }

    /// What happened in a changed cell, and its message, made beside the runtime.
    async fn cell(&self, change: CellChange, position: Position) -> Result<(Vec<CellEvent>, T), JournalError> {
        let _place = self.feeds.reading.acquire().await.map_err(|_| JournalError::Closed)?;
        let (map, encode, with_lines) = (self.feeds.followers.map().clone(), Arc::clone(&self.encode), self.lines);
        let CellChange { cell, from_version, to_version, .. } = change;
        let reading = tokio::task::spawn_blocking(move || {
            let happened = map.events_between(cell, from_version, to_version)?;
            let lines = if with_lines { map.changes_between(cell, from_version, to_version)? } else { None };
            Ok((happened, encode(Message::Cell { change, position, lines })))
        });
        reading.await.map_err(|error| JournalError::Store(error.to_string()))?
    }
}
