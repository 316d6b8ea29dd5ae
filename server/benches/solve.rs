//! What one frame costs on the default character, as a whole and stage by stage: 68 points to some 40 bones and 4 poses.
//! Budget: 10 microseconds a frame on one core; aim: 4.

#![allow(missing_docs, reason = "criterion's macros")]

#[path = "../tests/solve_fixture/mod.rs"]
mod solve_fixture;

use criterion::{BatchSize, Criterion, criterion_group, criterion_main};
use glam::{DVec2, DVec3, Vec3};
use rhytid_server::pipeline::Pipeline;
use rhytid_server::solve::stages::{Evaluator, ExpressionMap, OneEuroBank, Pose, Regression, lift, refine};
use rhytid_server::solve::{SolveConfig, Solver};
use rhytid_shared::layout::{IBUG_FROM_MEDIAPIPE, IBUG_STABLE, Layout};
use rhytid_shared::{Character, DEFAULT_CHARACTER_GLB, FaceFrame, TrackingData, TrackingFrame};
use solve_fixture::{IMAGE, View, expression, feed, hello, landmark_frame, landmarks, see, weight_frame};
use std::hint::black_box;
use std::sync::Arc;
use std::time::Instant;

fn character() -> Arc<Character> {
    Arc::new(Character::from_glb(DEFAULT_CHARACTER_GLB).expect("the built-in character is sound"))
}

/// Frames of a performance, over and over with time going on.
struct Endless {
    frames: Vec<TrackingFrame>,
    next: usize,
    t: f64,
}

impl Endless {
    fn next(&mut self) -> &TrackingFrame {
        let at = self.next % self.frames.len();
        self.next += 1;
        self.t += 1.0 / 30.0;
        self.frames[at].t = self.t;
        &self.frames[at]
    }
}

fn whole(criterion: &mut Criterion) {
    let character = character();
    let mut solver = Solver::new(character.clone(), &SolveConfig::default(), &hello(Some(Layout::Ibug68), None)).expect("a good session");
    let mut frames = Endless { frames: feed(&character, 900), next: 0, t: 0.0 };
    let mut out = FaceFrame::at_rest(&character);
    // Beyond the last look at the neutral: what a session costs that goes on.
    for _ in 0..3000 {
        solver.solve(frames.next(), &mut out).expect("a good frame");
    }
    criterion.bench_function("whole frame", |bencher| bencher.iter(|| solver.solve(black_box(frames.next()), &mut out)));

    let without = SolveConfig { estimate_weights: false, ..SolveConfig::default() };
    let mut frames = Endless { frames: feed(&character, 900), next: 0, t: 0.0 };
    let mut solver = Solver::new(character.clone(), &without, &hello(Some(Layout::Ibug68), None)).expect("a good session");
    for _ in 0..3000 {
        solver.solve(frames.next(), &mut out).expect("a good frame");
    }
    criterion.bench_function("whole frame without expression weights", |bencher| {
        bencher.iter(|| solver.solve(black_box(frames.next()), &mut out));
    });

    let mut solver = Solver::new(character.clone(), &SolveConfig::default(), &hello(None, None)).expect("a good session");
    let named: Vec<(&str, f32)> = ["jawOpen", "mouthSmileLeft", "browInnerUp", "eyeBlinkLeft"].map(|name| (name, 0.4)).into();
    let mut frames = Endless { frames: vec![weight_frame(0.0, &named), weight_frame(0.0, &[])], next: 0, t: 0.0 };
    criterion.bench_function("whole frame of weights", |bencher| bencher.iter(|| solver.solve(black_box(frames.next()), &mut out)));
}

/// The other things a frame may be: 478 points (ingest is what they cost more), bones, and no face.
fn others(criterion: &mut Criterion) {
    let character = character();
    let mut out = FaceFrame::at_rest(&character);
    let wide = feed(&character, 900).into_iter().map(|frame| {
        let TrackingData::Landmarks { points, .. } = &frame.data else { return frame };
        let mut wide = vec![[IMAGE[0] / 2.0, IMAGE[1] / 2.0, 0.0]; 478];
        for (ibug, &at) in IBUG_FROM_MEDIAPIPE.iter().enumerate() {
            wide[at] = points[ibug];
        }
        for (iris, corners) in [(468, [36, 39]), (473, [42, 45])] {
            wide[iris] = [0, 1, 2].map(|axis| 0.5 * (points[corners[0]][axis] + points[corners[1]][axis]));
        }
        landmark_frame(frame.t, wide)
    });
    let mut frames = Endless { frames: wide.collect(), next: 0, t: 0.0 };
    let hello_of = |layout| hello(layout, None);
    let mut solver =
        Solver::new(character.clone(), &SolveConfig::default(), &hello_of(Some(Layout::Mediapipe478))).expect("a good session");
    for _ in 0..3000 {
        solver.solve(frames.next(), &mut out).expect("a good frame");
    }
    criterion.bench_function("whole frame of 478 points", |bencher| bencher.iter(|| solver.solve(black_box(frames.next()), &mut out)));

    let bones = character.bones.iter().enumerate().map(|(i, bone)| (i, bone.rest + Vec3::splat(0.002))).collect();
    let frame = TrackingFrame::new(0.0, TrackingData::Bones { points: bones, head: None });
    let mut frames = Endless { frames: vec![frame], next: 0, t: 0.0 };
    let mut solver = Solver::new(character.clone(), &SolveConfig::default(), &hello_of(None)).expect("a good session");
    // Easing, the skeleton and the evaluation: what every frame pays whatever it comes as.
    criterion.bench_function("whole frame of bones", |bencher| bencher.iter(|| solver.solve(black_box(frames.next()), &mut out)));

    let mut frames = Endless { frames: vec![TrackingFrame::new(0.0, TrackingData::NoFace)], next: 0, t: 1e6 };
    criterion.bench_function("whole frame without a face", |bencher| bencher.iter(|| solver.solve(black_box(frames.next()), &mut out)));
}

