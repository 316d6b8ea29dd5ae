//! The ports that listen for trackers: one task each, which reads datagrams, tells performers apart and puts each one's face
//! into a room. A bad datagram is counted and dropped, and nothing else happens.
//!
//! Bounded: a datagram by its protocol's largest, performers by [`MOST_PERFORMERS`] a port, each one's rate by the limit of
//! frames a second, each one's silence by the publisher's time-out. Nothing queues but in the kernel.

use super::session::{Clock, Framer, Swaps, Tick, hello, room_of};
use super::spec::{ListenSpec, RoomRule};
use super::{Protocol, Refusal, Seen, Sight, fmv3, ifacialmocap, livelink, openseeface, sniff, vmc, vts};
use crate::config::seconds;
use crate::publish::Rate;
use crate::room::Evicted;
use crate::service::{Hub, ServerError, stopped};
use crate::source::{FrameError, OpenError, Prepared, Source};
use rhytid_shared::{RoomName, Slot};
use serde::Serialize;
use std::collections::HashMap;
use std::net::{IpAddr, SocketAddr};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;
use tokio::net::UdpSocket;
use tokio::time::Instant;

/// Most performers, and most senders, on one port.
pub(crate) const MOST_PERFORMERS: usize = 16;
/// How often silent performers, greetings and the listing are looked after.
const ROUND: Duration = Duration::from_millis(200);
/// A room that could not be had is asked for again this often.
const RETRY: Duration = Duration::from_secs(1);
/// Sessions a second that begin on one port: each sets up a solve, which costs more than thousands of frames.
const SESSIONS_PER_SECOND: u32 = 10;
/// Whoever has been silent for this long gives way to a newcomer on the same port, as an app does that was started again.
const GIVES_WAY: Duration = Duration::from_millis(750);
/// A phone that has been silent for this long is asked again.
const SILENCE: Duration = Duration::from_secs(3);
/// Frames a second that a phone is asked for.
const ASKED_FPS: u16 = 60;

/// A port that is bound.
pub(crate) struct Port {
    spec: ListenSpec,
    socket: UdpSocket,
    address: SocketAddr,
}

impl Port {
    pub async fn bind(spec: &ListenSpec) -> Result<Self, ServerError> {
        let problem = |source| ServerError::Listen { address: format!("{} (udp)", spec.address), source };
        let socket = UdpSocket::bind(spec.address).await.map_err(problem)?;
        let address = socket.local_addr().map_err(problem)?;
        Ok(Self { spec: spec.clone(), socket, address })
    }
}

/// What all ports are doing, for the listing.
#[derive(Default)]
pub(crate) struct Trackers(Mutex<Vec<PortListing>>);

/// A port as `/api/trackers` lists it.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(crate) struct PortListing {
    protocol: &'static str,
    address: String,
    performers: Vec<PerformerListing>,
}

#[derive(Debug, Clone, PartialEq, Serialize)]
struct PerformerListing {
    source: String,
    room: String,
    slot: String,
    /// Its session in the room; nothing while another publisher has its slot.
    session: Option<u32>,
    /// Seconds since its last datagram.
    silent: f64,
}

impl Trackers {
    fn update(&self, index: usize, listing: PortListing) {
        let mut ports = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(port) = ports.get_mut(index) {
            *port = listing;
        }
    }

    pub fn list(&self) -> Vec<PortListing> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }
}

/// Starts a task for each port.
pub(crate) fn start(hub: &Arc<Hub>, ports: Vec<Port>) {
    let listing =
        |port: &Port| PortListing { protocol: port.spec.protocol_name(), address: port.address.to_string(), performers: Vec::new() };
    *hub.trackers.0.lock().unwrap_or_else(PoisonError::into_inner) = ports.iter().map(listing).collect();
    for (index, port) in ports.into_iter().enumerate() {
        tracing::info!(protocol = port.spec.protocol_name(), address = %port.address, "listening for trackers (udp)");
        tokio::spawn(run(hub.clone(), index, port));
    }
}

