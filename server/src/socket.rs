//! WebSockets below the messages: the upgrade with its checks, small buffers, and closing so that the last word arrives.

use crate::metrics::Metrics;
use crate::service::{Hub, Place, stopped};
use crate::stream::{TimedStream, Wire};
use crate::token::Refusal;
use axum::body::Body;
use axum::extract::Request;
use axum::http::{HeaderMap, HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use futures_util::{SinkExt, StreamExt};
use hyper_util::rt::TokioIo;
use rhytid_shared::view::SUBPROTOCOL;
use serde::Serialize;
use std::future::Future;
use std::sync::Arc;
use std::time::Duration;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio_tungstenite::WebSocketStream;
use tokio_tungstenite::tungstenite::error::{CapacityError, ProtocolError};
use tokio_tungstenite::tungstenite::handshake::derive_accept_key;
use tokio_tungstenite::tungstenite::protocol::frame::coding::CloseCode;
use tokio_tungstenite::tungstenite::protocol::{CloseFrame, Role, WebSocketConfig};
use tokio_tungstenite::tungstenite::{Error, Message};

/// A server's end of a WebSocket.
pub(crate) type Socket = WebSocketStream<Wire>;

/// How long a peer may take to answer a close before its connection is cut.
const CLOSE_TIMEOUT: Duration = Duration::from_secs(1);

/// Bytes that are read and thrown away after the last word: the largest message a configuration may allow. A peer that has
/// more to say loses the last word.
const MOST_DRAINED: usize = 16 << 20;

/// How long the first frames, a few KB, may take to get into a fresh socket.
const FIRST_WRITE_TIMEOUT: Duration = Duration::from_secs(10);

/// An error as it goes to a peer, over HTTP or a socket.
#[derive(Debug, Clone, Serialize)]
#[serde(tag = "type", rename = "error")]
pub(crate) struct ErrorMessage {
    pub code: &'static str,
    pub message: String,
}

impl ErrorMessage {
    pub fn new(code: &'static str, message: impl Into<String>) -> Self {
        Self { code, message: message.into() }
    }

    /// As an HTTP answer.
    pub fn response(&self, status: StatusCode) -> Response {
        (status, axum::Json(self)).into_response()
    }
}

/// Why the server ends a socket: told as a message where there is an error, and in the close frame.
#[derive(Debug, Clone)]
pub(crate) struct Ending {
    pub error: Option<ErrorMessage>,
    pub code: CloseCode,
    pub reason: String,
}

impl Ending {
    /// Ends with an error message and the same words as the reason of the close.
    pub fn error(code: CloseCode, error: ErrorMessage) -> Self {
        Self { code, reason: error.message.clone(), error: Some(error) }
    }

    /// What the peer was let in with does not hold any longer.
    pub fn token_expired() -> Self {
        let (code, words) = Refusal::Expired.words();
        Self::error(CloseCode::Policy, ErrorMessage::new(code, words))
    }

    /// The server stops.
    pub fn shutdown() -> Self {
        Self { error: None, code: CloseCode::Away, reason: "server is shutting down".into() }
    }

    /// The peer shall connect again and begin anew: the numbers of the room's sessions have gone back.
    pub fn moved() -> Self {
        Self { error: None, code: CloseCode::Restart, reason: "the room counts its sessions anew; connect again".into() }
    }

    /// What it is counted as.
    fn label(&self) -> &'static str {
        match (&self.error, self.code) {
            (Some(error), _) => error.code,
            (None, CloseCode::Restart) => "moved",
            (None, _) => "shutdown",
        }
    }
}

