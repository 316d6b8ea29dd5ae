//! One connection, from its first byte to its last.

use super::inbox::Inbox;
use super::wire::Wire;
use super::{CharacterSource, Connected, LinkOptions, ServerAddress, fetch};
use rhytid_shared::FaceFrame;
use rhytid_shared::packet::{Decoder, PacketLayout};
use rhytid_shared::view::{PROTOCOL_VERSION, SUBPROTOCOL, ViewHello, ViewMessage};
use rustls::CertificateError;
use std::io::ErrorKind;
use std::net::{TcpStream, ToSocketAddrs};
use std::time::{Duration, Instant};
use tungstenite::error::{ProtocolError, SubProtocolError};
use tungstenite::http::StatusCode;
use tungstenite::protocol::WebSocketConfig;
use tungstenite::{ClientRequestBuilder, HandshakeError, Message, WebSocket};

/// Longest time to reach the server, and again to shake hands.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(3);
/// The same where there are other servers to try.
const CONNECT_TIMEOUT_OF_MANY: Duration = Duration::from_secs(1);
/// How often a quiet socket is looked up from, to ping and to see whether the link shall end.
const LOOK_UP: Duration = Duration::from_millis(50);
/// How often the way is measured.
const PING_EVERY: Duration = Duration::from_secs(2);
/// After three pings without any answer the server is gone, whatever TCP thinks.
const SILENCE: Duration = Duration::from_secs(6);
/// The same two where there are other servers to try: the face shall be back within two seconds.
const PING_EVERY_OF_MANY: Duration = Duration::from_millis(300);
const SILENCE_OF_MANY: Duration = Duration::from_millis(1200);
/// Largest message: the hello of 64 bones and 8 poses takes about 60 KB.
const MAX_MESSAGE: usize = 1 << 20;
/// What tungstenite reads at once; its own 128 KiB is for files.
const READ_BUFFER: usize = 16 << 10;

/// Why a connection is over.
pub(super) enum Ended {
    /// The link was dropped.
    Stopped,
    /// Trying again may help.
    Lost(String),
    /// The character could not be had. Trying again may help, but costs.
    NoCharacter(String),
    /// Trying again will not.
    Refused(String),
}

/// Connects and reads until the connection is over. The sha256 of a character fetched on the way is kept in `options`.
pub(super) fn watch(options: &mut LinkOptions, server: &ServerAddress, inbox: &Inbox, wake: &dyn Fn()) -> Ended {
    let is_of_many = options.servers.all().len() > 1;
    let socket = match connect(options, server, if is_of_many { CONNECT_TIMEOUT_OF_MANY } else { CONNECT_TIMEOUT }) {
        Ok(socket) => socket,
        Err(ended) => return ended,
    };
    let mut connection = Connection {
        socket,
        options,
        server,
        ping_every: if is_of_many { PING_EVERY_OF_MANY } else { PING_EVERY },
        silence: if is_of_many { SILENCE_OF_MANY } else { SILENCE },
        inbox,
        wake,
        stream: None,
        heard_at: Instant::now(),
        pinged_at: Instant::now(),
        pings: 0,
        parting_words: None,
    };
    let ended = connection.read_until_over();
    if matches!(ended, Ended::Stopped) {
        // The server notices a closed connection by itself too; this only tells it sooner.
        let _ = connection.socket.close(None);
        let _ = connection.socket.flush();
    }
    ended
}