async fn run(hub: Arc<Hub>, index: usize, port: Port) {
    let mut shutdown = hub.shutdown.clone();
    let mut round = tokio::time::interval(ROUND);
    round.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
    // One byte more than the longest: a longer one is cut by the kernel and looks like this.
    let mut buffer = vec![0; port.spec.largest_datagram() + 1];
    let mut listener = Listener::new(&hub, &port.spec, port.address);
    let mut out = Vec::new();
    loop {
        tokio::select! {
            biased;
            () = stopped(&mut shutdown) => break,
            _ = round.tick() => {
                listener.look_after(Instant::now(), &mut out);
                hub.trackers.update(index, listener.listing(Instant::now()));
            }
            received = port.socket.recv_from(&mut buffer) => match received {
                Ok((length, from)) => listener.take(&buffer[..length], from, Instant::now(), &mut out),
                Err(error) => {
                    // Systems tell here of datagrams of ours that nobody took.
                    tracing::debug!(%error, "cannot receive");
                    tokio::time::sleep(Duration::from_millis(10)).await;
                }
            },
        }
        send_all(&port, &mut out);
    }
    listener.say_goodbye(&mut out);
    send_all(&port, &mut out);
}

/// Sends without waiting: what the kernel has no room for is asked for again anyway.
fn send_all(port: &Port, out: &mut Vec<(SocketAddr, Vec<u8>)>) {
    for (to, bytes) in out.drain(..) {
        // A socket of IPv6 reaches IPv4 by its mapped addresses.
        let to = match to.ip() {
            IpAddr::V4(ip) if port.address.is_ipv6() => SocketAddr::new(ip.to_ipv6_mapped().into(), to.port()),
            _ => to,
        };
        if let Err(error) = port.socket.try_send_to(&bytes, to) {
            tracing::debug!(%to, %error, "cannot send");
        }
    }
}

/// One port's state: datagrams and a clock in, frames into rooms and answers out.
struct Listener<'a> {
    hub: &'a Hub,
    spec: &'a ListenSpec,
    address: SocketAddr,
    started: Instant,
    /// Of this start: phones tell an old attempt from a new one by it.
    nonce: u64,
    senders: HashMap<SocketAddr, Sender>,
    performers: HashMap<Key, Performer>,
    begins: Rate,
    hellos: fmv3::Hellos,
    last_heard: Option<Instant>,
    last_request: Option<Instant>,
}

/// What is remembered of an address whose datagrams mean something only together.
struct Sender {
    vmc: Option<Box<vmc::Reader>>,
    fmv3: Option<Box<fmv3::Receiver>>,
    last_heard: Instant,
}

/// Tells performers apart.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
struct Key {
    protocol: Protocol,
    from: SocketAddr,
    performer: String,
}

struct Performer {
    source: String,
    room: RoomName,
    slot: Slot,
    clock: Clock,
    rate: Rate,
    last_heard: Instant,
    /// When the slot may be asked for again, and why it was not to be had.
    retry_at: Instant,
    refusal: &'static str,
    begun_at: Option<Instant>,
    num_sessions: u32,
    live: Option<Live>,
}

/// A performer's session in a room.
struct Live {
    source: Source,
    evicted: Evicted,
    framer: Framer,
    /// The picture that the session's landmarks are of.
    image: Option<[f32; 2]>,
}

impl Performer {
    /// Without a place in its room, which it asks for again later.
    fn lose_slot(&mut self, now: Instant, why: &'static str) {
        self.live = None;
        (self.retry_at, self.refusal) = (now + RETRY, why);
    }
}

impl<'a> Listener<'a> {
    fn new(hub: &'a Hub, spec: &'a ListenSpec, address: SocketAddr) -> Self {
        use std::hash::{BuildHasher, Hasher};
        Self {
            hub,
            spec,
            address,
            started: Instant::now(),
            // The standard library's own source of unpredictable numbers; nothing secret hangs on it.
            nonce: std::collections::hash_map::RandomState::new().build_hasher().finish() | 1,
            senders: HashMap::new(),
            performers: HashMap::new(),
            begins: Rate::new(SESSIONS_PER_SECOND, Instant::now()),
            hellos: fmv3::Hellos::default(),
            last_heard: None,
            last_request: None,
        }
    }

    fn seconds(&self, now: Instant) -> f64 {
        (now - self.started).as_secs_f64()
    }

