//! What a recording is as an animated character: structure, times, sides, and that either animation says the whole pose.

use crate::fixture::write_packets;
use crate::server::Folder;
use gltf::animation::Property;
use gltf::animation::util::ReadOutputs;
use rhytid_server::load_character;
use rhytid_server::recording::{Faces, Recording, export_gltf};
use rhytid_shared::{ArkitShape, FaceFrame, HeadPose, PublishHello, TrackingData, TrackingFrame};
use std::collections::BTreeMap;
use std::path::Path;

/// A performer at rest for three seconds, then with `pose` held, 30 frames a second from `at` seconds on; ends at `end`.
fn held(at: f64, end: f64, pose: &[(&str, f32)], head: HeadPose) -> Vec<TrackingFrame> {
    let frame = |t: f64| {
        let is_posed = t >= 3.0;
        let mut weights = Box::new([0.0; 52]);
        for (name, weight) in pose.iter().filter(|_| is_posed) {
            weights[ArkitShape::from_name(name).unwrap().index()] = *weight;
        }
        TrackingFrame::new(t, TrackingData::Weights { weights, head: Some(if is_posed { head } else { HeadPose::default() }) })
    };
    let times = (0..90).map(|k| f64::from(k) / 30.0).chain((0..).map(|k| at + f64::from(k) / 30.0).take_while(|t| *t < end));
    times.map(frame).collect()
}

/// Times and values of one property of one node in one animation.
struct Track {
    times: Vec<f32>,
    width: usize,
    values: Vec<f32>,
}

impl Track {
    fn keys(&self) -> impl Iterator<Item = &[f32]> {
        self.values.chunks(self.width)
    }
}

