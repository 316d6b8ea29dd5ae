//! One frame as integer codes, and how codes are written as differences.

use super::PacketError;
use super::layout::PacketLayout;
use super::quantise::{HEAD_MAX, POINT_MAX, POINT_STEP, SmallestThree, head_code, head_value, point_code, unit_code};
use super::range_coder::{Coder, Model};
use crate::face::FaceFrame;
use crate::names::NUM_ARKIT_SHAPES;
use glam::Vec3;

/// Bits a component of a bone's rotation and of the head's.
const ROTATION_BITS: u32 = 12;

type Rotation = SmallestThree<ROTATION_BITS>;

/// A frame as integer codes, in the order in which packets carry them.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Codes {
    pub face: bool,
    pub has_shapes: bool,
    /// Displacement from rest of each bone that does not turn by itself, steps of 25 µm.
    points: Vec<[i32; 3]>,
    /// Rotation of each bone that turns by itself.
    turns: Vec<Rotation>,
    /// One coefficient a slot of the layout, 0 to 255.
    influences: Vec<i32>,
    /// 0 to 255.
    zones: Vec<i32>,
    /// 0 to 255; all 0 without shapes.
    shapes: [i32; NUM_ARKIT_SHAPES],
    head_rotation: Rotation,
    head_position: [i32; 3],
}

impl Codes {
    /// The codes of the character at rest, against which key packets are written.
    pub fn at_rest(layout: &PacketLayout) -> Self {
        Self {
            face: true,
            has_shapes: false,
            points: vec![[0; 3]; layout.moving.len()],
            turns: vec![Rotation::IDENTITY; layout.turning.len()],
            influences: vec![0; layout.slots.len()],
            zones: vec![0; layout.num_zones],
            shapes: [0; NUM_ARKIT_SHAPES],
            head_rotation: Rotation::IDENTITY,
            head_position: [0; 3],
        }
    }

    /// Takes over the values of `other`, which is of the same layout, without allocating.
    pub fn copy_from(&mut self, other: &Self) {
        self.face = other.face;
        self.has_shapes = other.has_shapes;
        self.points.copy_from_slice(&other.points);
        self.turns.copy_from_slice(&other.turns);
        self.influences.copy_from_slice(&other.influences);
        self.zones.copy_from_slice(&other.zones);
        self.shapes = other.shapes;
        self.head_rotation = other.head_rotation;
        self.head_position = other.head_position;
    }

    /// Quantises `frame`. Panics where its arrays are not of the layout's lengths, which is the solve's mistake.
    pub fn quantise(&mut self, frame: &FaceFrame, layout: &PacketLayout) {
        let n = layout.rest.len();
        assert_eq!((frame.points.len(), frame.rotations.len()), (n, n), "points and rotations of a face frame");
        assert_eq!(frame.influences.len(), layout.num_poses * n, "influences of a face frame");
        self.face = frame.face;
        self.has_shapes = frame.shapes.is_some();
        for (code, moving) in self.points.iter_mut().zip(&layout.moving) {
            *code = (frame.points[moving.bone] - layout.rest[moving.bone]).to_array().map(point_code);
        }
        for (code, turning) in self.turns.iter_mut().zip(&layout.turning) {
            *code = Rotation::new(frame.rotations[turning.bone]);
        }
        for (code, slot) in self.influences.iter_mut().zip(&layout.slots) {
            *code = unit_code(frame.influences[slot.pose * n + slot.bones[0]]);
        }
        for (code, zone) in self.zones.iter_mut().zip(&frame.zones) {
            *code = unit_code(*zone);
        }
        self.shapes = frame.shapes.map_or([0; NUM_ARKIT_SHAPES], |shapes| shapes.map(unit_code));
        self.head_rotation = Rotation::new(frame.head.rotation);
        self.head_position = frame.head.position.to_array().map(head_code);
    }

