//! One frame as integer codes, and how codes are written as differences.

use super::PacketError;
use super::layout::{BonePlace, PacketLayout, Slot, Turning};
use super::quantise::{HEAD_MAX, POINT_MAX, POINT_STEP, SmallestThree, head_code, head_value, point_code, unit_code};
use super::range_coder::{Coder, Model};
use crate::face::FaceFrame;
use crate::limits::MAX_BONES;
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
    /// 0 to 255 where wrinkles show, 0 to -255 where the zone is stretched.
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
        let num_zones = layout.num_zones;
        assert_eq!((frame.zones.len(), frame.stretched.len()), (num_zones, num_zones), "zones of a face frame");
        self.face = frame.face;
        self.has_shapes = frame.shapes.is_some();
        for (code, &bone) in self.points.iter_mut().zip(&layout.moving) {
            *code = (frame.points[bone] - layout.rest[bone]).to_array().map(point_code);
        }
        for (code, turning) in self.turns.iter_mut().zip(&layout.turning) {
            *code = Rotation::new(frame.rotations[turning.bone]);
        }
        for (code, slot) in self.influences.iter_mut().zip(&layout.slots) {
            *code = unit_code(frame.influences[slot.pose * n + slot.bones[0]]);
        }
        for ((code, zone), stretched) in self.zones.iter_mut().zip(&frame.zones).zip(&frame.stretched) {
            *code = unit_code(*zone) - unit_code(*stretched);
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
        for (code, &bone) in self.points.iter().zip(&layout.moving) {
            frame.points[bone] = layout.rest[bone] + displacement(code);
        }
        for (code, turning) in self.turns.iter().zip(&layout.turning) {
            frame.rotations[turning.bone] = code.rotation();
            frame.points[turning.bone] = turned(code, turning, layout);
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
        frame.zones.extend(self.zones.iter().map(|code| (*code).max(0) as f32 / 255.0));
        frame.stretched.clear();
        frame.stretched.extend(self.zones.iter().map(|code| (-*code).max(0) as f32 / 255.0));
        frame.shapes = self.has_shapes.then(|| self.shapes.map(|code| code as f32 / 255.0));
        frame.head.rotation = self.head_rotation.rotation();
        frame.head.position = Vec3::from(self.head_position.map(head_value));
    }

    /// Writes these codes as differences from `base`, or reads them: `coder` decides, `models` learn. Codes that leave their
    /// range are an error.
    pub fn transfer(&mut self, base: &Self, models: &mut Models, layout: &PacketLayout, coder: &mut impl Coder) -> Result<(), PacketError> {
        self.transfer_points(base, &mut models.points, layout, coder)?;
        for (code, base) in self.turns.iter_mut().zip(&base.turns) {
            transfer_rotation(code, base, &mut models.turns, &mut models.dropped, coder)?;
        }
        self.transfer_influences(base, &mut models.influences, layout, coder)?;
        for (code, base) in self.zones.iter_mut().zip(&base.zones) {
            transfer_code(code, *base, -255..=255, &mut models.zones, coder)?;
        }
        if self.has_shapes {
            for (code, base) in self.shapes.iter_mut().zip(&base.shapes) {
                transfer_code(code, *base, 0..=255, &mut models.shapes, coder)?;
            }
        } else {
            self.shapes = [0; NUM_ARKIT_SHAPES];
        }
        transfer_rotation(&mut self.head_rotation, &base.head_rotation, &mut models.head_rotation, &mut models.dropped, coder)?;
        for (code, base) in self.head_position.iter_mut().zip(&base.head_position) {
            transfer_code(code, *base, -HEAD_MAX..=HEAD_MAX, &mut models.head_position, coder)?;
        }
        Ok(())
    }

    /// A bone is expected to move with the bones before it and, in z, to slide along the face.
    fn transfer_points(
        &mut self,
        base: &Self,
        axes: &mut [Numbers; 3],
        layout: &PacketLayout,
        coder: &mut impl Coder,
    ) -> Result<(), PacketError> {
        let mut expected = [[0.0f32; MAX_BONES]; 3];
        for i in 0..layout.moving.len() {
            let slope = slope_at(base.points[i], layout.slopes[i]);
            let mut slide = 0.0;
            for axis in 0..3 {
                let field = if axis == 0 { &layout.sideways } else { &layout.upright };
                let from = if axis == 2 { slide } else { 0.0 };
                // The cast saturates; both ends round the same bits.
                let guess = base.points[i][axis].saturating_add((expected[axis][i] + from).round() as i32).clamp(-POINT_MAX, POINT_MAX);
                transfer_code(&mut self.points[i][axis], guess, -POINT_MAX..=POINT_MAX, &mut axes[axis], coder)?;
                let moved = (self.points[i][axis] - base.points[i][axis]) as f32;
                if axis < 2 {
                    slide += slope[axis] * moved;
                }
                field.tell(i, moved - from, &mut expected[axis]);
            }
        }
        Ok(())
    }

    /// Coefficients are expected to be what the bones just sent make them ([D09] 5.1, 5.2), as far as they were that in the base.
    fn transfer_influences(
        &mut self,
        base: &Self,
        numbers: &mut Numbers,
        layout: &PacketLayout,
        coder: &mut impl Coder,
    ) -> Result<(), PacketError> {
        for (i, slot) in layout.slots.iter().enumerate() {
            let off = base.influences[i] - base.projected(slot, layout);
            // One code is rounding, more is another way of evaluating.
            let off = if off.abs() > 1 { off } else { 0 };
            let expected = (self.projected(slot, layout) + off).clamp(0, 255);
            transfer_code(&mut self.influences[i], expected, 0..=255, numbers, coder)?;
        }
        Ok(())
    }

    /// The coefficient that these bones make in `slot`: the mean of their projections on the way to the pose.
    fn projected(&self, slot: &Slot, layout: &PacketLayout) -> i32 {
        let mut sum = 0.0;
        for member in &slot.moved {
            let moved = match member.place {
                BonePlace::Moving(i) => displacement(&self.points[i]),
                BonePlace::Turning(i) => turned(&self.turns[i], &layout.turning[i], layout) - layout.rest[layout.turning[i].bone],
            };
            sum += moved.dot(member.direction).clamp(0.0, 1.0);
        }
        unit_code(sum / slot.moved.len() as f32)
    }
}

