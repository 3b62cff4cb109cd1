//! One drive on its way: which frame is due, which are unacked. Knows no network.
//!
//! [`Outgoing`] is the request stream: it gives the start, then, once the server has accepted the drive and the vehicle
//! has said go, the frames as they come due and the window allows, then the end. [`Flow`] takes the answers.

use std::{
    collections::VecDeque,
    pin::Pin,
    sync::{Arc, Mutex, MutexGuard, PoisonError},
    task::{Context, Poll},
};

use bytes::Bytes;
use futures::{Stream, task::AtomicWaker};
use lanemap_core::Sequence;
use tokio::{
    sync::Notify,
    time::{Instant, Sleep, sleep_until},
};

use super::{answer::Answer, rate::FrameRate, tally::Tally, tape::Tape};

/// When the frames of a vehicle are due.
#[derive(Clone, Copy, Debug)]
pub struct Pace {
    /// How often.
    pub rate: FrameRate,
    /// When the next frame is due.
    pub next_due: Instant,
    /// When the vehicle stops sending.
    pub stop_at: Instant,
}

/// Which frames of which drive.
#[derive(Clone, Debug)]
pub struct Leg {
    pub tape: Arc<Tape>,
    /// Place of the first frame.
    pub from: usize,
    /// Start and end of a drive, where the service knows drives.
    pub framing: Option<Framing>,
}

/// The messages around the frames of a drive.
#[derive(Clone, Debug)]
pub struct Framing {
    pub start: Bytes,
    pub end: Bytes,
}

/// How the sending of a drive ended.
#[derive(Clone, Copy, Debug)]
pub enum Sent {
    /// Every frame was sent; the pace goes on with the next drive.
    WholeDrive(Pace),
    /// The time is up.
    TimeIsUp,
}

/// The answering side of a drive.
#[derive(Clone, Debug)]
pub struct Flow {
    shared: Arc<Shared>,
}

/// The sending side of a drive.
pub struct Outgoing {
    shared: Arc<Shared>,
    leg: Leg,
    timer: Pin<Box<Sleep>>,
}

#[derive(Debug)]
struct Shared {
    tally: Tally,
    /// Most frames unacked.
    window: usize,
    state: Mutex<State>,
    sender: AtomicWaker,
    changed: Notify,
}

#[derive(Debug)]
struct State {
    phase: Phase,
    accepted: bool,
    /// When the stream could first take frames: a frame that was due before counts from here.
    opened: Instant,
    pace: Option<Pace>,
    unacked: VecDeque<(Sequence, Instant)>,
    sent: Option<Sent>,
    max_in_flight: usize,
    closed: bool,
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum Phase {
    Start,
    Frames { next: usize },
    Over,
}

/// Both sides of a drive.
pub fn flow(leg: Leg, window: usize, tally: &Tally) -> (Flow, Outgoing) {
    let framed = leg.framing.is_some();
    let state = State {
        phase: if framed { Phase::Start } else { Phase::Frames { next: leg.from } },
        accepted: !framed,
        opened: Instant::now(),
        pace: None,
        unacked: VecDeque::new(),
        sent: None,
        max_in_flight: window,
        closed: false,
    };
    let shared = Arc::new(Shared {
        tally: tally.clone(),
        window,
        state: Mutex::new(state),
        sender: AtomicWaker::new(),
        changed: Notify::new(),
    });
    let outgoing = Outgoing { shared: Arc::clone(&shared), leg, timer: Box::pin(sleep_until(Instant::now())) };
    (Flow { shared }, outgoing)
}

impl Flow {
    /// Takes an answer of the server.
    pub fn take(&self, answer: Answer) {
        match answer {
            Answer::Accepted { max_frames_in_flight } => {
                let mut state = self.shared.lock();
                state.accepted = true;
                state.max_in_flight = max_frames_in_flight.min(self.shared.window);
                state.opened = Instant::now();
            }
            Answer::Acked(sequence) => self.acked_up_to(sequence),
            Answer::Refused { sequence, message } => self.refused(sequence, &message),
            Answer::Ended | Answer::Closed { .. } | Answer::Other => return,
        }
        self.shared.sender.wake();
        self.shared.changed.notify_waiters();
    }

    /// The oldest frame came back: an echo acks it.
    pub fn take_echo(&self) {
        let oldest = self.shared.lock().unacked.front().map(|(sequence, _)| *sequence);
        if let Some(sequence) = oldest {
            self.take(Answer::Acked(sequence));
        }
    }

    fn acked_up_to(&self, sequence: Sequence) {
        let now = Instant::now();
        let mut state = self.shared.lock();
        let mut counts = self.shared.tally.counts();
        counts.last_ack = Some(now);
        while let Some((_, since)) = state.unacked.pop_front_if(|(unacked, _)| *unacked <= sequence) {
            counts.acked_after(now.saturating_duration_since(since));
        }
    }

