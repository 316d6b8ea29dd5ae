//! The other ends of all sockets, in one thread: a publisher a room, and the viewers. The clock is this process's monotonic
//! one at both ends: a frame is stamped when its publisher writes it, and again at each viewer when the read that brought it
//! has returned.

use super::frames::{BINARY, CLOSE, Frame, FrameReader, PING, PONG, TEXT, packet_seq, put_frame, put_packet_head};
use super::{Feed, LoadError, USEFUL_WITHIN};
use hdrhistogram::Histogram;
use mio::net::TcpStream;
use mio::{Events, Interest, Poll, Token};
use rhytid_shared::view::SUBPROTOCOL;
use std::collections::VecDeque;
use std::io::{ErrorKind, Read, Write};
use std::net::SocketAddr;
use std::time::{Duration, Instant};

/// Handshakes under way at a time: the generator is no storm.
const MOST_HANDSHAKES: usize = 64;
/// How long a viewer that reconnects all the time stays.
const STAY: Duration = Duration::from_millis(500);
/// How long everybody may take to get in.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(60);
/// Bytes a publisher holds for a server that does not read; frames beyond are not sent, and counted.
const MOST_UNSENT: usize = 64 << 10;
/// For so long after an event the generator asks for the next one without sleeping: else every send of the server would have to
/// wake it, which costs the server as much as the send, and which no viewer on another machine asks of it.
const SPIN: Duration = Duration::from_micros(200);
/// Share of the warm-up over which the publishers begin, one after the other.
const STARTS: f64 = 0.5;
/// Events between two looks at the frames that are due.
const EVENTS_A_LOOK: usize = 32;

/// Who the sockets are.
pub(super) struct Crowd {
    pub rooms: usize,
    pub viewers: usize,
    pub stalled: usize,
    pub reconnecting: usize,
}

/// What the viewers saw between two moments; those that stall or reconnect are not counted.
pub(super) struct Seen {
    /// Nanoseconds.
    pub latencies: Histogram<u64>,
    /// Frames that came within [`USEFUL_WITHIN`].
    pub num_useful: u64,
    /// Frames that were older than one that had come before.
    pub num_backwards: u64,
    pub num_bytes: u64,
    /// Frames that the publishers sent.
    pub num_published: u64,
    /// Frames that a publisher could not send as the server did not read.
    pub num_held: u64,
    /// Viewers whose connection ended.
    pub num_lost: u64,
    pub num_reconnects: u64,
}

