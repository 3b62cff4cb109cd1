//! The task behind a session: connects, resumes, sends what is not acked, listens.

use std::{
    hash::{BuildHasher, RandomState},
    sync::{Arc, OnceLock},
    time::Duration,
};

use lanemap_core::Sequence;
use lanemap_proto::v1::{
    self, RefusalReason, stream_observations_request::Message as Request,
    stream_observations_response::Message as Response,
};
use prost::Message;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use tokio::{
    sync::{broadcast, watch},
    time::{sleep, timeout},
};
use tonic::Status;

use crate::{
    backlog::{Backlog, Leaving, Next},
    error::ClientError,
    event::{self, Event},
    link::{Link, Stream},
    reconnect::Reconnect,
    session::SessionSummary,
};

/// Bytes of a request around its frame, at most.
const ENVELOPE_BYTES: usize = 16;

/// What a session's task works with.
pub(crate) struct Connection {
    pub(crate) link: Link,
    pub(crate) start: v1::SessionStart,
    pub(crate) backlog: Arc<Backlog>,
    pub(crate) events: broadcast::Sender<Event>,
    pub(crate) acked: watch::Sender<Option<Sequence>>,
    /// Set when the service accepts the session for the first time.
    pub(crate) accepted: Arc<OnceLock<v1::SessionAccepted>>,
    /// Tells that it is set.
    pub(crate) opened: watch::Sender<bool>,
    pub(crate) max_unacked: usize,
    pub(crate) reconnect: Reconnect,
    pub(crate) open_timeout: Duration,
    /// Whether a first connection that fails is tried again, as a later one is.
    pub(crate) patient: bool,
}

/// The task's own state.
struct Task {
    with: Connection,
    limits: v1::IngestLimits,
    /// Tries without any progress since.
    tries: u32,
    random: ChaCha8Rng,
    summary: SessionSummary,
}

/// How a stream ended.
enum Outcome {
    /// As asked; whether the drive is over.
    Done { ended: bool },
    /// It broke.
    Broken(ClientError),
}

impl Connection {
    /// Runs until the session ends as asked, or fails for good.
    pub(crate) async fn run(self) -> Result<SessionSummary, ClientError> {
        let backlog = Arc::clone(&self.backlog);
        let syncing = backlog.keep_synced();
        // Randomly seeded, as the standard library's hash maps are.
        let random = ChaCha8Rng::seed_from_u64(RandomState::new().hash_one(0));
        let limits = v1::IngestLimits::default();
        let mut task = Task { with: self, limits, tries: 0, random, summary: SessionSummary::default() };
        let outcome = task.run().await;
        if let Some(syncing) = syncing {
            syncing.abort();
        }
        let closed = backlog.close(matches!(outcome, Ok(true))).await;
        outcome?;
        closed?;
        Ok(task.summary)
    }
}

impl Task {
    /// Whether the drive is over and delivered.
    async fn run(&mut self) -> Result<bool, ClientError> {
        loop {
            let error = match self.one_stream().await {
                Outcome::Done { ended } => return Ok(ended),
                Outcome::Broken(error) => error,
            };
            let first = self.with.accepted.get().is_none();
            let renews = error.is_unauthenticated() && self.with.link.may_renew_token();
            if !(error.is_transient() || renews)
                || (first && !self.with.patient)
                || self.tries >= self.with.reconnect.max_tries
            {
                return Err(error);
            }
            let pause = self.with.reconnect.pause(self.tries, error.retry_after(), &mut self.random);
            self.tell(Event::Disconnected { reason: error.to_string(), retry_in: pause });
            self.summary.reconnections += u64::from(!first);
            self.tries += 1;
            sleep(pause).await;
        }
    }

    async fn one_stream(&mut self) -> Outcome {
        let opened = timeout(self.with.open_timeout, self.open()).await;
        let too_late = || Err(Status::unavailable("the session was not accepted in time").into());
        match opened.unwrap_or_else(|_| too_late()) {
            Ok(Some(stream)) => self.serve(stream).await.unwrap_or_else(Outcome::Broken),
            Ok(None) => Outcome::Done { ended: true },
            Err(error) => Outcome::Broken(error),
        }
    }

    /// Opens a stream and waits until the session is accepted; `None` where the drive is over and done.
    async fn open(&mut self) -> Result<Option<Stream>, ClientError> {
        let start = request(Request::Start(self.with.start.clone()));
        let mut stream = self.with.link.open(start).await?;
        let accepted = match stream.answer().await? {
            Some(Response::Accepted(accepted)) => accepted,
            Some(Response::Refusal(refusal)) => return Err(ClientError::Refused(Box::new(refusal))),
            Some(other) => return Err(ClientError::Protocol(format!("{other:?} before the session was accepted"))),
            None => return Err(Status::unavailable("the stream ended before the session was accepted").into()),
        };
        self.resume(&accepted).await?;
        let over = accepted.ended && self.with.backlog.leaving() == Some(Leaving::End) && self.with.backlog.is_empty();
        // The first one counts.
        let _ = self.with.accepted.set(accepted);
        self.with.opened.send_replace(true);
        Ok((!over).then_some(stream))
    }

