//! The points a session's landmarks become: which of the layout's they are, where the character has them, what they serve.

use super::error::SolveError;
use super::head_pose;
use glam::DVec3;
use rhytid_shared::Character;
use rhytid_shared::character::{Drive, LandmarkWeight, Side};
use rhytid_shared::layout::{IBUG_FROM_MEDIAPIPE, IBUG_FROM_OPENSEEFACE, IBUG_MIRROR, IBUG_STABLE, Layout, NUM_IBUG};

/// Centres of MediaPipe's irises: the subject's right, then left.
const MEDIAPIPE_IRISES: [usize; 2] = [468, 473];
/// A regression in the plane needs three points; below five nothing is left to smooth over.
const FEWEST_FEATURES: usize = 5;
/// A user's point this near to a stable iBUG landmark, as a fraction of the interocular distance, counts as stable.
const STABLE_REACH: f64 = 0.08;
/// Where there are too few of them, all points place the head, weighed down beyond this distance from a stable landmark.
const STABLE_SOFTNESS: f64 = 0.05;
/// A head pose by perspective takes at least this many stable points.
const FEWEST_STABLE: usize = 5;
/// Reach of a user's point over bones without a point of their own, as a fraction of the interocular distance.
const NEIGHBOUR_REACH: f64 = 0.4;

/// Smoothing group of a point.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Group {
    Brows,
    Eyelids,
    Mouth,
}

/// iBUG's points of one eye.
#[derive(Debug, Clone, Copy)]
pub(super) struct EyePoints {
    /// Upper lid and, straight below each, lower lid.
    pub(super) lids: [(usize, usize); 2],
    pub(super) corners: (usize, usize),
}

pub(super) const RIGHT_EYE: EyePoints = EyePoints { lids: [(37, 41), (38, 40)], corners: (36, 39) };
pub(super) const LEFT_EYE: EyePoints = EyePoints { lids: [(43, 47), (44, 46)], corners: (42, 45) };

/// A session's points.
#[derive(Debug, Clone)]
pub(super) struct PointSet {
    /// Place in the layout of each point.
    pub(super) source_of: Vec<usize>,
    /// Place in the layout of the right and the left iris.
    pub(super) irises: Option<[usize; 2]>,
    /// Where the character has each point, metres, head space.
    pub(super) model: Vec<DVec3>,
    pub(super) groups: Vec<Group>,
    /// Points that expressions move little, with their weights in the head pose.
    pub(super) stable: Vec<(usize, f64)>,
    /// Points of mouth and chin; none where there is no pose in perspective.
    pub(super) lower: Vec<usize>,
    /// True where they are enough for a pose in perspective; else size, roll and place are all that is taken.
    pub(super) has_perspective: bool,
    /// The point on the other side of the face (irises after the points, where the layout has them); itself where unknown.
    pub(super) mirror: Vec<usize>,
    /// Centres of the regression.
    pub(super) centres: Vec<usize>,
    /// True where points are numbered as iBUG numbers them.
    pub(super) is_ibug: bool,
    /// Shares of points in each bone's motion.
    pub(super) shares: Vec<Vec<(usize, f32)>>,
}

impl PointSet {
    pub(super) fn new(character: &Character, layout: &Layout, mirror: bool) -> Result<Self, SolveError> {
        match layout {
            Layout::Ibug68 => Ok(Self::ibug(character, &std::array::from_fn(|i| i), None, mirror)),
            Layout::Mediapipe478 => Ok(Self::ibug(character, &IBUG_FROM_MEDIAPIPE, Some(MEDIAPIPE_IRISES), mirror)),
            Layout::OpenSeeFace66 => Ok(Self::ibug(character, &IBUG_FROM_OPENSEEFACE, None, mirror)),
            Layout::Named(names) => Self::named(character, names, mirror),
        }
    }

    /// Points of the layout.
    pub(super) fn len(&self) -> usize {
        self.model.len()
    }

    fn ibug(character: &Character, table: &[usize; NUM_IBUG], irises: Option<[usize; 2]>, mirror: bool) -> Self {
        let group_of = |i: usize| match i {
            17..=26 => Group::Brows,
            36..=47 => Group::Eyelids,
            _ => Group::Mouth,
        };
        // Expressions lift the nostrils a little and squints shift the corners, the bridge stays.
        let weight_of = |i: usize| match i {
            27..=30 => 1.0,
            31..=35 => 0.5,
            _ => 1.0,
        };
        // Left out: the jaw line, which in most layouts slides along the outline as the head turns (the chin stays); the
        // lids and the inner lips, whose neighbours nearly touch and would make the map's slope there arbitrary.
        let is_centre = |i: usize| matches!(i, 7..=9 | 17..=36 | 39 | 42 | 45 | 48..=59);
        let shares = character
            .bones
            .iter()
            .map(|bone| landmarks_of(&bone.drive).iter().map(|share| (share.landmark, share.weight)).collect())
            .collect();
        Self {
            source_of: (0..NUM_IBUG).map(|i| table[if mirror { IBUG_MIRROR[i] } else { i }]).collect(),
            irises: irises.map(|[right, left]| if mirror { [left, right] } else { [right, left] }),
            model: character.ibug68.iter().map(|p| p.as_dvec3()).collect(),
            groups: (0..NUM_IBUG).map(group_of).collect(),
            mirror: IBUG_MIRROR.into_iter().chain(irises.iter().flat_map(|_| [NUM_IBUG + 1, NUM_IBUG])).collect(),
            stable: IBUG_STABLE.iter().map(|&i| (i, weight_of(i))).collect(),
            lower: (0..NUM_IBUG).filter(|&i| is_lower(i)).collect(),
            has_perspective: true,
            centres: (0..NUM_IBUG).filter(|&i| is_centre(i)).collect(),
            is_ibug: true,
            shares,
        }
    }

