//! The face by hand: what the sliders say, in place of the stream.

use super::expressions;
use crate::renderer::RenderFrame;
use rhytid_shared::limits::{MAX_EXPRESSIONS, MAX_POSES};
use rhytid_shared::{ARKIT_NAMES, ArkitShape, Character, NUM_ARKIT_SHAPES};
use std::sync::Arc;

/// What the sliders say. Nobody but this window sees it.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Hand {
    /// The sliders pose the face, the stream does not.
    pub(crate) is_on: bool,
    /// Both sides of the face move together.
    pub(crate) is_mirrored: bool,
    /// In `[0, 1]`, in the order of [`ARKIT_NAMES`].
    pub(crate) weights: [f32; NUM_ARKIT_SHAPES],
    /// In `[0, 1]`, how much of each row of the character's table of expressions.
    pub(crate) expressions: [f32; MAX_EXPRESSIONS],
    /// In `[0, 1]`, how much of each reference pose.
    pub(crate) poses: [f32; MAX_POSES],
    /// Of the random faces.
    seed: u64,
}

/// A part of the face, for lists.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Region {
    pub(crate) name: &'static str,
    /// What the names of its shapes begin with.
    stems: &'static [&'static str],
}

/// Every shape belongs to one of these.
pub(crate) const REGIONS: [Region; 5] = [
    Region { name: "Brows", stems: &["brow"] },
    Region { name: "Eyes", stems: &["eye"] },
    Region { name: "Nose and cheeks", stems: &["nose", "cheek"] },
    Region { name: "Jaw", stems: &["jaw"] },
    Region { name: "Mouth", stems: &["mouth", "tongue"] },
];

/// No face does both of these.
const OPPOSITES: [(&str, &str); 8] = [
    ("jawLeft", "jawRight"),
    ("mouthLeft", "mouthRight"),
    ("eyeBlinkLeft", "eyeWideLeft"),
    ("eyeBlinkRight", "eyeWideRight"),
    ("eyeLookUpLeft", "eyeLookDownLeft"),
    ("eyeLookUpRight", "eyeLookDownRight"),
    ("eyeLookInLeft", "eyeLookOutLeft"),
    ("eyeLookInRight", "eyeLookOutRight"),
];
/// How often a shape takes part in a random face, and how much of it there is at most: more of either is a grimace.
const RANDOM_SHARE: f32 = 0.22;
const RANDOM_MOST: f32 = 0.85;

impl Default for Hand {
    fn default() -> Self {
        Self {
            is_on: false,
            is_mirrored: true,
            weights: [0.0; NUM_ARKIT_SHAPES],
            expressions: [0.0; MAX_EXPRESSIONS],
            poses: [0.0; MAX_POSES],
            seed: 0,
        }
    }
}

impl Region {
    /// Its shapes in ARKit's order.
    pub(crate) fn shapes(self) -> impl Iterator<Item = usize> {
        (0..NUM_ARKIT_SHAPES).filter(move |&shape| self.stems.iter().any(|stem| ARKIT_NAMES[shape].starts_with(stem)))
    }
}

/// The shape that does the same on the other side; none for shapes in the middle, nor for those that move jaw or mouth
/// sideways.
pub(crate) fn other_side(shape: usize) -> Option<usize> {
    let name = ARKIT_NAMES[shape];
    let (stem, other) = match (name.strip_suffix("Left"), name.strip_suffix("Right")) {
        (Some(stem), _) => (stem, "Right"),
        (_, Some(stem)) => (stem, "Left"),
        _ => return None,
    };
    if matches!(stem, "jaw" | "mouth") {
        return None;
    }
    ArkitShape::from_name(&format!("{stem}{other}")).map(ArkitShape::index)
}

impl Hand {
    /// Sets a shape, and its partner where sides are linked.
    pub(crate) fn set(&mut self, shape: usize, weight: f32) {
        self.weights[shape] = weight;
        if let Some(other) = other_side(shape).filter(|_| self.is_mirrored) {
            self.weights[other] = weight;
        }
    }

    /// Links the sides or parts them; linked, both take the stronger one's weight.
    pub(crate) fn mirror(&mut self, is_mirrored: bool) {
        self.is_mirrored = is_mirrored;
        for shape in 0..NUM_ARKIT_SHAPES {
            if let Some(other) = other_side(shape).filter(|_| is_mirrored) {
                self.weights[shape] = self.weights[shape].max(self.weights[other]);
            }
        }
    }

    /// The face at rest.
    pub(crate) fn reset(&mut self) {
        *self = Self { is_on: self.is_on, is_mirrored: self.is_mirrored, seed: self.seed, ..Self::default() };
    }

