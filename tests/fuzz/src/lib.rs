//! What the fuzz targets share: a count of what they allocate, and the hands.
//!
//! A target is a file in `targets/`, says at its head what it promises, and panics where a promise is broken. `deploy/fuzz`
//! runs all of them; `deploy/fuzz --help` says what it begins with, and how a crash is run again.

pub mod hands;

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;
use std::sync::LazyLock;

use teleop_common::hand::{HandModel, HandSide};

thread_local! {
    static LIVE: Cell<usize> = const { Cell::new(0) };
    static PEAK: Cell<usize> = const { Cell::new(0) };
    static CALLS: Cell<u64> = const { Cell::new(0) };
}

/// Counts what each thread has allocated, and the most that it had at a time.
struct Counting;

fn changed(grown: usize, shrunk: usize) {
    let _ended = LIVE.try_with(|live| {
        live.set(live.get().wrapping_add(grown).wrapping_sub(shrunk));
        PEAK.with(|peak| peak.set(peak.get().max(live.get())));
        CALLS.with(|calls| calls.set(calls.get() + 1));
    });
}

// SAFETY: every call goes to the system's allocator unchanged.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        changed(layout.size(), 0);
        // SAFETY: the caller's contract is passed on.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        changed(0, layout.size());
        // SAFETY: the caller's contract is passed on.
        unsafe { System.dealloc(pointer, layout) }
    }

    unsafe fn realloc(&self, pointer: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        // Old and new exist side by side while one is copied into the other.
        changed(size, 0);
        changed(0, layout.size());
        // SAFETY: the caller's contract is passed on.
        unsafe { System.realloc(pointer, layout, size) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// Does `work`, which must not hold more than `bytes` of the heap at a time.
///
/// # Panics
/// If it did.
#[track_caller]
pub fn within<T>(bytes: usize, work: impl FnOnce() -> T) -> T {
    let before = LIVE.get();
    PEAK.set(before);
    let out = work();
    let most = PEAK.get() - before;
    assert!(most <= bytes, "{most} bytes of heap where {bytes} are allowed");
    out
}

/// Does `work`, which must not touch the heap.
///
/// # Panics
/// If it did.
#[track_caller]
pub fn without_allocating<T>(work: impl FnOnce() -> T) -> T {
    let before = CALLS.get();
    let out = work();
    assert_eq!(CALLS.get() - before, 0, "allocations");
    out
}

/// What is wrong is told in a line or a few, however large the input.
///
/// # Panics
/// If it is not.
#[track_caller]
pub fn brief(error: &impl std::fmt::Display) {
    let length = error.to_string().len();
    assert!((1..4096).contains(&length), "an error of {length} bytes");
}

/// The Allegro hand of a side.
#[must_use]
pub fn allegro(left: bool) -> &'static HandModel {
    static HANDS: LazyLock<[HandModel; 2]> =
        LazyLock::new(|| [HandSide::Right, HandSide::Left].map(HandModel::allegro_v4));
    &HANDS[usize::from(left)]
}

/// Reports panics but for those of the XML parser, which `HandModel::load` catches; libFuzzer's hook would end the
/// process at either. To be called as `init` of a target.
pub fn let_the_parser_panic() {
    std::panic::set_hook(Box::new(|info| {
        if !info.location().is_some_and(|at| at.file().contains("/registry/")) {
            eprintln!("{info}");
        }
    }));
}
