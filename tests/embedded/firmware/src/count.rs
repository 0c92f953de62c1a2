//! Instructions of a control cycle, by the system timer: with `-icount shift=0` the emulator's clock goes on by a nanosecond an instruction.
//!
//! The processor of the machine has 25 MHz, so the timer counts 40 instructions a step. With the feature `count` every cycle is told on the
//! line, in words beside the frames; without it nothing is counted.

#[cfg(feature = "count")]
use cortex_m::peripheral::{SYST, syst::SystClkSource};

/// Largest count of the timer.
#[cfg(feature = "count")]
const RELOAD: u32 = 0x00ff_ffff;
/// Instructions a step of the timer.
#[cfg(feature = "count")]
const INSTRUCTIONS: u32 = 40;

/// Starts the timer.
pub fn start() {
    #[cfg(feature = "count")]
    if let Some(peripherals) = cortex_m::Peripherals::take() {
        let mut timer = peripherals.SYST;
        timer.set_clock_source(SystClkSource::Core);
        timer.set_reload(RELOAD);
        timer.clear_current();
        timer.enable_counter();
    }
}

/// What the timer shows.
pub fn now() -> u32 {
    #[cfg(feature = "count")]
    return SYST::get_current();
    #[cfg(not(feature = "count"))]
    0
}

/// Tells the instructions since `begin` of a tick, where it had a cycle.
pub fn tell(begin: u32, cycled: bool) {
    #[cfg(feature = "count")]
    {
        let steps = begin.wrapping_sub(SYST::get_current()) & RELOAD;
        let kind = if cycled { "cycle" } else { "servo" };
        cortex_m_semihosting::hprintln!("\n{} {}", kind, steps * INSTRUCTIONS);
    }
    let _ = (begin, cycled);
}
