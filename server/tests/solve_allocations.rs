//! A frame allocates nothing: counted by an allocator of this test's own.

mod solve_fixture;

use rhytid_server::solve::{SolveConfig, Solver};
use rhytid_shared::layout::Layout;
use rhytid_shared::{Character, DEFAULT_CHARACTER_GLB, FaceFrame};
use solve_fixture::{character, feed, hello, weight_frame};
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
    let character = character();
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
