//! One viewer: it gets the newest state and nothing else, however slow it is.
//!
//! Kernel buffers at both ends hold more than a thousand packets, most of them at the viewer's end where no option of ours
//! reaches. So the server looks at what the viewer has *read*: pings travel between the packets, a viewer that reads answers
//! them, and no more than [`WINDOW`] of packets goes out unanswered. What a sleeping viewer misses is never sent.

use crate::config::seconds;
use crate::room::{Latest, Viewing};
use crate::service::{Allowance, Hub, stopped};
use crate::socket::{Ending, ErrorMessage, Socket, Stop, broken, end, frame_bytes, send};
use futures_util::{SinkExt, StreamExt};
use rhytid_shared::RoomName;
use rhytid_shared::view::{ViewHello, ViewMessage};
use std::future::{Future, poll_fn};
use std::sync::Arc;
use std::task::Poll;
use std::time::Duration;
use tokio::time::Instant;
use tokio_tungstenite::tungstenite::protocol::WebSocketConfig;
use tokio_tungstenite::tungstenite::protocol::frame::coding::CloseCode;
use tokio_tungstenite::tungstenite::{Bytes, Message};

/// A ping goes with a packet at most this often: seldom enough to cost nothing, often enough to notice sleep.
const PING_SPACING: Duration = Duration::from_millis(120);
/// For this long packets go out while a ping is unanswered; longer than most round trips, and with [`PING_SPACING`]
/// shorter than the half second of old packets that a viewer may find when it wakes.
const WINDOW: Duration = Duration::from_millis(300);
/// How often a packet goes to a viewer that has not answered a ping yet, once [`WINDOW`] is over. One that never does breaks the
/// protocol (RFC 6455, 5.5.2): it still shows that something moves, until the idle time-out, and kernels hold little for it.
const TRICKLE: Duration = Duration::from_secs(1);
/// Messages a second from a viewer, after a burst of some seconds' worth: pongs, of which it has eight to send at most, and pings of
/// its own.
const MOST_MESSAGES: u32 = 50;
/// Largest message of a viewer, bytes: it has nothing to say but pongs.
const LARGEST_MESSAGE: usize = 1024;

/// Small buffers: a viewer sends nothing but pongs, and gets less than 100 bytes at a time.
pub(crate) fn socket_config() -> WebSocketConfig {
    const READ: usize = 256;
    const WRITE: usize = 512;
    WebSocketConfig::default()
        .read_buffer_size(READ)
        .write_buffer_size(WRITE)
        // Room for a state as JSON and a control frame behind it.
        .max_write_buffer_size(256 << 10)
        .max_message_size(Some(LARGEST_MESSAGE))
        .max_frame_size(Some(LARGEST_MESSAGE))
}

/// What a viewer gets before its first packet: a ping, which shows whether it answers pings at all, and the hello.
pub(crate) fn first_frames(hub: &Hub, room: &RoomName) -> Vec<u8> {
    const TEXT: u8 = 1;
    const PING: u8 = 9;
    let hello = ViewMessage::Hello(ViewHello::new(room.as_str(), &hub.character, hub.character_url.clone()));
    let text = serde_json::to_string(&hello).expect("plain data can be written");
    let mut bytes = frame_bytes(PING, &[]);
    bytes.extend(frame_bytes(TEXT, text.as_bytes()));
    bytes
}

/// Sends `viewing`'s states until one side ends it.
pub(crate) async fn talk(hub: Arc<Hub>, mut socket: Socket, mut viewing: Viewing, wants_json: bool, expires: Option<Instant>) {
    let stop = run(&hub, &mut socket, &mut viewing, wants_json, expires).await;
    drop(viewing);
    end(socket, stop, &hub.metrics).await;
}

/// Sends states until the viewer is gone or does not answer, or the service ends.
///
/// This is what a frame costs, once for each viewer, so nothing is done twice: the state's slot also says that the service
/// ends, one timer stays where it is until it is due, and a write gets a time-out only when it has to wait.
async fn run(hub: &Hub, socket: &mut Socket, viewing: &mut Viewing, wants_json: bool, expires: Option<Instant>) -> Stop {
    let timeouts = &hub.config.timeouts;
    let (idle, ping_interval, write) = (seconds(timeouts.viewer_idle), seconds(timeouts.ping), seconds(timeouts.write));
    let mut pace = Pace::new(Instant::now());
    let mut sent = Sent::default();
    let mut messages = Allowance::default();
    // A state that stands there already is news to this viewer.
    viewing.slot.mark_changed();
    let mut has_news = false;
    let timer = tokio::time::sleep_until(Instant::now() + idle);
    tokio::pin!(timer);
    loop {
        let now = Instant::now();
        if has_news && pace.has_credit(now) {
            has_news = false;
            let latest = viewing.slot.borrow_and_update().clone();
            if let Some(latest) = latest {
                pace.last_packet = now;
                let with_ping = pace.takes_ping(now);
                match within(hub, write, send_state(hub, socket, &latest, wants_json, with_ping, &mut sent)).await {
                    Ok(true) => {}
                    Ok(false) => return Stop::Gone("connection_lost"),
                    Err(stop) => return stop,
                }
            }
        }
        if now >= pace.last_heard + idle {
            let message = format!("no pong for {} seconds", timeouts.viewer_idle);
            return Ending::error(CloseCode::Policy, ErrorMessage::new("idle", message)).into();
        }
        if expires.is_some_and(|end| now >= end) {
            return Ending::token_expired().into();
        }
        // Mostly it is due later than the timer says; then the timer is moved when it fires.
        let end = expires.map_or(pace.last_heard + idle, |end| end.min(pace.last_heard + idle));
        let wake = pace.next_wake(ping_interval, now).min(end);
        if wake < timer.deadline() {
            timer.as_mut().reset(wake);
        }
        tokio::select! {
            biased;
            changed = viewing.slot.changed() => {
                if changed.is_err() {
                    return Stop::Gone("closed");
                }
                if *hub.shutdown.borrow() {
                    return Ending::shutdown().into();
                }
                has_news = true;
            }
            message = socket.next() => match message {
                Some(Ok(_)) if !messages.take_if_free(MOST_MESSAGES, std::time::Instant::now()) => {
                    let message = format!("more than {MOST_MESSAGES} messages a second: a viewer has nothing to say");
                    return Ending::error(CloseCode::Policy, ErrorMessage::new("too_fast", message)).into();
                }
                Some(Ok(Message::Pong(_))) => pace.hear(Instant::now()),
                Some(Ok(Message::Close(_))) | None => return Stop::Gone("closed"),
                // Viewers have nothing to say yet; what they say is ignored.
                Some(Ok(_)) => {}
                Some(Err(error)) => return broken(error, LARGEST_MESSAGE),
            },
            () = timer.as_mut() => {
                let now = Instant::now();
                if now >= wake
                    && pace.takes_ping(now)
                    && let Err(stop) = send(socket, Message::Ping(Bytes::new()), write).await
                {
                    return stop;
                }
                timer.as_mut().reset(pace.next_wake(ping_interval, now).min(end));
            }
        }
    }
}

