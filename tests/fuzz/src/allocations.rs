//! An allocator that counts a thread's memory while it reads an input.

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;
use std::io::Write as _;

/// A single allocation above this is refused while an input is read. A reader that requests it trusts a count
/// in the file; reserved memory that is never touched would otherwise go unnoticed.
const LARGEST: u64 = 1 << 30;

#[derive(Clone, Copy)]
struct Count {
    watching: bool,
    /// Bytes held, minus those at the start; it may be negative when older memory is freed.
    held: i64,
    most: i64,
}

thread_local! {
    static COUNT: Cell<Count> = const { Cell::new(Count { watching: false, held: 0, most: 0 }) };
}

/// Put this in a test binary as its `#[global_allocator]`.
///
/// Each thread is counted separately, so other tests may run at the same time. A reader's allocations on
/// other threads are not counted.
#[derive(Debug)]
pub struct Counting;

/// Starts to count on this thread.
pub fn start() {
    COUNT.set(Count { watching: true, held: 0, most: 0 });
}

/// Stops counting; returns the peak, bytes.
pub fn stop() -> u64 {
    let count = COUNT.get();
    COUNT.set(Count { watching: false, ..count });
    count.most.max(0) as u64
}

/// Records a change of `bytes`; false if it exceeds the limit of any reader.
fn note(bytes: i64) -> bool {
    // An ending thread frees memory after its locals are gone; it is no longer counted.
    COUNT
        .try_with(|cell| {
            let mut count = cell.get();
            if count.watching {
                if bytes > LARGEST as i64 {
                    record(bytes);
                    return false;
                }
                count.held += bytes;
                count.most = count.most.max(count.held);
                cell.set(count);
            }
            true
        })
        .unwrap_or(true)
}

/// Prints the number of the input before the program ends, bypassing the test's output capture and without
/// allocating.
fn record(bytes: i64) {
    let (seed, number) = crate::watch::current();
    let _ = writeln!(
        std::io::stderr(),
        "input {number} of seed {seed} asks for {bytes} bytes at once; replay it with FATHOM_FUZZ_SEED={seed} \
         FATHOM_FUZZ_INPUT={number}"
    );
}

/// A size as a signed number; no allocation has more than `isize::MAX` bytes.
fn signed(bytes: usize) -> i64 {
    i64::try_from(bytes).unwrap_or(i64::MAX)
}

// SAFETY: memory comes from `System` and returns to it with the same layout. Counting uses a `Cell` without
// destructor and allocates nothing. A global allocator may return null when a request is too large.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        if !note(signed(layout.size())) {
            return std::ptr::null_mut();
        }
        // SAFETY: the caller's layout, unchanged.
        unsafe { System.alloc(layout) }
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        if !note(signed(layout.size())) {
            return std::ptr::null_mut();
        }
        // SAFETY: the caller's layout, unchanged.
        unsafe { System.alloc_zeroed(layout) }
    }

    unsafe fn realloc(&self, memory: *mut u8, layout: Layout, new_size: usize) -> *mut u8 {
        // During the copy, both blocks are held.
        if !note(signed(new_size)) {
            return std::ptr::null_mut();
        }
        note(-signed(layout.size()));
        // SAFETY: the caller's block, which is from `System`, and the layout that it has.
        unsafe { System.realloc(memory, layout, new_size) }
    }

    unsafe fn dealloc(&self, memory: *mut u8, layout: Layout) {
        note(-signed(layout.size()));
        // SAFETY: the caller's block, which is from `System`, and the layout that it has.
        unsafe { System.dealloc(memory, layout) }
    }
}
