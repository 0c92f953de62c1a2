//! The figures of a run, from the truth of every step. The log holds the same records, so anyone can compute them again.

use std::collections::VecDeque;

use delmpc_mechanics::prelude::RigidTransform;
use delmpc_messages::{Command, status};
use delmpc_scenario::{Scenario, StartSettings};
use nalgebra::Vector3;
use serde::{Deserialize, Serialize};

use crate::legged_metrics::{LeggedFigures, LeggedMetrics};
use crate::setup::Setup;
use crate::truth::Truth;
use crate::verdict::Failure;

/// At rest: the mass centre is horizontally this close to where it was when the last push began (m) ...
const REST_DISTANCE_M: f64 = 0.01;
/// ... and slower than this (m/s).
const REST_SPEED_M_S: f64 = 0.02;

/// A robot that begins off the ground or leaning has so long to land: tilt and pressure point are judged from then on (s).
const LANDING_S: f64 = 0.5;

/// Collects the figures step by step. No allocation.
#[derive(Debug, Clone)]
pub struct Metrics {
    ball: Option<Ball>,
    push_end_s: Option<f64>,
    push_start_s: f64,
    start: Option<Truth>,
    judged_from_s: f64,
    /// The mass centre when the last push began (m).
    before_push: Option<[f64; 3]>,
    /// Last time it was not at rest after the push.
    restless_s: Option<f64>,
    figures: RobotFigures,
    /// The last truths of the base, for the estimates that come later.
    recent: VecDeque<BaseTruth>,
    estimates: EstimateErrors,
    legged: Option<LeggedMetrics>,
}

/// Steps an estimate may be late.
const RECENT_STEPS: usize = 256;

#[derive(Debug, Clone, Copy)]
struct BaseTruth {
    time_ns: u64,
    up_b: Vector3<f64>,
    velocity_b: Vector3<f64>,
}

/// Sums of squares.
#[derive(Debug, Clone, Copy, Default)]
struct EstimateErrors {
    count: u64,
    tilt: f64,
    velocity: f64,
}

#[derive(Debug, Clone, Copy)]
struct Ball {
    position_m: [f64; 3],
    deadline_ns: u64,
    hold_end_ns: u64,
}

/// What the robot did. Names and units are those of `summary.json`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RobotFigures {
    /// Simulated time.
    pub duration_s: f64,
    /// Plant steps.
    pub steps: u64,
    /// Whether it fell.
    pub fell: bool,
    /// When.
    pub fall_time_s: Option<f64>,
    /// Why, in words.
    #[serde(default)]
    pub fall_cause: Option<String>,
    /// Lowest height of the mass centre.
    pub min_com_height_m: Option<f64>,
    /// Whether a foot that was in the air at the start touched the ground.
    pub other_foot_touched: bool,
    /// Farthest the stance sole slipped.
    pub max_stance_slip_m: f64,
    /// Farthest it tilted.
    pub max_stance_tilt_rad: f64,
    /// Smallest distance of the pressure point from the edge.
    pub min_cop_margin_m: Option<f64>,
    /// Most of the friction that was used.
    pub max_friction_use: Option<f64>,
    /// Largest torque relative to its limit.
    pub max_torque_ratio: f64,
    /// Steps in which a torque was no number or infinite.
    #[serde(default)]
    pub steps_with_non_finite_torque: u64,
    /// Distance of hand and ball at the deadline.
    pub hand_error_at_deadline_m: Option<f64>,
    /// Largest distance of hand and ball while holding.
    pub hand_error_hold_max_m: Option<f64>,
    /// The least distance of hand and ball between deadline and end of the hold.
    #[serde(default)]
    pub hand_distance_left_m: Option<f64>,
    /// Whether it came to rest after the last push; nothing without a push.
    pub recovered: Option<bool>,
    /// From the beginning of the last push to rest.
    pub settle_time_s: Option<f64>,
    /// Largest change of energy that no work explains, relative.
    pub energy_balance_error: Option<f64>,
    /// Root mean square of the angle between the vertical and where the controller believed it to be.
    #[serde(default)]
    pub estimator_tilt_rms_rad: Option<f64>,
    /// Root mean square of the error of the base's velocity it believed in.
    #[serde(default)]
    pub estimator_velocity_rms_m_s: Option<f64>,
    /// What the feet did, of a robot on several feet or on its way.
    #[serde(flatten)]
    pub legged: Option<LeggedFigures>,
}

