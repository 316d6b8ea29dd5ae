//! The binary version 3 of iFacialMocap and Facemotion3d ("FMV3", contract revision 4), over UDP.
//!
//! ```text
//! 0 "FMV3" · 4 u8 type · 5 u8 flags · 6 u16 header size (40) · 8 u64 session · 16 u32 schema · 20 u32 sequence · 24 u32 token
//! 28 u32 length of the payload · 32 u16 part · 34 u16 parts · 36 u32 length of this part · 40 this part        (little-endian)
//! ```
//! HELLO asks for a stream, SCHEMA names its values, SCHEMA_ACK says that the names are known, FRAME carries one i16 or i32
//! percent a name and twelve f32 of head and eyes; PING keeps the stream alive. A phone may start by itself with a SCHEMA.
//!
//! [`Receiver`] and [`Sender`] are state machines: bytes and a clock in, faces and answers out.

use super::eyes::{EyeTurn, read_gaze, write_gaze};
use super::wire::Wire;
use super::{Refusal, Seen, SeenWeights, Sight, position, rotation, turns, weight};
use glam::{Quat, Vec3};
use rhytid_shared::{ARKIT_NAMES, ArkitShape, NUM_ARKIT_SHAPES};
use serde::Deserialize;

/// How every datagram begins.
pub const MAGIC: &[u8] = b"FMV3";
/// Largest datagram, bytes.
pub const LARGEST_DATAGRAM: usize = 1200;
const HEADER: usize = 40;
const REVISION: u32 = 4;
/// Largest datagram of a schema, bytes.
const SCHEMA_DATAGRAM: usize = 576;
/// Largest payload of a schema, bytes.
const LARGEST_SCHEMA: usize = 262_144;
/// Most names in a schema.
const MOST_NAMES: usize = 4096;
/// Most parts of a message.
const MOST_PARTS: u16 = 512;
/// Most messages that are being put together.
const MOST_ASSEMBLIES: usize = 8;
/// Most bytes in all of them.
const MOST_ASSEMBLY_BYTES: usize = 524_288;
/// How long a message may take to come together, seconds: a frame, a schema.
const FRAME_PATIENCE: f64 = 0.25;
const SCHEMA_PATIENCE: f64 = 3.0;
/// Without a frame for this long, seconds, the stream is asked for again, and after the other the phone is waited for.
const FRAME_GAP: f64 = 3.0;
const GIVE_UP: f64 = 12.0;
/// Between pings, and between answers to one schema, seconds.
const PING_INTERVAL: f64 = 3.0;
const ACK_INTERVAL: f64 = 1.0;
/// Hellos that go out, one a second, before the phone is waited for.
const MOST_HELLOS: u32 = 5;
/// While it is waited for, hellos go out this seldom, seconds: a phone that is switched on later need not be started by hand.
const SELDOM: f64 = 10.0;

/// Message types.
mod kind {
    pub const HELLO: u8 = 1;
    pub const SCHEMA: u8 = 3;
    pub const FRAME: u8 = 4;
    pub const GET_SCHEMA: u8 = 5;
    pub const PING: u8 = 6;
    pub const PONG: u8 = 7;
    pub const STOP: u8 = 8;
    pub const ERROR: u8 = 9;
    pub const SCHEMA_ACK: u8 = 10;
}

/// One datagram's header.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Header {
    kind: u8,
    flags: u8,
    session: u64,
    schema: u32,
    sequence: u32,
    token: u32,
    total: usize,
    part: u16,
    parts: u16,
}

impl Header {
    fn new(kind: u8, session: u64, schema: u32) -> Self {
        Self { kind, flags: 0, session, schema, sequence: 0, token: 0, total: 0, part: 0, parts: 1 }
    }

