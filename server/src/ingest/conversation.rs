//! The life of a stream, whatever carries it: a session is opened, messages are taken until the stream ends, and the
//! vehicle is told everything that it was promised before it is told how the stream ended.
//!
//! A transport brings the messages, says who its peer is, and carries the answers back; it knows no other rule.

use std::sync::Arc;

use futures::{Stream, StreamExt};
use lanemap_core::{FrameLimits, Sequence};
use lanemap_proto::v1::{self, RefusalReason, stream_observations_request::Message};
use tokio::time::{Instant, sleep, timeout_at};
use tokio_util::{sync::CancellationToken, task::TaskTracker};
use tonic::Status;

use super::{
    Outbox, OutboxStream, Refusal,
    decode::{self, PointFrame},
};
use crate::{
    auth::{AuthenticationError, Peer},
    config::ServerConfig,
    error::Error,
    session::{
        actor::Command,
        registry::{Attachment, OpenError, SessionRegistry, StreamPlace},
    },
};

/// Messages that a stream may get wrong before its session is open.
const MAX_REFUSALS_BEFORE_START: usize = 100;

/// What a stream ends with: all is well, or why not.
pub(crate) type Ending = Result<(), Status>;

/// Every stream of every transport. Clones share them.
#[derive(Clone)]
pub(crate) struct Conversations {
    config: Arc<ServerConfig>,
    registry: SessionRegistry,
    shutdown: CancellationToken,
    streams: TaskTracker,
}

/// A session that is open on a stream.
pub(super) struct OpenSession {
    attachment: Attachment,
    point_frame: PointFrame,
    limits: FrameLimits,
}

/// What a stream brings, and what ends it from outside.
struct Incoming<M> {
    messages: M,
    outbox: Outbox,
    shutdown: CancellationToken,
}

impl Conversations {
    pub(crate) fn new(
        config: Arc<ServerConfig>,
        registry: SessionRegistry,
        shutdown: CancellationToken,
        streams: TaskTracker,
    ) -> Self {
        Self { config, registry, shutdown, streams }
    }

    /// Serves a stream of `peer` to its end, in a task of its own; gives what is to be answered.
    ///
    /// The end of `messages` closes the stream, and so does dropping the answers.
    pub(crate) fn begin<M>(&self, peer: Peer, messages: M) -> OutboxStream
    where
        M: Stream<Item = Result<v1::StreamObservationsRequest, Status>> + Send + Unpin + 'static,
    {
        let (outbox, answers) = Outbox::new();
        let incoming = Incoming { messages, outbox, shutdown: self.shutdown.clone() };
        self.streams.spawn(self.clone().serve(peer, incoming));
        answers
    }

    async fn serve<M>(self, peer: Peer, mut incoming: Incoming<M>)
    where
        M: Stream<Item = Result<v1::StreamObservationsRequest, Status>> + Unpin,
    {
        let outbox = incoming.outbox.clone();
        let _place = match self.place() {
            Ok(place) => place,
            Err(error) => return outbox.finish(Err(error.into())),
        };
        let ending = match self.open(&peer, &mut incoming).await {
            Ok(session) => {
                outbox.accept(self.accepted(&session));
                let ending = self.take_messages(&peer, &mut incoming, &session).await;
                self.keep_promises(&outbox, &session, ending.clone()).await;
                ending
            }
            Err(ending) => ending,
        };
        outbox.finish(ending);
    }

    /// A place among the streams.
    pub(super) fn place(&self) -> Result<StreamPlace, Error> {
        self.registry.stream_place()
    }

    /// Waits for a start that is in order; the error is what the stream ended with before.
    async fn open<M>(&self, peer: &Peer, incoming: &mut Incoming<M>) -> Result<OpenSession, Ending>
    where
        M: Stream<Item = Result<v1::StreamObservationsRequest, Status>> + Unpin,
    {
        let outbox = incoming.outbox.clone();
        // Only the vehicle is waited for so long, not what it asks for.
        let deadline = Instant::now() + self.config.start_wait();
        let too_late = || Error::NoStart { waited_s: self.config.start_wait_s };
        for _ in 0..MAX_REFUSALS_BEFORE_START {
            let message = timeout_at(deadline, incoming.next()).await.map_err(|_| Err(too_late().into()))?;
            let refusal = match message? {
                Some(Message::Start(start)) => match self.start(peer, &start, &outbox).await {
                    Ok(session) => return Ok(session),
                    Err(OpenError::Refused(refusal)) => refusal,
                    Err(OpenError::Failed(error)) => return Err(Err(error.into())),
                },
                Some(Message::Frame(frame)) => {
                    out_of_turn("frame", "a frame before start").of_frame(Sequence(frame.sequence))
                }
                Some(Message::End(_)) => out_of_turn("end", "an end before start"),
                None => empty(),
            };
            tokio::select! {
                () = outbox.refuse(&refusal) => {}
                () = self.shutdown.cancelled() => {}
            }
        }
        let refusal = out_of_turn("start", format!("missing after {MAX_REFUSALS_BEFORE_START} messages"));
        Err(Err(Error::Refused(Box::new(refusal)).into()))
    }