impl Metrics {
    /// For a scenario.
    pub fn new(scenario: &Scenario) -> Self {
        let ns = |s: f64| (s * 1e9).round() as u64;
        let ball = scenario.reach.as_ref().map(|reach| {
            let deadline_ns = ns(reach.start_s + reach.deadline_s);
            Ball { position_m: reach.ball_m, deadline_ns, hold_end_ns: deadline_ns + ns(reach.hold_s) }
        });
        let pushes = scenario.push.iter().filter(|push| push.impulse_ns > 0.0);
        let last = pushes.filter(|push| push.start_s < scenario.duration_s);
        let last = last.max_by(|a, b| a.start_s.total_cmp(&b.start_s));
        Self {
            ball,
            push_start_s: last.map_or(0.0, |push| push.start_s),
            push_end_s: last.map(|push| push.start_s + push.duration_s),
            start: None,
            judged_from_s: match scenario.robot.start == StartSettings::default() {
                true => 0.0,
                false => LANDING_S,
            },
            before_push: None,
            restless_s: None,
            figures: RobotFigures {
                duration_s: 0.0,
                steps: 0,
                fell: false,
                fall_time_s: None,
                fall_cause: None,
                min_com_height_m: None,
                other_foot_touched: false,
                max_stance_slip_m: 0.0,
                max_stance_tilt_rad: 0.0,
                min_cop_margin_m: None,
                max_friction_use: None,
                max_torque_ratio: 0.0,
                steps_with_non_finite_torque: 0,
                hand_error_at_deadline_m: None,
                hand_error_hold_max_m: None,
                hand_distance_left_m: None,
                recovered: None,
                settle_time_s: None,
                energy_balance_error: None,
                estimator_tilt_rms_rad: None,
                estimator_velocity_rms_m_s: None,
                legged: None,
            },
            recent: VecDeque::with_capacity(RECENT_STEPS),
            estimates: EstimateErrors::default(),
            legged: None,
        }
    }

    /// For a scenario with its robot: ball, pushes and footholds in the frame of the stance, the feet by their names.
    ///
    /// # Errors
    /// As [`Setup::start`].
    pub fn judged_for(setup: &Setup) -> Result<Self, Failure> {
        let sole = |name: &str| setup.robot.soles.iter().position(|sole| sole.name == name);
        let legged = setup.is_legged().then(|| LeggedMetrics::new(&setup.scenario, sole));
        Ok(Self::new(&setup.scenario).of_feet(legged).in_stance_frame(&setup.start()?.stance_frame_w))
    }

    /// Of a robot on several feet, or on its way.
    #[must_use]
    pub fn of_feet(mut self, legged: Option<LeggedMetrics>) -> Self {
        self.legged = legged;
        self
    }

    /// Takes in the initial state (time 0) or the end of a step.
    pub fn observe(&mut self, truth: &Truth) {
        let start = *self.start.get_or_insert(*truth);
        if self.recent.len() == RECENT_STEPS {
            self.recent.pop_front();
        }
        self.recent.push_back(BaseTruth {
            time_ns: truth.time_ns,
            up_b: up_in(&truth.base_orientation_w),
            velocity_b: truth.base_linear_velocity_b.into(),
        });
        if truth.time_s() < self.push_start_s || self.before_push.is_none() {
            self.before_push = Some(truth.com_w);
        }
        let figures = &mut self.figures;
        let time_s = truth.time_s();
        figures.duration_s = time_s;
        figures.steps += u64::from(truth.time_ns > start.time_ns);
        if truth.status_flags & status::FELL != 0 && !figures.fell {
            figures.fell = true;
            figures.fall_time_s = Some(time_s);
        }
        lower(&mut figures.min_com_height_m, truth.com_w[2]);
        // The path, and as a check on it the distance.
        let slip = match &mut self.legged {
            Some(legged) => {
                legged.observe(truth);
                truth.stance_slip_m
            }
            None => {
                horizontal_distance(&truth.sole_position_w, &start.sole_position_w).max(truth.stance_slip_m)
            }
        };
        figures.max_stance_slip_m = figures.max_stance_slip_m.max(slip);
        figures.other_foot_touched |= self.legged.is_none()
            && truth.contact_flags & !start.contact_flags != 0
            && start.contact_flags != 0;
        if time_s >= self.judged_from_s {
            figures.max_stance_tilt_rad = figures.max_stance_tilt_rad.max(truth.sole_tilt_rad);
            lower(&mut figures.min_cop_margin_m, truth.cop_margin_m);
        }
        raise(&mut figures.max_friction_use, truth.friction_use);
        figures.max_torque_ratio = figures.max_torque_ratio.max(truth.torque_ratio);
        let torque = &truth.torque[..truth.torque.len().min(truth.n_joints as usize)];
        figures.steps_with_non_finite_torque += u64::from(torque.iter().any(|torque| !torque.is_finite()));
        raise(&mut figures.energy_balance_error, truth.energy_balance_error);

        if let Some(ball) = self.ball {
            let error = distance(&truth.hand_w, &ball.position_m);
            if truth.time_ns >= ball.deadline_ns
                && figures.hand_error_at_deadline_m.is_none()
                && error.is_finite()
            {
                figures.hand_error_at_deadline_m = Some(error);
            }
            if (ball.deadline_ns..=ball.hold_end_ns).contains(&truth.time_ns) {
                raise(&mut figures.hand_error_hold_max_m, error);
                lower(&mut figures.hand_distance_left_m, error);
            }
        }

        let speed = distance(&truth.com_velocity_w, &[0.0; 3]);
        let away = horizontal_distance(&truth.com_w, &self.before_push.unwrap_or(start.com_w));
        if time_s >= self.push_start_s && (speed > REST_SPEED_M_S || away > REST_DISTANCE_M) {
            self.restless_s = Some(time_s);
        }
    }

