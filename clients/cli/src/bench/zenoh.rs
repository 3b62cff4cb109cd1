//! The zenoh side of the load: few sessions, many vehicles on each, as if a gateway spoke for them.
//!
//! A vehicle does what [`lanemap_proto::zenoh_keys`] asks of it. Putting may wait for the network, and zenoh's callbacks
//! must not: each session has a thread that puts what its vehicles send.

use std::{
    hash::{BuildHasher, RandomState},
    sync::Arc,
    thread,
};

use bytes::Bytes;
use futures::StreamExt;
use lanemap_proto::zenoh_keys::{Attachment, REQUEST_ENCODING, StreamNonce, VehicleKeys};
use tokio::{sync::mpsc, task::JoinHandle, time::Duration};
use zenoh::{
    Config, Session, Wait,
    qos::{CongestionControl, Reliability},
    sample::Sample,
};
use zenoh_ext::{
    AdvancedPublisher, AdvancedPublisherBuilderExt, AdvancedSubscriberBuilderExt, CacheConfig, MissDetectionConfig,
    RecoveryConfig,
};

use super::{
    answer::Answer,
    flow::{Flow, Outgoing},
    tally::Tally,
};

/// Vehicles on one session, before another is opened.
const VEHICLES_PER_SESSION: u32 = 250;
/// Messages that may wait for a session's thread.
const WAITING_PUTS: usize = 256;
/// Messages that the server may fetch once more where the transport lost them.
const CACHED: usize = 256;
/// How soon the server can tell that the last message was lost.
const HEARTBEAT: Duration = Duration::from_millis(500);

/// Sessions with a router.
#[derive(Debug)]
pub struct Sessions {
    sessions: Vec<(Session, mpsc::Sender<Put>)>,
}

/// A message on its way to a session's thread.
#[derive(Debug)]
struct Put {
    publisher: Arc<AdvancedPublisher<'static>>,
    bytes: Bytes,
    attachment: Attachment,
}

impl Sessions {
    /// Opens as many sessions as so many vehicles ask for, at an endpoint such as `tcp/127.0.0.1:7447`.
    pub async fn open(endpoint: &str, vehicles: u32, tally: &Tally) -> anyhow::Result<Self> {
        let mut sessions = Vec::new();
        for _ in 0..vehicles.div_ceil(VEHICLES_PER_SESSION) {
            let session = zenoh::open(config(endpoint)?).await.map_err(failed)?;
            let (puts, waiting) = mpsc::channel(WAITING_PUTS);
            let tally = tally.clone();
            thread::Builder::new().name("zenoh-puts".to_owned()).spawn(move || put_all(waiting, &tally))?;
            sessions.push((session, puts));
        }
        Ok(Self { sessions })
    }

    /// Opens a stream of one vehicle; the task ends with the stream.
    pub async fn stream(
        &self,
        (fleet, vehicle): (&str, u32),
        outgoing: Outgoing,
        flow: Flow,
        tally: Tally,
    ) -> anyhow::Result<JoinHandle<()>> {
        let (session, puts) = &self.sessions[vehicle as usize % self.sessions.len()];
        let keys = VehicleKeys::new(fleet, &super::tape::vehicle_id(vehicle));
        let nonce = StreamNonce(RandomState::new().hash_one(vehicle));
        let token = session.liveliness().declare_token(keys.alive(nonce)).await.map_err(failed)?;
        let taking = (flow.clone(), tally);
        let acks = session
            .declare_subscriber(keys.acks())
            .callback(move |sample| take(&sample, nonce, &taking.0, &taking.1))
            .recovery(RecoveryConfig::default().heartbeat())
            .await
            .map_err(failed)?;
        // Poses are received, as a vehicle would, and not read.
        let poses = session.declare_subscriber(keys.pose()).callback(drop).await.map_err(failed)?;
        let publisher = session
            .declare_publisher(keys.observations())
            .encoding(REQUEST_ENCODING)
            .congestion_control(CongestionControl::Block)
            .reliability(Reliability::Reliable)
            .cache(CacheConfig::default().max_samples(CACHED))
            .sample_miss_detection(MissDetectionConfig::default().sporadic_heartbeat(HEARTBEAT))
            .publisher_detection()
            .await
            .map_err(failed)?;
        let publisher = Arc::new(publisher);
        let puts = puts.clone();
        Ok(tokio::spawn(async move {
            let mut numbered = outgoing.zip(futures::stream::iter(0_u64..));
            while let Some((bytes, number)) = numbered.next().await {
                let attachment = Attachment { nonce, number };
                let publisher = Arc::clone(&publisher);
                if puts.send(Put { publisher, bytes, attachment }).await.is_err() {
                    break;
                }
            }
            // Without its token the stream is over: the server sends what it has promised, then closes it.
            let settled = flow.settled();
            settled.await;
            drop(token);
            flow.closed().await;
            drop((acks, poses, publisher));
        }))
    }
}

/// Puts what vehicles send, in its order.
fn put_all(mut waiting: mpsc::Receiver<Put>, tally: &Tally) {
    while let Some(Put { publisher, bytes, attachment }) = waiting.blocking_recv() {
        if let Err(error) = publisher.put(bytes).attachment(attachment.to_string()).wait() {
            tally.counts().complain(|| format!("zenoh took a message back: {error}"));
        }
    }
}

/// Takes an answer; called by zenoh.
fn take(sample: &Sample, nonce: StreamNonce, flow: &Flow, tally: &Tally) {
    let attachment = sample.attachment().and_then(|bytes| Attachment::parse(&bytes.to_bytes()).ok());
    if attachment.is_none_or(|attachment| attachment.nonce != nonce) {
        return; // It belongs to the vehicle's drive before.
    }
    match Answer::parse(Bytes::copy_from_slice(&sample.payload().to_bytes())) {
        Ok(Answer::Closed { trouble }) => {
            if let Some(message) = trouble {
                let mut counts = tally.counts();
                counts.broken += 1;
                counts.complain(|| format!("a stream broke: {message}"));
            }
            flow.close();
        }
        Ok(answer) => flow.take(answer),
        Err(error) => tally.counts().complain(|| format!("an answer does not decode: {error}")),
    }
}

fn config(endpoint: &str) -> anyhow::Result<Config> {
    let mut config = Config::default();
    for (name, value) in [
        ("mode", "\"client\"".to_owned()),
        ("connect/endpoints", serde_json::json!([endpoint]).to_string()),
        ("scouting/multicast/enabled", "false".to_owned()),
        ("scouting/delay", "0".to_owned()),
    ] {
        config.insert_json5(name, &value).map_err(failed)?;
    }
    Ok(config)
}

#[expect(clippy::needless_pass_by_value, reason = "made for map_err")]
fn failed(error: zenoh::Error) -> anyhow::Error {
    anyhow::anyhow!("zenoh: {error}")
}