fn connect(options: &LinkOptions, server: &ServerAddress, timeout: Duration) -> Result<WebSocket<Wire>, Ended> {
    let lost = |why: String| Ended::Lost(why);
    let (host, port) = server.host_and_port();
    let addresses = (host, port).to_socket_addrs().map_err(|error| lost(format!("{host} is not known: {error}")))?;
    let mut failure = format!("{host} has no address");
    let stream = addresses
        .into_iter()
        .find_map(|address| TcpStream::connect_timeout(&address, timeout).map_err(|error| failure = plain_words(&error)).ok())
        .ok_or_else(|| lost(failure))?;
    let set_up = || {
        stream.set_nodelay(true)?;
        stream.set_read_timeout(Some(timeout))?;
        stream.set_write_timeout(Some(timeout))
    };
    set_up().map_err(|error| lost(error.to_string()))?;
    let stream = Wire::new(stream, server, &options.trust).map_err(|error| untrusted(&error))?;

    let uri = server.view_uri(&options.room);
    let uri = uri.parse().map_err(|error| Ended::Refused(format!("{uri} is no address: {error}")))?;
    let mut request = ClientRequestBuilder::new(uri).with_sub_protocol(SUBPROTOCOL);
    if let Some(token) = &options.token {
        if !server.may_carry_secrets() {
            return Err(Ended::Refused("a token goes over wss:// only, or to this machine: others on the way could read it".into()));
        }
        request = request.with_header("Authorization", format!("Bearer {token}"));
    }
    let config =
        WebSocketConfig::default().read_buffer_size(READ_BUFFER).max_message_size(Some(MAX_MESSAGE)).max_frame_size(Some(MAX_MESSAGE));
    let (socket, _) = tungstenite::client::client_with_config(request, stream, Some(config)).map_err(|error| match error {
        HandshakeError::Interrupted(_) => lost("the server does not answer".into()),
        HandshakeError::Failure(error) => refusal(error),
    })?;
    socket.get_ref().tcp().set_read_timeout(Some(LOOK_UP)).map_err(|error| lost(error.to_string()))?;
    Ok(socket)
}

/// A certificate that is not trusted will not be the next time either.
fn untrusted(error: &std::io::Error) -> Ended {
    match error.get_ref().and_then(|inner| inner.downcast_ref::<rustls::Error>()) {
        Some(rustls::Error::InvalidCertificate(CertificateError::ApplicationVerificationFailure)) => {
            Ended::Refused("the server's certificate has another fingerprint than --trust says".into())
        }
        Some(rustls::Error::InvalidCertificate(why)) => {
            Ended::Refused(format!("the server's certificate is not trusted ({why}); --trust FINGERPRINT or FILE.pem trusts one"))
        }
        Some(rustls::Error::InvalidMessage(_)) => Ended::Refused("the server does not speak TLS; use ws://".into()),
        _ => Ended::Lost(plain_words(error)),
    }
}

/// Which failed handshakes will fail again.
fn refusal(error: tungstenite::Error) -> Ended {
    match error {
        tungstenite::Error::Http(response) => {
            let status = response.status();
            let said = response.body().as_deref().map(String::from_utf8_lossy).unwrap_or_default();
            let said: String = said.trim().chars().take(300).collect();
            let message = if said.is_empty() { status.to_string() } else { said };
            let may_pass = status.is_server_error() || matches!(status, StatusCode::REQUEST_TIMEOUT | StatusCode::TOO_MANY_REQUESTS);
            if may_pass { Ended::Lost(message) } else { Ended::Refused(message) }
        }
        tungstenite::Error::Protocol(ProtocolError::SecWebSocketSubProtocolError(
            SubProtocolError::NoSubProtocol | SubProtocolError::InvalidSubProtocol,
        )) => Ended::Refused(format!("the server does not speak {SUBPROTOCOL}")),
        tungstenite::Error::Io(error) => Ended::Lost(plain_words(&error)),
        error => Ended::Lost(error.to_string()),
    }
}

fn plain_words(error: &std::io::Error) -> String {
    match error.kind() {
        ErrorKind::ConnectionRefused => "no server listens there".into(),
        ErrorKind::TimedOut | ErrorKind::WouldBlock => "the server does not answer".into(),
        ErrorKind::ConnectionReset | ErrorKind::ConnectionAborted | ErrorKind::UnexpectedEof | ErrorKind::BrokenPipe => {
            "the connection broke".into()
        }
        _ => error.to_string(),
    }
}

struct Connection<'a> {
    socket: WebSocket<Wire>,
    options: &'a mut LinkOptions,
    server: &'a ServerAddress,
    ping_every: Duration,
    silence: Duration,
    inbox: &'a Inbox,
    wake: &'a dyn Fn(),
    /// What packets are decoded with, once the hello has come.
    stream: Option<(Decoder, FaceFrame)>,
    heard_at: Instant,
    pinged_at: Instant,
    pings: u64,
    /// The error message that came before the close.
    parting_words: Option<String>,
}

