//! A stream's messages between zenoh's callback and the conversation: bounded in number and in bytes, read without a
//! gap, decoded where they are taken and not in the callback.

use std::{
    pin::Pin,
    sync::{
        Arc, OnceLock,
        atomic::{AtomicUsize, Ordering},
    },
    task::{Context, Poll, ready},
};

use futures::Stream;
use lanemap_proto::v1::{self, RefusalReason};
use prost::Message;
use tokio::sync::mpsc;
use tonic::{Code, Status};
use zenoh::bytes::ZBytes;

use crate::{error::Error, ingest::Refusal};

/// What may wait.
#[derive(Clone, Copy, Debug)]
pub(super) struct Bounds {
    /// Messages.
    pub(super) messages: usize,
    /// Bytes of one message.
    pub(super) message_bytes: usize,
    /// Bytes of all messages that wait.
    pub(super) waiting_bytes: usize,
}

/// The callback's end.
#[derive(Debug)]
pub(super) struct InboundSender {
    messages: mpsc::Sender<ZBytes>,
    shared: Arc<Shared>,
    bounds: Bounds,
}

/// The conversation's end.
#[derive(Debug)]
pub(super) struct Inbound {
    messages: mpsc::Receiver<ZBytes>,
    shared: Arc<Shared>,
    over: bool,
}

#[derive(Debug, Default)]
struct Shared {
    waiting_bytes: AtomicUsize,
    /// Why there are no more messages, where that is an error.
    broken: OnceLock<Status>,
}

/// The two ends of a stream.
pub(super) fn channel(bounds: Bounds) -> (InboundSender, Inbound) {
    let (sender, messages) = mpsc::channel(bounds.messages);
    let shared = Arc::<Shared>::default();
    let inbound = Inbound { messages, shared: Arc::clone(&shared), over: false };
    (InboundSender { messages: sender, shared, bounds }, inbound)
}

impl InboundSender {
    /// Puts a message into the queue; never waits.
    ///
    /// # Errors
    /// Why it was not taken. The stream cannot go on: what follows would leave a gap.
    pub(super) fn send(&self, message: ZBytes) -> Result<(), Status> {
        let bytes = message.len();
        if bytes > self.bounds.message_bytes {
            let limit = self.bounds.message_bytes;
            return Err(Status::new(Code::OutOfRange, format!("a message of {bytes} bytes, limit: {limit}")));
        }
        let waiting = self.shared.waiting_bytes.load(Ordering::Relaxed) + bytes;
        if waiting > self.bounds.waiting_bytes {
            let limit = self.bounds.waiting_bytes;
            return Err(overflow(&format!("{waiting} bytes wait to be taken, limit: {limit}")));
        }
        self.shared.waiting_bytes.fetch_add(bytes, Ordering::Relaxed);
        self.messages.try_send(message).map_err(|_| {
            overflow(&format!("{limit} messages wait to be taken, limit: {limit}", limit = self.bounds.messages))
        })
    }

    /// Ends the stream with an error, once what was sent before is taken.
    pub(super) fn break_off(self, with: Status) {
        // Only the first reason counts, and nobody else has this end.
        let _ = self.shared.broken.set(with);
    }
}

fn overflow(what: &str) -> Status {
    Status::new(Code::ResourceExhausted, format!("{what}; send no more frames than may be in flight"))
}

impl Stream for Inbound {
    type Item = Result<v1::StreamObservationsRequest, Status>;

    fn poll_next(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Self::Item>> {
        if self.over {
            return Poll::Ready(None);
        }
        let Some(message) = ready!(self.messages.poll_recv(context)) else {
            self.over = true;
            return Poll::Ready(self.shared.broken.get().cloned().map(Err));
        };
        self.shared.waiting_bytes.fetch_sub(message.len(), Ordering::Relaxed);
        let decoded = decode(&message);
        self.over = decoded.is_err();
        Poll::Ready(Some(decoded))
    }
}

fn decode(message: &ZBytes) -> Result<v1::StreamObservationsRequest, Status> {
    v1::StreamObservationsRequest::decode(&*message.to_bytes()).map_err(|error| {
        let value = format!("{} bytes: {error}", message.len());
        let refusal = Refusal::new(RefusalReason::OutOfRange, "message", value, "a StreamObservationsRequest");
        Error::Refused(Box::new(refusal)).into()
    })
}

#[cfg(test)]
mod tests {
    use futures::{FutureExt, StreamExt};

    use super::*;

    const BOUNDS: Bounds = Bounds { messages: 3, message_bytes: 100, waiting_bytes: 150 };

    fn end() -> ZBytes {
        let message = v1::stream_observations_request::Message::End(v1::SessionEnd {});
        v1::StreamObservationsRequest { message: Some(message) }.encode_to_vec().into()
    }

    #[test]
    fn what_does_not_fit_is_said_and_what_was_taken_before_is_kept() {
        let (sender, mut inbound) = channel(BOUNDS);
        for _ in 0..3 {
            sender.send(end()).unwrap();
        }
        let full = sender.send(end()).unwrap_err();
        assert_eq!(full.code(), Code::ResourceExhausted);
        sender.break_off(full);
        for _ in 0..3 {
            assert!(inbound.next().now_or_never().unwrap().unwrap().is_ok());
        }
        assert_eq!(inbound.next().now_or_never().unwrap().unwrap().unwrap_err().code(), Code::ResourceExhausted);
        assert!(inbound.next().now_or_never().unwrap().is_none());
    }

    #[test]
    fn bytes_are_bounded_one_by_one_and_together() {
        let (sender, mut inbound) = channel(BOUNDS);
        assert_eq!(sender.send(vec![0; 101].into()).unwrap_err().code(), Code::OutOfRange);
        sender.send(vec![0; 80].into()).unwrap();
        assert_eq!(sender.send(vec![0; 80].into()).unwrap_err().code(), Code::ResourceExhausted);
        assert!(inbound.next().now_or_never().unwrap().unwrap().is_err(), "eighty zeros are no message");
        sender.send(vec![0; 80].into()).unwrap();
    }

    #[test]
    fn a_vehicle_that_goes_ends_its_stream_without_an_error() {
        let (sender, mut inbound) = channel(BOUNDS);
        sender.send(end()).unwrap();
        drop(sender);
        assert!(inbound.next().now_or_never().unwrap().unwrap().is_ok());
        assert!(inbound.next().now_or_never().unwrap().is_none());
    }
}
