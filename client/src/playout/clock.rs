//! When a frame is shown: the moment on the sender's clock that belongs to a moment on the viewer's.

use std::collections::VecDeque;
use std::time::Duration;

/// How far back the fastest packet and the jitter are looked for, microseconds.
const WINDOW: i64 = 10_000_000;
/// Most measurements kept: 10 s of a 240 Hz tracker.
const MAX_TRANSITS: usize = 2400;
/// Send intervals whose median is taken: about a second.
const MAX_INTERVALS: usize = 31;
/// Send interval until two frames have come, microseconds (30 Hz).
const USUAL_INTERVAL: i64 = 33_333;
/// Bounds of the playout delay, microseconds.
const DELAY_RANGE: [i64; 2] = [40_000, 250_000];
/// Share of passing time by which the delay may be changed: the face runs at most 5 % faster or slower than life.
const MAX_SLEW: f64 = 0.05;
/// From this distance on, microseconds, slewing would take longer (5 s) than anybody wants to wait: jump.
const JUMP: i64 = 250_000;
/// A way that has been slower by [`JUMP`] for this long, microseconds, without one fast packet is no stall: a stall ends in
/// a burst whose last packet is fast. The sender paused its clock, or plays a feed slower than life.
const SLOWER_FOR_GOOD: i64 = 500_000;

/// Estimates the smallest transit of 10 s, the jitter and the send interval, and from them how far behind the viewer's
/// clock the face is shown: `lag = min(received - captured) + delay`, `delay = clamp(2 T + q95(jitter), 40 ms, 250 ms)`.
#[derive(Debug, Clone)]
pub(super) struct PlayoutClock {
    /// `(received_at, received_at - captured_at)`, microseconds, by arrival. The two clocks have nothing in common, so a
    /// transit by itself means nothing; differences of transits do.
    transits: VecDeque<(i64, i64)>,
    intervals: VecDeque<i64>,
    sorted: Vec<i64>,
    /// Smallest transit in the window.
    fastest: i64,
    jitter: i64,
    interval: i64,
    /// What is applied, slewed towards its target.
    lag: f64,
    advanced_to: i64,
    has_jumped: bool,
    /// When the first of an unbroken row of packets came that took longer than the fastest by [`JUMP`].
    slow_since: Option<i64>,
}

impl PlayoutClock {
    /// The first frame of a session.
    pub(super) fn starting(captured_at: i64, received_at: i64) -> Self {
        let transit = received_at - captured_at;
        let mut clock = Self {
            transits: VecDeque::from([(received_at, transit)]),
            intervals: VecDeque::new(),
            sorted: Vec::new(),
            fastest: transit,
            jitter: 0,
            interval: USUAL_INTERVAL,
            lag: 0.0,
            advanced_to: received_at,
            has_jumped: false,
            slow_since: None,
        };
        clock.lag = clock.target() as f64;
        clock
    }

    /// A newer frame; the one before it was captured at `before`.
    pub(super) fn note_arrival(&mut self, captured_at: i64, before: i64, received_at: i64) {
        if self.intervals.len() == MAX_INTERVALS {
            self.intervals.pop_front();
        }
        self.intervals.push_back(captured_at - before);
        self.sorted.clear();
        self.sorted.extend(&self.intervals);
        self.interval = quantile(&mut self.sorted, 0.5);

        let transit = received_at - captured_at;
        if transit < self.fastest - JUMP {
            // The sender's clock ran ahead, or what came before was an old frame kept for late viewers.
            self.transits.clear();
        }
        self.slow_since = (transit > self.fastest + JUMP).then(|| self.slow_since.unwrap_or(received_at));
        if let Some(since) = self.slow_since.take_if(|since| received_at - *since >= SLOWER_FOR_GOOD) {
            self.transits.retain(|&(at, _)| at >= since);
        }
        while self.transits.front().is_some_and(|&(at, _)| at < received_at - WINDOW) || self.transits.len() == MAX_TRANSITS {
            self.transits.pop_front();
        }
        self.transits.push_back((received_at, transit));
        self.sorted.clear();
        self.sorted.extend(self.transits.iter().map(|&(_, transit)| transit));
        let slow = quantile(&mut self.sorted, 0.95);
        self.fastest = self.transits.iter().map(|&(_, transit)| transit).min().unwrap_or(transit);
        self.jitter = slow - self.fastest;
        if (self.target() as f64 - self.lag).abs() > JUMP as f64 {
            self.lag = self.target() as f64;
            self.has_jumped = true;
        }
    }

