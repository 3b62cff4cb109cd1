//! Which lanes run near a place: k-d trees over the control points of each lane, in blocks.
//!
//! A lane is cut into blocks of `BLOCK` knots; each block has a `kiddo` tree of its own, which is rebuilt only when a
//! control point of it was added or moved by more than [`STALE_M`], and is listed in the cells of a coarse grid. A query
//! costs what is near, not what the map holds. It may miss by [`STALE_M`], which the caller's radius allows for.
//!
//! A block that no frame touched for a long way is let go ([`LaneIndex::forget_touched_before`]): by odometry alone a vehicle that
//! comes back does not find its old lanes where they were, and a street beside is taken for them.

use std::{
    collections::{BTreeMap, BTreeSet},
    sync::Arc,
};

use kiddo::{ImmutableKdTree, SquaredEuclidean};
use nalgebra::Point3;
use serde::{Deserialize, Serialize};

use super::information::{BandedInformation, Knot};
use crate::lane_map::LaneId;

/// Knots per block: about 100 m of road.
const BLOCK: Knot = 32;
/// How far an indexed control point may have moved before its block is rebuilt, metres.
pub const STALE_M: f64 = 0.5;
/// Side of a grid cell, metres.
const CELL_M: f64 = 64.0;

type Cell = (i64, i64);
type Key = (LaneId, i64);

/// Control points of all lanes by place.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(from = "StoredIndex", into = "StoredIndex")]
pub struct LaneIndex {
    blocks: BTreeMap<Key, Block>,
    cells: BTreeMap<Cell, BTreeSet<Key>>,
    /// Blocks by when they were touched last.
    by_touch: BTreeSet<(Touch, Key)>,
}

/// Way of the vehicle when a block was touched last, in steps of [`TOUCH_STEP_M`].
type Touch = u64;
/// Metres.
const TOUCH_STEP_M: f64 = 16.0;

#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)] // a way is not negative, and far below 2^53 steps
fn touch_at(way_m: f64) -> Touch {
    (way_m / TOUCH_STEP_M) as Touch
}

/// Control points of one lane as they were when the block was last built.
#[derive(Clone, Debug)]
struct Block {
    first: Knot,
    touch: Touch,
    points: Vec<[f64; 3]>,
    tree: Option<Arc<ImmutableKdTree<f64, 3>>>,
}

impl Block {
    fn new(first: Knot, touch: Touch, points: Vec<[f64; 3]>) -> Self {
        // A tree over points that are finite cannot fail; without one the block is just not found.
        let tree = ImmutableKdTree::new_from_slice(&points).ok().map(Arc::new);
        Self { first, touch, points, tree }
    }

    fn is_stale(&self, first: Knot, points: &[[f64; 3]]) -> bool {
        let moved = |(old, new): (&[f64; 3], &[f64; 3])| {
            old.iter().zip(new).map(|(a, b)| (a - b) * (a - b)).sum::<f64>() > STALE_M * STALE_M
        };
        self.first != first || self.points.len() != points.len() || self.points.iter().zip(points).any(moved)
    }
}

/// What a snapshot keeps: the trees and the grid are made anew from the same points.
#[derive(Clone, Debug, Serialize, Deserialize)]
struct StoredIndex {
    blocks: Vec<(Key, Knot, Touch, Vec<[f64; 3]>)>,
}

impl From<LaneIndex> for StoredIndex {
    fn from(index: LaneIndex) -> Self {
        let blocks = index.blocks.into_iter();
        Self { blocks: blocks.map(|(key, block)| (key, block.first, block.touch, block.points)).collect() }
    }
}

impl From<StoredIndex> for LaneIndex {
    fn from(stored: StoredIndex) -> Self {
        let mut index = Self::default();
        for (key, first, touch, points) in stored.blocks {
            index.put(key, Block::new(first, touch, points));
        }
        index
    }
}

/// A run of knots of one lane near a place.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct NearbyRun {
    /// The lane.
    pub lane: LaneId,
    /// First knot within the radius.
    pub first: Knot,
    /// Last knot within the radius.
    pub last: Knot,
}

#[allow(clippy::cast_possible_truncation)] // positions are bounded by the frame limits
fn cell_of(coordinate: f64) -> i64 {
    (coordinate / CELL_M).floor() as i64
}

impl LaneIndex {
    /// Brings the blocks of a lane up to date for its knots from `first` to `last`, those that a frame touched after so much
    /// way.
    pub fn update<const W: usize>(
        &mut self,
        lane: LaneId,
        information: &BandedInformation<W>,
        first: Knot,
        last: Knot,
        way_m: f64,
    ) {
        let touch = touch_at(way_m);
        for block in first.div_euclid(BLOCK)..=last.div_euclid(BLOCK) {
            let (first, points) = block_points(information, block);
            let key = (lane, block);
            match self.blocks.get_mut(&key) {
                Some(old) if !old.is_stale(first, &points) => {
                    if old.touch != touch {
                        self.by_touch.remove(&(old.touch, key));
                        self.by_touch.insert((touch, key));
                        old.touch = touch;
                    }
                }
                _ => {
                    self.take(&key);
                    self.put(key, Block::new(first, touch, points));
                }
            }
        }
    }

    /// Forgets a lane.
    pub fn remove(&mut self, lane: LaneId) {
        let keys: Vec<Key> = self.blocks.range((lane, i64::MIN)..=(lane, i64::MAX)).map(|(key, _)| *key).collect();
        for key in keys {
            self.take(&key);
        }
    }

    /// Lets go of blocks that no frame touched since the vehicle had come so far.
    pub fn forget_touched_before(&mut self, way_m: f64) {
        let limit = touch_at(way_m);
        while let Some((touch, key)) = self.by_touch.first().copied() {
            if touch >= limit {
                break;
            }
            self.take(&key);
        }
    }

