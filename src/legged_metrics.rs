//! The figures of a robot on several feet, or on its way: steps, flight, slip, how well it keeps to its path.

use delmpc_horizon::base_path::BasePath;
use delmpc_mechanics::prelude::RigidTransform;
use delmpc_scenario::Scenario;
use nalgebra::{Vector2, Vector3};
use serde::{Deserialize, Serialize};

use crate::truth::Truth;

/// A foot that has stood for so long has landed where it has landed (s).
const LANDED_S: f64 = 0.1;
/// Path and place are judged from then on (s): before, the robot settles.
const SETTLED_S: f64 = 0.2;

/// What the feet did. Names and units are those of `summary.json`.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct LeggedFigures {
    /// Different sets of feet that were on the ground.
    pub contact_sets_visited: u32,
    /// Touchdowns after the start that followed a time in the air of a fiftieth of a second and more.
    pub steps_taken: u32,
    /// Way of the mass centre, start to end, along the ground.
    pub distance_m: f64,
    /// That over the time from the first lift-off to the last touchdown; nothing without a step.
    pub mean_speed_m_s: Option<f64>,
    /// Longest time without a foot on the ground.
    pub flight_time_s: f64,
    /// Distance of the mass centre from where it shall be, root mean square along the ground; nothing for a walk of single steps.
    pub base_error_rms_m: Option<f64>,
    /// Farthest a foot landed from its foothold; nothing without given ones.
    pub landing_error_max_m: Option<f64>,
    /// Farthest a foot slipped from one touchdown to the next.
    pub max_slip_m: f64,
}

/// A foothold that was asked for.
#[derive(Debug, Clone)]
struct Asked {
    foot: usize,
    judged_s: f64,
    place_m: Vector3<f64>,
}

/// Collects them. No allocation after the start.
#[derive(Debug, Clone)]
pub struct LeggedMetrics {
    path: Option<BasePath>,
    asked: Vec<Asked>,
    stance_frame_w: RigidTransform,
    start_w: Option<Vector3<f64>>,
    touching: u32,
    sets: Vec<u32>,
    lifted_s: [f64; 32],
    first_lift_s: Option<f64>,
    last_touch_s: f64,
    airborne_since_s: Option<f64>,
    errors: (u64, f64),
    figures: LeggedFigures,
}

/// Shortest time in the air that makes a step (s).
const STEP_S: f64 = 0.02;
/// Different contact sets there is room for.
const SETS: usize = 64;

impl LeggedMetrics {
    /// For a scenario; `sole` gives a foot's index by the name of its sole. Nothing for a robot on one foot.
    pub fn new(scenario: &Scenario, sole: impl Fn(&str) -> Option<usize>) -> Self {
        let path = scenario.step.is_empty().then(|| {
            let still = BasePath::still(Vector2::zeros(), 0.0);
            scenario.gait.as_ref().map_or(still, |gait| BasePath {
                velocity: Vector2::new(gait.speed_m_s, gait.side_speed_m_s),
                yaw_rate: gait.yaw_rate_rad_s,
                start_s: gait.start_s,
                stop_s: gait.stop_s,
                ramp_s: gait.ramp_s,
                ..still
            })
        });
        let asked = scenario.step.iter().filter_map(|step| {
            let (foot, place_m) = (sole(&step.foot)?, step.position_m.into());
            Some(Asked { foot, judged_s: step.time_s + step.swing_s + LANDED_S, place_m })
        });
        Self {
            path,
            asked: asked.collect(),
            stance_frame_w: RigidTransform::identity(),
            start_w: None,
            touching: 0,
            sets: Vec::with_capacity(SETS),
            lifted_s: [0.0; 32],
            first_lift_s: None,
            last_touch_s: 0.0,
            airborne_since_s: None,
            errors: (0, 0.0),
            figures: LeggedFigures::default(),
        }
    }

    /// Footholds and path are told in this frame.
    pub fn set_stance_frame(&mut self, stance_frame_w: &RigidTransform) {
        self.stance_frame_w = *stance_frame_w;
    }

