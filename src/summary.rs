//! `summary.json`: the figures of a run and its success.

use std::path::Path;

use delmpc_scenario::{Clock, Scenario};
use serde::{Deserialize, Serialize};

use crate::metrics::RobotFigures;
use crate::output_file;

/// What the plant process found out.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PlantPart {
    /// The robot.
    #[serde(flatten)]
    pub robot: RobotFigures,
    /// From a state to the arrival of its command; realtime only.
    pub state_to_command_age_p50_s: Option<f64>,
    /// The same, 99.9 %.
    pub state_to_command_age_p999_s: Option<f64>,
    /// Wall time of a plant step; realtime only.
    pub plant_step_p50_s: Option<f64>,
    /// Simulated time over wall time; realtime only.
    pub plant_real_time_factor: Option<f64>,
    /// Times the plant process was held up for so long that the simulated world paused; realtime only.
    pub plant_pauses: Option<u64>,
    /// Records the log had no room for.
    pub log_records_dropped: u64,
    /// Commands that were refused.
    pub commands_refused: u64,
    /// Worst level of the plant's own watchdog.
    pub watchdog_level_max: u32,
}

/// What the controller process found out. Times and allocations are realtime only.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[allow(missing_docs, reason = "the names are those of the summary and say it all")]
pub struct ControllerPart {
    pub cycles: u64,
    pub cycle_time_p50_s: Option<f64>,
    pub cycle_time_p99_s: Option<f64>,
    pub cycle_time_p999_s: Option<f64>,
    pub cycle_time_max_s: Option<f64>,
    /// From the tick to the command sent; the rest of a cycle was prepared ahead.
    pub feedback_p50_s: Option<f64>,
    pub feedback_p99_s: Option<f64>,
    pub linearize_p50_s: Option<f64>,
    pub riccati_p50_s: Option<f64>,
    pub qp_p50_s: Option<f64>,
    pub qp_solves: u64,
    pub qp_iterations_max: u32,
    pub deadline_misses: u64,
    pub fallback_level_max: u32,
    pub allocations_per_cycle_max: Option<u32>,
    /// Cycles that ended late, infeasible, with a model mismatch, with a bad state.
    pub verdicts_late: u64,
    pub verdicts_infeasible: u64,
    pub verdicts_model_mismatch: u64,
    pub verdicts_bad_state: u64,
}

/// The whole summary: flat keys, SI units.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[allow(missing_docs, reason = "the names say it all")]
pub struct Summary {
    pub scenario: String,
    pub seed: u64,
    pub success: bool,
    pub failure: Option<String>,
    pub clock: Clock,
    #[serde(flatten)]
    pub plant: Option<PlantPart>,
    pub push_impulse_ns: Option<f64>,
    pub push_direction: Option<[f64; 3]>,
    pub cycle_period_s: f64,
    #[serde(flatten)]
    pub controller: Option<ControllerPart>,
}

impl Summary {
    /// Puts the parts together and judges them by the scenario's criteria. `fault`: why the run broke off, if it did.
    pub fn new(
        scenario: &Scenario,
        plant: Option<PlantPart>,
        controller: Option<ControllerPart>,
        fault: Option<String>,
    ) -> Self {
        let push = scenario.push.iter().max_by(|a, b| a.impulse_ns.total_cmp(&b.impulse_ns));
        let missed = plant.as_ref().and_then(|plant| missed_criterion(scenario, plant));
        let failure = fault.or(missed);
        Self {
            scenario: scenario.name.clone(),
            seed: scenario.seed,
            success: failure.is_none(),
            failure,
            clock: scenario.clock,
            plant,
            push_impulse_ns: push.map(|push| push.impulse_ns),
            push_direction: push.map(|push| unit(push.direction)),
            cycle_period_s: 1.0 / scenario.controller.mpc_rate_hz,
            controller,
        }
    }

    /// As a JSON object. Parts that are missing leave their keys with nothing in them.
    pub fn to_json(&self) -> serde_json::Value {
        let mut value = serde_json::to_value(self).unwrap_or_default();
        if let Some(object) = value.as_object_mut() {
            for key in KEYS {
                object.entry(key).or_insert(serde_json::Value::Null);
            }
        }
        value
    }

    /// Writes `summary.json`.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn write(&self, file: &Path) -> std::io::Result<()> {
        let mut text = serde_json::to_string_pretty(&self.to_json())?;
        text.push('\n');
        output_file::write(file, text)
    }
}

/// The keys that others read: none of them may ever be missing.
pub const KEYS: [&str; 50] = [
    "scenario",
    "seed",
    "success",
    "failure",
    "duration_s",
    "clock",
    "steps",
    "fell",
    "fall_time_s",
    "fall_cause",
    "min_com_height_m",
    "max_stance_slip_m",
    "max_stance_tilt_rad",
    "min_cop_margin_m",
    "max_friction_use",
    "max_torque_ratio",
    "hand_error_at_deadline_m",
    "hand_error_hold_max_m",
    "hand_distance_left_m",
    "push_impulse_ns",
    "push_direction",
    "recovered",
    "settle_time_s",
    "cycles",
    "cycle_period_s",
    "cycle_time_p50_s",
    "cycle_time_p99_s",
    "cycle_time_p999_s",
    "cycle_time_max_s",
    "feedback_p50_s",
    "feedback_p99_s",
    "linearize_p50_s",
    "riccati_p50_s",
    "qp_p50_s",
    "qp_solves",
    "qp_iterations_max",
    "deadline_misses",
    "fallback_level_max",
    "state_to_command_age_p50_s",
    "state_to_command_age_p999_s",
    "allocations_per_cycle_max",
    "plant_step_p50_s",
    "plant_real_time_factor",
    "energy_balance_error",
    "estimator_tilt_rms_rad",
    "estimator_velocity_rms_m_s",
    "plant_pauses",
    "log_records_dropped",
    "commands_refused",
    "watchdog_level_max",
];

