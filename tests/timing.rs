//! `delmpc timing` as a person calls it, for a second: what it leaves and how it ends. No figure is asserted: those are the machine's.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

use std::path::PathBuf;
use std::process::{Command, Output, Stdio};

use serde_json::Value;

fn timing(name: &str, more: &[&str]) -> (Output, PathBuf) {
    let folder = std::env::temp_dir().join(format!("delmpc-timing-{}-{name}", std::process::id()));
    let output = Command::new(env!("CARGO_BIN_EXE_delmpc"))
        .args(["timing", "--duration", "1", "--no-rt", "--out", folder.to_str().unwrap()])
        .args(more)
        .current_dir(env!("CARGO_MANIFEST_DIR"))
        .stdin(Stdio::null())
        .output()
        .unwrap();
    (output, folder)
}

#[test]
fn a_report_says_what_was_kept_and_the_exit_status_too() {
    // Without privileges, as on any machine.
    let (output, folder) = timing("plain", &["--json"]);
    let errors = String::from_utf8_lossy(&output.stderr);
    let report: Value = serde_json::from_slice(&output.stdout).unwrap_or_else(|_| panic!("{errors}"));
    let in_file: Value = serde_json::from_slice(&std::fs::read(folder.join("timing.json")).unwrap()).unwrap();
    assert_eq!(report, in_file);
    let kept = report["kept"].as_bool().unwrap();
    assert_eq!(output.status.code(), Some(if kept { 0 } else { 3 }), "{errors}");
    let broken = report["criteria"].as_array().unwrap().iter().any(|c| c["kept"] == false);
    assert_eq!(kept, !broken, "{errors}");

    let loops = report["loops"].as_array().unwrap();
    assert_eq!(loops.len(), 2, "alone and under co-load");
    for figures in loops {
        assert_eq!(figures["fault"], Value::Null);
        let cycles = figures["cycles"].as_u64().unwrap();
        assert!(cycles > 10);
        let missed: u64 = figures["missed_by"].as_array().unwrap().iter().map(|n| n.as_u64().unwrap()).sum();
        assert_eq!(figures["missed"], missed);
        let again = &figures["again"];
        assert!(
            again["passes"].as_u64().unwrap() >= 2,
            "the cycles come out the same again: {}",
            report["warnings"]
        );
        assert_eq!(again["least"]["figures"]["count"].as_u64().unwrap(), cycles);
        for quantity in figures["quantities"].as_array().unwrap() {
            let (count, bars) = (quantity["figures"]["count"].as_u64(), quantity["bars"].as_array().unwrap());
            let in_bars: u64 = bars.iter().map(|bar| bar["count"].as_u64().unwrap()).sum();
            assert_eq!(count.unwrap_or(0), in_bars, "{quantity}");
        }
        let stage = |key: &str| {
            let all = figures["quantities"].as_array().unwrap();
            all.iter().find(|quantity| quantity["key"] == key).unwrap()["figures"]["p50_s"].as_f64().unwrap()
        };
        let stages: f64 =
            ["stage_statein", "stage_linearize", "stage_riccati", "stage_qp"].map(stage).iter().sum();
        assert!(stages > 0.0 && stages < 1.5 * stage("cycle"), "{stages} s of {} s", stage("cycle"));
    }
    let load = &loops[1]["load"];
    assert!(load["copied_bytes"].as_u64().unwrap() > 0 && load["system_calls"].as_u64().unwrap() > 0);
    let idle = report["idle_floor"].as_array().unwrap();
    assert!(idle.iter().all(|floor| floor["wake_up"]["figures"]["count"].as_u64().unwrap() > 0));
    if let Some(transport) = report["transport"].as_object() {
        assert!(transport["ratio_to_flag"].as_f64().unwrap() > 1.0, "a message is no faster than a flag");
    }
    std::fs::remove_dir_all(folder).unwrap();
}

#[test]
fn a_threshold_nobody_can_keep_is_exit_status_3_and_is_named() {
    let (output, folder) =
        timing("broken", &["--one-core", "--no-load", "--set", "timing.max_cycle_p999_s=0"]);
    assert_eq!(output.status.code(), Some(3));
    let (table, errors) = (String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    assert!(errors.contains("timing.max_cycle_p999_s"), "{errors}");
    assert!(table.contains("BROKEN") && table.contains("core 0"), "{table}");
    std::fs::remove_dir_all(folder).unwrap();
}

#[test]
fn what_makes_no_sense_is_refused() {
    for (more, text) in [
        (&["--duration", "0"][..], "--duration"),
        (&["--set", "timing.compute_spread=0.5"], "timing.compute_spread"),
        (&["--set", "timing.mises=1"], "timing.mises"),
    ] {
        let output = Command::new(env!("CARGO_BIN_EXE_delmpc"))
            .arg("timing")
            .args(more)
            .current_dir(env!("CARGO_MANIFEST_DIR"))
            .output()
            .unwrap();
        assert_eq!(output.status.code(), Some(2));
        assert!(String::from_utf8_lossy(&output.stderr).contains(text));
    }
}
