//! From the performer's points in head space to the character's bones.
//!
//! The regression is applied as a difference, `bone = rest + gain * (F(p) - F(p_neutral))`, so that rest is exact
//! whatever the smoothing, and a tracker's bias cancels. Turning bones take an angle from it.

use super::error::SolveError;
use super::gaze::GazeMeasure;
use super::lids::{LidMeasure, lid_pitch};
use super::points::{LEFT_EYE, PointSet, RIGHT_EYE};
use super::rbf::Regression;
use super::rotation;
use super::skeleton::travel_of;
use glam::{DVec2, DVec3, Vec3};
use rhytid_shared::Character;
use rhytid_shared::character::{Drive, Side};

/// Beyond this many times its distance to the nearest centre a point's path is continued straight: the map may fold there.
const TRUSTED_SHAPES: f64 = 3.0;
/// A jaw swings to the side by no more than this, radians (5 degrees).
const MOST_JAW_YAW: f64 = 0.0873;
/// A jaw closes beyond neutral by no more than this, radians (2 degrees): the teeth are in the way.
const MOST_JAW_CLOSING: f64 = 0.0349;

/// A point that some bone uses.
#[derive(Debug, Clone)]
struct Slot {
    point: usize,
    neutral: DVec2,
    /// `F` and its slopes at neutral.
    value: Vec3,
    slope: [Vec3; 2],
    /// Displacement up to which `F` itself is asked, metres.
    trusted: f64,
}

/// A bone's own way of moving.
#[derive(Debug, Clone)]
enum Driver {
    Skin {
        shares: Vec<(usize, f32)>,
        gain: Vec3,
    },
    Jaw {
        shares: Vec<(usize, f32)>,
        gain: f64,
        max_angle: f64,
        arm: DVec3,
    },
    Lid {
        eye: usize,
        shut_angle: f64,
        wide_angle: f64,
    },
    Eye {
        eye: usize,
        gain: f64,
        range: [f64; 2],
    },
    /// A turning bone that has a point of its own in the sender's layout.
    Arc {
        shares: Vec<(usize, f32)>,
        gain: f64,
        arm: DVec3,
        pitch: [f64; 2],
        yaw: f64,
    },
    Still,
}

/// A bone of the skin that the jaw carries: its gain is on what it does beyond that, else lips would outrun the chin.
#[derive(Debug, Clone, Copy)]
struct Carried {
    bone: usize,
    jaw: usize,
    /// From the jaw's hinge, metres.
    arm: Vec3,
    gain: Vec3,
}

/// The map from one performer to the character, fixed at calibration.
pub(super) struct Retarget {
    map: Regression,
    slots: Vec<Slot>,
    drivers: Vec<Driver>,
    carried: Vec<Carried>,
    /// Right, left.
    lids: Option<[LidMeasure; 2]>,
    gazes: Option<[GazeMeasure; 2]>,
    displacements: Vec<Vec3>,
}

