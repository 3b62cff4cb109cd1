//! The features of one collection in one version of one cell: as they are written, and what is needed to choose among them.
//!
//! Coordinates are kept as they are written (degrees to 7 decimals, heights to millimetres), as whole numbers, so that what
//! a box is compared with is exactly what a reader sees.

use std::sync::Arc;

use lanemap_core::{TimestampNs, fleet::CellId};
use lanemap_proto::v1;

use super::{datetime::Interval, filters::Filtered, item_query::ItemQuery};
use crate::serve::{bounds::Bounds, line::Coordinate};

/// A coordinate, 1e-7 degrees and millimetres.
type Written = [i32; 3];

/// The features of a cell.
#[derive(Debug)]
pub(in crate::serve) struct CellFeatures {
    pub(in crate::serve) cell: CellId,
    pub(in crate::serve) map: Arc<v1::CellMap>,
    entries: Vec<Entry>,
    coordinates: Vec<Written>,
    text: Vec<u8>,
    /// Writes a feature, where that is cheaper than to keep it.
    write: Option<WriteFeature>,
    /// Whether features are all that lies in their boxes, at any height, and not the lines of their coordinates.
    are_boxes: bool,
}

/// Writes the feature at a coordinate of a lane.
pub(super) type WriteFeature = fn(&CellFeatures, &Entry, Coordinate) -> Vec<u8>;

/// What is known of a feature.
#[derive(Clone, Copy, Debug)]
pub(in crate::serve) struct Entry {
    /// Index of its lane within the cell.
    pub(in crate::serve) lane: usize,
    /// Index within the lane.
    pub(in crate::serve) within: usize,
    filtered: Filtered,
    /// First and last time at which it was seen, where it ever was.
    seen: Option<(TimestampNs, TimestampNs)>,
    low: Written,
    high: Written,
    coordinates_end: usize,
    text_end: usize,
}

/// A feature on its way in.
pub(super) struct NewFeature<'a> {
    pub(super) lane: usize,
    pub(super) within: usize,
    pub(super) filtered: Filtered,
    pub(super) seen: Option<(TimestampNs, TimestampNs)>,
    pub(super) coordinates: &'a [Coordinate],
    pub(super) text: Vec<u8>,
}

impl CellFeatures {
    pub(super) fn new(cell: CellId, map: Arc<v1::CellMap>, write: Option<WriteFeature>) -> Self {
        Self { cell, map, entries: vec![], coordinates: vec![], text: vec![], write, are_boxes: false }
    }

    /// The same of features that are all that lies in their boxes.
    pub(super) fn filled(self) -> Self {
        Self { are_boxes: true, ..self }
    }

    pub(super) fn push(&mut self, feature: NewFeature<'_>) {
        self.coordinates.extend(feature.coordinates.iter().map(whole));
        self.text.extend(feature.text);
        let start = self.entries.last().map_or(0, |last| last.coordinates_end);
        let (mut low, mut high) = ([i32::MAX; 3], [i32::MIN; 3]);
        for coordinate in &self.coordinates[start..] {
            for axis in 0..3 {
                low[axis] = low[axis].min(coordinate[axis]);
                high[axis] = high[axis].max(coordinate[axis]);
            }
        }
        self.entries.push(Entry {
            lane: feature.lane,
            within: feature.within,
            filtered: feature.filtered,
            seen: feature.seen,
            low,
            high,
            coordinates_end: self.coordinates.len(),
            text_end: self.text.len(),
        });
    }

    pub(in crate::serve) fn len(&self) -> usize {
        self.entries.len()
    }

    pub(in crate::serve) fn entries(&self) -> &[Entry] {
        &self.entries
    }

    /// Number of coordinates of a feature.
    pub(in crate::serve) fn size(&self, index: usize) -> usize {
        self.coordinates(index).len()
    }

    /// Whether a feature is wanted.
    pub(in crate::serve) fn is_wanted(&self, index: usize, query: &ItemQuery) -> bool {
        let entry = &self.entries[index];
        query.filters.pass(&entry.filtered)
            && query
                .filters
                .lane
                .as_ref()
                .is_none_or(|lane| self.map.lanes.get(entry.lane).is_some_and(|of| of.id == *lane))
            && query.interval.is_none_or(|interval| was_seen(entry, &interval))
            && query.bounds.is_none_or(|bounds| self.enters(index, &bounds))
    }

