//! The report as a person reads it.

use std::fmt::Write as _;

use crate::timing::TimingReport;
use crate::timing::attribution::Cause;
use crate::timing::figures::Figures;
use crate::timing::phases::{LoopFigures, Quantity};

/// Missed deadlines shown one by one.
const MISSES_SHOWN: usize = 12;

/// The whole report.
pub fn table(report: &TimingReport) -> String {
    let mut text = String::new();
    let verdict = if report.kept { "kept" } else { "BROKEN" };
    let _ = writeln!(text, "{} (seed {}): timing {verdict}", report.scenario, report.seed);
    let _ = writeln!(text, "  {}", report.machine.line());
    let [plant, controller] = report.cores;
    let _ = writeln!(
        text,
        "  plant on core {plant} every {:.1} ms, controller on core {controller} every {:.1} ms, {:.0} s",
        1e3 * report.step_s,
        1e3 * report.period_s,
        report.duration_s
    );
    for warning in &report.warnings {
        let _ = writeln!(text, "  warning: {warning}");
    }
    head(&mut text, "machine's floor: wake-up latency");
    for floor in report.idle_floor.iter().chain(&report.occupied_floor) {
        row(&mut text, &floor.wake_up.name, floor.wake_up.figures.as_ref());
    }
    for floor in &report.occupied_floor {
        let _ = writeln!(
            text,
            "  {}, with work for {:.2} ms of {:.1} ms, misses {} of {} deadlines",
            floor.wake_up.name,
            1e3 * floor.work_s,
            1e3 * floor.period_s,
            floor.missed,
            floor.deadlines
        );
    }
    for figures in &report.loops {
        let here = if figures.loaded { "loop under co-load" } else { "loop alone" };
        head(&mut text, here);
        one_loop(&mut text, figures);
    }
    if let Some(transport) = &report.transport {
        head(&mut text, "transport between two processes that poll");
        for quantity in [
            &transport.flag_round_trip,
            &transport.state_round_trip,
            &transport.state_one_way,
            &transport.command_round_trip,
            &transport.command_one_way,
        ] {
            row(&mut text, &quantity.name, quantity.figures.as_ref());
        }
    }
    text.push('\n');
    for criterion in &report.criteria {
        let mark = if criterion.kept { "kept  " } else { "BROKEN" };
        let _ = write!(
            text,
            "{mark} {:<62} {:>9} at most {}",
            criterion.what,
            number(criterion.value),
            number(criterion.limit)
        );
        let _ = match criterion.note.as_str() {
            "" => writeln!(text, "   ({})", criterion.key),
            note => writeln!(text, "   ({}; {note})", criterion.key),
        };
    }
    text
}