/// What is expected of every kind of number in a body.
#[derive(Debug, Clone)]
pub(super) struct Models {
    points: [Numbers; 3],
    turns: [Numbers; 3],
    dropped: Model,
    influences: Numbers,
    zones: Numbers,
    shapes: Numbers,
    head_rotation: [Numbers; 3],
    head_position: Numbers,
}

impl Models {
    /// For differences from rest.
    pub fn for_key() -> Self {
        Self { points: [Numbers::expecting(5); 3], turns: [Numbers::expecting(5), Numbers::rare(), Numbers::rare()], ..Self::for_delta() }
    }

    /// For differences from the frame before, over many frames.
    pub fn for_batch() -> Self {
        Self {
            points: [Numbers::expecting(1); 3],
            turns: [Numbers::expecting(1); 3],
            zones: Numbers::expecting(1),
            shapes: Numbers::expecting(1),
            head_rotation: [Numbers::expecting(2); 3],
            head_position: Numbers::expecting(4),
            ..Self::for_delta()
        }
    }

    /// For differences from a key packet.
    pub fn for_delta() -> Self {
        Self {
            points: [Numbers::expecting(4); 3],
            turns: [Numbers::expecting(4), Numbers::rare(), Numbers::rare()],
            dropped: Model::expecting(DROPPED_IS_SAME),
            influences: Numbers::rare(),
            zones: Numbers::expecting(3),
            shapes: Numbers::expecting(3),
            head_rotation: [Numbers::expecting(5); 3],
            head_position: Numbers::expecting(8),
        }
    }
}

/// A displacement from its codes, metres.
fn displacement(codes: &[i32; 3]) -> Vec3 {
    Vec3::from(codes.map(|code| code as f32 * POINT_STEP))
}

/// The evaluated point of a bone that turns by itself.
fn turned(code: &Rotation, turning: &Turning, layout: &PacketLayout) -> Vec3 {
    let rest = layout.rest[turning.bone];
    // Without a turn it is at rest exactly, which rounding would not quite give.
    if *code == Rotation::IDENTITY { rest } else { turning.pivot + code.rotation() * (rest - turning.pivot) }
}

/// The face's slope at a bone: from the rest positions around it, corrected by where the base has the bone.
fn slope_at(base: [i32; 3], rest: [f32; 2]) -> [f32; 2] {
    // Squared steps: bones nearer to rest than 0.25 mm say little about the slope.
    const DOUBT: f32 = 100.0;
    let [x, y, z] = base.map(|code| code as f32);
    let off = (z - rest[0] * x - rest[1] * y) / (x * x + y * y + DOUBT);
    [rest[0] + off * x, rest[1] + off * y]
}

/// 250 in 256: rotations leave out the same component as in the base, unless they turn by more than 90 degrees.
const DROPPED_IS_SAME: u8 = 250;

fn transfer_rotation(
    code: &mut Rotation,
    base: &Rotation,
    numbers: &mut [Numbers; 3],
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
        transfer_code(&mut code.codes[i], expected, -Rotation::MAX..=Rotation::MAX, &mut numbers[i], coder)?;
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
pub(super) struct Numbers {
    /// Does the length end here? By distance from the mean.
    ends: [Model; 8],
    /// The bit below the first.
    second: Model,
    /// Running mean of lengths, in 1/16.
    mean: i32,
}

impl Numbers {
    /// Numbers of about `length` bits.
    pub fn expecting(length: i32) -> Self {
        // Chance that a length goes on, in 1/256 of ending with a 0; tuned on real feeds.
        const ENDS: [u8; 8] = [20, 30, 50, 90, 120, 140, 170, 200];
        Self { ends: ENDS.map(Model::expecting), second: Model::expecting(140), mean: length * 16 }
    }

    /// Numbers that are mostly 0.
    fn rare() -> Self {
        Self { ends: [Model::expecting(225); 8], second: Model::expecting(140), mean: 0 }
    }

    /// Writes `value`, at most 17 bits of magnitude, or reads one and returns it.
    pub fn transfer(&mut self, value: i32, coder: &mut impl Coder) -> i32 {
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