    fn put(&mut self, key: Key, block: Block) {
        self.by_touch.insert((block.touch, key));
        for point in &block.points {
            self.cells.entry((cell_of(point[0]), cell_of(point[1]))).or_default().insert(key);
        }
        self.blocks.insert(key, block);
    }

    fn take(&mut self, key: &Key) {
        let Some(block) = self.blocks.remove(key) else { return };
        self.by_touch.remove(&(block.touch, *key));
        for point in &block.points {
            let cell = (cell_of(point[0]), cell_of(point[1]));
            if let Some(keys) = self.cells.get_mut(&cell) {
                keys.remove(key);
                if keys.is_empty() {
                    self.cells.remove(&cell);
                }
            }
        }
    }

    /// Lanes with a control point within `radius_m` of a place, in the order of their ids, and where they are near.
    #[must_use]
    pub fn within(&self, place: &Point3<f64>, radius_m: f64) -> Vec<NearbyRun> {
        let mut keys = BTreeSet::new();
        for x in cell_of(place.x - radius_m)..=cell_of(place.x + radius_m) {
            for y in cell_of(place.y - radius_m)..=cell_of(place.y + radius_m) {
                keys.extend(self.cells.get(&(x, y)).into_iter().flatten().copied());
            }
        }
        let mut runs: Vec<NearbyRun> = Vec::new();
        for key in keys {
            let Some((first, last)) = self.blocks.get(&key).and_then(|block| near_in_block(block, place, radius_m))
            else {
                continue;
            };
            match runs.last_mut() {
                Some(run) if run.lane == key.0 => run.last = last,
                _ => runs.push(NearbyRun { lane: key.0, first, last }),
            }
        }
        runs
    }
}

/// First and last knot of a block within the radius.
fn near_in_block(block: &Block, place: &Point3<f64>, radius_m: f64) -> Option<(Knot, Knot)> {
    let tree = block.tree.as_ref()?;
    let query = [place.x, place.y, place.z];
    let found = tree.query(&query).within::<SquaredEuclidean<f64>>(radius_m * radius_m).unsorted().execute();
    let (mut low, mut high) = (Knot::MAX, Knot::MIN);
    for neighbour in found {
        let knot = block.first + Knot::from(neighbour.item);
        low = low.min(knot);
        high = high.max(knot);
    }
    (low <= high).then_some((low, high))
}

/// First knot and positions of the control points of one block.
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, clippy::cast_possible_wrap)] // clamped to the lane
fn block_points<const W: usize>(information: &BandedInformation<W>, block: i64) -> (Knot, Vec<[f64; 3]>) {
    let head = information.head();
    let tail = head + information.len() as Knot - 1;
    let (first, last) = ((block * BLOCK).max(head), (block * BLOCK + BLOCK - 1).min(tail));
    let positions = information.positions();
    let points = (first..=last).map(|knot| positions[(knot - head) as usize].coords.into()).collect();
    (first, points)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn straight(y: f64, count: i32) -> BandedInformation<4> {
        let mut lane = BandedInformation::new(Point3::new(0.0, y, 0.0));
        (0..count).for_each(|k| lane.push_tail(Point3::new(3.0 * f64::from(k), y, 0.0)));
        lane
    }

    fn two_lanes() -> LaneIndex {
        let mut index = LaneIndex::default();
        index.update(LaneId(1), &straight(0.0, 200), 0, 199, 0.0);
        index.update(LaneId(2), &straight(100.0, 200), 0, 199, 0.0);
        index
    }

    proptest! {
        #[test]
        fn the_index_finds_what_a_scan_finds(x in -50.0..650.0f64, y in -40.0..140.0f64, radius in 1.0..90.0f64) {
            let place = Point3::new(x, y, 0.0);
            let lanes = [(LaneId(1), straight(0.0, 200)), (LaneId(2), straight(100.0, 200))];
            let scanned: Vec<NearbyRun> = lanes.iter().filter_map(|(lane, information)| {
                let near: Vec<Knot> = (0..200).filter(|k| (information.positions()[usize::try_from(*k).unwrap()] - place).norm() <= radius).collect();
                Some(NearbyRun { lane: *lane, first: *near.first()?, last: *near.last()? })
            }).collect();
            prop_assert_eq!(two_lanes().within(&place, radius), scanned);
        }
    }

    #[test]
    fn blocks_that_no_frame_touched_for_long_are_no_longer_found_and_the_rest_of_their_lane_is() {
        let mut index = two_lanes();
        let lane = straight(0.0, 200);
        index.update(LaneId(1), &lane, 150, 199, 500.0);
        index.forget_touched_before(200.0);
        assert!(index.within(&Point3::new(60.0, 0.0, 0.0), 20.0).is_empty());
        assert!(index.within(&Point3::new(300.0, 100.0, 0.0), 20.0).is_empty());
        assert_eq!(index.within(&Point3::new(540.0, 0.0, 0.0), 20.0).len(), 1);
        index.forget_touched_before(600.0);
        assert!(index.blocks.is_empty() && index.cells.is_empty() && index.by_touch.is_empty());
    }

    #[test]
    fn a_removed_lane_is_not_found_and_a_moved_one_is_found_where_it_went() {
        let mut index = two_lanes();
        index.remove(LaneId(1));
        assert!(index.within(&Point3::new(300.0, 0.0, 0.0), 20.0).is_empty());
        index.update(LaneId(2), &straight(5.0, 200), 0, 199, 0.0);
        assert_eq!(index.within(&Point3::new(300.0, 0.0, 0.0), 20.0).len(), 1);
        assert!(index.within(&Point3::new(300.0, 100.0, 0.0), 20.0).is_empty());
    }
}
