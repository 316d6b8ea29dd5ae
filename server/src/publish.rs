//! One publisher: its messages are read, solved, encoded and put into its room, in the order they come.

use crate::config::seconds;
use crate::http::Pass;
use crate::pipeline::Pipeline;
use crate::room::{Evicted, Publishing, RoomError};
use crate::service::{Hub, stopped};
use crate::socket::{Ending, ErrorMessage, Socket, Stop, broken, end, send, send_json};
use crate::solve::{Calibration, DelayReport, SolveError};
use futures_util::StreamExt;
use rhytid_shared::view::PROTOCOL_VERSION;
use rhytid_shared::{MessageError, PublishHello, PublishMessage, PublishReader, RoomName, TrackingFrame};
use serde::Serialize;
use std::convert::Infallible;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;
use tokio::time::Instant;
use tokio_tungstenite::tungstenite::protocol::WebSocketConfig;
use tokio_tungstenite::tungstenite::protocol::frame::coding::CloseCode;
use tokio_tungstenite::tungstenite::{Bytes, Message, Utf8Bytes};

/// Answers to a publisher, besides errors.
#[derive(Debug, Serialize)]
#[serde(tag = "type", rename_all = "snake_case")]
enum Answer<'a> {
    /// The hello was taken; frames may come.
    Ready {
        version: u32,
        room: &'a str,
        /// Number of this session in its room.
        session: u32,
        /// True where the session starts from the neutral face that the room has kept.
        kept_neutral: bool,
        character: &'a str,
        /// Names that `bones` frames may use.
        bones: Vec<&'a str>,
    },
    /// A neutral face has been taken.
    Calibrated {
        /// Sender's time at which it was reached, seconds.
        t: f64,
        /// Frames it is the median of.
        frames: usize,
        /// True where the publisher asked for it.
        requested: bool,
        /// Delay the smoothing adds at present, seconds by group.
        added_delay: DelayReport,
    },
}

/// Buffers for messages of the configured size.
pub(crate) fn socket_config(hub: &Hub) -> WebSocketConfig {
    let most = hub.config.limits.message_bytes;
    WebSocketConfig::default()
        .read_buffer_size(16 << 10)
        .write_buffer_size(1 << 10)
        .max_write_buffer_size(64 << 10)
        .max_message_size(Some(most))
        .max_frame_size(Some(most))
}

/// Calibrations a second from one publisher: each may solve all its frames of the last seconds anew.
const CALIBRATIONS_PER_SECOND: u32 = 2;

/// Takes a publisher's messages until one side ends it.
pub(crate) async fn talk(hub: Arc<Hub>, mut socket: Socket, room: RoomName, pass: Pass) {
    let Err(stop) = publish(&hub, &mut socket, &room, &pass).await;
    if let Stop::End(ending) = &stop {
        tracing::info!(%room, reason = %ending.reason, "publisher ended by the server");
    }
    end(socket, stop, &hub.metrics).await;
}

/// Waits for the hello, claims the room and takes messages, however long each step may block, until the session ends, the
/// service ends, another publisher takes the room, or nothing is heard any more.
async fn publish(hub: &Hub, socket: &mut Socket, room: &RoomName, pass: &Pass) -> Result<Infallible, Stop> {
    let timeouts = &hub.config.timeouts;
    let mut shutdown = hub.shutdown.clone();
    let mut reader = PublishReader::new(&hub.character);
    let hello = tokio::select! {
        biased;
        () = stopped(&mut shutdown) => return Err(Ending::shutdown().into()),
        hello = tokio::time::timeout(seconds(timeouts.hello), read_hello(hub, socket, &mut reader)) => match hello {
            Ok(hello) => hello?,
            Err(_) => return Err(refusal("hello_timeout", format!("no hello within {} seconds", timeouts.hello))),
        },
    };
    // Before the room is claimed: a hello that leads to nothing takes no room from anybody.
    let kept = hello.keep_neutral.then(|| hub.rooms.neutral(room, &hello)).flatten();
    let (mut pipeline, has_kept) = start(hub, &hello, kept).map_err(|error| refusal("bad_hello", format!("hello: {error}")))?;
    let (place, evicted) = claim(hub, room, &hello)?;
    pipeline.set_session(place.session);
    tracing::info!(%room, session = place.session, source = hello.source, takeover = hello.takeover, has_kept, "publisher ready");
    let heard = Heard::now();
    let mut session = Session::new(hub, pass, place, pipeline, reader, hello);
    let stop = tokio::select! {
        biased;
        () = stopped(&mut shutdown) => Ending::shutdown().into(),
        _ = evicted => taken_over(),
        () = until(pass.expires) => Ending::token_expired().into(),
        result = session.run(socket, &heard, has_kept) => match result { Err(stop) => stop },
        () = heard.silence(seconds(timeouts.publisher_idle)) => {
            refusal("idle", format!("nothing heard for {} seconds", timeouts.publisher_idle))
        }
    };
    // What has refined the neutral since it was told of.
    session.keep_neutral();
    tracing::info!(%room, session = session.place.session, frames = session.num_frames, "publisher gone");
    Err(stop)
}

