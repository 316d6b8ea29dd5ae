//! Several sources on one face: each channel group is driven by the live source of the highest priority, hand-overs are
//! eased, and influences and zones are evaluated anew from the merged bones. No clock: the caller says what time it is.
//!
//! One source *leads*: each of its frames gives one merged frame, with its time; what the others sent last is merged in. A lead
//! that pauses for longer than [`PACE`] loses the lead to another source, and a source of a higher priority takes it once it has
//! been steady for [`LIVE`]. Another lead has another clock, so it begins another session. A source alone passes as it is, bit
//! for bit.

use super::evaluate::Evaluator;
use super::zones::ZoneRig;
use glam::Quat;
use rhytid_shared::character::Drive;
use rhytid_shared::limits::MAX_EXPRESSIONS;
use rhytid_shared::{ARKIT_NAMES, ChannelGroup, ChannelGroups, Character, FaceFrame, NUM_ARKIT_SHAPES, Slot};
use std::sync::Arc;

/// A source that has shown no face for this long, seconds, drives nothing while another one can.
pub const LIVE: f64 = 0.5;
/// A lead without a frame for this long, seconds, loses the lead: before viewers let the face sink to rest.
pub const PACE: f64 = 0.2;
/// A hand-over takes this long, seconds.
pub const HAND_OVER: f64 = 0.3;

/// A source and what it sent last.
struct Source {
    /// Grows with each arrival.
    id: u32,
    priority: u8,
    groups: ChannelGroups,
    /// Times of its last frame and its last face, and since when faces have come without a pause.
    last_frame: f64,
    last_face: f64,
    steady_since: f64,
    newest: FaceFrame,
    /// The last frame with a face.
    seen: FaceFrame,
}

impl Source {
    fn is_live(&self, now: f64) -> bool {
        now - self.last_face <= LIVE
    }

    /// What it shows: while its face is lost for a moment only, the face as it was.
    fn shown(&self, now: f64) -> &FaceFrame {
        if self.is_live(now) { &self.seen } else { &self.newest }
    }
}

/// Merges the sources of one room.
pub struct Mixer {
    character: Arc<Character>,
    /// Of each bone and each expression shape.
    bone_groups: Vec<ChannelGroup>,
    shape_groups: Vec<ChannelGroup>,
    evaluator: Evaluator,
    zones: Option<ZoneRig>,
    rest: FaceFrame,
    sources: Vec<Source>,
    lead: Option<u32>,
    /// Who drives each group; `None` for rest.
    drivers: [Option<u32>; 5],
    /// When each group's hand-over began, and that of the zones from one way of telling them to the other.
    fades: [Option<f64>; 5],
    zone_fade: Option<f64>,
    is_alone: bool,
    /// What was shown when the hand-overs began, group by group.
    from: FaceFrame,
    shown: FaceFrame,
    has_shown: bool,
    session: u32,
}

impl Mixer {
    /// Without sources.
    pub fn new(character: Arc<Character>) -> Self {
        let rest = FaceFrame::at_rest(&character);
        Self {
            bone_groups: (0..character.num_bones()).map(|bone| group_of_bone(&character, bone)).collect(),
            shape_groups: ARKIT_NAMES.iter().map(|name| group_of_shape(name)).collect(),
            evaluator: Evaluator::new(&character),
            zones: ZoneRig::new(&character),
            sources: Vec::new(),
            lead: None,
            drivers: [None; 5],
            fades: [None; 5],
            zone_fade: None,
            is_alone: true,
            from: rest.clone(),
            shown: rest.clone(),
            has_shown: false,
            session: 0,
            rest,
            character,
        }
    }

    /// A source arrives; ids grow from each to the next.
    pub fn enter(&mut self, id: u32, slot: &Slot) {
        let never = f64::NEG_INFINITY;
        self.sources.push(Source {
            id,
            priority: slot.priority,
            groups: slot.groups,
            last_frame: never,
            last_face: never,
            steady_since: f64::INFINITY,
            newest: self.rest.clone(),
            seen: self.rest.clone(),
        });
    }