    fn named(character: &Character, names: &[String], mirror: bool) -> Result<Self, SolveError> {
        if names.len() < FEWEST_FEATURES {
            return Err(SolveError::TooFewFeatures { got: names.len(), expected: FEWEST_FEATURES });
        }
        let unit = f64::from(character.interocular());
        let mut model = Vec::with_capacity(names.len());
        let mut source_of = Vec::with_capacity(names.len());
        let mut opposite = Vec::with_capacity(names.len());
        for (index, name) in names.iter().enumerate() {
            let Some(point) = character.features.get(name) else {
                return Err(SolveError::UnknownFeature { index, name: name.clone() });
            };
            if names[..index].contains(name) {
                return Err(SolveError::RepeatedFeature { index, name: name.clone() });
            }
            model.push(point.as_dvec3());
            let partner = other_side(name).and_then(|other| names.iter().position(|name| *name == other));
            let partner = partner.unwrap_or(index);
            source_of.push(if mirror { partner } else { index });
            opposite.push(partner);
        }
        let nearest_ibug = |p: &DVec3| -> usize {
            let distances = (0..NUM_IBUG).map(|i| (i, character.ibug68[i].as_dvec3().distance(*p)));
            distances.fold((0, f64::INFINITY), |best, one| if one.1 < best.1 { one } else { best }).0
        };
        let nearest: Vec<usize> = model.iter().map(nearest_ibug).collect();
        let groups = nearest
            .iter()
            .map(|&i| match i {
                17..=26 => Group::Brows,
                36..=47 => Group::Eyelids,
                _ => Group::Mouth,
            })
            .collect();
        // Distance to the nearest stable landmark, interocular distances.
        let off: Vec<f64> = model
            .iter()
            .map(|p| IBUG_STABLE.iter().map(|&i| character.ibug68[i].as_dvec3().distance(*p) / unit).fold(f64::INFINITY, f64::min))
            .collect();
        let mut stable: Vec<(usize, f64)> = (0..off.len()).filter(|&i| off[i] < STABLE_REACH).map(|i| (i, 1.0)).collect();
        let has_perspective = stable.len() >= FEWEST_STABLE && head_pose::spans(&model, &stable, unit);
        if !has_perspective {
            // All of them, or the brows of a layout of brows and lips would be believed to be still.
            let weight = |off: f64| {
                let square = (off / STABLE_SOFTNESS) * (off / STABLE_SOFTNESS);
                1.0 / (1.0 + square * square)
            };
            stable = off.iter().enumerate().map(|(i, off)| (i, weight(*off))).collect();
        }
        let shares = character
            .bones
            .iter()
            .map(|bone| {
                if let Some(own) = names.iter().position(|name| *name == bone.name) {
                    return vec![(own, 1.0)];
                }
                if landmarks_of(&bone.drive).is_empty() {
                    return Vec::new();
                }
                neighbours(&model, bone.rest.as_dvec3(), NEIGHBOUR_REACH * unit)
            })
            .collect();
        Ok(Self {
            source_of,
            irises: None,
            mirror: opposite,
            centres: (0..model.len()).collect(),
            model,
            groups,
            stable,
            lower: if has_perspective { (0..names.len()).filter(|&i| is_lower(nearest[i])).collect() } else { Vec::new() },
            has_perspective,
            is_ibug: false,
            shares,
        })
    }

    /// True for points that expressions move little.
    pub(super) fn is_stable(&self, point: usize) -> bool {
        self.has_perspective && self.stable.iter().any(|(stable, _)| *stable == point)
    }

    /// The eye's points, where the layout has them.
    pub(super) fn eye(&self, side: Side) -> Option<EyePoints> {
        self.is_ibug.then_some(match side {
            Side::Right => RIGHT_EYE,
            Side::Left => LEFT_EYE,
        })
    }
}

/// iBUG's landmarks of mouth and chin.
fn is_lower(ibug: usize) -> bool {
    matches!(ibug, 6..=10 | 48..=67)
}

/// The landmarks that move a bone; none for lids and eyes, which have measures of their own.
fn landmarks_of(drive: &Drive) -> &[LandmarkWeight] {
    match drive {
        Drive::Skin { landmarks } | Drive::Jaw { landmarks, .. } => landmarks,
        Drive::Lid { .. } | Drive::Eye { .. } | Drive::Still => &[],
    }
}

/// The name of the same point on the other side, by the endings `_l` and `_r`.
fn other_side(name: &str) -> Option<String> {
    match name.split_at_checked(name.len().checked_sub(2)?)? {
        (stem, "_l") => Some(format!("{stem}_r")),
        (stem, "_r") => Some(format!("{stem}_l")),
        _ => None,
    }
}

/// Shares of the points around `at` that fall off to zero at `reach` (Wendland's C2 function) and sum to one at most.
fn neighbours(points: &[DVec3], at: DVec3, reach: f64) -> Vec<(usize, f32)> {
    let share = |p: &DVec3| {
        let r = p.distance(at) / reach;
        if r < 1.0 { (1.0 - r) * (1.0 - r) * (1.0 - r) * (1.0 - r) * (4.0 * r + 1.0) } else { 0.0 }
    };
    let raw: Vec<f64> = points.iter().map(share).collect();
    // A bone amid points follows their mean; one at the edge of their reach fades out.
    let total = raw.iter().sum::<f64>().max(0.3);
    raw.iter().enumerate().filter(|(_, share)| **share > 0.0).map(|(i, share)| (i, (share / total) as f32)).collect()
}
