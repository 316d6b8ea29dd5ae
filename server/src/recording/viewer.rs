//! Recording as a viewer: the packets of a room on any server, without what its publisher sent.

use super::files::hold;
use super::format::{SessionEvent, VERSION};
use super::recorder::RecordError;
use super::writer::{RecordingWriter, nanos, unix_nanos};
use crate::send::{SendError, connect};
use futures_util::StreamExt;
use mcap::McapError;
use rhytid_shared::packet::PacketLayout;
use rhytid_shared::trust::Trust;
use rhytid_shared::view::ViewMessage;
use std::fs::{File, OpenOptions};
use std::future::Future;
use std::path::Path;
use std::time::{Duration, Instant};
use tokio_tungstenite::tungstenite::Message;

/// Largest message: the hello of 64 bones and 8 poses takes about 60 KB.
const MAX_MESSAGE: usize = 1 << 20;
/// How long the server may take to shake hands and to say hello.
const PATIENCE: Duration = Duration::from_secs(10);
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

/// Records `room` of `server` (e.g. `ws://127.0.0.1:7878`; `wss://` where `trust` says so; with `token` where it wants one) into a
/// new file at `out` until `stop` is done or the server closes; gives the number of packets and of bytes.
pub async fn watch(
    server: &str,
    room: &str,
    trust: &Trust,
    token: Option<&str>,
    out: &Path,
    stop: impl Future<Output = ()>,
) -> Result<(u64, u64), WatchError> {
    let url = format!("{}/v1/rooms/{room}/view", server.trim_end_matches('/'));
    let failed = |problem: String| WatchError::Server { url: url.clone(), problem };
    let mut socket = connect(url.clone(), trust, token, PATIENCE, MAX_MESSAGE).await.map_err(|error| match error {
        SendError::Connect { problem, .. } => failed(problem),
        other => failed(other.to_string()),
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
        Ok(text) => text.map_err(failed)?,
        Err(_) => return Err(failed(format!("no hello within {} s", PATIENCE.as_secs()))),
    };
    let hello = match serde_json::from_str(&text) {
        Ok(ViewMessage::Hello(hello)) => hello,
        Ok(ViewMessage::Error { message, .. }) => return Err(failed(message)),
        Ok(ViewMessage::Frame(_)) => return Err(failed("it begins with a frame".into())),
        Err(error) => return Err(failed(format!("its hello is none: {error}"))),
    };
    let layout = PacketLayout::try_from(&hello.character).map_err(|error| failed(error.to_string()))?;
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
        character: Box::new(hello.character),
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