    /// Slews the delay up to `now`; returns how long that is after the last time, microseconds.
    pub(super) fn advance(&mut self, now: i64) -> i64 {
        let passed = (now - self.advanced_to).max(0);
        let most = MAX_SLEW * passed as f64;
        self.lag += (self.target() as f64 - self.lag).clamp(-most, most);
        self.advanced_to = self.advanced_to.max(now);
        passed
    }

    /// The moment on the sender's clock to show at `now`, microseconds.
    pub(super) fn play_time(&self, now: i64) -> i64 {
        now - self.lag.round() as i64
    }

    /// True once after the play time jumped.
    pub(super) fn take_jump(&mut self) -> bool {
        std::mem::take(&mut self.has_jumped)
    }

    /// The delay in effect: what the face is shown later than the fastest packet allows.
    pub(super) fn delay(&self) -> Duration {
        duration(self.lag.round() as i64 - self.fastest)
    }

    pub(super) fn jitter(&self) -> Duration {
        duration(self.jitter)
    }

    pub(super) fn send_interval(&self) -> Duration {
        duration(self.interval)
    }

    fn target(&self) -> i64 {
        let delay = self.interval.saturating_mul(2).saturating_add(self.jitter);
        self.fastest + delay.clamp(DELAY_RANGE[0], DELAY_RANGE[1])
    }
}

/// The smallest value that at least `q` of `values` do not exceed. `values` must not be empty.
fn quantile(values: &mut [i64], q: f64) -> i64 {
    let index = ((q * values.len() as f64).ceil() as usize).clamp(1, values.len()) - 1;
    *values.select_nth_unstable(index).1
}

fn duration(micros: i64) -> Duration {
    Duration::from_micros(micros.max(0).unsigned_abs())
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: i64 = 1000;

    #[test]
    fn delay_is_two_intervals_and_the_95th_percentile_of_jitter() {
        let mut clock = PlayoutClock::starting(0, 500 * MS);
        for k in 1..200 {
            // Every tenth packet takes 30 ms longer: more than 5 % of them.
            let late = if k % 10 == 0 { 30 * MS } else { 0 };
            clock.note_arrival(k * 40 * MS, (k - 1) * 40 * MS, 500 * MS + k * 40 * MS + late);
            clock.advance(500 * MS + k * 40 * MS + late);
        }
        assert_eq!(clock.send_interval(), Duration::from_millis(40));
        assert_eq!(clock.jitter(), Duration::from_millis(30));
        assert_eq!(clock.delay(), Duration::from_millis(110));
    }

    #[test]
    fn delay_keeps_its_bounds() {
        let run = |interval: i64, jitter: i64| {
            let mut clock = PlayoutClock::starting(0, 0);
            for k in 1..2000 {
                let now = k * interval + (k % 2) * jitter;
                clock.note_arrival(k * interval, (k - 1) * interval, now);
                clock.advance(now);
            }
            clock.delay()
        };
        assert_eq!(run(8 * MS, 0), Duration::from_millis(40));
        assert_eq!(run(40 * MS, 240 * MS), Duration::from_millis(250));
    }

    #[test]
    fn delay_is_slewed_by_five_percent_of_passing_time() {
        let mut clock = PlayoutClock::starting(0, 0);
        let start = clock.lag;
        clock.note_arrival(40 * MS, 0, 140 * MS);
        clock.advance(1000 * MS);
        assert_eq!(clock.lag - start, 50_000.0);
    }

    #[test]
    fn sender_that_paused_its_clock_is_followed_and_a_stall_is_not_taken_for_one() {
        let mut clock = PlayoutClock::starting(0, 0);
        let mut run = |from: i64, count: i64, transit: &dyn Fn(i64) -> i64| {
            (from..from + count).any(|k| {
                clock.note_arrival(k * 40 * MS, (k - 1) * 40 * MS, k * 40 * MS + transit(k));
                clock.take_jump()
            })
        };
        assert!(!run(1, 99, &|_| 0));
        // Two seconds in which nothing gets through, then all at once, up to the packet sent last.
        assert!(!run(100, 50, &|k| (149 - k) * 40 * MS));
        assert!(!run(150, 50, &|_| 0));
        // Two seconds in which the sender's clock stood still: all packets after are two seconds behind.
        assert!(run(200, 30, &|_| 2000 * MS));
        assert!((clock.play_time(230 * 40 * MS + 2000 * MS) - 230 * 40 * MS).abs() <= 250 * MS);
    }

    #[test]
    fn clock_that_was_set_is_followed_at_once() {
        let mut clock = PlayoutClock::starting(0, 0);
        clock.note_arrival(3_600_000 * MS, 0, 40 * MS);
        assert!(clock.take_jump());
        assert!((clock.play_time(40 * MS) - 3_600_000 * MS).abs() <= 250 * MS);
        assert!(!clock.take_jump());
    }
}
