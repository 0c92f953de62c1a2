//! The line to whoever has the robot: the semihosting console, which QEMU puts on a socket.
//!
//! A block of bytes is one trap, and a read waits in the emulator: the UART of the machine costs 0.1 ms of emulation a byte, measured. On a
//! real board this file is a driver: a serial line with direct memory access, CAN FD, EtherCAT.
//!
//! Source: Arm, *Semihosting for AArch32 and AArch64*, release 2.0: SYS_OPEN 0x01, SYS_WRITE 0x05, SYS_READ 0x06; ":tt" is the console.

use cortex_m_semihosting::syscall;

/// Name of the console, with the zero at its end.
const CONSOLE: &[u8] = b":tt\0";
const READ_BINARY: usize = 1;
const WRITE_BINARY: usize = 5;

/// The line.
pub struct Line {
    input: usize,
    output: usize,
}

impl Line {
    /// Opens it; `None`: nobody emulates this board.
    pub fn open() -> Option<Self> {
        Some(Self { input: open(READ_BINARY)?, output: open(WRITE_BINARY)? })
    }

    /// Waits for bytes, as many as there are and fit; returns how many.
    pub fn read(&mut self, bytes: &mut [u8]) -> usize {
        // SAFETY: the block is ours, and the emulator writes no more than its length.
        let left = unsafe { syscall!(READ, self.input, bytes.as_mut_ptr() as usize, bytes.len()) };
        bytes.len().saturating_sub(left)
    }

    /// Sends bytes.
    pub fn write(&mut self, bytes: &[u8]) {
        // SAFETY: the emulator reads the block, no more than its length.
        let _ = unsafe { syscall!(WRITE, self.output, bytes.as_ptr() as usize, bytes.len()) };
    }
}

fn open(mode: usize) -> Option<usize> {
    // SAFETY: a name with its length, which the emulator reads.
    let handle = unsafe { syscall!(OPEN, CONSOLE.as_ptr() as usize, mode, CONSOLE.len() - 1) };
    (handle != usize::MAX).then_some(handle)
}