/// Every part of the way in one figure, beside its budget.
fn total(_: &mut Criterion) {
    let character = character();
    let mut pipeline =
        Pipeline::new(character.clone(), &SolveConfig::default(), &hello(Some(Layout::Ibug68), None), 1).expect("a good session");
    let mut frames = Endless { frames: feed(&character, 900), next: 0, t: 0.0 };
    let mut packet = Vec::new();
    let mut run = |num: u32| {
        let started = Instant::now();
        for _ in 0..num {
            pipeline.frame(frames.next(), &mut packet).expect("a good frame");
        }
        started.elapsed() / num
    };
    run(3000);
    // The least of several runs: what the machine does besides only adds.
    let least = (0..20).map(|_| run(1000)).min().unwrap_or_default();
    println!("total, landmarks to packet: {:.2} microseconds a frame (budget of the solve: 10)", least.as_secs_f64() * 1e6);
}

/// The budget of a new neutral is 5 ms.
fn calibration(criterion: &mut Criterion) {
    let character = character();
    let frames = feed(&character, 601);
    let after = |num: usize| {
        let mut solver =
            Solver::new(character.clone(), &SolveConfig::default(), &hello(Some(Layout::Ibug68), None)).expect("a good session");
        let mut out = FaceFrame::at_rest(&character);
        for frame in &frames[..num] {
            solver.solve(frame, &mut out).expect("a good frame");
        }
        (solver, out)
    };
    let mut group = criterion.benchmark_group("calibration");
    group.sample_size(30);
    // Once for each character that is loaded.
    group.bench_function("train the expression weights", |bencher| bencher.iter(|| ExpressionMap::fit(black_box(&character))));
    group.bench_function("asked for", |bencher| {
        bencher.iter_batched_ref(|| after(100), |(solver, _)| solver.calibrate(), BatchSize::PerIteration)
    });
    // The frame of the look at 20 s, with as many frames in hand as a look works on.
    group.bench_function("of the whole session, with depth", |bencher| {
        bencher.iter_batched_ref(|| after(600), |(solver, out)| solver.solve(&frames[600], out), BatchSize::PerIteration);
    });
    group.finish();
}

fn stages(criterion: &mut Criterion) {
    let character = character();
    let model: Vec<DVec3> = landmarks().iter().map(|p| p.as_dvec3()).collect();
    let rays_of = |view: &View| -> Vec<DVec2> {
        see(&expression([0.005; 2], 0.004, 0.002, 0.0), character.head_pivot, view)
            .iter()
            .map(|p| (DVec2::new(f64::from(p[0]), f64::from(p[1])) - DVec2::new(f64::from(IMAGE[0]), f64::from(IMAGE[1])) / 2.0) / 640.0)
            .collect()
    };
    let rays = rays_of(&View { yaw: 11.0, ..View::FRONT });
    let stable: Vec<(usize, f64)> = IBUG_STABLE.iter().map(|&i| (i, 1.0)).collect();
    let unit = f64::from(character.interocular());
    let before: Pose = refine(None, &model, &rays_of(&View { yaw: 10.0, ..View::FRONT }), &stable, unit).expect("a face").pose;
    criterion.bench_function("head pose from the frame before", |bencher| {
        bencher.iter(|| refine(Some(black_box(before)), &model, &rays, &stable, unit));
    });
    let matrix = before.matrix();
    criterion.bench_function("lift 68 points", |bencher| {
        bencher.iter(|| rays.iter().zip(&model).map(|(ray, point)| lift(&matrix, before.translation, *ray, point.z)).sum::<DVec3>());
    });

    let mut bank = OneEuroBank::new(SolveConfig::default().filter.mouth, 136, unit);
    let (still, moved) = (vec![0.0; 136], vec![0.001; 136]);
    let mut is_odd = false;
    criterion.bench_function("smooth 68 points", |bencher| {
        bencher.iter(|| {
            is_odd = !is_odd;
            bank.update(black_box(if is_odd { &moved } else { &still }), 1.0 / 30.0)[0]
        });
    });

    let sources: Vec<DVec2> =
        (0..68).filter(|i| matches!(i, 7..=9 | 17..=36 | 39 | 42 | 45 | 48..=59)).map(|i| model[i].truncate()).collect();
    let targets: Vec<DVec3> = (0..68).filter(|i| matches!(i, 7..=9 | 17..=36 | 39 | 42 | 45 | 48..=59)).map(|i| model[i] * 1.1).collect();
    criterion.bench_function("train the regression", |bencher| bencher.iter(|| Regression::fit(black_box(&sources), &targets, 0.0)));
    let map = Regression::fit(&sources, &targets, 0.0).expect("a face");
    // As many as the default character's bones use.
    criterion.bench_function("regression at 39 points", |bencher| {
        bencher.iter(|| sources.iter().cycle().take(39).map(|p| map.value(black_box(*p))).sum::<Vec3>());
    });

    let evaluator = Evaluator::new(&character);
    let points: Vec<Vec3> = character.bones.iter().map(|bone| bone.rest + Vec3::splat(0.002)).collect();
    let mut influences = vec![0.0; character.num_poses() * character.num_bones()];
    criterion
        .bench_function("evaluate all bones x 4 poses", |bencher| bencher.iter(|| evaluator.evaluate(black_box(&points), &mut influences)));
}

criterion_group!(benches, whole, others, calibration, stages, total);
criterion_main!(benches);
