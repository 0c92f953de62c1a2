//! The heap of the constructors: memory handed out from the front of an arena, none taken back, none after the start.
//!
//! A microcontroller that allocates while it controls will one day find no block large enough. So the heap is sealed when the constructors
//! are done: a request after that is counted and refused, and the firmware stops its motors instead.

use core::alloc::{GlobalAlloc, Layout};
use core::cell::UnsafeCell;
use core::ptr::null_mut;
use core::sync::atomic::{AtomicBool, AtomicU32, AtomicUsize, Ordering};

/// Bytes of the arena.
pub const ARENA: usize = 3 << 20;
const ALIGNMENT: usize = 64;

#[repr(align(64))]
struct Arena(UnsafeCell<[u8; ARENA]>);

/// The allocator.
pub struct ConstructorsOnly {
    arena: Arena,
    used: AtomicUsize,
    sealed: AtomicBool,
    late: AtomicU32,
}

// SAFETY: every byte of the arena is handed out at most once, because `used` only grows, atomically.
unsafe impl Sync for ConstructorsOnly {}

// SAFETY: blocks lie inside the arena, are aligned as asked (the arena is aligned to 64 bytes, more is refused) and disjoint, but for a
// last block that is given back or grows in place.
unsafe impl GlobalAlloc for ConstructorsOnly {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        if self.sealed.load(Ordering::Relaxed) {
            self.late.fetch_add(1, Ordering::Relaxed);
            return null_mut();
        }
        if layout.align() > ALIGNMENT {
            return null_mut();
        }
        let mut used = self.used.load(Ordering::Relaxed);
        loop {
            let start = used.next_multiple_of(layout.align());
            let Some(end) = start.checked_add(layout.size()).filter(|end| *end <= ARENA) else {
                return null_mut();
            };
            match self.used.compare_exchange_weak(used, end, Ordering::Relaxed, Ordering::Relaxed) {
                // SAFETY: `start` is inside the arena.
                Ok(_) => return unsafe { self.arena.0.get().cast::<u8>().add(start) },
                Err(now) => used = now,
            }
        }
    }

    unsafe fn dealloc(&self, block: *mut u8, layout: Layout) {
        // The last block can be taken back: vectors that live for a line of a constructor cost nothing.
        let start = block as usize - self.arena.0.get() as usize;
        let end = start + layout.size();
        let _ = self.used.compare_exchange(end, start, Ordering::Relaxed, Ordering::Relaxed);
    }
}

impl ConstructorsOnly {
    /// An empty heap.
    pub const fn new() -> Self {
        Self {
            arena: Arena(UnsafeCell::new([0; ARENA])),
            used: AtomicUsize::new(0),
            sealed: AtomicBool::new(false),
            late: AtomicU32::new(0),
        }
    }

    /// From here on every request is refused and counted.
    pub fn seal(&self) {
        self.sealed.store(true, Ordering::Relaxed);
    }

    /// Bytes handed out.
    pub fn used(&self) -> usize {
        self.used.load(Ordering::Relaxed)
    }

    /// Requests after the seal.
    pub fn late(&self) -> u32 {
        self.late.load(Ordering::Relaxed)
    }
}
