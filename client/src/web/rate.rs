//! How much comes in a second.

use std::collections::VecDeque;

/// Over how long, milliseconds: short enough to follow, long enough to read.
const WINDOW_MS: f64 = 2000.0;
/// Amounts are gathered over this long, so that a flood keeps no long list.
const STEP_MS: f64 = 50.0;

/// The rate at which something comes, over the last two seconds.
#[derive(Debug, Default)]
pub(super) struct Rate {
    /// Start of a step and what came in it; at most 41.
    steps: VecDeque<(f64, f64)>,
}

impl Rate {
    pub fn add(&mut self, now_ms: f64, amount: f64) {
        self.forget(now_ms);
        match self.steps.back_mut() {
            Some((at, sum)) if now_ms - *at < STEP_MS => *sum += amount,
            _ => self.steps.push_back((now_ms, amount)),
        }
    }

    pub fn per_second(&mut self, now_ms: f64) -> f64 {
        self.forget(now_ms);
        let sum: f64 = self.steps.iter().map(|(_, sum)| sum).sum();
        let since = self.steps.front().map_or(WINDOW_MS, |(at, _)| (now_ms - at).max(500.0));
        sum * 1000.0 / since
    }

    fn forget(&mut self, now_ms: f64) {
        // A clock that went back means a fresh start.
        while self.steps.front().is_some_and(|(at, _)| !(0.0..=WINDOW_MS).contains(&(now_ms - at))) {
            self.steps.pop_front();
        }
    }
}
