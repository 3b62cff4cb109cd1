//! The last frames of a session by number and content: tells a frame that was sent twice from a number given twice.

use std::collections::VecDeque;

use lanemap_core::Sequence;
use serde::{Deserialize, Serialize};
use xxhash_rust::xxh3::xxh3_64;

/// Frames remembered: four times what a client with default settings keeps unacked.
pub(crate) const REMEMBERED: usize = 256;

/// What a frame with an old number is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Recollection {
    /// The same frame again.
    Same,
    /// Another frame under the same number.
    Other,
    /// A number that is not remembered.
    Unknown,
}

/// The last [`REMEMBERED`] frames, in the order of their numbers.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct RecentFrames {
    entries: VecDeque<(Sequence, u64)>,
}

impl RecentFrames {
    /// Remembers a frame whose number is above all before.
    pub(crate) fn remember(&mut self, sequence: Sequence, bytes: &[u8]) {
        if self.entries.len() == REMEMBERED {
            self.entries.pop_front();
        }
        self.entries.push_back((sequence, xxh3_64(bytes)));
    }

    /// Compares a frame with what is remembered under its number.
    pub(crate) fn recall(&self, sequence: Sequence, bytes: &[u8]) -> Recollection {
        match self.entries.binary_search_by_key(&sequence, |entry| entry.0) {
            Ok(index) if self.entries[index].1 == xxh3_64(bytes) => Recollection::Same,
            Ok(_) => Recollection::Other,
            Err(_) => Recollection::Unknown,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_newest_frames_are_remembered_and_older_ones_forgotten() {
        let mut recent = RecentFrames::default();
        for number in 1..=300_u64 {
            recent.remember(Sequence(number), &number.to_le_bytes());
        }
        let recall = |number: u64, content: u64| recent.recall(Sequence(number), &content.to_le_bytes());
        assert_eq!(recall(300, 300), Recollection::Same);
        assert_eq!(recall(45, 45), Recollection::Same);
        assert_eq!(recall(300, 299), Recollection::Other);
        assert_eq!(recall(44, 44), Recollection::Unknown);
    }
}