fn one_loop(text: &mut String, figures: &LoopFigures) {
    if let Some(fault) = &figures.fault {
        let _ = writeln!(text, "  broke off: {fault}");
    }
    let again = figures.again.as_ref().map(|again| &again.least);
    for Quantity { name, figures, .. } in figures.quantities.iter().chain(again).chain(&figures.witnesses) {
        row(text, name, figures.as_ref());
    }
    let by = Cause::ALL
        .into_iter()
        .zip(figures.missed_by)
        .map(|(cause, count)| format!("{count} {}", cause.name()));
    let by: Vec<String> = by.collect();
    let _ = writeln!(
        text,
        "  {} cycles, {} disturbed by the machine; {} of {} deadlines missed: {}",
        figures.cycles,
        figures.disturbed_cycles,
        figures.missed,
        figures.deadlines,
        by.join(", ")
    );
    let _ = writeln!(text, "  longest a cycle itself computed: {:.3} ms", 1e3 * figures.own_time_max_s);
    if let Some(again) = &figures.again {
        let _ = writeln!(
            text,
            "  computed again {} times, the same commands bit by bit: of the jitter of a cycle's own time at most {:.0} % is the software's",
            again.passes,
            100.0 * again.software_share_of_jitter
        );
    }
    for (who, counts) in [("controller", figures.controller_counts), ("plant", figures.plant_counts)] {
        let _ = writeln!(
            text,
            "  {who}: {} page faults ({} with the disk), {} involuntary context switches",
            counts.minor_faults + counts.major_faults,
            counts.major_faults,
            counts.involuntary_switches
        );
    }
    let fate = if figures.fell { "fell" } else { "stood" };
    let _ = writeln!(
        text,
        "  the robot {fate}; worst ladder level {} in the controller, {} in the plant; pauses of the plant {}; allocations in a cycle {}",
        figures.fallback_level_max,
        figures.watchdog_level_max,
        figures.plant_pauses,
        figures.allocations_per_cycle_max
    );
    if let Some(load) = &figures.load {
        let _ = writeln!(
            text,
            "  co-load: {:.1} GB copied, {:.1} million cache lines, {:.1} million system calls",
            load.copied_bytes as f64 * 1e-9,
            load.lines_written as f64 * 1e-6,
            load.system_calls as f64 * 1e-6
        );
    }
    for long in &figures.longest_undisturbed {
        let _ = writeln!(
            text,
            "  undisturbed, and long, at {:8.3} s: {:.3} ms, again {:.3} ms, slowness {:.1}, pace {:.1}, QP solves {}; most in {}, {:.3} ms above its median",
            long.time_s,
            long.account.computing_ns() as f64 * 1e-6,
            long.account.software_ns() as f64 * 1e-6,
            long.account.slowness,
            long.account.pace,
            long.qp_solves,
            long.stage.name(),
            1e3 * long.excess_s
        );
    }
    for miss in figures.misses.iter().take(MISSES_SHOWN) {
        let ms = |ns: u64| ns as f64 * 1e-6;
        let _ = write!(
            text,
            "  missed at {:8.3} s by {:6.3} ms ({} in a row): {}; woken late {:.3}, behind {:.3}, taken {:.3}, own {:.3} ms, again {:.3}, slowness {:.1}, pace {:.1}; \
             most in {}",
            miss.time_s,
            1e3 * miss.overrun_s,
            miss.deadlines,
            miss.cause.name(),
            ms(miss.account.late_ns),
            ms(miss.account.backlog_ns),
            ms(miss.account.taken_ns),
            ms(miss.account.own_ns()),
            ms(miss.account.software_ns()),
            miss.account.slowness,
            miss.account.pace,
            miss.stage.name()
        );
        let _ = match miss.robot {
            Some(robot) => writeln!(
                text,
                "; robot: level {}, pressure point {:.1} -> {:.1} mm",
                robot.watchdog_level,
                1e3 * robot.cop_margin_before_m,
                1e3 * robot.cop_margin_least_m
            ),
            None => writeln!(text),
        };
    }
    if figures.misses.len() > MISSES_SHOWN {
        let _ = writeln!(text, "  ... and {} more in timing.json", figures.misses.len() - MISSES_SHOWN);
    }
}

fn head(text: &mut String, title: &str) {
    let _ = writeln!(
        text,
        "\n{title:<42} {:>8} {:>10} {:>10} {:>10} {:>10} {:>10}",
        "count", "p50 µs", "p90 µs", "p99 µs", "p99.9 µs", "max µs"
    );
}

fn row(text: &mut String, name: &str, figures: Option<&Figures>) {
    let _ = match figures {
        None => writeln!(text, "  {name:<40} {:>8}", 0),
        Some(f) => {
            let us = [f.p50_s, f.p90_s, f.p99_s, f.p999_s, f.max_s].map(|s| microseconds(1e6 * s));
            let [p50, p90, p99, p999, max] = us;
            writeln!(text, "  {name:<40} {:>8} {p50:>10} {p90:>10} {p99:>10} {p999:>10} {max:>10}", f.count)
        }
    };
}

fn microseconds(us: f64) -> String {
    if us < 10.0 { format!("{us:.2}") } else { format!("{us:.1}") }
}

/// Three digits, and no tail of zeros.
fn number(value: f64) -> String {
    let text = if value != 0.0 && value.abs() < 0.01 { format!("{value:.5}") } else { format!("{value:.3}") };
    text.trim_end_matches('0').trim_end_matches('.').to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_short() {
        let texts = [0.0, 4.0, 3.456_78, 0.001_25, f64::NAN].map(number);
        assert_eq!(texts, ["0", "4", "3.457", "0.00125", "NaN"]);
        assert_eq!([0.244, 1234.56].map(microseconds), ["0.24", "1234.6"]);
    }
}