impl Retarget {
    /// Trains on a performer's neutral points (irises after the points, where the layout has them).
    pub(super) fn new(character: &Character, points: &PointSet, neutral: &[DVec2], ridge: f64) -> Result<Self, SolveError> {
        let sources: Vec<DVec2> = points.centres.iter().map(|&i| neutral[i]).collect();
        let targets: Vec<DVec3> = points.centres.iter().map(|&i| points.model[i]).collect();
        let Ok(map) = Regression::fit(&sources, &targets, ridge) else {
            return Err(SolveError::NoFaceShape { problem: "they lie on one line" });
        };
        let mut slots: Vec<Slot> = Vec::new();
        let mut slots_of = |shares: &[(usize, f32)]| -> Vec<(usize, f32)> {
            shares
                .iter()
                .map(|&(point, share)| {
                    let at = slots.iter().position(|slot| slot.point == point).unwrap_or_else(|| {
                        let p = neutral[point];
                        let others = sources.iter().map(|centre| centre.distance(p)).filter(|distance| *distance > 1e-9);
                        let trusted = TRUSTED_SHAPES * others.fold(f64::INFINITY, f64::min);
                        slots.push(Slot { point, neutral: p, value: map.value(p), slope: map.slope(p), trusted });
                        slots.len() - 1
                    });
                    (at, share)
                })
                .collect()
        };
        let index = |side: Side| usize::from(side == Side::Left);
        let carried: Vec<Carried> = (0..character.num_bones()).filter_map(|bone| Carried::new(character, bone)).collect();
        let is_carried = |bone: usize| carried.iter().any(|carried| carried.bone == bone);
        let mut drivers = Vec::with_capacity(character.num_bones());
        for (i, (bone, shares)) in character.bones.iter().zip(&points.shares).enumerate() {
            let arm = |pivot: Vec3| (bone.rest - pivot).as_dvec3();
            let gain = f64::from(bone.gain.x);
            let arc = |shares, pivot, pitch: [f32; 2], yaw: f32| Driver::Arc {
                shares,
                gain,
                arm: arm(pivot),
                pitch: [f64::from(pitch[0].min(pitch[1])), f64::from(pitch[0].max(pitch[1]))],
                yaw: f64::from(yaw),
            };
            drivers.push(match bone.drive {
                Drive::Skin { .. } => Driver::Skin { shares: slots_of(shares), gain: if is_carried(i) { Vec3::ONE } else { bone.gain } },
                Drive::Jaw { pivot, max_angle, .. } => {
                    Driver::Jaw { shares: slots_of(shares), gain, max_angle: f64::from(max_angle), arm: arm(pivot) }
                }
                Drive::Lid { eye, shut_angle, wide_angle, .. } if points.eye(eye).is_some() => {
                    Driver::Lid { eye: index(eye), shut_angle: f64::from(shut_angle) * gain, wide_angle: f64::from(wide_angle) * gain }
                }
                Drive::Eye { eye, range, .. } if points.irises.is_some() => {
                    Driver::Eye { eye: index(eye), gain, range: range.map(f64::from) }
                }
                Drive::Lid { pivot, shut_angle, wide_angle, .. } if !shares.is_empty() => {
                    arc(slots_of(shares), pivot, [shut_angle, wide_angle], 0.0)
                }
                Drive::Eye { pivot, range, .. } if !shares.is_empty() => arc(slots_of(shares), pivot, [-range[1], range[1]], range[0]),
                Drive::Lid { .. } | Drive::Eye { .. } | Drive::Still => Driver::Still,
            });
        }
        let lids = points.is_ibug.then(|| [RIGHT_EYE, LEFT_EYE].map(|eye| LidMeasure::new(eye, neutral)));
        let gazes = points.irises.map(|_| {
            let irises = [points.len(), points.len() + 1];
            [(RIGHT_EYE, irises[0]), (LEFT_EYE, irises[1])].map(|(eye, iris)| GazeMeasure::new(eye, iris, neutral))
        });
        let displacements = vec![Vec3::ZERO; slots.len()];
        Ok(Self { map, slots, drivers, carried, lids, gazes, displacements })
    }

