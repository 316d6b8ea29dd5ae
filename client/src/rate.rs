//! How often things happen.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

/// Over how long a rate is taken: short enough to follow, long enough to read.
const WINDOW: Duration = Duration::from_secs(2);

/// The rate at which a counter grows.
#[derive(Debug, Clone, Default)]
pub(crate) struct Rate {
    /// At most one reading every 50 ms, so at most 41.
    readings: VecDeque<(Instant, u64)>,
}

impl Rate {
    /// Reads the counter.
    pub(crate) fn note(&mut self, now: Instant, count: u64) {
        // A counter that went back belongs to something new.
        if self.readings.back().is_some_and(|&(_, before)| count < before) {
            self.readings.clear();
        }
        if self.readings.back().is_some_and(|&(at, _)| now.saturating_duration_since(at) < Duration::from_millis(50)) {
            return;
        }
        while self.readings.front().is_some_and(|&(at, _)| now.saturating_duration_since(at) > WINDOW) {
            self.readings.pop_front();
        }
        self.readings.push_back((now, count));
    }

    /// Counts a second; 0 until two readings lie apart.
    pub(crate) fn per_second(&self) -> f64 {
        match (self.readings.front(), self.readings.back()) {
            (Some(&(from, before)), Some(&(to, after))) if to > from => (after - before) as f64 / (to - from).as_secs_f64(),
            _ => 0.0,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rate_is_that_of_the_last_two_seconds() {
        let (mut rate, start) = (Rate::default(), Instant::now());
        assert_eq!(rate.per_second(), 0.0);
        for k in 0..500_u64 {
            // 25 a second for 10 s, then nothing.
            rate.note(start + Duration::from_millis(40 * k), k.min(250));
            if k == 250 {
                assert!((rate.per_second() - 25.0).abs() < 0.1, "{}", rate.per_second());
            }
        }
        assert_eq!(rate.per_second(), 0.0);
        assert!(rate.readings.len() <= 41);
        rate.note(start + Duration::from_secs(21), 3);
        assert_eq!(rate.readings.len(), 1, "the counter began anew");
    }
}
