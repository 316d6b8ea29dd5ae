//! One-Euro filter (Casiez et al. 2012): a low-pass whose cut-off opens with speed, so that rest is calm and motion quick.

use super::config::OneEuroConfig;
use std::f64::consts::TAU;

/// A longer pause than this, seconds, starts the filter anew: nothing is known of what lay between.
pub(super) const LONGEST_GAP: f64 = 0.25;

/// Steps shorter than this, seconds, are none: a speed over them has no digits left.
const SHORTEST_STEP: f64 = 1e-9;

/// Share of the new sample for a cut-off in Hz and a step in seconds.
fn alpha(cutoff: f64, dt: f64) -> f64 {
    let k = TAU * cutoff * dt;
    k / (1.0 + k)
}

/// Filters of one group of coordinates; the speed is taken against the last *filtered* value, as in the authors' own code.
#[derive(Debug, Clone)]
pub struct OneEuroBank {
    config: OneEuroConfig,
    /// Multiplies speeds before `beta`: one over the unit of length.
    per_unit: f64,
    values: Vec<f64>,
    speeds: Vec<f64>,
    has_value: bool,
    mean_cutoff: f64,
}

impl OneEuroBank {
    /// `len` coordinates whose speed is measured in `unit`s a second.
    pub fn new(config: OneEuroConfig, len: usize, unit: f64) -> Self {
        Self {
            config,
            per_unit: 1.0 / unit,
            values: vec![0.0; len],
            speeds: vec![0.0; len],
            has_value: false,
            mean_cutoff: config.min_cutoff,
        }
    }

    /// Smooths with other parameters from the next sample on.
    pub(super) fn set_config(&mut self, config: OneEuroConfig) {
        self.config = config;
    }

    /// Forgets the past: the next sample passes as it is.
    pub fn reset(&mut self) {
        self.has_value = false;
    }

    /// Takes one sample of every coordinate, `dt` seconds after the last, and gives the filtered ones.
    pub fn update(&mut self, samples: &[f64], dt: f64) -> &[f64] {
        debug_assert_eq!(samples.len(), self.values.len());
        if !self.has_value || dt > LONGEST_GAP {
            self.values.copy_from_slice(samples);
            self.speeds.fill(0.0);
            self.has_value = true;
            self.mean_cutoff = self.config.min_cutoff;
            return &self.values;
        }
        // Nor is a NaN a step.
        if dt.is_nan() || dt < SHORTEST_STEP {
            return &self.values;
        }
        let speed_share = alpha(self.config.derivative_cutoff, dt);
        let (per_dt, beta) = (1.0 / dt, self.config.beta * self.per_unit);
        let mut sum = 0.0;
        for ((value, speed), &sample) in self.values.iter_mut().zip(&mut self.speeds).zip(samples) {
            *speed += speed_share * ((sample - *value) * per_dt - *speed);
            let cutoff = self.config.min_cutoff + beta * speed.abs();
            sum += cutoff;
            *value += alpha(cutoff, dt) * (sample - *value);
        }
        self.mean_cutoff = if samples.is_empty() { self.config.min_cutoff } else { sum / samples.len() as f64 };
        &self.values
    }

    /// Lag behind a steady motion at the present mean cut-off, seconds.
    pub fn delay(&self) -> f64 {
        1.0 / (TAU * self.mean_cutoff)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn run(config: OneEuroConfig, samples: &[(f64, f64)]) -> Vec<f64> {
        let mut bank = OneEuroBank::new(config, 1, 1.0);
        let mut last = samples[0].0;
        samples
            .iter()
            .map(|&(t, x)| {
                let dt = t - last;
                last = t;
                bank.update(&[x], dt)[0]
            })
            .collect()
    }

    fn assert_near(got: &[f64], want: &[f64]) {
        for (got_one, want_one) in got.iter().zip(want) {
            assert!((got_one - want_one).abs() < 1e-8, "got {got:?}, expected {want:?}");
        }
    }

    #[test]
    fn speed_is_taken_against_the_filtered_value() {
        let samples: Vec<(f64, f64)> = [0.0, 0.0, 1.0, 1.0, 1.0, 0.5].into_iter().enumerate().map(|(i, x)| (i as f64 / 60.0, x)).collect();
        let config = OneEuroConfig { min_cutoff: 1.0, beta: 0.5, derivative_cutoff: 1.0 };
        assert_near(&run(config, &samples), &[0.0, 0.0, 0.28699815, 0.55061706, 0.73167479, 0.64930001]);
        let config = OneEuroConfig { beta: 0.0, ..config };
        assert_near(&run(config, &samples), &[0.0, 0.0, 0.09479305, 0.18060038, 0.25827377, 0.28118773]);
    }

    #[test]
    fn uneven_time_steps_are_true_time_steps() {
        let config = OneEuroConfig { min_cutoff: 1.5, beta: 6.0, derivative_cutoff: 1.0 };
        let samples = [(0.0, 0.0), (0.016, 0.02), (0.033, 0.05), (0.070, 0.30), (0.083, 0.31)];
        assert_near(&run(config, &samples), &[0.0, 0.0036021351, 0.0167432761, 0.2250211829, 0.2705384777]);
    }

    #[test]
    fn share_and_delay_follow_the_cutoff() {
        assert!((alpha(1.0, 1.0 / 60.0) - 0.0947930501).abs() < 1e-9);
        assert!((alpha(1.7, 1.0 / 30.0) - 0.2625625243).abs() < 1e-9);
        let bank = OneEuroBank::new(OneEuroConfig { min_cutoff: 1.0, beta: 0.0, derivative_cutoff: 1.0 }, 1, 1.0);
        assert!((bank.delay() - 0.1591549431).abs() < 1e-9);
    }

    #[test]
    fn a_step_of_no_length_changes_nothing() {
        let config = OneEuroConfig { min_cutoff: 3.0, beta: 10.0, derivative_cutoff: 1.0 };
        let mut bank = OneEuroBank::new(config, 2, 1.0);
        bank.update(&[0.0, 0.5], f64::INFINITY);
        for dt in [5e-324, 1e-320, 0.0, -1.0, f64::NAN] {
            assert_eq!(bank.update(&[0.0, 1.0], dt), [0.0, 0.5], "{dt}");
        }
        let after = bank.update(&[0.0, 1.0], 0.03);
        assert!(after[0] == 0.0 && after[1] > 0.5 && after[1] < 1.0, "{after:?}");
    }

    #[test]
    fn a_long_gap_starts_anew() {
        let config = OneEuroConfig { min_cutoff: 1.0, beta: 0.0, derivative_cutoff: 1.0 };
        assert_eq!(run(config, &[(0.0, 0.0), (0.3, 1.0)]), [0.0, 1.0]);
    }
}
