//! A vehicle in zenoh that puts exactly what a test wants put, however wrong.

use std::{
    sync::atomic::{AtomicU64, Ordering},
    time::Duration,
};

use lanemap_proto::{
    v1::{self, stream_observations_request::Message as Request, stream_observations_response::Message as Response},
    zenoh_keys::{Attachment, REQUEST_ENCODING, SERVER, StreamNonce, VehicleKeys},
};
use prost::Message;
use tokio::time::timeout;
use zenoh::{
    Session,
    handlers::{FifoChannelHandler, RingChannel, RingChannelHandler},
    liveliness::LivelinessToken,
    pubsub::Subscriber,
    qos::CongestionControl,
    sample::{Sample, SampleKind},
};
use zenoh_ext::{AdvancedPublisher, AdvancedPublisherBuilderExt, CacheConfig, MissDetectionConfig};

/// Longest wait for an answer before a test fails; an answer takes milliseconds.
const PATIENCE: Duration = Duration::from_secs(20);
/// Longest wait for an answer where a link may break; its vehicle begins anew then.
const BREAK: Duration = Duration::from_secs(2);

/// A configuration of zenoh that looks for nobody.
#[must_use]
pub fn configuration(mode: &str, listen: &[&str], connect: &[&str]) -> zenoh::Config {
    let mut config = zenoh::Config::default();
    let list = |endpoints: &[&str]| format!("{endpoints:?}");
    for (name, value) in [
        ("mode", format!("{mode:?}")),
        ("listen/endpoints", list(listen)),
        ("connect/endpoints", list(connect)),
        ("scouting/multicast/enabled", "false".to_owned()),
        ("scouting/gossip/enabled", "false".to_owned()),
        ("scouting/delay", "0".to_owned()),
    ] {
        config.insert_json5(name, &value).unwrap();
    }
    config
}

/// Connects to a router.
pub async fn connect(endpoint: &str) -> Session {
    zenoh::open(configuration("client", &[], &[endpoint])).await.unwrap()
}

/// One stream of one vehicle, without the client's care.
#[derive(Debug)]
pub struct RawZenohStream {
    session: Session,
    keys: VehicleKeys,
    /// The stream's nonce.
    pub nonce: StreamNonce,
    /// The number that the next message bears.
    pub next_number: u64,
    acks: Subscriber<FifoChannelHandler<Sample>>,
    poses: Subscriber<RingChannelHandler<Sample>>,
    token: Option<LivelinessToken>,
    next_ack: u64,
    recoverable: Option<AdvancedPublisher<'static>>,
}

impl RawZenohStream {
    /// A stream with its liveliness token and its subscriptions; nothing is sent yet.
    pub async fn open(session: &Session, fleet: &str, vehicle: &str) -> Self {
        let mut stream = Self::open_without_token(session, fleet, vehicle).await;
        let token = session.liveliness().declare_token(stream.keys.alive(stream.nonce));
        stream.token = Some(token.await.unwrap());
        stream
    }

    /// The same without a liveliness token.
    pub async fn open_without_token(session: &Session, fleet: &str, vehicle: &str) -> Self {
        let keys = VehicleKeys::new(fleet, vehicle);
        Self {
            acks: session.declare_subscriber(keys.acks()).await.unwrap(),
            // Poses that a test does not read must not hold back the acks behind them.
            poses: session.declare_subscriber(keys.pose()).with(RingChannel::new(1024)).await.unwrap(),
            token: None,
            session: session.clone(),
            keys,
            nonce: next_nonce(),
            next_number: 0,
            next_ack: 0,
            recoverable: None,
        }
    }

    /// Lets the server fetch again what the transport lost of the last `cached` messages.
    pub async fn make_recoverable(&mut self, cached: usize) {
        let publisher = self.session.declare_publisher(self.keys.observations()).encoding(REQUEST_ENCODING);
        let publisher = publisher.congestion_control(CongestionControl::Block);
        let publisher = publisher.cache(CacheConfig::default().max_samples(cached));
        let detection = MissDetectionConfig::default().heartbeat(Duration::from_millis(50));
        self.recoverable = Some(publisher.sample_miss_detection(detection).await.unwrap());
    }