    /// Writes the values into `frame`, whose buffers are brought to the layout's lengths.
    pub fn restore(&self, frame: &mut FaceFrame, layout: &PacketLayout) {
        let n = layout.rest.len();
        frame.face = self.face;
        frame.points.resize(n, Vec3::ZERO);
        frame.rotations.clear();
        frame.rotations.resize(n, glam::Quat::IDENTITY);
        frame.influences.clear();
        frame.influences.resize(layout.num_poses * n, 0.0);
        for (code, moving) in self.points.iter().zip(&layout.moving) {
            frame.points[moving.bone] = layout.rest[moving.bone] + Vec3::from(code.map(|code| code as f32 * POINT_STEP));
        }
        for (code, turning) in self.turns.iter().zip(&layout.turning) {
            let rotation = code.rotation();
            frame.rotations[turning.bone] = rotation;
            let rest = layout.rest[turning.bone];
            // Without a turn it is at rest exactly, which rounding would not quite give.
            frame.points[turning.bone] = if *code == Rotation::IDENTITY { rest } else { turning.pivot + rotation * (rest - turning.pivot) };
        }
        for &(bone, leader) in &layout.followers {
            frame.rotations[bone] = frame.rotations[leader];
        }
        for (code, slot) in self.influences.iter().zip(&layout.slots) {
            for bone in &slot.bones {
                frame.influences[slot.pose * n + bone] = *code as f32 / 255.0;
            }
        }
        frame.zones.clear();
        frame.zones.extend(self.zones.iter().map(|code| *code as f32 / 255.0));
        frame.shapes = self.has_shapes.then(|| self.shapes.map(|code| code as f32 / 255.0));
        frame.head.rotation = self.head_rotation.rotation();
        frame.head.position = Vec3::from(self.head_position.map(head_value));
    }

    /// Writes these codes as differences from `base`, or reads them: `coder` decides. `is_key` says that `base` is rest.
    /// Codes that leave their range are an error.
    pub fn transfer(&mut self, base: &Self, is_key: bool, layout: &PacketLayout, coder: &mut impl Coder) -> Result<(), PacketError> {
        self.transfer_points(base, is_key, layout, coder)?;
        let mut turns = Numbers::expecting(if is_key { 4 } else { 3 });
        let mut dropped = Model::expecting(DROPPED_IS_SAME);
        for (code, base) in self.turns.iter_mut().zip(&base.turns) {
            transfer_rotation(code, base, &mut turns, &mut dropped, coder)?;
        }
        let mut influences = Numbers::expecting(if is_key { 3 } else { 2 });
        for (code, base) in self.influences.iter_mut().zip(&base.influences) {
            transfer_code(code, *base, 0..=255, &mut influences, coder)?;
        }
        let mut zones = Numbers::expecting(3);
        for (code, base) in self.zones.iter_mut().zip(&base.zones) {
            transfer_code(code, *base, 0..=255, &mut zones, coder)?;
        }
        if self.has_shapes {
            let mut shapes = Numbers::expecting(3);
            for (code, base) in self.shapes.iter_mut().zip(&base.shapes) {
                transfer_code(code, *base, 0..=255, &mut shapes, coder)?;
            }
        } else {
            self.shapes = [0; NUM_ARKIT_SHAPES];
        }
        let mut head = Numbers::expecting(5);
        transfer_rotation(&mut self.head_rotation, &base.head_rotation, &mut head, &mut dropped, coder)?;
        let mut head = Numbers::expecting(8);
        for (code, base) in self.head_position.iter_mut().zip(&base.head_position) {
            transfer_code(code, *base, -HEAD_MAX..=HEAD_MAX, &mut head, coder)?;
        }
        Ok(())
    }