    /// A source is gone. After the last one nothing is remembered: what comes then is another performance.
    pub fn leave(&mut self, id: u32) {
        self.sources.retain(|source| source.id != id);
        if self.sources.is_empty() {
            (self.lead, self.drivers, self.fades, self.zone_fade) = (None, [None; 5], [None; 5], None);
            (self.has_shown, self.is_alone) = (false, true);
        }
    }

    /// Takes source `id`'s newest frame at `now`, seconds on a clock that never goes back. Gives the merged frame where that source
    /// leads. `last_session` is the highest session number so far; another lead counts it up, unless it is a source's first
    /// frame, whose session has its number already.
    pub fn take<'a>(&'a mut self, id: u32, face: &'a FaceFrame, now: f64, last_session: &mut u32) -> Option<&'a FaceFrame> {
        let source = self.sources.iter_mut().find(|source| source.id == id)?;
        if face.face {
            if now - source.last_face > PACE {
                source.steady_since = now;
            }
            source.last_face = now;
            source.seen.clone_from(face);
        }
        source.last_frame = now;
        source.newest.clone_from(face);
        self.choose_lead(face, now, last_session);
        if self.lead != Some(id) {
            return None;
        }
        self.choose_drivers(now);
        let seq = if self.session == id { face.seq } else { self.shown.seq };
        if self.is_alone && self.fades.iter().all(Option::is_none) && self.zone_fade.is_none() {
            let next = if self.session == id { seq } else { seq.wrapping_add(1) };
            self.shown.clone_from(face);
            self.has_shown = true;
            (self.shown.session, self.shown.seq) = (self.session, next);
            return Some(if self.session == id { face } else { &self.shown });
        }
        self.merge(face, now);
        self.shown.seq = if self.session == id { seq } else { seq.wrapping_add(1) };
        self.shown.session = self.session;
        self.shown.captured_at_micros = face.captured_at_micros;
        self.has_shown = true;
        Some(&self.shown)
    }

    /// What a source does at `now`: whether it is live, and the groups it drives.
    pub fn state_of(&self, id: u32, now: f64) -> (bool, ChannelGroups) {
        let is_live = self.sources.iter().any(|source| source.id == id && source.is_live(now));
        let drives = ChannelGroup::ALL.into_iter().filter(|group| self.best(*group, now) == Some(id));
        (is_live, drives.fold(ChannelGroups::NONE, ChannelGroups::with))
    }

    fn choose_lead(&mut self, face: &FaceFrame, now: f64, last_session: &mut u32) {
        let rank = |source: &Source| {
            let is_sending = now - source.last_frame <= PACE;
            (is_sending && source.is_live(now), is_sending, source.priority, source.id)
        };
        let Some(best) = self.sources.iter().max_by_key(|source| rank(source)) else { return };
        let lead = self.sources.iter().find(|source| Some(source.id) == self.lead);
        let is_worse = |lead: &Source| (rank(lead).0, rank(lead).1) < (rank(best).0, rank(best).1);
        let is_steady = now - best.steady_since >= LIVE;
        if self.lead == Some(best.id) || lead.is_some_and(|lead| !is_worse(lead) && !is_steady) {
            return;
        }
        self.lead = Some(best.id);
        if best.id > self.session && face.session == best.id && face.seq == 0 {
            self.session = best.id;
        } else {
            *last_session = last_session.wrapping_add(1).max(1);
            self.session = *last_session;
            // Its first frame counts as 0.
            self.shown.seq = u32::MAX;
        }
    }

    /// Who should drive `group`: the best live source; while none is, one that still says how it lost its face.
    fn best(&self, group: ChannelGroup, now: f64) -> Option<u32> {
        let candidates = self.sources.iter().filter(|source| source.groups.contains(group) && now - source.last_frame <= LIVE);
        candidates.max_by_key(|source| (source.is_live(now), source.priority, source.id)).map(|source| source.id)
    }

    /// Gives each group its driver; a change begins a hand-over from what is shown.
    fn choose_drivers(&mut self, now: f64) {
        for group in ChannelGroup::ALL {
            let best = self.best(group, now);
            let at = group.index();
            if self.drivers[at] != best {
                self.drivers[at] = best;
                if self.has_shown {
                    self.hold(group);
                    self.fades[at] = Some(now);
                }
            }
        }
        let is_alone = matches!(&self.sources[..], [only] if only.groups == ChannelGroups::ALL);
        if self.is_alone != is_alone {
            self.is_alone = is_alone;
            if self.has_shown {
                self.from.zones.clone_from(&self.shown.zones);
                self.from.stretched.clone_from(&self.shown.stretched);
                self.zone_fade = Some(now);
            }
        }
        for fade in self.fades.iter_mut().chain([&mut self.zone_fade]) {
            if fade.is_some_and(|since| now - since >= HAND_OVER) {
                *fade = None;
            }
        }
    }