    /// Takes one datagram.
    fn take(&mut self, bytes: &[u8], from: SocketAddr, now: Instant, out: &mut Vec<(SocketAddr, Vec<u8>)>) {
        let metrics = &self.hub.metrics;
        metrics.bytes_in.inc_by(bytes.len() as u64);
        let from = SocketAddr::new(from.ip().to_canonical(), from.port());
        if !self.spec.allow.is_empty() && !self.spec.allow.contains(&from.ip()) {
            metrics.tracker_datagram(self.spec.protocol_name());
            return self.drop_one(self.spec.protocol_name(), "not_allowed");
        }
        let Some(protocol) = self.protocol_of(bytes) else {
            metrics.tracker_datagram("any");
            return self.drop_one("any", Refusal::UnknownProtocol.label());
        };
        metrics.tracker_datagram(protocol.name());
        match self.parse(protocol, bytes, from, now, out) {
            Ok(sights) => {
                self.last_heard = Some(now);
                for seen in sights {
                    if let Err(reason) = self.show(protocol, seen, from, now) {
                        self.drop_one(protocol.name(), reason);
                    }
                }
            }
            Err(refusal) => {
                tracing::debug!(%from, protocol = protocol.name(), %refusal, "datagram dropped");
                self.drop_one(protocol.name(), refusal.label());
            }
        }
    }

    fn drop_one(&self, protocol: &'static str, reason: &'static str) {
        self.hub.metrics.tracker_drop(protocol, reason);
    }

    /// The protocol that a datagram is read as.
    fn protocol_of(&self, bytes: &[u8]) -> Option<Protocol> {
        match self.spec.protocol {
            None => sniff::sniff(bytes),
            // The two come from one app to one port.
            Some(Protocol::IFacialMocap) if bytes.starts_with(fmv3::MAGIC) => Some(Protocol::Fmv3),
            given => given,
        }
    }

    fn parse(
        &mut self,
        protocol: Protocol,
        bytes: &[u8],
        from: SocketAddr,
        now: Instant,
        out: &mut Vec<(SocketAddr, Vec<u8>)>,
    ) -> Result<Vec<Seen>, Refusal> {
        if bytes.len() > protocol.largest_datagram() {
            return Err(Refusal::TooLong);
        }
        let one = |seen: Seen| vec![seen];
        match protocol {
            Protocol::OpenSeeFace => openseeface::parse(bytes),
            Protocol::LiveLink => livelink::parse(bytes).map(one),
            Protocol::IFacialMocap => ifacialmocap::parse(bytes).map(one),
            Protocol::Vts => vts::parse(bytes).map(one),
            Protocol::Vmc => {
                let known = self.senders.get_mut(&from).and_then(|sender| sender.vmc.as_deref_mut());
                let mut fresh = vmc::Reader::default();
                let seen = match known {
                    Some(reader) => reader.take(bytes)?,
                    None => fresh.take(bytes)?,
                };
                // An address is remembered only after a sound datagram.
                self.sender(from, now)?.vmc.get_or_insert_with(|| Box::new(fresh));
                Ok(seen.into_iter().collect())
            }
            Protocol::Fmv3 => {
                let at = self.seconds(now);
                let known = self.senders.get_mut(&from).and_then(|sender| sender.fmv3.as_deref_mut());
                let mut fresh = fmv3::Receiver::new(self.nonce);
                let output = match known {
                    Some(receiver) => receiver.take(bytes, at)?,
                    None => fresh.take(bytes, at)?,
                };
                self.sender(from, now)?.fmv3.get_or_insert_with(|| Box::new(fresh));
                out.extend(output.reply.map(|reply| (from, reply)));
                Ok(output.seen.into_iter().collect())
            }
        }
    }

    /// What is remembered of `from`, which has just been heard.
    fn sender(&mut self, from: SocketAddr, now: Instant) -> Result<&mut Sender, Refusal> {
        if !self.senders.contains_key(&from) && self.senders.len() >= MOST_PERFORMERS {
            let oldest = self.senders.iter().min_by_key(|(_, sender)| sender.last_heard).map(|(key, sender)| (*key, sender.last_heard));
            match oldest {
                Some((key, heard)) if now - heard >= GIVES_WAY => self.senders.remove(&key),
                _ => return Err(Refusal::TooManySenders),
            };
        }
        let sender = self.senders.entry(from).or_insert_with(|| Sender { vmc: None, fmv3: None, last_heard: now });
        sender.last_heard = now;
        Ok(sender)
    }

