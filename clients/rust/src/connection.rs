//! The task behind a session: connects, resumes, sends what is not acked, listens.

use std::{collections::VecDeque, time::Duration};

use lanemap_core::Sequence;
use lanemap_proto::v1::{
    self, ingest_service_client::IngestServiceClient, stream_observations_request::Message as Request,
    stream_observations_response::Message as Response,
};
use tokio::{
    sync::{broadcast, mpsc, oneshot, watch},
    time::sleep,
};
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Status, Streaming, transport::Channel};

use crate::{
    error::ClientError,
    event::{self, Event},
    session::SessionSummary,
    start::SessionStart,
};

/// Messages between the session and the network.
const REQUESTS: usize = 16;
/// Largest answer taken, bytes: a local map is far smaller.
const MAX_ANSWER_BYTES: usize = 64 * 1024 * 1024;

/// What the session's owner asks for.
#[derive(Debug)]
pub(crate) enum Outgoing {
    Frame(v1::Frame),
    /// The drive is over.
    End,
    /// Leave once everything is acked.
    Close,
}

/// Frames that are not acked, in the order of sending, and how many of them this stream has sent.
#[derive(Debug, Default)]
struct Unacked {
    frames: VecDeque<v1::Frame>,
    sent: usize,
}

pub(crate) struct Connection {
    channel: Channel,
    start: SessionStart,
    outgoing: mpsc::Receiver<Outgoing>,
    events: broadcast::Sender<Event>,
    acked: watch::Sender<Option<Sequence>>,
    accept: Option<oneshot::Sender<v1::SessionAccepted>>,
    unacked: Unacked,
    leaving: Option<Leaving>,
    summary: SessionSummary,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Leaving {
    End,
    Close,
}

/// One open stream.
struct Stream {
    requests: Option<mpsc::Sender<v1::StreamObservationsRequest>>,
    answers: Streaming<v1::StreamObservationsResponse>,
}

/// What was sent.
#[derive(PartialEq, Eq)]
enum Sent {
    Frame,
    /// The end: nothing comes after it.
    Last,
}

/// How a stream ended.
enum Outcome {
    /// As asked.
    Done,
    /// It broke after it had been open.
    Broken(ClientError),
}

impl Unacked {
    /// Forgets what is durable.
    fn acked(&mut self, sequence: Sequence) {
        while self.frames.front().is_some_and(|frame| frame.sequence <= sequence.0) {
            self.frames.pop_front();
            self.sent = self.sent.saturating_sub(1);
        }
    }

    /// Forgets a frame that was refused: the oldest of its number that was sent.
    fn refused(&mut self, sequence: u64) {
        if let Some(index) = self.frames.iter().take(self.sent).position(|frame| frame.sequence == sequence) {
            self.frames.remove(index);
            self.sent -= 1;
        }
    }

    fn next_to_send(&self) -> Option<&v1::Frame> {
        self.frames.get(self.sent)
    }
}

impl Connection {
    pub(crate) fn new(
        channel: Channel,
        start: SessionStart,
        outgoing: mpsc::Receiver<Outgoing>,
        events: broadcast::Sender<Event>,
        acked: watch::Sender<Option<Sequence>>,
        accept: oneshot::Sender<v1::SessionAccepted>,
    ) -> Self {
        Self {
            channel,
            start,
            outgoing,
            events,
            acked,
            accept: Some(accept),
            unacked: Unacked::default(),
            leaving: None,
            summary: SessionSummary::default(),
        }
    }

    /// Runs until the session ends as asked, or fails for good.
    pub(crate) async fn run(mut self) -> Result<SessionSummary, ClientError> {
        let mut tries = 0;
        loop {
            let error = match self.open().await {
                Ok(None) => return Ok(self.summary),
                Ok(Some(stream)) => {
                    tries = 0;
                    match self.serve(stream).await {
                        Outcome::Done => return Ok(self.summary),
                        Outcome::Broken(error) => error,
                    }
                }
                Err(error) => error,
            };
            // Before the session was ever accepted, its owner decides whether to try again.
            if !error.is_transient() || self.accept.is_some() || tries >= self.start.reconnect.max_tries {
                return Err(error);
            }
            self.tell(Event::Disconnected { reason: error.to_string() });
            self.summary.reconnections += 1;
            sleep(self.pause(tries)).await;
            tries += 1;
        }
    }

    fn pause(&self, tries: u32) -> Duration {
        let reconnect = &self.start.reconnect;
        reconnect.first_pause.saturating_mul(1 << tries.min(16)).min(reconnect.longest_pause)
    }

    /// Opens a stream and waits until the session is accepted; `None` where the drive is over and done.
    async fn open(&mut self) -> Result<Option<Stream>, ClientError> {
        let (requests, messages) = mpsc::channel(REQUESTS);
        let start = Request::Start(self.start.to_wire());
        requests.send(request(start)).await.map_err(|_| ClientError::Ended)?;
        let mut client = IngestServiceClient::new(self.channel.clone()).max_decoding_message_size(MAX_ANSWER_BYTES);
        let mut answers = client.stream_observations(ReceiverStream::new(messages)).await?.into_inner();
        let accepted = match answers.message().await?.and_then(|answer| answer.message) {
            Some(Response::Accepted(accepted)) => accepted,
            Some(Response::Refusal(refusal)) => return Err(ClientError::Refused(Box::new(refusal))),
            Some(other) => return Err(ClientError::Protocol(format!("{other:?} before the session was accepted"))),
            None => return Err(Status::unavailable("the stream ended before the session was accepted").into()),
        };
        self.resume(accepted.resume_after_sequence.map(Sequence));
        let over = accepted.ended && self.leaving == Some(Leaving::End) && self.unacked.frames.is_empty();
        if let Some(accept) = self.accept.take() {
            // The owner may have gone meanwhile: then the next command's channel is closed, and the session is left.
            let _ = accept.send(accepted);
        }
        Ok((!over).then_some(Stream { requests: Some(requests), answers }))
    }

