//! A thread that cuts drives into contributions and fuses cells, one task after the other.

mod contributing;
mod fusing;

use std::{
    panic::{AssertUnwindSafe, catch_unwind},
    sync::{Arc, PoisonError, atomic::Ordering},
    time::{Duration, Instant},
};

use fusing::Fused;
use lanemap_core::{
    TimestampNs,
    fleet::{CellId, DriveId},
};
use lanemap_proto::v1;
use prost::Message;

use super::{
    CellRecord, CellVersion, Fuser,
    border::{self, Crossing},
    cell_record::fingerprint,
    drafts::DRAFTED,
    events::{self, CellEvent, Kept, Known},
    now_ms,
    publications::Publication,
    queue::{Taken, Task, Wanted},
    retention, wire,
};
use crate::{
    journal::{
        JournalError,
        cells::{CellStore, CellWrite, ContributionFact, Facts, NewVersion, encoded},
    },
    session::SessionId,
};

/// Most versions of a cell that are kept, however young.
const MOST_VERSIONS: usize = 128;
/// Pause after a task that could not be done.
const RETRY_PAUSE: Duration = Duration::from_secs(1);

/// Pause after a task in which this program failed.
const PAUSE_AFTER_FAULT: Duration = Duration::from_mins(1);

/// How much nicer a fusing thread is than the rest of the service: what is ready to take frames and to ack them goes first.
#[cfg(target_os = "linux")]
const NICER: i32 = 5;
/// The nicest that there is.
#[cfg(target_os = "linux")]
const NICEST: i32 = 19;

pub(super) struct Worker {
    fuser: Fuser,
    store: CellStore,
}

/// Why a task is not done.
enum Failure {
    Store(JournalError),
    Panic,
}

/// What became of a task that was done.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Done {
    Wholly,
    /// A cell was drafted, which is still to be fused.
    Drafted,
}

/// Whether a cell may be drafted.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Demand {
    Soon,
    Whole,
}

/// What of a cell is replaced.
struct Past {
    map: Arc<v1::CellMap>,
    /// Events that were kept, and those that are told now.
    known: Vec<CellEvent>,
    told: Vec<CellEvent>,
    /// Contributions that are no longer kept.
    dropped: Vec<SessionId>,
    /// A drive in it was deleted.
    purged: bool,
}

impl Worker {
    pub(super) fn new(fuser: Fuser, store: CellStore) -> Self {
        Self { fuser, store }
    }

    /// Works until the service stops; then puts what drives have offered into the store, and ends.
    pub(super) fn run(self) {
        #[cfg(target_os = "linux")]
        stand_back();
        while let Some(taken) = self.next() {
            let started = Instant::now();
            let task = match &taken {
                Taken::Contribute(offer) => Task::Contribute(offer.session),
                Taken::Locate(session) => Task::Locate(*session),
                Taken::Fuse(cell) => Task::Fuse(*cell),
                Taken::Settle(cell) => Task::Settle(*cell),
            };
            let outcome = self.attempt(&taken);
            let mut queue = self.fuser.queue();
            match outcome {
                Ok(done) => {
                    queue.finish(task, Instant::now());
                    if let Task::Fuse(cell) | Task::Settle(cell) = task {
                        match done {
                            Done::Drafted => queue.settle_later(cell, started),
                            Done::Wholly => queue.has_settled(cell),
                        }
                        self.fuser.seek_where_map_grew(&mut queue);
                    }
                }
                Err(Failure::Store(error)) if self.fuser.is_stopping() => {
                    // The next start finds out what is missing.
                    tracing::warn!(%error, "the shared map could not be brought up to date");
                    queue.finish(task, Instant::now());
                }
                Err(Failure::Store(error)) => {
                    tracing::warn!(%error, "the shared map cannot be brought up to date, and is tried again");
                    queue.retry(taken, Instant::now(), RETRY_PAUSE);
                }
                Err(Failure::Panic) if self.fuser.is_stopping() => queue.finish(task, Instant::now()),
                Err(Failure::Panic) => {
                    tracing::error!(?task, "a fault of this program: the task is tried again, the others go on");
                    queue.retry(taken, Instant::now(), PAUSE_AFTER_FAULT);
                }
            }
            self.fuser.tell_dirty(&queue);
            drop(queue);
            self.fuser.shared.woken.notify_all();
            self.fuser.shared.done.send_modify(|count| *count += 1);
            self.rest(started.elapsed());
        }
    }