/// The output of `sending`, or why it did not get there. The usual case is that the kernel takes everything at once.
async fn within<T>(hub: &Hub, timeout: Duration, sending: impl Future<Output = T>) -> Result<T, Stop> {
    tokio::pin!(sending);
    if let Poll::Ready(output) = poll_fn(|cx| Poll::Ready(sending.as_mut().poll(cx))).await {
        return Ok(output);
    }
    let mut shutdown = hub.shutdown.clone();
    tokio::select! {
        biased;
        () = stopped(&mut shutdown) => Err(Ending::shutdown().into()),
        output = tokio::time::timeout(timeout, sending) => output.map_err(|_| Stop::Gone("write_timeout")),
    }
}

/// What a viewer has been sent.
#[derive(Default)]
struct Sent {
    /// Index of the newest state.
    state: u64,
    /// Index of the newest key packet.
    key: u64,
}

/// Sends the newest state, after its key packet where the viewer has not got that. False where the connection is lost.
async fn send_state(hub: &Hub, socket: &mut Socket, latest: &Latest, wants_json: bool, with_ping: bool, sent: &mut Sent) -> bool {
    let text = wants_json.then(|| latest.json(&hub.layout, &hub.hello_character));
    let mut num_bytes = 0;
    let mut feed = async |message: Message| {
        num_bytes += message.len();
        socket.feed(message).await.is_ok()
    };
    let is_fed = (!with_ping || feed(Message::Ping(Bytes::new())).await)
        && match text {
            Some(text) => feed(Message::Text(text)).await,
            None => {
                let needs_key = sent.key != latest.key.index;
                (!needs_key || feed(Message::Binary(latest.key.bytes.clone())).await)
                    && match &latest.delta {
                        Some(delta) => feed(Message::Binary(delta.clone())).await,
                        None => true,
                    }
            }
        };
    if !is_fed || socket.flush().await.is_err() {
        return false;
    }
    let metrics = &hub.metrics;
    metrics.frames_out.inc();
    metrics.bytes_out.inc_by(num_bytes as u64);
    if sent.state > 0 && latest.index > sent.state + 1 {
        metrics.drop_frames("slow_viewer", latest.index - sent.state - 1);
    }
    *sent = Sent { state: latest.index, key: latest.key.index };
    true
}

/// When pings go out and how far packets may run ahead of the answers.
struct Pace {
    /// When the ping that is not answered yet went out.
    unanswered: Option<Instant>,
    last_ping: Instant,
    last_heard: Instant,
    last_packet: Instant,
    /// It has answered a ping; before that it gets a [`TRICKLE`] beyond the window.
    has_answered: bool,
}

impl Pace {
    /// The first ping went out with the hello.
    fn new(now: Instant) -> Self {
        Self { unanswered: Some(now), last_ping: now, last_heard: now, last_packet: now, has_answered: false }
    }

    fn hear(&mut self, now: Instant) {
        self.unanswered = None;
        self.last_heard = now;
        self.has_answered = true;
    }

    /// True where a packet may go out now.
    fn has_credit(&self, now: Instant) -> bool {
        self.unanswered.is_none_or(|since| now < since + WINDOW) || (!self.has_answered && now >= self.last_packet + TRICKLE)
    }

    /// True where a ping shall go out now, which is noted.
    fn takes_ping(&mut self, now: Instant) -> bool {
        let is_due = self.unanswered.is_none() && now >= self.last_ping + PING_SPACING;
        if is_due {
            self.unanswered = Some(now);
            self.last_ping = now;
        }
        is_due
    }

    /// When a socket without packets is looked at again: to be pinged, or for its next packet of the trickle.
    fn next_wake(&self, interval: Duration, now: Instant) -> Instant {
        match self.unanswered {
            None => self.last_ping + interval.max(PING_SPACING),
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
        let mut pace = Pace::new(start);
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
        let mut pace = Pace::new(start);
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
    fn a_long_round_trip_slows_but_does_not_stop() {
        let start = Instant::now();
        let at = |millis: u64| start + Duration::from_millis(millis);
        for (round_trip, least) in [(0, 250), (100, 250), (250, 250), (500, 150)] {
            let mut pace = Pace::new(start);
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
            let (mut pace, mut sent_state) = (Pace::new(at(from)), 0);
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
