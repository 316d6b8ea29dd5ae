//! Expression weights from landmarks: what they are on faces that are known, how well each shape is told, and, where the
//! recordings are at hand, how they go with another tracker's.

#![allow(clippy::unwrap_used, reason = "helpers of tests fail like tests")]

mod solve_fixture;

use rhytid_server::feed::{Feed, FeedItem};
use rhytid_server::load_character;
use rhytid_server::pipeline::Pipeline;
use rhytid_server::solve::stages::ExpressionMap;
use rhytid_server::solve::{SolveConfig, Solver};
use rhytid_shared::layout::{Layout, NUM_IBUG};
use rhytid_shared::{ARKIT_NAMES, ArkitShape, Character, FaceFrame, NUM_ARKIT_SHAPES, TrackingData, TrackingFrame};
use solve_fixture::{View, hello, landmark_frame, see};
use std::path::Path;
use std::sync::Arc;

type Weights = [f32; NUM_ARKIT_SHAPES];

/// What the solve makes of a feed: a frame's sender time and its weights; and the mean size of a packet.
fn solve(path: &Path, character: &Arc<Character>, estimate_weights: bool) -> (Vec<(f64, Option<Weights>)>, f64) {
    let mut feed = Feed::open(path, character).unwrap();
    let config = SolveConfig { estimate_weights, ..SolveConfig::default() };
    let mut pipeline = Pipeline::new(character.clone(), &config, &feed.hello, 1).unwrap();
    let (mut frame, mut packet, mut out, mut bytes) = (TrackingFrame::default(), Vec::new(), Vec::new(), 0);
    while let Some(item) = feed.next_frame(&mut frame).unwrap() {
        if item == FeedItem::Frame {
            packet.clear();
            pipeline.frame(&frame, &mut packet).unwrap();
            bytes += packet.len();
            out.push((frame.t, pipeline.face().shapes));
        }
    }
    let mean = bytes as f64 / out.len() as f64;
    (out, mean)
}

/// What a session makes of two seconds of the neutral and one of these shapes.
fn estimate(character: &Arc<Character>, config: &SolveConfig, layout: Layout, named: &[(&str, f32)]) -> [Option<Weights>; 2] {
    let view = View { yaw: 8.0, ..View::FRONT };
    let mut points = character.ibug68.to_vec();
    let neutral = see(&points, character.head_pivot, &view);
    for &(name, weight) in named {
        let own = character.shapes.iter().find(|own| own.shape.name() == name).unwrap();
        points.iter_mut().zip(&own.landmarks).for_each(|(point, delta)| *point += *delta * weight);
    }
    let shown = see(&points, character.head_pivot, &view);
    let mut solver = Solver::new(character.clone(), config, &hello(Some(layout), None)).unwrap();
    let mut out = FaceFrame::at_rest(character);
    let mut at_rest = None;
    for frame in 0..90 {
        let pixels = if frame < 60 { &neutral } else { &shown };
        solver.solve(&landmark_frame(f64::from(frame) / 30.0, pixels.clone()), &mut out).unwrap();
        if frame == 59 {
            at_rest = out.shapes;
        }
    }
    [at_rest, out.shapes]
}

fn index(name: &str) -> usize {
    ArkitShape::from_name(name).unwrap().index()
}

#[test]
fn neutral_has_no_weights_and_each_told_shape_is_found_as_the_strongest() {
    let (character, _) = load_character(None).unwrap();
    let map = ExpressionMap::fit(&character).unwrap();
    for fit in map.report().shapes.iter().filter(|fit| fit.is_used) {
        let [at_rest, shown] = estimate(&character, &SolveConfig::default(), Layout::Ibug68, &[(fit.shape, 1.0)]);
        assert_eq!(at_rest, Some([0.0; NUM_ARKIT_SHAPES]), "{}", fit.shape);
        let shown = shown.unwrap();
        let strongest = (0..NUM_ARKIT_SHAPES).max_by(|a, b| shown[*a].total_cmp(&shown[*b])).unwrap();
        assert_eq!(ARKIT_NAMES[strongest], fit.shape, "{shown:?}");
        assert!(shown[strongest] > 0.3, "{} comes out as {}", fit.shape, shown[strongest]);
    }
}

#[test]
fn one_side_is_not_taken_for_the_other() {
    let (character, _) = load_character(None).unwrap();
    for (shown, other) in [("mouthSmileLeft", "mouthSmileRight"), ("eyeBlinkRight", "eyeBlinkLeft"), ("browDownLeft", "browDownRight")] {
        let [_, weights] = estimate(&character, &SolveConfig::default(), Layout::Ibug68, &[(shown, 1.0)]);
        let weights = weights.unwrap();
        assert!(
            weights[index(shown)] > 3.0 * weights[index(other)],
            "{shown} {}, {other} {}",
            weights[index(shown)],
            weights[index(other)]
        );
    }
}

