//! Work of ordinary priority that gets in the loop's way: memory bandwidth, cache, system calls, on every core of the loop.

use std::hint::black_box;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread::{Builder, JoinHandle};

use delmpc_controller_process::machine::prepare;
use delmpc_scenario::ProcessSettings;
use delmpc_transport::SplitMix64;

use crate::verdict::Failure;

/// Bytes the copying thread goes through: far beyond any cache.
const STREAM_BYTES: usize = 64 << 20;
/// Bytes the cache thread hits at random: about what a core's share of the last cache holds.
const CACHE_BYTES: usize = 4 << 20;
/// Bytes of a cache line.
const LINE: usize = 64;

/// What a thread of the load does.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Work {
    Memory,
    Cache,
    SystemCalls,
}

/// The running load.
#[derive(Debug)]
pub struct CoLoad {
    stop: Arc<AtomicBool>,
    rounds: Arc<[AtomicU64; 3]>,
    threads: Vec<JoinHandle<()>>,
}

/// How much the load did: it is no load that did nothing.
#[derive(Debug, Clone, Copy, Default, PartialEq, serde::Serialize)]
pub struct LoadDone {
    /// Bytes copied.
    pub copied_bytes: u64,
    /// Cache lines written at random.
    pub lines_written: u64,
    /// System calls.
    pub system_calls: u64,
}

impl CoLoad {
    /// Starts three threads on each core.
    ///
    /// # Errors
    /// When there can be no further thread.
    pub fn start(cores: &[usize]) -> Result<Self, Failure> {
        let mut load = Self { stop: Arc::default(), rounds: Arc::default(), threads: Vec::new() };
        let mut distinct = cores.to_vec();
        distinct.dedup();
        for core in distinct {
            for work in [Work::Memory, Work::Cache, Work::SystemCalls] {
                let (stop, rounds) = (load.stop.clone(), load.rounds.clone());
                let thread = Builder::new().name("co-load".to_owned());
                let started = thread.spawn(move || {
                    // Pinned only; where that is refused, it loads whichever core it gets.
                    let settings = ProcessSettings { priority: 0, lock_memory: false, ..Default::default() };
                    let _ = prepare(&settings, Some(core));
                    match work {
                        Work::Memory => copy_memory(&stop, &rounds[0]),
                        Work::Cache => hit_cache(&stop, &rounds[1]),
                        Work::SystemCalls => call_system(&stop, &rounds[2]),
                    }
                });
                load.threads.push(started.map_err(Failure::fault)?);
            }
        }
        Ok(load)
    }

    /// Ends it and says what it did.
    pub fn finish(self) -> LoadDone {
        self.stop.store(true, Ordering::Relaxed);
        for thread in self.threads {
            let _ = thread.join();
        }
        let [memory, cache, calls] = [0, 1, 2].map(|kind| self.rounds[kind].load(Ordering::Relaxed));
        LoadDone { copied_bytes: memory, lines_written: cache, system_calls: calls }
    }
}

fn copy_memory(stop: &AtomicBool, done: &AtomicU64) {
    const PIECE: usize = 1 << 20;
    let (from, mut to) = (vec![1_u8; STREAM_BYTES], vec![0_u8; STREAM_BYTES]);
    for offset in (0..STREAM_BYTES).step_by(PIECE).cycle() {
        if stop.load(Ordering::Relaxed) {
            break;
        }
        let piece = offset..offset + PIECE;
        to[piece.clone()].copy_from_slice(black_box(&from[piece]));
        black_box(&to);
        done.fetch_add(PIECE as u64, Ordering::Relaxed);
    }
}

fn hit_cache(stop: &AtomicBool, done: &AtomicU64) {
    const ROUND: u64 = 1000;
    let mut memory = vec![0_u8; CACHE_BYTES];
    let mut random = SplitMix64::new(1);
    while !stop.load(Ordering::Relaxed) {
        for _ in 0..ROUND {
            let line = random.up_to((CACHE_BYTES / LINE - 1) as u64) as usize * LINE;
            memory[line] = memory[line].wrapping_add(1);
        }
        black_box(&memory);
        done.fetch_add(ROUND, Ordering::Relaxed);
    }
}

fn call_system(stop: &AtomicBool, done: &AtomicU64) {
    const CALLS: u64 = 1000;
    while !stop.load(Ordering::Relaxed) {
        for _ in 0..CALLS {
            black_box(rustix::process::getppid());
        }
        // Fresh pages: faults, and a map that changes.
        black_box(vec![1_u8; 1 << 20]);
        done.fetch_add(CALLS, Ordering::Relaxed);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_kind_of_load_works_and_ends() {
        let load = CoLoad::start(&[0, 0]).unwrap();
        assert_eq!(load.threads.len(), 3, "one core is loaded once");
        while load.rounds.iter().any(|rounds| rounds.load(Ordering::Relaxed) == 0) {
            std::thread::yield_now();
        }
        let done = load.finish();
        assert!(done.copied_bytes > 0 && done.lines_written > 0 && done.system_calls > 0, "{done:?}");
    }
}
