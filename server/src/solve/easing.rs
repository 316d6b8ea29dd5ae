//! What the viewer sees while the face is lost, comes back, or gets another neutral: no jump, in the sender's own time.

use super::config::LostConfig;
use super::weights_to_bones::Weights;
use super::zones::Amounts;
use glam::Vec3;
use rhytid_shared::NUM_ARKIT_SHAPES;
use rhytid_shared::limits::MAX_EXPRESSIONS;

/// Everything about a face that is eased: linear in each of its numbers.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct FaceState {
    /// A displacement in metres; for bones that turn pitch and yaw in radians, and how much longer their arm is than at rest
    /// (a fraction; 0 but on the way from placed bones).
    pub(super) motions: Vec<Vec3>,
    /// Rotation vector, then position in metres.
    pub(super) head: [f64; 6],
    pub(super) weights: Option<Weights>,
    /// Expressions; 0 where nothing is known of them.
    pub(super) expressions: Amounts,
    /// How much the influences drive the wrinkle zones: 1 where nothing is known of expressions, else 0, between them while
    /// one is blended into the other.
    pub(super) bridge: f32,
    /// True where every motion is a displacement, of turning bones, too: an animator's own bones.
    pub(super) is_placed: bool,
}

impl FaceState {
    pub(super) fn at_rest(num_bones: usize) -> Self {
        Self {
            motions: vec![Vec3::ZERO; num_bones],
            head: [0.0; 6],
            weights: None,
            expressions: [[0.0; 2]; MAX_EXPRESSIONS],
            bridge: 1.0,
            is_placed: false,
        }
    }

    /// `self = a * share`, but what drives the zones stays: the influences scale with the motions.
    fn copy_scaled(&mut self, a: &Self, share: f64) {
        for (to, from) in self.motions.iter_mut().zip(&a.motions) {
            *to = *from * share as f32;
        }
        for axis in 0..6 {
            self.head[axis] = a.head[axis] * share;
        }
        self.weights = a.weights.map(|weights| weights.map(|weight| weight * share as f32));
        self.expressions = a.expressions.map(|halves| halves.map(|amount| amount * share as f32));
        self.bridge = a.bridge;
        self.is_placed = a.is_placed;
    }

    /// `self += b * share`; weights that one of them lacks count as zero.
    fn add_scaled(&mut self, b: &Self, share: f64) {
        for (to, from) in self.motions.iter_mut().zip(&b.motions) {
            *to += *from * share as f32;
        }
        for axis in 0..6 {
            self.head[axis] += b.head[axis] * share;
        }
        if let Some(from) = &b.weights {
            let to = self.weights.get_or_insert([0.0; NUM_ARKIT_SHAPES]);
            for shape in 0..NUM_ARKIT_SHAPES {
                to[shape] += from[shape] * share as f32;
            }
        }
        for (to, from) in self.expressions.iter_mut().flatten().zip(b.expressions.iter().flatten()) {
            *to += from * share as f32;
        }
        self.bridge += b.bridge * share as f32;
    }
}

#[derive(Debug, Clone, Copy, PartialEq)]
enum Presence {
    /// No face yet.
    Never,
    Seen,
    /// Since this time.
    Lost(f64),
}

/// Eases from state to state.
#[derive(Debug, Clone)]
pub(super) struct Easing {
    config: LostConfig,
    presence: Presence,
    shown: FaceState,
    /// The face as it was lost.
    held: FaceState,
    /// What is shown beyond the target when a blend starts.
    offset: FaceState,
    blend: Option<Blend>,
}

#[derive(Debug, Clone, Copy, PartialEq)]
struct Blend {
    from: f64,
    duration: f64,
}

impl Easing {
    pub(super) fn new(config: &LostConfig, num_bones: usize) -> Self {
        let rest = FaceState::at_rest(num_bones);
        Self { config: config.clone(), presence: Presence::Never, shown: rest.clone(), held: rest.clone(), offset: rest, blend: None }
    }

    /// What is shown.
    pub(super) fn shown(&self) -> &FaceState {
        &self.shown
    }