    /// Reads a datagram: its header and its part of the payload.
    fn read(bytes: &[u8]) -> Result<(Self, &[u8]), Refusal> {
        if bytes.len() > LARGEST_DATAGRAM {
            return Err(Refusal::TooLong);
        }
        let mut wire = Wire(bytes);
        if wire.bytes(4)? != MAGIC {
            return Err(Refusal::Malformed);
        }
        let (kind, flags) = (wire.u8()?, wire.u8()?);
        if usize::from(wire.u16_le()?) != HEADER {
            return Err(Refusal::UnknownVersion);
        }
        let (session, schema, sequence, token) = (wire.u64_le()?, wire.u32_le()?, wire.u32_le()?, wire.u32_le()?);
        let (total, part, parts) = (wire.u32_le()? as usize, wire.u16_le()?, wire.u16_le()?);
        let length = wire.u32_le()? as usize;
        let is_schema = kind == kind::SCHEMA;
        let largest = if is_schema { LARGEST_SCHEMA } else { MOST_NAMES * 4 + 48 };
        if length != wire.0.len() {
            return Err(if length > wire.0.len() { Refusal::Truncated } else { Refusal::WrongLength });
        }
        if total > largest || (is_schema && bytes.len() > SCHEMA_DATAGRAM) {
            return Err(Refusal::TooLong);
        }
        if parts == 0 || parts > MOST_PARTS || part >= parts || length > total || (parts == 1 && length != total) {
            return Err(Refusal::WrongCount);
        }
        let has_flags = flags & if kind == kind::FRAME { !3 } else { !0 } != 0;
        let has_schema = matches!(kind, kind::SCHEMA | kind::FRAME | kind::SCHEMA_ACK);
        if session == 0 || has_flags || (has_schema && schema == 0) {
            return Err(Refusal::OutOfRange);
        }
        Ok((Self { kind, flags, session, schema, sequence, token, total, part, parts }, wire.0))
    }

    /// Writes `payload` as datagrams of at most `largest` bytes.
    fn write(self, payload: &[u8], largest: usize) -> Vec<Vec<u8>> {
        let capacity = largest - HEADER;
        let parts = payload.len().div_ceil(capacity).max(1);
        let part = |index: usize| {
            let chunk = &payload[(index * capacity).min(payload.len())..((index + 1) * capacity).min(payload.len())];
            let mut bytes = Vec::with_capacity(HEADER + chunk.len());
            bytes.extend(MAGIC);
            bytes.extend([self.kind, self.flags]);
            bytes.extend((HEADER as u16).to_le_bytes());
            bytes.extend(self.session.to_le_bytes());
            bytes.extend([self.schema, self.sequence, self.token, payload.len() as u32].into_iter().flat_map(u32::to_le_bytes));
            bytes.extend([index as u16, parts as u16].into_iter().flat_map(u16::to_le_bytes));
            bytes.extend((chunk.len() as u32).to_le_bytes());
            bytes.extend(chunk);
            bytes
        };
        (0..parts).map(part).collect()
    }

    /// One datagram without a payload.
    fn write_empty(self) -> Vec<u8> {
        self.write(&[], LARGEST_DATAGRAM).remove(0)
    }
}

/// The request for a stream: `nonce` (not 0) is this attempt's own.
pub fn hello(nonce: u64, fps: u16) -> Vec<u8> {
    let mut payload = Vec::with_capacity(8);
    payload.extend(fps.to_le_bytes());
    payload.extend((LARGEST_DATAGRAM as u16).to_le_bytes());
    payload.extend(REVISION.to_le_bytes());
    Header::new(kind::HELLO, nonce, 0).write(&payload, LARGEST_DATAGRAM).remove(0)
}

/// A message whose parts have not all come.
#[derive(Debug)]
struct Assembly {
    header: Header,
    parts: Vec<Option<Box<[u8]>>>,
    num_bytes: usize,
    since: f64,
}

