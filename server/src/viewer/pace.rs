//! When a viewer is asked whether it still reads, and how far packets may run ahead of its answers.

use std::time::Duration;
use tokio::time::Instant;

/// A ping goes with a packet at most this often: seldom enough to cost little, often enough to notice sleep.
const PING_SPACING: Duration = Duration::from_millis(150);
/// For this long packets go out while a ping is unanswered; longer than most round trips, and with [`PING_SPACING`]
/// shorter than the half second of old packets that a viewer may find when it wakes.
const WINDOW: Duration = Duration::from_millis(300);
/// How often a packet goes to a viewer that has not answered a ping yet, once [`WINDOW`] is over. One that never does breaks the
/// protocol (RFC 6455, 5.5.2): it still shows that something moves, until the idle time-out, and kernels hold little for it.
const TRICKLE: Duration = Duration::from_secs(1);

/// When pings go out and how far packets may run ahead of the answers.
pub(super) struct Pace {
    /// When the ping that is not answered yet went out.
    unanswered: Option<Instant>,
    last_ping: Instant,
    /// With a packet from then on; [`PING_SPACING`] apart, so that it stays this viewer's turn.
    next_ping: Instant,
    pub last_heard: Instant,
    pub last_packet: Instant,
    /// It has answered a ping; before that it gets a [`TRICKLE`] beyond the window.
    has_answered: bool,
}

impl Pace {
    /// Of the `number`th viewer of a room that is there since `origin`. The first ping went out with the hello.
    ///
    /// Viewers take turns with the pings: if all were asked with the same frame, a room's answers would come at once, in the way
    /// of the frames behind it. Multiples of the golden ratio lie evenly in any interval, however many there are.
    pub fn new(now: Instant, origin: Instant, number: u64) -> Self {
        let turn = PING_SPACING.mul_f64((number as f64 * 0.618_033_988_75).fract()).as_nanos();
        let spacing = PING_SPACING.as_nanos();
        let wait = (spacing + turn - (now - origin).as_nanos() % spacing) % spacing;
        let next_ping = now + Duration::from_nanos(wait as u64);
        Self { unanswered: Some(now), last_ping: now, next_ping, last_heard: now, last_packet: now, has_answered: false }
    }

    pub fn hear(&mut self, now: Instant) {
        self.unanswered = None;
        self.last_heard = now;
        self.has_answered = true;
    }

    /// True where a packet may go out now.
    pub fn has_credit(&self, now: Instant) -> bool {
        self.unanswered.is_none_or(|since| now < since + WINDOW) || (!self.has_answered && now >= self.last_packet + TRICKLE)
    }

    /// True where a ping shall go out now, which is noted.
    pub fn takes_ping(&mut self, now: Instant) -> bool {
        let is_due = self.unanswered.is_none() && now >= self.next_ping;
        if is_due {
            self.unanswered = Some(now);
            self.last_ping = now;
            let late = (now - self.next_ping).as_nanos() % PING_SPACING.as_nanos();
            self.next_ping = now + PING_SPACING - Duration::from_nanos(late as u64);
        }
        is_due
    }

