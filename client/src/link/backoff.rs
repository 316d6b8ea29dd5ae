//! How long to wait before the next attempt.

use std::hash::{BuildHasher, RandomState};
use std::time::Duration;

/// First pause before another connection: a server that was restarted by hand is back by then.
const FIRST: Duration = Duration::from_millis(250);
/// Longest pause before another connection: what somebody before the screen still waits.
const LONGEST: Duration = Duration::from_secs(5);
/// First pause after a character that could not be had: the next attempt may load another 64 MB.
const FIRST_FETCH: Duration = Duration::from_secs(5);
/// Longest pause after characters that could not be had.
const LONGEST_FETCH: Duration = Duration::from_secs(300);
/// A connection that stood this long was a good one; the pauses begin anew.
const GOOD_AFTER: Duration = Duration::from_secs(3);

/// Doubling pauses, each shortened by up to half at random so that a thousand viewers do not come back in one instant.
#[derive(Debug)]
pub(super) struct Backoff {
    first: Duration,
    longest: Duration,
    failures: u32,
    random: RandomState,
}

impl Backoff {
    /// Between connections.
    pub(super) fn of_connections() -> Self {
        Self { first: FIRST, longest: LONGEST, failures: 0, random: RandomState::new() }
    }

    /// Between attempts to fetch a character.
    pub(super) fn of_fetches() -> Self {
        Self { first: FIRST_FETCH, longest: LONGEST_FETCH, ..Self::of_connections() }
    }

    /// The pause after an attempt that ended after `lasted`.
    pub(super) fn next_pause(&mut self, lasted: Duration) -> Duration {
        if lasted >= GOOD_AFTER {
            self.failures = 0;
        }
        let pause = self.first.saturating_mul(1 << self.failures.min(8)).min(self.longest);
        self.failures = self.failures.saturating_add(1);
        let share = self.random.hash_one(self.failures) as u32 as f64 / f64::from(u32::MAX);
        pause.mul_f64(1.0 - 0.5 * share)
    }

    /// Attempts that failed in a row.
    pub(super) fn failures(&self) -> u32 {
        self.failures
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pauses_double_up_to_five_seconds_and_differ_between_viewers() {
        let (mut a, mut b) = (Backoff::of_connections(), Backoff::of_connections());
        let mut differ = false;
        for k in 0..40 {
            let full = FIRST.saturating_mul(1 << k.min(8)).min(LONGEST);
            let (pause, other) = (a.next_pause(Duration::ZERO), b.next_pause(Duration::ZERO));
            assert!(pause <= full && pause >= full / 2, "{pause:?} of {full:?}");
            differ |= pause != other;
        }
        assert!(differ);
        assert_eq!(a.failures(), 40);
    }

    #[test]
    fn good_connection_begins_anew_and_a_short_one_does_not() {
        let mut backoff = Backoff::of_connections();
        for _ in 0..6 {
            backoff.next_pause(Duration::from_secs(1));
        }
        assert!(backoff.next_pause(Duration::from_secs(1)) >= LONGEST / 2);
        assert!(backoff.next_pause(GOOD_AFTER) <= FIRST);
    }

    #[test]
    fn fetches_wait_seconds_at_first_and_minutes_in_the_end() {
        let mut backoff = Backoff::of_fetches();
        let pauses: Vec<Duration> = (0..12).map(|_| backoff.next_pause(Duration::ZERO)).collect();
        assert!(pauses[0] >= FIRST_FETCH / 2 && pauses[0] <= FIRST_FETCH, "{pauses:?}");
        assert!(pauses[11] >= LONGEST_FETCH / 2 && pauses[11] <= LONGEST_FETCH, "{pauses:?}");
    }
}
