//! What a user may tune in the solve, with its defaults and the ranges that make sense.

use serde::{Deserialize, Serialize};

/// Settings of the solve. Every field has a default, so a file names only what it changes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SolveConfig {
    /// The sender's picture is mirrored: left and right are swapped at ingest (landmarks and weights, not bones).
    pub mirror: bool,
    /// Ridge of the regression from landmarks to the character, in units of its unit-RMS coordinates; 0 interpolates.
    pub ridge: f64,
    /// Largest root-mean-square reprojection error of an accepted head pose, as a fraction of the interocular distance.
    pub max_reprojection: f64,
    /// Expression weights are estimated from landmarks and sent along: for faces of shapes, zones and exports. Costs bytes and
    /// time; the face of bones is the same with and without.
    pub estimate_weights: bool,
    /// Smoothing.
    pub filter: FilterConfig,
    /// Search for the neutral face.
    pub calibration: CalibrationConfig,
    /// What happens while the tracker sees no face.
    pub lost: LostConfig,
}

/// One-Euro parameters by group. Speeds are interocular distances a second for landmarks, radians or decimetres a second
/// for the head.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct FilterConfig {
    /// Brows and forehead.
    pub brows: OneEuroConfig,
    /// Eyelids and irises: quick, a blink lasts 0.1 to 0.3 s.
    pub eyelids: OneEuroConfig,
    /// Mouth, nose, cheeks and jaw.
    pub mouth: OneEuroConfig,
    /// Head rotation and position.
    pub head: OneEuroConfig,
    /// Expression weights, for senders of those; speed in weights a second.
    pub weights: OneEuroConfig,
}

/// One-Euro filter: cut-off = `min_cutoff + beta * |speed|`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct OneEuroConfig {
    /// Cut-off at rest, Hz.
    pub min_cutoff: f64,
    /// Hz for each unit of speed.
    pub beta: f64,
    /// Cut-off of the speed estimate, Hz.
    pub derivative_cutoff: f64,
}

/// Thresholds of the automatic calibration.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct CalibrationConfig {
    /// A frame is calm below this root-mean-square landmark speed, interocular distances a second.
    pub calm_speed: f64,
    /// Calm frames that make a neutral.
    pub min_frames: usize,
    /// After this long the calmest half serves even if it is not calm, seconds.
    pub patience: f64,
    /// Over this long a new neutral is blended in, seconds.
    pub blend: f64,
    /// An explicit `calibrate` looks back this far, seconds.
    pub look_back: f64,
}

/// Timing of a lost face, in the sender's time.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct LostConfig {
    /// The last face is held this long, seconds.
    pub hold: f64,
    /// Then it eases to neutral over this long, seconds.
    pub ease: f64,
    /// A face that comes back is blended in over this long, seconds.
    pub return_blend: f64,
}

impl Default for SolveConfig {
    fn default() -> Self {
        Self {
            mirror: false,
            ridge: 0.0,
            // Good frames of three performers stay below 0.03, with smiles that lift the nostrils.
            max_reprojection: 0.05,
            estimate_weights: true,
            filter: FilterConfig::default(),
            calibration: CalibrationConfig::default(),
            lost: LostConfig::default(),
        }
    }
}

impl Default for FilterConfig {
    fn default() -> Self {
        let one_euro = |min_cutoff, beta| OneEuroConfig { min_cutoff, beta, derivative_cutoff: 1.0 };
        // Tuned on recorded sessions of a webcam tracker at 24 to 30 frames a second.
        Self {
            brows: one_euro(2.0, 8.0),
            eyelids: one_euro(8.0, 30.0),
            mouth: one_euro(3.0, 10.0),
            head: one_euro(1.5, 3.0),
            weights: one_euro(4.0, 5.0),
        }
    }
}

