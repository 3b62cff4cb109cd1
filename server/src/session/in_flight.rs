//! What may be between the network and the journal: frames of one session, and bytes of all of them.
//!
//! A vehicle that sends more waits until some are mapped, or put off; it is not read from meanwhile. No session gets more than
//! a share of the bytes, so that one that sends huge frames does not make the others wait.

use std::sync::Arc;

use lanemap_core::Frame;
use tokio::sync::{AcquireError, OwnedSemaphorePermit, Semaphore};

use crate::config::ServerConfig;

/// Bytes are counted in units, since a semaphore counts to `u32`.
const UNIT_BYTES: usize = 1024;
/// Sessions that it takes to use up all bytes.
const SHARES: usize = 16;
/// Bytes that a frame takes besides its points and occlusions.
const FRAME_BYTES: usize = 512;

/// The bytes that all sessions share. Clones share them.
#[derive(Clone, Debug)]
pub(crate) struct InFlightBudget {
    units: Arc<Semaphore>,
    units_per_session: usize,
    frames_per_session: usize,
}

/// What one session may have in flight.
#[derive(Clone, Debug)]
pub(crate) struct SessionInFlight {
    frames: Arc<Semaphore>,
    units: Arc<Semaphore>,
    most_units: usize,
    all: Arc<Semaphore>,
}

/// The place of one frame; free again when dropped.
#[derive(Debug)]
pub(crate) struct FramePlace {
    _frame: OwnedSemaphorePermit,
    _units: OwnedSemaphorePermit,
    _all: OwnedSemaphorePermit,
}

impl InFlightBudget {
    pub(crate) fn new(config: &ServerConfig) -> Self {
        let units = (config.max_bytes_in_flight / UNIT_BYTES).min(Semaphore::MAX_PERMITS);
        Self {
            units: Arc::new(Semaphore::new(units)),
            units_per_session: (units / SHARES).max(1),
            frames_per_session: config.max_frames_in_flight,
        }
    }

    /// What one more session may have in flight.
    pub(crate) fn session(&self) -> SessionInFlight {
        SessionInFlight {
            frames: Arc::new(Semaphore::new(self.frames_per_session)),
            units: Arc::new(Semaphore::new(self.units_per_session)),
            most_units: self.units_per_session,
            all: Arc::clone(&self.units),
        }
    }

    /// Whether all bytes are taken.
    pub(crate) fn is_used_up(&self) -> bool {
        self.units.available_permits() == 0
    }
}

impl SessionInFlight {
    /// A place for `frame`; waits until there is one. A frame beyond the session's share takes the whole of it.
    pub(crate) async fn place(&self, frame: &Frame) -> Result<FramePlace, AcquireError> {
        let units = frame_bytes_in_memory(frame).div_ceil(UNIT_BYTES).min(self.most_units);
        let units = u32::try_from(units).unwrap_or(u32::MAX);
        Ok(FramePlace {
            _frame: Arc::clone(&self.frames).acquire_owned().await?,
            _units: Arc::clone(&self.units).acquire_many_owned(units).await?,
            _all: Arc::clone(&self.all).acquire_many_owned(units).await?,
        })
    }
}

fn frame_bytes_in_memory(frame: &Frame) -> usize {
    let points: usize = frame.detections().iter().map(|detection| detection.points_vehicle.len()).sum();
    // The frame, and the bytes that go into the journal.
    FRAME_BYTES + 2 * (points + frame.occlusions().len()) * size_of::<[f64; 3]>()
}

#[cfg(test)]
mod tests {
    use futures::FutureExt;
    use lanemap_core::{Category, Detection, FrameLimits, FrameParts, Odometry, Sequence, TimestampNs, geometry::Pose};
    use nalgebra::Point3;

    use super::*;

    fn frame(points: usize) -> Frame {
        let odometry = Odometry { odometry_from_vehicle: Pose::identity(), motion_covariance: None };
        let line =
            Detection { category: Category::WhiteSolid, points_vehicle: vec![Point3::new(1.0, 0.0, 0.0); points] };
        let detections = vec![line];
        let parts = FrameParts {
            sequence: Sequence(1),
            time: TimestampNs(1),
            odometry,
            gnss: None,
            detections,
            occlusions: vec![],
        };
        Frame::new(parts, &FrameLimits::default()).unwrap()
    }

    fn budget(max_frames_in_flight: usize, max_bytes_in_flight: usize) -> InFlightBudget {
        InFlightBudget::new(&ServerConfig { max_frames_in_flight, max_bytes_in_flight, ..ServerConfig::default() })
    }

    #[test]
    fn a_session_waits_once_its_window_is_full_and_goes_on_when_a_frame_is_done() {
        let session = budget(2, 1 << 20).session();
        let (small, next) = (frame(2), frame(2));
        let first = session.place(&small).now_or_never().unwrap().unwrap();
        let _second = session.place(&small).now_or_never().unwrap().unwrap();
        let mut waiting = Box::pin(session.place(&next));
        assert!(waiting.as_mut().now_or_never().is_none());
        drop(first);
        assert!(waiting.now_or_never().is_some());
    }

    #[test]
    fn a_session_of_huge_frames_leaves_bytes_for_the_others() {
        let budget = budget(64, 1 << 20);
        let (greedy, modest) = (budget.session(), budget.session());
        let (huge, small) = (frame(4096), frame(2));
        let _held = greedy.place(&huge).now_or_never().unwrap().unwrap();
        assert!(greedy.place(&huge).now_or_never().is_none());
        assert!(modest.place(&small).now_or_never().is_some());
        assert!(!budget.is_used_up());
    }
}
