//! A viewer that goes by what it sees.

use rhytid_shared::FaceFrame;
use rhytid_shared::packet::{Decoder, PacketLayout};
use rhytid_shared::view::ViewMessage;
use std::io::ErrorKind;
use std::net::TcpStream;
use tokio_tungstenite::tungstenite::{Error, Message, WebSocket};

/// A viewer's socket. Every packet that comes can be read when it comes, and none comes before the hello.
pub struct Viewer {
    pub socket: WebSocket<TcpStream>,
    decoder: Option<(FaceFrame, Decoder)>,
}

/// What a viewer sees next.
pub enum Sight<'a> {
    Face(&'a FaceFrame),
    /// No face has come, this time.
    Nothing,
    /// The server's last word.
    Refused(String),
    Gone,
}

impl Viewer {
    pub fn new(socket: WebSocket<TcpStream>) -> Self {
        Self { socket, decoder: None }
    }

    /// Waits for one message, as long as the socket's patience is.
    pub fn look(&mut self) -> Sight<'_> {
        match self.socket.read() {
            Ok(Message::Text(text)) => match serde_json::from_str(&text) {
                Ok(ViewMessage::Hello(hello)) => {
                    let layout = PacketLayout::try_from(&hello.character).unwrap();
                    self.decoder = Some((layout.frame_at_rest(), Decoder::new(layout)));
                    Sight::Nothing
                }
                Ok(ViewMessage::Error { code, message }) => Sight::Refused(format!("{code}: {message}")),
                _ => panic!("no message for a viewer of packets: {text}"),
            },
            Ok(Message::Binary(packet)) => {
                let (frame, decoder) = self.decoder.as_mut().expect("the hello comes first");
                decoder.decode(&packet, frame).expect("what a viewer gets can be decoded");
                Sight::Face(frame)
            }
            Ok(_) => Sight::Nothing,
            Err(Error::Io(error)) if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut) => Sight::Nothing,
            Err(_) => Sight::Gone,
        }
    }
}