impl Seen {
    fn new() -> Self {
        Self {
            // To a minute, three digits.
            latencies: Histogram::new_with_bounds(1000, 60_000_000_000, 3).expect("sound bounds"),
            num_useful: 0,
            num_backwards: 0,
            num_bytes: 0,
            num_published: 0,
            num_held: 0,
            num_lost: 0,
            num_reconnects: 0,
        }
    }
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum Role {
    Publisher,
    Viewer,
    Stalled,
    Reconnecting,
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum Phase {
    /// Its turn to connect has not come.
    Outside,
    /// The answer to the handshake has not come whole.
    Handshake,
    /// The publisher's `ready`, the viewer's hello has not come.
    Hello,
    Live,
    /// Its connection is gone.
    Gone,
}

struct Peer {
    role: Role,
    room: usize,
    phase: Phase,
    stream: Option<TcpStream>,
    reader: FrameReader,
    /// The head of an HTTP answer so far.
    answer: Vec<u8>,
    /// What could not be written yet.
    unsent: Vec<u8>,
    /// Newest frame seen, plus 1; of a publisher, frames sent.
    next_seq: usize,
    /// Connections so far.
    num_connections: u32,
}

pub(super) struct Generator<'a> {
    address: SocketAddr,
    feed: Feed<'a>,
    poll: Poll,
    events: Events,
    peers: Vec<Peer>,
    num_rooms: usize,
    /// By room and number of frame: when it was written, nanoseconds from `start`.
    stamps: Vec<Vec<u64>>,
    start: Instant,
    waiting: VecDeque<usize>,
    leaving: VecDeque<(Instant, usize)>,
    num_handshakes: usize,
    num_out: usize,
    seen: Option<Seen>,
    buffer: Vec<u8>,
    message: Vec<u8>,
    problem: Option<String>,
    last_event: Instant,
    /// Frames go to many viewers each; else there is always one within [`SPIN`], and the generator would never sleep.
    has_bursts: bool,
    /// The earliest frame that is due, seconds from `start`.
    next_due: f64,
    /// A key packet of the read that is being handled: number, bytes of payload.
    pending_key: Option<(usize, usize)>,
}

impl<'a> Generator<'a> {
    /// Opens all sockets to `address` and waits until everybody is in.
    pub fn connect(address: SocketAddr, crowd: &Crowd, feed: Feed<'a>) -> Result<Self, LoadError> {
        let system = |source| LoadError::System { what: "wait for sockets", source };
        let peer = |role, room| Peer {
            role,
            room,
            phase: Phase::Outside,
            stream: None,
            reader: FrameReader::default(),
            answer: Vec::new(),
            unsent: Vec::new(),
            next_seq: 0,
            num_connections: 0,
        };
        let mut peers: Vec<Peer> = (0..crowd.rooms).map(|room| peer(Role::Publisher, room)).collect();
        // Spread over all, so that no end of the room's list has them all.
        let is_nth = |k: usize, share: usize| (k + 1) * share / crowd.viewers != k * share / crowd.viewers;
        let mut num_stalled = 0;
        for k in 0..crowd.viewers {
            let role = match () {
                () if is_nth(k, crowd.stalled + crowd.reconnecting) => {
                    num_stalled += 1;
                    // Turn by turn, as far as there are some of each.
                    let is_stalled = (num_stalled % 2 == 1 || crowd.reconnecting == 0) && crowd.stalled > 0;
                    if is_stalled { Role::Stalled } else { Role::Reconnecting }
                }
                () => Role::Viewer,
            };
            peers.push(peer(role, k % crowd.rooms));
        }
        let mut generator = Self {
            address,
            feed,
            poll: Poll::new().map_err(system)?,
            events: Events::with_capacity(1024),
            waiting: (0..peers.len()).collect(),
            leaving: VecDeque::new(),
            num_rooms: crowd.rooms,
            stamps: vec![Vec::new(); crowd.rooms],
            start: Instant::now(),
            num_handshakes: 0,
            num_out: peers.len(),
            peers,
            seen: None,
            buffer: vec![0; 64 << 10],
            message: Vec::new(),
            problem: None,
            last_event: Instant::now(),
            has_bursts: crowd.viewers >= 16 * crowd.rooms,
            next_due: 0.0,
            pending_key: None,
        };
        let until = Instant::now() + CONNECT_TIMEOUT;
        while generator.num_out > 0 {
            generator.turn(Instant::now() + Duration::from_millis(100), f64::INFINITY)?;
            if Instant::now() > until {
                return Err(LoadError::Server(format!("{} sockets did not get in within a minute", generator.num_out)));
            }
        }
        Ok(generator)
    }

    /// Publishes `fps` frames a second to each room for a time, which is counted where `counts` says so; else it is the warm-up.
    pub fn run(&mut self, fps: f64, time: Duration, counts: bool) -> Result<Option<Seen>, LoadError> {
        if !counts {
            // People do not all come in the same instant, nor do what a session does at some age of its own.
            let (now, step) = (self.start.elapsed().as_secs_f64(), time.as_secs_f64() * STARTS / self.num_rooms as f64);
            let interval = 1.0 / fps;
            for (room, due) in self.feed.due.iter_mut().enumerate() {
                // In whole intervals, and then evenly over one: multiples of the golden ratio.
                let phase = (room as f64 * 0.618_033_988_75).fract();
                *due = now + ((room as f64 * step / interval).floor() + phase) * interval;
            }
            self.next_due = now;
        }
        self.seen = counts.then(Seen::new);
        let until = Instant::now() + time;
        while Instant::now() < until {
            self.turn(until, fps)?;
        }
        Ok(self.seen.take())
    }

