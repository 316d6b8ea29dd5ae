//! One source of a room, whatever it speaks, a WebSocket or a tracker's datagrams: frame in → solve → mix → room; and what it,
//! or somebody for it, asks for.

use crate::answer::Answer;
use crate::cluster::{Cluster, Kept};
use crate::pipeline::Pipeline;
use crate::profiles::Profiles;
use crate::publish::Rate;
use crate::recording::{Item, SessionEvent, text};
use crate::room::{Evicted, Publishing, RoomError, SlotClaim};
use crate::service::Hub;
use crate::socket::ErrorMessage;
use crate::solve::{Calibration, SolveError};
use rhytid_shared::{
    Command, FaceKind, FitRequest, PROFILE_VERSION, Profile, ProfileChoice, PublishHello, PublishReader, RoomName, Settings, TrackingFrame,
};
use std::sync::Arc;
use tokio::sync::{mpsc, oneshot};
use tokio::time::Instant;
use tokio_tungstenite::tungstenite::{Bytes, Utf8Bytes};

/// A message as its publisher sent it.
#[derive(Debug, Clone)]
pub(crate) enum Sent {
    Text(Utf8Bytes),
    Binary(Bytes),
}

impl Sent {
    fn taken(self, slot: Arc<str>, t: Option<f64>) -> Item {
        match self {
            Self::Text(text) => Item::Text { slot, t, text },
            Self::Binary(bytes) => Item::Binary { slot, t, bytes },
        }
    }
}

/// Calibrations a second of one source: each may solve all its frames of the last seconds anew.
const CALIBRATIONS_PER_SECOND: u32 = 2;
/// Other commands a second of one source: a knob that is turned on a page.
const COMMANDS_PER_SECOND: u32 = 30;

