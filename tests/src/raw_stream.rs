//! A stream that sends exactly what a test wants sent, however wrong.

use std::time::Duration;

use lanemap_proto::v1::{
    self, ingest_service_client::IngestServiceClient, stream_observations_request::Message as Request,
    stream_observations_response::Message as Response,
};
use tokio::{sync::mpsc, time::timeout};
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Status, Streaming, transport::Channel};

/// Longest wait for an answer before a test fails; an answer takes milliseconds.
const PATIENCE: Duration = Duration::from_secs(20);

/// A stream without the client's care.
#[derive(Debug)]
pub struct RawStream {
    requests: Option<mpsc::Sender<v1::StreamObservationsRequest>>,
    answers: Streaming<v1::StreamObservationsResponse>,
}

impl RawStream {
    /// Opens a stream on a connection of its own, without a start.
    pub async fn open(url: &str) -> Self {
        Self::open_on(Channel::from_shared(url.to_owned()).unwrap().connect().await.unwrap()).await
    }

    /// Opens a stream whose network buffers are small: a reader that stops is felt after 64 KiB.
    pub async fn open_with_small_windows(url: &str) -> Self {
        let endpoint = Channel::from_shared(url.to_owned()).unwrap();
        let endpoint = endpoint.initial_stream_window_size(65_535).initial_connection_window_size(65_535);
        Self::open_on(endpoint.connect().await.unwrap()).await
    }

    /// Opens a stream on a connection.
    pub async fn open_on(channel: Channel) -> Self {
        let (requests, messages) = mpsc::channel(16);
        let mut client = IngestServiceClient::new(channel);
        let answers = client.stream_observations(ReceiverStream::new(messages)).await.unwrap().into_inner();
        Self { requests: Some(requests), answers }
    }

    /// Opens a stream and a session.
    pub async fn started(url: &str, start: v1::SessionStart) -> (Self, v1::SessionAccepted) {
        let mut stream = Self::open(url).await;
        let accepted = stream.start(start).await;
        (stream, accepted)
    }

    /// Starts a session and waits until it is accepted.
    pub async fn start(&mut self, start: v1::SessionStart) -> v1::SessionAccepted {
        self.send(Request::Start(start)).await;
        match self.answer().await {
            Response::Accepted(accepted) => accepted,
            other => panic!("not accepted: {other:?}"),
        }
    }

    /// Asks for a session once.
    ///
    /// # Errors
    /// The status with which the stream ended, where there was no place for it.
    pub async fn try_start(mut self, start: v1::SessionStart) -> Result<(Self, v1::SessionAccepted), Status> {
        let message = v1::StreamObservationsRequest { message: Some(Request::Start(start)) };
        // A stream for which there is no place may be closed before it takes anything: its end tells why.
        let _ = timeout(PATIENCE, self.requests.as_ref().unwrap().send(message)).await;
        match self.answer_or_end().await? {
            Some(Response::Accepted(accepted)) => Ok((self, accepted)),
            other => panic!("not accepted: {other:?}"),
        }
    }

    /// Asks for a session that is not given; the status with which the stream ends.
    pub async fn start_error(mut self, start: v1::SessionStart) -> Status {
        self.send(Request::Start(start)).await;
        self.end().await.unwrap_err()
    }

    /// Sends a message.
    pub async fn send(&self, message: Request) {
        let message = v1::StreamObservationsRequest { message: Some(message) };
        let sent = self.requests.as_ref().unwrap().send(message);
        timeout(PATIENCE, sent).await.expect("the stream takes no message").expect("the stream is closed");
    }

    /// Sends a frame.
    pub async fn send_frame(&self, frame: v1::Frame) {
        self.send(Request::Frame(frame)).await;
    }

    /// Sends no more.
    pub fn close_sending(&mut self) {
        self.requests = None;
    }

    /// The next answer, or how the stream ended: `Ok(None)` where all is well.
    ///
    /// # Errors
    /// The status with which the stream ended.
    pub async fn answer_or_end(&mut self) -> Result<Option<Response>, Status> {
        let answer = timeout(PATIENCE, self.answers.message()).await.expect("no answer");
        Ok(answer?.map(|answer| answer.message.expect("an empty answer")))
    }

    /// The next answer.
    pub async fn answer(&mut self) -> Response {
        self.answer_or_end().await.expect("the stream failed").expect("the stream ended")
    }

    /// The next refusal; acks and poses before it are passed over.
    pub async fn refusal(&mut self) -> v1::Refusal {
        loop {
            if let Response::Refusal(refusal) = self.answer().await {
                return refusal;
            }
        }
    }

    /// Waits until a frame is acked; poses and refusals before it are passed over.
    pub async fn acked(&mut self, sequence: u64) {
        loop {
            match self.answer().await {
                Response::Ack(ack) if ack.acked_sequence_inclusive >= sequence => return,
                _ => {}
            }
        }
    }

    /// How the stream ends; what it still answers is passed over.
    ///
    /// # Errors
    /// The status with which the stream ended.
    pub async fn end(&mut self) -> Result<(), Status> {
        while self.answer_or_end().await?.is_some() {}
        Ok(())
    }
}