    /// Says what is shown in the other way, before a face of another kind is shown.
    pub(super) fn convert(&mut self, convert: impl Fn(&mut FaceState)) {
        convert(&mut self.shown);
        // A blend under way goes on in the new kind only from what is shown: the next one starts there.
        self.blend = None;
    }

    /// Shows `target` at `t`, of the kind that is shown. `blend` asks for a smooth way from what is shown now over that many
    /// seconds.
    pub(super) fn show(&mut self, t: f64, target: &FaceState, blend: Option<f64>) {
        let returns = matches!(self.presence, Presence::Lost(_)).then_some(self.config.return_blend);
        if let Some(duration) = [blend, returns].into_iter().flatten().reduce(f64::max) {
            self.offset.copy_scaled(&self.shown, 1.0);
            self.offset.add_scaled(target, -1.0);
            self.blend = (duration > 0.0).then_some(Blend { from: t, duration });
        }
        self.presence = Presence::Seen;
        self.shown.copy_scaled(target, 1.0);
        if let Some(Blend { from, duration }) = self.blend {
            let left = 1.0 - smooth((t - from) / duration);
            if left > 0.0 {
                self.shown.add_scaled(&self.offset, left);
            } else {
                self.blend = None;
            }
        }
    }

    /// No face at `t`: the last one is held, then eases to rest.
    pub(super) fn show_none(&mut self, t: f64) {
        let since = match self.presence {
            Presence::Never => return,
            Presence::Lost(since) => since,
            Presence::Seen => {
                self.held.copy_scaled(&self.shown, 1.0);
                self.presence = Presence::Lost(t);
                self.blend = None;
                t
            }
        };
        let eased = if self.config.ease > 0.0 {
            (t - since - self.config.hold) / self.config.ease
        } else {
            f64::from(t - since > self.config.hold)
        };
        self.shown.copy_scaled(&self.held, 1.0 - smooth(eased));
    }
}

/// `0..=1` to `0..=1` without a jerk at either end.
fn smooth(x: f64) -> f64 {
    let x = x.clamp(0.0, 1.0);
    x * x * (3.0 - 2.0 * x)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn raised(height: f32) -> FaceState {
        FaceState { motions: vec![Vec3::new(0.0, height, 0.0)], ..FaceState::at_rest(1) }
    }

    fn height(easing: &Easing) -> f32 {
        easing.shown().motions[0].y
    }

    #[test]
    fn lost_face_is_held_then_eased_then_at_rest() {
        let mut easing = Easing::new(&LostConfig::default(), 1);
        easing.show_none(0.0);
        assert_eq!(height(&easing), 0.0, "nothing before the first face");
        easing.show(1.0, &raised(0.01), None);
        for (t, want) in [(1.04, 0.01), (1.29, 0.01), (1.54, 0.005), (1.79, 0.0), (2.5, 0.0)] {
            easing.show_none(t);
            assert!((height(&easing) - want).abs() < 1e-6, "{t}: {}", height(&easing));
        }
    }

    #[test]
    fn face_comes_back_without_a_jump() {
        let mut easing = Easing::new(&LostConfig::default(), 1);
        easing.show(0.0, &raised(0.01), None);
        for frame in 1..30 {
            easing.show_none(f64::from(frame) * 0.04);
        }
        let mut last = height(&easing);
        assert_eq!(last, 0.0);
        for frame in 30..60 {
            easing.show(f64::from(frame) * 0.04, &raised(0.01), None);
            assert!((height(&easing) - last).abs() < 0.003, "frame {frame}");
            last = height(&easing);
        }
        assert_eq!(last, 0.01);
    }

    #[test]
    fn another_neutral_is_blended_in() {
        let mut easing = Easing::new(&LostConfig::default(), 1);
        easing.show(0.0, &raised(0.01), None);
        easing.show(0.04, &raised(0.002), Some(0.5));
        assert!((height(&easing) - 0.01).abs() < 1e-7, "the switch itself shows nothing");
        easing.show(0.29, &raised(0.002), None);
        assert!((height(&easing) - 0.006).abs() < 1e-7);
        easing.show(0.54, &raised(0.002), None);
        assert_eq!(height(&easing), 0.002);
    }
}
