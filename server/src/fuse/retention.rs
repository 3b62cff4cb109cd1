//! Which replaced versions of a cell are kept: the newest ones all, and of those before ever fewer the older they are.
//!
//! Whoever follows the map asks for what changed since a version a moment ago: the newest [`RECENT`] are all there.
//! Whoever looks back asks what the map was an hour ago, and gets one version near that time: of the older ones that one is
//! let go of first whose going leaves the smallest gap between its neighbours, measured against its age. A cell that
//! changes ten times a second so keeps a past as long as one that changes once a minute.

/// The newest versions, all of which are kept while they are young enough.
const RECENT: usize = 64;

/// The versions, of `versions` (each with the time of its publication, milliseconds, the oldest first), that are not kept
/// once another comes: those replaced before `since_ms`, and as many more as make place for it among at most `most`.
pub(super) fn outdated(versions: &[(u64, u64)], most: usize, since_ms: u64, now_ms: u64) -> Vec<u64> {
    let replaced_ms = versions.iter().skip(1).map(|(_, published_ms)| *published_ms).chain([u64::MAX]);
    let is_old = |(_, replaced_ms): &(&(u64, u64), u64)| *replaced_ms < since_ms;
    let (old, mut kept): (Vec<_>, Vec<_>) = versions.iter().zip(replaced_ms).partition(is_old);
    let mut outdated: Vec<u64> = old.into_iter().map(|((version, _), _)| *version).collect();
    while kept.len() >= most.max(1) {
        let (version, _) = kept.remove(least_missed(&kept.iter().map(|(at, _)| at.1).collect::<Vec<_>>(), now_ms));
        outdated.push(version.0);
    }
    outdated.sort_unstable();
    outdated
}

/// The one whose going leaves the smallest gap for its age, of those that are not recent; else the oldest.
fn least_missed(published_ms: &[u64], now_ms: u64) -> usize {
    let older = published_ms.len().saturating_sub(RECENT);
    let gap = |index: usize| {
        let [before, at, after] = [index - 1, index, index + 1].map(|index| published_ms[index]);
        after.saturating_sub(before) as f64 / (now_ms.saturating_sub(at) + 1) as f64
    };
    (1..older).min_by(|one, other| gap(*one).total_cmp(&gap(*other))).unwrap_or(0)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// What is kept of a cell that gets a version every 500 ms, for so long.
    fn after(seconds: u64, most: usize, kept_s: u64) -> Vec<(u64, u64)> {
        let mut kept: Vec<(u64, u64)> = Vec::new();
        for number in 1..=seconds * 2 {
            let now_ms = number * 500;
            let gone = outdated(&kept, most, now_ms.saturating_sub(kept_s * 1_000), now_ms);
            kept.retain(|(version, _)| !gone.contains(version));
            kept.push((number, now_ms));
            assert!(kept.len() <= most);
        }
        kept
    }

    #[test]
    fn a_busy_cell_keeps_its_newest_versions_and_a_past_that_thins_out() {
        let kept = after(1_800, 128, 3_600);
        let newest = 3_600;
        let recent: Vec<u64> = kept.iter().rev().take(RECENT).map(|(version, _)| *version).collect();
        assert_eq!(recent, (newest - RECENT as u64 + 1..=newest).rev().collect::<Vec<_>>());
        assert_eq!(kept[0].0, 1, "the beginning is still there");
        for ago_s in [60, 300, 900, 1_500] {
            let wanted = 1_800_000 - ago_s * 1_000;
            let nearest = kept.iter().map(|(_, at)| at.abs_diff(wanted)).min().unwrap();
            assert!(nearest <= ago_s * 100, "{ago_s} s ago: {nearest} ms away");
        }
    }

    #[test]
    fn what_was_replaced_too_long_ago_is_let_go_of_and_the_one_that_held_then_is_not() {
        let kept = after(100, 1_000, 10);
        assert_eq!(kept.first(), Some(&(179, 89_500)));
        assert_eq!(kept.len(), 22);
    }
}
