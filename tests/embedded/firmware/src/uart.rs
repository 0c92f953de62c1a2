//! The serial line of the board: the CMSDK APB UART of Arm's MPS2 boards, polled.
//!
//! Source: *Arm Cortex-M System Design Kit, Technical Reference Manual*, DDI 0479, section 4.3: DATA 0x00, STATE 0x04 (bit 0: transmit buffer
//! full, bit 1: receive buffer full), CTRL 0x08 (bit 0: transmit, bit 1: receive enable), BAUDDIV 0x10. UART0 of the AN500 is at
//! 0x40004000 (Application Note AN500, memory map).

use core::ptr::{read_volatile, write_volatile};

const UART0: usize = 0x4000_4000;
const DATA: *mut u32 = UART0 as *mut u32;
const STATE: *mut u32 = (UART0 + 0x04) as *mut u32;
const CTRL: *mut u32 = (UART0 + 0x08) as *mut u32;
const BAUDDIV: *mut u32 = (UART0 + 0x10) as *mut u32;

/// The line; there is one.
pub struct Uart(());

impl Uart {
    /// Switches it on.
    ///
    /// # Safety
    /// Once, and on a board with that UART.
    pub unsafe fn start() -> Self {
        // SAFETY: the registers of the UART, by the caller's promise.
        unsafe {
            write_volatile(BAUDDIV, 16);
            write_volatile(CTRL, 3);
        }
        Self(())
    }

    /// Waits for a byte.
    pub fn read(&mut self) -> u8 {
        // SAFETY: reading these registers is what they are for.
        unsafe {
            while read_volatile(STATE) & 2 == 0 {}
            read_volatile(DATA) as u8
        }
    }

    /// Sends bytes.
    pub fn write(&mut self, bytes: &[u8]) {
        for byte in bytes {
            // SAFETY: as above; writing the data register sends.
            unsafe {
                while read_volatile(STATE) & 1 != 0 {}
                write_volatile(DATA, u32::from(*byte));
            }
        }
    }
}