/// The session's pipeline, and whether it starts from the `kept` neutral face.
fn start(hub: &Hub, hello: &PublishHello, kept: Option<Calibration>) -> Result<(Pipeline, bool), SolveError> {
    let (character, config) = (&hub.character, &hub.config.solve);
    // A neutral of weights does not fit a sender that has a layout too: its landmarks have none yet.
    if let Some(pipeline) = kept.and_then(|kept| Pipeline::with_calibration(character.clone(), config, hello, 0, kept).ok()) {
        return Ok((pipeline, true));
    }
    Ok((Pipeline::new(character.clone(), config, hello, 0)?, false))
}

/// Reads up to the hello.
async fn read_hello(hub: &Hub, socket: &mut Socket, reader: &mut PublishReader) -> Result<PublishHello, Stop> {
    let text = first_text(socket, hub).await?;
    hub.metrics.bytes_in.inc_by(text.len() as u64);
    match reader.read(&text, &mut TrackingFrame::default()) {
        Ok(PublishMessage::Hello(hello)) => Ok(hello),
        Ok(PublishMessage::Frame | PublishMessage::Calibrate) => unreachable!("the reader refuses both before a hello"),
        Err(MessageError { code, message }) => Err(refusal(code, message)),
    }
}

/// A publisher that has claimed its room.
struct Session<'a> {
    hub: &'a Hub,
    pass: &'a Pass,
    place: Publishing,
    pipeline: Pipeline,
    reader: PublishReader,
    hello: PublishHello,
    frame: TrackingFrame,
    packet: Vec<u8>,
    messages: Rate,
    calibrations: Rate,
    /// The sender knows that it is too fast.
    has_told_rate: bool,
    num_frames: u64,
    num_bad_in_a_row: u32,
}

impl<'a> Session<'a> {
    fn new(hub: &'a Hub, pass: &'a Pass, place: Publishing, pipeline: Pipeline, reader: PublishReader, hello: PublishHello) -> Self {
        let now = Instant::now();
        Self {
            hub,
            pass,
            place,
            pipeline,
            reader,
            hello,
            frame: TrackingFrame::default(),
            packet: Vec::new(),
            messages: Rate::new(hub.config.limits.frames_per_second, now),
            calibrations: Rate::new(CALIBRATIONS_PER_SECOND, now),
            has_told_rate: false,
            num_frames: 0,
            num_bad_in_a_row: 0,
        }
    }

    /// Says that it is ready and takes messages until the session ends. May be dropped at any await.
    async fn run(&mut self, socket: &mut Socket, heard: &Heard, kept_neutral: bool) -> Result<Infallible, Stop> {
        let character = &self.hub.character;
        let ready = Answer::Ready {
            version: PROTOCOL_VERSION,
            room: self.place.room.name.as_str(),
            session: self.place.session,
            kept_neutral,
            character: &character.name,
            bones: character.bones.iter().map(|bone| bone.name.as_str()).collect(),
        };
        let timeouts = &self.hub.config.timeouts;
        let (ping, write) = (seconds(timeouts.ping), seconds(timeouts.write));
        send_json(socket, &ready, write).await?;
        let mut last_ping = Instant::now();
        loop {
            let message = tokio::select! {
                message = socket.next() => message,
                () = tokio::time::sleep_until(last_ping + ping) => {
                    last_ping = Instant::now();
                    send(socket, Message::Ping(Bytes::new()), write).await?;
                    continue;
                }
            };
            heard.set(Instant::now());
            match message {
                Some(Ok(Message::Text(text))) => {
                    self.hub.metrics.bytes_in.inc_by(text.len() as u64);
                    self.take(socket, &text).await?;
                }
                Some(Ok(Message::Binary(bytes))) => {
                    self.hub.metrics.bytes_in.inc_by(bytes.len() as u64);
                    self.refuse(socket, ErrorMessage::new("binary_message", BINARY)).await?;
                }
                Some(Ok(Message::Close(_))) | None => return Err(Stop::Gone("closed")),
                Some(Ok(_)) => {}
                Some(Err(error)) => return Err(broken(error, self.hub.config.limits.message_bytes)),
            }
            self.hold_back(socket, heard).await?;
        }
    }

