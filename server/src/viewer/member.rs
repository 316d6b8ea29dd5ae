//! One viewer: its socket, its pace, and what the kernel has not taken yet.

use super::LARGEST_MESSAGE;
use super::audience::Bell;
use super::pace::Pace;
use crate::config::seconds;
use crate::framed::ping;
use crate::metrics::Metrics;
use crate::room::{Latest, Viewing};
use crate::service::{Allowance, Hub, Place};
use crate::socket::{Ending, ErrorMessage, Socket, Stop, broken, end};
use futures_util::{SinkExt, StreamExt};
use std::io;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll, ready};
use std::time::Duration;
use tokio::io::{AsyncWrite, AsyncWriteExt};
use tokio::time::Instant;
use tokio_tungstenite::tungstenite::protocol::frame::coding::CloseCode;
use tokio_tungstenite::tungstenite::{Bytes, Error, Message};

/// Messages a second from a viewer, after a burst of some seconds' worth: pongs, of which it has eight to send at most, and pings of
/// its own.
const MOST_MESSAGES: u32 = 50;
/// How long the rest of a begun packet may take before the last word; with that, less than the service waits for at its end.
const LAST_WRITE: Duration = Duration::from_millis(300);

/// A viewer of a room.
pub(crate) struct Member {
    pace: Pace,
    sent: Sent,
    outgoing: Outgoing,
    wants_json: bool,
    /// What it was let in with holds until then.
    expires: Option<Instant>,
    messages: Allowance,
    socket: Box<Socket>,
    viewing: Viewing,
    place: Option<Arc<Place>>,
}

/// What a viewer has been sent.
#[derive(Default)]
struct Sent {
    /// Index of the newest state.
    state: u64,
    /// Its era.
    era: u64,
    /// Index of the newest key packet.
    key: u64,
}

/// Who writes to the socket. Packets go around the WebSocket, which would copy them through its buffer. It writes by itself only
/// after it has read a ping or a close, so nothing is read while a packet is half written ([`Member::answer`]), and no packet is
/// begun while it has a pong to send ([`Member::show`]).
enum Outgoing {
    /// Nobody.
    Nothing,
    /// The rest of what was begun, and since when it waits; empty where a record of TLS waits.
    Rest { bytes: Bytes, since: Instant },
    /// The WebSocket has a pong to send.
    Pong { since: Instant },
}

impl Member {
    pub fn new(socket: Socket, viewing: Viewing, wants_json: bool, expires: Option<Instant>, place: Option<Arc<Place>>) -> Self {
        Self {
            pace: Pace::new(Instant::now(), viewing.room.since().into(), viewing.number),
            sent: Sent::default(),
            outgoing: Outgoing::Nothing,
            wants_json,
            expires,
            messages: Allowance::default(),
            socket: Box::new(socket),
            viewing,
            place,
        }
    }

    pub(super) fn viewing(&self) -> &Viewing {
        &self.viewing
    }

    /// Sends the newest state where the viewer has not got it and may have it.
    pub(super) fn show(&mut self, latest: &Latest, hub: &Hub, bell: &Bell, now: Instant, counts: &mut Counts) -> Result<(), Stop> {
        if self.sent.state == latest.index || !matches!(self.outgoing, Outgoing::Nothing) || !self.pace.has_credit(now) {
            return Ok(());
        }
        if self.sent.state > 0 && self.sent.era != latest.era {
            return Err(Ending::moved().into());
        }
        self.pace.last_packet = now;
        let with_ping = self.pace.takes_ping(now);
        let (key, newest) = (&latest.key.framed, latest.delta.as_ref().unwrap_or(&latest.key.framed));
        let num_bytes = if self.wants_json {
            let text = latest.json(&hub.layout, &hub.hello_character);
            self.write(text.frames(with_ping), || text.to_frames(with_ping), bell, now)?;
            text.payload().len()
        } else if latest.delta.is_some() && self.sent.key != latest.key.index {
            let both = key.to_frames_before(newest, with_ping);
            self.write(&both, || both.clone(), bell, now)?;
            key.payload().len() + newest.payload().len()
        } else {
            self.write(newest.frames(with_ping), || newest.to_frames(with_ping), bell, now)?;
            newest.payload().len()
        };
        counts.frames += 1;
        counts.bytes += num_bytes as u64;
        if self.sent.state > 0 {
            counts.skipped += latest.index - self.sent.state - 1;
        }
        self.sent = Sent { state: latest.index, era: latest.era, key: latest.key.index };
        Ok(())
    }

    /// Writes `frames`, or as much as the kernel takes and the rest later: then they are wanted as bytes to keep. Nothing else is
    /// being written.
    fn write(&mut self, frames: &[u8], keep: impl FnOnce() -> Bytes, bell: &Bell, now: Instant) -> Result<(), Stop> {
        let mut cx = bell.context();
        let wire = Pin::new(self.socket.get_mut());
        let num_written = match wire.poll_write(&mut cx, frames) {
            Poll::Ready(Ok(num_written)) => num_written,
            Poll::Ready(Err(_)) => return Err(Stop::Gone("connection_lost")),
            Poll::Pending => 0,
        };
        if num_written < frames.len() || self.socket.get_ref().is_encrypted() {
            self.outgoing = Outgoing::Rest { bytes: keep().slice(num_written..), since: now };
            self.go_on(bell)?;
        }
        Ok(())
    }

    /// Goes on with what was begun; the bell rings when there is more to do.
    fn go_on(&mut self, bell: &Bell) -> Result<(), Stop> {
        match self.poll_out(&mut bell.context()) {
            Poll::Ready(Ok(())) | Poll::Pending => Ok(()),
            Poll::Ready(Err(_)) => Err(Stop::Gone("connection_lost")),
        }
    }