    /// Waits for events or for the next frame that is due, at most until `until`, and handles them.
    fn turn(&mut self, until: Instant, fps: f64) -> Result<(), LoadError> {
        let publishes = fps.is_finite();
        let mut next = until;
        if publishes {
            next = next.min(self.publish(fps));
        }
        self.meet();
        let now = Instant::now();
        let is_in_burst = publishes && self.has_bursts && now < self.last_event + SPIN;
        let timeout = if is_in_burst { Duration::ZERO } else { next.saturating_duration_since(now) };
        let mut events = std::mem::replace(&mut self.events, Events::with_capacity(0));
        match self.poll.poll(&mut events, Some(timeout)) {
            Ok(()) => {}
            Err(error) if error.kind() == ErrorKind::Interrupted => {}
            Err(source) => return Err(LoadError::System { what: "wait for sockets", source }),
        }
        if !events.is_empty() {
            self.last_event = Instant::now();
        }
        for (k, event) in events.iter().enumerate() {
            let at = event.token().0;
            if event.is_writable() {
                self.write(at);
            }
            if event.is_readable() || event.is_read_closed() || event.is_error() {
                self.read(at);
            }
            if publishes && k % EVENTS_A_LOOK == EVENTS_A_LOOK - 1 {
                self.publish(fps);
            }
        }
        self.events = events;
        self.problem.take().map_or(Ok(()), |problem| Err(LoadError::Server(problem)))
    }

    /// Sends the frames that are due; when the next one is.
    fn publish(&mut self, fps: f64) -> Instant {
        let interval = 1.0 / fps;
        if self.next_due > self.start.elapsed().as_secs_f64() {
            return self.start + Duration::from_secs_f64(self.next_due);
        }
        // The schedule is the process's: frames that a pause has missed are left out, not caught up with.
        let mut first = f64::INFINITY;
        for room in 0..self.num_rooms {
            let now = self.start.elapsed().as_secs_f64();
            let due = self.feed.due[room];
            if due <= now {
                self.publish_one(room);
                let missed = ((now - due) / interval).floor();
                self.feed.due[room] = due + interval * (1.0 + missed);
            }
            first = first.min(self.feed.due[room]);
        }
        self.next_due = first;
        self.start + Duration::from_secs_f64(first)
    }

    fn publish_one(&mut self, room: usize) {
        let peer = &mut self.peers[room];
        if peer.phase != Phase::Live {
            return;
        }
        if peer.unsent.len() > MOST_UNSENT {
            if let Some(seen) = &mut self.seen {
                seen.num_held += 1;
            }
            return;
        }
        self.message.clear();
        let seq = peer.next_seq;
        // Each performer is at another moment of the session: a thousand who do the same at once are a chorus, and the server would
        // search all their neutral faces anew in the same instant.
        let moment = seq + room * self.feed.lines.len() / self.num_rooms;
        self.feed.put(seq, moment, &mut self.message);
        peer.next_seq += 1;
        let is_blocked = !peer.unsent.is_empty();
        put_frame(self.feed.opcode(), &[&self.message], &mut peer.unsent);
        self.stamps[room].push(self.start.elapsed().as_nanos() as u64);
        if let Some(seen) = &mut self.seen {
            seen.num_published += 1;
        }
        if !is_blocked {
            self.write(room);
        }
    }

    /// Lets those in whose turn it is, and those out who have stayed long enough.
    fn meet(&mut self) {
        let now = Instant::now();
        while let Some(&(due, at)) = self.leaving.front()
            && due <= now
        {
            self.leaving.pop_front();
            let peer = &mut self.peers[at];
            // Every other one says that it goes.
            if peer.num_connections.is_multiple_of(2)
                && let Some(stream) = &mut peer.stream
            {
                let mut close = Vec::new();
                put_frame(CLOSE, &[&1000u16.to_be_bytes()], &mut close);
                // It goes anyway.
                let _ = stream.write(&close);
            }
            peer.stream = None;
            peer.phase = Phase::Outside;
            self.waiting.push_back(at);
            if let Some(seen) = &mut self.seen {
                seen.num_reconnects += 1;
            }
        }
        while self.num_handshakes < MOST_HANDSHAKES
            && let Some(at) = self.waiting.pop_front()
        {
            if let Err(error) = self.open(at) {
                self.problem = Some(format!("cannot connect: {error}"));
            }
        }
    }

