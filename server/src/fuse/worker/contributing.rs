//! What drives say, put into the store: by their own GNSS, or where a search found them.

use std::{sync::PoisonError, time::Instant};

use lanemap_core::fleet::{CellId, Contribution};

use super::Worker;
use crate::{
    fuse::{
        Offer,
        localizing::{Searched, Sought},
    },
    journal::{
        JournalError,
        cells::{Contributed, OwnFrame, StoredContribution, encoded},
    },
    session::{MapVersion, SessionId},
    telemetry,
};

impl Worker {
    /// Puts what a drive says into the store, where it is not what it said before.
    pub(super) fn contribute(&self, offer: &Offer) -> Result<(), JournalError> {
        let started = Instant::now();
        let session = offer.session;
        let before = self.fuser.queue().contributed(session).cloned().unwrap_or_default();
        if offer.georeference.is_none() {
            let Some(whole) = offer.whole() else { return Ok(()) };
            return self.seek(session, &whole, Some(offer.version));
        }
        let map = &self.fuser.shared.map;
        let had_none = map.sought(session).is_some();
        let own_frame = if had_none { OwnFrame::Goes } else { OwnFrame::Stays };
        self.say(session, offer.contributions()?, &before, offer.version, own_frame)?;
        if had_none {
            map.tell_sought(session, None);
        }
        metrics::histogram!(telemetry::CONTRIBUTE_SECONDS).record(started.elapsed().as_secs_f64());
        Ok(())
    }

    /// Seeks a drive without GNSS again, on a map that has grown.
    pub(super) fn locate(&self, session: SessionId) -> Result<(), JournalError> {
        if !self.store.purges()?.is_empty() {
            return Err(JournalError::Store("a drive that was deleted is still being taken out of the map".to_owned()));
        }
        let Some(whole) = self.store.own_frame(session)? else { return Ok(()) };
        self.seek(session, &whole, None)
    }

    /// Seeks a drive without GNSS on the map, where that is due, and puts what it says there into the store. `version` is that
    /// of its map, where that is new.
    fn seek(&self, session: SessionId, whole: &Contribution, version: Option<MapVersion>) -> Result<(), JournalError> {
        let map = &self.fuser.shared.map;
        let before = map.sought(session);
        let searched = {
            let mut searched = self.fuser.shared.searched.lock().unwrap_or_else(PoisonError::into_inner);
            searched.seek(whole, before, map, self.fuser.shared.settings.most_searched_m)?
        };
        // A deletion may have taken the drive off the map meanwhile: the store knows.
        let mut contributed = self.store.contributed_of(session)?;
        let contribution = version.map(|_| encoded("a drive in its own frame", whole)).transpose()?;
        let version = version.unwrap_or(contributed.version);
        contributed.version = version;
        let Some(Searched { sought, contributions }) = searched else {
            let own_frame = OwnFrame::Put { contribution, sought: None };
            self.store.contribute(session, &contributed, Vec::new(), &[], own_frame)?;
            self.fuser.queue().has_contributed(session, contributed);
            if before.is_none() {
                map.tell_sought(session, Some(Sought::default()));
            }
            return Ok(());
        };
        tracing::debug!(%session, alignment = ?sought.alignment, "a drive without GNSS was sought on the map");
        let own_frame = OwnFrame::Put { contribution, sought: Some(encoded("a search", &sought)?) };
        self.say(session, contributions, &contributed, version, own_frame)?;
        map.tell_sought(session, Some(sought));
        Ok(())
    }

    /// Puts what a drive says into the store, in the place of what it said before.
    fn say(
        &self,
        session: SessionId,
        mut changed: Vec<StoredContribution>,
        before: &Contributed,
        version: MapVersion,
        own_frame: OwnFrame,
    ) -> Result<(), JournalError> {
        let cells: Vec<CellId> = changed.iter().map(|contribution| contribution.cell).collect();
        let left: Vec<CellId> =
            before.cells.iter().filter(|cell| cells.binary_search(cell).is_err()).copied().collect();
        let mut kept = Vec::with_capacity(changed.len());
        for contribution in changed.drain(..) {
            let known = self.store.facts_of(contribution.cell)?;
            if known.get(&session) != Some(&contribution.fact) {
                kept.push(contribution);
            }
        }
        let touched: Vec<CellId> =
            kept.iter().map(|contribution| contribution.cell).chain(left.iter().copied()).collect();
        let contributed = Contributed { version, cells };
        metrics::counter!(telemetry::CONTRIBUTIONS).increment(kept.len() as u64);
        self.store.contribute(session, &contributed, kept, &left, own_frame)?;
        let mut queue = self.fuser.queue();
        queue.has_contributed(session, contributed);
        for cell in touched {
            queue.touch_cell(cell, Instant::now());
        }
        Ok(())
    }
}