    /// Takes over what the stream shows now; parts the sides, which a tracker never has alike.
    pub(crate) fn take(&mut self, weights: &[f32; NUM_ARKIT_SHAPES]) {
        self.reset();
        self.is_mirrored = false;
        self.weights = *weights;
    }

    /// Another face every time: a few shapes that go together.
    pub(crate) fn randomise(&mut self) {
        self.reset();
        for shape in 0..NUM_ARKIT_SHAPES {
            let (chance, amount) = (self.next(), self.next());
            if chance < RANDOM_SHARE && !(self.is_mirrored && other_side(shape).is_some_and(|other| other < shape)) {
                self.set(shape, RANDOM_MOST * amount);
            }
        }
        let index = |name| ArkitShape::from_name(name).map(ArkitShape::index);
        for (a, b) in OPPOSITES {
            if let (Some(a), Some(b)) = (index(a), index(b)) {
                let weaker = if self.weights[a] < self.weights[b] { a } else { b };
                self.weights[weaker] = 0.0;
            }
        }
    }

    /// From 0 to below 1 (splitmix64, Steele and others 2014).
    fn next(&mut self) -> f32 {
        self.seed = self.seed.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.seed;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        ((z ^ (z >> 31)) >> 40) as f32 / (1_u64 << 24) as f32
    }

    /// The shapes' own weights and what the expressions ask of them, each at most 1.
    fn all_weights(&self, character: &Character) -> [f32; NUM_ARKIT_SHAPES] {
        let mut weights = self.weights;
        let rows = character.zones.iter().flat_map(|zones| &zones.expressions);
        for (row, &amount) in rows.zip(&self.expressions) {
            let known = expressions::ALL.iter().find(|known| known.name == row.name);
            for &(name, weight) in known.into_iter().flat_map(|known| known.weights) {
                if let Some(shape) = ArkitShape::from_name(name) {
                    weights[shape.index()] += amount * weight;
                }
            }
        }
        weights.map(|weight| weight.clamp(0.0, 1.0))
    }
}

/// The face that a [`Hand`] makes of a character, solved anew where either changes.
#[derive(Debug, Default)]
pub(crate) struct HandFace {
    solved: Option<(Arc<Character>, Hand, RenderFrame)>,
}

impl HandFace {
    /// The face to draw.
    pub(crate) fn frame(&mut self, character: &Arc<Character>, hand: &Hand) -> RenderFrame {
        match &self.solved {
            Some((of, by, frame)) if Arc::ptr_eq(of, character) && by == hand => frame.clone(),
            _ => {
                let frame = solve(character, hand);
                self.solved = Some((Arc::clone(character), hand.clone(), frame.clone()));
                frame
            }
        }
    }
}

/// Without the server's solve shapes move the face; bones and wrinkles stay at rest.
#[cfg(not(feature = "embedded"))]
fn solve(character: &Arc<Character>, hand: &Hand) -> RenderFrame {
    RenderFrame { shapes: Some(hand.all_weights(character)), ..RenderFrame::at_rest(character) }
}

/// Through the same solve as a sender's frames.
#[cfg(feature = "embedded")]
fn solve(character: &Arc<Character>, hand: &Hand) -> RenderFrame {
    use rhytid_shared::{TrackingData, TrackingFrame};
    let weights = hand.all_weights(character);
    let has_expressions = hand.expressions.iter().any(|amount| *amount > 0.0);
    let solve = |data, expressions| {
        let tracked = TrackingFrame { expressions, ..TrackingFrame::new(0.0, data) };
        match crate::render_cli::solve_first(character, &tracked) {
            Ok(face) => RenderFrame::from(&face),
            // Sliders cannot leave their ranges: only a character at odds with itself comes here.
            Err(error) => {
                tracing::warn!(%error, "the face by hand");
                RenderFrame::at_rest(character)
            }
        }
    };
    let by_weights = solve(TrackingData::Weights { weights: Box::new(weights), head: None }, has_expressions.then_some(hand.expressions));
    if hand.poses.iter().all(|amount| *amount == 0.0) {
        return by_weights;
    }
    // Poses are points of the bones: their ways from rest add up, on top of the weights'.
    let points = by_weights.points.iter().enumerate().map(|(i, &point)| {
        let rest = character.bones[i].rest;
        let moved = character.poses.iter().zip(&hand.poses).map(|(pose, &amount)| amount * (pose.points[i] - rest)).sum::<glam::Vec3>();
        (i, point + moved)
    });
    let mut face = solve(TrackingData::Bones { points: points.collect(), head: None }, None);
    // What bones say of zones, and what weights and expressions say.
    let stronger = |to: &mut [f32], from: &[f32]| to.iter_mut().zip(from).for_each(|(to, from)| *to = to.max(*from));
    stronger(&mut face.zones, &by_weights.zones);
    stronger(&mut face.stretched, &by_weights.stretched);
    face.shapes = by_weights.shapes;
    face
}

