//! The gRPC side of ingest: one task per stream reads, decodes, and hands frames to the session's actor.

use std::sync::Arc;

use futures::StreamExt;
use lanemap_core::{FrameLimits, Sequence};
use lanemap_proto::v1::{
    self, RefusalReason, ingest_service_server::IngestService, stream_observations_request::Message,
    stream_observations_response::Message as Answer,
};
use tokio::time::{Instant, sleep};
use tokio_util::{sync::CancellationToken, task::TaskTracker};
use tonic::{Request, Response, Status, Streaming};

use super::{
    Outbox, OutboxStream, Refusal,
    decode::{self, PointFrame},
};
use crate::{
    config::ServerConfig,
    error::Error,
    session::{
        actor::Command,
        registry::{Attachment, OpenError, SessionRegistry},
    },
};

/// Messages that a stream may get wrong before its session is open.
const MAX_REFUSALS_BEFORE_START: usize = 100;

/// The ingest service.
#[derive(Clone)]
pub struct IngestGrpc {
    config: Arc<ServerConfig>,
    registry: SessionRegistry,
    shutdown: CancellationToken,
    streams: TaskTracker,
}

/// A stream's messages, and what ends it.
struct Incoming {
    messages: Streaming<v1::StreamObservationsRequest>,
    shutdown: CancellationToken,
    outbox: Outbox,
}

/// What a stream brings next.
enum Next {
    Message(Message),
    /// The vehicle sends no more, or its connection broke.
    Closed(Result<(), Status>),
    /// A newer stream took over, or nobody reads the answers.
    Finished,
    ShuttingDown,
}

impl IngestGrpc {
    pub(crate) fn new(
        config: Arc<ServerConfig>,
        registry: SessionRegistry,
        shutdown: CancellationToken,
        streams: TaskTracker,
    ) -> Self {
        Self { config, registry, shutdown, streams }
    }

    /// Serves a stream to its end.
    async fn serve(self, mut incoming: Incoming, outbox: Outbox) {
        let Some((start, attachment)) = self.open(&mut incoming, &outbox).await else { return };
        outbox.accept(self.accepted(&attachment));
        let limits = self.config.frame_limits();
        let shutdown = self.shutdown.clone();
        // What is cut off here was not acked: the vehicle sends it again.
        let with = tokio::select! {
            biased;
            () = shutdown.cancelled() => Err(Error::ShuttingDown.into()),
            with = pass_frames(&mut incoming, &outbox, &attachment, &start.point_frame, &limits) => with,
        };
        self.detach(&outbox, &attachment, with).await;
    }

    /// Lets the actor send what the stream was promised, then ends it. Only a shutdown bounds the wait.
    async fn detach(&self, outbox: &Outbox, attachment: &Attachment, with: Result<(), Status>) {
        let last_words = with.clone();
        let promised = async {
            if attachment.send(|stream| Command::Detach { stream, with: last_words }).await.is_ok() {
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
                tracing::warn!(session = %attachment.session, "a stream did not take what it was promised in time");
            }
        }
        outbox.finish(with);
    }

    /// Waits for a start that is in order; `None` where the stream ended before.
    async fn open(&self, incoming: &mut Incoming, outbox: &Outbox) -> Option<(decode::Start, Attachment)> {
        for _ in 0..MAX_REFUSALS_BEFORE_START {
            let refusal = match incoming.next().await {
                Next::Message(Message::Start(start)) => match self.start(&start, outbox).await {
                    Ok(opened) => return Some(opened),
                    Err(OpenError::Refused(refusal)) => refusal,
                    Err(OpenError::Failed(error)) => {
                        outbox.finish(Err(error.into()));
                        return None;
                    }
                },
                Next::Message(Message::Frame(frame)) => {
                    out_of_turn("frame", "a frame before start").of_frame(Sequence(frame.sequence))
                }
                Next::Message(Message::End(_)) => out_of_turn("end", "an end before start"),
                Next::Closed(with) => {
                    outbox.finish(with);
                    return None;
                }
                Next::ShuttingDown => {
                    outbox.finish(Err(Error::ShuttingDown.into()));
                    return None;
                }
                Next::Finished => return None,
            };
            tokio::select! {
                () = outbox.refuse(&refusal) => {}
                () = self.shutdown.cancelled() => {}
            }
        }
        let refusal = out_of_turn("start", format!("missing after {MAX_REFUSALS_BEFORE_START} messages"));
        outbox.finish(Err(Error::Refused(Box::new(refusal)).into()));
        None
    }

    async fn pass_uploaded(
        &self,
        frames: &[v1::Frame],
        end: bool,
        outbox: &Outbox,
        attachment: &Attachment,
        start: &decode::Start,
    ) -> Result<(), Error> {
        let limits = self.config.frame_limits();
        for message in frames {
            match decode::frame(message, &start.point_frame, &limits) {
                Ok(frame) => {
                    let arrived = Instant::now();
                    attachment.send(|stream| Command::Frame { stream, frame: Box::new(frame), arrived }).await?;
                }
                Err(refusal) => outbox.refuse(&refusal).await,
            }
        }
        if end { attachment.send(|stream| Command::End { stream }).await } else { Ok(()) }
    }