    /// Does a task. A panic in it, which is a fault of this program, ends the task and not the thread.
    fn attempt(&self, taken: &Taken) -> Result<Done, Failure> {
        let attempt = AssertUnwindSafe(|| match taken {
            Taken::Contribute(offer) => self.contribute(offer).map(|()| Done::Wholly),
            Taken::Locate(session) => self.locate(*session).map(|()| Done::Wholly),
            Taken::Fuse(cell) => self.fuse(*cell, Demand::Soon),
            Taken::Settle(cell) => self.fuse(*cell, Demand::Whole),
        });
        match catch_unwind(attempt) {
            Ok(outcome) => outcome.map_err(Failure::Store),
            Err(_) => Err(Failure::Panic),
        }
    }

    /// Which tasks are done now: drives only until those that a crash interrupted have been asked, and when the service
    /// stops.
    fn wanted(&self) -> Wanted {
        match (self.fuser.is_stopping(), self.fuser.shared.recovered.load(Ordering::Relaxed)) {
            (true, _) => Wanted::DrivesAtOnce,
            (false, false) => Wanted::Drives,
            (false, true) => Wanted::All,
        }
    }

    /// Waits for the next task; `None` where none will come.
    fn next(&self) -> Option<Taken> {
        let mut queue = self.fuser.queue();
        loop {
            let stopping = self.fuser.is_stopping();
            let woken = &self.fuser.shared.woken;
            match queue.take(Instant::now(), self.wanted()) {
                Ok(taken) => return Some(taken),
                Err(_) if stopping => return None,
                Err(None) => queue = woken.wait(queue).unwrap_or_else(PoisonError::into_inner),
                Err(Some(at)) => {
                    let pause = at.saturating_duration_since(Instant::now());
                    queue = woken.wait_timeout(queue, pause).unwrap_or_else(PoisonError::into_inner).0;
                }
            }
        }
    }

    /// Leaves the machine to others after work, so that fusing takes its share of a core and no more.
    fn rest(&self, worked: Duration) {
        let share = self.fuser.shared.settings.cpu_share;
        let until = Instant::now() + worked.mul_f64(1.0 / share - 1.0);
        let mut queue = self.fuser.queue();
        while !self.fuser.is_stopping() && Instant::now() < until {
            let pause = until.saturating_duration_since(Instant::now());
            queue = self.fuser.shared.woken.wait_timeout(queue, pause).unwrap_or_else(PoisonError::into_inner).0;
        }
    }

    /// Brings a cell up to date: fuses it where it is not fused from what the store has, and joins it with its neighbours.
    fn fuse(&self, cell: CellId, demand: Demand) -> Result<Done, JournalError> {
        let mut facts = self.store.facts_of(cell)?;
        let dropped = self.drop_least_missed(cell, &mut facts)?;
        let before = self.fuser.shared.map.record(cell);
        let before = before.as_deref().cloned().unwrap_or_default();
        let purged = self.store.purges()?.contains(&cell);
        let print = fingerprint(facts.values());
        let fused = match demand {
            _ if before.fingerprint == print => None,
            Demand::Soon => Some(self.draft_or_fuse(cell, &facts)?),
            Demand::Whole => Some(self.fuse_whole(cell, &facts)?),
        };
        let is_draft = fused.as_ref().is_some_and(|fused| fused.is_draft);

        let (pieces, crossings) = match &fused {
            Some(fused) => (fused.pieces.clone(), fused.crossings.clone()),
            None => (self.store.lines(cell)?, before.crossings.clone()),
        };
        let map = &self.fuser.shared.map;
        let neighbours: Vec<(CellId, _)> =
            cell.neighbours().into_iter().filter_map(|near| Some((near, map.record(near)?))).collect();
        let joined = border::join(cell, pieces, &crossings, |near| {
            let found = neighbours.iter().find(|(neighbour, _)| *neighbour == near);
            found.map(|(_, record)| record.crossings.as_slice())
        });
        let lanes = wire::lanes(&joined);

        let fingerprint = if is_draft { DRAFTED } else { print };
        let mut record = CellRecord { fingerprint, crossings, ..before.clone() };
        record.lanes = u32::try_from(lanes.len()).unwrap_or(u32::MAX);
        (record.line_m, record.median_lateral_sigma_m) = length_and_sigma(&lanes);
        if let Some(fused) = &fused {
            record.tell(fused, &facts);
        }
        let published = map.get(cell)?.map(|published| Arc::clone(&published.map));
        let known: Vec<CellEvent> = if fused.is_some() || purged { self.store.events(cell)? } else { Vec::new() };
        record.forgets |= !dropped.is_empty();
        if purged {
            // It is the start of a drive, maybe of the one that was deleted.
            record.events_left = None;
        }
        let told = fused.as_ref().map(|fused| {
            let earlier = published.as_ref().map(|published| published.lanes.as_slice()).unwrap_or_default();
            // What is told of the past may name the drive that was deleted.
            let (events, earlier) = if purged { (&[][..], &[][..]) } else { (known.as_slice(), earlier) };
            let (left, forgets) = (record.events_left, record.forgets);
            let after = if purged { &[][..] } else { lanes.as_slice() };
            let known = Known { cell, events, left, forgets, lanes: earlier };
            // What became of the road is told by all drives.
            events::told(&known, (!is_draft).then_some(&fused.map), after)
        });
        let told = told.unwrap_or_default();
        let is_same = told.is_empty() && published.as_ref().is_some_and(|published| published.lanes == lanes);
        let next = (!is_same).then(|| {
            record.version = CellVersion(before.version.0 + 1);
            let next = v1::CellMap { version: record.version.0, lanes, ..wire::empty_cell(cell) };
            let bytes = next.encode_to_vec();
            (next, bytes)
        });
        if fused.is_some() || next.is_some() || purged || !dropped.is_empty() {
            let published = published.unwrap_or_else(|| Arc::new(wire::empty_cell(cell)));
            let past = Past { map: published, known, told, dropped, purged };
            self.write(cell, record.clone(), fused.as_ref(), next, past)?;
        }
        self.tell_neighbours(cell, &before.crossings, &record.crossings);
        Ok(if is_draft { Done::Drafted } else { Done::Wholly })
    }

