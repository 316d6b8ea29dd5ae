//! `send`: publishes a feed in real time or as fast as the server takes it.

use crate::clip::Clip;
use crate::feed::{Feed, FeedError, FeedItem};
use crate::recording::{ReadError, RecordedFeed, RecordedSession, Recording};
use futures_util::stream::{SplitSink, SplitStream};
use futures_util::{SinkExt, StreamExt};
use indicatif::ProgressBar;
use rhytid_shared::trust::Trust;
use rhytid_shared::view::SUBPROTOCOL;
use rhytid_shared::{ProfileChoice, RoomName, TrackingData, TrackingFrame, encode_landmarks};
use serde::Deserialize;
use std::collections::BTreeMap;
use std::future::Future;
use std::io::{BufRead, Cursor};
use std::path::{Path, PathBuf};
use std::pin::Pin;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;
use tokio::net::TcpStream;
use tokio::sync::{oneshot, watch};
use tokio::time::Instant;
use tokio_tungstenite::tungstenite::client::IntoClientRequest;
use tokio_tungstenite::tungstenite::http::{HeaderValue, Uri, header};
use tokio_tungstenite::tungstenite::protocol::WebSocketConfig;
use tokio_tungstenite::tungstenite::protocol::frame::coding::CloseCode;
use tokio_tungstenite::tungstenite::{self, Bytes, Message};
use tokio_tungstenite::{Connector, MaybeTlsStream, WebSocketStream, connect_async_tls_with_config};

/// How long the server may take to read what is on its way and to close.
const CLOSE_TIMEOUT: Duration = Duration::from_secs(120);
/// How long it may take to close when the sender is stopped.
const STOP_TIMEOUT: Duration = Duration::from_secs(2);
/// How long a server may be silent where there are others: with it the face is elsewhere within two seconds.
const SILENCE: Duration = Duration::from_millis(1200);
/// How often such a server is pinged.
const PING_EVERY: Duration = Duration::from_millis(300);
/// How long such a server may take to let the publisher in: it may have to ask one that does not answer.
const ENTER_TIMEOUT: Duration = Duration::from_millis(3500);
/// Between tries when no server was there.
const PAUSE: Duration = Duration::from_millis(200);
/// Frames that are due for longer than this when another server is found are old, and left out.
const OLD: Duration = Duration::from_millis(100);

/// Largest answer of a server: a fit's profile takes a few KB.
pub(crate) const MAX_ANSWER: usize = 1 << 20;