    /// Takes one text message.
    async fn take(&mut self, socket: &mut Socket, text: &str) -> Result<(), Stop> {
        match self.reader.read(text, &mut self.frame) {
            Ok(PublishMessage::Calibrate) => {
                if self.calibrations.take_if_free(Instant::now()) {
                    self.pipeline.calibrate();
                } else {
                    let message = format!("more than {CALIBRATIONS_PER_SECOND} calibrations a second: this one is left out");
                    return self.refuse(socket, ErrorMessage::new("too_many_calibrations", message)).await;
                }
            }
            Ok(PublishMessage::Hello(_)) => unreachable!("the reader refuses a second hello"),
            Ok(PublishMessage::Frame) => {
                let start = std::time::Instant::now();
                if let Err(error) = self.pipeline.solve(&self.frame) {
                    self.reader.take_back();
                    return self.refuse(socket, ErrorMessage::new("bad_frame", error.to_string())).await;
                }
                self.hub.metrics.solve_seconds.observe(start.elapsed().as_secs_f64());
                let kind = self.pipeline.encode(&mut self.packet);
                if !self.place.publish(kind, &self.packet, self.pipeline.face()) {
                    return Err(taken_over());
                }
                self.hub.metrics.frames_in.inc();
                self.num_frames += 1;
                self.num_bad_in_a_row = 0;
            }
            Err(error) => return self.refuse(socket, ErrorMessage::new(error.code, error.message)).await,
        }
        if let Some(report) = self.pipeline.take_calibrated() {
            self.keep_neutral();
            let answer = Answer::Calibrated {
                t: report.t,
                frames: report.num_frames,
                requested: report.requested,
                added_delay: self.pipeline.added_delay(),
            };
            send_json(socket, &answer, seconds(self.hub.config.timeouts.write)).await?;
        }
        Ok(())
    }

    /// Leaves the neutral in use with the room.
    fn keep_neutral(&self) {
        if let Some(calibration) = self.pipeline.calibration() {
            self.place.keep_neutral(&self.hello, calibration);
        }
    }

    /// Slows a sender that is too fast, whatever it sends: nothing is read meanwhile, so its own socket fills up. Its frames
    /// are not dropped.
    async fn hold_back(&mut self, socket: &mut Socket, heard: &Heard) -> Result<(), Stop> {
        let now = Instant::now();
        let by_address = self.pass.place.as_ref().and_then(|place| place.take_message(now.into_std())).map(Instant::from_std);
        let Some(until) = self.messages.take(now).max(by_address) else { return Ok(()) };
        if !std::mem::replace(&mut self.has_told_rate, true) {
            let limits = &self.hub.config.limits;
            let most = if by_address.is_some() { limits.frames_per_second_per_address } else { limits.frames_per_second };
            let message = format!("more than {most} messages a second: the server reads no faster, no frame is dropped");
            send_json(socket, &ErrorMessage::new("too_fast", message), seconds(self.hub.config.timeouts.write)).await?;
        }
        // The silence until then is the server's own.
        heard.set(until);
        tokio::time::sleep_until(until).await;
        Ok(())
    }

    /// Counts a bad message and says what is wrong with it; too many in a row end the session.
    async fn refuse(&mut self, socket: &mut Socket, error: ErrorMessage) -> Result<(), Stop> {
        self.hub.metrics.drop_frames(error.code, 1);
        self.num_bad_in_a_row += 1;
        tracing::debug!(room = %self.place.room.name, code = error.code, message = error.message, "bad message from publisher");
        send_json(socket, &error, seconds(self.hub.config.timeouts.write)).await?;
        let most = self.hub.config.limits.bad_frames_in_a_row;
        if self.num_bad_in_a_row >= most {
            return Err(refusal("too_many_bad_frames", format!("{most} bad messages in a row, the last one: {}", error.message)));
        }
        Ok(())
    }
}

const BINARY: &str = "message is binary, expected JSON text";

