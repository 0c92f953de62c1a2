//! The success criteria of a scenario, each with what the run reached.

use delmpc_scenario::{Clock, Scenario};
use serde::Serialize;
use serde_json::Value;

use crate::summary::{is_at_least, is_at_most};

/// One criterion.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Criterion {
    /// What is asked.
    pub name: &'static str,
    /// What was reached, with its unit.
    pub value: String,
    /// What is allowed.
    pub limit: String,
    /// Whether it is met; nothing: nothing in this run could be judged by it.
    pub met: Option<bool>,
}

/// All criteria that apply to a scenario and a robot with so many feet, judged by the figures of `summary.json`.
pub fn criteria(scenario: &Scenario, feet: usize, summary: &Value) -> Vec<Criterion> {
    let limit = &scenario.success;
    let number = |key: &str| summary.get(key).and_then(Value::as_f64);
    let flag = |key: &str| summary.get(key).and_then(Value::as_bool);
    let mut list = Vec::new();
    let none = || "–".to_owned();

    if limit.no_fall {
        let value = match (flag("fell"), number("fall_time_s")) {
            (Some(true), Some(time_s)) => format!("fell at {time_s:.2} s"),
            (Some(fell), _) => if fell { "fell" } else { "stood" }.to_owned(),
            (None, _) => none(),
        };
        list.push(Criterion {
            name: "No fall",
            value,
            limit: "stands to the end".to_owned(),
            met: flag("fell").map(|fell| !fell),
        });
    }
    if limit.no_touch_down && feet > 1 {
        let touched = flag("other_foot_touched");
        let value =
            touched.map_or_else(none, |touched| if touched { "touched" } else { "in the air" }.to_owned());
        list.push(Criterion {
            name: "Swing foot",
            value,
            limit: "stays in the air".to_owned(),
            met: touched.map(|touched| !touched),
        });
    }
    // Not "-0.0": adding zero leaves no sign.
    let millimetres = |value: f64| format!("{:.1} mm", (1e4 * value).round() / 10.0 + 0.0);
    let degrees = |value: f64| format!("{:.3}°", value.to_degrees());
    let percent = |value: f64| format!("{:.0} %", 1e2 * value);
    let seconds = |value: f64| format!("{value:.2} s");
    let factor = |value: f64| format!("{value:.3}");
    let mut compare = |name, key: &str, most: bool, bound: f64, show: &dyn Fn(f64) -> String| {
        let value = number(key);
        list.push(Criterion {
            name,
            value: value.map_or_else(none, show),
            limit: format!("{} {}", if most { "≤" } else { "≥" }, show(bound)),
            met: value.map(|value| if most { is_at_most(value, bound) } else { is_at_least(value, bound) }),
        });
    };
    if scenario.reach.is_some() {
        let bound = limit.hand_error_at_deadline_m;
        compare("Hand at the deadline", "hand_error_at_deadline_m", true, bound, &millimetres);
        let bound = limit.hand_error_hold_max_m;
        compare("Hand while holding", "hand_error_hold_max_m", true, bound, &millimetres);
    }
    compare("Stance slip", "max_stance_slip_m", true, limit.max_stance_slip_m, &millimetres);
    compare("Stance tilt", "max_stance_tilt_rad", true, limit.max_stance_tilt_rad, &degrees);
    compare("Pressure point to edge", "min_cop_margin_m", false, limit.min_cop_margin_m, &millimetres);
    compare("Torque of its limit", "max_torque_ratio", true, limit.max_torque_ratio, &percent);
    if scenario.push.iter().any(|push| push.impulse_ns > 0.0 && push.start_s < scenario.duration_s) {
        compare("Push to rest", "settle_time_s", true, limit.settle_time_s, &seconds);
    }
    if scenario.clock == Clock::Realtime {
        let bound = limit.min_real_time_factor;
        compare("Simulated per wall time", "plant_real_time_factor", false, bound, &factor);
    }
    if let Some(lost) = number("log_records_dropped").filter(|lost| *lost > 0.0) {
        list.push(Criterion {
            name: "Log",
            value: format!("{lost} lost"),
            limit: "every record written".to_owned(),
            met: Some(false),
        });
    }
    list
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn criteria_say_what_was_reached_and_whether_it_is_enough() {
        let scenario = Scenario { clock: Clock::Lockstep, ..Scenario::default() };
        let summary = json!({"fell": false, "max_torque_ratio": 1.25, "max_stance_slip_m": 0.001});
        let list = criteria(&scenario, 1, &summary);
        let found = |name: &str| list.iter().find(|criterion| criterion.name == name).unwrap();
        assert_eq!((found("No fall").met, found("No fall").value.as_str()), (Some(true), "stood"));
        assert_eq!(found("Torque of its limit").met, Some(false));
        assert_eq!((found("Stance slip").met, found("Stance slip").value.as_str()), (Some(true), "1.0 mm"));
        assert_eq!(found("Pressure point to edge").met, None, "nothing was measured");
        assert!(list.iter().all(|criterion| criterion.name != "Push to rest"), "there is no push");
        assert!(list.iter().all(|criterion| criterion.name != "Swing foot"), "there is no other foot");
    }
}
