//! Recording as a viewer: the packets of a room on any server, without what its publisher sent.

use super::files::hold;
use super::format::{SessionEvent, VERSION};
use super::recorder::RecordError;
use super::writer::{RecordingWriter, nanos, unix_nanos};
use crate::send::{SendError, Socket, connect};
use futures_util::{SinkExt, StreamExt};
use mcap::McapError;
use rhytid_shared::packet::PacketLayout;
use rhytid_shared::trust::Trust;
use rhytid_shared::view::{CharacterHello, ViewMessage};
use std::fs::{File, OpenOptions};
use std::future::Future;
use std::path::Path;
use std::time::{Duration, Instant};
use tokio_tungstenite::tungstenite::Message;
use tokio_tungstenite::tungstenite::protocol::CloseFrame;
use tokio_tungstenite::tungstenite::protocol::frame::coding::CloseCode;

/// Largest message: the hello of 64 bones and 8 poses takes about 60 KB.
const MAX_MESSAGE: usize = 1 << 20;
/// How long the server may take to shake hands and to say hello.
const PATIENCE: Duration = Duration::from_secs(10);
/// How long a server that has said it would go on, or goes away, is looked for: longer than a restart takes.
const BACK_WITHIN: Duration = Duration::from_secs(10);
/// How long each try waits before it begins.
const TRY_AFTER: Duration = Duration::from_millis(250);
/// How often a chunk that is due is looked for while nothing comes.
const LOOK_EVERY: Duration = Duration::from_millis(100);

/// Why a room could not be recorded.
#[derive(Debug, thiserror::Error)]
pub enum WatchError {
    /// The server could not be reached, or is none.
    #[error("{url}: {problem}")]
    Server {
        /// Where.
        url: String,
        /// What happened.
        problem: String,
    },
    /// The file could not be made or written.
    #[error("{path}: {problem}")]
    File {
        /// The file.
        path: String,
        /// What happened.
        problem: String,
    },
}

/// Where a viewer enters, and with what.
struct Door<'a> {
    url: String,
    trust: &'a Trust,
    token: Option<&'a str>,
}

impl Door<'_> {
    /// Connects and waits for the hello; else says what is wrong.
    async fn enter(&self) -> Result<(Socket, CharacterHello), String> {
        let mut socket = connect(self.url.clone(), self.trust, self.token, PATIENCE, MAX_MESSAGE).await.map_err(|error| match error {
            SendError::Connect { problem, .. } => problem,
            other => other.to_string(),
        })?;
        let greeting = async {
            loop {
                match socket.next().await {
                    Some(Ok(Message::Text(text))) => return Ok(text),
                    Some(Ok(_)) => {}
                    Some(Err(error)) => return Err(error.to_string()),
                    None => return Err("it closed before its hello".into()),
                }
            }
        };
        let text = match tokio::time::timeout(PATIENCE, greeting).await {
            Ok(text) => text?,
            Err(_) => return Err(format!("no hello within {} s", PATIENCE.as_secs())),
        };
        match serde_json::from_str(&text) {
            Ok(ViewMessage::Hello(hello)) => Ok((socket, hello.character)),
            Ok(ViewMessage::Error { message, .. }) => Err(message),
            Ok(ViewMessage::Frame(_)) => Err("it begins with a frame".into()),
            Err(error) => Err(format!("its hello is none: {error}")),
        }
    }

    /// Tries it again and again, for [`BACK_WITHIN`]; else says what was wrong last.
    async fn enter_again(&self) -> Result<(Socket, CharacterHello), String> {
        let mut problem = "no answer".to_owned();
        let trying = async {
            loop {
                tokio::time::sleep(TRY_AFTER).await;
                match self.enter().await {
                    Ok(entered) => return entered,
                    Err(error) => problem = error,
                }
            }
        };
        let entered = tokio::time::timeout(BACK_WITHIN, trying).await;
        entered.map_err(|_| problem)
    }
}

