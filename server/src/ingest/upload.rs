//! Store and forward: a piece of a drive in one call, under the rules of a stream.

use futures::StreamExt;
use lanemap_proto::v1::{self, RefusalReason, stream_observations_response::Message as Answer};
use tonic::Status;

use super::{
    Outbox, OutboxStream, Refusal,
    conversation::{Conversations, OpenSession},
};
use crate::{auth::Peer, error::Error};

/// What became of the frames of a call.
#[derive(Default)]
struct Outcome {
    acked: Option<u64>,
    refusals: Vec<v1::Refusal>,
    gaps: Vec<v1::Gap>,
}

impl Conversations {
    /// Takes a piece of a drive; answers once every frame of it is durable or refused.
    pub(super) async fn upload(
        &self,
        peer: &Peer,
        request: v1::UploadObservationsRequest,
    ) -> Result<v1::UploadObservationsResponse, Status> {
        let v1::UploadObservationsRequest { start, frames, end } = request;
        let start = start.ok_or_else(|| Error::Refused(Box::new(missing_start())))?;
        let _place = self.place()?;
        let (outbox, answers) = Outbox::new();
        let session = self.start(peer, &start, &outbox).await?;
        let accepted = self.accepted(&session);
        let hand_over = async {
            let ending = take_all(&session, &frames, end, &outbox).await.map_err(Status::from);
            self.keep_promises(&outbox, &session, ending.clone()).await;
            outbox.finish(ending);
        };
        let ((), outcome) = tokio::join!(hand_over, collect(answers));
        let Outcome { acked, refusals, gaps } = outcome?;
        Ok(v1::UploadObservationsResponse {
            acked_sequence_inclusive: acked.or(accepted.resume_after_sequence),
            accepted: Some(accepted),
            refusals,
            gaps,
        })
    }
}

async fn take_all(session: &OpenSession, frames: &[v1::Frame], end: bool, outbox: &Outbox) -> Result<(), Error> {
    for frame in frames {
        session.take_frame(frame, outbox).await?;
    }
    if end { session.end().await } else { Ok(()) }
}

async fn collect(mut answers: OutboxStream) -> Result<Outcome, Status> {
    let mut outcome = Outcome::default();
    while let Some(answer) = answers.next().await {
        match answer?.message {
            Some(Answer::Ack(ack)) => outcome.acked = Some(ack.acked_sequence_inclusive),
            Some(Answer::Refusal(refusal)) => outcome.refusals.push(refusal),
            Some(Answer::Gap(gap)) => outcome.gaps.push(gap),
            _ => {}
        }
    }
    Ok(outcome)
}

fn missing_start() -> Refusal {
    Refusal::new(RefusalReason::Missing, "start", "nothing", "required")
}