/// The names of a stream's values.
#[derive(Debug)]
struct Schema {
    session: u64,
    id: u32,
    shapes: Vec<Option<ArkitShape>>,
    has_gaze: bool,
    is_wide: bool,
    /// Milliseconds that the stream lives without a ping.
    lease: u32,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct SchemaText {
    schema_version: u32,
    app: String,
    #[serde(rename = "profile")]
    _profile: String,
    blend_names: Vec<String>,
    blend_encoding: String,
    blend_unit: String,
    pose_layout: String,
    rotation_unit: String,
    position_unit: String,
}

const POSE_LAYOUT: &str = "head_rxyz_pxyz_rightEye_rxyz_leftEye_rxyz";

/// What a datagram led to.
#[derive(Debug, Default, PartialEq)]
pub struct Output {
    /// A face, or that there is none.
    pub seen: Option<Seen>,
    /// To be sent back to where the datagram came from.
    pub reply: Option<Vec<u8>>,
}

/// The receiving end of one phone's stream.
#[derive(Debug)]
pub struct Receiver {
    nonce: u64,
    schema: Option<Schema>,
    assemblies: Vec<Assembly>,
    last_sequence: Option<u32>,
    /// When a frame came last, or the schema.
    last_frame: f64,
    last_ping: f64,
    last_ack: f64,
    num_recoveries: u32,
    num_pings: u32,
}

impl Receiver {
    /// A receiver whose hellos carry `nonce`.
    pub fn new(nonce: u64) -> Self {
        Self {
            nonce,
            schema: None,
            assemblies: Vec::new(),
            last_sequence: None,
            last_frame: f64::NEG_INFINITY,
            last_ping: f64::NEG_INFINITY,
            last_ack: f64::NEG_INFINITY,
            num_recoveries: 0,
            num_pings: 0,
        }
    }

    /// Takes a datagram that came at `now`, seconds on any clock that only goes forward.
    pub fn take(&mut self, bytes: &[u8], now: f64) -> Result<Output, Refusal> {
        let (header, chunk) = Header::read(bytes)?;
        match header.kind {
            kind::SCHEMA | kind::FRAME => {}
            // They say that somebody is there, which the socket has noticed.
            kind::PONG => return Ok(Output::default()),
            kind::ERROR => {
                tracing::debug!(reason = ?String::from_utf8_lossy(chunk), "the phone refuses");
                return Err(Refusal::NoSession);
            }
            _ => return Err(Refusal::NoContent),
        }
        if header.kind == kind::FRAME {
            let schema = self.schema.as_ref().filter(|schema| (schema.session, schema.id) == (header.session, header.schema));
            let Some(schema) = schema else { return Err(Refusal::NoSession) };
            if header.total != schema.frame_bytes() {
                return Err(Refusal::WrongCount);
            }
            if self.last_sequence.is_some_and(|last| !is_newer(header.sequence, last)) {
                return Err(Refusal::Late);
            }
        }
        let Some(payload) = self.assemble(header, chunk, now)? else { return Ok(Output::default()) };
        if header.kind == kind::SCHEMA { self.take_schema(header, &payload, now) } else { self.take_frame(header, &payload, now) }
    }

    /// Puts a message together; gives it when it is whole.
    fn assemble(&mut self, header: Header, chunk: &[u8], now: f64) -> Result<Option<Vec<u8>>, Refusal> {
        if header.parts == 1 {
            return Ok(Some(chunk.to_vec()));
        }
        self.assemblies.retain(|assembly| {
            let patience = if assembly.header.kind == kind::FRAME { FRAME_PATIENCE } else { SCHEMA_PATIENCE };
            now - assembly.since <= patience
        });
        let key = |header: &Header| (header.kind, header.session, header.schema, header.sequence);
        let index = self.assemblies.iter().position(|assembly| key(&assembly.header) == key(&header));
        let index = index.unwrap_or_else(|| {
            if self.assemblies.len() == MOST_ASSEMBLIES {
                self.assemblies.remove(0);
            }
            let parts = vec![None; usize::from(header.parts)];
            self.assemblies.push(Assembly { header, parts, num_bytes: 0, since: now });
            self.assemblies.len() - 1
        });
        let in_all: usize = self.assemblies.iter().map(|assembly| assembly.num_bytes).sum();
        let assembly = &mut self.assemblies[index];
        let known = &assembly.header;
        let fits = (known.total, known.parts, known.flags, known.token) == (header.total, header.parts, header.flags, header.token);
        let slot = &mut assembly.parts[usize::from(header.part).min(usize::from(known.parts) - 1)];
        if let (true, Some(before)) = (fits, slot.as_deref()) {
            if before == chunk {
                return Ok(None);
            }
        } else if fits && assembly.num_bytes + chunk.len() <= header.total && in_all + chunk.len() <= MOST_ASSEMBLY_BYTES {
            *slot = Some(chunk.into());
            assembly.num_bytes += chunk.len();
            if assembly.parts.iter().any(Option::is_none) {
                return Ok(None);
            }
            let assembly = self.assemblies.remove(index);
            let payload: Vec<u8> = assembly.parts.iter().flatten().flat_map(|part| part.iter().copied()).collect();
            return if payload.len() == header.total { Ok(Some(payload)) } else { Err(Refusal::WrongLength) };
        }
        // Parts that contradict each other are all thrown away.
        self.assemblies.remove(index);
        Err(Refusal::WrongCount)
    }

