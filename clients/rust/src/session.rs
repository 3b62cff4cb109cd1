//! A drive that is streamed.

use std::sync::{Arc, OnceLock};

use lanemap_core::{Frame, Sequence};
use lanemap_proto::{encode, v1};
use tokio::{
    sync::{broadcast, watch},
    task::JoinHandle,
};

use crate::{
    backlog::{Backlog, Leaving, on_blocking_thread},
    connection::Connection,
    error::ClientError,
    event::Events,
    link::{ConnectOptions, Link},
    reconnect::Reconnect,
    spool::{SpoolOptions, SpoolRecovery, SpooledDrive},
    start::{MAX_UNACKED, SessionStart},
};

/// Events kept for a slow reader.
const EVENTS: usize = 4096;

/// Streams drives to one service, over gRPC (`http://host:port`, `https://...`) or zenoh (`tcp/host:port`, `tls/...`).
///
/// Over gRPC clones and their sessions share a connection; over zenoh every stream has one of its own, and tokio's
/// multi-thread runtime is needed.
#[derive(Clone, Debug)]
pub struct IngestClient {
    link: Link,
    options: ConnectOptions,
}

/// One drive that is streamed.
///
/// Dropped without [`finish`](Self::finish) or [`close`](Self::close), it still delivers what it has taken, and leaves.
#[derive(Debug)]
pub struct Session {
    accepted: Arc<OnceLock<v1::SessionAccepted>>,
    backlog: Arc<Backlog>,
    acked: watch::Receiver<Option<Sequence>>,
    opened: watch::Receiver<bool>,
    recovery: Option<SpoolRecovery>,
    task: JoinHandle<Result<SessionSummary, ClientError>>,
    /// The task's error, once it was asked for: a task gives its outcome only once.
    failed: Option<ClientError>,
}

/// What became of a drive.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct SessionSummary {
    /// Last durable frame, inclusive.
    pub acked: Option<Sequence>,
    /// Frames refused, of those sent in this session.
    pub refused: u64,
    /// Connections that broke.
    pub reconnections: u64,
}

impl IngestClient {
    /// Connects to a service, e.g. `http://127.0.0.1:8080` or `tcp/127.0.0.1:7447`.
    ///
    /// # Errors
    /// An address that is not one, or nobody there.
    pub async fn connect(url: impl Into<String>) -> Result<Self, ClientError> {
        Self::connect_with(url, ConnectOptions::default()).await
    }

    /// Connects to a service as the options say.
    ///
    /// # Errors
    /// An address that is not one, certificates that cannot be read, or nobody there who is trusted.
    pub async fn connect_with(url: impl Into<String>, options: ConnectOptions) -> Result<Self, ClientError> {
        let mut client = Self::offline(url, options).await?;
        client.link.reach().await?;
        Ok(client)
    }

    /// A client of a service that need not be there yet: its sessions connect when they can.
    ///
    /// # Errors
    /// An address that is not one, or certificates that cannot be read.
    pub async fn offline(url: impl Into<String>, options: ConnectOptions) -> Result<Self, ClientError> {
        Ok(Self { link: Link::new(&url.into(), &options).await?, options })
    }

    /// Opens a drive, or resumes it, and waits until the service has accepted it. A first connection that fails is not
    /// tried again.
    ///
    /// # Errors
    /// [`ClientError::Refused`] names what is wrong with the start; others say why the service cannot be reached.
    pub async fn start_session(&self, start: SessionStart) -> Result<(Session, Events), ClientError> {
        let (mut session, events) = self.session(start, false).await?;
        session.wait_opened().await?;
        Ok((session, events))
    }

    /// Opens a drive, or resumes it, without waiting for the service: frames go to the spool, and from there to the
    /// service once it can be reached, [`Reconnect`] allowing. [`Session::wait_opened`] tells when it was.
    ///
    /// # Errors
    /// A spool that cannot be opened.
    pub async fn begin_session(&self, start: SessionStart) -> Result<(Session, Events), ClientError> {
        self.session(start, true).await
    }

