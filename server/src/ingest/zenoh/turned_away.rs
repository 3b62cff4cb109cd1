//! Tells peers why a message of theirs belongs to no stream. Bounded: who floods the server is not answered each time.

use std::collections::HashSet;

use lanemap_proto::{
    v1,
    zenoh_keys::{Attachment, RESPONSE_ENCODING, StreamNonce},
};
use prost::Message;
use tokio::sync::mpsc;
use tonic::Status;
use zenoh::{Session, Wait, qos::CongestionControl};

use super::answers::closed;
use crate::telemetry;

/// Answers that may wait; more are not given.
const MAX_WAITING: usize = 256;

/// A message that belongs to no stream.
#[derive(Debug)]
pub(super) struct TurnedAway {
    /// Where to answer.
    pub(super) acks: String,
    /// Its stream; 0 where that cannot be read.
    pub(super) nonce: StreamNonce,
    /// Why.
    pub(super) why: Status,
}

/// Where callbacks leave what they turn away.
#[derive(Clone, Debug)]
pub(super) struct Usher {
    waiting: mpsc::Sender<TurnedAway>,
}

impl Usher {
    /// Starts the task that answers; it ends with the last clone.
    pub(super) fn start(session: Session) -> Self {
        let (waiting, turned_away) = mpsc::channel(MAX_WAITING);
        tokio::spawn(answer(session, turned_away));
        Self { waiting }
    }

    /// Has a message answered; never waits.
    pub(super) fn turn_away(&self, message: TurnedAway) {
        metrics::counter!(telemetry::ZENOH_TURNED_AWAY).increment(1);
        // Where too many wait, this one is not answered: its sender hears of it at its next attempt.
        let _ = self.waiting.try_send(message);
    }
}

async fn answer(session: Session, mut turned_away: mpsc::Receiver<TurnedAway>) {
    let mut messages = Vec::with_capacity(MAX_WAITING);
    while turned_away.recv_many(&mut messages, MAX_WAITING).await > 0 {
        let (session, batch) = (session.clone(), std::mem::take(&mut messages));
        let answered = tokio::task::spawn_blocking(move || answer_each_stream_once(&session, batch)).await;
        if let Err(error) = answered {
            tracing::error!(%error, "messages that were turned away were not answered");
        }
    }
}

fn answer_each_stream_once(session: &Session, batch: Vec<TurnedAway>) {
    let mut answered = HashSet::new();
    for TurnedAway { acks, nonce, why } in batch {
        if !answered.insert((acks.clone(), nonce)) {
            continue;
        }
        let response = v1::StreamObservationsResponse { message: Some(closed(&Err(why))) };
        let put = session.put(acks, response.encode_to_vec()).encoding(RESPONSE_ENCODING);
        let put = put.attachment(Attachment { nonce, number: 0 }.to_string());
        if let Err(error) = put.congestion_control(CongestionControl::Drop).wait() {
            tracing::debug!(%error, "a message that was turned away was not answered");
        }
    }
}