impl Default for CalibrationConfig {
    fn default() -> Self {
        // Two performers at a webcam, one making faces and one talking: the median of their speeds is 0.064 and 0.052, the lowest
        // quarter below 0.030 and 0.026. Below 0.05 are 41 and 48 % of all frames, and 34 and 8 of the first 50: one is calm at
        // once, the other has to be waited for.
        Self { calm_speed: 0.05, min_frames: 30, patience: 2.0, blend: 0.5, look_back: 0.4 }
    }
}

impl Default for LostConfig {
    fn default() -> Self {
        Self { hold: 0.25, ease: 0.5, return_blend: 0.25 }
    }
}

/// A setting outside its range.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("solve setting {field} is {got}, expected {expected}")]
pub struct ConfigError {
    /// Path of the field below the solve's table.
    pub field: String,
    /// Its value.
    pub got: String,
    /// The range.
    pub expected: &'static str,
}

impl SolveConfig {
    /// Checks every range.
    pub fn validate(&self) -> Result<(), ConfigError> {
        in_range("ridge", self.ridge, 0.0, 0.1, "0 to 0.1")?;
        in_range("max_reprojection", self.max_reprojection, 1e-3, 1.0, "0.001 to 1")?;
        let FilterConfig { brows, eyelids, mouth, head, weights } = &self.filter;
        for (group, one_euro) in [("brows", brows), ("eyelids", eyelids), ("mouth", mouth), ("head", head), ("weights", weights)] {
            in_range(&format!("filter.{group}.min_cutoff"), one_euro.min_cutoff, 0.01, 1e3, "0.01 to 1000 Hz")?;
            in_range(&format!("filter.{group}.beta"), one_euro.beta, 0.0, 1e4, "0 to 10000")?;
            in_range(&format!("filter.{group}.derivative_cutoff"), one_euro.derivative_cutoff, 0.01, 1e3, "0.01 to 1000 Hz")?;
        }
        let calibration = &self.calibration;
        in_range("calibration.calm_speed", calibration.calm_speed, 0.0, 10.0, "0 to 10 interocular distances a second")?;
        in_range("calibration.patience", calibration.patience, 0.1, 60.0, "0.1 to 60 s")?;
        in_range("calibration.blend", calibration.blend, 0.0, 10.0, "0 to 10 s")?;
        in_range("calibration.look_back", calibration.look_back, 0.0, 5.0, "0 to 5 s")?;
        if !(1..=1000).contains(&calibration.min_frames) {
            return Err(ConfigError {
                field: "calibration.min_frames".into(),
                got: calibration.min_frames.to_string(),
                expected: "1 to 1000",
            });
        }
        in_range("lost.hold", self.lost.hold, 0.0, 60.0, "0 to 60 s")?;
        in_range("lost.ease", self.lost.ease, 0.0, 60.0, "0 to 60 s")?;
        in_range("lost.return_blend", self.lost.return_blend, 0.0, 10.0, "0 to 10 s")
    }
}

fn in_range(field: &str, got: f64, least: f64, most: f64, expected: &'static str) -> Result<(), ConfigError> {
    // A NaN is in no range.
    if (least..=most).contains(&got) { Ok(()) } else { Err(ConfigError { field: field.to_owned(), got: got.to_string(), expected }) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn defaults_are_in_range() {
        assert_eq!(SolveConfig::default().validate(), Ok(()));
    }

    #[test]
    fn nonsense_is_refused_by_name() {
        for (text, field) in [
            ("ridge = -1.0", "ridge"),
            ("max_reprojection = nan", "max_reprojection"),
            ("[filter]\nmouth = { min_cutoff = 0.0, beta = 1.0, derivative_cutoff = 1.0 }", "filter.mouth.min_cutoff"),
            ("[calibration]\nmin_frames = 0", "calibration.min_frames"),
            ("[lost]\nhold = inf", "lost.hold"),
        ] {
            let config: SolveConfig = toml::from_str(text).expect("well-formed");
            assert_eq!(config.validate().expect_err(text).field, field);
        }
        assert!(toml::from_str::<SolveConfig>("rigde = 0.0").is_err(), "misspelt names are refused");
    }
}