    async fn start(&self, start: &v1::SessionStart, outbox: &Outbox) -> Result<(decode::Start, Attachment), OpenError> {
        let start = decode::start(start).map_err(OpenError::Refused)?;
        let attachment = self.registry.open(&start, outbox).await?;
        Ok((start, attachment))
    }

    fn accepted(&self, attachment: &Attachment) -> v1::SessionAccepted {
        let config = &self.config;
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

/// Passes frames on until the stream ends; gives what the stream ends with.
async fn pass_frames(
    incoming: &mut Incoming,
    outbox: &Outbox,
    attachment: &Attachment,
    point_frame: &PointFrame,
    limits: &FrameLimits,
) -> Result<(), Status> {
    loop {
        let sent = match incoming.next().await {
            Next::Message(Message::Frame(message)) => match decode::frame(&message, point_frame, limits) {
                Ok(frame) => {
                    let arrived = Instant::now();
                    attachment.send(|stream| Command::Frame { stream, frame: Box::new(frame), arrived }).await
                }
                Err(refusal) => {
                    outbox.refuse(&refusal).await;
                    Ok(())
                }
            },
            Next::Message(Message::End(_)) => attachment.send(|stream| Command::End { stream }).await,
            Next::Message(Message::Start(_)) => {
                outbox.refuse(&out_of_turn("start", "a second start of this stream")).await;
                Ok(())
            }
            Next::Closed(with) => return with,
            Next::Finished => return Ok(()),
            Next::ShuttingDown => Err(Error::ShuttingDown),
        };
        sent?;
    }
}

impl Incoming {
    async fn next(&mut self) -> Next {
        loop {
            let message = tokio::select! {
                biased;
                () = self.shutdown.cancelled() => return Next::ShuttingDown,
                () = self.outbox.finished() => return Next::Finished,
                message = self.messages.message() => message,
            };
            match message {
                Ok(Some(v1::StreamObservationsRequest { message: Some(message) })) => return Next::Message(message),
                Ok(Some(v1::StreamObservationsRequest { message: None })) => {
                    self.outbox.refuse(&Refusal::new(RefusalReason::Missing, "message", "nothing", "required")).await;
                }
                Ok(None) => return Next::Closed(Ok(())),
                Err(status) => return Next::Closed(Err(status)),
            }
        }
    }
}

fn out_of_turn(field: &str, value: impl std::fmt::Display) -> Refusal {
    Refusal::new(RefusalReason::OutOfTurn, field, value, "start, then frames, then end")
}

fn saturating(count: usize) -> u32 {
    u32::try_from(count).unwrap_or(u32::MAX)
}

#[tonic::async_trait]
impl IngestService for IngestGrpc {
    type StreamObservationsStream = OutboxStream;

    async fn stream_observations(
        &self,
        request: Request<Streaming<v1::StreamObservationsRequest>>,
    ) -> Result<Response<OutboxStream>, Status> {
        let (outbox, answers) = Outbox::new();
        let incoming =
            Incoming { messages: request.into_inner(), shutdown: self.shutdown.clone(), outbox: outbox.clone() };
        self.streams.spawn(self.clone().serve(incoming, outbox));
        Ok(Response::new(answers))
    }

    async fn upload_observations(
        &self,
        request: Request<v1::UploadObservationsRequest>,
    ) -> Result<Response<v1::UploadObservationsResponse>, Status> {
        let v1::UploadObservationsRequest { start, frames, end } = request.into_inner();
        let start = required_start(start)?;
        let (outbox, mut answers) = Outbox::new();
        let attachment = self.registry.open(&start, &outbox).await?;
        let accepted = self.accepted(&attachment);
        let feed = async {
            let passed = self.pass_uploaded(&frames, end, &outbox, &attachment, &start).await;
            self.detach(&outbox, &attachment, passed.map_err(Status::from)).await;
        };
        let mut acked = accepted.resume_after_sequence;
        let mut refusals = Vec::new();
        let collect = async {
            while let Some(answer) = answers.next().await {
                match answer?.message {
                    Some(Answer::Ack(ack)) => acked = Some(ack.acked_sequence_inclusive),
                    Some(Answer::Refusal(refusal)) => refusals.push(refusal),
                    _ => {}
                }
            }
            Ok::<_, Status>(())
        };
        let ((), collected) = tokio::join!(feed, collect);
        collected?;
        Ok(Response::new(v1::UploadObservationsResponse {
            accepted: Some(accepted),
            acked_sequence_inclusive: acked,
            refusals,
        }))
    }
}

fn required_start(start: Option<v1::SessionStart>) -> Result<decode::Start, Status> {
    let missing = || Refusal::new(RefusalReason::Missing, "start", "nothing", "required");
    let start = start.ok_or_else(missing).and_then(|start| decode::start(&start));
    start.map_err(|refusal| Error::Refused(Box::new(refusal)).into())
}