/// Why a feed could not be sent.
#[derive(Debug, thiserror::Error)]
pub enum SendError {
    /// The feed is broken.
    #[error(transparent)]
    Feed(#[from] FeedError),
    /// The recording is broken, or has nothing to send.
    #[error(transparent)]
    Recording(#[from] ReadError),
    /// The server could not be reached, or refused the connection.
    #[error("cannot connect to {url}: {problem}")]
    Connect {
        /// Where to.
        url: String,
        /// What happened.
        problem: String,
    },
    /// The server ended the session.
    #[error("the server ended the session: {reason}")]
    Ended {
        /// In the server's words.
        reason: String,
    },
}

/// What to send.
#[derive(Debug, Clone)]
pub enum SendSource {
    /// A feed file.
    File(PathBuf),
    /// A feed's text, and what to call it.
    Text(String, String),
    /// An animation clip, and what to call it.
    Clip(Arc<Clip>, String),
    /// What the publishers of a recording sent, each slot's sessions one after the other, from the first time to the second, seconds
    /// since the recording began.
    Recording(PathBuf, [f64; 2]),
}

/// What to send, where to and how.
#[derive(Debug, Clone)]
pub struct SendOptions {
    /// The feed.
    pub source: SendSource,
    /// The server, e.g. `ws://127.0.0.1:7878`, or nodes of a cluster with commas between them: when one is lost, the next one is
    /// asked, and the face goes on there as it was.
    pub to: String,
    /// The room.
    pub room: String,
    /// Feed seconds a second; infinite for as fast as the server takes it.
    pub speed: f64,
    /// Send it again and again, each time as a new session.
    pub repeats: bool,
    /// Take the room over from another publisher.
    pub takeover: bool,
    /// Slot in the room, in place of what the feed's hello says.
    pub slot: Option<RoomName>,
    /// Priority of that slot, 0 to 100, in place of what the feed's hello says.
    pub priority: Option<u8>,
    /// Send frames of landmarks in the binary form, a twelfth of the bytes; what it has no room for stays JSON.
    pub binary: bool,
    /// What is known of the performer, in place of what the feed's hello says.
    pub profile: Option<ProfileChoice>,
    /// How long the server may take to accept the connection, to answer the hello, and to read a message.
    pub timeout: Duration,
    /// Whom to trust where `to` is `wss://`.
    pub trust: Trust,
    /// What lets it in, where the server wants to know. Sent over TLS or to this machine only.
    pub token: Option<String>,
}

/// What was sent.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct SendReport {
    /// Frames sent.
    pub frames: u64,
    /// Frames and other messages that the server refused.
    pub errors: u64,
}

/// Sends a feed until its end, or until `stop` is done; `progress` counts its bytes and shows what the server answers.
pub async fn send(options: &SendOptions, progress: &ProgressBar, stop: impl Future<Output = ()>) -> Result<SendReport, SendError> {
    let mut report = SendReport::default();
    tokio::pin!(stop);
    loop {
        progress.set_position(0);
        let ending = match &options.source {
            SendSource::File(path) => {
                if let Ok(file) = std::fs::metadata(path) {
                    progress.set_length(file.len());
                }
                let feed = Feed::open_for_any_character(path)?;
                send_once(feed, options, progress, &mut report, stop.as_mut()).await?
            }
            SendSource::Text(text, name) => {
                progress.set_length(text.len() as u64);
                let feed = Feed::new_for_any_character(Cursor::new(text.as_bytes()), name.clone())?;
                send_once(feed, options, progress, &mut report, stop.as_mut()).await?
            }
            SendSource::Recording(path, range) => {
                progress.set_length(std::fs::metadata(path).map_or(0, |file| file.len()));
                send_recording(path, *range, options, progress, &mut report, stop.as_mut()).await?
            }
            SendSource::Clip(clip, name) => {
                progress.set_length(clip.num_bytes());
                let feed = Feed::new_for_any_character(clip.reader(), name.clone())?;
                send_once(feed, options, progress, &mut report, stop.as_mut()).await?
            }
        };
        if ending == Ending::Stopped || !options.repeats {
            return Ok(report);
        }
    }
}

/// Sends the sessions of a recording as they came: those of one slot one after the other, slots beside each other.
async fn send_recording(
    path: &Path,
    range: [f64; 2],
    options: &SendOptions,
    progress: &ProgressBar,
    report: &mut SendReport,
    stop: Pin<&mut impl Future<Output = ()>>,
) -> Result<Ending, SendError> {
    let mut slots: BTreeMap<String, Vec<RecordedSession>> = BTreeMap::new();
    for session in RecordedFeed::sessions(&mut Recording::open(path)?, range)? {
        slots.entry(session.slot.clone()).or_default().push(session);
    }
    let shown = path.display().to_string();
    if slots.is_empty() {
        let problem = "it has no publisher's messages from their beginning there: play its packets with --packets".into();
        return Err(ReadError::Broken { path: shown, problem }.into());
    }
    let begun = Instant::now();
    let (stopping, stopped) = watch::channel(false);
    let send_slot = async |sessions: Vec<RecordedSession>| {
        let mut sent = SendReport::default();
        for RecordedSession { index, after, .. } in sessions {
            let mut stopped = stopped.clone();
            let told = async move {
                // An error means that it is over anyway.
                let _ = stopped.wait_for(|is_told| *is_told).await;
            };
            tokio::pin!(told);
            let due = begun + Duration::from_secs_f64((after / options.speed).clamp(0.0, 1e9));
            tokio::select! {
                () = told.as_mut() => return Ok((Ending::Stopped, sent)),
                () = tokio::time::sleep_until(due) => {}
            }
            let Ok(feed) = RecordedFeed::session(Recording::open(path)?, index, range)? else { continue };
            let feed = Feed::new_for_any_character(feed, shown.clone())?;
            if send_once(feed, options, progress, &mut sent, told.as_mut()).await? == Ending::Stopped {
                return Ok((Ending::Stopped, sent));
            }
        }
        Ok::<_, SendError>((Ending::Sent, sent))
    };
    let all = futures_util::future::try_join_all(slots.into_values().map(send_slot));
    tokio::pin!(all);
    let ended = tokio::select! {
        ended = all.as_mut() => ended,
        () = stop => {
            stopping.send_replace(true);
            all.await
        }
    };
    let mut ending = Ending::Sent;
    for (end, sent) in ended? {
        report.frames += sent.frames;
        report.errors += sent.errors;
        if end == Ending::Stopped {
            ending = end;
        }
    }
    Ok(ending)
}

/// Why a session was closed without an error.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Ending {
    /// The whole feed has been sent.
    Sent,
    /// The sender was told to stop.
    Stopped,
}