    /// Writes each bone's motion: a displacement in metres, or pitch and yaw in radians for bones that turn.
    pub(super) fn solve(&mut self, points: &[DVec2], motions: &mut [Vec3]) {
        self.displace(points);
        for (driver, motion) in self.drivers.iter().zip(motions.iter_mut()) {
            *motion = match driver {
                Driver::Skin { shares, gain } => *gain * self.mean(shares),
                Driver::Jaw { shares, gain, max_angle, arm } => {
                    let (pitch, yaw) = hinge(*arm, self.mean(shares).as_dvec3());
                    angles((pitch * gain).clamp(-MOST_JAW_CLOSING, *max_angle), (yaw * gain).clamp(-MOST_JAW_YAW, MOST_JAW_YAW))
                }
                Driver::Lid { eye, shut_angle, wide_angle } => {
                    let openness = self.lids.as_ref().map_or(1.0, |lids| lids[*eye].openness(points));
                    angles(lid_pitch(openness, *shut_angle, *wide_angle), 0.0)
                }
                Driver::Eye { eye, gain, range } => {
                    let (pitch, yaw) = self.gazes.as_ref().map_or((0.0, 0.0), |gazes| gazes[*eye].pitch_yaw(points));
                    angles((pitch * gain).clamp(-range[1], range[1]), (yaw * gain).clamp(-range[0], range[0]))
                }
                Driver::Arc { shares, gain, arm, pitch, yaw } => {
                    let (p, y) = rotation::pitch_yaw_between(*arm, *arm + self.mean(shares).as_dvec3());
                    angles((p * gain).clamp(pitch[0], pitch[1]), (y * gain).clamp(-yaw, *yaw))
                }
                Driver::Still => Vec3::ZERO,
            };
        }
        for carried in &self.carried {
            let by_jaw = travel_of(carried.arm, motions[carried.jaw]);
            let motion = &mut motions[carried.bone];
            *motion = by_jaw + carried.gain * (*motion - by_jaw);
        }
    }

    fn mean(&self, shares: &[(usize, f32)]) -> Vec3 {
        shares.iter().fold(Vec3::ZERO, |sum, &(slot, share)| sum + self.displacements[slot] * share)
    }

    /// `F(p) - F(p_neutral)` for every slot.
    fn displace(&mut self, points: &[DVec2]) {
        for (slot, displacement) in self.slots.iter().zip(&mut self.displacements) {
            let moved = points[slot.point] - slot.neutral;
            let length = moved.length();
            *displacement = if length <= slot.trusted {
                self.map.value(slot.neutral + moved) - slot.value
            } else {
                let within = moved * (slot.trusted / length);
                let beyond = (moved - within).as_vec2();
                self.map.value(slot.neutral + within) - slot.value + slot.slope[0] * beyond.x + slot.slope[1] * beyond.y
            };
        }
    }
}

impl Carried {
    /// Nothing where the jaw does not carry the bone, or its gain changes nothing.
    fn new(character: &Character, index: usize) -> Option<Self> {
        let bone = &character.bones[index];
        let jaw = bone.turns_with?;
        match (&bone.drive, &character.bones[jaw].drive) {
            (Drive::Skin { .. }, Drive::Jaw { pivot, .. }) if bone.gain != Vec3::ONE => {
                Some(Self { bone: index, jaw, arm: bone.rest - *pivot, gain: bone.gain })
            }
            _ => None,
        }
    }
}

fn angles(pitch: f64, yaw: f64) -> Vec3 {
    Vec3::new(pitch as f32, yaw as f32, 0.0)
}

/// Pitch and yaw of a hinge that carry the end of `arm` by `moved` in the plane of the picture. A single camera does not
/// see how far the chin goes back, so the depth follows from the length of the arm.
fn hinge(arm: DVec3, moved: DVec3) -> (f64, f64) {
    // At its full reach down the arm's height says nothing about its angle any more.
    const FULLEST: f64 = 0.995;
    let length = arm.length();
    let (x, y) = (arm.x + moved.x, (arm.y + moved.y).clamp(-FULLEST * length, FULLEST * length));
    let z = (length * length - x * x - y * y).max(0.0).sqrt();
    rotation::pitch_yaw_between(arm, DVec3::new(x, y, z))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn hinge_opens_as_far_as_the_chin_falls() {
        let arm = DVec3::new(0.0, -0.08, 0.08);
        for opening in [0.0, 0.05, 0.2, 0.4] {
            let chin = rotation::rotate(rotation::from_pitch_yaw(opening, 0.0), arm);
            let seen = DVec3::new(0.0, chin.y - arm.y, 0.0);
            let (pitch, yaw) = hinge(arm, seen);
            assert!((pitch - opening).abs() < 1e-9 && yaw.abs() < 1e-12, "{opening}: {pitch} {yaw}");
        }
    }
}
