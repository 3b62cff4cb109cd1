//! How a broken connection is tried again.

use std::time::Duration;

use rand::Rng;

/// How often, and for how long, a broken connection is tried again.
///
/// The pause doubles from try to try, up to the longest. Each is drawn at random between half of that and all of it, so
/// that a fleet that lost one server does not come back in one moment. Where the service said how long to wait
/// (`RetryInfo`), the pause is at least that long.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Reconnect {
    /// Tries without any progress before the session fails; 0: a broken connection ends the session.
    pub max_tries: u32,
    /// Pause before the first try.
    pub first_pause: Duration,
    /// Longest pause.
    pub longest_pause: Duration,
}

impl Default for Reconnect {
    /// Ten tries: about half a minute.
    fn default() -> Self {
        Self { max_tries: 10, first_pause: Duration::from_millis(100), longest_pause: Duration::from_secs(5) }
    }
}

impl Reconnect {
    /// For ever, with pauses of up to half a minute: what a vehicle with a spool wants.
    #[must_use]
    pub fn forever() -> Self {
        Self { max_tries: u32::MAX, longest_pause: Duration::from_secs(30), ..Self::default() }
    }

    /// The pause before the try after `tries` that failed.
    pub(crate) fn pause(&self, tries: u32, retry_after: Option<Duration>, random: &mut impl Rng) -> Duration {
        let longest = self.first_pause.saturating_mul(1 << tries.min(16)).min(self.longest_pause);
        let jittered = longest.mul_f64(random.random_range(0.5..=1.0));
        match retry_after {
            // A little later than asked, so that not all come at once.
            Some(asked) if asked > jittered => asked + longest.mul_f64(random.random_range(0.0..=0.5)),
            _ => jittered,
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    use super::*;

    proptest! {
        #[test]
        fn a_pause_lies_between_half_its_bound_and_all_of_it(tries in 0..40u32, seed in any::<u64>()) {
            let reconnect = Reconnect::default();
            let pause = reconnect.pause(tries, None, &mut ChaCha8Rng::seed_from_u64(seed));
            let bound = Duration::from_millis(100 << tries.min(16)).min(Duration::from_secs(5));
            prop_assert!(pause >= bound / 2 && pause <= bound, "{pause:?} of {bound:?}");
        }

        #[test]
        fn a_service_that_asks_for_time_gets_it(asked_ms in 0..120_000u64, tries in 0..40u32, seed in any::<u64>()) {
            let asked = Duration::from_millis(asked_ms);
            let pause = Reconnect::default().pause(tries, Some(asked), &mut ChaCha8Rng::seed_from_u64(seed));
            prop_assert!(pause >= asked && pause <= asked.max(Duration::from_secs(5)) + Duration::from_secs(3));
        }
    }

    #[test]
    fn two_vehicles_do_not_pause_alike() {
        let pause = |seed| Reconnect::default().pause(6, None, &mut ChaCha8Rng::seed_from_u64(seed));
        assert_ne!(pause(1), pause(2));
    }
}
