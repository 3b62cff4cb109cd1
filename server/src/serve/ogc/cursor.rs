//! Where a page begins: opaque text for clients, who take it from the link `next` and from nowhere else.
//!
//! A walk through a collection of the shared map is pinned to the revision at which it began, so that its pages are one
//! map however it changes meanwhile, as long as the versions of its cells are kept; a walk through the drives is pinned to
//! the state in which they all were.

use base64::{Engine, engine::general_purpose::URL_SAFE_NO_PAD};
use lanemap_core::fleet::CellId;
use serde::{Deserialize, Serialize};

use crate::{fuse::MapRevision, session::SessionId};

/// What a cursor says.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(in crate::serve) enum Cursor {
    /// Within a collection of the shared map.
    Map(MapCursor),
    /// Within the drives.
    Drives(DriveCursor),
}

/// The first feature of the page, in a state of the map.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(in crate::serve) struct MapCursor {
    pub(in crate::serve) revision: MapRevision,
    pub(in crate::serve) cell: CellId,
    /// Index of the feature within its cell.
    pub(in crate::serve) index: u32,
    /// What was asked, hashed: the counts are of that.
    pub(in crate::serve) question: u64,
    /// Features on all pages, where they were counted.
    pub(in crate::serve) matched: Option<u64>,
}

/// The last lane of the page before, in a state of the drives.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub(in crate::serve) struct DriveCursor {
    /// The walk: see [`super::drive_walks`].
    pub(in crate::serve) walk: u64,
    pub(in crate::serve) session: [u8; 8],
    pub(in crate::serve) lane: u64,
}

impl DriveCursor {
    /// The place of a lane among those of all drives.
    pub(in crate::serve) fn at(walk: u64, session: SessionId, lane: u64) -> Self {
        Self { walk, session: session.to_key(), lane }
    }
}

impl Cursor {
    /// Its text: letters, digits, `-` and `_`.
    pub(in crate::serve) fn text(&self) -> String {
        URL_SAFE_NO_PAD.encode(postcard::to_stdvec(self).unwrap_or_default())
    }

    /// Reads its text.
    pub(in crate::serve) fn parse(text: &str) -> Result<Self, String> {
        let read = || {
            let bytes = URL_SAFE_NO_PAD.decode(text).ok()?;
            let (cursor, rest) = postcard::take_from_bytes::<Self>(&bytes).ok()?;
            let is_on_earth = match &cursor {
                Self::Map(at) => CellId::new(at.cell.x(), at.cell.y()).is_some(),
                Self::Drives(_) => true,
            };
            (rest.is_empty() && is_on_earth).then_some(cursor)
        };
        read().ok_or_else(|| "it must be taken from the link `next` of the page before".to_owned())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_cursor_survives_its_text_and_no_other_text_is_one() {
        let cell = CellId::new(8_718, 5_685).unwrap();
        let map = MapCursor { revision: MapRevision(7), cell, index: 300, question: u64::MAX, matched: Some(1_000) };
        for cursor in [Cursor::Map(map), Cursor::Drives(DriveCursor { walk: 3, session: [1; 8], lane: 9 })] {
            let text = cursor.text();
            assert!(text.chars().all(|letter| letter.is_ascii_alphanumeric() || "-_".contains(letter)), "{text}");
            assert_eq!(Cursor::parse(&text), Ok(cursor));
            assert!(Cursor::parse(&text[1..]).is_err() && Cursor::parse(&format!("{text}AAAA")).is_err());
        }
        assert!(Cursor::parse("").is_err() && Cursor::parse("14-1-1.x.0").is_err());
    }
}