    fn resume(&mut self, resume_after: Option<Sequence>) {
        self.unacked.sent = 0;
        if let Some(sequence) = resume_after {
            self.note_acked(sequence);
        }
        self.tell(Event::Opened { resume_after });
    }

    /// Sends and listens until the stream ends.
    async fn serve(&mut self, mut stream: Stream) -> Outcome {
        loop {
            let room = self.leaving.is_none() && self.unacked.frames.len() < self.start.max_unacked.max(1);
            let to_send = self.unacked.next_to_send().is_some() || self.leaving.is_some();
            tokio::select! {
                outgoing = self.outgoing.recv(), if room => self.take(outgoing),
                permit = reserve(stream.requests.clone()), if to_send => {
                    if self.send_next(permit) == Sent::Last {
                        stream.requests = None;
                    }
                }
                answer = stream.answers.message() => match answer {
                    Ok(Some(answer)) => {
                        if let Err(error) = self.hear(answer.message) {
                            return Outcome::Broken(error);
                        }
                    }
                    Ok(None) if self.is_done() => return Outcome::Done,
                    Ok(None) => return Outcome::Broken(Status::unavailable("the stream ended").into()),
                    Err(status) => return Outcome::Broken(status.into()),
                },
            }
        }
    }

    fn is_done(&self) -> bool {
        self.leaving.is_some() && self.unacked.frames.is_empty()
    }

    /// Sends the next frame, or, after the last one, the end.
    fn send_next(&mut self, permit: mpsc::OwnedPermit<v1::StreamObservationsRequest>) -> Sent {
        if let Some(frame) = self.unacked.next_to_send() {
            permit.send(request(Request::Frame(frame.clone())));
            self.unacked.sent += 1;
            return Sent::Frame;
        }
        if self.leaving == Some(Leaving::End) {
            permit.send(request(Request::End(v1::SessionEnd {})));
        }
        Sent::Last
    }

    fn take(&mut self, outgoing: Option<Outgoing>) {
        match outgoing {
            Some(Outgoing::Frame(frame)) => self.unacked.frames.push_back(frame),
            Some(Outgoing::End) => self.leaving = Some(Leaving::End),
            Some(Outgoing::Close) | None => self.leaving = Some(Leaving::Close),
        }
    }

    fn hear(&mut self, message: Option<Response>) -> Result<(), ClientError> {
        match message {
            Some(Response::Ack(ack)) => self.note_acked(Sequence(ack.acked_sequence_inclusive)),
            Some(Response::Refusal(refusal)) => {
                if let Some(sequence) = refusal.sequence {
                    self.unacked.refused(sequence);
                }
                self.summary.refused += 1;
                self.tell(Event::Refused(refusal));
            }
            Some(Response::Pose(pose)) => self.tell(Event::Pose(Box::new(event::pose(&pose)?))),
            Some(Response::LocalMap(map)) => self.tell(Event::LocalMap(event::local_map(&map)?)),
            // gRPC says by its status how a stream ends.
            Some(Response::Ended(_) | Response::Closed(_)) | None => {}
            Some(Response::Accepted(_)) => {
                return Err(ClientError::Protocol("a session was accepted twice".to_owned()));
            }
        }
        Ok(())
    }

    fn note_acked(&mut self, sequence: Sequence) {
        self.unacked.acked(sequence);
        self.summary.acked = Some(sequence);
        self.acked.send_replace(Some(sequence));
        self.tell(Event::Acked(sequence));
    }

    fn tell(&self, event: Event) {
        // Nobody need listen.
        let _ = self.events.send(event);
    }
}

fn request(message: Request) -> v1::StreamObservationsRequest {
    v1::StreamObservationsRequest { message: Some(message) }
}

/// Room for one message; waits for ever where the sending side is closed: the answers tell why.
async fn reserve(
    requests: Option<mpsc::Sender<v1::StreamObservationsRequest>>,
) -> mpsc::OwnedPermit<v1::StreamObservationsRequest> {
    if let Some(requests) = requests
        && let Ok(permit) = requests.reserve_owned().await
    {
        return permit;
    }
    std::future::pending().await
}

#[cfg(test)]
mod tests {
    use super::*;

    fn unacked(sequences: &[u64], sent: usize) -> Unacked {
        let frames = sequences.iter().map(|&sequence| v1::Frame { sequence, ..v1::Frame::default() }).collect();
        Unacked { frames, sent }
    }

    #[test]
    fn what_is_acked_is_forgotten_and_the_rest_stays_in_order() {
        let mut unacked = unacked(&[1, 2, 3, 4], 3);
        unacked.acked(Sequence(2));
        assert_eq!(unacked.frames.iter().map(|frame| frame.sequence).collect::<Vec<_>>(), [3, 4]);
        assert_eq!(unacked.next_to_send().map(|frame| frame.sequence), Some(4));
    }

    #[test]
    fn a_refused_frame_is_not_sent_again() {
        let mut unacked = unacked(&[1, 2, 3], 2);
        unacked.refused(2);
        unacked.sent = 0;
        assert_eq!(unacked.frames.iter().map(|frame| frame.sequence).collect::<Vec<_>>(), [1, 3]);
    }
}