/// The first criterion that was missed, in words.
fn missed_criterion(scenario: &Scenario, plant: &PlantPart) -> Option<String> {
    let (limit, robot) = (&scenario.success, &plant.robot);
    if limit.no_fall && robot.fell {
        let cause = robot.fall_cause.as_ref().map_or(String::new(), |cause| format!(": {cause}"));
        return Some(format!("the robot fell at {:.3} s{cause}", robot.fall_time_s.unwrap_or_default()));
    }
    if limit.no_touch_down && robot.other_foot_touched {
        return Some("a foot that was in the air touched the ground".to_owned());
    }
    if robot.steps < scenario.steps() {
        return Some(format!("the run ended after {} of {} steps", robot.steps, scenario.steps()));
    }
    let realtime = scenario.clock == Clock::Realtime;
    if plant.log_records_dropped > 0 {
        let lost = plant.log_records_dropped;
        return Some(format!(
            "the log has holes: {lost} records were lost, the machine could not write them in time"
        ));
    }
    let at_most = |key: &str, value: Option<f64>, most: f64| {
        let value = value.filter(|value| !is_at_most(*value, most))?;
        let (value, most) = apart(value, most);
        Some(format!("{key} = {value}, allowed is at most {most}"))
    };
    let at_least = |key: &str, value: Option<f64>, least: f64| {
        let value = value.filter(|value| !is_at_least(*value, least))?;
        let (value, least) = apart(value, least);
        Some(format!("{key} = {value}, needed is at least {least}"))
    };
    at_most("hand_error_at_deadline_m", robot.hand_error_at_deadline_m, limit.hand_error_at_deadline_m)
        .or_else(|| {
            at_most("hand_error_hold_max_m", robot.hand_error_hold_max_m, limit.hand_error_hold_max_m)
        })
        .or_else(|| at_most("max_stance_slip_m", Some(robot.max_stance_slip_m), limit.max_stance_slip_m))
        .or_else(|| {
            at_most("max_stance_tilt_rad", Some(robot.max_stance_tilt_rad), limit.max_stance_tilt_rad)
        })
        .or_else(|| at_least("min_cop_margin_m", robot.min_cop_margin_m, limit.min_cop_margin_m))
        .or_else(|| at_most("max_torque_ratio", Some(robot.max_torque_ratio), limit.max_torque_ratio))
        .or_else(|| {
            (robot.recovered == Some(false))
                .then(|| "the robot did not come to rest after the push".to_owned())
        })
        .or_else(|| at_most("settle_time_s", robot.settle_time_s, limit.settle_time_s))
        .or_else(|| {
            let factor = plant.plant_real_time_factor.filter(|_| realtime);
            at_least("plant_real_time_factor", factor, limit.min_real_time_factor)
        })
}

/// A figure this near to a bound of exactly 0 keeps it: half of the last digit that is shown.
const NEARLY_ZERO: f64 = 5e-5;
/// Round-off of a figure, relative to its bound.
const ROUND_OFF: f64 = 1e-9;

fn tolerance(bound: f64) -> f64 {
    if bound == 0.0 { NEARLY_ZERO } else { ROUND_OFF * bound.abs() }
}

/// Whether a figure keeps an upper bound, round-off aside.
pub fn is_at_most(value: f64, most: f64) -> bool {
    value <= most + tolerance(most)
}

/// Whether a figure keeps a lower bound, round-off aside.
pub fn is_at_least(value: f64, least: f64) -> bool {
    value >= least - tolerance(least)
}

/// A figure and its bound as somebody would write them, with as many digits as it takes to tell them apart.
fn apart(value: f64, bound: f64) -> (String, String) {
    let texts = |digits: usize| {
        let plain = format!("{bound:.digits$}");
        (format!("{value:.digits$}"), plain.trim_end_matches('0').trim_end_matches('.').to_owned())
    };
    let differ = |(value, bound): &(String, String)| value.parse::<f64>().ok() != bound.parse::<f64>().ok();
    (4..12).map(texts).find(differ).unwrap_or_else(|| texts(12))
}

fn unit(direction: [f64; 3]) -> [f64; 3] {
    let length = direction.iter().map(|x| x * x).sum::<f64>().sqrt();
    direction.map(|x| x / length)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_bound_of_exactly_zero_is_kept_by_round_off_and_a_figure_that_breaks_a_bound_is_told_apart_from_it() {
        assert!(is_at_least(-1e-5, 0.0) && is_at_most(1e-5, 0.0) && is_at_least(0.0, 0.0));
        assert!(!is_at_least(-6e-5, 0.0) && !is_at_most(6e-5, 0.0));
        assert!(is_at_most(0.02 + 1e-15, 0.02) && !is_at_most(0.02001, 0.02));
        assert!(!is_at_most(f64::NAN, 1.0) && !is_at_least(f64::NAN, 0.0));
        let pair = |value, bound| apart(value, bound);
        assert_eq!(pair(-6e-5, 0.0), ("-0.0001".to_owned(), "0".to_owned()));
        assert_eq!(pair(0.02001, 0.02), ("0.02001".to_owned(), "0.02".to_owned()));
        assert_eq!(pair(1.5, 1.0), ("1.5000".to_owned(), "1".to_owned()));
        assert_eq!(pair(f64::NAN, 1.0).0, "NaN");
    }
}