    /// When a socket without packets is looked at again: to be pinged, or for its next packet of the trickle.
    pub fn next_wake(&self, interval: Duration, now: Instant) -> Instant {
        match self.unanswered {
            None => (self.last_ping + interval).max(self.next_ping),
            Some(_) if !self.has_answered && !self.has_credit(now) => self.last_packet + TRICKLE,
            // Far enough away: the idle time-out comes before.
            Some(since) => since + Duration::from_secs(86_400),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_viewer_that_stops_answering_gets_half_a_second_more_at_most() {
        let start = Instant::now();
        let at = |millis: u64| start + Duration::from_millis(millis);
        let mut pace = Pace::new(start, start, 0);
        pace.hear(at(1));
        // Frames every 40 ms; the viewer reads until 2 s and then sleeps.
        let mut last_sent = 0;
        for millis in (0..10_000).step_by(40) {
            if pace.has_credit(at(millis)) {
                last_sent = millis;
                pace.takes_ping(at(millis));
                if millis < 2000 {
                    pace.hear(at(millis));
                }
            }
        }
        assert!((2200..=2500).contains(&last_sent), "last packet {last_sent} ms after the start");
        pace.hear(at(10_000));
        assert!(pace.has_credit(at(10_000)), "it gets the newest when it wakes");
    }

    #[test]
    fn a_viewer_that_never_answers_gets_a_window_and_then_a_trickle() {
        let start = Instant::now();
        let at = |millis: u64| start + Duration::from_millis(millis);
        let mut pace = Pace::new(start, start, 0);
        let mut num_sent = 0;
        for millis in (0..10_000).step_by(40) {
            if pace.has_credit(at(millis)) {
                num_sent += 1;
                pace.last_packet = at(millis);
                assert!(!pace.takes_ping(at(millis)), "the first ping still counts");
            } else {
                let wake = pace.next_wake(Duration::from_secs(5), at(millis));
                assert!(wake > at(millis) && pace.has_credit(wake), "it wakes when it may send again");
            }
        }
        // Eight frames of 40 ms in the window, then about one a second.
        assert!((16..=18).contains(&num_sent), "{num_sent} of 250");
        pace.hear(at(10_000));
        assert!((10_000..10_300).step_by(40).all(|millis| pace.has_credit(at(millis))), "all of them once it has answered");
    }

    #[test]
    fn pings_of_many_viewers_are_spread_over_the_spacing() {
        let start = Instant::now();
        let at = |millis: u64| start + Duration::from_millis(millis);
        // They come over a second, in any order, and answer at once; a frame every 10 ms.
        let mut paces: Vec<Pace> = (0..300).map(|k| Pace::new(at(k * 7919 % 1000), start, k)).collect();
        let mut most = 0;
        for millis in (1000..4000).step_by(10) {
            let mut num_pings = 0;
            for pace in &mut paces {
                pace.hear(at(millis));
                num_pings += u32::from(pace.takes_ping(at(millis)));
            }
            if millis > 1000 {
                most = most.max(num_pings);
            }
        }
        // 300 in 15 frames.
        assert!((20..=24).contains(&most), "{most} pings with one frame");
    }

    #[test]
    fn a_long_round_trip_slows_but_does_not_stop() {
        let start = Instant::now();
        let at = |millis: u64| start + Duration::from_millis(millis);
        for (round_trip, least) in [(0, 250), (100, 250), (250, 250), (500, 150)] {
            let mut pace = Pace::new(start, start, 0);
            pace.hear(start);
            let (mut num_sent, mut pong) = (0, None);
            for millis in (0..10_000).step_by(40) {
                if pong.is_some_and(|due| millis >= due) {
                    pace.hear(at(millis));
                    pong = None;
                }
                if pace.has_credit(at(millis)) {
                    num_sent += 1;
                    if pace.takes_ping(at(millis)) {
                        pong = Some(millis + round_trip);
                    }
                }
            }
            assert!(num_sent >= least, "{num_sent} of 250 frames at a round trip of {round_trip} ms");
        }
    }

    /// A link that keeps its order: packets wait while it stalls, and all of them come when it goes on. Times in milliseconds.
    #[derive(Debug, Clone)]
    struct Weather {
        delay: u64,
        jitter: u64,
        stall_every: u64,
        stall: u64,
        /// When the connection breaks, and what is under way with it; the viewer comes back after `away`.
        breaks_at: u64,
        away: u64,
    }

    /// What one viewer sees of frames that come every `interval` for `time`: index and time of arrival, connection by connection.
    fn simulate(weather: &Weather, interval: u64, time: u64, seed: u64) -> Vec<Vec<(u64, u64)>> {
        let start = Instant::now();
        let at = |millis: u64| start + Duration::from_millis(millis);
        let mut random = seed;
        let mut arrival = |sent: u64, last: u64| {
            random = random.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            let mut arrives = sent + weather.delay + (random >> 33) % (weather.jitter + 1);
            let into = arrives % weather.stall_every;
            if into < weather.stall {
                arrives += weather.stall - into;
            }
            arrives.max(last)
        };
        let mut seen = Vec::new();
        for (from, to) in [(0, weather.breaks_at), (weather.breaks_at + weather.away, u64::MAX)] {
            let (mut pace, mut sent_state) = (Pace::new(at(from), start, seed % 100), 0);
            // Pings whose answers are on their way; the first went out with the hello.
            let mut pongs = std::collections::VecDeque::new();
            let (mut down, mut up) = (from, from);
            let mut came = Vec::new();
            down = arrival(from, down);
            up = arrival(down, up);
            pongs.push_back(up);
            // Long enough after the last frame for a trickle.
            for now in from..to.min(time + 5000) {
                while pongs.front().is_some_and(|due| *due <= now) {
                    pongs.pop_front();
                    pace.hear(at(now));
                }
                // The slot holds the newest state alone.
                let newest = now.min(time) / interval;
                if newest > sent_state && pace.has_credit(at(now)) {
                    pace.last_packet = at(now);
                    down = arrival(now, down);
                    if pace.takes_ping(at(now)) {
                        up = arrival(down, up);
                        pongs.push_back(up);
                    }
                    sent_state = newest;
                    if down < to {
                        came.push((newest, down));
                    }
                }
            }
            seen.push(came);
        }
        seen
    }

    proptest::proptest! {
        #![proptest_config(proptest::prelude::ProptestConfig::with_cases(64))]

        #[test]
        fn viewer_never_sees_an_older_frame_after_a_newer_one_and_ends_on_the_last(
            delay in 0..400_u64, jitter in 0..100_u64, stall_every in 1000..5000_u64, stall in 0..900_u64,
            breaks_at in 500..8000_u64, away in 0..2000_u64, interval in 1..100_u64, seed: u64,
        ) {
            const TIME: u64 = 8000;
            let weather = Weather { delay, jitter, stall_every, stall, breaks_at, away };
            let seen = simulate(&weather, interval, TIME, seed);
            for came in &seen {
                proptest::prop_assert!(came.windows(2).all(|pair| pair[0].0 < pair[1].0 && pair[0].1 <= pair[1].1), "{weather:?}");
            }
            let newest = seen.iter().flatten().map(|(index, _)| *index).collect::<Vec<_>>();
            proptest::prop_assert!(newest.is_sorted(), "a connection made anew begins with the newest state");
            proptest::prop_assert_eq!(newest.last(), Some(&(TIME / interval)));
            // However long the link stalls: what comes then was sent within the window and the ping before it.
            let most = delay + jitter + stall + stall + WINDOW.as_millis() as u64 + PING_SPACING.as_millis() as u64;
            for (index, arrived) in seen.iter().flatten() {
                if (index + 1) * interval < TIME.min(breaks_at) {
                    let age = arrived - index * interval;
                    proptest::prop_assert!(age <= most + interval + TRICKLE.as_millis() as u64, "a packet is {age} ms old: {weather:?}");
                }
            }
        }
    }
}
