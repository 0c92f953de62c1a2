//! The heap of the constructors: none is used after the start.
//!
//! A microcontroller that allocates while it controls will one day find no block large enough. So the heap is sealed when the constructors
//! are done: a request after that is counted and refused.

use core::alloc::{GlobalAlloc, Layout};
use core::mem::MaybeUninit;
use core::ptr::{addr_of_mut, null_mut};
use core::sync::atomic::{AtomicBool, AtomicU32, AtomicUsize, Ordering};

use embedded_alloc::LlffHeap;

/// Bytes of the heap.
pub const ARENA: usize = 2 << 20;

static mut MEMORY: [MaybeUninit<u8>; ARENA] = [MaybeUninit::uninit(); ARENA];

/// A first-fit heap that can be sealed.
pub struct ConstructorsOnly {
    heap: LlffHeap,
    sealed: AtomicBool,
    late: AtomicU32,
    highest: AtomicUsize,
}

// SAFETY: the heap's promises are kept by the heap; sealed, no block is handed out at all.
unsafe impl GlobalAlloc for ConstructorsOnly {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        if self.sealed.load(Ordering::Relaxed) {
            self.late.fetch_add(1, Ordering::Relaxed);
            return null_mut();
        }
        // SAFETY: the caller's layout is passed on.
        let block = unsafe { self.heap.alloc(layout) };
        self.highest.fetch_max(block as usize + layout.size(), Ordering::Relaxed);
        block
    }

    unsafe fn dealloc(&self, block: *mut u8, layout: Layout) {
        // SAFETY: the block came from the same heap.
        unsafe { self.heap.dealloc(block, layout) }
    }
}

impl ConstructorsOnly {
    /// Without memory yet.
    pub const fn new() -> Self {
        Self {
            heap: LlffHeap::empty(),
            sealed: AtomicBool::new(false),
            late: AtomicU32::new(0),
            highest: AtomicUsize::new(0),
        }
    }

    /// Gives it its memory.
    ///
    /// # Safety
    /// Once, before anything is allocated.
    pub unsafe fn start(&self) {
        // SAFETY: nobody else uses this memory, by the caller's promise.
        unsafe { self.heap.init(addr_of_mut!(MEMORY) as usize, ARENA) }
    }

    /// From here on every request is refused and counted.
    pub fn seal(&self) {
        self.sealed.store(true, Ordering::Relaxed);
    }

    /// Bytes a heap must have for what was asked of it so far: up to the end of the highest block.
    pub fn needed(&self) -> usize {
        self.highest.load(Ordering::Relaxed).saturating_sub(addr_of_mut!(MEMORY) as usize)
    }

    /// Requests after the seal.
    pub fn late(&self) -> u32 {
        self.late.load(Ordering::Relaxed)
    }
}