    fn open(&mut self, at: usize) -> std::io::Result<()> {
        let peer = &mut self.peers[at];
        let mut stream = TcpStream::connect(self.address)?;
        stream.set_nodelay(true)?;
        // Edge-triggered: what never blocks costs no second event.
        self.poll.registry().register(&mut stream, Token(at), Interest::READABLE | Interest::WRITABLE)?;
        let end = if peer.role == Role::Publisher { "publish" } else { "view" };
        let request = format!(
            "GET /v1/rooms/load-{}/{end} HTTP/1.1\r\nHost: {}\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n\
             Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Protocol: {SUBPROTOCOL}\r\n\r\n",
            peer.room, self.address
        );
        peer.stream = Some(stream);
        peer.phase = Phase::Handshake;
        peer.reader = FrameReader::default();
        peer.answer.clear();
        peer.unsent = request.into_bytes();
        peer.num_connections += 1;
        self.num_handshakes += 1;
        Ok(())
    }

    fn write(&mut self, at: usize) {
        let peer = &mut self.peers[at];
        let Some(stream) = &mut peer.stream else { return };
        while !peer.unsent.is_empty() {
            match stream.write(&peer.unsent) {
                Ok(num_written) => drop(peer.unsent.drain(..num_written)),
                Err(error) if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::NotConnected) => return,
                Err(error) => return self.lose(at, &error.to_string()),
            }
        }
    }