    /// Puts what was seen into its room, or says why not.
    fn show(&mut self, protocol: Protocol, seen: Seen, from: SocketAddr, now: Instant) -> Result<(), &'static str> {
        // A phone has its own id, whichever port it sends from.
        let port = if protocol == Protocol::LiveLink { 0 } else { from.port() };
        let key = Key { protocol, from: SocketAddr::new(from.ip(), port), performer: seen.performer.clone() };
        if !self.performers.contains_key(&key) {
            self.make_room(now)?;
            let room = match &self.spec.room {
                RoomRule::Named(room) => room.clone(),
                RoomRule::Subject => room_of(protocol, &seen.subject),
            };
            let performer = Performer {
                source: hello(protocol, &seen, from.ip()).source,
                room,
                slot: self.spec.slot_of(protocol),
                clock: Clock::default(),
                rate: Rate::new(self.hub.config.limits.frames_per_second, now),
                last_heard: now,
                retry_at: now,
                refusal: "",
                begun_at: None,
                num_sessions: 0,
                live: None,
            };
            self.performers.insert(key.clone(), performer);
        }
        let arrived = self.seconds(now);
        let performer = self.performers.get_mut(&key).expect("it has just been put there");
        performer.last_heard = now;
        if !performer.rate.take_if_free(now) {
            return Err("too_fast");
        }
        let t = seen.time.unwrap_or(arrived);
        match performer.clock.place(t) {
            Tick::Next => {}
            Tick::Duplicate => return Err("duplicate"),
            Tick::Late => return Err("late"),
            Tick::OutOfRange => return Err(Refusal::OutOfRange.label()),
            Tick::Restart => performer.live = None,
        }
        let image = match seen.sight {
            Sight::Landmarks { image, .. } => Some(image),
            _ => None,
        };
        if performer.live.as_ref().is_some_and(|live| image.is_some() && live.image != image) {
            // Another camera: another session.
            performer.live = None;
        }
        if performer.live.as_mut().is_some_and(|live| live.evicted.try_recv().is_ok()) {
            performer.lose_slot(now, "taken_over");
        }
        if performer.live.is_none() {
            if seen.sight == Sight::NoFace {
                // Nobody is no reason to take a room.
                return Ok(());
            }
            self.begin(&key, protocol, &seen, from.ip(), now)?;
        }
        let performer = self.performers.get_mut(&key).expect("nobody has removed it");
        let live = performer.live.as_mut().expect("the session has begun");
        match live.source.frame(self.hub, live.framer.frame(t, &seen.sight), None) {
            Ok(()) => {
                self.hub.metrics.tracker_frame(protocol.name());
                live.source.take_controls();
                // Nobody is to be told; the room keeps it.
                live.source.news();
                Ok(())
            }
            Err(FrameError::Evicted) => {
                performer.lose_slot(now, "taken_over");
                Err("taken_over")
            }
            Err(FrameError::Bad(error)) => {
                tracing::debug!(%from, %error, "frame refused");
                Err("bad_frame")
            }
        }
    }

    /// Makes a place for one more performer.
    fn make_room(&mut self, now: Instant) -> Result<(), &'static str> {
        if self.performers.len() < MOST_PERFORMERS {
            return Ok(());
        }
        let oldest = self.performers.iter().min_by_key(|(_, performer)| performer.last_heard);
        match oldest.map(|(key, performer)| (key.clone(), performer.last_heard)) {
            Some((key, heard)) if now - heard >= GIVES_WAY => {
                self.performers.remove(&key);
                Ok(())
            }
            _ => Err(Refusal::TooManySenders.label()),
        }
    }

    /// Begins a session of the performer `key` in its slot.
    fn begin(&mut self, key: &Key, protocol: Protocol, seen: &Seen, ip: IpAddr, now: Instant) -> Result<(), &'static str> {
        let performer = self.performers.get_mut(key).expect("sessions are of performers");
        if now < performer.retry_at {
            return Err(performer.refusal);
        }
        if let Some(cluster) = &self.hub.cluster {
            let mut hello = hello(protocol, seen, ip);
            (hello.keep_neutral, hello.slot) = (performer.num_sessions > 0, performer.slot.clone());
            cluster.enter_soon(&self.hub.rooms, &performer.room, &hello)?;
        }
        if performer.begun_at.is_some_and(|begun| now - begun < RETRY) || !self.begins.take_if_free(now) {
            return Err("too_many_sessions");
        }
        let (room, slot, num_sessions) = (performer.room.clone(), performer.slot.clone(), performer.num_sessions);
        for (other, silent) in &mut self.performers {
            if other != key && silent.room == room && silent.slot == slot && now - silent.last_heard >= GIVES_WAY {
                silent.live = None;
            }
        }
        let mut hello = hello(protocol, seen, ip);
        // The same tracker that begins anew sees the same face.
        hello.keep_neutral = num_sessions > 0;
        hello.slot = slot;
        let kept = self.hub.rooms.kept(&room, &hello);
        let begun = Prepared::new(self.hub, hello, kept)
            .and_then(|prepared| Source::open(self.hub, &room, prepared, None).map_err(OpenError::from));
        let performer = self.performers.get_mut(key).expect("sessions are of performers");
        match begun {
            Ok((source, evicted)) => {
                let usual = Swaps::usual(protocol);
                let swaps = Swaps { jaw: self.spec.swap_jaw.unwrap_or(usual.jaw), mouth: self.spec.swap_mouth.unwrap_or(usual.mouth) };
                let image = match seen.sight {
                    Sight::Landmarks { image, .. } => Some(image),
                    _ => None,
                };
                performer.begun_at = Some(now);
                performer.num_sessions = num_sessions.saturating_add(1);
                performer.live = Some(Live { source, evicted, framer: Framer::new(swaps), image });
                Ok(())
            }
            Err(error) => {
                tracing::debug!(%room, source = performer.source, %error, "tracker has no room");
                let refusal = match error {
                    OpenError::Hello(_) | OpenError::Profile(_) => "bad_frame",
                    OpenError::Room(error) => error.code(),
                };
                performer.lose_slot(now, refusal);
                Err(refusal)
            }
        }
    }

    /// Lets go of who is silent, and keeps streams alive that want to be asked for.
    fn look_after(&mut self, now: Instant, out: &mut Vec<(SocketAddr, Vec<u8>)>) {
        let idle = seconds(self.hub.config.timeouts.publisher_idle);
        self.performers.retain(|_, performer| now - performer.last_heard < idle);
        self.senders.retain(|_, sender| now - sender.last_heard < idle);
        self.performers.values_mut().filter_map(|performer| performer.live.as_mut()).for_each(|live| live.source.take_controls());
        let at = self.seconds(now);
        let mut has_stream = false;
        for (from, sender) in &mut self.senders {
            if let Some(receiver) = &mut sender.fmv3 {
                out.extend(receiver.due(at).into_iter().map(|message| (*from, message)));
                has_stream |= receiver.is_running();
            }
        }
        let Some(phone) = self.spec.phone else { return };
        let is_silent = self.last_heard.is_none_or(|heard| now - heard >= SILENCE);
        if self.spec.protocol == Some(Protocol::Vts) {
            // Each request is for some seconds.
            if self.last_request.is_none_or(|last| now - last >= RETRY) {
                self.last_request = Some(now);
                out.push((phone, vts::request(self.address.port())));
            }
        } else if has_stream || !is_silent {
            self.hellos.reset();
        } else if self.hellos.take(at) {
            let hello = if self.spec.asks_fmv3() {
                fmv3::hello(self.nonce, ASKED_FPS)
            } else {
                ifacialmocap::hello(self.spec.dialect.unwrap_or(ifacialmocap::Dialect::V2))
            };
            out.push((phone, hello));
        }
    }

    /// Tells phones that nobody listens any more, where there is a word for it.
    fn say_goodbye(&mut self, out: &mut Vec<(SocketAddr, Vec<u8>)>) {
        for (from, sender) in &self.senders {
            out.extend(sender.fmv3.as_ref().and_then(|receiver| receiver.stop()).map(|message| (*from, message)));
        }
        if let (Some(phone), Some(stop)) = (self.spec.phone, self.spec.dialect.and_then(ifacialmocap::stop)) {
            out.push((phone, stop.to_vec()));
        }
    }

    fn listing(&self, now: Instant) -> PortListing {
        let mut performers: Vec<_> = self
            .performers
            .values()
            .map(|performer| PerformerListing {
                source: performer.source.clone(),
                room: performer.room.to_string(),
                slot: performer.slot.name.clone(),
                session: performer.live.as_ref().map(|live| live.source.session()),
                silent: (now - performer.last_heard).as_secs_f64(),
            })
            .collect();
        performers.sort_by(|a, b| (&a.room, &a.source).cmp(&(&b.room, &b.source)));
        PortListing { protocol: self.spec.protocol_name(), address: self.address.to_string(), performers }
    }
}
