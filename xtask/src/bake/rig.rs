//! Bones of the face: where they stand, what drives them, how far they reach.

use super::bust::Eyeball;
use glam::Vec3;
use rhytid_shared::character::schema::{Bone, Drive, LidKind, Side};
use rhytid_shared::layout::NUM_IBUG;

/// Which parts of the skin a bone may move.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Zone {
    /// Everything but lids and lips' inner side.
    Open,
    /// Not the lower lip.
    UpperLip,
    /// Not the upper lip.
    LowerLip,
}

/// A bone that translates with the skin. `left` entries also exist mirrored for the right.
struct SkinBone {
    name: &'static str,
    has_sides: bool,
    /// Where it stands: landmarks and shares, for the left side...
    at: &'static [(usize, f32)],
    /// ...moved by this much, metres (x is outwards), then snapped onto the skin.
    offset: Vec3,
    /// Landmarks whose displacement it follows, and with what share.
    follows: &'static [(usize, f32)],
    /// Distance along the skin at which its influence ends, metres.
    reach: f32,
    /// Where else the muscles it stands for pull the skin.
    echoes: &'static [Pull],
    zone: Zone,
    turns_with_jaw: bool,
    gain: [f32; 3],
}

/// A place away from the bone that its muscle moves too: furrows of the forehead lie well above the brows.
struct Pull {
    /// From the bone, metres, left side; snapped onto the skin.
    offset: Vec3,
    /// Influence there.
    strength: f32,
    /// As for the bone.
    reach: f32,
}

const fn pull(x_mm: f32, y_mm: f32, strength: f32, reach_mm: f32) -> Pull {
    Pull { offset: Vec3::new(x_mm * 1e-3, y_mm * 1e-3, 0.0), strength, reach: reach_mm * 1e-3 }
}

const fn also(bone: SkinBone, echoes: &'static [Pull]) -> SkinBone {
    SkinBone { echoes, ..bone }
}

const fn bone(name: &'static str, at: &'static [(usize, f32)], follows: &'static [(usize, f32)], reach: f32) -> SkinBone {
    SkinBone {
        name,
        has_sides: true,
        at,
        offset: Vec3::ZERO,
        follows,
        reach,
        echoes: &[],
        zone: Zone::Open,
        turns_with_jaw: false,
        gain: [1.0; 3],
    }
}

const fn upper_lip(bone: SkinBone) -> SkinBone {
    SkinBone { zone: Zone::UpperLip, ..bone }
}

const fn lower_lip(bone: SkinBone) -> SkinBone {
    SkinBone { zone: Zone::LowerLip, turns_with_jaw: true, ..bone }
}

const fn stronger(bone: SkinBone, gain: [f32; 3]) -> SkinBone {
    SkinBone { gain, ..bone }
}

const fn midline(bone: SkinBone) -> SkinBone {
    SkinBone { has_sides: false, ..bone }
}

const fn moved(bone: SkinBone, x: f32, y: f32, z: f32) -> SkinBone {
    SkinBone { offset: Vec3::new(x, y, z), ..bone }
}

/// Trackers hardly see a smile of ours that is as wide as the performer's: MakeHuman's lips are fuller than most. Found by
/// measuring a tracker's readings of renders against its readings of performers.
const CORNER_GAIN: [f32; 3] = [1.7, 1.8, 1.3];
const UPPER_LIP_GAIN: [f32; 3] = [1.2, 1.8, 1.0];
/// Of what the lower lip does beyond the jaw.
const LOWER_LIP_GAIN: [f32; 3] = [1.1, 1.6, 1.0];
const BROW_GAIN: [f32; 3] = [1.2, 1.4, 1.0];

/// The forehead's muscle draws the skin up to the hair line.
const FRONTALIS: &[Pull] = &[pull(0.0, 20.0, 0.80, 34.0), pull(0.0, 38.0, 0.55, 34.0)];
/// The ring muscle of the eye lifts the cheek and folds the skin beside the outer corner.
const CROWS_FEET: &[Pull] = &[pull(21.0, 20.0, 0.75, 34.0)];

