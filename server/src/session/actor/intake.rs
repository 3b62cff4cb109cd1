//! How a frame comes into its drive: it passes, waits for those before it, or is refused.

use lanemap_core::Sequence;
use lanemap_proto::v1::RefusalReason;
use tokio::time::Instant;

use super::{
    Actor, Batch, Outcome,
    command::{Arrival, StreamNumber},
};
use crate::{
    ingest::Refusal,
    journal::{JournalFrame, frame_bytes},
    session::{
        drive::Admission,
        reorder::{Offer, Passed},
    },
    telemetry,
};

/// A frame that may have come too early, and the bytes under which it is journaled.
#[derive(Debug)]
pub(super) struct Early {
    pub(super) arrival: Box<Arrival>,
    pub(super) bytes: Vec<u8>,
}

impl Actor {
    /// Takes a frame of the stream that is open: it passes, waits for those before it, or is refused.
    pub(super) async fn take_frame(
        &mut self,
        stream: StreamNumber,
        arrival: Box<Arrival>,
        batch: &mut Batch,
    ) -> Outcome {
        if !self.is_current(stream) {
            return Ok(());
        }
        let sequence = arrival.frame.sequence();
        if self.record.ended {
            let limit = "no frame after the end of the drive";
            let refusal = Refusal::new(RefusalReason::OutOfTurn, "frame", "a frame", limit);
            self.refuse(&refusal.of_frame(sequence)).await;
            return Ok(());
        }
        let bytes = frame_bytes(&arrival.frame)?;
        let early = Early { arrival, bytes };
        if self.reorder.has_passed(sequence) {
            return self.admit(early, batch).await;
        }
        let arrived = early.arrival.arrived;
        match self.reorder.offer(sequence, early, arrived) {
            Offer::Taken => self.pass_due(batch).await,
            Offer::Held { before, again } if before.bytes == again.bytes => {
                metrics::counter!(telemetry::FRAMES_REPEATED).increment(1);
                Ok(())
            }
            Offer::Held { .. } => {
                self.refuse(&given_twice(sequence)).await;
                Ok(())
            }
        }
    }

    /// Admits what need not wait any more.
    pub(super) async fn pass_due(&mut self, batch: &mut Batch) -> Outcome {
        let now = Instant::now();
        while let Some(passed) = self.reorder.pass(now) {
            self.take_passed(passed, batch).await?;
        }
        Ok(())
    }

    /// Admits what is held, since nothing more comes.
    pub(super) async fn pass_all(&mut self, batch: &mut Batch) -> Outcome {
        while let Some(passed) = self.reorder.pass_last() {
            self.take_passed(passed, batch).await?;
        }
        Ok(())
    }

    async fn take_passed(&mut self, passed: Passed<Early>, batch: &mut Batch) -> Outcome {
        match passed {
            Passed::Frame(early) => self.admit(early, batch).await,
            Passed::Gap(missing) => {
                if let Some(outbox) = self.stream.as_ref().map(|stream| stream.outbox.clone()) {
                    self.mapping_meanwhile(outbox.gap(&missing)).await;
                }
                Ok(())
            }
        }
    }

    /// Gives up frames that did not come in time.
    pub(super) async fn give_up_overdue(&mut self) -> Outcome {
        let mut batch = Batch::default();
        self.pass_due(&mut batch).await?;
        self.commit(&mut batch).await?;
        self.publish_if_due();
        Ok(())
    }

    async fn refuse(&mut self, refusal: &Refusal) {
        if let Some(outbox) = self.stream.as_ref().map(|stream| stream.outbox.clone()) {
            self.mapping_meanwhile(outbox.refuse(refusal)).await;
        }
    }

    /// Puts a frame into the batch where it is next in its drive.
    async fn admit(&mut self, Early { arrival, bytes }: Early, batch: &mut Batch) -> Outcome {
        if batch.must_precede(self.drive.would_cut(&arrival.frame)) {
            self.commit(batch).await?;
        }
        match self.drive.admit(&arrival.frame, &bytes) {
            Admission::Cut => batch.cut += 1,
            Admission::New => {
                batch.journal.push(JournalFrame { sequence: arrival.frame.sequence(), bytes });
                batch.frames.push(*arrival);
            }
            Admission::Repeated => {
                metrics::counter!(telemetry::FRAMES_REPEATED).increment(1);
                batch.repeated = true;
            }
            Admission::Refused(refusal) => self.refuse(&refusal).await,
        }
        Ok(())
    }
}

fn given_twice(sequence: Sequence) -> Refusal {
    let value = format!("{} again, with other content", sequence.0);
    let limit = "the frame that waits under this number";
    Refusal::new(RefusalReason::Sequence, "frame.sequence", value, limit).of_frame(sequence)
}
