//! Forgets drives: their streams end, their data go, and no stream of them is taken any more.

use std::{
    collections::HashMap,
    sync::{Arc, MutexGuard},
    time::{SystemTime, UNIX_EPOCH},
};

use tokio::sync::OwnedMutexGuard;

use super::{
    SessionId, SessionKey,
    actor::{Command, Surroundings},
    registry::{SessionRegistry, Slot, locked},
};
use crate::{
    error::Error,
    journal::ForgottenDrive,
    privacy::{DrivePseudonym, VehiclePseudonym},
};

/// Days for which a forgotten drive is remembered as forgotten, so that what a vehicle still has of it is not taken.
const REMEMBERED_DAYS: u32 = 400;

/// Whom to forget, by name.
#[derive(Clone, Debug)]
pub enum Whom {
    /// Every drive of a vehicle.
    Vehicle {
        /// The fleet.
        fleet: String,
        /// The vehicle.
        vehicle: String,
    },
    /// One drive.
    Drive(SessionKey),
}

/// The drives that were forgotten, and the day of it, counted from 1970.
#[derive(Clone, Debug, Default)]
pub(super) struct Forgotten {
    days: HashMap<DrivePseudonym, u32>,
}

impl Forgotten {
    pub(super) fn new(drives: Vec<ForgottenDrive>) -> Self {
        Self { days: drives.into_iter().map(|forgotten| (forgotten.drive, forgotten.day)).collect() }
    }

    pub(super) fn contains(&self, drive: DrivePseudonym) -> bool {
        self.days.contains_key(&drive)
    }

    /// Adds `drives`, and drops those that are outdated; gives what there was before, and what was dropped.
    fn remember(&mut self, drives: &[ForgottenDrive]) -> (Self, Vec<DrivePseudonym>) {
        let before = self.clone();
        let today = today();
        self.days.retain(|_, day| today.saturating_sub(*day) <= REMEMBERED_DAYS);
        let mut outdated: Vec<_> = before.days.keys().filter(|drive| !self.contains(**drive)).copied().collect();
        outdated.sort_unstable();
        self.days.extend(drives.iter().map(|forgotten| (forgotten.drive, forgotten.day)));
        (before, outdated)
    }
}

impl SessionRegistry {
    /// Deletes what there is of the drives of `whom`; gives their number once it is gone from the disk.
    pub(crate) async fn forget(&self, whom: &Whom) -> Result<usize, Error> {
        // One at a time: two that lock the same drives in another order would wait for each other.
        let _alone = self.shared.forgetting.lock().await;
        let day = today();
        let drives: Vec<_> = self.drives_of(whom).into_iter().map(|drive| ForgottenDrive { drive, day }).collect();
        // From here on no stream of them begins; where it cannot be done, all is as before.
        let (before, outdated) = self.forgotten().remember(&drives);
        let forgotten = self.forget_held(&drives, outdated).await;
        if forgotten.is_err() {
            *self.forgotten() = before;
        }
        let count = forgotten?;
        self.shared.surroundings.journal.erase().await?;
        tracing::info!(drives = count, "drives were deleted on request");
        Ok(count)
    }

    /// Makes what was cut off trips leave the disk every `trip_erase_s`, and what a deletion left that a crash
    /// interrupted at once.
    pub(crate) async fn keep_erasing(self) {
        loop {
            let erased = {
                let _alone = self.shared.forgetting.lock().await;
                self.shared.surroundings.journal.erase().await
            };
            match erased {
                Ok(true) => tracing::info!("what was deleted has left the disk"),
                Ok(false) => {}
                Err(error) => tracing::error!(%error, "what was deleted cannot leave the disk"),
            }
            tokio::select! {
                () = tokio::time::sleep(self.shared.surroundings.config.trip_erase()) => {}
                () = self.shared.surroundings.shutdown.cancelled() => return,
            }
        }
    }

    async fn forget_held(&self, drives: &[ForgottenDrive], outdated: Vec<DrivePseudonym>) -> Result<usize, Error> {
        let mut held = Vec::new();
        for forgotten in drives {
            held.push(self.hold(forgotten.drive).await);
        }
        let sessions: Vec<SessionId> = held.iter().filter_map(|slot| Some(slot.record.as_ref()?.id)).collect();
        let Surroundings { journal, fuser, .. } = &self.shared.surroundings;
        fuser.drop_offers(&sessions).await;
        journal.forget(sessions.clone(), drives.to_vec(), outdated).await?;
        for forgotten in drives {
            self.remove(forgotten.drive);
        }
        for session in &sessions {
            self.shared.surroundings.sessions.remove(session);
        }
        fuser.fuse_without(&sessions).await;
        Ok(sessions.len())
    }

    /// Every drive of `whom` that there is; a drive that is named, in any case.
    fn drives_of(&self, whom: &Whom) -> Vec<DrivePseudonym> {
        match whom {
            Whom::Drive(key) => vec![self.pseudonyms().drive(key)],
            Whom::Vehicle { fleet, vehicle } => self.drives_of_vehicle(self.pseudonyms().vehicle(fleet, vehicle)),
        }
    }

    fn drives_of_vehicle(&self, vehicle: VehiclePseudonym) -> Vec<DrivePseudonym> {
        let slots = locked(&self.shared.slots);
        let mut drives: Vec<_> =
            slots.iter().filter(|(_, place)| place.vehicle == vehicle).map(|(drive, _)| *drive).collect();
        drives.sort_unstable();
        drives
    }

    /// Locks a drive's slot and ends its actor, which saves nothing any more.
    async fn hold(&self, drive: DrivePseudonym) -> OwnedMutexGuard<Slot> {
        let slot = locked(&self.shared.slots).get(&drive).map(|place| Arc::clone(&place.slot)).unwrap_or_default();
        let mut slot = slot.lock_owned().await;
        if let Some(actor) = slot.actor.take() {
            actor.outbox.finish(Err(Error::Forgotten.into()));
            // Closed where it has just left: then it has saved what it had, which is deleted next.
            let _ = actor.commands.send(Command::Forget).await;
            let _ = actor.task.await;
        }
        slot
    }

    pub(super) fn forgotten(&self) -> MutexGuard<'_, Forgotten> {
        locked(&self.shared.forgotten)
    }
}

fn today() -> u32 {
    let since_epoch = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    u32::try_from(since_epoch.as_secs() / 86_400).unwrap_or(u32::MAX)
}