/// What a server says to a publisher.
#[derive(Debug, Deserialize)]
#[serde(tag = "type", rename_all = "snake_case")]
enum Answer {
    Ready(Begun),
    Calibrated {
        t: f64,
    },
    Error {
        code: String,
        message: String,
    },
    #[serde(other)]
    Unknown,
}

/// A session that a server has begun.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
struct Begun {
    session: u32,
    /// What proves that it was this sender's.
    resume_key: Option<String>,
}

pub(crate) type Socket = WebSocketStream<MaybeTlsStream<TcpStream>>;
type Sink = SplitSink<Socket, Message>;
type Answers = SplitStream<Socket>;

/// What outlives a connection.
struct Journey {
    /// The feed's own.
    hello: String,
    /// Which of the servers is asked.
    at: usize,
    /// The session that was begun last.
    session: Option<Begun>,
    /// When the feed began, and its time then.
    clock: Option<(Instant, f64)>,
}

/// Why a connection has ended before the feed.
struct Lost {
    error: SendError,
    /// Another server may do better.
    may_pass: bool,
}

impl From<FeedError> for Lost {
    fn from(error: FeedError) -> Self {
        Self { error: error.into(), may_pass: false }
    }
}

/// Sends a feed, to one server after the other where one is lost.
async fn send_once<R: BufRead>(
    mut feed: Feed<R>,
    options: &SendOptions,
    progress: &ProgressBar,
    report: &mut SendReport,
    mut stop: Pin<&mut impl Future<Output = ()>>,
) -> Result<Ending, SendError> {
    let servers: Vec<&str> = options.to.split(',').map(|server| server.trim().trim_end_matches('/')).collect();
    let mut journey = Journey { hello: feed.text().to_owned(), at: 0, session: None, clock: None };
    let mut since = Instant::now();
    let mut num_in_vain = 0;
    loop {
        let session = journey.session.clone();
        let over = Over { server: servers[journey.at], is_of_many: servers.len() > 1, options, progress };
        let lost = match over.send(&mut feed, &mut journey, report, stop.as_mut()).await {
            Ok(ending) => return Ok(ending),
            Err(lost) => lost,
        };
        if journey.session != session {
            (since, num_in_vain) = (Instant::now(), 0);
        }
        if !lost.may_pass || servers.len() < 2 || since.elapsed() >= options.timeout {
            return Err(lost.error);
        }
        journey.at = (journey.at + 1) % servers.len();
        tracing::warn!(error = %lost.error, next = servers[journey.at], "server lost");
        num_in_vain += 1;
        if num_in_vain >= servers.len() {
            tokio::select! {
                () = stop.as_mut() => return Ok(Ending::Stopped),
                () = tokio::time::sleep(PAUSE) => {}
            }
        }
    }
}

/// One connection.
struct Over<'a> {
    server: &'a str,
    is_of_many: bool,
    options: &'a SendOptions,
    progress: &'a ProgressBar,
}

