//! `fit`: a performer's profile, from a recorded feed or live, with instructions on the command line.

use crate::feed::{Feed, FeedError, FeedItem};
use crate::send::{SendError, Socket, connect};
use crate::solve::{FitError, FitReport, SolveConfig, SolveError, Solver, StepReport};
use futures_util::{SinkExt, StreamExt};
use rhytid_shared::trust::Trust;
use rhytid_shared::{Character, FaceFrame, FitStep, Profile, Settings, TrackingFrame};
use serde::Deserialize;
use serde_json::json;
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::str::FromStr;
use std::sync::Arc;
use std::time::Duration;
use tokio_tungstenite::tungstenite::{Message, Utf8Bytes};

/// Tries of one step before it is left out.
const MOST_TRIES: usize = 3;
/// How much longer than a step measures its answer may take.
const PATIENCE: Duration = Duration::from_secs(20);

/// Why there is no profile.
#[derive(Debug, thiserror::Error)]
pub enum FitCliError {
    /// The feed is broken.
    #[error(transparent)]
    Feed(#[from] FeedError),
    /// A frame of it makes no sense.
    #[error("feed {path}, line {line}: {source}")]
    Frame {
        /// The feed's file.
        path: String,
        /// Counted from 1.
        line: usize,
        /// What is wrong with it.
        source: SolveError,
    },
    /// The feed is over before a step has been measured.
    #[error("the feed ends at {end} s, before the step {} is over", step.name())]
    TooShort {
        /// The step.
        step: FitStep,
        /// Time of the last frame, seconds.
        end: f64,
    },
    /// A step gave nothing.
    #[error(transparent)]
    Fit(#[from] FitError),
    /// The server could not be reached, or ended the talk.
    #[error(transparent)]
    Server(#[from] SendError),
    /// What the server refused.
    #[error("the server: {message} ({code})")]
    Refused {
        /// Short and stable.
        code: String,
        /// For people.
        message: String,
    },
}

/// When a recorded performer makes a face: `smile=12.5..14`, seconds of the feed.
#[derive(Debug, Clone, PartialEq)]
pub struct StepAt {
    /// The face.
    pub step: FitStep,
    /// From when to when, on the sender's clock, seconds.
    pub time: Range<f64>,
}

impl FromStr for StepAt {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let names = || FitStep::ALL.map(FitStep::name).join(", ");
        let (name, time) = text.split_once('=').ok_or("expected STEP=FROM..TO")?;
        let step = FitStep::from_name(name).ok_or_else(|| format!("{name:?} is no step, expected one of {}", names()))?;
        let (from, to) = time.split_once("..").ok_or("expected STEP=FROM..TO")?;
        let seconds = |text: &str| text.parse::<f64>().map_err(|_| format!("{text:?} is no number of seconds"));
        let (from, to) = (seconds(from)?, seconds(to)?);
        let [least, most] = rhytid_shared::FIT_SECONDS;
        if !(least..=most).contains(&(to - from)) {
            return Err(format!("{from}..{to} lasts {} s, expected {least} to {most}", to - from));
        }
        Ok(Self { step, time: from..to })
    }
}

/// Fits a recorded performer: each of `steps` is measured at its time; without any, those that the feed itself asks for.
/// `tell` gets what a person wants to read.
pub fn fit_feed(
    path: &Path,
    character: &Arc<Character>,
    mut steps: Vec<StepAt>,
    name: Option<&rhytid_shared::RoomName>,
    mut tell: impl FnMut(&str),
) -> Result<FitReport, FitCliError> {
    let shown = path.display().to_string();
    let mut feed = Feed::open(path, character)?;
    let at = |line: usize| {
        let path = shown.clone();
        move |source: SolveError| FitCliError::Frame { path, line, source }
    };
    let mut solver = Solver::new(character.clone(), &SolveConfig::default(), &feed.hello).map_err(at(1))?;
    let (mut frame, mut face) = (TrackingFrame::default(), FaceFrame::at_rest(character));
    steps.sort_by(|a, b| a.time.start.total_cmp(&b.time.start));
    let mut steps = steps.into_iter().peekable();
    let mut running: Option<FitStep> = None;
    while let Some(item) = feed.next_frame(&mut frame)? {
        match item {
            FeedItem::Command(command) => solver.command(&command).map_err(at(feed.line()))?,
            FeedItem::Frame => {
                if running.is_none()
                    && let Some(StepAt { step, time }) = steps.next_if(|next| frame.t >= next.time.start)
                {
                    solver.measure(step, time.end - time.start);
                    running = Some(step);
                }
                solver.solve(&frame, &mut face).map_err(at(feed.line()))?;
            }
        }
        if let Some(outcome) = solver.take_fit() {
            tell(&sentence(&outcome?));
            running = None;
        }
    }
    if let Some(step) = running.or(steps.next().map(|next| next.step)) {
        return Err(FitCliError::TooShort { step, end: frame.t });
    }
    Ok(solver.finish_fit(name)?)
}

fn sentence(report: &StepReport) -> String {
    let StepReport { step, frames, note } = report;
    let note = if note.is_empty() { String::new() } else { format!(", {note}") };
    format!("{}: {frames} frames{note}", step.name())
}

/// A live source to be fitted.
#[derive(Debug, Clone)]
pub struct LiveFit {
    /// The server, e.g. `ws://127.0.0.1:7878`.
    pub to: String,
    /// The room.
    pub room: String,
    /// The source's slot.
    pub slot: String,
    /// What the profile shall be called.
    pub name: Option<String>,
    /// Seconds to get into a face before it is measured.
    pub ready: Duration,
    /// How long each face is measured.
    pub hold: Duration,
    /// Whom to trust where `to` is `wss://`.
    pub trust: Trust,
    /// What lets it in, where the server wants to know. Sent over TLS or to this machine only.
    pub token: Option<String>,
}

/// How a person is guided through the fit.
pub trait Guide {
    /// A face is asked for, number `at` of `of`, in `ready`; then it is held for `hold`.
    fn ask(&mut self, step: FitStep, at: usize, of: usize, ready: Duration, hold: Duration);
    /// What came of it, or is worth knowing.
    fn tell(&mut self, text: &str);
    /// Shall the sides be put right?
    fn agrees(&mut self, offers: &Settings) -> bool;
}

#[derive(Debug, Deserialize)]
#[serde(tag = "type", rename_all = "snake_case")]
enum Answer {
    Fit {
        step: String,
        frames: usize,
        #[serde(default)]
        note: String,
    },
    Profile {
        profile: Box<Profile>,
        warnings: Vec<String>,
        offers: Settings,
        kept: bool,
    },
    Settings {},
    Error {
        code: String,
        message: String,
    },
}

/// Guides a performer before a live tracker through the fit.
pub async fn fit_live(options: &LiveFit, guide: &mut impl Guide) -> Result<Profile, FitCliError> {
    let url = format!("{}/v1/rooms/{}/control?slot={}", options.to.trim_end_matches('/'), options.room, options.slot);
    let mut socket = connect(url, &options.trust, options.token.as_deref(), PATIENCE).await?;
    let hold = options.hold.as_secs_f64();
    let num_steps = FitStep::ALL.len();
    for (i, step) in FitStep::ALL.into_iter().enumerate() {
        for attempt in 1.. {
            guide.ask(step, i + 1, num_steps, options.ready, options.hold);
            tokio::time::sleep(options.ready).await;
            match ask(&mut socket, &json!({"type": "fit", "step": step.name(), "seconds": hold})).await? {
                Answer::Fit { step, frames, note } => {
                    guide.tell(&if note.is_empty() {
                        format!("{step}: {frames} frames")
                    } else {
                        format!("{step}: {frames} frames, {note}")
                    });
                    break;
                }
                // Another try helps where a person has to do something; a source that is not there must come first.
                Answer::Error { code, message } if code.starts_with("fit_") && attempt < MOST_TRIES => guide.tell(&message),
                Answer::Error { code, message } if code.starts_with("fit_") && step != FitStep::Neutral => {
                    guide.tell(&format!("{message}; left out"));
                    break;
                }
                Answer::Error { code, message } => return Err(FitCliError::Refused { code, message }),
                other => return Err(unexpected(&other)),
            }
        }
    }
    let mut finish = json!({"type": "fit", "step": "finish"});
    if let Some(name) = &options.name {
        finish["name"] = json!(name);
    }
    let (mut profile, offers) = match ask(&mut socket, &finish).await? {
        Answer::Profile { profile, warnings, offers, kept } => {
            warnings.iter().for_each(|warning| guide.tell(warning));
            if kept {
                guide.tell(&format!("the server keeps it as {:?}", profile.name));
            }
            (*profile, offers)
        }
        Answer::Error { code, message } => return Err(FitCliError::Refused { code, message }),
        other => return Err(unexpected(&other)),
    };
    if offers != Settings::default() && guide.agrees(&offers) {
        let mut change = serde_json::to_value(offers).expect("plain data can be written");
        change["type"] = json!("settings");
        match ask(&mut socket, &change).await? {
            Answer::Settings {} => profile.settings.change(&offers),
            Answer::Error { code, message } => return Err(FitCliError::Refused { code, message }),
            other => return Err(unexpected(&other)),
        }
    }
    // The server closes by itself where this does not reach it.
    let _ = socket.close(None).await;
    Ok(profile)
}

fn unexpected(answer: &Answer) -> FitCliError {
    FitCliError::Refused { code: "unexpected".into(), message: format!("an answer to something else: {answer:?}") }
}

/// Sends a message and waits for its answer.
async fn ask(socket: &mut Socket, message: &serde_json::Value) -> Result<Answer, FitCliError> {
    let ended = |reason: String| FitCliError::Server(SendError::Ended { reason });
    socket.send(Message::text(message.to_string())).await.map_err(|error| ended(error.to_string()))?;
    let answer = async {
        loop {
            match socket.next().await {
                Some(Ok(Message::Text(text))) => return Ok::<Utf8Bytes, FitCliError>(text),
                Some(Ok(Message::Close(frame))) => {
                    let reason = frame.map(|frame| frame.reason.to_string()).filter(|reason| !reason.is_empty());
                    return Err(ended(reason.unwrap_or_else(|| "without a reason".into())));
                }
                Some(Ok(_)) => {}
                Some(Err(error)) => return Err(ended(error.to_string())),
                None => return Err(ended("the connection broke off".into())),
            }
        }
    };
    let text = tokio::time::timeout(PATIENCE, answer).await.map_err(|_| ended(format!("no answer within {} s", PATIENCE.as_secs())))??;
    serde_json::from_str(&text).map_err(|error| ended(format!("it answered {text:?}: {error}")))
}

/// Writes a profile's file.
pub fn write_profile(profile: &Profile, path: &PathBuf) -> std::io::Result<()> {
    let text = serde_json::to_string_pretty(profile).expect("plain data can be written");
    std::fs::write(path, text + "\n")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_step_says_when_and_what_is_wrong_with_it() {
        assert_eq!("smile=12.5..14".parse(), Ok(StepAt { step: FitStep::Smile, time: 12.5..14.0 }));
        for (text, says) in [
            ("smile", "expected STEP=FROM..TO"),
            ("grin=1..2", "\"grin\" is no step, expected one of neutral, brows_up"),
            ("smile=1", "expected STEP=FROM..TO"),
            ("smile=a..2", "\"a\" is no number"),
            ("smile=3..2", "lasts -1 s, expected 0.2 to 10"),
            ("smile=NaN..2", "lasts NaN s"),
        ] {
            let error = text.parse::<StepAt>().unwrap_err();
            assert!(error.contains(says), "{error}");
        }
    }
}