    fn take_schema(&mut self, header: Header, payload: &[u8], now: f64) -> Result<Output, Refusal> {
        if self.schema.as_ref().is_some_and(|schema| (schema.session, schema.id) == (header.session, header.schema)) {
            // Its first answer may have been lost.
            if now - self.last_ack < ACK_INTERVAL {
                return Ok(Output::default());
            }
            self.last_ack = now;
            return Ok(Output { seen: None, reply: Some(ack(&header)) });
        }
        // Another stream may not take the place of one that is running.
        let is_running = now - self.last_frame < FRAME_GAP;
        if self.schema.as_ref().is_some_and(|schema| schema.session != header.session && is_running) {
            return Err(Refusal::NoSession);
        }
        let mut wire = Wire(payload);
        let nonce = wire.u64_le()?;
        let (fps, largest, lease, revision) = (wire.u16_le()?, wire.u16_le()?, wire.u32_le()?, wire.u32_le()?);
        if revision != REVISION {
            return Err(Refusal::UnknownVersion);
        }
        if nonce != 0 && nonce != self.nonce {
            return Err(Refusal::NoSession);
        }
        let is_sound = (1..=60).contains(&fps) && (576..=1200).contains(&largest) && (5000..=60_000).contains(&lease);
        if !is_sound {
            return Err(Refusal::OutOfRange);
        }
        let text: SchemaText = serde_json::from_slice(wire.0).map_err(|_| Refusal::Malformed)?;
        self.schema = Some(Schema::new(&header, &text, lease)?);
        self.assemblies.clear();
        self.last_sequence = None;
        (self.last_frame, self.last_ack, self.last_ping, self.num_recoveries) = (now, now, now, 0);
        tracing::debug!(app = text.app, names = text.blend_names.len(), "schema taken");
        Ok(Output { seen: None, reply: Some(ack(&header)) })
    }

    fn take_frame(&mut self, header: Header, payload: &[u8], now: f64) -> Result<Output, Refusal> {
        let schema = self.schema.as_ref().ok_or(Refusal::NoSession)?;
        let sight = schema.read(payload, header.flags & 1 != 0)?;
        self.last_sequence = Some(header.sequence);
        (self.last_frame, self.num_recoveries) = (now, 0);
        Ok(Output { seen: Some(Seen { performer: String::new(), subject: String::new(), time: None, sight }), reply: None })
    }

    /// What is to be sent at `now` to keep the stream alive or to get it back; to be asked a few times a second.
    pub fn due(&mut self, now: f64) -> Vec<Vec<u8>> {
        let mut due = Vec::new();
        let Some(schema) = &self.schema else { return due };
        let (session, id) = (schema.session, schema.id);
        let silence = now - self.last_frame;
        if silence > GIVE_UP {
            // It is waited for: a new schema starts it.
            self.schema = None;
            self.assemblies.clear();
            return due;
        }
        if silence > FRAME_GAP * f64::from(self.num_recoveries + 1) && self.num_recoveries < 3 {
            self.num_recoveries += 1;
            due.push(Header::new(kind::SCHEMA_ACK, session, id).write_empty());
            due.push(Header::new(kind::GET_SCHEMA, session, 0).write_empty());
        }
        if now - self.last_ping >= PING_INTERVAL.min(f64::from(schema.lease) / 2000.0) {
            self.last_ping = now;
            self.num_pings = self.num_pings.wrapping_add(1);
            due.push(Header { sequence: self.num_pings, ..Header::new(kind::PING, session, 0) }.write_empty());
        }
        due
    }

