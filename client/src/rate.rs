//! How often things happen, for the window's and the browser's numbers.

use std::collections::VecDeque;
use std::time::Duration;

/// Over how long a rate is taken: short enough to follow, long enough to read.
const WINDOW: Duration = Duration::from_secs(2);
/// Readings lie this far apart, so that a flood keeps no long list.
const STEP: Duration = Duration::from_millis(50);

/// The rate at which something grows. Times are since any moment that stays the same.
#[derive(Debug, Clone, Default)]
pub(crate) struct Rate {
    /// When, and how much there was then: at most one every [`STEP`], so at most 41.
    readings: VecDeque<(Duration, f64)>,
    /// How much there is.
    total: f64,
}

impl Rate {
    /// Reads a counter.
    #[cfg_attr(target_arch = "wasm32", allow(dead_code, reason = "the page counts by itself"))]
    pub(crate) fn note(&mut self, now: Duration, total: f64) {
        // A counter or a clock that went back belongs to something new.
        if total < self.total || self.readings.back().is_some_and(|&(at, _)| now < at) {
            self.readings.clear();
        }
        self.total = total;
        while self.readings.front().is_some_and(|&(at, _)| now.saturating_sub(at) > WINDOW) {
            self.readings.pop_front();
        }
        if self.readings.back().is_none_or(|&(at, _)| now.saturating_sub(at) >= STEP) {
            self.readings.push_back((now, total));
        }
    }

    /// Counts `amount` more.
    #[cfg_attr(not(target_arch = "wasm32"), allow(dead_code, reason = "the link counts by itself"))]
    pub(crate) fn add(&mut self, now: Duration, amount: f64) {
        self.note(now, self.total + amount);
    }

    /// How much came a second, of late; 0 until there are two moments to tell it from.
    pub(crate) fn per_second(&self, now: Duration) -> f64 {
        let oldest = self.readings.iter().find(|&&(at, _)| now.saturating_sub(at) <= WINDOW);
        match oldest {
            Some(&(at, before)) if now > at => (self.total - before) / (now - at).as_secs_f64(),
            _ => 0.0,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rate_is_that_of_the_last_two_seconds() {
        let mut rate = Rate::default();
        assert_eq!(rate.per_second(Duration::ZERO), 0.0);
        let mut now = Duration::ZERO;
        for k in 0..500_u32 {
            // 25 a second for 10 s, then nothing.
            now = Duration::from_millis(40 * u64::from(k));
            rate.note(now, f64::from(k.min(250)));
            if k == 250 {
                assert!((rate.per_second(now) - 25.0).abs() < 0.1, "{}", rate.per_second(now));
            }
        }
        assert_eq!(rate.per_second(now), 0.0);
        assert!(rate.readings.len() <= 41);
        rate.note(Duration::from_secs(21), 3.0);
        assert_eq!(rate.readings.len(), 1, "the counter began anew");
        rate.note(Duration::from_secs(5), 4.0);
        assert_eq!(rate.readings.len(), 1, "the clock went back");
    }

    #[test]
    fn what_is_counted_piece_by_piece_fades_when_nothing_comes_any_more() {
        let mut rate = Rate::default();
        for k in 0..100 {
            rate.add(Duration::from_millis(10 * k), 3.0);
        }
        assert!((rate.per_second(Duration::from_millis(990)) - 300.0).abs() < 1.0);
        assert!(rate.per_second(Duration::from_millis(2500)) < 300.0);
        assert_eq!(rate.per_second(Duration::from_secs(4)), 0.0);
    }
}
