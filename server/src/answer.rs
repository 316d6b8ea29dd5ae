//! What a publisher is told, and whoever speaks for it over a control socket, besides errors.

use crate::solve::{CalibrationReport, DelayReport, StepReport};
use rhytid_shared::{Profile, Settings};
use serde::Serialize;
use tokio_tungstenite::tungstenite::Utf8Bytes;

/// An answer as it is sent.
#[derive(Debug, Serialize)]
#[serde(tag = "type", rename_all = "snake_case")]
pub(crate) enum Answer<'a> {
    /// The hello was taken; frames may come.
    Ready {
        version: u32,
        room: &'a str,
        /// Number of this session in its room.
        session: u32,
        /// What the publisher proves with that this session was its own, when it comes back.
        resume_key: &'a str,
        /// True where the session starts from the neutral face that the room has kept.
        kept_neutral: bool,
        character: &'a str,
        /// Names that `bones` frames may use.
        bones: Vec<&'a str>,
        /// The profile in use, where it has a name.
        #[serde(skip_serializing_if = "Option::is_none")]
        profile: Option<&'a str>,
    },
    /// The settings in use.
    Settings {
        #[serde(flatten)]
        settings: &'a Settings,
        added_delay: DelayReport,
    },
    /// The head's present pose is straight ahead.
    Recentred,
    /// The neutral face is taken from the next moments.
    Calibrating,
    /// A neutral face has been taken.
    Calibrated {
        /// Sender's time at which it was reached, seconds.
        t: f64,
        /// Frames it is the median of.
        frames: usize,
        /// True where the publisher asked for it.
        requested: bool,
        /// Delay the smoothing adds at present, seconds by group.
        added_delay: DelayReport,
    },
    /// A step of the fit has been measured, or the fit has been given up (`step` is `cancel`).
    Fit {
        step: &'a str,
        done: bool,
        frames: usize,
        #[serde(skip_serializing_if = "str::is_empty")]
        note: &'a str,
    },
    /// The profile in use.
    Profile {
        profile: &'a Profile,
        /// For people: what looked wrong, or does not fit this tracker.
        warnings: &'a [String],
        /// Settings that would put a side right.
        offers: Settings,
        /// The server keeps it by its name.
        kept: bool,
    },
}

impl<'a> Answer<'a> {
    /// A neutral that has been reached.
    pub fn calibrated(report: CalibrationReport, added_delay: DelayReport) -> Self {
        Self::Calibrated { t: report.t, frames: report.num_frames, requested: report.requested, added_delay }
    }

    /// A step that has been measured.
    pub fn measured(report: &'a StepReport) -> Self {
        Self::Fit { step: report.step.name(), done: true, frames: report.frames, note: &report.note }
    }

    /// As a text message.
    pub fn text(&self) -> Utf8Bytes {
        serde_json::to_string(self).expect("plain data can be written").into()
    }
}
