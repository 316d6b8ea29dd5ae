//! One publisher: its messages are read, solved, encoded and put into its room, in the order they come.

use crate::config::seconds;
use crate::pipeline::Pipeline;
use crate::room::{Publishing, RoomError};
use crate::service::{Hub, stopped};
use crate::socket::{Ending, ErrorMessage, Socket, Stop, close, farewell, send, send_json};
use crate::solve::DelayReport;
use futures_util::StreamExt;
use rhytid_shared::view::PROTOCOL_VERSION;
use rhytid_shared::{MessageError, PublishHello, PublishMessage, PublishReader, RoomName, TrackingFrame};
use serde::Serialize;
use std::sync::Arc;
use std::time::Duration;
use tokio::time::Instant;
use tokio_tungstenite::tungstenite::error::CapacityError;
use tokio_tungstenite::tungstenite::protocol::WebSocketConfig;
use tokio_tungstenite::tungstenite::protocol::frame::coding::CloseCode;
use tokio_tungstenite::tungstenite::{Bytes, Error, Message};

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

/// Takes a publisher's messages until one side ends it.
pub(crate) async fn talk(hub: Arc<Hub>, mut socket: Socket, room: RoomName) {
    let stop = match Session::begin(&hub, &mut socket, &room).await {
        Ok(mut session) => match session.run(&mut socket).await {
            Ok(never) => match never {},
            Err(stop) => {
                tracing::info!(%room, session = session.place.session, frames = session.num_frames, "publisher gone");
                stop
            }
        },
        Err(stop) => stop,
    };
    match stop {
        Stop::End(ending) => {
            tracing::info!(%room, reason = %ending.reason, "publisher ended by the server");
            hub.metrics.end(ending.error.as_ref().map_or("shutdown", |error| error.code));
            close(socket, &ending).await;
        }
        Stop::Gone(reason) => {
            hub.metrics.end(reason);
            farewell(socket).await;
        }
    }
}

/// A publisher that has said its hello.
struct Session<'a> {
    hub: &'a Hub,
    place: Publishing,
    pipeline: Pipeline,
    reader: PublishReader,
    frame: TrackingFrame,
    packet: Vec<u8>,
    rate: Rate,
    liveness: Liveness,
    num_frames: u64,
    num_bad_in_a_row: u32,
}

impl<'a> Session<'a> {
    /// Waits for the hello and claims the room.
    async fn begin(hub: &'a Hub, socket: &mut Socket, room: &RoomName) -> Result<Self, Stop> {
        let timeout = seconds(hub.config.timeouts.hello);
        let mut reader = PublishReader::new(&hub.character);
        let mut frame = TrackingFrame::default();
        let mut shutdown = hub.shutdown.clone();
        let text = tokio::select! {
            () = stopped(&mut shutdown) => return Err(Ending::shutdown().into()),
            text = tokio::time::timeout(timeout, first_text(socket, hub)) => match text {
                Ok(text) => text?,
                Err(_) => {
                    let message = format!("no hello within {} seconds", hub.config.timeouts.hello);
                    return Err(Ending::error(CloseCode::Policy, ErrorMessage::new("hello_timeout", message)).into());
                }
            },
        };
        hub.metrics.bytes_in.inc_by(text.len() as u64);
        let refuse = |error: MessageError| Stop::from(Ending::error(CloseCode::Policy, ErrorMessage::new(error.code, error.message)));
        let hello = match reader.read(&text, &mut frame).map_err(refuse)? {
            PublishMessage::Hello(hello) => hello,
            PublishMessage::Frame | PublishMessage::Calibrate => unreachable!("the reader refuses both before a hello"),
        };
        let place = claim(hub, room, &hello)?;
        let pipeline = Pipeline::new(hub.character.clone(), &hub.config.solve, &hello, place.session)
            .map_err(|error| Stop::from(Ending::error(CloseCode::Policy, ErrorMessage::new("bad_hello", format!("hello: {error}")))))?;
        tracing::info!(%room, session = place.session, source = hello.source, takeover = hello.takeover, "publisher ready");
        let ready = Answer::Ready {
            version: PROTOCOL_VERSION,
            room: room.as_str(),
            session: place.session,
            character: &hub.character.name,
            bones: hub.character.bones.iter().map(|bone| bone.name.as_str()).collect(),
        };
        send_json(socket, &ready, seconds(hub.config.timeouts.write)).await?;
        let now = Instant::now();
        Ok(Self {
            hub,
            place,
            pipeline,
            reader,
            frame,
            packet: Vec::new(),
            rate: Rate::new(hub.config.limits.frames_per_second, now),
            liveness: Liveness { last_heard: now, last_ping: now },
            num_frames: 0,
            num_bad_in_a_row: 0,
        })
    }