    /// What ends the stream.
    pub fn stop(&self) -> Option<Vec<u8>> {
        self.schema.as_ref().map(|schema| Header::new(kind::STOP, schema.session, 0).write_empty())
    }

    /// True while a stream is there or is being got back.
    pub fn is_running(&self) -> bool {
        self.schema.is_some()
    }
}

fn ack(header: &Header) -> Vec<u8> {
    Header::new(kind::SCHEMA_ACK, header.session, header.schema).write_empty()
}

fn is_newer(sequence: u32, last: u32) -> bool {
    (1..=u32::MAX / 2).contains(&sequence.wrapping_sub(last))
}

impl Schema {
    fn new(header: &Header, text: &SchemaText, lease: u32) -> Result<Self, Refusal> {
        let units = (text.blend_unit.as_str(), text.rotation_unit.as_str(), text.position_unit.as_str());
        if text.schema_version != 1 || text.pose_layout != POSE_LAYOUT || units != ("percent", "degree", "meter") {
            return Err(Refusal::UnknownVersion);
        }
        if text.blend_names.len() > MOST_NAMES {
            return Err(Refusal::WrongCount);
        }
        let is_wide = match text.blend_encoding.as_str() {
            "i16" => false,
            "i32" => true,
            _ => return Err(Refusal::UnknownVersion),
        };
        let shapes: Vec<_> = text.blend_names.iter().map(|name| ArkitShape::from_name(name)).collect();
        if shapes.iter().all(Option::is_none) {
            return Err(Refusal::NoContent);
        }
        let has_gaze = shapes.iter().flatten().any(|shape| super::eyes::is_gaze(shape.index()));
        Ok(Self { session: header.session, id: header.schema, shapes, has_gaze, is_wide, lease })
    }

    fn frame_bytes(&self) -> usize {
        self.shapes.len() * if self.is_wide { 4 } else { 2 } + 48
    }

    fn read(&self, payload: &[u8], is_tracking: bool) -> Result<Sight, Refusal> {
        let mut wire = Wire(payload);
        let mut weights = Box::new([0.0; NUM_ARKIT_SHAPES]);
        for shape in &self.shapes {
            let percent = if self.is_wide { wire.u32_le()? as i32 } else { i32::from(wire.u16_le()? as i16) };
            if let Some(shape) = shape {
                weights[shape.index()] = weight(percent as f32 / 100.0)?;
            }
        }
        let mut vector = || Ok([wire.f32_le()?, wire.f32_le()?, wire.f32_le()?]);
        let [turn, place, right, left] = [vector()?, vector()?, vector()?, vector()?];
        wire.end()?;
        let turned = |[x, y, z]: [f32; 3]| rotation(x.to_radians(), y.to_radians(), z.to_radians());
        let (head_rotation, head_position) = (turned(turn)?, position(Vec3::from_array(place))?);
        if !self.has_gaze {
            turned(left)?;
            turned(right)?;
            write_gaze([left, right].map(|[x, y, _]| EyeTurn { pitch: x.to_radians(), yaw: y.to_radians() }), &mut weights);
        }
        if !is_tracking {
            return Ok(Sight::NoFace);
        }
        Ok(Sight::Weights(SeenWeights { weights, head_rotation: Some(head_rotation), head_position: Some(head_position) }))
    }
}

/// When hellos go out to a phone that has not answered.
#[derive(Debug, Default)]
pub struct Hellos {
    count: u32,
    last: Option<f64>,
}

impl Hellos {
    /// True where one is due at `now`, which is noted: five a second apart, then seldom.
    pub fn take(&mut self, now: f64) -> bool {
        let interval = if self.count < MOST_HELLOS { 1.0 } else { SELDOM };
        let is_due = self.last.is_none_or(|last| now - last >= interval);
        if is_due {
            self.last = Some(now);
            self.count += 1;
        }
        is_due
    }

    /// The phone has answered.
    pub fn reset(&mut self) {
        *self = Self::default();
    }
}

/// The phone's end, for fake senders.
#[derive(Debug)]
pub struct Sender {
    session: u64,
    nonce: u64,
    sequence: u32,
    is_known: bool,
}

impl Sender {
    /// A phone that starts by itself.
    pub fn new(session: u64) -> Self {
        Self { session: session.max(1), nonce: 0, sequence: 0, is_known: false }
    }

