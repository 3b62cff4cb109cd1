//! What a stream has yet to send to its vehicle, bounded in every part.
//!
//! Refusals and gaps are kept, and none is overtaken by a later ack: what an ack covers but for those is durable, so that a
//! vehicle must know of them first. Acks with none between them are merged: the newest says all. A stream that has too many
//! unread is not read from until the vehicle reads again. Poses and local maps are dropped, oldest first, where the vehicle
//! does not read them.

use std::{
    collections::VecDeque,
    ops::RangeInclusive,
    pin::Pin,
    sync::{Arc, Mutex, MutexGuard, PoisonError},
    task::{Context, Poll},
};

use futures::{Stream, task::AtomicWaker};
use lanemap_core::Sequence;
use lanemap_proto::v1::{self, stream_observations_response::Message};
use tokio::sync::Notify;
use tonic::Status;

use super::Refusal;
use crate::telemetry;

/// Refusals and gaps that may wait to be read, with the acks among them.
const MAX_NOTICES: usize = 64;
/// Poses and local maps that may wait to be read.
const MAX_UPDATES: usize = 128;

/// The writing end.
#[derive(Clone, Debug)]
pub struct Outbox {
    shared: Arc<Shared>,
}

/// The reading end: the response stream of the call. Dropped when the vehicle goes away.
#[derive(Debug)]
pub struct OutboxStream {
    shared: Arc<Shared>,
}

#[derive(Debug, Default)]
struct Shared {
    waiting: Mutex<Waiting>,
    reader: AtomicWaker,
    room: Notify,
}

#[derive(Debug, Default)]
struct Waiting {
    accepted: Option<v1::SessionAccepted>,
    /// Acks, refusals and gaps in their order, no two acks in a row.
    promises: VecDeque<Message>,
    updates: VecDeque<Message>,
    ended: Option<v1::SessionEnded>,
    finish: Option<Result<(), Status>>,
    closed: bool,
}

impl Outbox {
    /// A pair of ends.
    #[must_use]
    pub fn new() -> (Self, OutboxStream) {
        let shared = Arc::new(Shared::default());
        (Self { shared: Arc::clone(&shared) }, OutboxStream { shared })
    }

    /// The session is open.
    pub fn accept(&self, accepted: v1::SessionAccepted) {
        self.put(|waiting| waiting.accepted = Some(accepted));
    }

    /// Every frame up to `sequence` is durable.
    pub fn ack(&self, sequence: Sequence) {
        self.put(|waiting| {
            waiting.promises.pop_back_if(|last| matches!(last, Message::Ack(_)));
            waiting.promises.push_back(Message::Ack(v1::Ack { acked_sequence_inclusive: sequence.0 }));
        });
    }

    /// A pose or a local map.
    pub fn update(&self, update: Message) {
        self.put(|waiting| {
            if waiting.updates.len() == MAX_UPDATES {
                waiting.updates.pop_front();
                metrics::counter!(telemetry::UPDATES_DROPPED).increment(1);
            }
            waiting.updates.push_back(update);
        });
    }

    /// Something was refused; waits for room. Returns at once where nobody reads any more.
    pub async fn refuse(&self, refusal: &Refusal) {
        metrics::counter!(telemetry::REFUSALS, "reason" => refusal.reason.as_str_name()).increment(1);
        self.notify(Message::Refusal(refusal.to_wire())).await;
    }

    /// Frames did not come, inclusive; waits for room as a refusal does.
    pub async fn gap(&self, missing: &RangeInclusive<u64>) {
        metrics::counter!(telemetry::GAPS).increment(1);
        let (first_missing_sequence, last_missing_sequence) = (*missing.start(), *missing.end());
        self.notify(Message::Gap(v1::Gap { first_missing_sequence, last_missing_sequence })).await;
    }

    async fn notify(&self, notice: Message) {
        loop {
            let room = self.shared.room.notified();
            {
                let mut waiting = self.shared.lock();
                if waiting.closed || waiting.finish.is_some() {
                    return;
                }
                if waiting.promises.len() < MAX_NOTICES {
                    waiting.promises.push_back(notice);
                    break;
                }
            }
            room.await;
        }
        self.shared.reader.wake();
    }

    /// The drive is over.
    pub fn end(&self, ended: v1::SessionEnded) {
        self.put(|waiting| waiting.ended = Some(ended));
    }

    /// Ends the stream once everything before has been read. The first call counts.
    pub fn finish(&self, with: Result<(), Status>) {
        self.put(|waiting| {
            waiting.finish.get_or_insert(with);
        });
        self.shared.room.notify_waiters();
    }

    /// Waits until the stream is told to end, or nobody reads any more.
    pub async fn finished(&self) {
        loop {
            let change = self.shared.room.notified();
            {
                let waiting = self.shared.lock();
                if waiting.closed || waiting.finish.is_some() {
                    return;
                }
            }
            change.await;
        }
    }

