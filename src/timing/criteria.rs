//! The thresholds of the scenario, kept or broken.
//!
//! Shares of misses and high percentiles are those of a sample: beyond its limit such a threshold is called broken when chance would hardly
//! have put so many misses or times there ([`chance`]). The note beside it says what was counted.

use delmpc_scenario::TimingSettings;
use serde::Serialize;

use crate::timing::chance::{self, SIGNIFICANCE};
use crate::timing::figures::Times;
use crate::timing::phases::{FloorFigures, LoopFigures, Quantity};
use crate::timing::transport::TransportReport;

/// Part of the cycles that may compute longer than the spread allows.
const SPREAD_REST: f64 = 0.001;

/// Latencies below this cannot be measured (ns): the clock counts nanoseconds.
const LEAST_LATENCY_NS: u64 = 1;

/// One threshold.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Criterion {
    /// Key of the scenario.
    pub key: &'static str,
    /// What and where.
    pub what: String,
    /// What was found.
    pub value: f64,
    /// What is allowed at most.
    pub limit: f64,
    /// Whether it is kept.
    pub kept: bool,
    /// What a person should know about it.
    pub note: String,
}

/// What the thresholds are compared with.
#[derive(Debug)]
pub struct Measured<'a> {
    /// Idle threads.
    pub idle: &'a [FloorFigures],
    /// Occupied threads.
    pub occupied: &'a [FloorFigures],
    /// The loop.
    pub loops: &'a [LoopFigures],
    /// The links.
    pub transport: Option<&'a TransportReport>,
    /// Core of the controller.
    pub controller_core: usize,
}

/// All thresholds.
pub fn criteria(settings: &TimingSettings, measured: &Measured<'_>) -> Vec<Criterion> {
    let mut list = Vec::new();
    for figures in measured.loops {
        let here = if figures.loaded { "under co-load" } else { "alone" };
        list.extend(loop_criteria(settings, measured, figures, here));
    }
    if let Some(ratio) = measured.transport.and_then(|transport| transport.ratio_to_flag) {
        let what = "round trip of a state over that of a flag, medians".to_owned();
        list.push(at_most("timing.round_trip_of_floor", what, ratio, settings.round_trip_of_floor));
    }
    list
}

fn loop_criteria(
    settings: &TimingSettings,
    measured: &Measured<'_>,
    figures: &LoopFigures,
    here: &str,
) -> Vec<Criterion> {
    let mut list = Vec::new();
    let [taken, slow, shared_core, software, unexplained] = figures.missed_by;
    let machine = taken + slow;
    list.push(Criterion {
        note: format!(
            "{software} over budget, {shared_core} by the plant on the same core, {unexplained} unexplained"
        ),
        ..at_most(
            "timing.compute_budget",
            format!("{here}: deadlines missed by the software"),
            (shared_core + software + unexplained) as f64,
            0.0,
        )
    });
    if let Some(spread) = figures.compute_spread {
        let seen = match (&figures.again, figures.compute_spread_seen) {
            (Some(again), Some(seen)) => format!(
                "least of {} computations of each cycle; of this one alone, where no disturbance was seen: {seen:.2}; ",
                again.passes + 1
            ),
            _ => String::new(),
        };
        let criterion = compute_spread(here, &figures.computing, spread, settings.compute_spread);
        list.push(Criterion { note: seen + &criterion.note, ..criterion });
    }
    let same =
        |floor: &&FloorFigures| floor.loaded == figures.loaded && floor.core == measured.controller_core;
    if let Some(floor) = measured.occupied.iter().find(same) {
        let share = machine as f64 / figures.deadlines.max(1) as f64;
        // A floor without a miss has a share of less than one in its deadlines; nothing is infinitely often as many.
        let least_share = 1.0 / floor.deadlines.max(1) as f64;
        let of_floor = if machine == 0 { 0.0 } else { share / floor.missed_share().max(least_share) };
        let (loop_misses, floor_misses) = ((machine, figures.deadlines), (floor.missed, floor.deadlines));
        let counted = format!(
            "{machine} of {} deadlines, floor {} of {}",
            figures.deadlines, floor.missed, floor.deadlines
        );
        let criterion = at_most(
            "timing.misses_of_floor",
            format!("{here}: share of deadlines the machine broke, over the floor's"),
            of_floor,
            settings.misses_of_floor,
        );
        let chance = chance::of_so_many_misses(loop_misses, floor_misses, settings.misses_of_floor);
        list.push(unless_by_chance(criterion, chance, &counted));
    }
    let p99 = |quantity: &Quantity| quantity.figures.map(|figures| figures.p99_s);
    let of = |key: &str| figures.quantities.iter().find(|quantity| quantity.key == key);
    let wake_up = of("wake_up").and_then(p99);
    if let Some(floor) = measured.idle.iter().find(same) {
        list.extend(wake_up_of_floor(here, &figures.late, &floor.late, settings.wake_up_of_floor));
    }
    let absolute = [
        (
            "timing.max_misses",
            "deadlines missed",
            settings.max_misses.map(f64::from),
            Some(figures.missed as f64),
        ),
        ("timing.max_wake_up_p99_s", "wake-up latency, 99 %, s", settings.max_wake_up_p99_s, wake_up),
        (
            "timing.max_cycle_p999_s",
            "cycle, 99.9 %, s",
            settings.max_cycle_p999_s,
            of("cycle").and_then(|quantity| quantity.figures).map(|figures| figures.p999_s),
        ),
        (
            "timing.max_age_p99_s",
            "state measured to its command, 99 %, s",
            settings.max_age_p99_s,
            of("age").and_then(p99),
        ),
    ];
    for (key, what, limit, value) in absolute {
        if let Some(limit) = limit {
            list.push(at_most(key, format!("{here}: {what}"), value.unwrap_or(f64::NAN), limit));
        }
    }
    list
}