    /// Opens a stream and a session, as the vehicle that the start names.
    pub async fn started(session: &Session, start: v1::SessionStart) -> (Self, v1::SessionAccepted) {
        let mut stream = Self::open(session, &start.fleet_id, &start.vehicle_id).await;
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

    /// Sends a message under the next number.
    pub async fn send(&mut self, message: Request) {
        self.send_bytes(v1::StreamObservationsRequest { message: Some(message) }.encode_to_vec()).await;
    }

    /// Sends a frame.
    pub async fn send_frame(&mut self, frame: v1::Frame) {
        self.send(Request::Frame(frame)).await;
    }

    /// Sends bytes, whatever they are, under the next number.
    pub async fn send_bytes(&mut self, bytes: Vec<u8>) {
        let attachment = Attachment { nonce: self.nonce, number: self.next_number };
        self.next_number += 1;
        match &self.recoverable {
            Some(publisher) => publisher.put(bytes).attachment(attachment.to_string()).await.unwrap(),
            None => self.put(bytes, Some(&attachment.to_string())).await,
        }
    }

    /// Puts bytes with any attachment.
    pub async fn put(&self, bytes: Vec<u8>, attachment: Option<&str>) {
        let put = self.session.put(self.keys.observations(), bytes).encoding(REQUEST_ENCODING);
        let put = put.congestion_control(CongestionControl::Block);
        match attachment {
            Some(attachment) => put.attachment(attachment).await.unwrap(),
            None => put.await.unwrap(),
        }
    }

    /// The next answer on the vehicle's acks, with its attachment.
    pub async fn any_answer(&self) -> (Attachment, Response) {
        answer_of(&timeout(PATIENCE, self.acks.recv_async()).await.expect("no answer").unwrap())
    }

    /// The next answer of this stream; answers to other streams are passed over, and none may be missing.
    pub async fn answer(&mut self) -> Response {
        loop {
            let (attachment, answer) = self.any_answer().await;
            if attachment.nonce == self.nonce {
                // What closes a stream that the server does not know follows no other answer.
                let unknown = attachment.number == 0 && matches!(answer, Response::Closed(_));
                if unknown {
                    return answer;
                }
                assert_eq!(attachment.number, self.next_ack, "an answer is missing");
                self.next_ack += 1;
                return answer;
            }
        }
    }

    /// The next pose or local map.
    pub async fn pose(&self) -> (Attachment, Response) {
        answer_of(&timeout(PATIENCE, self.poses.recv_async()).await.expect("no pose").unwrap())
    }

    /// Waits until a frame is acked.
    pub async fn acked(&mut self, sequence: u64) {
        loop {
            match self.answer().await {
                Response::Ack(ack) if ack.acked_sequence_inclusive >= sequence => return,
                Response::Closed(closed) => panic!("closed before frame {sequence} was acked: {closed:?}"),
                _ => {}
            }
        }
    }

    /// The next refusal.
    pub async fn refusal(&mut self) -> v1::Refusal {
        loop {
            if let Response::Refusal(refusal) = self.answer().await {
                return refusal;
            }
        }
    }

    /// How the stream ends; what it still answers is passed over.
    pub async fn closed(&mut self) -> v1::StreamClosed {
        loop {
            if let Response::Closed(closed) = self.answer().await {
                return closed;
            }
        }
    }

    /// Streams frames with a window of `in_flight` unacked ones.
    pub async fn stream(&mut self, frames: &[lanemap_core::Frame], in_flight: usize) {
        for window in frames.chunks(in_flight) {
            for frame in window {
                self.send_frame(lanemap_proto::encode::frame(frame)).await;
            }
            self.acked(window.last().unwrap().sequence().0).await;
        }
    }

    /// Streams frames to the last ack, as a vehicle does whose link may break: what is not acked is sent again on a new
    /// stream. Zenoh's links over TLS break by themselves now and then, see `lanemap_server`'s `link_security`.
    pub async fn streamed_whatever_breaks(
        session: &Session,
        start: &v1::SessionStart,
        frames: &[lanemap_core::Frame],
        in_flight: usize,
    ) -> Self {
        let streamed = async {
            loop {
                let mut stream = Self::open(session, &start.fleet_id, &start.vehicle_id).await;
                if stream.streams_on(start, frames, in_flight).await.is_some() {
                    return stream;
                }
            }
        };
        timeout(2 * PATIENCE, streamed).await.expect("every stream breaks")
    }

    /// Starts the session and streams the frames that it has not had; `None` where the stream breaks.
    async fn streams_on(
        &mut self,
        start: &v1::SessionStart,
        frames: &[lanemap_core::Frame],
        in_flight: usize,
    ) -> Option<()> {
        self.send(Request::Start(start.clone())).await;
        let Response::Accepted(accepted) = self.answer_unless_broken().await? else { return None };
        let had = accepted.resume_after_sequence.unwrap_or(0);
        let first = frames.partition_point(|frame| frame.sequence().0 <= had);
        for window in frames[first..].chunks(in_flight) {
            for frame in window {
                self.send_frame(lanemap_proto::encode::frame(frame)).await;
            }
            let last = window.last()?.sequence().0;
            loop {
                match self.answer_unless_broken().await? {
                    Response::Ack(ack) if ack.acked_sequence_inclusive >= last => break,
                    Response::Closed(_) => return None,
                    _ => {}
                }
            }
        }
        Some(())
    }

    /// The next answer of this stream; `None` where none comes or one is missing.
    async fn answer_unless_broken(&mut self) -> Option<Response> {
        loop {
            let (attachment, answer) = answer_of(&timeout(BREAK, self.acks.recv_async()).await.ok()?.ok()?);
            if attachment.nonce == self.nonce {
                let in_turn = attachment.number == self.next_ack;
                self.next_ack += 1;
                return in_turn.then_some(answer);
            }
        }
    }

    /// Ends the drive and waits until the server has said so.
    pub async fn end_drive(&mut self) -> v1::SessionEnded {
        self.send(Request::End(v1::SessionEnd {})).await;
        loop {
            match self.answer().await {
                Response::Ended(ended) => {
                    assert_eq!(self.closed().await.code, 0);
                    return ended;
                }
                Response::Closed(closed) => panic!("closed before the drive ended: {closed:?}"),
                _ => {}
            }
        }
    }

    /// Gives up the liveliness token, as a vehicle does that leaves.
    pub async fn drop_token(&mut self) {
        self.token.take().unwrap().undeclare().await.unwrap();
    }
}

/// Waits until a server is there (`true`) or gone.
pub async fn server_is_there(session: &Session, there: bool) {
    let changes = session.liveliness().declare_subscriber(SERVER).await.unwrap();
    let seen = async {
        let mut now = session.liveliness().get(SERVER).await.unwrap().recv_async().await.is_ok();
        while now != there {
            now = changes.recv_async().await.unwrap().kind() == SampleKind::Put;
        }
    };
    timeout(PATIENCE, seen).await.expect("the server's token does not change");
}

fn answer_of(sample: &Sample) -> (Attachment, Response) {
    let attachment = Attachment::parse(&sample.attachment().expect("no attachment").to_bytes()).unwrap();
    let answer = v1::StreamObservationsResponse::decode(&*sample.payload().to_bytes()).unwrap();
    (attachment, answer.message.expect("an empty answer"))
}

fn next_nonce() -> StreamNonce {
    static NEXT: AtomicU64 = AtomicU64::new(0x1a2e_0000_0000_0001);
    StreamNonce(NEXT.fetch_add(1, Ordering::Relaxed))
}
