//! A drive that is streamed.

use std::time::Duration;

use lanemap_core::{Frame, Sequence};
use lanemap_proto::{encode, v1};
use tokio::{
    sync::{broadcast, mpsc, oneshot, watch},
    task::JoinHandle,
};
use tonic::transport::{Channel, Endpoint};

use crate::{
    connection::{Connection, Outgoing},
    error::ClientError,
    event::Events,
    start::SessionStart,
};

/// Events kept for a slow reader.
const EVENTS: usize = 4096;
/// Time to wait for a connection.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(10);

/// Streams drives to one service. Clones share the connection.
#[derive(Clone, Debug)]
pub struct IngestClient {
    channel: Channel,
}

/// One drive that is streamed.
#[derive(Debug)]
pub struct Session {
    id: String,
    resume_after: Option<Sequence>,
    outgoing: mpsc::Sender<Outgoing>,
    acked: watch::Receiver<Option<Sequence>>,
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
    /// Connects to a service, e.g. `http://127.0.0.1:8080`.
    ///
    /// # Errors
    /// An address that is not one, or nobody there.
    pub async fn connect(url: impl Into<String>) -> Result<Self, ClientError> {
        let url = url.into();
        let endpoint = Endpoint::from_shared(url.clone())
            .map_err(|error| ClientError::Address { url, reason: crate::error::with_sources(&error) })?
            .connect_timeout(CONNECT_TIMEOUT)
            .tcp_nodelay(true)
            .http2_keep_alive_interval(Duration::from_secs(20))
            .keep_alive_while_idle(true);
        Ok(Self { channel: endpoint.connect().await? })
    }

    /// Opens a drive, or resumes it, and waits until the service has accepted it.
    ///
    /// # Errors
    /// [`ClientError::Refused`] names what is wrong with the start; others say why the service cannot be reached.
    pub async fn start_session(&self, start: SessionStart) -> Result<(Session, Events), ClientError> {
        let (outgoing, requests) = mpsc::channel(1);
        let (event_sender, events) = broadcast::channel(EVENTS);
        let (ack_sender, acked) = watch::channel(None);
        let (accept, accepted) = oneshot::channel();
        let connection = Connection::new(self.channel.clone(), start, requests, event_sender, ack_sender, accept);
        let mut task = tokio::spawn(connection.run());
        let accepted = tokio::select! {
            biased;
            Ok(accepted) = accepted => accepted,
            outcome = &mut task => return Err(outcome_error(outcome)),
        };
        let v1::SessionAccepted { session_id, resume_after_sequence, .. } = accepted;
        let resume_after = resume_after_sequence.map(Sequence);
        Ok((Session { id: session_id, resume_after, outgoing, acked, task, failed: None }, Events::new(events)))
    }
}

impl Session {
    /// The service's name of the session, as in `/sessions/{id}`.
    #[must_use]
    pub fn id(&self) -> &str {
        &self.id
    }

    /// Last frame that was durable when the session opened, inclusive: frames up to it need not be sent.
    #[must_use]
    pub fn resume_after(&self) -> Option<Sequence> {
        self.resume_after
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

    /// Sends a frame; waits while [`SessionStart::max_unacked`] frames are unacked.
    ///
    /// # Errors
    /// The session failed: the service is gone for good, or a newer stream of the drive has taken over.
    pub async fn send(&mut self, frame: &Frame) -> Result<(), ClientError> {
        self.send_message(encode::frame(frame)).await
    }

    /// Sends a frame as the wire has it; its points are in the vehicle frame. Nothing is validated on this side.
    ///
    /// # Errors
    /// As [`Session::send`].
    pub async fn send_message(&mut self, frame: v1::Frame) -> Result<(), ClientError> {
        if self.outgoing.send(Outgoing::Frame(frame)).await.is_err() {
            return Err(self.failure().await);
        }
        Ok(())
    }

    /// Ends the drive; returns once all of it is durable and in the map. No frame can be added later.
    ///
    /// # Errors
    /// The session failed; it can be resumed by [`IngestClient::start_session`] under the same key.
    pub async fn finish(self) -> Result<SessionSummary, ClientError> {
        self.leave(Outgoing::End).await
    }

    /// Leaves the drive open to be resumed later; returns once every frame sent is durable or refused.
    ///
    /// # Errors
    /// As [`Session::finish`].
    pub async fn close(self) -> Result<SessionSummary, ClientError> {
        self.leave(Outgoing::Close).await
    }

    async fn leave(self, outgoing: Outgoing) -> Result<SessionSummary, ClientError> {
        if let Some(error) = self.failed {
            return Err(error);
        }
        // Where the task has ended already, its outcome says why.
        let _ = self.outgoing.send(outgoing).await;
        match self.task.await {
            Ok(outcome) => outcome,
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

fn outcome_error(outcome: Result<Result<SessionSummary, ClientError>, tokio::task::JoinError>) -> ClientError {
    match outcome {
        Ok(Ok(_)) => ClientError::Ended,
        Ok(Err(error)) => error,
        Err(error) => ClientError::Protocol(format!("the session's task failed: {error}")),
    }
}
