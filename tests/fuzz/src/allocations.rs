//! An allocator that counts what a thread holds while an input is read.

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;
use std::io::Write as _;

/// A single allocation above this is refused while an input is read: reserved memory that is never touched
/// would not be missed otherwise, and a reader that asks for it believes a count in a file.
const LARGEST: u64 = 1 << 30;

#[derive(Clone, Copy)]
struct Count {
    watching: bool,
    /// What is held, less what was held at the start: memory of before may be given back.
    held: i64,
    most: i64,
}

thread_local! {
    static COUNT: Cell<Count> = const { Cell::new(Count { watching: false, held: 0, most: 0 }) };
}

/// Put this in a test binary as its `#[global_allocator]`.
///
/// Threads are counted apart, so other tests may run meanwhile, and what a reader does on other threads is
/// not seen.
#[derive(Debug)]
pub struct Counting;

/// Starts to count on this thread.
pub fn start() {
    COUNT.set(Count { watching: true, held: 0, most: 0 });
}

/// Ends it, and says how many bytes were held at most.
pub fn stop() -> u64 {
    let count = COUNT.get();
    COUNT.set(Count { watching: false, ..count });
    count.most.max(0) as u64
}

/// Notes `bytes` more or fewer; false where they are more than any reader may ask for.
fn note(bytes: i64) -> bool {
    // A thread that ends frees after its locals are gone; nobody watches it any more.
    COUNT
        .try_with(|cell| {
            let mut count = cell.get();
            if count.watching {
                if bytes > LARGEST as i64 {
                    tell(bytes);
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

/// Says which input it was before the program ends, past what captures the output of a test and without
/// allocating.
fn tell(bytes: i64) {
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

// SAFETY: memory comes from `System` and goes back to it with the layout that it came with; counting touches
// a `Cell` without destructor and allocates nothing. Null where too much is asked for is what a global
// allocator gives that has no more.
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
        // Both are held while their content is copied.
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