/// Records `room` of `server` (e.g. `ws://127.0.0.1:7878`; `wss://` where `trust` says so; with `token` where it wants one) into a
/// new file at `out` until `stop` is done or the server closes; gives the number of packets and of bytes. A server that closes
/// because it restarts, or begins the room anew, is connected to again, and the file goes on behind a gap.
pub async fn watch(
    server: &str,
    room: &str,
    trust: &Trust,
    token: Option<&str>,
    out: &Path,
    stop: impl Future<Output = ()>,
) -> Result<(u64, u64), WatchError> {
    let door = Door { url: format!("{}/v1/rooms/{room}/view", server.trim_end_matches('/')), trust, token };
    let failed = |problem: String| WatchError::Server { url: door.url.clone(), problem };
    let (mut socket, character) = door.enter().await.map_err(failed)?;
    let layout = PacketLayout::try_from(&character).map_err(|error| failed(error.to_string()))?;
    let sha256 = character.sha256.clone();
    let write_error = |error: &dyn std::fmt::Display| WatchError::File { path: out.display().to_string(), problem: error.to_string() };
    let file = OpenOptions::new().write(true).create_new(true).open(out).map_err(|error| write_error(&error))?;
    hold(&file);
    let mut writer: RecordingWriter<File> = RecordingWriter::to(file, layout).map_err(|error: RecordError| write_error(&error))?;
    // Looked at once: a clock that is set back meanwhile would give what follows one time.
    let (started, begin_nanos) = (Instant::now(), unix_nanos());
    let now = || begin_nanos.saturating_add(nanos(started.elapsed()));
    let begin = SessionEvent::Recording {
        version: VERSION,
        room: room.to_owned(),
        server: env!("CARGO_PKG_VERSION").into(),
        character: Box::new(character),
        clock: 0,
    };
    writer.event(now(), &begin).map_err(|error: McapError| write_error(&error))?;
    let mut num_packets = 0;
    let mut look = tokio::time::interval(LOOK_EVERY);
    tokio::pin!(stop);
    let reason = loop {
        tokio::select! {
            () = &mut stop => break "told to",
            _ = look.tick() => writer.flush_if_due().map_err(|error| write_error(&error))?,
            message = socket.next() => match message {
                Some(Ok(Message::Binary(bytes))) => {
                    num_packets += 1;
                    writer.put_packet(now(), bytes).map_err(|error| write_error(&error))?;
                }
                Some(Ok(Message::Close(Some(frame)))) if matches!(frame.code, CloseCode::Restart | CloseCode::Away) => {
                    let CloseFrame { code, reason } = frame;
                    tracing::warn!(code = u16::from(code), %reason, "the server closed; connecting again for {} s", BACK_WITHIN.as_secs());
                    // The server waits for the answer to its close, which stands ready.
                    let _ = tokio::time::timeout(TRY_AFTER, socket.flush()).await;
                    // It may take a while, in which nothing else looks after the file.
                    writer.flush().map_err(|error| write_error(&error))?;
                    let back = tokio::select! {
                        () = &mut stop => break "told to",
                        back = door.enter_again() => back,
                    };
                    match back {
                        Ok((again, character)) if character.sha256 == sha256 => socket = again,
                        Ok(_) => {
                            tracing::warn!("the server has another character now; the recording ends");
                            break "the server has another character";
                        }
                        Err(problem) => {
                            tracing::warn!(problem, "the server did not come back; the recording ends");
                            break "the server closed";
                        }
                    }
                    tracing::warn!("connected again; the recording goes on");
                    // How many packets there were meanwhile, nobody knows.
                    writer.event(now(), &SessionEvent::Gap { messages: 0 }).map_err(|error| write_error(&error))?;
                }
                Some(Ok(Message::Close(_))) | None => break "the server closed",
                Some(Ok(_)) => {}
                Some(Err(error)) => {
                    tracing::warn!(%error, "connection lost");
                    break "the connection was lost";
                }
            },
        }
    };
    writer.event(now(), &SessionEvent::Stop { reason: reason.into() }).map_err(|error| write_error(&error))?;
    let num_bytes = writer.finish().map_err(|error| write_error(&error))?;
    Ok((num_packets, num_bytes))
}

#[cfg(test)]
mod tests {
    use super::super::{Faces, Recording};
    use super::*;
    use rhytid_shared::FaceFrame;
    use rhytid_shared::packet::Encoder;
    use rhytid_shared::view::{SUBPROTOCOL, ViewHello};
    use tokio_tungstenite::tungstenite::handshake::server::{Request, Response};
    use tokio_tungstenite::tungstenite::http::HeaderValue;

    /// A server that shows a face of each of `sessions` to one connection after the other, and closes each with its code.
    async fn serve(listener: tokio::net::TcpListener, sessions: Vec<(u32, u16)>) {
        let (character, _) = crate::load_character(None).unwrap();
        let hello = serde_json::to_string(&ViewMessage::Hello(ViewHello::new("demo", &character, "/demo.glb".into()))).unwrap();
        for (session, code) in sessions {
            let (stream, _) = listener.accept().await.unwrap();
            #[expect(clippy::result_large_err, reason = "the callback's type is the library's")]
            let choose = |_: &Request, mut answer: Response| {
                answer.headers_mut().insert("sec-websocket-protocol", HeaderValue::from_static(SUBPROTOCOL));
                Ok(answer)
            };
            let mut socket = tokio_tungstenite::accept_hdr_async(stream, choose).await.unwrap();
            socket.send(Message::text(hello.clone())).await.unwrap();
            let mut packet = Vec::new();
            Encoder::new(PacketLayout::from(&*character)).encode(&FaceFrame { session, ..FaceFrame::at_rest(&character) }, &mut packet);
            socket.send(Message::binary(packet)).await.unwrap();
            socket.close(Some(CloseFrame { code: code.into(), reason: "".into() })).await.unwrap();
            while socket.next().await.is_some_and(|message| message.is_ok()) {}
        }
        panic!("nobody connects more often: {:?}", listener.accept().await);
    }

    #[tokio::test]
    async fn a_server_that_restarts_is_recorded_on_and_one_that_closes_otherwise_is_not() {
        let folder = tempfile::tempdir().unwrap();
        let out = folder.path().join("take.mcap");
        let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
        let url = format!("ws://{}", listener.local_addr().unwrap());
        let trust = Trust::default();
        let watching = watch(&url, "demo", &trust, None, &out, std::future::pending());
        let (packets, _) = tokio::select! {
            watched = watching => watched.unwrap(),
            () = serve(listener, vec![(7, 1012), (3, 1001), (4, 1000)]) => unreachable!(),
        };
        assert_eq!(packets, 3);
        let mut faces = Faces::new(Recording::open(&out).unwrap());
        let mut sessions = Vec::new();
        while faces.advance().unwrap().is_some() {
            sessions.push(faces.frame().session);
        }
        assert_eq!((sessions, faces.num_unreadable()), (vec![7, 3, 4], 0));
    }
}
