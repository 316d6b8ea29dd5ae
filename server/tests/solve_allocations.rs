//! A frame allocates nothing: counted by an allocator of this test's own.

mod solve_fixture;

use rhytid_server::pipeline::Pipeline;
use rhytid_server::solve::{SolveConfig, Solver};
use rhytid_shared::layout::{IBUG_FROM_MEDIAPIPE, Layout};
use rhytid_shared::limits::MAX_EXPRESSIONS;
use rhytid_shared::{Character, DEFAULT_CHARACTER_GLB, FaceFrame, HeadPose, TrackingData, TrackingFrame};
use solve_fixture::{character_with_zones, feed, hello, landmark_frame, weight_frame};
use std::alloc::{GlobalAlloc, Layout as MemoryLayout, System};
use std::cell::Cell;

thread_local! {
    static NUM_ALLOCATIONS: Cell<usize> = const { Cell::new(0) };
}

struct Counting;

// SAFETY: every call goes on to the system's allocator unchanged; the counter is of the thread and allocates nothing.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: MemoryLayout) -> *mut u8 {
        NUM_ALLOCATIONS.set(NUM_ALLOCATIONS.get() + 1);
        // SAFETY: the caller's promise is passed on.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: MemoryLayout) {
        // SAFETY: the caller's promise is passed on.
        unsafe { System.dealloc(pointer, layout) }
    }

    unsafe fn realloc(&self, pointer: *mut u8, layout: MemoryLayout, new_size: usize) -> *mut u8 {
        NUM_ALLOCATIONS.set(NUM_ALLOCATIONS.get() + 1);
        // SAFETY: the caller's promise is passed on.
        unsafe { System.realloc(pointer, layout, new_size) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

#[test]
fn frames_allocate_nothing() {
    let character = character_with_zones();
    let mut solver = Solver::new(character.clone(), &SolveConfig::default(), &hello(Some(Layout::Ibug68), None)).expect("a good session");
    let mut out = FaceFrame::at_rest(&character);
    // Only a new neutral may: it is trained on, five times in the first minute and a half.
    let frames = feed(&character, 900);
    let mut num_allocating = 0;
    for frame in &frames {
        let before = NUM_ALLOCATIONS.get();
        solver.solve(frame, &mut out).expect("a good frame");
        num_allocating += usize::from(NUM_ALLOCATIONS.get() > before);
    }
    // First frame, first neutral, looks at 5, 10 and 20 s.
    assert!(num_allocating <= 5, "{num_allocating} of {} frames allocated", frames.len());

    let mut solver = Solver::new(character.clone(), &SolveConfig::default(), &hello(None, None)).expect("a good session");
    solver.solve(&weight_frame(0.0, &[]), &mut out).expect("a good frame");
    let weights: Vec<_> = (1..50).map(|i| weight_frame(f64::from(i) * 0.02, &[("jawOpen", 0.01 * i as f32)])).collect();
    let before = NUM_ALLOCATIONS.get();
    for frame in &weights {
        solver.solve(frame, &mut out).expect("a good frame");
    }
    assert_eq!(NUM_ALLOCATIONS.get(), before);
    // Weights drove the zones; expressions do in their stead.
    let mut frames = weights.clone();
    for (i, frame) in frames.iter_mut().enumerate() {
        (frame.t, frame.expressions) = (1.0 + i as f64 * 0.02, Some([0.5; MAX_EXPRESSIONS]));
    }
    let before = NUM_ALLOCATIONS.get();
    for frame in &frames {
        solver.solve(frame, &mut out).expect("a good frame");
    }
    assert_eq!(NUM_ALLOCATIONS.get(), before);
    assert!(out.zones[0] > 0.5);
}

/// The fixture has no shapes that landmarks tell; the built-in character has.
#[test]
fn expression_weights_allocate_nothing() {
    let character = std::sync::Arc::new(Character::from_glb(DEFAULT_CHARACTER_GLB).expect("the built-in character is sound"));
    let mut solver = Solver::new(character.clone(), &SolveConfig::default(), &hello(Some(Layout::Ibug68), None)).expect("a good session");
    let mut out = FaceFrame::at_rest(&character);
    let frames = feed(&character, 100);
    // The first neutral stands by then.
    let (before, after) = frames.split_at(80);
    for frame in before {
        solver.solve(frame, &mut out).expect("a good frame");
    }
    let num = NUM_ALLOCATIONS.get();
    for frame in after {
        solver.solve(frame, &mut out).expect("a good frame");
    }
    assert!(out.shapes.is_some(), "weights are estimated");
    assert_eq!(NUM_ALLOCATIONS.get(), num);
}

/// Frames that allocate after the first `num_first`, through the solve and the encoder.
fn num_allocating(layout: Option<Layout>, frames: &[TrackingFrame], num_first: usize) -> usize {
    let mut pipeline = Pipeline::new(character_with_zones(), &SolveConfig::default(), &hello(layout, None), 1).expect("a good session");
    // The largest packet there is fits.
    let mut packet = Vec::with_capacity(4096);
    let mut num_allocating = 0;
    for (i, frame) in frames.iter().enumerate() {
        let before = NUM_ALLOCATIONS.get();
        pipeline.frame(frame, &mut packet).expect("a good frame");
        num_allocating += usize::from(i >= num_first && NUM_ALLOCATIONS.get() > before);
    }
    num_allocating
}

#[test]
fn packets_allocate_nothing_whatever_they_are_of() {
    let character = character_with_zones();
    // From the third second on the first neutral is there; the next look is at five.
    let landmarks = &feed(&character, 145)[..];
    assert_eq!(num_allocating(Some(Layout::Ibug68), landmarks, 70), 0, "68 points");

    let wide: Vec<TrackingFrame> = landmarks
        .iter()
        .map(|frame| {
            let TrackingData::Landmarks { points, .. } = &frame.data else { panic!("landmarks") };
            let mut wide = vec![[320.0, 240.0, 0.0]; 478];
            for (ibug, &at) in IBUG_FROM_MEDIAPIPE.iter().enumerate() {
                wide[at] = points[ibug];
            }
            for (iris, corners) in [(468, [36, 39]), (473, [42, 45])] {
                wide[iris] = [0, 1, 2].map(|axis| 0.5 * (points[corners[0]][axis] + points[corners[1]][axis]));
            }
            landmark_frame(frame.t, wide)
        })
        .collect();
    assert_eq!(num_allocating(Some(Layout::Mediapipe478), &wide, 70), 0, "478 points");

    let lost: Vec<TrackingFrame> = landmarks
        .iter()
        .enumerate()
        .map(|(i, frame)| if (80..120).contains(&i) { TrackingFrame::new(frame.t, TrackingData::NoFace) } else { frame.clone() })
        .collect();
    assert_eq!(num_allocating(Some(Layout::Ibug68), &lost, 70), 0, "a face lost and found");

    let bones: Vec<TrackingFrame> = (0..100)
        .map(|i| {
            let points = vec![(0, character.bones[0].rest + glam::Vec3::Y * 1e-4 * i as f32), (23, character.bones[23].rest)];
            let head = Some(HeadPose { rotation: glam::Quat::IDENTITY, position: glam::Vec3::X * 1e-3 * i as f32 });
            TrackingFrame::new(f64::from(i) / 60.0, TrackingData::Bones { points, head })
        })
        .collect();
    assert_eq!(num_allocating(None, &bones, 1), 0, "bones");

    let weights: Vec<TrackingFrame> = (0..100).map(|i| weight_frame(f64::from(i) / 60.0, &[("jawOpen", 0.01 * i as f32)])).collect();
    assert_eq!(num_allocating(None, &weights, 1), 0, "weights");
}
