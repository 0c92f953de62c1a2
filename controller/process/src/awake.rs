//! Keeps a core from falling asleep while a real-time loop waits on it.
//!
//! A core with nothing to do goes to sleep. It wakes up late, from a deep sleep with empty caches, and a hypervisor gives it to somebody else
//! meanwhile and has to get it back first. So there is always something to do: a thread of the lowest class (`SCHED_IDLE`), which runs only
//! where the core would sleep and makes way for everybody at once, does nothing in a loop. It needs no privilege; it costs power.
//! Elsewhere the same is had from the boot parameter `idle=poll`.

use std::hint::spin_loop;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::{Builder, JoinHandle};

use delmpc_scenario::ProcessSettings;
use thread_priority::{
    NormalThreadSchedulePolicy, ThreadPriority, ThreadSchedulePolicy, set_thread_priority_and_policy,
    thread_native_id,
};

use crate::machine::bind_to_core;

/// Pauses between two looks at whether it is over.
const PAUSES: u32 = 64;

/// A core that is kept awake as long as this lives.
#[derive(Debug)]
pub struct Awake {
    over: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Awake {
    /// Keeps a core awake, where the settings want it and name the core. The thread ends by itself when it cannot have its core or its class:
    /// then it would be in somebody's way.
    pub fn keep(settings: &ProcessSettings, core: Option<usize>) -> Option<Self> {
        let core = core.filter(|_| settings.keep_awake)?;
        let over = Arc::new(AtomicBool::new(false));
        let flag = over.clone();
        let thread = Builder::new().name("awake".to_owned()).spawn(move || {
            if !bind_to_core(core) || !give_way_to_everybody() {
                return;
            }
            while !flag.load(Ordering::Relaxed) {
                (0..PAUSES).for_each(|_| spin_loop());
            }
        });
        Some(Self { over, thread: Some(thread.ok()?) })
    }
}

impl Drop for Awake {
    fn drop(&mut self) {
        self.over.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

fn give_way_to_everybody() -> bool {
    let policy = ThreadSchedulePolicy::Normal(NormalThreadSchedulePolicy::Idle);
    set_thread_priority_and_policy(thread_native_id(), ThreadPriority::Min, policy).is_ok()
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::thread::sleep;
    use std::time::Duration;
    use thread_priority::thread_schedule_policy;

    #[test]
    fn only_what_is_asked_for_is_kept_awake_and_no_longer_than_asked() {
        let asked = ProcessSettings { keep_awake: true, ..ProcessSettings::default() };
        let not_asked = ProcessSettings { keep_awake: false, ..ProcessSettings::default() };
        assert!(Awake::keep(&asked, None).is_none());
        assert!(Awake::keep(&not_asked, Some(0)).is_none());
        let awake = Awake::keep(&asked, Some(0)).unwrap();
        sleep(Duration::from_millis(5));
        drop(awake);
    }

    #[test]
    fn a_core_that_does_not_exist_is_let_alone() {
        let settings = ProcessSettings { keep_awake: true, ..ProcessSettings::default() };
        let mut awake = Awake::keep(&settings, Some(usize::MAX)).unwrap();
        awake.thread.take().unwrap().join().unwrap();
    }

    #[test]
    fn the_lowest_class_is_everybodys_right() {
        let thread = std::thread::spawn(|| (give_way_to_everybody(), thread_schedule_policy()));
        let (given, policy) = thread.join().unwrap();
        assert!(given);
        assert_eq!(policy.unwrap(), ThreadSchedulePolicy::Normal(NormalThreadSchedulePolicy::Idle));
    }
}
