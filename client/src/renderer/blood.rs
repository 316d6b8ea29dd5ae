//! Blood that follows the face: mixed on the processor where the face changes, read by the skin's shader as one small map.

use super::coefficients::moves_bone;
use super::frame::RenderFrame;
use crate::asset::{BloodMaps, BloodTexel};
use rhytid_shared::Character;
use rhytid_shared::character::{ColourDriver, Side};
use rhytid_shared::limits::{MAX_POSES, MAX_ZONES};

/// Largest change the codes of the map reach, optical density: twice what a strong flush or a pressed finger does.
pub const RANGE: f32 = 0.5;
pub const FORMAT: wgpu::TextureFormat = wgpu::TextureFormat::R8Unorm;
/// The code of no change.
pub const UNCHANGED: u8 = 128;
/// Amounts that differ by less than this give the same map, or nearly.
const LEAST_DIFFERENCE: f32 = 1.0 / 1024.0;
/// Bones nearer to the middle than this, metres, belong to both halves.
const MIDDLE: f32 = 0.002;

/// How much a change shows on the left and on the right half.
pub type Amount = [f32; 2];

/// The map of a frame.
#[derive(Debug)]
pub struct Blood {
    maps: BloodMaps,
    /// For each change.
    drivers: Vec<Driver>,
    amounts: Vec<Amount>,
    codes: Vec<u8>,
}

/// What a change follows.
#[derive(Debug)]
enum Driver {
    /// The pose, and the bones it moves on the left and on the right half.
    Pose(usize, [Vec<usize>; 2]),
    /// The zone, and how much of it counts on the left and on the right half.
    Zone(usize, [f32; 2]),
}

/// At most one change a pose and one a zone, as the checks have it.
const MAX_CHANGES: usize = MAX_POSES + MAX_ZONES;

/// Amount of haemoglobin with the changes `(amount, spread, shift)`: `clamp(H0 + sum a ((s - 1)(H0 - mu0) + b), 0, most)`, where
/// `spread` is `s - 1`.
pub fn mixed(at_rest: &BloodTexel, changes: impl Iterator<Item = (f32, f32, f32)>, most: f32) -> f32 {
    let uneven = at_rest.amount - at_rest.mean;
    changes.fold(at_rest.amount, |sum, (amount, spread, shift)| sum + amount * (spread * uneven + shift)).clamp(0.0, most)
}

impl Blood {
    pub fn new(character: &Character, maps: &BloodMaps) -> Self {
        let middle = 0.5 * (character.ibug68[36].x + character.ibug68[45].x);
        let of_pose = |pose: usize| {
            let moved = (0..character.num_bones()).filter(|&i| moves_bone(character, pose, i));
            let moved: Vec<(usize, f32)> = moved.map(|i| (i, character.bones[i].rest.x - middle)).collect();
            let on_side = |sign: f32| moved.iter().filter(|(_, x)| x * sign > -MIDDLE).map(|&(i, _)| i).collect();
            Driver::Pose(pose, [on_side(1.0), on_side(-1.0)])
        };
        let of_zone = |zone: usize| {
            let side = character.zones.as_ref().and_then(|zones| zones.list.get(zone)?.side);
            Driver::Zone(zone, [Side::Left, Side::Right].map(|half| f32::from(u8::from(side.is_none_or(|side| side == half)))))
        };
        let drivers = maps.changes.iter().map(|change| match change.driver {
            ColourDriver::Pose(pose) => of_pose(pose),
            ColourDriver::Zone(zone) => of_zone(zone),
        });
        Self {
            drivers: drivers.collect(),
            amounts: vec![[0.0; 2]; maps.changes.len()],
            codes: vec![UNCHANGED; maps.base.len()],
            maps: maps.clone(),
        }
    }

    /// What the file multiplies changes by.
    pub fn strength(&self) -> f32 {
        self.maps.strength
    }

    /// Codes of the map as it is.
    pub fn codes(&self) -> &[u8] {
        &self.codes
    }

    /// How much each change shows: the mean influence of its pose over the bones it moves on that half, or its zone's weight.
    pub fn amounts(&self, frame: &RenderFrame) -> Vec<Amount> {
        let num_bones = frame.points.len();
        let mean = |pose: usize, bones: &[usize]| {
            let sum: f32 = bones.iter().map(|&bone| frame.influences[pose * num_bones + bone].clamp(0.0, 1.0)).sum();
            sum / bones.len().max(1) as f32
        };
        let amount = |driver: &Driver| match driver {
            Driver::Pose(pose, sides) => sides.each_ref().map(|bones| mean(*pose, bones)),
            Driver::Zone(zone, halves) => halves.map(|share| share * frame.zones[*zone].clamp(0.0, 1.0)),
        };
        self.drivers.iter().map(amount).collect()
    }

