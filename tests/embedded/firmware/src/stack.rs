//! How deep the stack has been: it is painted at the start, and what is no longer paint was used.

use core::ptr::{addr_of, read_volatile, write_volatile};

const PAINT: u32 = 0x5ac3_96a5;
/// What is left alone below the stack pointer while painting, bytes.
const MARGIN: usize = 256;

unsafe extern "C" {
    static _stack_start: u32;
    static __sheap: u32;
}

/// Lowest address the stack may reach, and the one above its first entry.
fn bounds() -> (usize, usize) {
    (addr_of!(__sheap) as usize, addr_of!(_stack_start) as usize)
}

/// Paints what is below the stack pointer.
pub fn paint() {
    let (bottom, _) = bounds();
    let top = cortex_m::register::msp::read() as usize - MARGIN;
    let mut at = bottom.next_multiple_of(4);
    while at < top {
        // SAFETY: between the end of the data and the stack pointer nothing lives.
        unsafe { write_volatile(at as *mut u32, PAINT) };
        at += 4;
    }
}

/// Most bytes used since [`paint`].
pub fn deepest() -> usize {
    let (bottom, top) = bounds();
    let mut at = bottom.next_multiple_of(4);
    // SAFETY: this memory is the board's, and reading it disturbs nobody.
    while at < top && unsafe { read_volatile(at as *const u32) } == PAINT {
        at += 4;
    }
    top - at
}