    /// Bones move with their neighbours: a bone's difference is expected to be that of the nearest bone before it.
    fn transfer_points(&mut self, base: &Self, is_key: bool, layout: &PacketLayout, coder: &mut impl Coder) -> Result<(), PacketError> {
        let mut axes = [Numbers::expecting(if is_key { 5 } else { 4 }); 3];
        for (i, moving) in layout.moving.iter().enumerate() {
            for axis in 0..3 {
                let neighbour = match moving.neighbour {
                    None => 0,
                    Some(neighbour) => {
                        let difference = self.points[neighbour.moving][axis] - base.points[neighbour.moving][axis];
                        if neighbour.is_mirrored && axis == 0 { -difference } else { difference }
                    }
                };
                let expected = (base.points[i][axis] + neighbour * 3 / 4).clamp(-POINT_MAX, POINT_MAX);
                transfer_code(&mut self.points[i][axis], expected, -POINT_MAX..=POINT_MAX, &mut axes[axis], coder)?;
            }
        }
        Ok(())
    }
}

/// 250 in 256: rotations leave out the same component as in the base, unless they turn by more than 90 degrees.
const DROPPED_IS_SAME: u8 = 250;

fn transfer_rotation(
    code: &mut Rotation,
    base: &Rotation,
    numbers: &mut Numbers,
    dropped: &mut Model,
    coder: &mut impl Coder,
) -> Result<(), PacketError> {
    let is_same = !coder.bit(code.dropped != base.dropped, dropped);
    if is_same {
        code.dropped = base.dropped;
    } else {
        let high = coder.even_bit(code.dropped & 2 != 0);
        let low = coder.even_bit(code.dropped & 1 != 0);
        code.dropped = u8::from(high) * 2 + u8::from(low);
    }
    for i in 0..3 {
        // Where another component is left out, the base says nothing.
        let expected = if is_same { base.codes[i] } else { 0 };
        transfer_code(&mut code.codes[i], expected, -Rotation::MAX..=Rotation::MAX, numbers, coder)?;
    }
    Ok(())
}

fn transfer_code(
    code: &mut i32,
    expected: i32,
    range: std::ops::RangeInclusive<i32>,
    numbers: &mut Numbers,
    coder: &mut impl Coder,
) -> Result<(), PacketError> {
    *code = expected + numbers.transfer(*code - expected, coder);
    if range.contains(code) { Ok(()) } else { Err(PacketError::Broken("a code is out of its range")) }
}

/// Bit lengths of numbers, 0 to 17: the farthest apart two codes can be is 65,534.
const MAX_LENGTH: i32 = 17;

/// Signed numbers that are about as long as those before them.
///
/// A number is its bit length in unary, its bits below the first, and its sign. The model of each unary bit depends on how
/// far it is from the running mean of lengths, not on the length itself, so that few bits teach it.
#[derive(Debug, Clone, Copy)]
struct Numbers {
    /// Does the length end here? By distance from the mean.
    ends: [Model; 8],
    /// The bit below the first.
    second: Model,
    /// Running mean of lengths, in 1/16.
    mean: i32,
}

impl Numbers {
    /// Numbers of about `length` bits.
    fn expecting(length: i32) -> Self {
        // Chance that a length goes on, in 1/256 of ending with a 0; tuned on real feeds.
        const ENDS: [u8; 8] = [20, 30, 50, 90, 120, 140, 170, 200];
        Self { ends: ENDS.map(Model::expecting), second: Model::expecting(140), mean: length * 16 }
    }

    fn transfer(&mut self, value: i32, coder: &mut impl Coder) -> i32 {
        let magnitude = value.unsigned_abs();
        let wanted = 32 - magnitude.leading_zeros() as i32;
        let mean = (self.mean + 8) >> 4;
        let mut length = 0;
        while length < MAX_LENGTH {
            let distance = (length - mean + 4).clamp(0, 7) as usize;
            if !coder.bit(length < wanted, &mut self.ends[distance]) {
                break;
            }
            length += 1;
        }
        self.mean += ((length << 4) - self.mean) / 4;
        if length == 0 {
            return 0;
        }
        let mut read = 1;
        for at in (0..length - 1).rev() {
            let bit = magnitude >> at & 1 != 0;
            let bit = if at == length - 2 { coder.bit(bit, &mut self.second) } else { coder.even_bit(bit) };
            read = read << 1 | i32::from(bit);
        }
        if coder.even_bit(value < 0) { -read } else { read }
    }
}
