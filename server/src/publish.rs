//! One publisher: its messages are read, solved, encoded and put into its room, in the order they come.

use crate::answer::Answer;
use crate::cluster::LeaseError;
use crate::config::seconds;
use crate::http::Pass;
use crate::room::RoomError;
use crate::service::{Hub, stopped};
use crate::socket::{Ending, ErrorMessage, Socket, Stop, broken, end, send, send_json};
use crate::source::{FrameError, OpenError, Prepared, Sent, Source};
use futures_util::StreamExt;
use rhytid_shared::view::PROTOCOL_VERSION;
use rhytid_shared::{MessageError, PublishHello, PublishMessage, PublishReader, RoomName, TrackingFrame};
use std::convert::Infallible;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;
use tokio::time::Instant;
use tokio_tungstenite::tungstenite::protocol::WebSocketConfig;
use tokio_tungstenite::tungstenite::protocol::frame::coding::CloseCode;
use tokio_tungstenite::tungstenite::{Bytes, Message, Utf8Bytes};

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
    let (hello, text) = tokio::select! {
        biased;
        () = stopped(&mut shutdown) => return Err(Ending::shutdown().into()),
        hello = tokio::time::timeout(seconds(timeouts.hello), read_hello(hub, socket, &mut reader)) => match hello {
            Ok(hello) => hello?,
            Err(_) => return Err(refusal("hello_timeout", format!("no hello within {} seconds", timeouts.hello))),
        },
    };
    let prepared = tokio::select! {
        biased;
        () = stopped(&mut shutdown) => return Err(Ending::shutdown().into()),
        () = until(pass.expires) => return Err(Ending::token_expired().into()),
        prepared = enter(hub, room, hello) => prepared?,
    };
    let (source, evicted) = Source::open(hub, room, prepared, Some(text)).map_err(|error| not_opened(error.into()))?;
    let heard = Heard::now();
    let mut session = Session::new(hub, pass, source, reader);
    Err(tokio::select! {
        biased;
        () = stopped(&mut shutdown) => Ending::shutdown().into(),
        _ = evicted => taken_over(),
        () = until(pass.expires) => Ending::token_expired().into(),
        result = session.run(socket, &heard) => match result { Err(stop) => stop },
        () = heard.silence(seconds(timeouts.publisher_idle)) => {
            refusal("idle", format!("nothing heard for {} seconds", timeouts.publisher_idle))
        }
    })
}

/// Makes this node the room's home, where there are others.
async fn enter(hub: &Hub, room: &RoomName, hello: PublishHello) -> Result<Prepared, Stop> {
    let Some(cluster) = &hub.cluster else {
        let kept = hub.rooms.kept(room, &hello);
        return Prepared::new(hub, hello, kept).map_err(not_opened);
    };
    let kept = cluster.find_kept(&hub.rooms, room, &hello).await;
    // Before anybody at another node loses the room to it.
    let prepared = Prepared::new(hub, hello, kept.clone()).map_err(not_opened)?;
    cluster.enter(&hub.rooms, room, &prepared.hello, kept).await.map_err(not_entered)?;
    Ok(prepared)
}

/// Reads up to the hello.
async fn read_hello(hub: &Hub, socket: &mut Socket, reader: &mut PublishReader) -> Result<(PublishHello, Utf8Bytes), Stop> {
    let text = first_text(socket, hub).await?;
    hub.metrics.bytes_in.inc_by(text.len() as u64);
    match reader.read(&text, &mut TrackingFrame::default()) {
        Ok(PublishMessage::Hello(hello)) => Ok((hello, text)),
        Ok(_) => unreachable!("the reader refuses all else before a hello"),
        Err(MessageError { code, message }) => Err(refusal(code, message)),
    }
}

/// A publisher that has claimed its slot.
struct Session<'a> {
    hub: &'a Hub,
    pass: &'a Pass,
    source: Source,
    reader: PublishReader,
    frame: TrackingFrame,
    messages: Rate,
    /// The sender knows that it is too fast.
    has_told_rate: bool,
    num_bad_in_a_row: u32,
}

impl<'a> Session<'a> {
    fn new(hub: &'a Hub, pass: &'a Pass, source: Source, reader: PublishReader) -> Self {
        Self {
            hub,
            pass,
            source,
            reader,
            frame: TrackingFrame::default(),
            messages: Rate::new(hub.config.limits.frames_per_second, Instant::now()),
            has_told_rate: false,
            num_bad_in_a_row: 0,
        }
    }