/// The error and what is left out: both are stated in the README.
#[test]
fn shapes_that_landmarks_hardly_show_stay_at_zero() {
    let (character, _) = load_character(None).unwrap();
    let map = ExpressionMap::fit(&character).unwrap();
    let report = map.report();
    println!("{} examples, ridge {}, leave-one-out error {:.4}", report.num_examples, report.ridge, report.error);
    for fit in &report.shapes {
        println!("{:20} error {:.3} explained {:.2} {}", fit.shape, fit.error, fit.explained, if fit.is_used { "" } else { "left at 0" });
    }
    assert!(report.error < 0.11, "leave-one-out error {}", report.error);
    let is_used = |name: &str| report.shapes.iter().find(|fit| fit.shape == name).unwrap().is_used;
    for name in ["tongueOut", "cheekPuff", "jawForward", "eyeLookInLeft", "cheekSquintRight"] {
        assert!(!is_used(name), "{name}");
    }
    for name in ["jawOpen", "mouthSmileLeft", "mouthSmileRight", "eyeBlinkLeft", "eyeBlinkRight", "browInnerUp", "browDownLeft"] {
        assert!(is_used(name), "{name}");
    }
    let used = report.shapes.iter().filter(|fit| fit.is_used).map(|fit| fit.shape);
    for name in used.filter(|name| name.ends_with("Left")) {
        assert!(is_used(&name.replace("Left", "Right")), "{name} without its partner");
    }
    assert_eq!(ExpressionMap::fit(&character).unwrap().report(), report, "the second training gave another result");
}

#[test]
fn weights_are_left_out_where_nobody_wants_them_or_nothing_tells_them() {
    let (character, _) = load_character(None).unwrap();
    let smile = [("mouthSmileLeft", 1.0)];
    let without = SolveConfig { estimate_weights: false, ..SolveConfig::default() };
    assert_eq!(estimate(&character, &without, Layout::Ibug68, &smile), [None; 2]);
    let bare = Arc::new(Character { shapes: Vec::new(), ..(*character).clone() });
    assert_eq!(estimate(&bare, &SolveConfig::default(), Layout::Ibug68, &[]), [None; 2]);
    assert_eq!(character.shapes.iter().map(|own| own.landmarks.len()).collect::<Vec<_>>(), vec![NUM_IBUG; character.shapes.len()]);
}

/// Weights that a feed carries, by the sender's time.
fn sent(path: &Path, character: &Arc<Character>) -> Vec<(f64, Weights)> {
    let mut feed = Feed::open(path, character).unwrap();
    let (mut frame, mut out) = (TrackingFrame::default(), Vec::new());
    while feed.next_frame(&mut frame).unwrap().is_some() {
        if let TrackingData::Weights { weights, .. } = &frame.data {
            out.push((frame.t, **weights));
        }
    }
    out
}

/// Pearson's.
fn correlation(pairs: &[(f64, f64)]) -> Option<f64> {
    let num = pairs.len() as f64;
    let mean = |of: fn(&(f64, f64)) -> f64| pairs.iter().map(of).sum::<f64>() / num;
    let (a, b) = (mean(|pair| pair.0), mean(|pair| pair.1));
    let sum = |of: &dyn Fn(&(f64, f64)) -> f64| pairs.iter().map(of).sum::<f64>();
    let (aa, bb) = (sum(&|p| (p.0 - a) * (p.0 - a)), sum(&|p| (p.1 - b) * (p.1 - b)));
    let ab = sum(&|p| (p.0 - a) * (p.1 - b));
    (aa > 1e-9 && bb > 1e-9).then(|| ab / (aa * bb).sqrt())
}

/// For feeds that hold the same session as landmarks and as weights, where `RHYTID_FEEDS` names a folder of them.
#[test]
fn recorded_sessions() {
    let Some(folder) = std::env::var_os("RHYTID_FEEDS") else { return };
    let (character, _) = load_character(None).unwrap();
    for name in ["webcam", "talking"] {
        let path = |kind: &str| Path::new(&folder).join(format!("{name}.{kind}.jsonl"));
        let truth = sent(&path("arkit"), &character);
        let (without, bytes_without) = solve(&path("ibug68"), &character, false);
        let (estimated, bytes) = solve(&path("ibug68"), &character, true);
        println!("{name}: {} frames, {bytes_without:.1} bytes a packet without, {bytes:.1} with", without.len());
        let (mut sum, mut num) = (0.0, 0);
        for shape in 0..NUM_ARKIT_SHAPES {
            let values: Vec<f64> = truth.iter().map(|(_, weights)| f64::from(weights[shape])).collect();
            let range = values.iter().fold(0.0_f64, |most, v| most.max(*v)) - values.iter().fold(1.0_f64, |least, v| least.min(*v));
            let pairs: Vec<(f64, f64)> = estimated
                .iter()
                .filter_map(|(t, weights)| {
                    let at = truth.iter().find(|(other, _)| (other - t).abs() < 1e-3)?;
                    Some((f64::from(at.1[shape]), f64::from((*weights)?[shape])))
                })
                .collect();
            if range < 0.15 {
                continue;
            }
            let most = pairs.iter().fold(0.0_f64, |most, p| most.max(p.1));
            match correlation(&pairs) {
                Some(r) => {
                    println!("  {:20} range {range:.2}, estimated up to {most:.2}, r {r:.2}", ARKIT_NAMES[shape]);
                    (sum, num) = (sum + r, num + 1);
                }
                None => println!("  {:20} range {range:.2}, left at 0", ARKIT_NAMES[shape]),
            }
        }
        let mean = sum / f64::from(num);
        println!("  mean r {mean:.3} over {num} shapes");
        assert!(mean > 0.6 && bytes <= 90.0, "{name}: mean r {mean}, {bytes} bytes");
    }
}