    /// Takes messages until the session ends.
    async fn run(&mut self, socket: &mut Socket) -> Result<std::convert::Infallible, Stop> {
        let timeouts = &self.hub.config.timeouts;
        let (ping, idle, write) = (seconds(timeouts.ping), seconds(timeouts.publisher_idle), seconds(timeouts.write));
        let mut shutdown = self.hub.shutdown.clone();
        loop {
            let wake = (self.liveness.last_ping + ping).min(self.liveness.last_heard + idle);
            tokio::select! {
                () = stopped(&mut shutdown) => return Err(Ending::shutdown().into()),
                _ = &mut self.place.evicted => return Err(taken_over()),
                message = socket.next() => {
                    self.liveness.last_heard = Instant::now();
                    let text = match message {
                        Some(Ok(Message::Text(text))) => text,
                        Some(Ok(Message::Binary(_))) => {
                            self.refuse(socket, ErrorMessage::new("binary_message", BINARY)).await?;
                            continue;
                        }
                        Some(Ok(Message::Close(_))) | None => return Err(Stop::Gone("closed")),
                        Some(Ok(_)) => continue,
                        Some(Err(error)) => return Err(broken(error, self.hub)),
                    };
                    self.hub.metrics.bytes_in.inc_by(text.len() as u64);
                    self.take(socket, &text).await?;
                }
                () = tokio::time::sleep_until(wake) => {
                    let now = Instant::now();
                    if now >= self.liveness.last_heard + idle {
                        let message = format!("nothing heard for {} seconds", timeouts.publisher_idle);
                        return Err(Ending::error(CloseCode::Policy, ErrorMessage::new("idle", message)).into());
                    }
                    self.liveness.last_ping = now;
                    send(socket, Message::Ping(Bytes::new()), write).await?;
                }
            }
        }
    }

    /// Takes one text message.
    async fn take(&mut self, socket: &mut Socket, text: &str) -> Result<(), Stop> {
        let write = seconds(self.hub.config.timeouts.write);
        match self.reader.read(text, &mut self.frame) {
            Ok(PublishMessage::Calibrate) => self.pipeline.calibrate(),
            Ok(PublishMessage::Hello(_)) => unreachable!("the reader refuses a second hello"),
            Ok(PublishMessage::Frame) => {
                let start = std::time::Instant::now();
                if let Err(error) = self.pipeline.solve(&self.frame) {
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
                self.hold_back(socket).await?;
            }
            Err(error) => return self.refuse(socket, ErrorMessage::new(error.code, error.message)).await,
        }
        if let Some(report) = self.pipeline.take_calibrated() {
            let answer = Answer::Calibrated {
                t: report.t,
                frames: report.num_frames,
                requested: report.requested,
                added_delay: self.pipeline.added_delay(),
            };
            send_json(socket, &answer, write).await?;
        }
        Ok(())
    }

    /// Slows a sender that is too fast: nothing is read meanwhile, so its own socket fills up. Its frames are not dropped.
    async fn hold_back(&mut self, socket: &mut Socket) -> Result<(), Stop> {
        let Some(until) = self.rate.take(Instant::now()) else { return Ok(()) };
        if !std::mem::replace(&mut self.rate.has_told, true) {
            let most = self.hub.config.limits.frames_per_second;
            let message = format!("more than {most} frames a second: the server reads no faster, no frame is dropped");
            send_json(socket, &ErrorMessage::new("too_fast", message), seconds(self.hub.config.timeouts.write)).await?;
        }
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
            let message = format!("{most} bad messages in a row, the last one: {}", error.message);
            return Err(Ending::error(CloseCode::Policy, ErrorMessage::new("too_many_bad_frames", message)).into());
        }
        Ok(())
    }
}