type Tracks = BTreeMap<(String, String, &'static str), Track>;

/// Everything that is animated in `file`, by animation, node and property, with the rules of the format that players rely on checked.
fn tracks(file: &[u8]) -> Tracks {
    let gltf = gltf::Gltf::from_slice(file).expect("the file is sound");
    let blob = gltf.blob.as_deref().unwrap();
    for view in gltf.views() {
        assert!(view.offset() + view.length() <= blob.len() && blob.len() <= view.buffer().length() + 3);
    }
    let mut tracks = Tracks::new();
    for animation in gltf.animations() {
        for channel in animation.channels() {
            let target = channel.target();
            assert!(matches!(target.node().transform(), gltf::scene::Transform::Decomposed { .. }), "a matrix cannot be animated");
            let input = channel.sampler().input();
            let reader = channel.reader(|_| Some(blob));
            let times: Vec<f32> = reader.read_inputs().unwrap().collect();
            assert!(times.windows(2).all(|pair| pair[0] < pair[1]) && times[0] == 0.0, "{times:?}");
            let [least, most] = [input.min(), input.max()].map(|bound| bound.unwrap()[0].as_f64().unwrap() as f32);
            assert_eq!([least, most], [times[0], *times.last().unwrap()], "bounds of times are required, and exact");
            let (name, values): (_, Vec<f32>) = match reader.read_outputs().unwrap() {
                ReadOutputs::Translations(values) => ("translation", values.flatten().collect()),
                ReadOutputs::Rotations(values) => ("rotation", values.into_f32().flatten().collect()),
                ReadOutputs::MorphTargetWeights(values) => ("weights", values.into_f32().collect()),
                ReadOutputs::Scales(_) => panic!("nothing grows"),
            };
            assert!(values.iter().all(|value| value.is_finite()) && values.len().is_multiple_of(times.len()));
            let width = values.len() / times.len();
            let track = Track { times, width, values };
            if target.property() == Property::Rotation {
                assert!(track.keys().all(|q| (q.iter().map(|x| x * x).sum::<f32>() - 1.0).abs() < 1e-5), "rotations have a length of 1");
                let close = |[a, b]: [&[f32]; 2]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f32>() >= 0.0;
                let keys: Vec<_> = track.keys().collect();
                assert!(keys.windows(2).all(|pair| close([pair[0], pair[1]])), "neighbours are in the same half");
            }
            let node = target.node().name().unwrap().to_owned();
            let before = tracks.insert((animation.name().unwrap().to_owned(), node, name), track);
            assert!(before.is_none(), "one channel a property");
        }
    }
    tracks
}

/// The export of `range` of a recording of `frames`, and the faces that were recorded.
fn exported(frames: &[TrackingFrame], range: [f64; 2]) -> (Vec<u8>, u64, Vec<FaceFrame>) {
    let folder = Folder::new();
    let (character, glb) = load_character(None).unwrap();
    let path = folder.path("held.mcap");
    let shown = write_packets(&path, &character, &PublishHello::default(), frames);
    let open = |path: &Path| Faces::new(Recording::open(path).unwrap());
    let (file, num) = export_gltf(&mut open(&path), range, &character, &glb).unwrap();
    (file, num, shown)
}

#[test]
fn a_pose_that_is_held_throughout_is_not_taken_for_rest() {
    let head = HeadPose { rotation: glam::Quat::from_rotation_y(0.3), ..HeadPose::default() };
    let frames = held(3.0, 6.0, &[("mouthSmileLeft", 1.0)], head);
    let (file, num, shown) = exported(&frames, [4.5, 5.5]);
    assert!((30..=32).contains(&num), "{num}");
    let tracks = tracks(&file);
    let (_, glb) = load_character(None).unwrap();
    let gltf = gltf::Gltf::from_slice(&glb).unwrap();
    let rest = |name: &str| gltf.nodes().find(|node| node.name() == Some(name)).unwrap().transform().decomposed();
    let track = |animation: &str, node: &str, property| tracks.get(&(animation.to_owned(), node.to_owned(), property));
    let moved = |animation: &str, node: &str| {
        track(animation, node, "translation").map_or(glam::Vec3::ZERO, |track| {
            let ends = [track.keys().next().unwrap(), track.keys().last().unwrap()];
            let [first, last] = ends.map(|end| glam::Vec3::from_slice(end) - glam::Vec3::from(rest(node).0));
            assert!(first.distance(last) < 1e-4, "{node} stands still");
            first
        })
    };
    // The performer's left is +X, up is +Y.
    let (left, right) = (moved("bones", "lip_corner_l"), moved("bones", "lip_corner_r"));
    assert!(left.x > 2e-3 && left.y > 2e-3 && right.length() < 0.3 * left.length(), "{left} {right}");

    // What one animation moves, the other holds where it is at rest.
    let names = |animation: &str| -> Vec<_> {
        tracks.keys().filter(|(of, ..)| of == animation).map(|(_, node, property)| (node.clone(), *property)).collect()
    };
    assert_eq!(names("bones"), names("shapes"));
    assert_eq!(moved("shapes", "lip_corner_l"), glam::Vec3::ZERO);
    let [none, some] = ["bones", "shapes"].map(|animation| track(animation, "face", "weights").expect("both say what shapes do"));
    assert!(none.values.iter().all(|weight| *weight == 0.0) && none.width == 52);
    let smile = ArkitShape::from_name("mouthSmileLeft").unwrap().index();
    let expected = shown.last().unwrap().shapes.unwrap()[smile];
    let targets: Vec<f32> = some.keys().last().unwrap().to_vec();
    assert!(expected > 0.9 && targets.iter().filter(|weight| **weight > 0.0).count() == 1 && targets.contains(&expected), "{targets:?}");
    assert!(some.times.last().unwrap() == none.times.last().unwrap() && (0.97..=1.03).contains(some.times.last().unwrap()));

    // Both turn the head as it was sent.
    for animation in ["bones", "shapes"] {
        let last = track(animation, "head", "rotation").unwrap().keys().last().unwrap();
        let turned = glam::Quat::from_slice(last) * glam::Quat::from_array(rest("head").1).inverse();
        assert!(turned.angle_between(shown.last().unwrap().head.rotation) < 1e-3 && turned.angle_between(head.rotation) < 0.02);
    }
}

#[test]
fn one_face_and_a_face_at_rest_are_animations_too() {
    let frames = held(3.0, 5.0, &[("jawOpen", 1.0)], HeadPose::default());
    let (file, num, _) = exported(&frames, [1.0, 2.0]);
    assert!((30..=32).contains(&num));
    let at_rest = tracks(&file);
    assert!(at_rest.keys().all(|(_, node, _)| node == "head") && at_rest.len() == 4, "{:?}", at_rest.keys());
    let (file, num, _) = exported(&frames[89..91], [0.0, 2.98]);
    let one = tracks(&file);
    assert!(num == 1 && one.values().all(|track| track.times == [0.0]), "{num}");
}

#[test]
fn the_face_stands_still_while_nothing_came() {
    let frames = held(8.0, 9.0, &[("jawOpen", 1.0)], HeadPose::default());
    let (file, num, _) = exported(&frames, [0.0, f64::INFINITY]);
    let tracks = tracks(&file);
    let jaw = &tracks[&("bones".to_owned(), "jaw".to_owned(), "rotation")];
    assert_eq!((num as usize, jaw.times.len()), (frames.len(), frames.len() + 1), "a key more, before the jaw opens");
    let weights = &tracks[&("shapes".to_owned(), "face".to_owned(), "weights")];
    let pause = jaw.times.windows(2).position(|pair| pair[1] - pair[0] > 1.0).unwrap();
    assert!((7.95..8.0).contains(&jaw.times[pause + 1]), "{}", jaw.times[pause + 1]);
    for track in [jaw, weights] {
        let keys: Vec<_> = track.keys().collect();
        assert_eq!(keys[pause], keys[pause + 1], "the last face stands until the next comes");
        assert_ne!(keys[pause + 1], keys[pause + 2]);
    }
}
