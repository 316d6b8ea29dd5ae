//! What a publisher may tune while it sends.

use super::MessageError;
use serde::{Deserialize, Serialize};

/// Largest gain.
pub const MAX_GAIN: f32 = 3.0;
/// Largest factor of the default smoothing.
pub const MAX_SMOOTHING: f32 = 4.0;

/// A session's settings, or a change of some of them: what is `None` stays as it is.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Settings {
    /// Swap left and right.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub mirror: Option<bool>,
    /// Factors about the neutral face, 0 to [`MAX_GAIN`]; of lids the closing range only.
    pub gains: GroupValues,
    /// Factors of the default smoothing, 0 (raw) to [`MAX_SMOOTHING`]. Gaze is smoothed with the lids; a `gaze` here is refused.
    pub smoothing: GroupValues,
    /// Swap `jawLeft` and `jawRight` of a sender of weights.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub swap_jaw: Option<bool>,
    /// Swap `mouthLeft` and `mouthRight` of a sender of weights.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub swap_mouth: Option<bool>,
}

/// A number for each channel group.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
#[expect(missing_docs, reason = "the groups themselves")]
pub struct GroupValues {
    #[serde(skip_serializing_if = "Option::is_none")]
    pub brows: Option<f32>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lids: Option<f32>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub gaze: Option<f32>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub mouth: Option<f32>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub head: Option<f32>,
}

impl GroupValues {
    /// In the order of `ChannelGroup::ALL`, 1 where nothing is said.
    pub fn or_one(&self) -> [f32; 5] {
        [self.brows, self.lids, self.gaze, self.mouth, self.head].map(|value| value.unwrap_or(1.0))
    }

    fn check(&self, field: &str, most: f32) -> Result<(), MessageError> {
        let Self { brows, lids, gaze, mouth, head } = self;
        for (group, value) in [("brows", brows), ("lids", lids), ("gaze", gaze), ("mouth", mouth), ("head", head)] {
            // A NaN is in no range.
            if let Some(value) = value.filter(|value| !(0.0..=most).contains(value)) {
                return Err(MessageError::new("out_of_range", format!("field {field}.{group} is {value}, expected 0 to {most}")));
            }
        }
        Ok(())
    }

    fn change(&mut self, by: &Self) {
        self.brows = by.brows.or(self.brows);
        self.lids = by.lids.or(self.lids);
        self.gaze = by.gaze.or(self.gaze);
        self.mouth = by.mouth.or(self.mouth);
        self.head = by.head.or(self.head);
    }
}

impl Settings {
    /// Checks every range.
    pub fn check(&self) -> Result<(), MessageError> {
        self.gains.check("gains", MAX_GAIN)?;
        self.smoothing.check("smoothing", MAX_SMOOTHING)?;
        if self.smoothing.gaze.is_some() {
            return Err(MessageError::new("out_of_range", "field smoothing.gaze is given, expected lids, which smooths both"));
        }
        Ok(())
    }

    /// Takes over what `by` says.
    pub fn change(&mut self, by: &Self) {
        self.mirror = by.mirror.or(self.mirror);
        self.gains.change(&by.gains);
        self.smoothing.change(&by.smoothing);
        self.swap_jaw = by.swap_jaw.or(self.swap_jaw);
        self.swap_mouth = by.swap_mouth.or(self.swap_mouth);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn settings_out_of_range_are_refused_by_name_and_changes_add_up() {
        for (text, says) in [
            (r#"{"gains":{"lids":3.1}}"#, "field gains.lids is 3.1, expected 0 to 3"),
            (r#"{"gains":{"lids":-1}}"#, "field gains.lids is -1"),
            (r#"{"smoothing":{"mouth":5}}"#, "field smoothing.mouth is 5, expected 0 to 4"),
            (r#"{"smoothing":{"gaze":1}}"#, "field smoothing.gaze"),
        ] {
            let settings: Settings = serde_json::from_str(text).unwrap();
            assert!(settings.check().unwrap_err().message.contains(says), "{text}");
        }
        assert!(serde_json::from_str::<Settings>(r#"{"gains":{"ears":1}}"#).is_err());
        let mut settings: Settings = serde_json::from_str(r#"{"mirror":true,"gains":{"brows":2}}"#).unwrap();
        settings.change(&serde_json::from_str(r#"{"gains":{"mouth":0.5}}"#).unwrap());
        assert_eq!((settings.mirror, settings.gains.or_one()), (Some(true), [2.0, 1.0, 1.0, 0.5, 1.0]));
    }
}