/// Why talking to a peer stopped.
pub(crate) enum Stop {
    /// The server ends it.
    End(Ending),
    /// The peer closed, vanished or does not take what it is sent.
    Gone(&'static str),
}

impl Stop {
    /// Counts it among the ends of sockets.
    pub fn count(&self, metrics: &Metrics) {
        metrics.end(match self {
            Self::End(ending) => ending.label(),
            Self::Gone(reason) => reason,
        });
    }
}

impl From<Ending> for Stop {
    fn from(ending: Ending) -> Self {
        Self::End(ending)
    }
}

/// A request for a WebSocket that has been checked.
pub(crate) struct Handshake {
    accept: HeaderValue,
    /// The peer offers subprotocols, ours among them.
    offers_protocol: bool,
}

impl Handshake {
    /// Checks `request`; the answer that refuses it where it is no handshake, or one for another protocol.
    pub fn check(request: &Request) -> Result<Self, Box<Response>> {
        let headers = request.headers();
        let has_token = |name, token: &str| tokens(headers, &name).any(|given| given.eq_ignore_ascii_case(token));
        let version_is_13 = headers.get(header::SEC_WEBSOCKET_VERSION).is_some_and(|version| version == "13");
        let (true, true, true, Some(key)) = (
            has_token(header::CONNECTION, "upgrade"),
            has_token(header::UPGRADE, "websocket"),
            version_is_13,
            headers.get(header::SEC_WEBSOCKET_KEY),
        ) else {
            let mut answer =
                ErrorMessage::new("not_a_websocket", "expected a WebSocket handshake, version 13").response(StatusCode::UPGRADE_REQUIRED);
            answer.headers_mut().insert(header::SEC_WEBSOCKET_VERSION, HeaderValue::from_static("13"));
            return Err(answer.into());
        };
        let mut offered = tokens(headers, &header::SEC_WEBSOCKET_PROTOCOL).peekable();
        let offers_protocol = offered.peek().is_some();
        if offers_protocol && !offered.any(|protocol| protocol == SUBPROTOCOL) {
            let message = format!("none of the subprotocols offered is known, expected {SUBPROTOCOL} or none at all");
            return Err(ErrorMessage::new("unknown_subprotocol", message).response(StatusCode::BAD_REQUEST).into());
        }
        let accept = HeaderValue::from_str(&derive_accept_key(key.as_bytes())).expect("base64 is a header value");
        Ok(Self { accept, offers_protocol })
    }
}

/// Answers a handshake, writes the `first` frames and runs `talk` on the socket in a task of its own.
pub(crate) fn upgrade<F, Fut>(
    hub: &Hub,
    mut request: Request,
    handshake: Handshake,
    config: WebSocketConfig,
    first: Vec<u8>,
    talk: F,
) -> Response
where
    F: FnOnce(Socket) -> Fut + Send + 'static,
    Fut: Future<Output = ()> + Send,
{
    let mut shutdown = hub.shutdown.clone();
    let upgraded = hyper::upgrade::on(&mut request);
    let place = request.extensions().get::<Arc<Place>>().cloned();
    tokio::spawn(async move {
        let parts = match upgraded.await.map(hyper::upgrade::Upgraded::downcast::<TokioIo<TimedStream>>) {
            Ok(Ok(parts)) => parts,
            Ok(Err(_)) => return tracing::error!("an upgraded connection is not the stream it was"),
            Err(error) => return tracing::debug!(%error, "the upgrade did not happen"),
        };
        let mut stream = parts.io.into_inner().into_inner();
        // The first frames go around the WebSocket's write buffer, which would keep their size for as long as it lives.
        let is_written = tokio::select! {
            biased;
            written = tokio::time::timeout(FIRST_WRITE_TIMEOUT, stream.write_all(&first)) => matches!(written, Ok(Ok(()))),
            // A socket that does not take its first frames cannot be told of the end either.
            () = stopped(&mut shutdown) => false,
        };
        if !is_written {
            return;
        }
        drop(first);
        // Hyper's buffer is 8 KiB, whatever it holds: what is kept here is kept for as long as the socket lives.
        let already_read = parts.read_buf.to_vec();
        drop(parts.read_buf);
        talk(WebSocketStream::from_partially_read(stream, already_read, Role::Server, Some(config)).await).await;
        drop(place);
    });
    let mut answer = Response::new(Body::empty());
    *answer.status_mut() = StatusCode::SWITCHING_PROTOCOLS;
    answer.headers_mut().insert(header::SEC_WEBSOCKET_ACCEPT, handshake.accept);
    answer.headers_mut().insert(header::CONNECTION, HeaderValue::from_static("upgrade"));
    answer.headers_mut().insert(header::UPGRADE, HeaderValue::from_static("websocket"));
    if handshake.offers_protocol {
        answer.headers_mut().insert(header::SEC_WEBSOCKET_PROTOCOL, HeaderValue::from_static(SUBPROTOCOL));
    }
    answer
}

/// The comma-separated words of all headers called `name`.
pub(crate) fn tokens<'a>(headers: &'a HeaderMap, name: &header::HeaderName) -> impl Iterator<Item = &'a str> {
    headers
        .get_all(name)
        .into_iter()
        .filter_map(|value| value.to_str().ok())
        .flat_map(|value| value.split(','))
        .map(str::trim)
        .filter(|word| !word.is_empty())
}