    /// Delivers what a spool's folder still holds of other drives, one after the other: those that an earlier process
    /// left there, ended or not. Drives that another process is using are left to it.
    ///
    /// # Errors
    /// The first drive that cannot be delivered; it stays in the spool.
    pub async fn deliver_spooled(&self, spool: &SpoolOptions) -> Result<Vec<SessionSummary>, ClientError> {
        let folder = spool.folder.clone();
        let drives = on_blocking_thread(move || SpooledDrive::list(&folder)).await?;
        let mut delivered = Vec::new();
        for drive in drives {
            let backlog = match open_spool(spool.clone(), drive.start.clone()).await {
                Err(ClientError::Spool(crate::SpoolError::InUse(_))) => continue,
                opened => opened?,
            };
            let (session, _events) = self.spawn(drive.start, backlog, MAX_UNACKED, Reconnect::default(), true);
            delivered.push(if drive.ended { session.finish().await? } else { session.close().await? });
        }
        Ok(delivered)
    }

    async fn session(&self, start: SessionStart, patient: bool) -> Result<(Session, Events), ClientError> {
        let message = start.to_wire();
        let backlog = match start.spool {
            Some(spool) => open_spool(spool, message.clone()).await?,
            None => Backlog::in_memory(start.max_unacked),
        };
        Ok(self.spawn(message, backlog, start.max_unacked, start.reconnect, patient))
    }

    fn spawn(
        &self,
        start: v1::SessionStart,
        backlog: Arc<Backlog>,
        max_unacked: usize,
        reconnect: Reconnect,
        patient: bool,
    ) -> (Session, Events) {
        let (events, heard) = broadcast::channel(EVENTS);
        let (acked, acked_now) = watch::channel(None);
        let (opened, opened_now) = watch::channel(false);
        let accepted = Arc::new(OnceLock::new());
        let connection = Connection {
            link: self.link.clone(),
            start,
            backlog: Arc::clone(&backlog),
            events,
            acked,
            accepted: Arc::clone(&accepted),
            opened,
            max_unacked,
            reconnect,
            open_timeout: self.options.open_timeout,
            patient,
        };
        let session = Session {
            accepted,
            recovery: backlog.recovery(),
            backlog,
            acked: acked_now,
            opened: opened_now,
            task: tokio::spawn(connection.run()),
            failed: None,
        };
        (session, Events::new(heard))
    }
}

async fn open_spool(options: SpoolOptions, start: v1::SessionStart) -> Result<Arc<Backlog>, ClientError> {
    Ok(on_blocking_thread(move || Backlog::on_disk(&options, &start)).await?)
}

impl Session {
    /// The service's name of the session, as in `/sessions/{id}`; empty until the service has accepted it, for which
    /// [`Session::wait_opened`] waits.
    #[must_use]
    pub fn id(&self) -> &str {
        self.accepted.get().map_or("", |accepted| accepted.session_id.as_str())
    }

    /// Waits until the service has accepted the session for the first time.
    ///
    /// # Errors
    /// The session failed before.
    pub async fn wait_opened(&mut self) -> Result<(), ClientError> {
        let opened = self.opened.wait_for(|opened| *opened).await.is_ok();
        if opened { Ok(()) } else { Err(self.failure().await) }
    }

    /// Last frame that was durable when the session opened, inclusive: frames up to it need not be sent.
    #[must_use]
    pub fn resume_after(&self) -> Option<Sequence> {
        self.accepted.get().and_then(|accepted| accepted.resume_after_sequence).map(Sequence)
    }

    /// Highest sequence that this or an earlier process put into the drive's spool; `None` without a spool.
    #[must_use]
    pub fn last_spooled(&self) -> Option<Sequence> {
        self.backlog.last_sequence().map(Sequence)
    }