    /// Remembers what is shown of `group`.
    fn hold(&mut self, group: ChannelGroup) {
        for (bone, of) in self.bone_groups.iter().enumerate() {
            if *of == group {
                self.from.points[bone] = self.shown.points[bone];
                self.from.rotations[bone] = self.shown.rotations[bone];
            }
        }
        let shown = self.shown.shapes.unwrap_or([0.0; NUM_ARKIT_SHAPES]);
        let from = self.from.shapes.get_or_insert([0.0; NUM_ARKIT_SHAPES]);
        for (shape, of) in self.shape_groups.iter().enumerate() {
            if *of == group {
                from[shape] = shown[shape];
            }
        }
        if group == ChannelGroup::Head {
            self.from.head = self.shown.head;
        }
    }

    /// Merges what the drivers show at `now` into `shown`.
    fn merge(&mut self, face: &FaceFrame, now: f64) {
        let shares = self.fades.map(|fade| fade.map_or(1.0, |since| smooth((now - since) / HAND_OVER)));
        let of = self.drivers.map(|driver| {
            let source = driver.and_then(|id| self.sources.iter().find(|source| source.id == id));
            source.map_or(&self.rest, |source| source.shown(now))
        });
        let (from, shown) = (&self.from, &mut self.shown);
        for (bone, group) in self.bone_groups.iter().enumerate() {
            let (target, share) = (of[group.index()], shares[group.index()]);
            // A share of 1 leaves every bit of the target as it is.
            (shown.points[bone], shown.rotations[bone]) = if share < 1.0 {
                let rotation = between(from.rotations[bone], target.rotations[bone], share);
                (from.points[bone].lerp(target.points[bone], share), rotation)
            } else {
                (target.points[bone], target.rotations[bone])
            };
        }
        for (bone, of) in self.character.bones.iter().enumerate() {
            if let Some(leader) = of.turns_with {
                shown.rotations[bone] = shown.rotations[leader];
            }
        }
        shown.shapes = of.iter().any(|face| face.shapes.is_some()).then(|| {
            let before = from.shapes.unwrap_or([0.0; NUM_ARKIT_SHAPES]);
            std::array::from_fn(|shape| {
                let group = self.shape_groups[shape].index();
                let target = of[group].shapes.map_or(0.0, |shapes| shapes[shape]);
                if shares[group] < 1.0 { before[shape] + (target - before[shape]) * shares[group] } else { target }
            })
        });
        let head = ChannelGroup::Head.index();
        shown.head = of[head].head;
        if shares[head] < 1.0 {
            shown.head.rotation = between(from.head.rotation, shown.head.rotation, shares[head]);
            shown.head.position = from.head.position.lerp(shown.head.position, shares[head]);
        }
        shown.face = if self.is_alone { face.face } else { self.sources.iter().any(|source| source.is_live(now)) };
        self.evaluator.evaluate(&shown.points, &mut shown.influences);
        if let Some(zones) = &self.zones {
            if self.is_alone {
                shown.zones.clone_from(&face.zones);
                shown.stretched.clone_from(&face.stretched);
            } else {
                // What one source says of the whole face's expression does not hold for a face of several.
                zones.write(&[[0.0; 2]; MAX_EXPRESSIONS], 1.0, &shown.influences, &mut shown.zones, &mut shown.stretched);
            }
            if let Some(since) = self.zone_fade {
                let share = smooth((now - since) / HAND_OVER);
                for zone in 0..shown.zones.len() {
                    let before = from.zones[zone] - from.stretched[zone];
                    let signed = before + (shown.zones[zone] - shown.stretched[zone] - before) * share;
                    (shown.zones[zone], shown.stretched[zone]) = (signed.max(0.0), (-signed).max(0.0));
                }
            }
        }
    }
}