/// Sends one message within `timeout`.
pub(crate) async fn send(socket: &mut Socket, message: Message, timeout: Duration) -> Result<(), Stop> {
    match tokio::time::timeout(timeout, socket.send(message)).await {
        Ok(Ok(())) => Ok(()),
        Ok(Err(_)) => Err(Stop::Gone("connection_lost")),
        Err(_) => Err(Stop::Gone("write_timeout")),
    }
}

/// Sends `value` as JSON text within `timeout`.
pub(crate) async fn send_json(socket: &mut Socket, value: &impl Serialize, timeout: Duration) -> Result<(), Stop> {
    let text = serde_json::to_string(value).expect("plain data can be written");
    send(socket, Message::text(text), timeout).await
}

/// What a broken stream of messages, of at most `most` bytes each, means for its sender.
pub(crate) fn broken(error: Error, most: usize) -> Stop {
    match error {
        Error::Capacity(CapacityError::MessageTooLong { size, .. }) => {
            let message = format!("message has {size} bytes or more, at most {most} are allowed");
            Ending::error(CloseCode::Size, ErrorMessage::new("too_long", message)).into()
        }
        Error::Utf8(_) => Ending::error(CloseCode::Invalid, ErrorMessage::new("not_utf8", "text message is not UTF-8")).into(),
        // The connection ended without a close, as when a laptop's lid shuts.
        Error::Protocol(ProtocolError::ResetWithoutClosingHandshake) => Stop::Gone("connection_lost"),
        Error::Protocol(error) => Ending::error(CloseCode::Protocol, ErrorMessage::new("protocol", error.to_string())).into(),
        _ => Stop::Gone("connection_lost"),
    }
}

/// Ends a socket as `stop` says, and counts it.
pub(crate) async fn end(socket: Socket, stop: Stop, metrics: &Metrics) {
    stop.count(metrics);
    match stop {
        Stop::End(ending) => close(socket, &ending).await,
        Stop::Gone(_) => farewell(socket).await,
    }
}

/// Tells the peer why, closes, and waits a little for its answer: what is unread when a connection is cut would take the
/// last message with it.
pub(crate) async fn close(mut socket: Socket, ending: &Ending) {
    let telling = async {
        if let Some(error) = &ending.error {
            let text = serde_json::to_string(error).expect("plain data can be written");
            socket.feed(Message::text(text)).await?;
        }
        // A control frame holds 125 bytes, two of them the code.
        let reason: String = ending
            .reason
            .chars()
            .scan(0, |len, c| {
                *len += c.len_utf8();
                (*len <= 120).then_some(c)
            })
            .collect();
        socket.send(Message::Close(Some(CloseFrame { code: ending.code, reason: reason.into() }))).await?;
        Ok::<(), Error>(())
    };
    if let Ok(Ok(())) = tokio::time::timeout(CLOSE_TIMEOUT, telling).await {
        farewell(socket).await;
    }
}

/// Reads to the end of a socket that one side has closed, which also sends the answer to a peer's close.
async fn farewell(mut socket: Socket) {
    let reading = async {
        while socket.next().await.is_some_and(|message| message.is_ok()) {}
        // After an error the WebSocket gives nothing more, but its peer may still be writing.
        drain(&mut socket.into_inner()).await;
    };
    // A peer that stays silent is cut off.
    let _ = tokio::time::timeout(CLOSE_TIMEOUT, reading).await;
}

/// Says the last word on a connection that has not become a socket.
pub(crate) async fn say_and_close(mut stream: Wire, bytes: &[u8]) {
    let saying = async {
        if stream.write_all(bytes).await.is_ok() {
            drain(&mut stream).await;
        }
    };
    // A peer that stays is cut off.
    let _ = tokio::time::timeout(CLOSE_TIMEOUT, saying).await;
}

/// Ends the sending half, then reads what still comes and throws it away, up to [`MOST_DRAINED`] bytes: a connection that is
/// dropped with unread bytes is reset, and a reset takes the bytes on their way to the peer with it.
async fn drain(stream: &mut Wire) {
    if stream.shutdown().await.is_err() {
        return;
    }
    let mut buffer = vec![0; 16 << 10];
    let mut num_left = MOST_DRAINED;
    while num_left > 0 {
        match stream.read(&mut buffer).await {
            Ok(0) | Err(_) => return,
            Ok(num_bytes) => num_left = num_left.saturating_sub(num_bytes),
        }
    }
}
