//! The thresholds of the scenario, kept or broken.

use delmpc_scenario::TimingSettings;
use serde::Serialize;

use crate::timing::phases::{FloorFigures, LoopFigures, Quantity};
use crate::timing::transport::TransportReport;

/// Chance of calling a share of misses too large that is not.
const SIGNIFICANCE: f64 = 0.05;

/// Latencies below this cannot be measured (s): the clock counts nanoseconds.
const LEAST_LATENCY_S: f64 = 1e-9;

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
        let note = match (&figures.again, figures.compute_spread_seen) {
            (Some(again), Some(seen)) => format!(
                "least of {} computations of each cycle; of this one alone, where no disturbance was seen: {seen:.2}",
                again.passes + 1
            ),
            _ => String::new(),
        };
        list.push(Criterion {
            note,
            ..at_most(
                "timing.compute_spread",
                format!("{here}: cycle, 99.9 % over median, without the machine"),
                spread,
                settings.compute_spread,
            )
        });
    }
    let same =
        |floor: &&FloorFigures| floor.loaded == figures.loaded && floor.core == measured.controller_core;
    if let Some(floor) = measured.occupied.iter().find(same) {
        let share = machine as f64 / figures.deadlines.max(1) as f64;
        // A floor without a miss has a share of less than one in its deadlines; nothing is infinitely often as many.
        let least_share = 1.0 / floor.deadlines.max(1) as f64;
        let of_floor = if machine == 0 { 0.0 } else { share / floor.missed_share().max(least_share) };
        let (loop_misses, floor_misses) = ((machine, figures.deadlines), (floor.missed, floor.deadlines));
        let chance = chance_of_so_many(loop_misses, floor_misses, settings.misses_of_floor);
        let within = of_floor <= settings.misses_of_floor;
        let reason = match (within, chance >= SIGNIFICANCE) {
            (false, true) => ", so nothing shows that it is not",
            _ => "",
        };
        list.push(Criterion {
            kept: within || chance >= SIGNIFICANCE,
            note: format!(
                "{machine} of {} deadlines, floor {} of {}; chance of so many if the limit were kept: {chance:.2}{reason}",
                figures.deadlines,
                floor.missed,
                floor.deadlines
            ),
            ..at_most(
                "timing.misses_of_floor",
                format!("{here}: share of deadlines the machine broke, over the floor's"),
                of_floor,
                settings.misses_of_floor,
            )
        });
    }
    let p99 = |quantity: &Quantity| quantity.figures.map(|figures| figures.p99_s);
    let of = |key: &str| figures.quantities.iter().find(|quantity| quantity.key == key);
    let wake_up = of("wake_up").and_then(p99);
    let idle = measured.idle.iter().find(same).and_then(|floor| p99(&floor.wake_up));
    if let (Some(wake_up), Some(idle)) = (wake_up, idle) {
        list.push(Criterion {
            note: format!("{:.1} µs, floor {:.1} µs", 1e6 * wake_up, 1e6 * idle),
            ..at_most(
                "timing.wake_up_of_floor",
                format!("{here}: wake-up latency, 99 %, over the floor's"),
                wake_up / idle.max(LEAST_LATENCY_S),
                settings.wake_up_of_floor,
            )
        });
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

/// NaN is not kept.
fn at_most(key: &'static str, what: String, value: f64, limit: f64) -> Criterion {
    Criterion { key, what, value, limit, kept: value <= limit, note: String::new() }
}

/// Chance that the loop misses at least as many deadlines as it did when its share is `ratio` times the floor's.
///
/// Given both counts together, the loop's one is binomial. Source: Przyborowski, Wilenski, "Homogeneity of results in testing samples from
/// Poisson series", Biometrika 31, 1940. Each argument: missed, of how many.
fn chance_of_so_many(in_loop: (u64, u64), in_floor: (u64, u64), ratio: f64) -> f64 {
    let (misses, cycles) = in_loop;
    let (floor_misses, ticks) = in_floor;
    let all = misses + floor_misses;
    let weight = ratio * cycles as f64;
    let part = weight / (weight + ticks as f64);
    if misses == 0 || part >= 1.0 {
        return 1.0;
    }
    if part.is_nan() || part <= 0.0 {
        return 0.0;
    }
    // Terms of the binomial distribution from `misses` on, each from the one before.
    let mut log_term = 0.0;
    for k in 0..misses {
        log_term += ((all - k) as f64 / (k + 1) as f64).ln();
    }
    log_term += misses as f64 * part.ln() + floor_misses as f64 * (1.0 - part).ln();
    let mut sum = 0.0;
    for k in misses..=all {
        sum += log_term.exp();
        if k < all {
            log_term += ((all - k) as f64 / (k + 1) as f64).ln() + part.ln() - (1.0 - part).ln();
        }
    }
    sum.min(1.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_chance_is_that_of_the_binomial_distribution() {
        // One miss, none in the floor, equal lengths, ratio 1: half.
        assert!((chance_of_so_many((1, 100), (0, 100), 1.0) - 0.5).abs() < 1e-12);
        // Three of three: an eighth; two or more of three: a half.
        assert!((chance_of_so_many((3, 100), (0, 100), 1.0) - 0.125).abs() < 1e-12);
        assert!((chance_of_so_many((2, 100), (1, 100), 1.0) - 0.5).abs() < 1e-12);
        // Twice allowed: (2/3)^10.
        let chance = chance_of_so_many((10, 100), (0, 100), 2.0);
        assert!((chance - (2.0_f64 / 3.0).powi(10)).abs() < 1e-12);
        assert_eq!(chance_of_so_many((0, 100), (0, 100), 2.0), 1.0);
        // Far from the limit on either side, with large counts.
        assert!(chance_of_so_many((5000, 12_000), (1000, 12_000), 2.0) < 1e-12);
        assert!(chance_of_so_many((1000, 12_000), (1000, 12_000), 2.0) > 1.0 - 1e-9);
    }

    #[test]
    fn a_threshold_is_kept_at_its_limit_and_broken_by_what_is_no_number() {
        let kept = |value| at_most("timing.compute_spread", String::new(), value, 1.5).kept;
        assert!(kept(1.5) && !kept(1.500_001) && !kept(f64::NAN));
    }
}