    /// Ball and start are told in this frame.
    #[must_use]
    pub fn in_stance_frame(mut self, stance_frame_w: &RigidTransform) -> Self {
        if let Some(ball) = &mut self.ball {
            ball.position_m = stance_frame_w.transform_point(&ball.position_m.into()).into();
        }
        if let Some(legged) = &mut self.legged {
            legged.set_stance_frame(stance_frame_w);
        }
        self
    }

    /// Why it fell.
    pub fn set_fall_cause(&mut self, cause: Option<String>) {
        self.figures.fall_cause = cause;
    }

    /// Compares what a controller believed with what was true then. No allocation.
    pub fn observe_estimate(&mut self, command: &Command) {
        let estimate = &command.estimate;
        let time_ns = command.state_time_ns;
        let then = self.recent.iter().rev().find(|truth| truth.time_ns <= time_ns);
        let Some(then) = then.filter(|then| estimate.known == 1 && then.time_ns == time_ns) else { return };
        let up_b = up_in(&estimate.base_orientation_w);
        let tilt = up_b.cross(&then.up_b).norm().atan2(up_b.dot(&then.up_b));
        let velocity = (Vector3::from(estimate.base_linear_velocity_b) - then.velocity_b).norm();
        if tilt.is_finite() && velocity.is_finite() && !self.figures.fell {
            self.estimates.count += 1;
            self.estimates.tilt += tilt * tilt;
            self.estimates.velocity += velocity * velocity;
        }
    }

    /// When the robot fell, if it did (s).
    pub fn fall_time_s(&self) -> Option<f64> {
        self.figures.fall_time_s
    }

    /// The figures so far.
    pub fn figures(&self) -> RobotFigures {
        let mut figures = self.figures.clone();
        let rms = |sum: f64| (self.estimates.count > 0).then(|| (sum / self.estimates.count as f64).sqrt());
        figures.estimator_tilt_rms_rad = rms(self.estimates.tilt);
        figures.estimator_velocity_rms_m_s = rms(self.estimates.velocity);
        figures.legged = self.legged.as_ref().map(LeggedMetrics::figures);
        if let Some(push_end_s) = self.push_end_s {
            // At rest at the end, with some time to show that it stays so.
            let restless_s = self.restless_s.unwrap_or(self.push_start_s);
            let rested = figures.duration_s > push_end_s && restless_s < figures.duration_s;
            let recovered = rested && !figures.fell;
            figures.recovered = Some(recovered);
            figures.settle_time_s = recovered.then_some(restless_s - self.push_start_s);
        }
        figures
    }
}

/// The vertical in the axes of a body with this orientation (x, y, z, w).
fn up_in(xyzw: &[f64; 4]) -> Vector3<f64> {
    let [x, y, z, w] = *xyzw;
    Vector3::new(2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y))
}