impl Over<'_> {
    /// Sends what is left of a feed.
    async fn send<R: BufRead>(
        &self,
        feed: &mut Feed<R>,
        journey: &mut Journey,
        report: &mut SendReport,
        mut stop: Pin<&mut impl Future<Output = ()>>,
    ) -> Result<Ending, Lost> {
        let options = self.options;
        let url = format!("{}/v1/rooms/{}/publish", self.server, options.room);
        let patience = if self.is_of_many { options.timeout.min(SILENCE) } else { options.timeout };
        let connected = tokio::select! {
            () = stop.as_mut() => return Ok(Ending::Stopped),
            connected = connect(url, &options.trust, options.token.as_deref(), patience, MAX_ANSWER) => {
                connected.map_err(|error| Lost { error, may_pass: true })?
            }
        };
        let (mut sink, answers) = connected.split();
        let (ready, is_ready) = oneshot::channel();
        let heard = Arc::new(Mutex::new(Instant::now()));
        // Answers are read beside the sending: a server whose answers nobody reads stops reading, too.
        let mut listening = tokio::spawn(listen(answers, self.progress.clone(), ready, heard.clone()));
        let ended = |end: Result<End, tokio::task::JoinError>| match end {
            Ok(End { reason, may_pass, .. }) => Lost { error: SendError::Ended { reason }, may_pass },
            Err(error) => Lost { error: SendError::Ended { reason: error.to_string() }, may_pass: false },
        };
        // At full speed a server may have much to read before it comes to a ping.
        let is_watched = self.is_of_many && options.speed.is_finite();
        let begun = journey.session.clone();

        let ending = tokio::select! {
            // An end of the listening says more than that a message did not get through.
            biased;
            end = &mut listening => return Err(ended(end)),
            () = stop.as_mut() => Ending::Stopped,
            () = silence(&heard), if is_watched => {
                let reason = format!("nothing heard for {} s", SILENCE.as_secs_f64());
                listening.abort();
                return Err(Lost { error: SendError::Ended { reason }, may_pass: true });
            }
            sent = self.publish(feed, &mut sink, is_ready, &heard, journey, report) => match sent {
                Ok(()) => Ending::Sent,
                Err(Unsent::Feed(error)) => return Err(error.into()),
                Err(Unsent::Lost) => return Err(match tokio::time::timeout(patience, listening).await {
                    Ok(end) => ended(end),
                    Err(_) => Lost { error: SendError::Ended { reason: "the connection broke off".into() }, may_pass: true },
                }),
                Err(Unsent::Stuck(reason)) => return Err(Lost { error: SendError::Ended { reason }, may_pass: true }),
            },
        };
        // A server that has ended the session in this moment says so in its own close; one that reads nothing is cut off below.
        let closing = async {
            let _ = sink.send(Message::Close(None)).await;
            (&mut listening).await
        };
        let patience = if ending == Ending::Stopped { STOP_TIMEOUT } else { CLOSE_TIMEOUT };
        let end = tokio::select! {
            end = tokio::time::timeout(patience, closing) => end,
            () = stop, if ending == Ending::Sent => return Ok(Ending::Stopped),
        };
        match end {
            Ok(Ok(End { is_normal: true, errors, .. })) => {
                report.errors += errors;
                Ok(ending)
            }
            Err(_) if ending == Ending::Stopped => Ok(ending),
            // All of it has been sent, so nothing is left for another server.
            Ok(end) => Err(Lost { may_pass: journey.session == begun, ..ended(end) }),
            Err(_) => Err(Lost { error: SendError::Ended { reason: "it does not answer the close".into() }, may_pass: false }),
        }
    }

    /// Sends the hello and, once the server is ready, what is left of the feed in its time.
    async fn publish<R: BufRead>(
        &self,
        feed: &mut Feed<R>,
        sink: &mut Sink,
        is_ready: oneshot::Receiver<Begun>,
        heard: &Mutex<Instant>,
        journey: &mut Journey,
        report: &mut SendReport,
    ) -> Result<(), Unsent> {
        let options = self.options;
        let within = |what: &str, time: Duration| Unsent::Stuck(format!("{what} within {} s", time.as_secs_f64()));
        let mut write = async |message: Message| match tokio::time::timeout(options.timeout, sink.send(message)).await {
            Ok(Ok(())) => Ok(()),
            Ok(Err(_)) => Err(Unsent::Lost),
            Err(_) => Err(within("it read nothing", options.timeout)),
        };
        write(Message::text(hello(&journey.hello, options, journey.session.as_ref()))).await?;
        let patience = if self.is_of_many { options.timeout.min(ENTER_TIMEOUT) } else { options.timeout };
        // The server reads nothing while it finds out whether the publisher may come in.
        set(heard, Instant::now() + patience);
        // An error means that the listening has ended, which is told there.
        let session = tokio::time::timeout(patience, is_ready).await.map_err(|_| within("no answer to the hello", patience))?;
        let is_again = journey.session.is_some();
        journey.session = Some(session.map_err(|_| Unsent::Lost)?);
        set(heard, Instant::now());
        let mut pinged = Instant::now();
        let mut frame = TrackingFrame::default();
        let came = Instant::now();
        while let Some(item) = feed.next_frame(&mut frame).map_err(Unsent::Feed)? {
            if item == FeedItem::Frame {
                let (start, t0) = *journey.clock.get_or_insert_with(|| (Instant::now(), frame.t));
                // At infinite speed every frame is due at once.
                let due = start + Duration::from_secs_f64(((frame.t - t0) / options.speed).clamp(0.0, 1e9));
                if is_again && options.speed.is_finite() && due + OLD < came {
                    self.progress.inc(feed.text().len() as u64 + 1);
                    continue;
                }
                loop {
                    if self.is_of_many && pinged.elapsed() >= PING_EVERY {
                        pinged = Instant::now();
                        write(Message::Ping(Bytes::new())).await?;
                    }
                    if due <= Instant::now() {
                        break;
                    }
                    tokio::time::sleep_until(if self.is_of_many { due.min(pinged + PING_EVERY) } else { due }).await;
                }
                report.frames += 1;
            }
            let binary = if options.binary && item == FeedItem::Frame { binary_form(&frame, feed.text()) } else { None };
            write(binary.unwrap_or_else(|| Message::text(feed.text()))).await?;
            self.progress.inc(feed.text().len() as u64 + 1);
        }
        Ok(())
    }
}