    /// Opens the session that a start asks for, where its peer may.
    pub(super) async fn start(
        &self,
        peer: &Peer,
        start: &v1::SessionStart,
        outbox: &Outbox,
    ) -> Result<OpenSession, OpenError> {
        let start = decode::start(start).map_err(OpenError::Refused)?;
        peer.may_stream(&start.key.fleet, &start.key.vehicle)?;
        let attachment = self.registry.open(&start, outbox).await?;
        Ok(OpenSession { attachment, point_frame: start.point_frame, limits: self.config.frame_limits() })
    }

    /// Takes messages until the stream ends; gives what it ends with.
    ///
    /// What a shutdown cuts off here was not acked: the vehicle sends it again.
    async fn take_messages<M>(&self, peer: &Peer, incoming: &mut Incoming<M>, session: &OpenSession) -> Ending
    where
        M: Stream<Item = Result<v1::StreamObservationsRequest, Status>> + Unpin,
    {
        let outbox = incoming.outbox.clone();
        let take_all = async {
            loop {
                match incoming.next().await {
                    Ok(message) => session.take(message, &outbox).await?,
                    Err(ending) => return ending,
                }
            }
        };
        tokio::select! {
            biased;
            () = self.shutdown.cancelled() => Err(Error::ShuttingDown.into()),
            () = peer.expired() => Err(Error::Unauthenticated(AuthenticationError::Expired).into()),
            ending = take_all => ending,
        }
    }

    /// Lets the actor send what the stream was promised. Only a shutdown bounds the wait.
    pub(super) async fn keep_promises(&self, outbox: &Outbox, session: &OpenSession, last_words: Ending) {
        let promised = async {
            let detach = |stream| Command::Detach { stream, with: last_words };
            if session.attachment.send(detach).await.is_ok() {
                outbox.finished().await;
            }
        };
        let overdue = async {
            self.shutdown.cancelled().await;
            sleep(self.config.shutdown_grace() / 2).await;
        };
        tokio::select! {
            () = promised => {}
            () = overdue => {
                let session = session.attachment.session;
                tracing::warn!(%session, "a stream did not take what it was promised in time");
            }
        }
    }

    /// The answer to the start of `session`.
    pub(super) fn accepted(&self, session: &OpenSession) -> v1::SessionAccepted {
        let (config, attachment) = (&self.config, &session.attachment);
        v1::SessionAccepted {
            session_id: attachment.session.to_string(),
            resume_after_sequence: attachment.at.last.map(|sequence| sequence.0),
            limits: Some(v1::IngestLimits {
                max_detections: saturating(config.max_detections),
                max_points_per_detection: saturating(config.max_points_per_detection),
                max_point_range_m: config.max_point_range_m,
                max_message_bytes: config.max_message_bytes as u64,
                max_frames_in_flight: saturating(config.max_frames_in_flight),
            }),
            ended: attachment.at.ended,
        }
    }
}

impl OpenSession {
    /// Hands a message to the session's actor, or refuses it; waits where the session or the reader of refusals is slow.
    async fn take(&self, message: Option<Message>, outbox: &Outbox) -> Result<(), Error> {
        match message {
            Some(Message::Frame(frame)) => self.take_frame(&frame, outbox).await,
            Some(Message::End(_)) => self.end().await,
            Some(Message::Start(_)) => {
                outbox.refuse(&out_of_turn("start", "a second start of this stream")).await;
                Ok(())
            }
            None => {
                outbox.refuse(&empty()).await;
                Ok(())
            }
        }
    }

    /// Decodes and validates a frame, and hands it on.
    pub(super) async fn take_frame(&self, message: &v1::Frame, outbox: &Outbox) -> Result<(), Error> {
        match decode::frame(message, &self.point_frame, &self.limits) {
            Ok(frame) => {
                let arrived = Instant::now();
                self.attachment.send_frame(frame, arrived).await
            }
            Err(refusal) => {
                outbox.refuse(&refusal).await;
                let sequence = Sequence(message.sequence);
                self.attachment.send(|stream| Command::Refused { stream, sequence }).await
            }
        }
    }

    /// Tells the actor that the drive is over.
    pub(super) async fn end(&self) -> Result<(), Error> {
        self.attachment.send(|stream| Command::End { stream }).await
    }
}

impl<M: Stream<Item = Result<v1::StreamObservationsRequest, Status>> + Unpin> Incoming<M> {
    /// The next message, `None` where it is empty; the error is what the stream ends with.
    async fn next(&mut self) -> Result<Option<Message>, Ending> {
        let message = tokio::select! {
            biased;
            () = self.shutdown.cancelled() => return Err(Err(Error::ShuttingDown.into())),
            // A newer stream took over, or nobody reads the answers: what the stream ends with is settled.
            () = self.outbox.finished() => return Err(Ok(())),
            message = self.messages.next() => message,
        };
        match message {
            Some(Ok(request)) => Ok(request.message),
            Some(Err(status)) => Err(Err(status)),
            None => Err(Ok(())),
        }
    }
}

fn out_of_turn(field: &str, value: impl std::fmt::Display) -> Refusal {
    Refusal::new(RefusalReason::OutOfTurn, field, value, "start, then frames, then end")
}

fn empty() -> Refusal {
    Refusal::new(RefusalReason::Missing, "message", "nothing", "required")
}

fn saturating(count: usize) -> u32 {
    u32::try_from(count).unwrap_or(u32::MAX)
}