#[cfg(test)]
mod tests {
    use super::*;
    use rhytid_shared::DEFAULT_CHARACTER_GLB;

    fn character() -> Arc<Character> {
        Arc::new(Character::from_glb(DEFAULT_CHARACTER_GLB).expect("whole"))
    }

    fn shape(name: &str) -> usize {
        ArkitShape::from_name(name).expect("a shape's name").index()
    }

    #[test]
    fn every_shape_stands_in_one_region() {
        let mut shapes: Vec<usize> = REGIONS.iter().flat_map(|region| region.shapes()).collect();
        shapes.sort_unstable();
        assert_eq!(shapes, (0..NUM_ARKIT_SHAPES).collect::<Vec<_>>());
    }

    #[test]
    fn linked_sides_move_together_and_parted_ones_alone() {
        let mut hand = Hand::default();
        hand.set(shape("browDownLeft"), 0.7);
        assert_eq!(hand.weights[shape("browDownRight")], 0.7);
        hand.set(shape("jawLeft"), 0.5);
        assert_eq!(hand.weights[shape("jawRight")], 0.0, "a jaw cannot go both ways");
        hand.mirror(false);
        hand.set(shape("browDownRight"), 0.1);
        assert_eq!(hand.weights[shape("browDownLeft")], 0.7);
        hand.mirror(true);
        assert_eq!(hand.weights[shape("browDownRight")], 0.7);
    }

    #[test]
    fn random_faces_differ_stay_in_range_and_do_nothing_impossible() {
        let mut hand = Hand::default();
        let mut last = hand.weights;
        for _ in 0..50 {
            hand.randomise();
            assert_ne!(hand.weights, last);
            last = hand.weights;
            assert!(last.iter().all(|weight| (0.0..=1.0).contains(weight)));
            assert!(OPPOSITES.iter().all(|(a, b)| last[shape(a)] == 0.0 || last[shape(b)] == 0.0));
            assert_eq!(last[shape("mouthSmileLeft")], last[shape("mouthSmileRight")]);
        }
        hand.reset();
        assert_eq!(hand.weights, [0.0; NUM_ARKIT_SHAPES]);
    }

    #[test]
    fn expressions_ask_for_shapes_and_never_too_much() {
        let character = character();
        let mut hand = Hand::default();
        let surprise = character.zones.as_ref().and_then(|zones| zones.expression_index("surprise")).expect("in the table");
        hand.expressions[surprise] = 0.5;
        assert!((hand.all_weights(&character)[shape("browInnerUp")] - 0.45).abs() < 1e-6);
        hand.weights[shape("browInnerUp")] = 0.9;
        assert_eq!(hand.all_weights(&character)[shape("browInnerUp")], 1.0);
    }

    #[test]
    fn nothing_by_hand_is_the_face_at_rest() {
        let character = character();
        let frame = HandFace::default().frame(&character, &Hand::default());
        let rest = RenderFrame::at_rest(&character);
        assert!(frame.points.iter().zip(&rest.points).all(|(a, b)| a.distance(*b) < 1e-6));
        assert_eq!((frame.influences, frame.zones), (rest.influences, rest.zones));
    }

    #[test]
    #[cfg(feature = "embedded")]
    fn weights_poses_and_expressions_move_bones_and_add_up() {
        let character = character();
        let mut face = HandFace::default();
        let bone = |name: &str| character.bones.iter().position(|bone| bone.name == name).expect("a bone's name");
        let brow = bone("brow_inner_l");
        let up = |frame: &RenderFrame| frame.points[brow].y - character.bones[brow].rest.y;
        let mut hand = Hand::default();
        hand.set(shape("browInnerUp"), 0.4);
        let by_weight = up(&face.frame(&character, &hand));
        let stretch = character.poses.iter().position(|pose| pose.name == "stretch").expect("a pose");
        hand.poses[stretch] = 0.5;
        let by_both = face.frame(&character, &hand);
        let of_pose = 0.5 * (character.poses[stretch].points[brow].y - character.bones[brow].rest.y);
        assert!(by_weight > 0.001 && (up(&by_both) - by_weight - of_pose).abs() < 1e-4, "{by_weight} {of_pose} {}", up(&by_both));
        assert!(by_both.influences[stretch * character.num_bones() + brow] > 0.4);
        hand.reset();
        let anger = character.zones.as_ref().and_then(|zones| zones.expression_index("anger")).expect("in the table");
        hand.expressions[anger] = 1.0;
        let angry = face.frame(&character, &hand);
        assert!(up(&angry) < -0.001 && angry.zones[6] > 0.9, "{} {:?}", up(&angry), angry.zones);
    }
}
