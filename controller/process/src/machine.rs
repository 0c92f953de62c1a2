//! What a real-time process asks of the operating system. A refusal is a warning: the loop then runs with what there is.

use delmpc_scenario::ProcessSettings;
use rustix::mm::{MlockAllFlags, mlockall};
use rustix::process::{Resource, geteuid, getrlimit};
use rustix::thread::{CpuSet, sched_getaffinity, sched_setaffinity};
use thread_priority::{
    RealtimeThreadSchedulePolicy, ThreadPriority, ThreadPriorityValue, ThreadSchedulePolicy,
    set_thread_priority_and_policy, thread_native_id, thread_schedule_policy,
};

/// The smallest real-time priority.
const LEAST_PRIORITY: u8 = 1;

/// Binds the calling thread to a core, raises it to SCHED_FIFO and keeps all memory in RAM, as far as asked and permitted. Returns a
/// warning for everything refused.
///
/// Threads made afterwards inherit core and priority: make helpers before.
pub fn prepare(settings: &ProcessSettings, core: Option<usize>) -> Vec<String> {
    let mut warnings = Vec::new();
    if let Some(core) = core.filter(|core| !bind_to_core(*core)) {
        warnings.push(format!("core {core} does not exist or is not ours: any core is used"));
    }
    if settings.lock_memory {
        // With a limit, a lock that succeeds now would make later allocations fail.
        let unlimited = geteuid().is_root() || getrlimit(Resource::Memlock).current.is_none();
        if !unlimited || mlockall(MlockAllFlags::CURRENT | MlockAllFlags::FUTURE).is_err() {
            warnings.push("memory is not locked (RLIMIT_MEMLOCK): a page fault may delay a cycle".to_owned());
        }
    }
    if settings.priority > 0 && !raise_priority(settings.priority) {
        let message =
            "no real-time priority (CAP_SYS_NICE or RLIMIT_RTPRIO): other programs may delay a cycle";
        warnings.push(message.to_owned());
    }
    warnings
}

/// The cores this process may use; none when the operating system does not say.
pub fn available_cores() -> Vec<usize> {
    let Ok(cores) = sched_getaffinity(None) else { return Vec::new() };
    (0..CpuSet::MAX_CPU).filter(|core| cores.is_set(*core)).collect()
}

/// Binds the calling thread to a core; says whether that succeeded.
pub fn bind_to_core(core: usize) -> bool {
    let mut cores = CpuSet::new();
    let exists = core < CpuSet::MAX_CPU;
    if exists {
        cores.set(core);
    }
    exists && sched_setaffinity(None, &cores).is_ok()
}

/// Whether the calling thread has a real-time priority.
pub fn is_realtime() -> bool {
    matches!(thread_schedule_policy(), Ok(ThreadSchedulePolicy::Realtime(_)))
}

/// Puts the calling thread before all programs of ordinary priority, and after every loop with a real-time priority of its own; says whether
/// that was permitted. For work that has to be done soon, but not in time.
pub fn go_before_ordinary_programs() -> bool {
    raise_priority(LEAST_PRIORITY)
}

fn raise_priority(priority: u8) -> bool {
    let Ok(value) = ThreadPriorityValue::try_from(priority) else {
        return false;
    };
    let policy = ThreadSchedulePolicy::Realtime(RealtimeThreadSchedulePolicy::Fifo);
    set_thread_priority_and_policy(thread_native_id(), ThreadPriority::Crossplatform(value), policy).is_ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_not_asked_is_not_refused() {
        let settings = ProcessSettings { priority: 0, lock_memory: false, ..ProcessSettings::default() };
        assert_eq!(prepare(&settings, None), Vec::<String>::new());
    }

    #[test]
    fn a_core_that_does_not_exist_is_a_warning() {
        let settings = ProcessSettings { priority: 0, lock_memory: false, ..ProcessSettings::default() };
        for core in [usize::MAX, CpuSet::MAX_CPU - 1] {
            assert_eq!(prepare(&settings, Some(core)).len(), 1, "core {core}");
        }
    }
}