/// Why a source could not enter a room.
#[derive(Debug, thiserror::Error)]
pub(crate) enum OpenError {
    /// The hello's layout, camera or settings make no sense.
    #[error("hello: {0}")]
    Hello(#[from] SolveError),
    /// The profile is not here.
    #[error("hello: {0}")]
    Profile(#[from] UnknownProfile),
    /// The room or the slot has no place.
    #[error(transparent)]
    Room(#[from] RoomError),
}

/// The server keeps no profile of this name.
#[derive(Debug, thiserror::Error)]
#[error("field profile is \"{0}\", which this server does not keep: see /api/profiles")]
pub(crate) struct UnknownProfile(RoomName);

/// Why a frame was not taken.
#[derive(Debug, thiserror::Error)]
pub(crate) enum FrameError {
    /// It counts for nothing; the source is as before.
    #[error(transparent)]
    Bad(#[from] SolveError),
    /// Another publisher has taken the slot over: the source is over.
    #[error("another publisher has taken the room over")]
    Evicted,
}

/// What a command, or what came of it later, is answered with: JSON.
pub(crate) type Told = Result<Utf8Bytes, ErrorMessage>;

/// A command from elsewhere than the source's own connection.
pub(crate) struct Control {
    pub command: Command,
    /// As it was sent.
    pub text: Utf8Bytes,
    pub answer: oneshot::Sender<Told>,
}

/// Commands from elsewhere that may wait for one source.
pub(crate) const MOST_CONTROLS: usize = 4;

/// Who waits for a step of the fit.
#[derive(Default)]
enum FitOwner {
    #[default]
    Publisher,
    Control(oneshot::Sender<Told>),
}

/// A source that has yet to claim its slot: its hello leads to something.
pub(crate) struct Prepared {
    /// With the profile and settings in use.
    pub hello: PublishHello,
    pipeline: Pipeline,
    /// The profile in use.
    profile: Option<Profile>,
    /// The neutral face that it starts from.
    kept: Option<Calibration>,
}

impl Prepared {
    /// Makes what solves the frames of a source with this hello, which starts from what is `kept` of its slot where it asks for
    /// that and the tracker is the same.
    pub fn new(hub: &Hub, mut hello: PublishHello, kept: Option<Kept>) -> Result<Self, OpenError> {
        let kept = kept.filter(|kept| hello.keep_neutral && kept.tracker == hello.tracker());
        let resumed = kept.as_ref().filter(|_| hello.resume.is_some()).and_then(|kept| kept.profile.clone());
        if let Some(profile) = resumed {
            // One who comes back in the middle finds everything as it was, also what has been changed since its first hello.
            hello.settings = Settings::default();
            hello.profile = Some(ProfileChoice::Given(Box::new(profile)));
        }
        let kept_profile = kept.as_ref().and_then(|kept| kept.profile.clone());
        let kept = kept.map(|kept| kept.calibration);
        let profile = match hello.profile.take() {
            Some(ProfileChoice::Given(profile)) => Some(*profile),
            Some(ProfileChoice::Named(name)) => match hub.profiles.named(&name) {
                Some(profile) => Some((*profile).clone()),
                None => return Err(UnknownProfile(name).into()),
            },
            None => match kept_profile {
                Some(profile) => Some(profile),
                None => hub.profiles.of_source(&hello.source).map(|profile| (*profile).clone()),
            },
        };
        hello.profile = profile.clone().map(|profile| ProfileChoice::Given(Box::new(profile)));
        let (pipeline, kept_neutral) = start(hub, &hello, kept.clone())?;
        Ok(Self { hello, pipeline, profile, kept: kept.filter(|_| kept_neutral) })
    }
}

/// A source that has claimed its slot; gives it back on drop.
pub(crate) struct Source {
    place: Publishing,
    pipeline: Pipeline,
    hello: PublishHello,
    controls: mpsc::Receiver<Control>,
    profiles: Arc<Profiles>,
    cluster: Option<Arc<Cluster>>,
    /// The profile in use.
    profile: Option<Profile>,
    /// Its settings have changed since it was kept.
    is_profile_changed: bool,
    fit_owner: FitOwner,
    calibrations: Rate,
    commands: Rate,
    num_frames: u64,
    /// Its slot's name.
    slot: Arc<str>,
    /// For publishers that send no messages: what would read them.
    reader: Option<(PublishReader, TrackingFrame)>,
    /// It started from the neutral face that the room had kept.
    pub kept_neutral: bool,
}

impl Source {
    /// Claims the slot that its hello names; `sent` is the hello's text where the publisher sent one. The second value is done when
    /// another publisher has taken it over. Whatever else could be wrong with a hello has been found before: one that leads to
    /// nothing takes no slot from anybody.
    pub fn open(hub: &Hub, room: &RoomName, prepared: Prepared, sent: Option<Utf8Bytes>) -> Result<(Self, Evicted), RoomError> {
        let Prepared { hello, mut pipeline, profile, kept } = prepared;
        let kept_neutral = kept.is_some();
        let (controls, waiting) = mpsc::channel(MOST_CONTROLS);
        let slot: Arc<str> = hello.slot.name.as_str().into();
        let reader = sent.is_none().then(|| {
            let mut reader = PublishReader::new(&hub.character);
            let mut frame = TrackingFrame::default();
            // A hello made of one that was checked.
            reader.read(&text::of_hello(&hello), &mut frame).ok().map(|_| (reader, frame))
        });
        let recorded = |session| {
            let start = SessionEvent::Start {
                session,
                slot: slot.to_string(),
                source: hello.source.clone(),
                under_way: false,
                kept_neutral: kept.map(Box::new),
                profile: profile.clone().map(Box::new),
                solve: Some(Box::new(hub.config.solve.clone())),
            };
            let text = sent.unwrap_or_else(|| text::of_hello(&hello).into());
            vec![Item::Event(start), Item::Text { slot: slot.clone(), t: None, text }]
        };
        let (place, evicted) = hub.rooms.claim(room, SlotClaim::of(&hello), controls, recorded)?;
        pipeline.set_session(place.session);
        let session = place.session;
        let called = profile.as_ref().map(|profile| profile.name.as_str());
        tracing::info!(%room, session, source = hello.source, slot = %slot, takeover = hello.takeover, kept_neutral, profile = called, "publisher ready");
        let now = Instant::now();
        let source = Self {
            place,
            pipeline,
            hello,
            controls: waiting,
            profiles: hub.profiles.clone(),
            cluster: hub.cluster.clone(),
            profile,
            is_profile_changed: false,
            fit_owner: FitOwner::Publisher,
            calibrations: Rate::new(CALIBRATIONS_PER_SECOND, now),
            commands: Rate::new(COMMANDS_PER_SECOND, now),
            num_frames: 0,
            slot,
            reader: reader.flatten(),
            kept_neutral,
        };
        Ok((source, evicted))
    }

    /// Solves a frame and puts it into the room; `sent` is its message where the publisher sent one.
    pub fn frame(&mut self, hub: &Hub, frame: &TrackingFrame, sent: Option<Sent>) -> Result<(), FrameError> {
        let start = std::time::Instant::now();
        let (mut made, mut solved) = (None, frame);
        if sent.is_none()
            && self.place.room.is_recorded()
            && let Some((reader, read)) = &mut self.reader
        {
            // What is recorded is solved: text may round differently than a tracker's own form.
            let text = text::of_frame(frame);
            if reader.read(&text, read).is_ok() {
                (made, solved) = (Some(Sent::Text(text.into())), read);
            }
        }
        if let Err(error) = self.pipeline.solve(solved) {
            if let (Some(_), Some((reader, _))) = (made, &mut self.reader) {
                reader.take_back();
            }
            return Err(error.into());
        }
        hub.metrics.solve_seconds.observe(start.elapsed().as_secs_f64());
        let message = made.or(sent).map(|sent| sent.taken(self.slot.clone(), Some(frame.t)));
        if !self.place.publish(self.pipeline.face(), message) {
            return Err(FrameError::Evicted);
        }
        hub.metrics.frames_in.inc();
        self.num_frames += 1;
        Ok(())
    }

    /// Keeps with the recording a message that is no frame and was taken.
    pub fn record_taken(&self, sent: Sent) {
        self.place.record(|| sent.taken(self.slot.clone(), None));
    }

    /// Keeps with the recording a message that was refused.
    pub fn record_refused(&self, sent: Sent) {
        let bytes = match sent {
            Sent::Text(text) => text.into(),
            Sent::Binary(bytes) => bytes,
        };
        self.place.record(|| Item::Refused { slot: self.slot.clone(), bytes });
    }

    /// Does what is asked for. The answer to a step of the fit comes later, with [`Self::news`].
    pub fn command(&mut self, command: Command) -> Result<Option<Utf8Bytes>, ErrorMessage> {
        self.check_rate(&command)?;
        let solver = self.pipeline.solver();
        let answer = match command {
            Command::Calibrate => {
                solver.calibrate();
                return Ok(None);
            }
            Command::Settings(change) => {
                solver.set(&change).map_err(|error| ErrorMessage::new("bad_settings", error.to_string()))?;
                self.settings_changed();
                self.settings_answer()
            }
            Command::Recentre if solver.recentre() => Answer::Recentred.text(),
            Command::Recentre => {
                return Err(ErrorMessage::new("no_face", "no face has been seen yet, expected one to re-centre"));
            }
            Command::Fit(FitRequest::Measure { step, seconds }) => {
                solver.measure(step, seconds);
                self.own_fit(FitOwner::Publisher);
                return Ok(None);
            }
            Command::Fit(FitRequest::Cancel) => {
                solver.cancel_fit();
                self.own_fit(FitOwner::Publisher);
                Answer::Fit { step: "cancel", done: true, frames: 0, note: "" }.text()
            }
            Command::Fit(FitRequest::Finish { name }) => {
                let report = solver.finish_fit(name.as_ref()).map_err(|error| ErrorMessage::new(error.code(), error.to_string()))?;
                let mut warnings = report.warnings;
                let kept = self.keep_profile(report.profile.clone(), &mut warnings);
                Answer::Profile { profile: &report.profile, warnings: &warnings, offers: report.offers, kept }.text()
            }
            Command::Profile(choice) => self.use_profile(choice)?,
        };
        Ok(Some(answer))
    }

    fn check_rate(&mut self, command: &Command) -> Result<(), ErrorMessage> {
        // Other sides begin another search, so these are held to the rate of calibrations, too.
        let (rate, most, code, what) = match command {
            Command::Calibrate => (&mut self.calibrations, CALIBRATIONS_PER_SECOND, "too_many_calibrations", "calibrations"),
            _ => (&mut self.commands, COMMANDS_PER_SECOND, "too_many_settings", "changes of settings"),
        };
        if rate.take_if_free(Instant::now()) {
            return Ok(());
        }
        Err(ErrorMessage::new(code, format!("more than {most} {what} a second: this one is left out")))
    }

    fn settings_answer(&mut self) -> Utf8Bytes {
        let solver = self.pipeline.solver();
        Answer::Settings { settings: solver.settings(), added_delay: solver.added_delay() }.text()
    }

    /// Settings are part of the profile in use.
    fn settings_changed(&mut self) {
        let settings: Settings = *self.pipeline.solver().settings();
        if let Some(profile) = &mut self.profile {
            self.is_profile_changed |= profile.settings != settings;
            profile.settings = settings;
        }
        self.keep_neutral();
    }

    fn use_profile(&mut self, choice: ProfileChoice) -> Result<Utf8Bytes, ErrorMessage> {
        let is_named = matches!(choice, ProfileChoice::Named(_));
        let profile = match choice {
            ProfileChoice::Given(profile) => *profile,
            ProfileChoice::Named(name) => match self.profiles.named(&name) {
                Some(profile) => (*profile).clone(),
                None => return Err(ErrorMessage::new("unknown_profile", UnknownProfile(name).to_string())),
            },
        };
        let warnings = self.pipeline.solver().use_profile(&profile).map_err(|error| ErrorMessage::new("bad_profile", error.to_string()))?;
        if is_named {
            // Another server may keep another one of this name.
            let (session, profile) = (self.session(), &profile);
            self.place.record(|| Item::Event(SessionEvent::Profile { session, profile: Box::new(profile.clone()) }));
        }
        self.save_profile();
        let kept = RoomName::new(&profile.name).is_ok_and(|name| self.profiles.named(&name).is_some_and(|known| *known == profile));
        let answer = Answer::Profile { profile: &profile, warnings: &warnings, offers: Settings::default(), kept }.text();
        self.profile = Some(profile);
        self.settings_changed();
        Ok(answer)
    }

    /// A fresh profile is in use, and kept where the server keeps profiles.
    fn keep_profile(&mut self, profile: Profile, warnings: &mut Vec<String>) -> bool {
        let kept = self.profiles.keep(&profile).unwrap_or_else(|error| {
            tracing::warn!(%error, "profile not kept");
            warnings.push(error.to_string());
            false
        });
        (self.profile, self.is_profile_changed) = (Some(profile), false);
        self.keep_neutral();
        kept
    }

    /// Keeps what has changed in the profile in use.
    fn save_profile(&mut self) {
        if !std::mem::take(&mut self.is_profile_changed) {
            return;
        }
        if let Some(profile) = &self.profile
            && RoomName::new(&profile.name).is_ok_and(|name| self.profiles.named(&name).is_some())
            && let Err(error) = self.profiles.keep(profile)
        {
            tracing::warn!(%error, "profile not kept");
        }
    }

    fn own_fit(&mut self, owner: FitOwner) {
        if let FitOwner::Control(waits) = std::mem::replace(&mut self.fit_owner, owner) {
            // Who asked may have gone.
            let _ =
                waits.send(Err(ErrorMessage::new("fit_replaced", "another step of the fit was asked for before this one was measured")));
        }
    }

    /// What has come about since the last call and is the publisher's to know: a neutral that has been reached, which is left
    /// with the room, and a step of the fit.
    pub fn news(&mut self) -> Vec<Told> {
        let mut news = Vec::new();
        if let Some(report) = self.pipeline.take_calibrated() {
            self.keep_neutral();
            news.push(Ok(Answer::calibrated(report, self.pipeline.added_delay()).text()));
        }
        if let Some(outcome) = self.pipeline.solver().take_fit() {
            let told = match outcome {
                Ok(report) => Ok(Answer::measured(&report).text()),
                Err(error) => Err(ErrorMessage::new(error.code(), error.to_string())),
            };
            match std::mem::take(&mut self.fit_owner) {
                FitOwner::Publisher => news.push(told),
                // Who asked may have gone.
                FitOwner::Control(waits) => drop(waits.send(told)),
            }
        }
        news
    }

    /// The next command from elsewhere. May be dropped at its await.
    pub async fn next_control(&mut self) -> Control {
        match self.controls.recv().await {
            Some(control) => control,
            // The room holds the other end for as long as the place is this source's.
            None => std::future::pending().await,
        }
    }

    /// Does what others have asked for since the last call.
    pub fn take_controls(&mut self) {
        while let Ok(control) = self.controls.try_recv() {
            self.control(control);
        }
    }

    /// Does what somebody else asks for.
    pub fn control(&mut self, Control { command, text, answer }: Control) {
        let is_calibrate = command == Command::Calibrate;
        let is_measured = matches!(command, Command::Fit(FitRequest::Measure { .. }));
        let done = self.command(command);
        if done.is_ok() {
            self.place.record(|| Item::Control { slot: self.slot.clone(), text });
        }
        let told = match done {
            Ok(None) if is_measured => return self.own_fit(FitOwner::Control(answer)),
            Ok(None) if is_calibrate => Ok(Answer::Calibrating.text()),
            Ok(None) => Ok(self.settings_answer()),
            Ok(Some(text)) => Ok(text),
            Err(error) => Err(error),
        };
        // Who asked may have gone.
        let _ = answer.send(told);
    }

    /// Leaves the neutral in use with the room, and with other nodes.
    fn keep_neutral(&mut self) {
        let Some(calibration) = self.pipeline.calibration().cloned() else { return };
        let solver = self.pipeline.solver();
        let (settings, ranges) = (*solver.settings(), *solver.ranges());
        let measured = if calibration.points.is_empty() { FaceKind::Weights } else { FaceKind::Landmarks };
        let profile = match &self.profile {
            Some(profile) => Profile { neutral: None, ranges, settings, ..profile.clone() },
            None => {
                let (name, source) = (String::new(), self.hello.source.clone());
                Profile { rhytid_profile: PROFILE_VERSION, name, source, measured, neutral: None, ranges, settings }
            }
        };
        let kept = Kept { tracker: self.hello.tracker(), calibration, profile: Some(profile) };
        let slot = &self.hello.slot.name;
        if self.place.keep(slot, kept.clone())
            && let Some(cluster) = &self.cluster
        {
            cluster.keep(self.room(), slot, &kept);
        }
    }

    /// Name of the profile in use, where it has one.
    pub fn profile_name(&self) -> Option<&str> {
        self.profile.as_ref().map(|profile| profile.name.as_str()).filter(|name| !name.is_empty())
    }

    /// What its publisher takes its slot back with, beside the session's number.
    pub fn resume_key(&self) -> &str {
        &self.place.key
    }

    /// Number of this session in its room, from 1.
    pub fn session(&self) -> u32 {
        self.place.session
    }

    /// The room.
    pub fn room(&self) -> &RoomName {
        &self.place.room.name
    }
}

impl Drop for Source {
    /// What has refined the neutral since it was told of is kept.
    fn drop(&mut self) {
        self.keep_neutral();
        self.save_profile();
        tracing::info!(room = %self.room(), session = self.session(), frames = self.num_frames, "publisher gone");
    }
}

/// The session's pipeline, and whether it starts from the `kept` neutral face.
fn start(hub: &Hub, hello: &PublishHello, kept: Option<Calibration>) -> Result<(Pipeline, bool), SolveError> {
    let (character, config) = (&hub.character, &hub.config.solve);
    // A neutral of weights does not fit a sender that has a layout too: its landmarks have none yet.
    if let Some(pipeline) = kept.and_then(|kept| Pipeline::with_calibration(character.clone(), config, hello, 0, kept).ok()) {
        return Ok((pipeline, true));
    }
    Ok((Pipeline::new(character.clone(), config, hello, 0)?, false))
}
