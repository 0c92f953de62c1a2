//! Every fault of messages in the project's fault scenario, each in a run of its own: which rung of the ladder it leads to, and that the robot
//! stands. The faults of processes need real time and minutes: `delmpc timing --faults`, or
//! `cargo test --test lockstep faults -- --ignored`; the quickest of them are in `two_processes`.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

use std::path::Path;
use std::process::Command;
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};

use delmpc::setup::{FAULT_SCENARIO, Setup};
use delmpc::timing::campaign::{Trial, message_trial};
use delmpc_controller_process::stop::StopFlag;
use delmpc_messages::FallbackLevel;
use delmpc_scenario::{FaultKind, FaultSettings, FaultTarget, Scenario};

/// Sooner and shorter than in the file, and still long enough to fall after the longest fault.
const START_S: f64 = 0.2;
const DURATION: &str = "duration_s=1.0";

fn setup() -> Setup {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join(FAULT_SCENARIO);
    let mut setup = Setup::read(&file, &[DURATION.to_owned()]).unwrap();
    setup.scenario.fault.iter_mut().for_each(|fault| fault.start_s = START_S);
    setup
}

/// All trials of some faults, as many at a time as there are cores.
fn trials(setup: &Setup, faults: &[FaultSettings]) -> Vec<Trial> {
    let next = AtomicUsize::new(0);
    let done = Mutex::new(vec![None; faults.len()]);
    std::thread::scope(|scope| {
        for _ in 0..std::thread::available_parallelism().unwrap().get() {
            scope.spawn(|| {
                while let Some((index, fault)) = {
                    let index = next.fetch_add(1, Ordering::Relaxed);
                    faults.get(index).map(|fault| (index, fault))
                } {
                    let trial = message_trial(setup, fault, &StopFlag::never()).unwrap();
                    done.lock().unwrap()[index] = Some(trial);
                }
            });
        }
    });
    done.into_inner().unwrap().into_iter().map(Option::unwrap).collect()
}

#[test]
fn every_fault_of_messages_is_stood_on_the_first_rungs() {
    let setup = setup();
    let faults: Vec<FaultSettings> =
        setup.scenario.fault.iter().filter(|fault| fault.kind.is_of_messages()).cloned().collect();
    assert!(faults.len() >= 20);
    let (fresh, shifted) = (FallbackLevel::FreshSolution as u32, FallbackLevel::ShiftedPlan as u32);
    for (fault, trial) in faults.iter().zip(trials(&setup, &faults)) {
        assert_eq!(trial.non_finite_torques, Some(0), "{trial:?}");
        assert_eq!(trial.wrong, None, "{trial:?}");
        assert!(trial.fate.starts_with("stood"), "{trial:?}");
        let (states, commands) = (trial.states_refused.unwrap(), trial.commands_refused.unwrap());
        let count = u64::from(fault.count);
        match (fault.target, fault.kind) {
            // A tenth of a second without commands is bridged by the last one.
            (FaultTarget::Command, FaultKind::Lost) => {
                assert_eq!((trial.fallback_level_max, states, commands), (Some(fresh), 0, 0), "{trial:?}");
            }
            (FaultTarget::Command, _) => {
                assert_eq!(
                    (trial.fallback_level_max, states, commands),
                    (Some(fresh), 0, count),
                    "{trial:?}"
                );
            }
            // An old state is believed until it is too old.
            (_, FaultKind::Lost | FaultKind::Repeated) => {
                assert_eq!((trial.fallback_level_max, commands), (Some(shifted), 0), "{trial:?}");
                assert!(states > 0 && states < count, "{trial:?}");
            }
            _ => {
                assert_eq!(
                    (trial.fallback_level_max, states, commands),
                    (Some(shifted), count, 0),
                    "{trial:?}"
                );
            }
        }
    }
}

#[test]
fn a_long_silence_leads_down_the_ladder() {
    let setup = Setup { scenario: Scenario { duration_s: 2.0, ..setup().scenario }, ..setup() };
    let silent = |target| FaultSettings { count: 1000, target, start_s: START_S, ..FaultSettings::default() };
    let found = trials(&setup, &[silent(FaultTarget::Command), silent(FaultTarget::State)]);
    let [commands, states] = &found[..] else { panic!("{found:?}") };
    // The plant's watchdog steps in for the commands, the controller's ladder for the states.
    assert!(commands.watchdog_level_max.unwrap() >= FallbackLevel::GravityHold as u32, "{commands:?}");
    assert!(states.fallback_level_max.unwrap() >= FallbackLevel::GravityHold as u32, "{states:?}");
    for trial in &found {
        assert_eq!(trial.non_finite_torques, Some(0), "{trial:?}");
    }
}

/// A command carries the plan of the next tenth of a second: it is not held beyond the stage it is right for.
#[test]
fn a_reach_and_a_push_are_done_with_two_thirds_of_the_commands_or_the_states_lost() {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("configs/scenarios/atlas_one_foot.toml");
    let course = "reach.start_s=0.2 reach.hold_s=0.2 reach.return_s=1.0 push.start_s=2.9 duration_s=3.8";
    let settings: Vec<String> = course.split(' ').map(str::to_owned).collect();
    let setup = Setup::read(&file, &settings).unwrap();
    let lost = |target| FaultSettings {
        target,
        start_s: START_S,
        count: 1000,
        probability: 0.67,
        must_stand: true,
        ..FaultSettings::default()
    };
    for trial in trials(&setup, &[lost(FaultTarget::Command), lost(FaultTarget::State)]) {
        assert_eq!((trial.wrong.as_deref(), trial.non_finite_torques), (None, Some(0)), "{trial:?}");
    }
}

#[test]
#[ignore = "minutes, in real time: every fault with the real processes"]
fn every_fault_of_processes() {
    let folder = std::env::temp_dir().join(format!("delmpc-faults-{}", std::process::id()));
    let output = Command::new(env!("CARGO_BIN_EXE_delmpc"))
        .args(["timing", "--faults", "--out", folder.to_str().unwrap()])
        .current_dir(env!("CARGO_MANIFEST_DIR"))
        .output()
        .unwrap();
    let text = String::from_utf8_lossy(&output.stdout);
    assert!(output.status.success(), "{text}{}", String::from_utf8_lossy(&output.stderr));
    std::fs::remove_dir_all(folder).unwrap();
}