    fn refused(&self, sequence: Option<Sequence>, message: &str) {
        let mut state = self.shared.lock();
        let mut counts = self.shared.tally.counts();
        if let Some(sequence) = sequence {
            counts.refused += 1;
            match state.unacked.iter().position(|(unacked, _)| *unacked == sequence) {
                Some(place) => drop(state.unacked.remove(place)),
                // An ack of later frames came first, and covered it by mistake.
                None => counts.acked = counts.acked.saturating_sub(1),
            }
        }
        counts.complain(|| format!("refused: {message}"));
    }

    /// The stream is over: nothing more is sent, and what is unacked stays so.
    pub fn close(&self) {
        let mut state = self.shared.lock();
        state.closed = true;
        state.phase = Phase::Over;
        drop(state);
        self.shared.sender.wake();
        self.shared.changed.notify_waiters();
    }

    /// Lets the frames go.
    pub fn go(&self, pace: Pace) {
        self.shared.lock().pace = Some(pace);
        self.shared.sender.wake();
    }

    /// Waits until the server has accepted the drive; `false` where the stream ended before.
    pub async fn accepted(&self) -> bool {
        self.when(|state| (state.accepted || state.closed).then_some(state.accepted)).await
    }

    /// Waits until everything is sent; `None` where the stream ended before.
    pub async fn sent(&self) -> Option<Sent> {
        self.when(|state| (state.sent.is_some() || state.closed).then_some(state.sent)).await
    }

    /// Waits until nothing is unacked, or the stream is over.
    pub async fn settled(&self) {
        self.when(|state| (state.unacked.is_empty() || state.closed).then_some(())).await;
    }

    /// Waits until the stream is over.
    pub async fn closed(&self) {
        self.when(|state| state.closed.then_some(())).await;
    }

    async fn when<T>(&self, reached: impl Fn(&State) -> Option<T>) -> T {
        loop {
            let changed = self.shared.changed.notified();
            if let Some(value) = reached(&self.shared.lock()) {
                return value;
            }
            changed.await;
        }
    }
}

impl Shared {
    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// What the sending side does next.
enum Step {
    Send(Bytes),
    WaitForAnswer,
    WaitUntil(Instant),
    Finish,
}

impl State {
    fn step(&mut self, leg: &Leg, tally: &Tally) -> Step {
        let next = match (self.phase, &leg.framing) {
            (Phase::Start, Some(framing)) => {
                self.phase = Phase::Frames { next: leg.from };
                return Step::Send(framing.start.clone());
            }
            (Phase::Start, None) | (Phase::Over, _) => return Step::Finish,
            (Phase::Frames { next }, _) => next,
        };
        let Some(pace) = self.pace.as_mut().filter(|_| self.accepted) else { return Step::WaitForAnswer };
        let now = Instant::now();
        if now >= pace.stop_at || pace.next_due >= pace.stop_at {
            self.phase = Phase::Over;
            self.sent = Some(Sent::TimeIsUp);
            return Step::Finish;
        }
        let Some((sequence, bytes)) = leg.tape.frame(next) else {
            self.phase = Phase::Over;
            self.sent = Some(Sent::WholeDrive(*pace));
            return leg.framing.as_ref().map_or(Step::Finish, |framing| Step::Send(framing.end.clone()));
        };
        if let FrameRate::Every(_) = pace.rate
            && pace.next_due > now
        {
            return Step::WaitUntil(pace.next_due);
        }
        if self.unacked.len() >= self.max_in_flight {
            return Step::WaitForAnswer;
        }
        let since = match pace.rate {
            FrameRate::Max => now,
            FrameRate::Every(period) => {
                let due = pace.next_due;
                pace.next_due += period;
                due.max(self.opened)
            }
        };
        self.unacked.push_back((sequence, since));
        self.phase = Phase::Frames { next: next + 1 };
        tally.counts().sent += 1;
        Step::Send(bytes)
    }
}

impl Stream for Outgoing {
    type Item = Bytes;

    fn poll_next(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Bytes>> {
        loop {
            self.shared.sender.register(context.waker());
            let step = {
                let mut state = self.shared.lock();
                let step = state.step(&self.leg, &self.shared.tally);
                if state.sent.is_some() {
                    self.shared.changed.notify_waiters();
                }
                step
            };
            match step {
                Step::Send(bytes) => return Poll::Ready(Some(bytes)),
                Step::WaitForAnswer => return Poll::Pending,
                Step::Finish => return Poll::Ready(None),
                Step::WaitUntil(due) => {
                    self.timer.as_mut().reset(due);
                    if self.timer.as_mut().poll(context).is_pending() {
                        return Poll::Pending;
                    }
                }
            }
        }
    }
}