fn set(heard: &Mutex<Instant>, at: Instant) {
    *heard.lock().unwrap_or_else(PoisonError::into_inner) = at;
}

/// Done when nothing has been heard for too long.
async fn silence(heard: &Mutex<Instant>) {
    loop {
        let end = *heard.lock().unwrap_or_else(PoisonError::into_inner) + SILENCE;
        if end <= Instant::now() {
            return;
        }
        tokio::time::sleep_until(end).await;
    }
}

/// Opens a WebSocket of the server's, on which messages of up to `most_bytes` may come.
pub(crate) async fn connect(
    url: String,
    trust: &Trust,
    token: Option<&str>,
    timeout: Duration,
    most_bytes: usize,
) -> Result<Socket, SendError> {
    let connecting = async {
        let mut request = url.as_str().into_client_request()?;
        request.headers_mut().insert(header::SEC_WEBSOCKET_PROTOCOL, HeaderValue::from_static(SUBPROTOCOL));
        if let Some(token) = token {
            if !may_carry_secrets(request.uri()) {
                return Err(tungstenite::Error::Io(std::io::Error::other(
                    "a token goes over wss:// only, or to this machine: others on the way could read it",
                )));
            }
            let mut value = HeaderValue::from_str(&format!("Bearer {token}"))
                .map_err(|_| tungstenite::Error::Io(std::io::Error::other("the token holds characters that no token has")))?;
            value.set_sensitive(true);
            request.headers_mut().insert(header::AUTHORIZATION, value);
        }
        let config = trust.client_config().map_err(|error| tungstenite::Error::Io(std::io::Error::other(error)))?;
        let limits = WebSocketConfig::default().max_message_size(Some(most_bytes)).max_frame_size(Some(most_bytes));
        connect_async_tls_with_config(request, Some(limits), false, Some(Connector::Rustls(config))).await
    };
    let problem = match tokio::time::timeout(timeout, connecting).await {
        Ok(Ok((socket, _))) => return Ok(socket),
        Ok(Err(error)) => explain(error),
        Err(_) => format!("no answer within {} s", timeout.as_secs_f64()),
    };
    Err(SendError::Connect { url, problem })
}

/// Nobody else can read what is sent there.
fn may_carry_secrets(uri: &Uri) -> bool {
    let host = uri.host().unwrap_or_default();
    let address = host.trim_matches(['[', ']']).parse::<std::net::IpAddr>();
    uri.scheme_str() == Some("wss") || host == "localhost" || address.is_ok_and(|address| address.is_loopback())
}

/// Why a feed did not get through.
enum Unsent {
    /// The feed is broken.
    Feed(FeedError),
    /// The connection is.
    Lost,
    /// The server does not answer, or does not read.
    Stuck(String),
}

/// A frame of landmarks in the binary form; `None` for what stays JSON: other frames, and those that also give expressions,
/// which a sender's reader leaves out.
fn binary_form(frame: &TrackingFrame, text: &str) -> Option<Message> {
    let TrackingData::Landmarks { points, confidence } = &frame.data else { return None };
    if text.contains("\"expressions\"") {
        return None;
    }
    let mut bytes = Vec::new();
    encode_landmarks(frame.t, points, confidence, &mut bytes).ok()?;
    Some(Message::binary(bytes))
}