/// The first text message.
async fn first_text(socket: &mut Socket, hub: &Hub) -> Result<Utf8Bytes, Stop> {
    loop {
        match socket.next().await {
            Some(Ok(Message::Text(text))) => return Ok(text),
            Some(Ok(Message::Binary(_))) => {
                return Err(Ending::error(CloseCode::Unsupported, ErrorMessage::new("binary_message", BINARY)).into());
            }
            Some(Ok(Message::Close(_))) | None => return Err(Stop::Gone("closed")),
            Some(Ok(_)) => {}
            Some(Err(error)) => return Err(broken(error, hub.config.limits.message_bytes)),
        }
    }
}

fn claim(hub: &Hub, room: &RoomName, hello: &PublishHello) -> Result<(Publishing, Evicted), Stop> {
    hub.rooms.claim(room, &hello.source, hello.takeover).map_err(|error| {
        let code = match error {
            RoomError::Taken => CloseCode::Policy,
            RoomError::TooManyRooms { .. } | RoomError::TooManyViewers { .. } => CloseCode::Again,
        };
        Ending::error(code, ErrorMessage::new(error.code(), error.to_string())).into()
    })
}

/// The end of a publisher that does not keep the rules.
fn refusal(code: &'static str, message: String) -> Stop {
    Ending::error(CloseCode::Policy, ErrorMessage::new(code, message)).into()
}

/// Done at `end`, where there is one.
async fn until(end: Option<Instant>) {
    match end {
        Some(end) => tokio::time::sleep_until(end).await,
        None => std::future::pending().await,
    }
}

fn taken_over() -> Stop {
    refusal("taken_over", "another publisher has taken the room over".into())
}

/// When the peer was last heard.
struct Heard(Mutex<Instant>);

impl Heard {
    fn now() -> Self {
        Self(Mutex::new(Instant::now()))
    }

    fn set(&self, at: Instant) {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner) = at;
    }

    /// Done when nothing has been heard for `idle`.
    async fn silence(&self, idle: Duration) {
        loop {
            let due = *self.0.lock().unwrap_or_else(PoisonError::into_inner) + idle;
            if due <= Instant::now() {
                return;
            }
            tokio::time::sleep_until(due).await;
        }
    }
}

/// So many a second, with a burst of a tenth of a second or of two.
struct Rate {
    interval: Duration,
    burst: Duration,
    /// When what came so far would have come at the allowed rate.
    due: Instant,
}

impl Rate {
    fn new(per_second: u32, now: Instant) -> Self {
        let interval = Duration::from_secs(1) / per_second;
        let burst = (interval * 2).max(Duration::from_millis(100));
        Self { interval, burst, due: now.checked_sub(burst).unwrap_or(now) }
    }

    /// Counts one; gives the time before which no other shall be read.
    fn take(&mut self, now: Instant) -> Option<Instant> {
        let earliest = now.checked_sub(self.burst).unwrap_or(now);
        self.due = self.due.max(earliest) + self.interval;
        (self.due > now).then_some(self.due)
    }

    /// Counts one where the rate allows it now.
    fn take_if_free(&mut self, now: Instant) -> bool {
        let is_free = self.due <= now;
        if is_free {
            self.take(now);
        }
        is_free
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_fast_sender_is_slowed_to_the_rate_after_a_short_burst() {
        let start = Instant::now() + Duration::from_secs(10);
        let mut rate = Rate::new(100, start);
        let mut now = start;
        for _ in 0..200 {
            now = rate.take(now).unwrap_or(now);
        }
        let took = now - start;
        assert!((Duration::from_millis(1880)..=Duration::from_millis(2000)).contains(&took), "{took:?}");
        // One at the allowed rate is never held.
        for i in 0..200u32 {
            assert_eq!(rate.take(now + Duration::from_millis(500) + Duration::from_millis(10) * i), None);
        }
    }

    #[test]
    fn what_is_refused_does_not_count_against_the_rate() {
        let start = Instant::now() + Duration::from_secs(10);
        let mut rate = Rate::new(2, start);
        // A flood every 10 ms for ten seconds: two a second get through, and the burst.
        let free = (0..1000).filter(|i| rate.take_if_free(start + Duration::from_millis(10) * *i)).count();
        assert!((20..=23).contains(&free), "{free}");
    }

    #[tokio::test]
    async fn silence_counts_from_what_was_heard_last() {
        let heard = Heard::now();
        let start = Instant::now();
        heard.set(start + Duration::from_millis(100));
        heard.silence(Duration::from_millis(50)).await;
        assert!(start.elapsed() >= Duration::from_millis(150));
    }
}