    /// The names of the values, to be sent every second until they are known.
    pub fn schema(&self) -> Vec<Vec<u8>> {
        let mut payload = Vec::new();
        payload.extend(self.nonce.to_le_bytes());
        payload.extend([60u16, LARGEST_DATAGRAM as u16].into_iter().flat_map(u16::to_le_bytes));
        payload.extend([10_000u32, REVISION].into_iter().flat_map(u32::to_le_bytes));
        let text = serde_json::json!({
            "schema_version": 1, "app": "iFacialMocap", "profile": "ifacialmocap-stream", "blend_names": &ARKIT_NAMES[..],
            "blend_encoding": "i16", "blend_unit": "percent", "pose_layout": POSE_LAYOUT, "rotation_unit": "degree",
            "position_unit": "meter",
        });
        payload.extend(text.to_string().into_bytes());
        Header::new(kind::SCHEMA, self.session, 1).write(&payload, SCHEMA_DATAGRAM)
    }

    /// True once the receiver knows the names.
    pub fn is_known(&self) -> bool {
        self.is_known
    }

    /// Takes a datagram of the receiver; gives what is sent back.
    pub fn take(&mut self, bytes: &[u8]) -> Vec<Vec<u8>> {
        let Ok((header, payload)) = Header::read(bytes) else { return Vec::new() };
        match header.kind {
            kind::HELLO if payload.len() == 8 => {
                self.nonce = header.session;
                self.schema()
            }
            kind::GET_SCHEMA if header.session == self.session => self.schema(),
            kind::SCHEMA_ACK if (header.session, header.schema) == (self.session, 1) => {
                self.is_known = true;
                Vec::new()
            }
            kind::PING if header.session == self.session => {
                vec![Header { kind: kind::PONG, ..header }.write_empty()]
            }
            _ => Vec::new(),
        }
    }