    /// Takes in the initial state or the end of a step.
    pub fn observe(&mut self, truth: &Truth) {
        let (time_s, com_w) = (truth.time_s(), Vector3::from(truth.com_w));
        let start_w = *self.start_w.get_or_insert(com_w);
        let to_stance = |vector: &Vector3<f64>| self.stance_frame_w.rotation.tr_mul(vector);
        let way = to_stance(&(com_w - start_w)).xy();
        self.figures.distance_m = way.norm();
        if let Some(path) = self.path.filter(|_| time_s >= SETTLED_S) {
            self.errors.0 += 1;
            self.errors.1 += (way - path.at(time_s).position).norm_squared();
        }
        let feet = truth.n_feet.min(truth.foot_slip_m.len() as u32) as usize;
        for foot in 0..feet {
            self.figures.max_slip_m = self.figures.max_slip_m.max(truth.foot_slip_m[foot]);
        }
        let (was, is) = (self.touching, truth.feet_touching);
        self.touching = is;
        if truth.time_ns == 0 {
            return;
        }
        if !self.sets.contains(&is) && self.sets.len() < SETS {
            self.sets.push(is);
            self.figures.contact_sets_visited = self.sets.len() as u32;
        }
        for foot in 0..feet {
            let bit = 1 << foot;
            if was & bit != 0 && is & bit == 0 {
                self.lifted_s[foot] = time_s;
            }
            let lands = was & bit == 0 && is & bit != 0 && self.lifted_s[foot] > 0.0;
            if lands && time_s - self.lifted_s[foot] >= STEP_S {
                self.figures.steps_taken += 1;
                self.first_lift_s.get_or_insert(self.lifted_s[foot]);
                self.last_touch_s = time_s;
            }
        }
        match (is, self.airborne_since_s) {
            (0, None) => self.airborne_since_s = Some(time_s),
            (0, Some(since_s)) => {
                self.figures.flight_time_s = self.figures.flight_time_s.max(time_s - since_s);
            }
            _ => self.airborne_since_s = None,
        }
        let landed = self.asked.iter_mut().find(|asked| asked.judged_s <= time_s);
        if let Some(asked) = landed {
            let wanted = self.stance_frame_w.transform_point(&asked.place_m);
            let is = Vector3::from(truth.foot_position_w[asked.foot.min(truth.foot_position_w.len() - 1)]);
            let error = (is - wanted).xy().norm();
            let worst = self.figures.landing_error_max_m.unwrap_or(0.0).max(error);
            self.figures.landing_error_max_m = Some(worst);
            asked.judged_s = f64::INFINITY;
        }
    }

    /// The figures so far.
    pub fn figures(&self) -> LeggedFigures {
        let mut figures = self.figures.clone();
        let (count, sum) = self.errors;
        figures.base_error_rms_m = (count > 0).then(|| (sum / count as f64).sqrt());
        figures.mean_speed_m_s = self
            .first_lift_s
            .filter(|first_s| self.last_touch_s > *first_s)
            .map(|first_s| figures.distance_m / (self.last_touch_s - first_s));
        figures
    }
}

#[cfg(test)]
mod tests {
    use delmpc_scenario::{GaitSettings, StepSettings};

    use super::*;

    fn truth(time_s: f64, x: f64, touching: u32) -> Truth {
        let mut truth = Truth::new(0);
        truth.time_ns = (time_s * 1e9) as u64;
        (truth.com_w, truth.n_feet, truth.feet_touching) = ([x, 0.0, 1.0], 2, touching);
        truth
    }

    #[test]
    fn steps_flight_and_path_are_told() {
        let gait = GaitSettings { speed_m_s: 0.5, start_s: 0.0, ramp_s: 1e-3, ..GaitSettings::default() };
        let scenario = Scenario { gait: Some(gait), ..Scenario::default() };
        let mut metrics = LeggedMetrics::new(&scenario, |_| None);
        for k in 0..1000 {
            let t = 1e-3 * f64::from(k);
            // Both feet in the air from 0.3 to 0.4 s, one more until 0.5 s.
            let touching = if t < 0.2995 {
                3
            } else if t < 0.3995 {
                0
            } else if t < 0.4995 {
                1
            } else {
                3
            };
            metrics.observe(&truth(t, 0.5 * t + 0.01, touching));
        }
        let figures = metrics.figures();
        assert_eq!((figures.steps_taken, figures.contact_sets_visited), (2, 3));
        assert!((figures.flight_time_s - 0.099).abs() < 2e-3, "{}", figures.flight_time_s);
        assert!(figures.base_error_rms_m.unwrap() < 1e-3);
        assert_eq!(figures.landing_error_max_m, None);
    }

    #[test]
    fn a_landing_is_judged_against_its_foothold() {
        let step = StepSettings {
            foot: "left".to_owned(),
            time_s: 0.1,
            swing_s: 0.2,
            position_m: [0.3, 0.0, 0.0],
            ..StepSettings::default()
        };
        let scenario = Scenario { step: vec![step], ..Scenario::default() };
        let mut metrics = LeggedMetrics::new(&scenario, |name| (name == "left").then_some(1));
        for k in 0..500 {
            let mut now = truth(1e-3 * f64::from(k), 0.0, 3);
            now.foot_position_w[1] = [0.304, 0.003, 0.0];
            metrics.observe(&now);
        }
        assert!((metrics.figures().landing_error_max_m.unwrap() - 0.005).abs() < 1e-12);
        assert_eq!(metrics.figures().base_error_rms_m, None);
    }
}
