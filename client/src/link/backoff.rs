//! How long to wait before the next attempt.

use std::hash::{BuildHasher, RandomState};
use std::time::Duration;

/// First pause: a server that was restarted by hand is back by then.
const FIRST: Duration = Duration::from_millis(250);
/// Longest pause: what somebody before the screen still waits.
const LONGEST: Duration = Duration::from_secs(5);
/// A connection that stood this long was a good one; the pauses begin anew.
const GOOD_AFTER: Duration = Duration::from_secs(3);

/// Doubling pauses, each shortened by up to half at random so that a thousand viewers do not come back in one instant.
#[derive(Debug)]
pub(super) struct Backoff {
    failures: u32,
    random: RandomState,
}

impl Backoff {
    pub(super) fn new() -> Self {
        Self { failures: 0, random: RandomState::new() }
    }

    /// The pause after an attempt that ended after `lasted`.
    pub(super) fn next_pause(&mut self, lasted: Duration) -> Duration {
        if lasted >= GOOD_AFTER {
            self.failures = 0;
        }
        let pause = FIRST.saturating_mul(1 << self.failures.min(8)).min(LONGEST);
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
        let (mut a, mut b) = (Backoff::new(), Backoff::new());
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
        let mut backoff = Backoff::new();
        for _ in 0..6 {
            backoff.next_pause(Duration::from_secs(1));
        }
        assert!(backoff.next_pause(Duration::from_secs(1)) >= LONGEST / 2);
        assert!(backoff.next_pause(GOOD_AFTER) <= FIRST);
    }
}
