//! A vehicle of the load: it streams one drive after the other until its time is up.

use std::sync::Arc;

use bytes::Bytes;
use tokio::{
    sync::{oneshot, watch},
    task::JoinSet,
    time::{Duration, Instant, sleep, timeout_at},
};
use tonic::{Code, Status, Streaming};

use super::{
    answer::Answer,
    flow::{Flow, Framing, Leg, Pace, Sent, flow},
    grpc::Connections,
    rate::FrameRate,
    tally::Tally,
    tape::{DriveName, Tape},
    zenoh::Sessions,
};

/// Time that acks get after the last frame; what is not acked by then is lost.
pub const ACK_GRACE: Duration = Duration::from_secs(10);
/// How long a vehicle tries to open a drive that the server has no room for, and the pause between two tries.
const OPEN_TRIES: u32 = 50;
const OPEN_PAUSE: Duration = Duration::from_millis(200);

/// What all vehicles of a run share.
#[derive(Debug)]
pub struct Fleet {
    /// Name of the fleet, new in every run, so that every drive is.
    pub name: String,
    pub tapes: Vec<Arc<Tape>>,
    pub vehicles: u32,
    pub rate: FrameRate,
    pub window: usize,
    pub link: Link,
    pub tally: Tally,
    /// When the frames begin and end, once every vehicle has opened its first drive.
    pub run: watch::Receiver<Option<(Instant, Instant)>>,
}

/// Where the frames go.
#[derive(Debug)]
pub enum Link {
    /// The ingest service over gRPC.
    Grpc(Connections),
    /// The ingest service over zenoh.
    Zenoh(Sessions),
    /// A gRPC service that sends back what it gets.
    Echo(Connections),
}

/// A drive that is open.
struct OpenDrive {
    flow: Flow,
    reading: tokio::task::JoinHandle<()>,
}

impl Fleet {
    /// Streams as one vehicle; `ready` hears when its first drive is open.
    pub async fn drive(self: Arc<Self>, vehicle: u32, ready: tokio::sync::mpsc::Sender<()>) -> anyhow::Result<()> {
        let mut drives = JoinSet::new();
        let mut leg = self.first_leg(vehicle);
        let mut number = 0;
        let mut open = self.open_patiently(vehicle, number, leg.clone()).await?;
        ready.send(()).await?;
        drop(ready);
        let (began, stop_at) = self.began().await?;
        let mut pace = Pace { rate: self.rate, next_due: began + self.phase(vehicle), stop_at };
        loop {
            open.flow.go(pace);
            let sent = open.flow.sent().await;
            let leaving = leave(open, stop_at + ACK_GRACE);
            match self.rate {
                // Where frames are due, they go with the next drive while the server ends this one; a vehicle that is as
                // fast as it may be ends one drive before it begins another.
                FrameRate::Every(_) => drop(drives.spawn(leaving)),
                FrameRate::Max => leaving.await,
            }
            match sent {
                Some(Sent::TimeIsUp) => break,
                Some(Sent::WholeDrive(later)) => pace = later,
                // The stream broke: frames that were due meanwhile go with the next drive.
                None => {
                    if Instant::now() >= stop_at {
                        break;
                    }
                }
            }
            number += 1;
            leg = Leg { from: 0, ..leg };
            open = self.open_patiently(vehicle, number, leg.clone()).await?;
        }
        drives.join_all().await;
        Ok(())
    }

    /// Vehicles begin at places of their own, so that their drives do not all end at once.
    fn first_leg(&self, vehicle: u32) -> Leg {
        let tape = Arc::clone(&self.tapes[vehicle as usize % self.tapes.len()]);
        let from = tape.len() * vehicle as usize / self.vehicles as usize;
        Leg { tape, from, framing: None }
    }

    /// Frames of different vehicles are due at different moments of a period.
    fn phase(&self, vehicle: u32) -> Duration {
        match self.rate {
            FrameRate::Max => Duration::ZERO,
            FrameRate::Every(period) => period * vehicle / self.vehicles,
        }
    }