    /// What the spool held when the session began; `None` without a spool.
    #[must_use]
    pub fn recovery(&self) -> Option<&SpoolRecovery> {
        self.recovery.as_ref()
    }

    /// Frames taken and neither acked nor refused, and the bytes that they have on disk.
    #[must_use]
    pub fn waiting(&self) -> (usize, u64) {
        self.backlog.waiting()
    }

    /// Last frame known to be durable, inclusive.
    #[must_use]
    pub fn acked(&self) -> Option<Sequence> {
        *self.acked.borrow()
    }

    /// Waits until the frame `sequence`, or a later one, is durable.
    ///
    /// # Errors
    /// The session failed before.
    pub async fn wait_acked(&mut self, sequence: Sequence) -> Result<(), ClientError> {
        let reached = self.acked.wait_for(|acked| *acked >= Some(sequence)).await.is_ok();
        if reached { Ok(()) } else { Err(self.failure().await) }
    }

    /// Takes a frame: into the spool, or into memory. Without a spool waits while [`SessionStart::max_unacked`] frames
    /// are unacked; with one, while it is full and [`SpoolOptions::when_full`] says so.
    ///
    /// # Errors
    /// A spool that is full and refuses: the session goes on. Or the session failed: the service is gone for good, or a
    /// newer stream of the drive has taken over; what is in the spool stays there.
    pub async fn send(&mut self, frame: &Frame) -> Result<(), ClientError> {
        self.send_message(encode::frame(frame)).await
    }

    /// Takes a frame as the wire has it; its points are in the vehicle frame. Nothing is validated on this side.
    ///
    /// # Errors
    /// As [`Session::send`].
    pub async fn send_message(&mut self, frame: v1::Frame) -> Result<(), ClientError> {
        match self.backlog.push(frame).await {
            Err(ClientError::Ended) => Err(self.failure().await),
            taken => taken,
        }
    }

    /// Ends the drive; returns once all of it is durable and in the map. No frame can be added later.
    ///
    /// # Errors
    /// The session failed; it can be resumed by [`IngestClient::start_session`] under the same key.
    pub async fn finish(self) -> Result<SessionSummary, ClientError> {
        self.leave(Leaving::End).await
    }

    /// Leaves the drive open to be resumed later; returns once every frame sent is durable or refused.
    ///
    /// # Errors
    /// As [`Session::finish`].
    pub async fn close(self) -> Result<SessionSummary, ClientError> {
        self.leave(Leaving::Close).await
    }

    /// Leaves at once. What is not acked stays in the spool, for the next session of the drive; without a spool it is lost.
    pub async fn abort(mut self) {
        self.task.abort();
        // Its outcome is that it was aborted, or how it ended before.
        let _ = (&mut self.task).await;
        // Nobody is left to close the backlog.
        let _ = self.backlog.close(false).await;
    }

    async fn leave(mut self, leaving: Leaving) -> Result<SessionSummary, ClientError> {
        if let Some(error) = self.failed.take() {
            return Err(error);
        }
        let left = self.backlog.leave(leaving).await;
        match (&mut self.task).await {
            Ok(outcome) => left.and(outcome),
            outcome => Err(outcome_error(outcome)),
        }
    }

    async fn failure(&mut self) -> ClientError {
        match self.failed.clone() {
            Some(error) => error,
            None => self.failed.insert(outcome_error((&mut self.task).await)).clone(),
        }
    }
}

impl Drop for Session {
    fn drop(&mut self) {
        self.backlog.abandon();
    }
}

fn outcome_error(outcome: Result<Result<SessionSummary, ClientError>, tokio::task::JoinError>) -> ClientError {
    match outcome {
        Ok(Ok(_)) => ClientError::Ended,
        Ok(Err(error)) => error,
        Err(error) => ClientError::Protocol(format!("the session's task failed: {error}")),
    }
}
