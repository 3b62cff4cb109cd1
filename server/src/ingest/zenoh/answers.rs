//! Carries a stream's answers back: what must be heard on one key, poses on another.

use std::time::Duration;

use futures::{FutureExt, StreamExt};
use lanemap_proto::{
    v1::{self, stream_observations_response::Message},
    zenoh_keys::{Attachment, RESPONSE_ENCODING, StreamNonce, VehicleKeys},
};
use prost::Message as _;
use tonic_types::StatusExt;
use zenoh::{
    Session, Wait,
    pubsub::Publisher,
    qos::{CongestionControl, Priority, Reliability},
};
use zenoh_ext::{AdvancedPublisher, AdvancedPublisherBuilderExt, CacheConfig, MissDetectionConfig};

use crate::ingest::{OutboxStream, conversation::Ending};

/// Answers that a vehicle may fetch once more where the transport lost them.
const CACHED_ANSWERS: usize = 64;
/// How often a vehicle may check that it has heard the last answer.
const HEARTBEAT: Duration = Duration::from_secs(2);
/// Answers published together at most.
const BATCH: usize = 64;

/// A stream's publishers.
pub(super) struct Answers {
    acks: AdvancedPublisher<'static>,
    poses: Publisher<'static>,
    nonce: StreamNonce,
    next_ack: u64,
    next_pose: u64,
}

impl Answers {
    /// Declares the publishers of a stream. May wait for the network.
    fn declare(session: &Session, keys: &VehicleKeys, nonce: StreamNonce) -> zenoh::Result<Self> {
        let acks = session
            .declare_publisher(keys.acks())
            .encoding(RESPONSE_ENCODING)
            .reliability(Reliability::Reliable)
            .congestion_control(CongestionControl::Block)
            .cache(CacheConfig::default().max_samples(CACHED_ANSWERS))
            .sample_miss_detection(MissDetectionConfig::default().heartbeat(HEARTBEAT))
            .wait()?;
        let poses = session
            .declare_publisher(keys.pose())
            .encoding(RESPONSE_ENCODING)
            .reliability(Reliability::Reliable)
            .congestion_control(CongestionControl::Drop)
            .priority(Priority::DataLow)
            .wait()?;
        Ok(Self { acks, poses, nonce, next_ack: 0, next_pose: 0 })
    }

    /// Publishes answers in their order. Waits for a vehicle that is slow to read.
    fn put(&mut self, answers: Vec<Message>) -> zenoh::Result<()> {
        for answer in answers {
            let is_pose = matches!(answer, Message::Pose(_) | Message::LocalMap(_));
            let bytes = v1::StreamObservationsResponse { message: Some(answer) }.encode_to_vec();
            if is_pose {
                let attachment = Attachment { nonce: self.nonce, number: self.next_pose };
                self.next_pose += 1;
                self.poses.put(bytes).attachment(attachment.to_string()).wait()?;
            } else {
                let attachment = Attachment { nonce: self.nonce, number: self.next_ack };
                self.next_ack += 1;
                self.acks.put(bytes).attachment(attachment.to_string()).wait()?;
            }
        }
        Ok(())
    }
}

/// Publishes a stream's answers to its end, and how it ended.
pub(super) async fn publish(session: Session, keys: VehicleKeys, nonce: StreamNonce, mut answers: OutboxStream) {
    let declared = beside_the_runtime(move || Answers::declare(&session, &keys, nonce)).await;
    let Some(mut publishers) = declared else { return };
    let mut ended = false;
    while !ended {
        let mut batch = Vec::new();
        let mut next = answers.next().await;
        loop {
            match next {
                Some(Ok(answer)) => batch.extend(answer.message),
                Some(Err(status)) => {
                    batch.push(closed(&Err(status)));
                    ended = true;
                }
                None => {
                    batch.push(closed(&Ok(())));
                    ended = true;
                }
            }
            if ended || batch.len() == BATCH {
                break;
            }
            match answers.next().now_or_never() {
                Some(ready) => next = ready,
                None => break,
            }
        }
        let put = beside_the_runtime(move || publishers.put(batch).map(|()| publishers)).await;
        match put {
            Some(back) => publishers = back,
            None => return,
        }
    }
}

/// The last message of a stream.
pub(super) fn closed(ending: &Ending) -> Message {
    Message::Closed(match ending {
        Ok(()) => v1::StreamClosed::default(),
        Err(status) => {
            let delay = status.get_details_retry_info().and_then(|info| info.retry_delay);
            v1::StreamClosed {
                code: status.code().into(),
                message: status.message().to_owned(),
                retry_after_ms: delay.map(|delay| u64::try_from(delay.as_millis()).unwrap_or(u64::MAX)),
            }
        }
    })
}

/// Runs what may wait for the network; `None` where it failed, which ends the stream.
async fn beside_the_runtime<T: Send + 'static>(work: impl FnOnce() -> zenoh::Result<T> + Send + 'static) -> Option<T> {
    match tokio::task::spawn_blocking(work).await {
        Ok(Ok(done)) => Some(done),
        Ok(Err(error)) => {
            tracing::warn!(%error, "a stream's answers cannot be published");
            None
        }
        Err(error) => {
            tracing::error!(%error, "a stream's answers cannot be published");
            None
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::error::Error;

    #[test]
    fn a_stream_closes_with_the_code_that_grpc_would_give() {
        let Message::Closed(superseded) = closed(&Err(Error::Superseded.into())) else { unreachable!() };
        assert_eq!((superseded.code, superseded.retry_after_ms), (10, None));
        assert_eq!(closed(&Ok(())), Message::Closed(v1::StreamClosed::default()));
    }

    #[test]
    fn a_wait_that_the_server_asks_for_is_passed_on() {
        let details = tonic_types::ErrorDetails::with_retry_info(Some(Duration::from_millis(1500)));
        let status = tonic::Status::with_error_details(tonic::Code::ResourceExhausted, "busy", details);
        let Message::Closed(busy) = closed(&Err(status)) else { unreachable!() };
        assert_eq!((busy.code, busy.retry_after_ms), (8, Some(1500)));
    }
}