    async fn began(&self) -> anyhow::Result<(Instant, Instant)> {
        let mut run = self.run.clone();
        let run = run.wait_for(Option::is_some).await?;
        run.ok_or_else(|| anyhow::anyhow!("the run was given up"))
    }

    async fn open_patiently(&self, vehicle: u32, number: u32, leg: Leg) -> anyhow::Result<OpenDrive> {
        for _ in 1..OPEN_TRIES {
            match self.open(vehicle, number, leg.clone()).await {
                Ok(open) => return Ok(open),
                Err(status) if matches!(status.code(), Code::Unavailable | Code::ResourceExhausted) => {
                    tracing::debug!(vehicle, %status, "no drive could be opened, trying again");
                    sleep(OPEN_PAUSE).await;
                }
                Err(status) => anyhow::bail!("vehicle {vehicle} cannot open a drive: {status}"),
            }
        }
        self.open(vehicle, number, leg)
            .await
            .map_err(|status| anyhow::anyhow!("vehicle {vehicle} cannot open a drive: {status}"))
    }

    async fn open(&self, vehicle: u32, number: u32, mut leg: Leg) -> Result<OpenDrive, Status> {
        if !matches!(self.link, Link::Echo(_)) {
            let name = DriveName { fleet: &self.name, vehicle, drive: number };
            leg.framing = Some(Framing { start: leg.tape.start(name), end: Tape::end() });
        }
        let (flow, outgoing) = flow(leg, self.window, &self.tally);
        let (refuse, mut refused) = oneshot::channel();
        let reading = match &self.link {
            Link::Grpc(connections) => {
                let answers = connections.stream(vehicle, outgoing).await?;
                let reader = flow.clone();
                let take = move |bytes| Answer::parse(bytes).map(|answer| reader.take(answer));
                tokio::spawn(read(answers, take, flow.clone(), refuse, self.tally.clone()))
            }
            Link::Echo(connections) => {
                let answers = connections.stream(vehicle, outgoing).await?;
                let reader = flow.clone();
                let take = move |_| {
                    reader.take_echo();
                    Ok(())
                };
                tokio::spawn(read(answers, take, flow.clone(), refuse, self.tally.clone()))
            }
            Link::Zenoh(sessions) => sessions
                .stream((&self.name, vehicle), outgoing, flow.clone(), self.tally.clone())
                .await
                .map_err(|error| Status::unavailable(error.to_string()))?,
        };
        if flow.accepted().await {
            refused.close();
            self.tally.counts().drives += 1;
            return Ok(OpenDrive { flow, reading });
        }
        let _ = reading.await;
        Err(refused.try_recv().unwrap_or_else(|_| Status::unavailable("the stream ended before the drive was open")))
    }
}

/// Reads the answers of a gRPC stream to its end. A stream that breaks is told to who waits for its opening, or counted.
async fn read(
    mut answers: Streaming<Bytes>,
    take: impl Fn(Bytes) -> Result<(), prost::DecodeError>,
    flow: Flow,
    refuse: oneshot::Sender<Status>,
    tally: Tally,
) {
    let ended = loop {
        match answers.message().await {
            Ok(Some(bytes)) => {
                if let Err(error) = take(bytes) {
                    break Err(Status::internal(error.to_string()));
                }
            }
            Ok(None) => break Ok(()),
            Err(status) => break Err(status),
        }
    };
    // Told before the flow closes: who waits for the opening asks then.
    if let Err(Err(status)) = ended.map_err(|status| refuse.send(status)) {
        let mut counts = tally.counts();
        counts.broken += 1;
        counts.complain(|| format!("a stream broke: {status}"));
    }
    flow.close();
}

/// Waits for the acks of a drive that is sent, as long as they may take, then for the end of its stream.
async fn leave(open: OpenDrive, until: Instant) {
    let OpenDrive { flow, reading } = open;
    let abort = reading.abort_handle();
    let left = async {
        flow.settled().await;
        // A panic of the reading task has been reported.
        let _ = reading.await;
    };
    if timeout_at(until, left).await.is_err() {
        abort.abort();
    }
}