    fn read(&mut self, at: usize) {
        loop {
            let peer = &mut self.peers[at];
            if peer.role == Role::Stalled && peer.phase == Phase::Live {
                return;
            }
            let Some(stream) = &mut peer.stream else { return };
            match stream.read(&mut self.buffer) {
                Ok(0) => return self.lose(at, "it closed"),
                Ok(num_bytes) => {
                    let now = self.start.elapsed().as_nanos() as u64;
                    self.take(at, num_bytes, now);
                    // Less than there was room for: the socket is empty, and says so when it is not.
                    if num_bytes < self.buffer.len() {
                        return;
                    }
                }
                Err(error) if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::NotConnected) => return,
                Err(error) if error.kind() == ErrorKind::Interrupted => {}
                Err(error) => return self.lose(at, &error.to_string()),
            }
        }
    }

    /// Handles what has come for `at` by `now`, the first `num_bytes` of the buffer.
    fn take(&mut self, at: usize, num_bytes: usize, now: u64) {
        let buffer = std::mem::take(&mut self.buffer);
        let mut bytes = &buffer[..num_bytes];
        let peer = &mut self.peers[at];
        let mut rest = Vec::new();
        if peer.phase == Phase::Handshake {
            peer.answer.extend_from_slice(bytes);
            bytes = &[];
            if let Some(end) = peer.answer.windows(4).position(|window| window == b"\r\n\r\n") {
                rest = peer.answer.split_off(end + 4);
                self.num_handshakes -= 1;
                peer.phase = Phase::Hello;
                if !peer.answer.starts_with(b"HTTP/1.1 101") {
                    let line = String::from_utf8_lossy(&peer.answer).lines().next().unwrap_or_default().to_owned();
                    self.problem = Some(format!("it refused a handshake: {line}"));
                }
                peer.answer = Vec::new();
                if peer.role == Role::Publisher
                    && let Some(hello) = self.feed.hello()
                {
                    put_frame(TEXT, &[hello.as_bytes()], &mut peer.unsent);
                }
            }
        }
        let bytes = if rest.is_empty() { bytes } else { &rest };
        let mut reader = std::mem::take(&mut self.peers[at].reader);
        reader.read(bytes, |frame| self.take_frame(at, &frame, now));
        if let Some((seq, len)) = self.pending_key.take() {
            self.count(at, seq, len, now);
        }
        self.peers[at].reader = reader;
        self.buffer = buffer;
        if !self.peers[at].unsent.is_empty() {
            self.write(at);
        }
    }

    fn take_frame(&mut self, at: usize, frame: &Frame<'_>, now: u64) {
        let peer = &mut self.peers[at];
        match frame.opcode {
            BINARY => {
                let Some(seq) = packet_seq(frame.head) else {
                    self.problem = Some("it sent a packet that is none".into());
                    return;
                };
                // A key packet that comes together with a delta is what that is read with, no frame of its own.
                let is_delta = frame.head[0] & 1 == 1;
                if let Some((key, len)) = self.pending_key.take()
                    && !is_delta
                {
                    self.count(at, key, len, now);
                }
                if is_delta {
                    self.count(at, seq, frame.len, now);
                } else {
                    self.pending_key = Some((seq, frame.len));
                }
            }
            PING => put_frame(PONG, &[frame.head], &mut peer.unsent),
            TEXT if peer.phase == Phase::Hello => {
                let text = String::from_utf8_lossy(frame.head);
                if text.contains("\"type\":\"error\"") {
                    self.problem = Some(text.into_owned());
                }
                peer.phase = Phase::Live;
                if peer.num_connections == 1 {
                    self.num_out -= 1;
                }
                if peer.role == Role::Reconnecting {
                    self.leaving.push_back((Instant::now() + STAY, at));
                }
            }
            TEXT => {
                let text = String::from_utf8_lossy(frame.head);
                if text.contains("\"type\":\"error\"") && !text.contains("too_fast") {
                    self.problem = Some(text.into_owned());
                }
            }
            _ => {}
        }
    }

    /// Counts frame `seq` that a viewer has got.
    fn count(&mut self, at: usize, seq: usize, len: usize, now: u64) {
        let peer = &mut self.peers[at];
        let (Some(seen), Role::Viewer) = (&mut self.seen, peer.role) else { return };
        let Some(&sent) = self.stamps[peer.room].get(seq) else {
            self.problem = Some(format!("it sent frame {seq}, which nobody has published"));
            return;
        };
        if seq < peer.next_seq {
            seen.num_backwards += 1;
            return;
        }
        peer.next_seq = seq + 1;
        let latency = now.saturating_sub(sent);
        seen.latencies.saturating_record(latency);
        seen.num_bytes += len as u64;
        if latency <= USEFUL_WITHIN.as_nanos() as u64 {
            seen.num_useful += 1;
        }
    }

    fn lose(&mut self, at: usize, why: &str) {
        let peer = &mut self.peers[at];
        peer.stream = None;
        match (peer.role, peer.phase) {
            (Role::Publisher, _) | (_, Phase::Handshake | Phase::Hello) => {
                let role = if peer.role == Role::Publisher { "publisher" } else { "viewer" };
                self.problem.get_or_insert(format!("a {role}'s connection ended: {why}"));
            }
            // A server may send a stalled one away.
            (Role::Stalled, _) => {}
            _ => {
                if let Some(seen) = &mut self.seen {
                    seen.num_lost += 1;
                }
            }
        }
        peer.phase = Phase::Gone;
    }
}

impl Feed<'_> {
    fn opcode(&self) -> u8 {
        if self.lines.is_empty() { BINARY } else { TEXT }
    }

    /// What a publisher says first.
    fn hello(&self) -> Option<&str> {
        (!self.hello.is_empty()).then_some(self.hello)
    }

    /// Message number `seq` of a publisher, with the face of a `moment` of the session.
    fn put(&self, seq: usize, moment: usize, out: &mut Vec<u8>) {
        if self.lines.is_empty() {
            put_packet_head(seq, out);
            out.resize(self.packet_bytes, 0xA5);
        } else {
            let [before, after] = self.lines[moment % self.lines.len()];
            out.extend_from_slice(before.as_bytes());
            write!(out, "{:.4}", seq as f64 * self.interval).expect("memory can be written");
            out.extend_from_slice(after.as_bytes());
        }
    }
}