const SKIN_BONES: [SkinBone; 16] = [
    also(stronger(bone("brow_inner", &[(22, 0.7), (23, 0.3)], &[(22, 0.7), (23, 0.3)], 0.052), BROW_GAIN), FRONTALIS),
    also(stronger(bone("brow_mid", &[(23, 0.5), (24, 0.5)], &[(23, 0.5), (24, 0.5)], 0.050), BROW_GAIN), FRONTALIS),
    also(stronger(bone("brow_outer", &[(24, 0.35), (25, 0.65)], &[(24, 0.35), (25, 0.65)], 0.048), BROW_GAIN), FRONTALIS),
    bone("brow_tail", &[(26, 1.0)], &[(25, 0.2), (26, 0.8)], 0.042),
    also(moved(bone("cheek", &[(46, 0.6), (47, 0.4)], &[(54, 0.35), (46, 0.25), (55, 0.1)], 0.040), 0.006, -0.024, 0.0), CROWS_FEET),
    moved(bone("nasolabial", &[(35, 0.5), (54, 0.5)], &[(54, 0.5), (35, 0.3)], 0.032), 0.010, 0.002, 0.0),
    also(bone("nose_wing", &[(35, 1.0)], &[(35, 0.8), (34, 0.2)], 0.024), &[pull(-5.0, 15.0, 1.0, 24.0), pull(-6.0, 28.0, 0.8, 22.0)]),
    stronger(midline(upper_lip(bone("lip_upper_mid", &[(51, 1.0)], &[(51, 0.85), (62, 0.15)], 0.026))), UPPER_LIP_GAIN),
    stronger(upper_lip(bone("lip_upper", &[(52, 1.0)], &[(52, 0.85), (63, 0.15)], 0.025)), UPPER_LIP_GAIN),
    stronger(upper_lip(bone("lip_upper_outer", &[(53, 1.0)], &[(53, 0.7), (63, 0.15), (54, 0.15)], 0.025)), UPPER_LIP_GAIN),
    stronger(bone("lip_corner", &[(54, 1.0)], &[(54, 0.8), (64, 0.2)], 0.034), CORNER_GAIN),
    stronger(lower_lip(bone("lip_lower_outer", &[(55, 1.0)], &[(55, 0.7), (65, 0.15), (54, 0.15)], 0.025)), LOWER_LIP_GAIN),
    stronger(lower_lip(bone("lip_lower", &[(56, 1.0)], &[(56, 0.85), (65, 0.15)], 0.025)), LOWER_LIP_GAIN),
    stronger(midline(lower_lip(bone("lip_lower_mid", &[(57, 1.0)], &[(57, 0.85), (66, 0.15)], 0.026))), LOWER_LIP_GAIN),
    midline(SkinBone {
        turns_with_jaw: true,
        zone: Zone::LowerLip,
        ..moved(bone("chin", &[(8, 1.0)], &[(8, 0.6), (7, 0.2), (9, 0.2)], 0.034), 0.0, 0.012, 0.0)
    }),
    also(
        stronger(midline(bone("glabella", &[(21, 0.5), (22, 0.5)], &[(21, 0.5), (22, 0.5)], 0.024)), BROW_GAIN),
        &[pull(0.0, 22.0, 0.8, 30.0), pull(0.0, -14.0, 0.6, 18.0)],
    ),
];

/// Joints that carry no bone of the extension, in front of all others.
pub const ROOT: u8 = 0;
pub const NECK: u8 = 1;
pub const HEAD: u8 = 2;
const NUM_BODY_JOINTS: u8 = 3;

/// A joint node.
pub struct Joint {
    /// Node name.
    pub name: String,
    /// Origin, head space.
    pub position: Vec3,
    /// Index of the parent joint.
    pub parent: Option<u8>,
}

/// A bone's reach over the skin.
pub struct Reach {
    /// Its joint.
    pub joint: u8,
    /// Vertex of the skin it stands on.
    pub vertex: u32,
    /// Metres along the skin.
    pub reach: f32,
    /// Vertices its muscle moves too: `(vertex, strength, metres along the skin)`.
    pub echoes: Vec<(u32, f32, f32)>,
    /// What it may move.
    pub zone: Zone,
}

/// The finished rig.
pub struct Rig {
    /// Joints in the order of the skin.
    pub joints: Vec<Joint>,
    /// Bones of the extension.
    pub bones: Vec<Bone>,
    /// Skin bones' reaches.
    pub reaches: Vec<Reach>,
    /// Groups of bones whose influences are averaged.
    pub groups: Vec<Vec<String>>,
}

/// What the rig is built on.
pub struct Places<'a> {
    /// Landmarks on the neutral.
    pub ibug68: &'a [Vec3; NUM_IBUG],
    /// Left and right eye.
    pub eyes: [Eyeball; 2],
    /// Hinge of the jaw.
    pub jaw_pivot: Vec3,
    /// Upper end of the neck: the head turns about it.
    pub head_pivot: Vec3,
    /// Lower end of the neck.
    pub neck_pivot: Vec3,
    /// Angles about +X that shut and that widen the upper and the lower lid, degrees: `[upper, lower][shut, wide]`.
    pub lid_degrees: [[f32; 2]; 2],
    /// Points on the lids' margins: `[left, right][upper, lower]`.
    pub lid_points: [[Vec3; 2]; 2],
}

const SIDES: [(&str, Side); 2] = [("_l", Side::Left), ("_r", Side::Right)];