    /// Mixes the map of a frame; true where it is another than before.
    pub fn mix(&mut self, frame: &RenderFrame) -> bool {
        let amounts = self.amounts(frame);
        let is_near = |(a, b): (&Amount, &Amount)| (0..2).all(|side| (a[side] - b[side]).abs() < LEAST_DIFFERENCE);
        if amounts.iter().zip(&self.amounts).all(is_near) {
            return false;
        }
        let most = self.maps.most;
        let mut shown = [(0, [0.0; 2]); MAX_CHANGES];
        let mut num_shown = 0;
        for (c, &amount) in amounts.iter().enumerate().filter(|(_, amount)| **amount != [0.0; 2]).take(MAX_CHANGES) {
            shown[num_shown] = (c, amount);
            num_shown += 1;
        }
        for (t, (code, at_rest)) in self.codes.iter_mut().zip(&self.maps.base).enumerate() {
            let changes = shown[..num_shown].iter().map(|&(c, [left, right])| {
                let [spread, shift] = self.maps.changes[c].texels[t];
                (right + (left - right) * at_rest.left, spread, shift)
            });
            let change = mixed(at_rest, changes, most) - at_rest.amount;
            *code = (change.clamp(-RANGE, RANGE) / RANGE * 127.0 + f32::from(UNCHANGED) + 0.5) as u8;
        }
        self.amounts = amounts;
        true
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::CharacterAsset;
    use crate::asset::BloodChange;
    use rhytid_shared::DEFAULT_CHARACTER_GLB;

    #[test]
    fn mixed_matches_the_worked_numbers_and_never_leaves_its_range() {
        let place = BloodTexel { amount: 0.5, mean: 0.45, left: 1.0 };
        let of = |amount: f32, shift: f32| mixed(&place, [(amount, 0.2, shift)].into_iter(), 1.0);
        assert!((of(1.0, 0.08) - 0.59).abs() < 1e-6 && (of(0.5, 0.08) - 0.545).abs() < 1e-6);
        assert_eq!((of(0.0, 0.08), of(1.0, -0.9), of(1.0, 0.9)), (0.5, 0.0, 1.0));
    }

    /// A map of one texel on each half, flushed by one pose or zone.
    fn blood(character: &Character, driver: ColourDriver) -> Blood {
        let place = |left| BloodTexel { amount: 0.5, mean: 0.5, left };
        let change = BloodChange { driver, texels: vec![[0.0, 0.25]; 4] };
        let base = vec![place(1.0), place(0.0), place(0.5), place(0.5)];
        Blood::new(character, &BloodMaps { side: 2, base, changes: vec![change], most: 2.0, strength: 1.0 })
    }

    #[test]
    fn each_half_flushes_by_its_own_bones() {
        let character = CharacterAsset::from_glb(DEFAULT_CHARACTER_GLB).expect("whole").character;
        let mut blood = blood(&character, ColourDriver::Pose(0));
        let mut frame = RenderFrame::at_rest(&character);
        assert!(!blood.mix(&frame), "at rest nothing changes");
        for i in 0..character.num_bones() {
            frame.influences[i] = f32::from(u8::from(character.bones[i].rest.x > MIDDLE && moves_bone(&character, 0, i)));
        }
        let [left, right] = blood.amounts(&frame)[0];
        assert!(left > 0.6 && right < 0.1, "{left} {right}");
        assert!(blood.mix(&frame) && !blood.mix(&frame), "the same frame is mixed once");
        let [on_left, on_right, ..] = blood.codes() else { panic!("four texels") };
        assert!(*on_left > 160 && (127..=132).contains(on_right), "{on_left} {on_right}");
        assert!(blood.mix(&RenderFrame::at_rest(&character)));
        assert_eq!(blood.codes(), [UNCHANGED; 4]);
    }

    #[test]
    fn zones_flush_their_half_where_there_are_no_poses() {
        let mut character = Character::from_glb(DEFAULT_CHARACTER_GLB).expect("whole");
        character.poses.clear();
        let zones = character.zones.as_ref().expect("it has zones");
        let zone_of = |side| zones.list.iter().position(|zone| zone.side == side).expect("one on each side and one between");
        let cases = [Some(Side::Left), Some(Side::Right), None].map(zone_of);
        let mut flushed = Vec::new();
        for zone in cases {
            let mut blood = blood(&character, ColourDriver::Zone(zone));
            let mut frame = RenderFrame::at_rest(&character);
            assert!(!blood.mix(&frame));
            frame.zones[zone] = 1.0;
            assert!(blood.mix(&frame));
            flushed.push([blood.codes()[0] > 160, blood.codes()[1] > 160]);
        }
        assert_eq!(flushed, [[true, false], [false, true], [true, true]]);
    }
}
