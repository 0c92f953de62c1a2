//! Outputs nobody reads, outputs that are full, and what a terminal would obey.

use crate::support::{Scratch, atlas, delmpc, lamp, run, shell};

#[test]
fn an_output_nobody_reads_ends_quietly_with_the_status_of_the_command() {
    let scratch = Scratch::new("pipe");
    let short = "--set clock=lockstep --set duration_s=0.1 --no-report --out";
    let out = scratch.file("out");
    for command in [
        format!("run $REACH {short} {out}"),
        format!("run $REACH {short} {out} --json"),
        format!("model {}", lamp("lamp.urdf")),
        "completions bash".to_owned(),
        "--help".to_owned(),
        "help run".to_owned(),
        format!("replay {out} --verify"),
        format!("report {out}"),
    ] {
        shell(&format!("$DELMPC {command} | true; exit ${{PIPESTATUS[0]}}")).assert(0, &[]);
        shell(&format!("$DELMPC {command} >&-")).assert(0, &[]);
        // Errors to nowhere: the status says it.
        let ended = shell(&format!("$DELMPC {command} >/dev/full 2>/dev/full"));
        assert_eq!(ended.status, Some(3), "{command}: {ended:?}");
        shell(&format!("$DELMPC {command} >/dev/full")).assert(3, &["standard output cannot be written"]);
    }
}

#[test]
fn names_cannot_give_a_terminal_orders() {
    let scratch = Scratch::with_lamp("escape");
    let scenario =
        scratch.write("escape.toml", "seed = 1\n\"\\u001b]0;owned\\u0007\\u001b[2J\\u009b1m\" = 1\n");
    let mut seen = vec![run(&scratch, &scenario, &[])];
    seen.push(run(&scratch, &scratch.file("reach.toml"), &["--set", "robot.posture=\u{1b}[31m"]));
    seen.push(run(&scratch, &scratch.file("reach.toml"), &["--set", "\u{1b}]0;x\u{7}=1"]));
    seen.push(run(&scratch, &scratch.file("\u{1b}[2Jnone.toml"), &[]));
    scratch.change("lamp.urdf", "neck_roll", "neck&#27;[2J&#155;_roll");
    seen.push(delmpc(&["model", &scratch.file("lamp.urdf")]));
    seen.push(delmpc(&["model", &atlas(), "--base", "fixed:\u{1b}[2J"]));
    let at = scratch.write("at.json", "{\"q\": {\"\\u001b[2J\": 1}}");
    seen.push(delmpc(&["model", &atlas(), "--at", &at]));
    for ended in seen {
        let text = [ended.out.as_str(), &ended.errors].concat();
        assert!(!text.is_empty() && ended.status != Some(101), "{ended:?}");
        assert!(text.chars().all(|c| c == '\n' || !c.is_control()), "{ended:?}");
    }
}