    /// Says that it is ready and takes messages until the session ends. May be dropped at any await.
    async fn run(&mut self, socket: &mut Socket, heard: &Heard) -> Result<Infallible, Stop> {
        let character = &self.hub.character;
        let ready = Answer::Ready {
            version: PROTOCOL_VERSION,
            room: self.source.room().as_str(),
            session: self.source.session(),
            resume_key: self.source.resume_key(),
            kept_neutral: self.source.kept_neutral,
            character: &character.name,
            bones: character.bones.iter().map(|bone| bone.name.as_str()).collect(),
            profile: self.source.profile_name(),
        };
        let timeouts = &self.hub.config.timeouts;
        let (ping, write) = (seconds(timeouts.ping), seconds(timeouts.write));
        send(socket, Message::Text(ready.text()), write).await?;
        let mut last_ping = Instant::now();
        loop {
            let message = tokio::select! {
                message = socket.next() => message,
                control = self.source.next_control() => {
                    self.source.control(control);
                    continue;
                }
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
                    let message = self.reader.read(&text, &mut self.frame);
                    self.take(socket, message, Sent::Text(text)).await?;
                }
                Some(Ok(Message::Binary(bytes))) => {
                    self.hub.metrics.bytes_in.inc_by(bytes.len() as u64);
                    let message = self.reader.read_binary(&bytes, &mut self.frame);
                    self.take(socket, message, Sent::Binary(bytes)).await?;
                }
                Some(Ok(Message::Close(_))) | None => return Err(Stop::Gone("closed")),
                Some(Ok(_)) => {}
                Some(Err(error)) => return Err(broken(error, self.hub.config.limits.message_bytes)),
            }
            self.hold_back(socket, heard).await?;
        }
    }

    /// Takes one message as it was read.
    async fn take(&mut self, socket: &mut Socket, message: Result<PublishMessage, MessageError>, sent: Sent) -> Result<(), Stop> {
        match message {
            Ok(PublishMessage::Command(command)) => match self.source.command(command) {
                Ok(answer) => {
                    self.source.record_taken(sent);
                    if let Some(answer) = answer {
                        send(socket, Message::Text(answer), seconds(self.hub.config.timeouts.write)).await?;
                    }
                }
                Err(error) => return self.refuse(socket, sent, error).await,
            },
            Ok(PublishMessage::Hello(_)) => unreachable!("the reader refuses a second hello"),
            Ok(PublishMessage::Frame) => match self.source.frame(self.hub, &self.frame, Some(sent.clone())) {
                Ok(()) => self.num_bad_in_a_row = 0,
                Err(FrameError::Evicted) => return Err(taken_over()),
                Err(FrameError::Bad(error)) => {
                    self.reader.take_back();
                    return self.refuse(socket, sent, ErrorMessage::new("bad_frame", error.to_string())).await;
                }
            },
            Err(error) => return self.refuse(socket, sent, ErrorMessage::new(error.code, error.message)).await,
        }
        for told in self.source.news() {
            match told {
                Ok(text) => send(socket, Message::Text(text), seconds(self.hub.config.timeouts.write)).await?,
                // The step is to be made again; no message was bad.
                Err(error) => send_json(socket, &error, seconds(self.hub.config.timeouts.write)).await?,
            }
        }
        Ok(())
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
    async fn refuse(&mut self, socket: &mut Socket, sent: Sent, error: ErrorMessage) -> Result<(), Stop> {
        self.source.record_refused(sent);
        self.hub.metrics.drop_frames(error.code, 1);
        self.num_bad_in_a_row += 1;
        tracing::debug!(room = %self.source.room(), code = error.code, message = error.message, "bad message from publisher");
        send_json(socket, &error, seconds(self.hub.config.timeouts.write)).await?;
        let most = self.hub.config.limits.bad_frames_in_a_row;
        if self.num_bad_in_a_row >= most {
            return Err(refusal("too_many_bad_frames", format!("{most} bad messages in a row, the last one: {}", error.message)));
        }
        Ok(())
    }
}

const BINARY: &str = "the first message is binary, expected the hello as JSON text";

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

/// The end of a publisher that could not enter its room.
fn not_opened(error: OpenError) -> Stop {
    match error {
        OpenError::Hello(_) => refusal("bad_hello", error.to_string()),
        OpenError::Profile(_) => refusal("unknown_profile", error.to_string()),
        OpenError::Room(refused) => {
            let code = match refused {
                RoomError::Taken | RoomError::SlotTaken => CloseCode::Policy,
                RoomError::TooManyRooms { .. }
                | RoomError::TooManyViewers { .. }
                | RoomError::TooManySlots { .. }
                | RoomError::Elsewhere => CloseCode::Again,
            };
            Ending::error(code, ErrorMessage::new(refused.code(), refused.to_string())).into()
        }
    }
}

/// The end of a publisher whose room cannot have its home here.
fn not_entered(error: LeaseError) -> Stop {
    match error {
        LeaseError::Room(error) => not_opened(error.into()),
        // As for those who are in already: it is no fault of theirs, and another node takes them.
        LeaseError::Leaving => Ending::shutdown().into(),
        error => refusal(error.code(), error.to_string()),
    }
}

/// The end of a publisher that does not keep the rules.
fn refusal(code: &'static str, message: String) -> Stop {
    Ending::error(CloseCode::Policy, ErrorMessage::new(code, message)).into()
}

/// Done at `end`, where there is one.
pub(crate) async fn until(end: Option<Instant>) {
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
pub(crate) struct Rate {
    interval: Duration,
    burst: Duration,
    /// When what came so far would have come at the allowed rate.
    due: Instant,
}

impl Rate {
    pub fn new(per_second: u32, now: Instant) -> Self {
        let interval = Duration::from_secs(1) / per_second;
        let burst = (interval * 2).max(Duration::from_millis(100));
        Self { interval, burst, due: now.checked_sub(burst).unwrap_or(now) }
    }

    /// Counts one; gives the time before which no other shall be read.
    pub fn take(&mut self, now: Instant) -> Option<Instant> {
        let earliest = now.checked_sub(self.burst).unwrap_or(now);
        self.due = self.due.max(earliest) + self.interval;
        (self.due > now).then_some(self.due)
    }

    /// Counts one where the rate allows it now.
    pub fn take_if_free(&mut self, now: Instant) -> bool {
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
