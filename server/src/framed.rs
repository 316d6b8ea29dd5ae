//! WebSocket frames as bytes, for what is written around the WebSocket: the same for many viewers, so made once for all of them.

use tokio_tungstenite::tungstenite::Bytes;

/// Opcodes (RFC 6455, 5.2).
const TEXT: u8 = 1;
const BINARY: u8 = 2;
const PING: u8 = 9;

/// A ping without payload.
const PING_FRAME: [u8; 2] = [0x80 | PING, 0];
/// Bytes of a frame's head, at most.
const MOST_HEAD: usize = 10;

/// A message as a viewer gets it: its frame, and before it the ping for those whose turn it is to be asked.
#[derive(Clone)]
pub(crate) struct Framed {
    bytes: Bytes,
    /// Bytes before the payload.
    head_len: usize,
}

impl Framed {
    /// A packet.
    pub fn packet(packet: &[u8]) -> Self {
        Self::new(BINARY, packet)
    }

    /// A text message.
    pub fn text(text: &str) -> Self {
        Self::new(TEXT, text.as_bytes())
    }

    fn new(opcode: u8, payload: &[u8]) -> Self {
        let mut bytes = Vec::with_capacity(PING_FRAME.len() + MOST_HEAD + payload.len());
        bytes.extend(PING_FRAME);
        put_server_frame(opcode, payload, &mut bytes);
        Self { head_len: bytes.len() - payload.len(), bytes: bytes.into() }
    }

    /// What is framed.
    pub fn payload(&self) -> &[u8] {
        &self.bytes[self.head_len..]
    }

    /// As [`Self::payload`], to be kept.
    pub fn to_payload(&self) -> Bytes {
        self.bytes.slice(self.head_len..)
    }

    /// What goes to a viewer.
    pub fn frames(&self, with_ping: bool) -> &[u8] {
        &self.bytes[Self::start(with_ping)..]
    }

    /// As [`Self::frames`], to be kept.
    pub fn to_frames(&self, with_ping: bool) -> Bytes {
        self.bytes.slice(Self::start(with_ping)..)
    }

    /// This and `next` behind it, to be kept.
    pub fn to_frames_before(&self, next: &Self, with_ping: bool) -> Bytes {
        [self.frames(with_ping), next.frames(false)].concat().into()
    }

    fn start(with_ping: bool) -> usize {
        if with_ping { 0 } else { PING_FRAME.len() }
    }
}

/// A ping.
pub(crate) fn ping() -> Bytes {
    Bytes::from_static(&PING_FRAME)
}

/// A ping, and behind it a text message.
pub(crate) fn ping_and_text(text: &str) -> Vec<u8> {
    Framed::text(text).bytes.into()
}

/// Puts one whole frame from a server behind `bytes`: `opcode` with FIN, no mask (RFC 6455, 5.2).
pub(crate) fn put_server_frame(opcode: u8, payload: &[u8], bytes: &mut Vec<u8>) {
    bytes.push(0x80 | opcode);
    match payload.len() {
        len @ 0..=125 => bytes.push(len as u8),
        len @ 126..=0xFFFF => {
            bytes.push(126);
            bytes.extend((len as u16).to_be_bytes());
        }
        len => {
            bytes.push(127);
            bytes.extend((len as u64).to_be_bytes());
        }
    }
    bytes.extend(payload);
}

#[cfg(test)]
mod tests {
    use super::*;
    use tokio_tungstenite::tungstenite::protocol::{Role, WebSocket};
    use tokio_tungstenite::tungstenite::{Error, Message};

    /// What a client reads.
    fn read(bytes: &[u8]) -> Vec<Message> {
        let mut socket = WebSocket::from_raw_socket(std::io::Cursor::new(bytes.to_vec()), Role::Client, None);
        let mut messages = Vec::new();
        loop {
            match socket.read() {
                Ok(message) => messages.push(message),
                // The end, or no place for an answer to a ping.
                Err(Error::Io(_) | Error::ConnectionClosed | Error::Protocol(_)) => return messages,
                Err(error) => panic!("{error}"),
            }
        }
    }

    #[test]
    fn packets_of_any_length_are_read_with_their_pings_and_without() {
        for len in [0, 1, 125, 126, 127, 65_535, 65_536, 70_000] {
            let packet: Vec<u8> = (0..len).map(|k| k as u8).collect();
            let framed = Framed::packet(&packet);
            assert_eq!((framed.payload(), &framed.to_payload()[..]), (&packet[..], &packet[..]));
            assert_eq!(read(framed.frames(false)), [Message::binary(packet.clone())]);
            assert_eq!(framed.frames(true)[..2], PING_FRAME);
            assert_eq!(&framed.frames(true)[2..], framed.frames(false));
            assert_eq!((&framed.to_frames(true)[..], &framed.to_frames(false)[..]), (framed.frames(true), framed.frames(false)));
            let two = framed.to_frames_before(&Framed::text("next"), false);
            assert_eq!(read(&two), [Message::binary(packet.clone()), Message::text("next")]);
        }
        assert_eq!(read(&ping_and_text("hello")[2..]), [Message::text("hello")]);
    }
}
