//! How a session's frames come into its map: in turns with all other sessions, and never while an ack could go out.

use std::{pin::pin, time::Duration};

use lanemap_core::Frame;
use lanemap_proto::v1::stream_observations_response::Message;
use tokio::time::Instant;

use super::{
    Actor, Outcome,
    backlog::Origin,
    updates::{local_map_update, pose_update},
};
use crate::{
    journal::JournalError,
    session::{mapping_turns::MappingTurn, registry::blocking},
    telemetry,
};

/// Time of mapping between two chances for other tasks to run.
const LONGEST_RUN: Duration = Duration::from_millis(1);

impl Actor {
    /// Waits for `work`, and maps what was acked where it is this session's turn meanwhile: a turn is not kept waiting.
    pub(super) async fn mapping_meanwhile<T>(&mut self, work: impl Future<Output = T>) -> T {
        let mut work = pin!(work);
        loop {
            tokio::select! {
                biased;
                done = &mut work => return done,
                turn = self.backlog.turn() => match turn {
                    Ok(turn) => self.map_for(turn).await,
                    // Whoever asks for the next turn hears of it.
                    Err(_) => return work.await,
                },
            }
        }
    }

    /// Maps frames that wait for the length of a turn, behind whatever else is ready to run: what reads, journals and acks is.
    pub(super) async fn map_for(&mut self, turn: MappingTurn) {
        tokio::task::yield_now().await;
        let began = Instant::now();
        while began.elapsed() < LONGEST_RUN {
            let Some(waiting) = self.backlog.pop() else { break };
            self.map(&waiting.frame, waiting.from == Origin::Stream);
            if waiting.from == Origin::Crash {
                self.frames_since_snapshot += 1;
            }
        }
        drop(turn);
        self.publish_if_due();
    }

    /// Maps every frame that was acked.
    pub(super) async fn map_all_acked(&mut self) -> Outcome {
        while !self.backlog.is_empty() {
            let turn = self.backlog.turn().await?;
            self.map_for(turn).await;
        }
        Ok(())
    }

    /// Whether the service stops before the map has caught up with the journal: the next one goes on with it.
    pub(super) fn stops_before_it_caught_up(&self) -> bool {
        self.backlog.is_long() && self.surroundings.shutdown.is_cancelled()
    }

    /// Maps frames that were held back when they were acked.
    pub(super) async fn map_held_back(&mut self, frames: &[Frame]) {
        let turns = self.mapping_turns.clone();
        let (mut turn, mut began) = (turns.take().await, Instant::now());
        for frame in frames {
            self.map(frame, true);
            if began.elapsed() >= LONGEST_RUN {
                drop(turn);
                tokio::task::yield_now().await;
                (turn, began) = (turns.take().await, Instant::now());
            }
        }
        drop(turn);
    }

    /// The frames that were held back until now.
    pub(super) async fn ready_frames(&mut self) -> Result<Vec<Frame>, JournalError> {
        let Some(through) = self.drive.ready() else { return Ok(Vec::new()) };
        let (journal, session, covered) = (self.surroundings.journal.clone(), self.record.id, self.drive.covered());
        blocking(move || journal.frames_between(session, covered, through)?.collect()).await
    }

    /// Maps a frame, and tells the vehicle of it where it waits for that.
    fn map(&mut self, frame: &Frame, is_heard: bool) {
        let started = Instant::now();
        let report = self.drive.map(frame);
        metrics::histogram!(telemetry::STEP_SECONDS).record(started.elapsed().as_secs_f64());
        self.unpublished = true;
        let Some(stream) = self.stream.as_ref().filter(|_| is_heard) else { return };
        stream.outbox.update(Message::Pose(pose_update(&report)));
        if stream.wants_local_map {
            stream.outbox.update(Message::LocalMap(local_map_update(&report, &self.drive)));
        }
    }
}