    async fn resume(&mut self, accepted: &v1::SessionAccepted) -> Result<(), ClientError> {
        self.limits = accepted.limits.unwrap_or_default();
        self.with.backlog.rewind();
        let resume_after = accepted.resume_after_sequence.map(Sequence);
        if let Some(sequence) = resume_after {
            self.note_acked(sequence).await?;
        }
        self.tell(Event::Opened { resume_after });
        Ok(())
    }

    /// Frames that may be sent and not acked: the owner's bound or the service's, whichever is less.
    fn window(&self) -> usize {
        let theirs = match self.limits.max_frames_in_flight {
            0 => usize::MAX,
            frames => frames as usize,
        };
        self.with.max_unacked.min(theirs).max(1)
    }

    /// Sends and listens until the stream ends.
    async fn serve(&mut self, mut stream: Stream) -> Result<Outcome, ClientError> {
        let backlog = Arc::clone(&self.with.backlog);
        let mut ready = None;
        let mut left = false;
        loop {
            if ready.is_none() && !left {
                ready = self.next().await?;
            }
            tokio::select! {
                permit = stream.reserve(), if ready.is_some() => match ready.take() {
                    Some(Next::Frame(frame)) => {
                        permit.send(request(Request::Frame(frame)));
                    }
                    leaving => {
                        if leaving == Some(Next::Leave(Leaving::End)) {
                            permit.send(request(Request::End(v1::SessionEnd {})));
                        }
                        stream.close_sending();
                        left = true;
                    }
                },
                answer = stream.answer() => match answer? {
                    Some(answer) => self.hear(answer).await?,
                    None if left && backlog.is_empty() => {
                        return Ok(Outcome::Done { ended: backlog.leaving() == Some(Leaving::End) });
                    }
                    None => return Err(Status::unavailable("the stream ended").into()),
                },
                () = backlog.filled(), if ready.is_none() && !left => {}
            }
        }
    }

    /// What is to be sent next. A frame that the service would never take is refused here, as the service would: it must
    /// not keep those behind it.
    async fn next(&mut self) -> Result<Option<Next>, ClientError> {
        loop {
            let next = self.with.backlog.next(self.window()).await?;
            let limit = self.limits.max_message_bytes;
            match next {
                Some(Next::Frame(frame)) if limit > 0 && (frame.encoded_len() + ENVELOPE_BYTES) as u64 > limit => {
                    self.hear(Response::Refusal(too_large(&frame, limit))).await?;
                }
                next => return Ok(next),
            }
        }
    }

    async fn hear(&mut self, answer: Response) -> Result<(), ClientError> {
        // The connection carries something: a next break starts counting anew.
        self.tries = 0;
        match answer {
            Response::Ack(ack) => self.note_acked(Sequence(ack.acked_sequence_inclusive)).await?,
            Response::Refusal(refusal) => {
                if let Some(sequence) = refusal.sequence {
                    self.with.backlog.refused(sequence).await?;
                }
                self.summary.refused += 1;
                self.tell(Event::Refused(refusal));
            }
            Response::Pose(pose) => self.tell(Event::Pose(Box::new(event::pose(&pose)?))),
            Response::LocalMap(map) => self.tell(Event::LocalMap(event::local_map(&map)?)),
            // What is missing was never sent, or was sent too late: there is nothing more to send.
            Response::Gap(gap) => self.tell(Event::Gap {
                first: Sequence(gap.first_missing_sequence),
                last: Sequence(gap.last_missing_sequence),
            }),
            // How a stream ends, its transport says.
            Response::Ended(_) | Response::Closed(_) => {}
            Response::Accepted(_) => {
                return Err(ClientError::Protocol("a session was accepted twice".to_owned()));
            }
        }
        Ok(())
    }

    async fn note_acked(&mut self, sequence: Sequence) -> Result<(), ClientError> {
        self.with.backlog.acked(sequence.0).await?;
        self.summary.acked = Some(sequence);
        self.with.acked.send_replace(Some(sequence));
        self.tell(Event::Acked(sequence));
        Ok(())
    }

    fn tell(&self, event: Event) {
        // Nobody need listen.
        let _ = self.with.events.send(event);
    }
}

fn request(message: Request) -> v1::StreamObservationsRequest {
    v1::StreamObservationsRequest { message: Some(message) }
}

fn too_large(frame: &v1::Frame, limit: u64) -> v1::Refusal {
    let (value, limit) = (format!("{} bytes", frame.encoded_len()), format!("messages of at most {limit} bytes"));
    v1::Refusal {
        sequence: Some(frame.sequence),
        reason: RefusalReason::TooMany.into(),
        field: "frame".to_owned(),
        message: format!("frame {}: frame is {value}, limit: {limit}", frame.sequence),
        value,
        limit,
    }
}