/// The rotation at `share` of the way, the short way round.
fn between(from: Quat, to: Quat, share: f32) -> Quat {
    let (from, to) = (from.as_dquat(), to.as_dquat());
    let to = if from.x * to.x + from.y * to.y + from.z * to.z + from.w * to.w < 0.0 { -to } else { to };
    let sum = from * f64::from(1.0 - share) + to * f64::from(share);
    let length = (sum.x * sum.x + sum.y * sum.y + sum.z * sum.z + sum.w * sum.w).sqrt();
    (sum * (1.0 / length)).as_quat()
}

/// `0..=1` to `0..=1` without a jerk at either end.
fn smooth(x: f64) -> f32 {
    let x = x.clamp(0.0, 1.0);
    (x * x * (3.0 - 2.0 * x)) as f32
}

/// By what moves the bone, as the groups of the smoothing are: most of its landmarks; the nearest one where it has none.
pub(super) fn group_of_bone(character: &Character, bone: usize) -> ChannelGroup {
    let of_landmark = |landmark: usize| match landmark {
        17..=26 => ChannelGroup::Brows,
        36..=47 => ChannelGroup::Lids,
        _ => ChannelGroup::Mouth,
    };
    let bone = &character.bones[bone];
    match &bone.drive {
        Drive::Jaw { .. } => ChannelGroup::Mouth,
        Drive::Lid { .. } => ChannelGroup::Lids,
        Drive::Eye { .. } => ChannelGroup::Gaze,
        Drive::Skin { landmarks } => {
            let mut shares = [0.0_f32; 5];
            landmarks.iter().for_each(|share| shares[of_landmark(share.landmark).index()] += share.weight.abs());
            ChannelGroup::ALL.into_iter().fold(
                ChannelGroup::Brows,
                |best, group| {
                    if shares[group.index()] > shares[best.index()] { group } else { best }
                },
            )
        }
        Drive::Still => {
            let distance = |i: &usize| character.ibug68[*i].distance_squared(bone.rest);
            let nearest = (0..character.ibug68.len()).min_by(|a, b| distance(a).total_cmp(&distance(b)));
            of_landmark(nearest.unwrap_or_default())
        }
    }
}