    /// Done when nothing is left to be written.
    fn poll_out(&mut self, cx: &mut Context<'_>) -> Poll<Result<(), Error>> {
        match &mut self.outgoing {
            Outgoing::Nothing => {}
            Outgoing::Rest { bytes, .. } => {
                let wire = self.socket.get_mut();
                while !bytes.is_empty() {
                    match ready!(Pin::new(&mut *wire).poll_write(cx, bytes))? {
                        0 => return Poll::Ready(Err(Error::Io(io::ErrorKind::WriteZero.into()))),
                        num_written => drop(bytes.split_to(num_written)),
                    }
                }
                // Under TLS, a record may have been left behind.
                ready!(Pin::new(wire).poll_flush(cx))?;
            }
            Outgoing::Pong { .. } => ready!(self.socket.poll_flush_unpin(cx))?,
        }
        self.outgoing = Outgoing::Nothing;
        Poll::Ready(Ok(()))
    }

    /// Does what its socket has called for: goes on writing, and reads.
    pub(super) fn answer(&mut self, bell: &Bell, now: Instant) -> Result<(), Stop> {
        loop {
            self.go_on(bell)?;
            if !matches!(self.outgoing, Outgoing::Nothing) {
                // Reading could make the WebSocket write.
                return Ok(());
            }
            match self.socket.poll_next_unpin(&mut bell.context()) {
                Poll::Pending => return Ok(()),
                Poll::Ready(Some(Ok(_))) if !self.messages.take_if_free(MOST_MESSAGES, now.into_std()) => {
                    let message = format!("more than {MOST_MESSAGES} messages a second: a viewer has nothing to say");
                    return Err(Ending::error(CloseCode::Policy, ErrorMessage::new("too_fast", message)).into());
                }
                Poll::Ready(Some(Ok(Message::Pong(_)))) => self.pace.hear(now),
                Poll::Ready(Some(Ok(Message::Ping(_)))) => self.outgoing = Outgoing::Pong { since: now },
                Poll::Ready(Some(Ok(Message::Close(_))) | None) => return Err(Stop::Gone("closed")),
                // Viewers have nothing to say yet; what they say is ignored.
                Poll::Ready(Some(Ok(_))) => {}
                Poll::Ready(Some(Err(error))) => return Err(broken(error, LARGEST_MESSAGE)),
            }
        }
    }

    /// Does what the time asks for: a ping where no packet takes one along, or the end.
    pub(super) fn tick(&mut self, hub: &Hub, bell: &Bell, now: Instant) -> Result<(), Stop> {
        let timeouts = &hub.config.timeouts;
        let (idle, write) = (seconds(timeouts.viewer_idle), seconds(timeouts.write));
        let is_late = |member: &Self| {
            let is_stuck = member.writes_since().is_some_and(|since| now >= since + write);
            (now >= member.pace.last_heard + idle, is_stuck)
        };
        if is_late(self) != (false, false) {
            // After a pause of this machine what would keep it lies in the socket.
            self.answer(bell, now)?;
        }
        let (is_idle, is_stuck) = is_late(self);
        if is_idle {
            let message = format!("no pong for {} seconds", timeouts.viewer_idle);
            return Err(Ending::error(CloseCode::Policy, ErrorMessage::new("idle", message)).into());
        }
        if self.expires.is_some_and(|end| now >= end) {
            return Err(Ending::token_expired().into());
        }
        if is_stuck {
            return Err(Stop::Gone("write_timeout"));
        }
        if self.writes_since().is_none() && now >= self.pace.next_wake(seconds(timeouts.ping), now) && self.pace.takes_ping(now) {
            self.write(&ping(), ping, bell, now)?;
        }
        Ok(())
    }

    /// When [`Self::tick`] is next due, or a packet of the trickle.
    pub(super) fn next_tick(&self, hub: &Hub, now: Instant) -> Instant {
        let timeouts = &hub.config.timeouts;
        let mut next = self.pace.last_heard + seconds(timeouts.viewer_idle);
        next = match self.writes_since() {
            Some(since) => next.min(since + seconds(timeouts.write)),
            None => next.min(self.pace.next_wake(seconds(timeouts.ping), now)),
        };
        self.expires.map_or(next, |end| next.min(end))
    }

    fn writes_since(&self) -> Option<Instant> {
        match self.outgoing {
            Outgoing::Nothing => None,
            Outgoing::Rest { since, .. } | Outgoing::Pong { since } => Some(since),
        }
    }

    /// Ends it as `stop` says, in a task of its own.
    pub(super) fn end(self, stop: Stop, hub: Arc<Hub>) {
        let Self { mut socket, viewing, outgoing, place, .. } = self;
        drop(viewing);
        tokio::spawn(async move {
            // The last word comes behind what was begun, or not at all.
            let rest = async {
                if let (Outgoing::Rest { bytes, .. }, Stop::End(_)) = (&outgoing, &stop) {
                    socket.get_mut().write_all(bytes).await?;
                }
                io::Result::Ok(())
            };
            let is_whole = matches!(tokio::time::timeout(LAST_WRITE, rest).await, Ok(Ok(())));
            if is_whole {
                end(*socket, stop, &hub.metrics).await;
            } else {
                stop.count(&hub.metrics);
            }
            drop(place);
        });
    }
}

/// What looks at viewers count.
#[derive(Default)]
pub(super) struct Counts {
    pub frames: u64,
    pub bytes: u64,
    pub skipped: u64,
}

impl Counts {
    pub fn add_to(&self, metrics: &Metrics) {
        if self.frames > 0 {
            metrics.frames_out.inc_by(self.frames);
            metrics.bytes_out.inc_by(self.bytes);
        }
        if self.skipped > 0 {
            metrics.drop_frames("slow_viewer", self.skipped);
        }
    }
}