    /// Makes a fused cell durable, and what is new in it the next revision of the map, which readers then see.
    fn write(
        &self,
        cell: CellId,
        mut record: CellRecord,
        fused: Option<&Fused>,
        next: Option<(v1::CellMap, Vec<u8>)>,
        past: Past,
    ) -> Result<(), JournalError> {
        let Past { map: before, known, told, dropped, purged } = past;
        let kept = self.events_kept();
        let outdated = self.outdated(cell, next.is_some(), purged)?;
        let published_ms = now_ms();
        let map = &self.fuser.shared.map;
        let changes = next.as_ref().map(|(next, _)| wire::changes(&before, next));
        let mut turn = map.turn();
        let publication = changes.map(|changes| Publication {
            revision: turn.next(),
            cell,
            from_version: CellVersion(changes.from_version),
            to_version: record.version,
            published_ms,
            lines_upserted: u32::try_from(changes.upserted.len()).unwrap_or(u32::MAX),
            lines_removed: u32::try_from(changes.removed.len()).unwrap_or(u32::MAX),
        });
        let version = next.as_ref().zip(publication).map(|((map, bytes), publication)| {
            Ok::<_, JournalError>(NewVersion {
                version: map.version,
                published_ms,
                bytes: bytes.clone(),
                revision: publication.revision.0,
                publication: encoded("a publication", &publication)?,
            })
        });
        // A record of an earlier build may not know it.
        let last = known.iter().map(|event| event.number).fold(record.last_event, u64::max);
        let told = publication.map(|Publication { revision, to_version, .. }| {
            events::number(told, last, kept.most, (revision, to_version, published_ms))
        });
        let told = told.unwrap_or_default();
        let left = events::outdated(&known, &told, kept, purged);
        if !purged {
            let left = left.iter().filter_map(|event| event.noticed_unix_ns).map(TimestampNs).max();
            record.events_left = record.events_left.max(left);
        }
        record.last_event = told.iter().map(|event| event.number).fold(last, u64::max);
        if !told.is_empty() {
            record.told_in = record.version;
        }
        let told = told.iter().map(|event| Ok((event.number, encoded("an event", event)?)));
        let outdated_revisions =
            if publication.is_some() { map.outdated_publications(self.oldest_kept_ms()) } else { Vec::new() };
        self.store.put_cell(CellWrite {
            cell,
            newest: record.version.0,
            told: encoded("a cell", &record)?,
            lines: fused.map(|fused| encoded("a cell's lines", &fused.pieces)).transpose()?,
            version: version.transpose()?,
            outdated,
            outdated_events: left.iter().map(|event| event.number).collect(),
            events: told.collect::<Result<_, JournalError>>()?,
            outdated_revisions: outdated_revisions.iter().map(|revision| revision.0).collect(),
            dropped,
            purged,
        })?;
        map.publish(cell, record, next.map(|(map, bytes)| (map, bytes.into())), publication);
        if let Some(last) = outdated_revisions.last() {
            map.drop_publications_until(*last);
        }
        drop(turn);
        Ok(())
    }

