//! Ids of an OSM file: positive, and the same for the same names.

use std::collections::HashSet;

use xxhash_rust::xxh3::xxh3_64;

/// Ids are below 2^53, so that they survive programs that read numbers as doubles.
const BITS: u32 = 53;

/// Ids that are given; nodes, ways and relations have them together, as Lanelet2 wants it.
#[derive(Default)]
pub(super) struct Ids(HashSet<u64>);

impl Ids {
    /// The id of a name: its hash, or the next number that nobody has.
    pub(super) fn next(&mut self, name: &str) -> u64 {
        let mut id = (xxh3_64(name.as_bytes()) >> (64 - BITS)).max(1);
        while !self.0.insert(id) {
            id = if id + 1 < 1 << BITS { id + 1 } else { 1 };
        }
        id
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_same_name_twice_has_two_ids_and_the_first_is_the_same_in_every_file() {
        let mut ids = Ids::default();
        let (first, second) = (ids.next("a"), ids.next("a"));
        assert_ne!(first, second);
        assert_eq!(Ids::default().next("a"), first);
        assert!(first > 0 && first < 1 << 53);
    }
}