impl Connection<'_> {
    fn read_until_over(&mut self) -> Ended {
        loop {
            if self.inbox.is_stopped() {
                return Ended::Stopped;
            }
            let message = match self.socket.read() {
                Ok(message) => message,
                Err(tungstenite::Error::Io(error)) if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut) => {
                    if let Err(ended) = self.keep_alive() {
                        return ended;
                    }
                    continue;
                }
                Err(error) => return self.over(error),
            };
            self.heard_at = Instant::now();
            let outcome = match message {
                Message::Text(text) => self.text(&text),
                Message::Binary(packet) => {
                    self.packet(&packet);
                    Ok(())
                }
                Message::Pong(payload) => {
                    if *payload == self.pings.to_le_bytes() {
                        let round_trip = self.heard_at - self.pinged_at;
                        self.inbox.count(|stats| stats.round_trip = Some(round_trip));
                    }
                    Ok(())
                }
                Message::Close(frame) => {
                    let reason = frame.map(|frame| frame.reason.to_string()).filter(|reason| !reason.is_empty());
                    self.parting_words = self.parting_words.take().or(reason);
                    Ok(())
                }
                Message::Ping(_) | Message::Frame(_) => Ok(()),
            };
            if let Err(ended) = outcome.and_then(|()| self.keep_alive()) {
                return ended;
            }
        }
    }

    fn over(&mut self, error: tungstenite::Error) -> Ended {
        let why = match (self.parting_words.take(), error) {
            (Some(words), _) => words,
            (None, tungstenite::Error::ConnectionClosed | tungstenite::Error::AlreadyClosed) => "the server closed the connection".into(),
            (None, tungstenite::Error::Protocol(ProtocolError::ResetWithoutClosingHandshake)) => "the connection broke".into(),
            (None, tungstenite::Error::Io(error)) => plain_words(&error),
            (None, error) => error.to_string(),
        };
        Ended::Lost(why)
    }

    fn keep_alive(&mut self) -> Result<(), Ended> {
        let now = Instant::now();
        if now - self.heard_at > self.silence {
            return Err(Ended::Lost(format!("nothing heard for {} s", self.silence.as_secs_f32())));
        }
        if now - self.pinged_at >= self.ping_every {
            self.pings += 1;
            self.pinged_at = now;
            let ping = Message::Ping(self.pings.to_le_bytes().to_vec().into());
            if let Err(error) = self.socket.send(ping)
                && self.socket.can_write()
            {
                return Err(self.over(error));
            }
        }
        Ok(())
    }

    fn text(&mut self, text: &str) -> Result<(), Ended> {
        match serde_json::from_str(text) {
            Ok(ViewMessage::Hello(hello)) => self.hello(hello),
            Ok(ViewMessage::Error { code, message }) => {
                tracing::warn!(code, message, "the server says");
                self.parting_words = Some(message);
                Ok(())
            }
            Ok(ViewMessage::Frame(_)) | Err(_) => {
                self.inbox.count(|stats| stats.garbage += 1);
                Ok(())
            }
        }
    }

    fn hello(&mut self, hello: ViewHello) -> Result<(), Ended> {
        if hello.version != PROTOCOL_VERSION {
            return Err(Ended::Refused(format!("the server speaks version {}, this viewer version {PROTOCOL_VERSION}", hello.version)));
        }
        let layout =
            PacketLayout::try_from(&hello.character).map_err(|error| Ended::Refused(format!("the server's hello is wrong: {error}")))?;
        let wanted = &hello.character.sha256;
        let character = if self.options.known_sha256.as_ref() == Some(wanted) {
            CharacterSource::Known
        } else {
            let glb = fetch::character(self.server, &self.options.trust, &hello.character.url, wanted)
                .map_err(|error| Ended::NoCharacter(error.to_string()))?;
            self.options.known_sha256 = Some(wanted.clone());
            CharacterSource::Fetched(glb)
        };
        // Fetching may have taken its time; the silence was ours.
        self.heard_at = Instant::now();
        let frame = layout.frame_at_rest();
        self.stream = Some((Decoder::new(layout), frame));
        self.inbox.connected(Connected { hello, character });
        (self.wake)();
        Ok(())
    }

    fn packet(&mut self, packet: &[u8]) {
        let decoded = match &mut self.stream {
            None => false,
            Some((decoder, frame)) => match decoder.decode(packet, frame) {
                Ok(_) => {
                    self.inbox.frame(frame.clone(), self.heard_at);
                    true
                }
                Err(error) => {
                    tracing::debug!(%error, len = packet.len(), "packet skipped");
                    false
                }
            },
        };
        self.inbox.count(|stats| {
            stats.packets += 1;
            stats.bytes += packet.len() as u64;
            stats.garbage += u64::from(!decoded);
        });
        if decoded {
            (self.wake)();
        }
    }
}