pub(super) fn group_of_shape(name: &str) -> ChannelGroup {
    match name {
        _ if name.starts_with("brow") => ChannelGroup::Brows,
        _ if name.starts_with("eyeLook") => ChannelGroup::Gaze,
        _ if name.starts_with("eye") => ChannelGroup::Lids,
        _ => ChannelGroup::Mouth,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Vec3;
    use rhytid_shared::DEFAULT_CHARACTER_GLB;

    fn character() -> Arc<Character> {
        Arc::new(Character::from_glb(DEFAULT_CHARACTER_GLB).unwrap())
    }

    fn slot(priority: u8, groups: &[ChannelGroup]) -> Slot {
        let groups =
            if groups.is_empty() { ChannelGroups::ALL } else { groups.iter().fold(ChannelGroups::NONE, |all, one| all.with(*one)) };
        Slot { name: "test".into(), priority, groups }
    }

    /// Frame `seq` of session `id`, every bone lifted by `height`.
    fn lifted(character: &Character, id: u32, seq: u32, height: f32) -> FaceFrame {
        let mut face = FaceFrame::at_rest(character);
        (face.session, face.seq) = (id, seq);
        face.points.iter_mut().for_each(|point| *point += Vec3::Y * height);
        face
    }

    fn height(character: &Character, mixer: &Mixer, face: &FaceFrame, group: ChannelGroup) -> f32 {
        let bone = mixer.bone_groups.iter().position(|of| *of == group).unwrap();
        face.points[bone].y - character.bones[bone].rest.y
    }

    #[test]
    fn every_group_has_bones() {
        let mixer = Mixer::new(character());
        for group in [ChannelGroup::Brows, ChannelGroup::Lids, ChannelGroup::Gaze, ChannelGroup::Mouth] {
            assert!(mixer.bone_groups.contains(&group), "{group:?}");
        }
    }

    #[test]
    fn a_source_alone_passes_bit_for_bit() {
        let character = character();
        let mut mixer = Mixer::new(character.clone());
        mixer.enter(1, &slot(50, &[]));
        let mut last = 1;
        for seq in 0..50 {
            let mut face = lifted(&character, 1, seq, 0.0001 * seq as f32);
            face.face = seq % 7 != 0;
            face.zones.fill(0.3);
            assert_eq!(mixer.take(1, &face, f64::from(seq) * 0.9, &mut last), Some(&face));
        }
        assert_eq!(last, 1);
    }

    #[test]
    fn hand_overs_are_eased_and_come_back() {
        let character = character();
        let mut mixer = Mixer::new(character.clone());
        let (phone, camera) = (1, 2);
        mixer.enter(phone, &slot(60, &[ChannelGroup::Brows]));
        mixer.enter(camera, &slot(50, &[]));
        let mut last_session = 2;
        let (mut last, mut sessions, mut steepest): (Option<FaceFrame>, Vec<u32>, f32) = (None, Vec::new(), 0.0);
        let mut heights = Vec::new();
        let mut brows_when = |now: f64, phone_sends: bool, seq: u32| {
            for (id, height) in [(phone, 0.01), (camera, 0.002)] {
                if id == phone && !phone_sends {
                    continue;
                }
                let face = lifted(&character, id, seq, height);
                let Some(merged) = mixer.take(id, &face, now, &mut last_session) else { continue };
                let merged = merged.clone();
                if let Some(last) = &last {
                    let step = merged.points.iter().zip(&last.points).map(|(a, b)| a.distance(*b)).fold(0.0, f32::max);
                    steepest = steepest.max(step);
                    assert!(merged.session > last.session || (merged.session == last.session && merged.seq == last.seq + 1));
                }
                let mut influences = vec![0.0; merged.influences.len()];
                mixer.evaluator.evaluate(&merged.points, &mut influences);
                assert_eq!(influences, merged.influences, "anybody finds the influences in the bones");
                sessions.push(merged.session);
                heights.push((
                    now,
                    height_of(&character, &mixer, &merged, ChannelGroup::Brows),
                    height_of(&character, &mixer, &merged, ChannelGroup::Mouth),
                ));
                last = Some(merged);
            }
        };
        fn height_of(character: &Character, mixer: &Mixer, face: &FaceFrame, group: ChannelGroup) -> f32 {
            height(character, mixer, face, group)
        }
        for i in 0..300_u32 {
            let now = f64::from(i) / 30.0;
            brows_when(now, !(3.0..6.0).contains(&now), i);
        }
        let at = |t: f64| heights.iter().rev().find(|(now, ..)| *now <= t).map(|(_, brows, mouth)| (*brows, *mouth)).unwrap();
        let is = |got: (f32, f32), brows: f32, mouth: f32| (got.0 - brows).abs() < 1e-6 && (got.1 - mouth).abs() < 1e-6;
        assert!(is(at(2.9), 0.01, 0.002), "{:?}", at(2.9));
        assert!(is(at(3.4), 0.01, 0.002), "held for half a second: {:?}", at(3.4));
        assert!(is(at(4.0), 0.002, 0.002), "then the camera's: {:?}", at(4.0));
        assert!(is(at(6.5), 0.01, 0.002), "and back: {:?}", at(6.5));
        // 8 mm in 0.3 s at 30 frames a second, 1.5 times the mean at the steepest.
        assert!(steepest < 0.0016, "{steepest} m between two packets");
        sessions.dedup();
        assert!(sessions.len() >= 3, "each lead has its session: {sessions:?}");
    }

    #[test]
    fn what_nobody_drives_goes_to_rest() {
        let character = character();
        let mut mixer = Mixer::new(character.clone());
        mixer.enter(1, &slot(50, &[ChannelGroup::Mouth]));
        let mut last = 1;
        let face = lifted(&character, 1, 0, 0.004);
        let merged = mixer.take(1, &face, 0.0, &mut last).unwrap().clone();
        assert_eq!((height(&character, &mixer, &merged, ChannelGroup::Brows), merged.session, merged.seq), (0.0, 1, 0));
        assert!(height(&character, &mixer, &merged, ChannelGroup::Mouth) > 0.003);
        assert_eq!(mixer.state_of(1, 0.4), (true, ChannelGroups::NONE.with(ChannelGroup::Mouth)));
        assert_eq!(mixer.state_of(1, 0.6), (false, ChannelGroups::NONE));
    }
}
