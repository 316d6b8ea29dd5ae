//! What one frame costs, as a whole and stage by stage: 68 points to 31 bones and 4 poses.
//! Budget: 10 microseconds a frame on one core; aim: 4.

#![allow(missing_docs, reason = "criterion's macros")]

#[path = "../tests/solve_fixture/mod.rs"]
mod solve_fixture;

use criterion::{Criterion, criterion_group, criterion_main};
use glam::{DVec2, DVec3, Vec3};
use rhytid_server::solve::stages::{Evaluator, OneEuroBank, Pose, Regression, lift, refine};
use rhytid_server::solve::{SolveConfig, Solver};
use rhytid_shared::layout::{IBUG_STABLE, Layout};
use rhytid_shared::{FaceFrame, TrackingFrame};
use solve_fixture::{IMAGE, View, character, expression, feed, hello, landmarks, see};
use std::hint::black_box;

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
    criterion.bench_function("regression at 30 points", |bencher| {
        bencher.iter(|| sources.iter().take(30).map(|p| map.value(black_box(*p))).sum::<Vec3>());
    });

    let evaluator = Evaluator::new(&character);
    let points: Vec<Vec3> = character.bones.iter().map(|bone| bone.rest + Vec3::splat(0.002)).collect();
    let mut influences = vec![0.0; character.num_poses() * character.num_bones()];
    criterion
        .bench_function("evaluate 31 bones x 4 poses", |bencher| bencher.iter(|| evaluator.evaluate(black_box(&points), &mut influences)));
}

criterion_group!(benches, whole, stages);
criterion_main!(benches);
