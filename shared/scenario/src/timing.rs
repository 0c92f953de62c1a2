//! The keys of `delmpc timing`.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Thresholds of `delmpc timing`. Those named `…_of_floor` are relative to what the machine itself does in the same minutes; absolute ones
/// hold when given.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct TimingSettings {
    /// Time without the core from which on the machine is said to have interfered, s.
    pub event_s: f64,
    /// Time a cycle may compute, as part of its period: a deadline missed by a cycle that computed longer is the software's.
    pub compute_budget: f64,
    /// Longest 99.9 % of the cycles' computing time over its median, without the machine's part.
    pub compute_spread: f64,
    /// Largest share of missed deadlines, relative to that of a loop that only burns the same time.
    pub misses_of_floor: f64,
    /// Largest 99 % of the wake-up latency, relative to an idle thread's.
    pub wake_up_of_floor: f64,
    /// Largest median of the round trip between the processes, relative to that of a flag in shared memory.
    pub round_trip_of_floor: f64,
    /// Most deadlines that may be missed, whoever is to blame.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub max_misses: Option<u32>,
    /// Largest 99 % of the controller's wake-up latency, s.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub max_wake_up_p99_s: Option<f64>,
    /// Largest 99.9 % of the cycle time, s.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub max_cycle_p999_s: Option<f64>,
    /// Largest 99 % of the time from a measurement to the arrival of its command, s.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub max_age_p99_s: Option<f64>,
}

impl Default for TimingSettings {
    fn default() -> Self {
        Self {
            event_s: 1e-4,
            compute_budget: 1.0,
            compute_spread: 1.5,
            misses_of_floor: 2.0,
            wake_up_of_floor: 4.0,
            round_trip_of_floor: 4.0,
            max_misses: None,
            max_wake_up_p99_s: None,
            max_cycle_p999_s: None,
            max_age_p99_s: None,
        }
    }
}
