//! A simulated fleet: vehicles that drive in real time, one drive after the other.

use std::{
    sync::Arc,
    time::{Duration, SystemTime, UNIX_EPOCH},
};

use lanemap_client::{ClientError, IngestClient, Session, SessionStart};
use lanemap_core::{Frame, FrameError, FrameLimits, FrameParts, TimestampNs};
use lanemap_simulator::{drive::motion::FRAME_RATE_HZ, fleet::FleetDrive};
use thiserror::Error;
use tokio::time::{Instant, MissedTickBehavior, interval, sleep, timeout};
use tokio_util::{sync::CancellationToken, task::TaskTracker};

/// Pause after a drive that failed.
const AFTER_FAILURE: Duration = Duration::from_secs(2);

/// Vehicles on the road.
pub struct Fleet {
    vehicles: TaskTracker,
    stop: CancellationToken,
}

/// Why a drive of the demo failed.
#[derive(Debug, Error)]
enum DriveError {
    #[error(transparent)]
    Client(#[from] ClientError),
    #[error("a simulated frame is not valid: {0}")]
    Frame(#[from] FrameError),
}

/// What all vehicles share.
struct Town {
    fleet: lanemap_simulator::Fleet,
    began_unix_s: u64,
}

impl Fleet {
    /// Lets so many vehicles drive, each on a connection of its own session.
    pub fn start(vehicles: u32, fleet: lanemap_simulator::Fleet, client: &IngestClient) -> Self {
        let began_unix_s = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default().as_secs();
        let town = Arc::new(Town { fleet, began_unix_s });
        let (tasks, stop) = (TaskTracker::new(), CancellationToken::new());
        for vehicle in 0..vehicles {
            let drives = (vehicle..).step_by(vehicles as usize);
            tasks.spawn(keep_driving(vehicle, drives, Arc::clone(&town), client.clone(), stop.clone()));
        }
        tasks.close();
        Self { vehicles: tasks, stop }
    }

    /// Stops the vehicles; returns once their streams have ended, or after `grace`.
    pub async fn stop(self, grace: Duration) {
        self.stop.cancel();
        if timeout(grace, self.vehicles.wait()).await.is_err() {
            tracing::warn!("some vehicles had not ended their streams in {grace:?}");
        }
    }
}

/// One drive after the other, until stopped.
async fn keep_driving(
    vehicle: u32,
    drives: impl Iterator<Item = u32>,
    town: Arc<Town>,
    client: IngestClient,
    stop: CancellationToken,
) {
    for number in drives {
        match one_drive(vehicle, number, &town, &client, &stop).await {
            Ok(()) => {}
            Err(error) if stop.is_cancelled() => tracing::debug!(vehicle, %error, "drive cut short"),
            Err(error) => {
                tracing::warn!(vehicle, %error, "drive failed, the next begins in {AFTER_FAILURE:?}");
                tokio::select! {
                    () = stop.cancelled() => {}
                    () = sleep(AFTER_FAILURE) => {}
                }
            }
        }
        if stop.is_cancelled() {
            return;
        }
    }
}

async fn one_drive(
    vehicle: u32,
    number: u32,
    town: &Town,
    client: &IngestClient,
    stop: &CancellationToken,
) -> Result<(), DriveError> {
    let drive = town.fleet.drive(number);
    let start = SessionStart {
        sensor: drive.sensor(),
        ..SessionStart::new("demo", format!("vehicle-{vehicle}"), format!("{}-{number}", town.began_unix_s))
    };
    let (mut session, _events) = client.start_session(start).await?;
    let all_driven = stream(&mut session, &drive, stop).await?;
    let summary = if all_driven { session.finish().await? } else { session.close().await? };
    tracing::debug!(vehicle, number, ?summary, "drive over");
    Ok(())
}

/// Sends the frames at 10 Hz; `false` where it was stopped before the last.
async fn stream(session: &mut Session, drive: &FleetDrive<'_>, stop: &CancellationToken) -> Result<bool, DriveError> {
    let began_ns = now_ns();
    let mut ticks = interval(Duration::from_secs_f64(1.0 / FRAME_RATE_HZ));
    ticks.set_missed_tick_behavior(MissedTickBehavior::Burst);
    let _: Instant = ticks.tick().await;
    let later_ns = began_ns - drive.start().0;
    for frame in drive.frames() {
        let frame = later(&frame, later_ns)?;
        tokio::select! {
            () = stop.cancelled() => return Ok(false),
            sent = session.send(&frame) => sent?,
        }
        tokio::select! {
            () = stop.cancelled() => return Ok(false),
            _ = ticks.tick() => {}
        }
    }
    Ok(true)
}

/// The frame at a later time.
fn later(frame: &Frame, later_ns: i64) -> Result<Frame, FrameError> {
    let parts = FrameParts {
        sequence: frame.sequence(),
        time: TimestampNs(frame.time().0 + later_ns),
        odometry: frame.odometry().clone(),
        gnss: frame.gnss().copied(),
        detections: frame.detections().to_vec(),
        occlusions: frame.occlusions().to_vec(),
    };
    Frame::new(parts, &FrameLimits::default())
}

fn now_ns() -> i64 {
    let since_epoch = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    i64::try_from(since_epoch.as_nanos()).unwrap_or(i64::MAX)
}