/// NaN changes nothing.
fn lower(least: &mut Option<f64>, value: f64) {
    if value.is_finite() && least.is_none_or(|least| value < least) {
        *least = Some(value);
    }
}

/// NaN changes nothing.
fn raise(most: &mut Option<f64>, value: f64) {
    if value.is_finite() && most.is_none_or(|most| value > most) {
        *most = Some(value);
    }
}

fn distance(a: &[f64; 3], b: &[f64; 3]) -> f64 {
    a.iter().zip(b).map(|(a, b)| (a - b) * (a - b)).sum::<f64>().sqrt()
}

fn horizontal_distance(a: &[f64; 3], b: &[f64; 3]) -> f64 {
    (a[0] - b[0]).hypot(a[1] - b[1])
}

#[cfg(test)]
mod tests {
    use super::*;
    use delmpc_scenario::{PushSettings, ReachSettings};

    fn scenario() -> Scenario {
        Scenario {
            duration_s: 3.0,
            reach: Some(ReachSettings {
                ball_m: [1.0, 0.0, 0.0],
                start_s: 0.5,
                deadline_s: 0.5,
                hold_s: 0.5,
                ..ReachSettings::default()
            }),
            push: vec![PushSettings {
                impulse_ns: 1.0,
                start_s: 1.5,
                duration_s: 0.1,
                ..PushSettings::default()
            }],
            ..Scenario::default()
        }
    }

    /// The mass centre decays to rest from the push on; the hand approaches the ball.
    fn truth(k: u64) -> Truth {
        let time_s = k as f64 * 0.01;
        let mut truth = Truth::new(1);
        truth.time_ns = k * 10_000_000;
        truth.com_w[2] = 1.0;
        truth.com_velocity_w[1] = if time_s >= 1.5 { 0.4 * (-(time_s - 1.5) / 0.2).exp() } else { 0.0 };
        truth.hand_w = [if time_s >= 1.0 { 1.01 } else { 0.0 }, 0.0, 0.0];
        truth
    }

    #[test]
    fn hand_errors_are_those_of_deadline_and_hold() {
        let mut metrics = Metrics::new(&scenario());
        (0..=300).for_each(|k| metrics.observe(&truth(k)));
        let figures = metrics.figures();
        assert!((figures.hand_error_at_deadline_m.unwrap() - 0.01).abs() < 1e-12);
        assert!((figures.hand_error_hold_max_m.unwrap() - 0.01).abs() < 1e-12);
        assert_eq!((figures.steps, figures.duration_s), (300, 3.0));
    }

    #[test]
    fn a_push_is_recovered_from_when_rest_stays() {
        let mut metrics = Metrics::new(&scenario());
        (0..=300).for_each(|k| metrics.observe(&truth(k)));
        let figures = metrics.figures();
        // 0.4 exp(-t/0.2) = 0.02
        assert_eq!(figures.recovered, Some(true));
        assert!((figures.settle_time_s.unwrap() - 0.2 * 20.0_f64.ln()).abs() < 0.011);
    }

    #[test]
    fn a_fall_is_not_recovered_from() {
        let mut metrics = Metrics::new(&scenario());
        for k in 0..=300 {
            let mut truth = truth(k);
            if k >= 200 {
                truth.status_flags = status::FELL;
            }
            metrics.observe(&truth);
        }
        let figures = metrics.figures();
        assert_eq!((figures.fell, figures.fall_time_s), (true, Some(2.0)));
        assert_eq!((figures.recovered, figures.settle_time_s), (Some(false), None));
    }

    #[test]
    fn a_torque_that_is_no_number_is_counted_and_what_lies_beyond_the_joints_is_not() {
        let mut metrics = Metrics::new(&scenario());
        for (k, (joint, torque)) in
            [(0, 1.0), (0, f64::NAN), (0, f64::INFINITY), (1, f64::NAN)].into_iter().enumerate()
        {
            let mut truth = truth(k as u64);
            truth.torque[joint] = torque;
            metrics.observe(&truth);
        }
        assert_eq!(metrics.figures().steps_with_non_finite_torque, 2);
    }

    #[test]
    fn without_a_push_there_is_nothing_to_recover_from() {
        let mut metrics = Metrics::new(&Scenario { push: Vec::new(), ..scenario() });
        (0..=300).for_each(|k| metrics.observe(&truth(k)));
        assert_eq!(metrics.figures().recovered, None);
    }
}