    /// Whether nobody reads any more.
    #[must_use]
    pub fn is_closed(&self) -> bool {
        self.shared.lock().closed
    }

    fn put(&self, change: impl FnOnce(&mut Waiting)) {
        change(&mut self.shared.lock());
        self.shared.reader.wake();
    }
}

impl Shared {
    fn lock(&self) -> MutexGuard<'_, Waiting> {
        self.waiting.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Waiting {
    fn next(&mut self) -> Option<Message> {
        if let Some(accepted) = self.accepted.take() {
            return Some(Message::Accepted(accepted));
        }
        let waiting = self.promises.pop_front().or_else(|| self.updates.pop_front());
        waiting.or_else(|| self.ended.take().map(Message::Ended))
    }
}

impl Stream for OutboxStream {
    type Item = Result<v1::StreamObservationsResponse, Status>;

    fn poll_next(self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Self::Item>> {
        self.shared.reader.register(context.waker());
        let mut waiting = self.shared.lock();
        if let Some(message) = waiting.next() {
            drop(waiting);
            self.shared.room.notify_waiters();
            return Poll::Ready(Some(Ok(v1::StreamObservationsResponse { message: Some(message) })));
        }
        if waiting.closed {
            return Poll::Ready(None);
        }
        match waiting.finish.take() {
            Some(with) => {
                waiting.closed = true;
                Poll::Ready(with.err().map(Err))
            }
            None => Poll::Pending,
        }
    }
}

impl Drop for OutboxStream {
    fn drop(&mut self) {
        self.shared.lock().closed = true;
        self.shared.room.notify_waiters();
    }
}

#[cfg(test)]
mod tests {
    use futures::{FutureExt, StreamExt};
    use lanemap_proto::v1::RefusalReason;

    use super::*;

    fn refusal() -> Refusal {
        Refusal::new(RefusalReason::Missing, "frame", "nothing", "required")
    }

    #[tokio::test]
    async fn acks_that_nobody_read_are_merged_into_the_newest() {
        let (outbox, stream) = Outbox::new();
        (1..=1000).for_each(|sequence| outbox.ack(Sequence(sequence)));
        outbox.finish(Ok(()));
        let messages: Vec<_> = stream.map(|message| message.unwrap().message.unwrap()).collect().await;
        assert_eq!(messages, [Message::Ack(v1::Ack { acked_sequence_inclusive: 1000 })]);
    }

    #[tokio::test]
    async fn no_ack_overtakes_a_gap_that_was_told_before_it() {
        let (outbox, stream) = Outbox::new();
        let ack = |acked_sequence_inclusive| Message::Ack(v1::Ack { acked_sequence_inclusive });
        let gap = v1::Gap { first_missing_sequence: 3, last_missing_sequence: 4 };
        (1..=2).for_each(|sequence| outbox.ack(Sequence(sequence)));
        outbox.gap(&(3..=4)).await;
        (5..=6).for_each(|sequence| outbox.ack(Sequence(sequence)));
        outbox.finish(Ok(()));
        let messages: Vec<_> = stream.map(|message| message.unwrap().message.unwrap()).collect().await;
        assert_eq!(messages, [ack(2), Message::Gap(gap), ack(6)]);
    }

    #[tokio::test]
    async fn the_oldest_poses_are_dropped_where_nobody_reads() {
        let (outbox, stream) = Outbox::new();
        for sequence in 0..1000 {
            outbox.update(Message::Pose(v1::PoseUpdate { sequence, ..v1::PoseUpdate::default() }));
        }
        outbox.finish(Ok(()));
        let messages: Vec<_> = stream.map(|message| message.unwrap().message.unwrap()).collect().await;
        assert_eq!(messages.len(), MAX_UPDATES);
        assert!(matches!(messages.last(), Some(Message::Pose(pose)) if pose.sequence == 999));
    }

    #[tokio::test]
    async fn refusals_wait_for_their_reader_and_none_is_lost() {
        let (outbox, mut stream) = Outbox::new();
        for _ in 0..MAX_NOTICES {
            outbox.refuse(&refusal()).now_or_never().unwrap();
        }
        let bad = refusal();
        let mut waiting = Box::pin(outbox.refuse(&bad));
        assert!(waiting.as_mut().now_or_never().is_none());
        stream.next().await.unwrap().unwrap();
        waiting.await;
        outbox.finish(Ok(()));
        assert_eq!(stream.count().await, MAX_NOTICES);
    }

    #[tokio::test]
    async fn a_writer_does_not_wait_for_a_reader_that_went_away() {
        let (outbox, stream) = Outbox::new();
        drop(stream);
        for _ in 0..2 * MAX_NOTICES {
            outbox.refuse(&refusal()).now_or_never().unwrap();
        }
        assert!(outbox.is_closed());
    }
}
