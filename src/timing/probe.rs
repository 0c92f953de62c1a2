//! A fixed piece of work, by whose time one sees how fast a core is just now: half arithmetic, half memory.
//!
//! Cores that share caches and memory with strangers compute slower when those are busy, several times at worst, without ever being taken
//! away: no clock of the operating system tells. The same work, timed again and again, does.
//!
//! A stranger on the other thread of the same core takes its arithmetic units. Work that waits for itself, one multiplication after the
//! other, leaves them idle and hardly feels that; a control cycle keeps them full. So the arithmetic here is many sums that do not wait
//! for each other.

use std::hint::black_box;

/// Bytes the memory half goes through at random: beyond the caches of a single core.
const BYTES: usize = 4 << 20;
/// Bytes of a cache line.
const LINE: usize = 64;
/// Sums that go on side by side: more than an arithmetic unit has under way.
const SUMS: usize = 64;
/// Terms of every sum per access to memory: about as long as one that the shared cache answers.
const TERMS_PER_ACCESS: u32 = 8;
/// What a sum keeps of itself from term to term, so that it stays finite.
const KEPT: f64 = 0.75;
/// Multiplier and increment. Source: D. E. Knuth, MMIX, "The Art of Computer Programming", fascicle 1.
const LCG: (u64, u64) = (6_364_136_223_846_793_005, 1_442_695_040_888_963_407);

/// The work and its memory.
#[derive(Debug, Clone)]
pub struct Probe {
    memory: Vec<u8>,
    state: u64,
    sums: [f64; SUMS],
}

impl Probe {
    /// With all its memory touched.
    pub fn new() -> Self {
        Self { memory: vec![1; BYTES], state: 1, sums: [0.0; SUMS] }
    }

    /// `units` accesses to memory, each of which waits for the arithmetic that goes with the one before.
    pub fn work(&mut self, units: u32) {
        let mut x = self.state;
        for _ in 0..units {
            x = x.wrapping_mul(LCG.0).wrapping_add(LCG.1);
            let line = (x >> 33) as usize % (BYTES / LINE);
            let term = f64::from(self.memory[line * LINE]);
            for _ in 0..TERMS_PER_ACCESS {
                self.sums.iter_mut().for_each(|sum| *sum = *sum * KEPT + term);
            }
            x = x.wrapping_add(black_box(&mut self.sums)[0] as u64);
        }
        self.state = black_box(x);
    }
}

impl Default for Probe {
    fn default() -> Self {
        Self::new()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn work_goes_on_where_it_was() {
        let (mut once, mut twice) = (Probe::new(), Probe::new());
        once.work(300);
        twice.work(100);
        assert_ne!(once.state, twice.state);
        twice.work(200);
        assert_eq!(once.state, twice.state);
        let bound = 1.0 / (1.0 - KEPT);
        assert!(once.sums.iter().all(|sum| *sum > 1.0 && *sum <= bound), "{:?}", once.sums);
    }
}