    /// How many events of a cell are kept, and how long.
    fn events_kept(&self) -> Kept {
        let settings = &self.fuser.shared.settings;
        let kept_ms = u64::try_from(settings.events_kept.as_millis()).unwrap_or(u64::MAX);
        Kept { most: settings.most_events, since_ms: now_ms().saturating_sub(kept_ms) }
    }

    /// Time before which what was replaced is kept no longer, milliseconds since the Unix epoch.
    fn oldest_kept_ms(&self) -> u64 {
        let kept = self.fuser.shared.settings.versions_kept;
        now_ms().saturating_sub(u64::try_from(kept.as_millis()).unwrap_or(u64::MAX))
    }

    /// Takes the drives out that are missed least, where there are more than a cell keeps.
    fn drop_least_missed(&self, cell: CellId, facts: &mut Facts) -> Result<Vec<SessionId>, JournalError> {
        let most = self.fuser.shared.settings.max_contributions;
        let read = |session| self.store.contribution(cell, session);
        let dropped = self.fuser.shared.footprints.missed_least(cell, facts, most, read)?;
        for session in &dropped {
            facts.remove(session);
        }
        Ok(dropped)
    }

    /// Versions of a cell that are no longer kept: replaced long ago, beyond the most, or with a deleted drive in them.
    fn outdated(&self, cell: CellId, replaced: bool, purged: bool) -> Result<Vec<u64>, JournalError> {
        if !replaced {
            // The newest stays. A purge without a change has nothing of the deleted drive in it, but its past may.
            let mut versions = if purged { self.store.versions(cell)? } else { Vec::new() };
            versions.pop();
            return Ok(versions.into_iter().map(|(version, _)| version).collect());
        }
        let versions = self.store.versions(cell)?;
        if purged {
            return Ok(versions.into_iter().map(|(version, _)| version).collect());
        }
        Ok(retention::outdated(&versions, MOST_VERSIONS, self.oldest_kept_ms(), now_ms()))
    }

    /// Has the neighbours joined again whose border was changed.
    fn tell_neighbours(&self, cell: CellId, before: &[Crossing], after: &[Crossing]) {
        let map = &self.fuser.shared.map;
        let changed = |near: &CellId| border::differ(before, after, *near) && map.record(*near).is_some();
        let near: Vec<CellId> = cell.neighbours().into_iter().filter(changed).collect();
        let mut queue = self.fuser.queue();
        for near in near {
            queue.touch_cell(near, Instant::now());
        }
    }
}

/// Lets the system run this thread after the others of the service, where there is too much for all.
#[cfg(target_os = "linux")]
fn stand_back() {
    use rustix::{
        process::{getpriority_process, setpriority_process},
        thread::gettid,
    };
    let thread = Some(gettid());
    let outcome = getpriority_process(thread).and_then(|nice| setpriority_process(thread, (nice + NICER).min(NICEST)));
    if let Err(error) = outcome {
        tracing::warn!(%error, "fusing has the priority of everything else");
    }
}

impl CellRecord {
    fn tell(&mut self, fused: &Fused, facts: &Facts) {
        self.fused_at_ms = now_ms();
        self.fused_in_ms = u64::try_from(fused.took.as_millis()).unwrap_or(u64::MAX);
        self.drives = u32::try_from(facts.len()).unwrap_or(u32::MAX);
        let apart: Vec<DriveId> =
            fused.map.drives.iter().filter(|drive| drive.correction.is_none()).map(|drive| drive.drive).collect();
        let is_apart = |fact: &ContributionFact| apart.contains(&fact.drive);
        self.kept_apart = facts.iter().filter(|(_, fact)| is_apart(fact)).map(|(session, _)| *session).collect();
    }
}

/// Length of all lanes, metres, and the median of the standard deviations across them, metres.
fn length_and_sigma(lanes: &[v1::FusedLane]) -> (f64, f64) {
    let length = |lane: &v1::FusedLane| -> f64 {
        wire::positions(lane).windows(2).map(|pair| nalgebra::distance(&pair[0], &pair[1])).sum()
    };
    let mut sigmas: Vec<u32> = lanes.iter().flat_map(|lane| lane.lateral_sigma_mm.iter().copied()).collect();
    sigmas.sort_unstable();
    let median = sigmas.get(sigmas.len() / 2).map_or(0.0, |sigma| f64::from(*sigma) * 1e-3);
    (lanes.iter().map(length).sum(), median)
}