    /// Number of features that are wanted.
    pub(in crate::serve) fn count(&self, query: &ItemQuery) -> usize {
        if query.is_of_all() {
            return self.len();
        }
        (0..self.len()).filter(|index| self.is_wanted(*index, query)).count()
    }

    /// Appends a feature as it is written.
    pub(in crate::serve) fn write(&self, index: usize, out: &mut Vec<u8>) {
        let entry = &self.entries[index];
        match (self.write, self.coordinates(index).first()) {
            (Some(write), Some(at)) => out.extend(write(self, entry, degrees(at))),
            _ => out.extend(&self.text[self.start(index, |entry| entry.text_end)..entry.text_end]),
        }
    }

    /// Bytes that it takes in memory.
    pub(in crate::serve) fn memory_bytes(&self) -> usize {
        // The map is shared with the map's own cache as a rule, and not always.
        let map: usize = self.map.lanes.iter().map(|lane| 256 + 32 * lane.lateral_sigma_mm.len()).sum();
        size_of::<Self>()
            + map
            + self.text.len()
            + size_of::<Written>() * self.coordinates.len()
            + size_of::<Entry>() * self.entries.len()
    }

    fn start(&self, index: usize, end: impl Fn(&Entry) -> usize) -> usize {
        index.checked_sub(1).map_or(0, |before| end(&self.entries[before]))
    }

    fn coordinates(&self, index: usize) -> &[Written] {
        &self.coordinates[self.start(index, |entry| entry.coordinates_end)..self.entries[index].coordinates_end]
    }

    fn enters(&self, index: usize, bounds: &Bounds) -> bool {
        let entry = &self.entries[index];
        let ([west, south, low], [east, north, high]) = (degrees(&entry.low), degrees(&entry.high));
        // A line over the antimeridian has coordinates at both ends of the earth; its box is then the whole belt.
        let around = Bounds { west, south, east, north, heights: None };
        if self.are_boxes {
            return around.touches(bounds);
        }
        if !around.touches(bounds) || bounds.heights.is_some_and(|(lowest, highest)| high < lowest || low > highest) {
            return false;
        }
        if bounds.holds(&around) {
            return true;
        }
        let plain = Bounds { heights: None, ..*bounds };
        let coordinates = self.coordinates(index);
        let first = coordinates.first().map(degrees);
        first.is_some_and(|first| plain.is_entered_by(&[first, first]))
            || coordinates.windows(2).any(|pair| {
                let pair = [degrees(&pair[0]), degrees(&pair[1])];
                // From one side of the antimeridian to the other: the line is cut here.
                let is_cut = (pair[0][0] - pair[1][0]).abs() > 180.0;
                !is_cut && plain.is_entered_by(&pair)
            })
    }

    /// The borders of all features, first and last time at which any was seen.
    pub(in crate::serve) fn bounds(&self) -> Option<Bounds> {
        let low = |axis: usize| self.entries.iter().map(|entry| entry.low[axis]).min();
        let high = |axis: usize| self.entries.iter().map(|entry| entry.high[axis]).max();
        let [west, south, _] = degrees(&[low(0)?, low(1)?, 0]);
        let [east, north, _] = degrees(&[high(0)?, high(1)?, 0]);
        Some(Bounds { west, south, east, north, heights: None })
    }

    /// First and last time at which any feature was seen.
    pub(in crate::serve) fn seen(&self) -> Option<(TimestampNs, TimestampNs)> {
        let seen = self.entries.iter().filter_map(|entry| entry.seen);
        seen.reduce(|(first, last), (from, to)| (first.min(from), last.max(to)))
    }
}

fn was_seen(entry: &Entry, interval: &Interval) -> bool {
    entry.seen.is_none_or(|(first, last)| interval.meets(first.0, last.0))
}

#[expect(
    clippy::cast_possible_truncation,
    reason = "180e7 is less than 2^31; the cast saturates beyond 2 147 km of height"
)]
fn whole(coordinate: &Coordinate) -> Written {
    [1e7, 1e7, 1e3].map({
        let mut axes = coordinate.iter();
        move |scale| (axes.next().unwrap_or(&0.0) * scale).round() as i32
    })
}

fn degrees(written: &Written) -> Coordinate {
    [f64::from(written[0]) / 1e7, f64::from(written[1]) / 1e7, f64::from(written[2]) / 1e3]
}