impl Rig {
    /// Builds the rig. `on_skin` finds the skin's vertex nearest to a point and where it lies.
    pub fn new(places: &Places<'_>, on_skin: impl Fn(Vec3) -> (u32, Vec3)) -> Self {
        let joint = |name: &str, position, parent| Joint { name: name.to_owned(), position, parent };
        let mut rig = Self {
            joints: vec![
                joint("root", Vec3::new(0.0, places.neck_pivot.y - 0.05, places.neck_pivot.z), None),
                joint("neck", places.neck_pivot, Some(ROOT)),
                joint("head", places.head_pivot, Some(NECK)),
            ],
            bones: Vec::new(),
            reaches: Vec::new(),
            groups: Vec::new(),
        };
        for spec in &SKIN_BONES {
            let sides: &[usize] = if spec.has_sides { &[0, 1] } else { &[0] };
            for &side in sides {
                rig.add_skin_bone(spec, side, places, &on_skin);
            }
        }
        rig.add_turning_bones(places, &on_skin);
        for (suffix, _) in SIDES {
            rig.groups.push(["brow_mid", "brow_outer"].map(|name| format!("{name}{suffix}")).to_vec());
        }
        rig
    }

    fn add_skin_bone(&mut self, spec: &SkinBone, side: usize, places: &Places<'_>, on_skin: &impl Fn(Vec3) -> (u32, Vec3)) {
        let of_side = |landmark: usize| if side == 0 { landmark } else { super::landmarks::mirror(landmark) };
        let sign = if side == 0 { 1.0 } else { -1.0 };
        let at: Vec3 = spec.at.iter().map(|&(landmark, share)| places.ibug68[of_side(landmark)] * share).sum();
        let (vertex, point) = on_skin(at + spec.offset * Vec3::new(sign, 1.0, 1.0));
        let name = if spec.has_sides { format!("{}{}", spec.name, SIDES[side].0) } else { spec.name.to_owned() };
        let echoes = spec.echoes.iter().map(|pull| (on_skin(point + pull.offset * Vec3::new(sign, 1.0, 1.0)).0, pull.strength, pull.reach));
        self.reaches.push(Reach { joint: self.num_joints(), vertex, reach: spec.reach, echoes: echoes.collect(), zone: spec.zone });
        let landmarks = spec.follows.iter().map(|&(landmark, share)| (of_side(landmark), share)).collect();
        let turns_with = spec.turns_with_jaw.then(|| "jaw".to_owned());
        self.add(name, point, point, Drive::Skin { landmarks }, spec.gain, turns_with);
    }

    fn add_turning_bones(&mut self, places: &Places<'_>, on_skin: &impl Fn(Vec3) -> (u32, Vec3)) {
        for (s, (suffix, eye)) in SIDES.into_iter().enumerate() {
            let centre = places.eyes[s].centre;
            for (k, (name, lid)) in [("lid_upper", LidKind::Upper), ("lid_lower", LidKind::Lower)].into_iter().enumerate() {
                let [shut_degrees, wide_degrees] = places.lid_degrees[k];
                let drive = Drive::Lid { eye, lid, pivot: centre.into(), shut_degrees, wide_degrees };
                self.add(format!("{name}{suffix}"), centre, places.lid_points[s][k], drive, [1.0; 3], None);
            }
            let drive = Drive::Eye { eye, pivot: centre.into(), range_degrees: EYE_RANGE_DEGREES };
            let front = centre + Vec3::Z * places.eyes[s].radius;
            self.add(format!("eye{suffix}"), centre, front, drive, [1.0; 3], None);
        }
        let landmarks = vec![(8, 0.6), (7, 0.2), (9, 0.2)];
        let drive = Drive::Jaw { pivot: places.jaw_pivot.into(), landmarks, max_degrees: JAW_MAX_DEGREES };
        let (_, chin) = on_skin(places.ibug68[8]);
        self.add("jaw".to_owned(), places.jaw_pivot, chin, drive, [1.0; 3], None);
    }

    fn add(&mut self, name: String, joint_at: Vec3, point: Vec3, drive: Drive, gain: [f32; 3], turns_with: Option<String>) {
        self.joints.push(Joint { name: name.clone(), position: joint_at, parent: Some(HEAD) });
        self.bones.push(Bone { name, joint: None, point: point.into(), drive, gain, turns_with });
    }

    fn num_joints(&self) -> u8 {
        self.joints.len() as u8
    }

    /// Joint of the bone called `name`.
    pub fn joint_of(&self, name: &str) -> u8 {
        let bone = self.bones.iter().position(|bone| bone.name == name).expect("the bake asks for bones it made");
        NUM_BODY_JOINTS + bone as u8
    }
}

/// Gaze at ARKit's full weight and a little more, to the side and up or down.
const EYE_RANGE_DEGREES: [f32; 2] = [26.0, 20.0];
/// A jaw opens by 20.7 degrees in the shape `jawOpen`; a yawn by more.
const JAW_MAX_DEGREES: f32 = 27.0;