/// Computing times: 99.9 % over the median.
fn compute_spread(here: &str, computing: &Times, spread: f64, limit: f64) -> Criterion {
    let criterion = at_most(
        "timing.compute_spread",
        format!("{here}: cycle, 99.9 % over median, without the machine"),
        spread,
        limit,
    );
    let longest_ns = limit * computing.at_ns(0.5).unwrap_or(0) as f64;
    let (longer, cycles) = (computing.count_over(longest_ns as u64), computing.count());
    let counted = format!("{longer} of {cycles} cycles longer than {limit} medians, 0.1 % may be");
    unless_by_chance(criterion, chance::of_so_many(longer, cycles, SPREAD_REST), &counted)
}

/// Wake-up latencies of the loop and of the floor: 99 %, one over the other. `None` without a time.
fn wake_up_of_floor(here: &str, late: &Times, floor: &Times, limit: f64) -> Option<Criterion> {
    let (late_ns, floor_ns) = (late.at_ns(0.99)?, floor.at_ns(0.99)?);
    let criterion = at_most(
        "timing.wake_up_of_floor",
        format!("{here}: wake-up latency, 99 %, over the floor's"),
        late_ns as f64 / floor_ns.max(LEAST_LATENCY_NS) as f64,
        limit,
    );
    // Were ours the floor's times the limit, as many would be longer as of the floor's own ones.
    let longest_ns = (limit * floor_ns.max(LEAST_LATENCY_NS) as f64) as u64;
    let (longer, rank) = (late.count_over(longest_ns), floor.count_from(floor_ns));
    let counted = format!(
        "{:.1} µs, floor {:.1} µs; {longer} of {} longer than the limit, floor {rank} of {} from its 99 % on",
        1e-3 * late_ns as f64,
        1e-3 * floor_ns as f64,
        late.count(),
        floor.count()
    );
    let chance = chance::of_so_many_longer(longer, late.count(), rank, floor.count());
    Some(unless_by_chance(criterion, chance, &counted))
}

/// A threshold that is kept as well when what was counted may be chance.
fn unless_by_chance(criterion: Criterion, chance: f64, counted: &str) -> Criterion {
    let reason = match (criterion.kept, chance >= SIGNIFICANCE) {
        (false, true) => ", so nothing shows that it is not",
        _ => "",
    };
    let note = format!("{counted}; chance of so many if the limit were kept: {chance:.2}{reason}");
    Criterion { kept: criterion.kept || chance >= SIGNIFICANCE, note, ..criterion }
}

/// NaN is not kept.
fn at_most(key: &'static str, what: String, value: f64, limit: f64) -> Criterion {
    Criterion { key, what, value, limit, kept: value <= limit, note: String::new() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_threshold_is_kept_at_its_limit_and_broken_by_what_is_no_number() {
        let kept = |value| at_most("timing.compute_spread", String::new(), value, 1.5).kept;
        assert!(kept(1.5) && !kept(1.500_001) && !kept(f64::NAN));
    }

    #[test]
    fn one_long_cycle_of_200_is_chance_and_two_are_not() {
        let of = |long: usize, cycles: usize| {
            let times = Times::of((0..cycles).map(|k| if k < long { 2_000_000 } else { 1_000_000 }));
            let spread = times.at_ns(0.999).unwrap() as f64 / times.at_ns(0.5).unwrap() as f64;
            compute_spread("alone", &times, spread, 1.5)
        };
        let (none, one, two) = (of(0, 200), of(1, 200), of(2, 200));
        assert!(none.kept && none.value < 1.01 && !none.note.contains("nothing shows"), "{none:?}");
        assert!(one.kept && one.value > 1.9, "{one:?}");
        assert!(
            one.note.contains("1 of 200 cycles") && one.note.contains("0.18, so nothing shows"),
            "{one:?}"
        );
        assert!(!two.kept && two.note.contains("2 of 200 cycles"), "{two:?}");
        // With many cycles 99.9 % is what it says: ten of 10 000 are within it, twenty are too many.
        assert!(of(10, 10_000).kept && of(10, 10_000).value < 1.01);
        assert!(!of(20, 10_000).kept);
    }

    #[test]
    fn a_short_floor_shows_little_about_wake_ups_and_a_long_one_much() {
        let late = |count: u64, long: u64| {
            Times::of((0..count).map(move |k| if k < long { 1_000_000 } else { 10_000 + 20 * k }))
        };
        let of = |loop_late, floor| wake_up_of_floor("alone", &loop_late, &floor, 4.0).unwrap();
        // Four per cent late by a millisecond: the longest of 51 says little about that, the 51 longest of 5000 do.
        let short = of(late(200, 8), late(51, 0));
        assert!(short.kept && short.value > 50.0, "{short:?}");
        assert!(
            short.note.contains("8 of 200 longer") && short.note.contains("so nothing shows"),
            "{short:?}"
        );
        let long = of(late(200, 8), late(5000, 0));
        assert!(!long.kept, "{long:?}");
        // A tenth of all is too many beside any floor.
        assert!(!of(late(200, 20), late(51, 0)).kept);
        let within = of(late(200, 1), late(51, 0));
        assert!(within.kept && within.value < 1.5 && !within.note.contains("nothing shows"), "{within:?}");
        assert_eq!(wake_up_of_floor("alone", &late(0, 0), &late(51, 0), 4.0), None);
    }
}