const BINARY: &str = "message is binary, expected JSON text";

/// The first text message.
async fn first_text(socket: &mut Socket, hub: &Hub) -> Result<tokio_tungstenite::tungstenite::Utf8Bytes, Stop> {
    loop {
        match socket.next().await {
            Some(Ok(Message::Text(text))) => return Ok(text),
            Some(Ok(Message::Binary(_))) => {
                return Err(Ending::error(CloseCode::Unsupported, ErrorMessage::new("binary_message", BINARY)).into());
            }
            Some(Ok(Message::Close(_))) | None => return Err(Stop::Gone("closed")),
            Some(Ok(_)) => {}
            Some(Err(error)) => return Err(broken(error, hub)),
        }
    }
}

fn claim(hub: &Hub, room: &RoomName, hello: &PublishHello) -> Result<Publishing, Stop> {
    hub.rooms.claim(room, &hello.source, hello.takeover).map_err(|error| {
        let code = match error {
            RoomError::Taken => CloseCode::Policy,
            RoomError::TooManyRooms { .. } | RoomError::TooManyViewers { .. } => CloseCode::Again,
        };
        Ending::error(code, ErrorMessage::new(error.code(), error.to_string())).into()
    })
}

fn taken_over() -> Stop {
    Ending::error(CloseCode::Policy, ErrorMessage::new("taken_over", "another publisher has taken the room over")).into()
}

/// What a broken stream of messages means for its sender.
fn broken(error: Error, hub: &Hub) -> Stop {
    match error {
        Error::Capacity(CapacityError::MessageTooLong { size, .. }) => {
            let message = format!("message has {size} bytes or more, at most {} are allowed", hub.config.limits.message_bytes);
            Ending::error(CloseCode::Size, ErrorMessage::new("too_long", message)).into()
        }
        Error::Utf8(_) => Ending::error(CloseCode::Invalid, ErrorMessage::new("not_utf8", "text message is not UTF-8")).into(),
        Error::Protocol(error) => Ending::error(CloseCode::Protocol, ErrorMessage::new("protocol", error.to_string())).into(),
        _ => Stop::Gone("connection_lost"),
    }
}

/// When the peer was last heard and pinged.
struct Liveness {
    last_heard: Instant,
    last_ping: Instant,
}

/// Frames a second, with a burst of a tenth of a second.
struct Rate {
    interval: Duration,
    burst: Duration,
    /// When the frames so far would have come at the allowed rate.
    due: Instant,
    /// The sender knows that it is too fast.
    has_told: bool,
}

impl Rate {
    fn new(frames_per_second: u32, now: Instant) -> Self {
        let interval = Duration::from_secs(1) / frames_per_second;
        let burst = (interval * 2).max(Duration::from_millis(100));
        Self { interval, burst, due: now.checked_sub(burst).unwrap_or(now), has_told: false }
    }

    /// Counts a frame; gives the time before which no other shall be read.
    fn take(&mut self, now: Instant) -> Option<Instant> {
        let earliest = now.checked_sub(self.burst).unwrap_or(now);
        self.due = self.due.max(earliest) + self.interval;
        (self.due > now).then_some(self.due)
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
}