/// How a session came to its end.
struct End {
    is_normal: bool,
    reason: String,
    errors: u64,
    /// Another server may do better.
    may_pass: bool,
}

/// Shows the server's answers until it closes.
async fn listen(mut answers: Answers, progress: ProgressBar, ready: oneshot::Sender<Begun>, heard: Arc<Mutex<Instant>>) -> End {
    let mut ready = Some(ready);
    let mut errors = 0;
    let mut last_error = None;
    let mut may_pass = false;
    while let Some(message) = answers.next().await {
        set(&heard, Instant::now());
        match message {
            Ok(Message::Text(text)) => match serde_json::from_str(&text) {
                Ok(Answer::Ready(begun)) => {
                    tracing::info!(session = begun.session, "ready");
                    // The sender may have given up in this moment.
                    let _ = ready.take().map(|ready| ready.send(begun));
                }
                Ok(Answer::Calibrated { t }) => tracing::info!(t, "calibrated"),
                Ok(Answer::Error { code, message }) if code == "too_fast" => tracing::info!(message),
                Ok(Answer::Error { code, message }) => {
                    errors += 1;
                    // Other nodes of the cluster may know better, or be the room's home.
                    may_pass = matches!(code.as_str(), "room_elsewhere" | "cluster" | "shutting_down" | "too_many_connections" | "idle");
                    progress.suspend(|| eprintln!("server: {message} ({code})"));
                    last_error = Some(message);
                }
                Ok(Answer::Unknown) | Err(_) => tracing::debug!(%text, "unknown answer"),
            },
            Ok(Message::Close(frame)) => {
                let is_normal = frame.as_ref().is_none_or(|frame| matches!(frame.code, CloseCode::Normal | CloseCode::Status));
                let is_going = frame.as_ref().is_some_and(|frame| matches!(frame.code, CloseCode::Away | CloseCode::Restart));
                let said = frame.map(|frame| frame.reason.to_string()).filter(|reason| !reason.is_empty());
                let reason = last_error.or(said).unwrap_or_else(|| "without a reason".into());
                return End { is_normal, reason, errors, may_pass: may_pass || is_going };
            }
            Ok(_) => {}
            Err(error) => {
                let may_pass = may_pass || last_error.is_none();
                return End { is_normal: false, reason: last_error.unwrap_or_else(|| error.to_string()), errors, may_pass };
            }
        }
    }
    let may_pass = may_pass || last_error.is_none();
    End { is_normal: false, reason: last_error.unwrap_or_else(|| "the connection broke off".into()), errors, may_pass }
}

/// The feed's hello, with what the options add to it, or as that of one who comes back from `session`.
fn hello(line: &str, options: &SendOptions, session: Option<&Begun>) -> String {
    if !options.takeover && options.profile.is_none() && options.slot.is_none() && options.priority.is_none() && session.is_none() {
        return line.to_owned();
    }
    let Ok(mut fields) = serde_json::from_str::<serde_json::Map<String, serde_json::Value>>(line) else { return line.to_owned() };
    if let Some(Begun { session, resume_key }) = session {
        fields.insert("resume".into(), (*session).into());
        if let Some(key) = resume_key {
            fields.insert("resume_key".into(), key.as_str().into());
        }
        fields.insert("keep_neutral".into(), true.into());
    } else if options.takeover {
        fields.insert("takeover".into(), true.into());
    }
    if let Some(slot) = &options.slot {
        fields.insert("slot".into(), slot.as_str().into());
    }
    if let Some(priority) = options.priority {
        fields.insert("priority".into(), priority.into());
    }
    match &options.profile {
        Some(ProfileChoice::Given(profile)) => {
            fields.insert("profile".into(), serde_json::to_value(profile).expect("plain data can be written"));
        }
        Some(ProfileChoice::Named(name)) => {
            fields.insert("profile".into(), name.as_str().into());
        }
        None => {}
    }
    serde_json::Value::from(fields).to_string()
}

/// A failed handshake in the server's own words, where it has some.
fn explain(error: tungstenite::Error) -> String {
    if let tungstenite::Error::Http(response) = &error
        && let Some(Answer::Error { message, .. }) = response.body().as_ref().and_then(|body| serde_json::from_slice(body).ok())
    {
        return message;
    }
    error.to_string()
}