    /// One face, or nobody.
    pub fn frame(&mut self, face: Option<(&[f32; NUM_ARKIT_SHAPES], Quat, Vec3)>) -> Vec<Vec<u8>> {
        let (weights, head, place) = face.unwrap_or((&[0.0; NUM_ARKIT_SHAPES], Quat::IDENTITY, Vec3::ZERO));
        let mut payload = Vec::with_capacity(NUM_ARKIT_SHAPES * 2 + 48);
        payload.extend(weights.iter().flat_map(|weight| ((weight * 100.0).round() as i16).to_le_bytes()));
        let mut put = |values: [f32; 3]| payload.extend(values.iter().flat_map(|value| value.to_le_bytes()));
        put(turns(head).map(f32::to_degrees));
        put(place.to_array());
        let [left, right] = read_gaze(weights);
        for eye in [right, left] {
            put([eye.pitch.to_degrees(), eye.yaw.to_degrees(), 0.0]);
        }
        self.sequence = self.sequence.wrapping_add(1);
        let header = Header { flags: u8::from(face.is_some()), sequence: self.sequence, ..Header::new(kind::FRAME, self.session, 1) };
        header.write(&payload, LARGEST_DATAGRAM)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const HELLO: [u8; 48] = [
        0x46, 0x4d, 0x56, 0x33, 1, 0, 0x28, 0, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 8, 0, 0, 0, 0, 0, 1, 0, 8, 0, 0,
        0, 0x3c, 0, 0xb0, 4, 4, 0, 0, 0,
    ];

    fn connected() -> (Receiver, Sender) {
        let (mut receiver, mut sender) = (Receiver::new(7), Sender::new(99));
        let mut reply = None;
        for part in sender.take(&hello(7, 60)) {
            reply = receiver.take(&part, 0.0).unwrap().reply.or(reply);
        }
        assert!(sender.take(&reply.expect("the schema is acknowledged")).is_empty() && sender.is_known());
        (receiver, sender)
    }

    #[test]
    fn the_published_hello_is_written() {
        assert_eq!(hello(1, 60), HELLO);
    }

    #[test]
    fn a_stream_comes_through_its_handshake() {
        let (mut receiver, mut sender) = connected();
        assert!(sender.schema().len() > 1, "the schema comes in parts");
        let weights = std::array::from_fn(|i| i as f32 / 100.0);
        let head = rotation(0.1, 0.2, -0.1).unwrap();
        let frame = sender.frame(Some((&weights, head, Vec3::new(0.0, 0.1, -0.4))));
        assert_eq!((frame.len(), frame[0].len()), (1, 192));
        let seen = receiver.take(&frame[0], 0.1).unwrap().seen.unwrap();
        let Sight::Weights(seen) = seen.sight else { panic!("weights") };
        assert!(seen.weights.iter().zip(&weights).all(|(a, b): (&f32, &f32)| (a - b).abs() < 1e-6));
        assert!(seen.head_rotation.unwrap().abs_diff_eq(head, 1e-5));
        assert_eq!(receiver.take(&frame[0], 0.1), Err(Refusal::Late), "the same again");
        let nobody = sender.frame(None);
        assert_eq!(receiver.take(&nobody[0], 0.2).unwrap().seen.unwrap().sight, Sight::NoFace);
    }

    #[test]
    fn a_phone_may_start_by_itself_and_no_other_may_push_it_aside() {
        let (mut receiver, sender) = (Receiver::new(7), Sender::new(99));
        let replies: Vec<_> = sender.schema().iter().filter_map(|part| receiver.take(part, 0.0).unwrap().reply).collect();
        assert_eq!(replies.len(), 1);
        let other = Sender::new(100).schema();
        let last = other.iter().map(|part| receiver.take(part, 1.0)).last().unwrap();
        assert_eq!(last, Err(Refusal::NoSession));
        let mut stranger = Sender::new(101);
        let (mut receiver, mut last) = (Receiver::new(7), Ok(Output::default()));
        for part in stranger.take(&hello(8, 60)) {
            last = receiver.take(&part, 1.0);
        }
        assert_eq!(last, Err(Refusal::NoSession), "an answer to somebody else's hello");
    }

    #[test]
    fn the_stream_is_kept_alive_and_got_back() {
        let (mut receiver, mut sender) = connected();
        assert!(receiver.due(1.0).is_empty());
        let due = receiver.due(3.0);
        assert_eq!((due.len(), due[0][4]), (1, kind::PING));
        assert_eq!(sender.take(&due[0])[0][4], kind::PONG);
        let kinds = |due: Vec<Vec<u8>>| due.iter().map(|message| message[4]).collect::<Vec<_>>();
        assert_eq!(kinds(receiver.due(3.5)), [kind::SCHEMA_ACK, kind::GET_SCHEMA]);
        assert_eq!(kinds(receiver.due(3.6)), [0u8; 0]);
        let mut num = 0;
        for tenth in 36..130 {
            num += kinds(receiver.due(f64::from(tenth) / 10.0)).iter().filter(|kind| **kind == kind::GET_SCHEMA).count();
        }
        assert_eq!((num, receiver.is_running()), (2, false), "three times in all, then it is waited for");
        assert_eq!(receiver.stop(), None);
    }

    #[test]
    fn hellos_grow_seldom() {
        let mut hellos = Hellos::default();
        let sent = (0..600).filter(|tenth| hellos.take(f64::from(*tenth) / 10.0)).count();
        assert_eq!(sent, 10, "five in the first five seconds, then one in ten");
    }

    #[test]
    fn parts_that_contradict_or_never_end_are_thrown_away() {
        let (mut receiver, _) = connected();
        let part = |sequence: u32, index: u16, parts: u16, total: usize, chunk: &[u8]| {
            let mut bytes = Header { sequence, ..Header::new(kind::FRAME, 99, 1) }.write(chunk, LARGEST_DATAGRAM).remove(0);
            bytes[28..32].copy_from_slice(&(total as u32).to_le_bytes());
            bytes[32..34].copy_from_slice(&index.to_le_bytes());
            bytes[34..36].copy_from_slice(&parts.to_le_bytes());
            bytes
        };
        assert_eq!(receiver.take(&part(1, 0, 2, 152, &[0; 100]), 1.0), Ok(Output::default()));
        assert_eq!(receiver.take(&part(1, 0, 2, 152, &[0; 100]), 1.0), Ok(Output::default()), "the same part twice is one");
        assert_eq!(receiver.take(&part(1, 0, 2, 152, &[1; 100]), 1.0), Err(Refusal::WrongCount));
        assert!(receiver.assemblies.is_empty());
        assert_eq!(receiver.take(&part(2, 1, 2, 152, &[0; 52]), 2.0), Ok(Output::default()));
        assert!(receiver.take(&part(2, 0, 2, 152, &[0; 100]), 2.1).unwrap().seen.is_some(), "in any order");
        for sequence in 3..40 {
            receiver.take(&part(sequence, 0, 512, 152, &[0; 1]), 3.0).unwrap();
        }
        assert_eq!(receiver.assemblies.len(), MOST_ASSEMBLIES);
        receiver.take(&part(50, 0, 3, 152, &[0; 1]), 3.3).unwrap();
        assert_eq!(receiver.assemblies.len(), 1, "the others were too late");
        assert_eq!(receiver.take(&part(51, 0, 2, 150, &[0; 100]), 3.3), Err(Refusal::WrongCount));
        assert_eq!(receiver.take(&part(52, 2, 2, 152, &[0; 100]), 3.3), Err(Refusal::WrongCount));
        assert_eq!(receiver.take(&part(53, 0, 0, 152, &[0; 100]), 3.3), Err(Refusal::WrongCount));
        assert_eq!(receiver.take(&part(54, 0, 513, 152, &[0; 100]), 3.3), Err(Refusal::WrongCount));
        assert_eq!(receiver.take(&part(55, 0, 2, 1 << 30, &[0; 100]), 3.3), Err(Refusal::TooLong));
    }

    #[test]
    fn what_is_wrong_is_named() {
        let (mut receiver, mut sender) = connected();
        let good = sender.frame(Some((&[0.5; NUM_ARKIT_SHAPES], Quat::IDENTITY, Vec3::ZERO))).remove(0);
        for cut in 0..good.len() {
            assert_eq!(receiver.take(&good[..cut], 0.1), Err(Refusal::Truncated), "cut at {cut}");
        }
        let mut broken = |at: usize, bytes: &[u8]| {
            let mut bad = good.clone();
            bad[at..at + bytes.len()].copy_from_slice(bytes);
            receiver.take(&bad, 0.1).unwrap_err()
        };
        assert_eq!(broken(0, b"X"), Refusal::Malformed);
        assert_eq!(broken(4, &[2, 0]), Refusal::NoContent);
        assert_eq!(broken(5, &[4]), Refusal::OutOfRange);
        assert_eq!(broken(6, &[41]), Refusal::UnknownVersion);
        assert_eq!(broken(8, &[1]), Refusal::NoSession);
        assert_eq!(broken(40, &30_000i16.to_le_bytes()), Refusal::OutOfRange);
        assert_eq!(broken(144, &f32::NAN.to_le_bytes()), Refusal::NotFinite);
        assert_eq!(broken(36, &[0]), Refusal::WrongLength);
        assert_eq!(receiver.take(&vec![0; 1201], 0.1), Err(Refusal::TooLong));
        assert!(receiver.take(&good, 0.1).unwrap().seen.is_some());
        let with = |from: &str, to: &str| {
            let payload: Vec<u8> = {
                let mut whole = Vec::new();
                for part in Sender::new(5).schema() {
                    whole.extend(&part[HEADER..]);
                }
                let text = String::from_utf8(whole[20..].to_vec()).unwrap().replacen(from, to, 1);
                [&whole[..20], text.as_bytes()].concat()
            };
            let mut receiver = Receiver::new(7);
            Header::new(kind::SCHEMA, 5, 1).write(&payload, SCHEMA_DATAGRAM).iter().map(|part| receiver.take(part, 0.0)).last().unwrap()
        };
        assert!(with("percent", "percent").unwrap().reply.is_some());
        assert_eq!(with("percent", "radians"), Err(Refusal::UnknownVersion));
        assert_eq!(with("\"i16\"", "\"i64\""), Err(Refusal::UnknownVersion));
        assert_eq!(with("\"app\"", "\"apple\""), Err(Refusal::Malformed));
        assert_eq!(with("{", "["), Err(Refusal::Malformed));
    }
}
