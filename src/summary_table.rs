//! The summary as a person reads it: first what was asked and whether it was reached, then how it went.

use std::fmt::Write as _;

use delmpc_scenario::Scenario;

use crate::colour::Colour;
use crate::output::printable;
use crate::report::criteria::criteria;
use crate::summary::Summary;

/// The table that `delmpc run` ends with; `feet` is the number of soles the robot has.
pub fn summary_table(summary: &Summary, scenario: &Scenario, feet: usize, colour: Colour) -> String {
    let mut text = String::new();
    let verdict = match &summary.failure {
        None => colour.good("success"),
        Some(failure) => format!("{} {}", colour.bad("FAILED:"), printable(failure)),
    };
    let _ = writeln!(text, "{} (seed {}): {verdict}", printable(&summary.scenario), summary.seed);
    // Of a process that left nothing there is nothing to say.
    if summary.plant.is_some() {
        for criterion in criteria(scenario, feet, &summary.to_json()) {
            let mark = match criterion.met {
                Some(true) => colour.good("✓"),
                Some(false) => colour.bad("✗"),
                None => colour.faint("·"),
            };
            let (name, value, limit) = (criterion.name, criterion.value, colour.faint(&criterion.limit));
            let _ = writeln!(text, "  {mark} {name:<26} {value:>12}   {limit}");
        }
    }
    let mut line = |what: &str, value: Option<String>, remark: &str| {
        if let Some(value) = value {
            let line = format!("    {what:<26} {value:>12}   {}", colour.faint(remark));
            let _ = writeln!(text, "{}", if remark.is_empty() { line.trim_end() } else { &line });
        }
    };
    let milliseconds = |seconds: f64| format!("{:.3} ms", 1e3 * seconds);
    let (plant, controller) = (summary.plant.as_ref(), summary.controller.as_ref());
    if let Some(part) = plant {
        line("Simulated time", Some(format!("{:.2} s", part.robot.duration_s)), "");
        let friction = part.robot.max_friction_use.map(|part| format!("{:.0} %", 1e2 * part));
        line("Friction used", friction, "of what the ground gives");
    }
    if let Some(part) = controller {
        let period = format!("one every {:.3} ms", 1e3 * summary.cycle_period_s);
        line("Control cycles", Some(part.cycles.to_string()), &period);
        line("Cycle time, median", part.cycle_time_p50_s.map(milliseconds), "");
        line("Tick to command, median", part.feedback_p50_s.map(milliseconds), "");
        line("Cycle time, 99.9 %", part.cycle_time_p999_s.map(milliseconds), "");
        let timed = part.cycle_time_p50_s.is_some();
        line("Deadlines missed", timed.then(|| part.deadline_misses.to_string()), "");
        line("QP solves", Some(part.qp_solves.to_string()), "the other cycles met no constraint");
        line("Worst fallback level", Some(part.fallback_level_max.to_string()), "0 is a fresh solution");
    }
    if let Some(part) = plant {
        line("State to command, median", part.state_to_command_age_p50_s.map(milliseconds), "");
        line("Plant step, median", part.plant_step_p50_s.map(milliseconds), "");
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_run_that_broke_off_says_why_and_nothing_else() {
        let scenario = Scenario { name: "walk".to_owned(), ..Scenario::default() };
        let summary = Summary::new(&scenario, None, None, Some("the plant was lost".to_owned()));
        let text = summary_table(&summary, &scenario, 2, Colour::NONE);
        assert_eq!(text, "walk (seed 1): FAILED: the plant was lost\n");
    }
}
