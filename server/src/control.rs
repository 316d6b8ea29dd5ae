//! A control socket: somebody who speaks for a source that cannot speak for itself, such as a phone's tracker: its settings, its
//! neutral face, the guided fit. It takes and gives the messages of a publish socket, without frames.

use crate::config::seconds;
use crate::http::Pass;
use crate::publish::{Rate, until};
use crate::service::{Hub, stopped};
use crate::socket::{Ending, ErrorMessage, Socket, Stop, broken, end, send, send_json};
use crate::source::{Control, Told};
use futures_util::StreamExt;
use futures_util::stream::FuturesUnordered;
use rhytid_shared::{FIT_SECONDS, PublishReader, RoomName};
use std::convert::Infallible;
use std::sync::Arc;
use std::time::Duration;
use tokio::sync::mpsc::error::TrySendError;
use tokio::sync::oneshot;
use tokio::time::Instant;
use tokio_tungstenite::tungstenite::protocol::frame::coding::CloseCode;
use tokio_tungstenite::tungstenite::{Bytes, Message, Utf8Bytes};

/// Commands of one socket that may wait for their answers.
const MOST_WAITING: usize = 4;
/// Messages a second of one socket: more than the commands that any source takes, and pongs.
const MOST_MESSAGES: u32 = 50;
/// How much longer than a step of the fit measures its frames may take to come.
const PATIENCE: Duration = Duration::from_secs(5);

/// Where commands go: the slot of a room, whoever has it.
pub(crate) struct Target {
    pub hub: Arc<Hub>,
    pub room: RoomName,
    pub slot: String,
}

impl Target {
    /// Sends a command; what comes back answers it.
    fn send(&self, command: rhytid_shared::Command, text: Utf8Bytes) -> Result<oneshot::Receiver<Told>, ErrorMessage> {
        let Self { hub, room, slot } = self;
        let controls = hub.rooms.find(room).and_then(|room| room.controls(slot));
        let none = || ErrorMessage::new("no_source", format!("room {room} has no source in the slot {slot:?}, expected one that sends"));
        let (answer, answered) = oneshot::channel();
        match controls.ok_or_else(none)?.try_send(Control { command, text, answer }) {
            Ok(()) => Ok(answered),
            Err(TrySendError::Full(_)) => {
                Err(ErrorMessage::new("too_many_commands", "the source has commands waiting, expected its answers first"))
            }
            Err(TrySendError::Closed(_)) => Err(none()),
        }
    }
}

/// Takes commands until one side ends it.
pub(crate) async fn talk(target: Target, mut socket: Socket, pass: Pass) {
    let mut shutdown = target.hub.shutdown.clone();
    let Err(stop) = tokio::select! {
        biased;
        () = stopped(&mut shutdown) => Err(Ending::shutdown().into()),
        () = until(pass.expires) => Err(Ending::token_expired().into()),
        result = run(&target, &mut socket, &pass) => result,
    };
    end(socket, stop, &target.hub.metrics).await;
}

async fn run(target: &Target, socket: &mut Socket, pass: &Pass) -> Result<Infallible, Stop> {
    let timeouts = &target.hub.config.timeouts;
    let (ping, idle, write) = (seconds(timeouts.ping), seconds(timeouts.viewer_idle), seconds(timeouts.write));
    let mut waiting = FuturesUnordered::new();
    let mut messages = Rate::new(MOST_MESSAGES, Instant::now());
    let (mut last_ping, mut last_heard) = (Instant::now(), Instant::now());
    loop {
        let told: Told = tokio::select! {
            message = tokio::time::timeout_at(last_heard + idle, socket.next()) => {
                last_heard = Instant::now();
                let limits = &target.hub.config.limits;
                let by_address = pass.place.as_ref().and_then(|place| place.take_message(last_heard.into_std())).map(Instant::from_std);
                // As a publisher that is too fast, whether or not there is somebody to command: nothing is read meanwhile.
                if let Some(until) = messages.take(last_heard).max(by_address) {
                    last_heard = until;
                    tokio::time::sleep_until(until).await;
                }
                match message {
                    Err(_) => return Err(Ending::error(
                        CloseCode::Policy,
                        ErrorMessage::new("idle", format!("nothing heard for {} seconds", timeouts.viewer_idle)),
                    ).into()),
                    Ok(Some(Ok(Message::Text(text)))) => {
                        let sent = if waiting.len() < MOST_WAITING {
                            PublishReader::read_command(&text)
                                .map_err(|error| ErrorMessage::new(error.code, error.message))
                                .and_then(|command| target.send(command, text))
                        } else {
                            Err(ErrorMessage::new("too_many_commands", format!("{MOST_WAITING} commands wait, expected their answers first")))
                        };
                        match sent {
                            Ok(answered) => {
                                waiting.push(answer(answered));
                                continue;
                            }
                            Err(error) => Err(error),
                        }
                    }
                    Ok(Some(Ok(Message::Binary(_)))) => Err(ErrorMessage::new("binary_message", "a control socket takes text, got a binary message")),
                    Ok(Some(Ok(Message::Close(_))) | None) => return Err(Stop::Gone("closed")),
                    Ok(Some(Ok(_))) => continue,
                    Ok(Some(Err(error))) => return Err(broken(error, limits.message_bytes)),
                }
            }
            Some(told) = waiting.next() => told,
            () = tokio::time::sleep_until(last_ping + ping) => {
                last_ping = Instant::now();
                send(socket, Message::Ping(Bytes::new()), write).await?;
                continue;
            }
        };
        match told {
            Ok(text) => send(socket, Message::Text(text), write).await?,
            Err(error) => send_json(socket, &error, write).await?,
        }
    }
}

/// What a command is answered with, or that nothing came.
async fn answer(answered: oneshot::Receiver<Told>) -> Told {
    let longest = Duration::from_secs_f64(FIT_SECONDS[1]) + PATIENCE;
    match tokio::time::timeout(longest, answered).await {
        Ok(Ok(told)) => told,
        Ok(Err(_)) => Err(ErrorMessage::new("no_source", "the source has gone before it answered")),
        Err(_) => {
            Err(ErrorMessage::new("no_frames", format!("no answer within {} seconds: do frames of the source come?", longest.as_secs())))
        }
    }
}
