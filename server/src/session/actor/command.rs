//! What an actor is told, and by which stream.

use lanemap_core::{Frame, Sequence};
use tokio::{sync::oneshot, time::Instant};
use tokio_util::sync::CancellationToken;
use tonic::Status;

use crate::{ingest::Outbox, session::in_flight::FramePlace};

/// Numbers the streams of one session, so that what a superseded stream still sends is told apart.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct StreamNumber(pub(crate) u64);

/// What an actor is told.
#[derive(Debug)]
pub(crate) enum Command {
    /// A stream of the vehicle opens; a stream before it is superseded.
    Attach(Attach),
    /// A validated frame.
    Frame { stream: StreamNumber, arrival: Box<Arrival> },
    /// A frame of this number was refused before it got here.
    Refused { stream: StreamNumber, sequence: Sequence },
    /// The drive is over.
    End { stream: StreamNumber },
    /// The stream closes; what it was promised is sent first, then `with`.
    Detach { stream: StreamNumber, with: Result<(), Status> },
    /// The drive is to be deleted: the actor leaves at once and saves nothing.
    Forget,
}

/// A frame that came, and its place among those in flight.
#[derive(Debug)]
pub(crate) struct Arrival {
    pub(crate) frame: Frame,
    pub(crate) arrived: Instant,
    /// Held until the frame is mapped.
    pub(crate) place: FramePlace,
}

/// A stream that opens.
#[derive(Debug)]
pub(crate) struct Attach {
    pub(crate) stream: StreamNumber,
    pub(crate) outbox: Outbox,
    pub(crate) wants_local_map: bool,
    /// Cancelled when the stream's task is gone, however it went.
    pub(crate) gone: CancellationToken,
    pub(crate) attached: oneshot::Sender<Attached>,
}

/// Where a session is when a stream opens.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Attached {
    pub(crate) last: Option<Sequence>,
    pub(crate) ended: bool,
}
