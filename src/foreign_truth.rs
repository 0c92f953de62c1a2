//! From what a plant of somebody else's tells to the truth that figures are made of: the rules are those by which our own plant is watched.
//!
//! | quantity | from |
//! |---|---|
//! | mass centre, soles, hand | motion of the base and the joints, by our kinematics |
//! | pressure point, its margin, friction use | wrench on each foot, above 1 % of the weight |
//! | slip | path of the sole's material point under the pressure point, along the ground, since the touchdown; of a plant that tells no truth, whose noise would add up in a path, how far the sole's origin is from where it touched down |
//! | tilt | angle between the sole's normal and the ground's |
//! | fall | mass centre below half its height above the lowest sole, base leaning by a radian from its start, or the plant says so |

use delmpc_mechanics::prelude::{RigidTransform, Twist};
use delmpc_messages::{PlantState, foot, sensor, status};
use delmpc_plant::monitor::margin;
use delmpc_plant::prelude::{MonitorConfig, Push};
use nalgebra::{Quaternion, UnitQuaternion, Vector3};

use crate::observer::{Motion, Observer};
use crate::setup::Setup;
use crate::simulated_robot::pushes;
use crate::start::slope;
use crate::truth::Truth;
use crate::verdict::Failure;

/// The pressure point is told above this share of the weight.
const PRESSURE_SHARE: f64 = 0.01;
/// Slower than this a foot does not slip, m/s.
const SLIP_SPEED: f64 = 1e-6;

/// A sole, and what is remembered of it.
#[derive(Debug, Clone)]
struct SoleMemory {
    polygon: Vec<[f64; 2]>,
    pose_w: Option<RigidTransform>,
    touching: bool,
    touchdown_w: Option<Vector3<f64>>,
    slip_m: f64,
}

/// Makes truths of states.
#[derive(Debug, Clone)]
pub struct ForeignTruth {
    observer: Observer,
    soles: Vec<SoleMemory>,
    stance: usize,
    is_legged: bool,
    weight_n: f64,
    friction: f64,
    normal_w: Vector3<f64>,
    pushes: Vec<Push>,
    limits: MonitorConfig,
    /// Height of the mass centre above the lowest sole, and the vertical in the base's axes, both at the start.
    start: Option<(f64, Vector3<f64>)>,
    fell: Option<String>,
    last_ns: u64,
}

impl ForeignTruth {
    /// For the robot and the scenario of a setup.
    ///
    /// # Errors
    /// As [`Observer::new`].
    pub fn new(setup: &Setup) -> Result<Self, Failure> {
        let (robot, scenario) = (&setup.robot, &setup.scenario);
        let floats = robot.tree.is_floating();
        let soles = robot.soles.iter().filter(|_| floats).map(|sole| SoleMemory {
            polygon: sole.polygon.iter().map(|corner| (*corner).into()).collect(),
            pose_w: None,
            touching: false,
            touchdown_w: None,
            slip_m: 0.0,
        });
        Ok(Self {
            observer: Observer::new(setup)?,
            soles: soles.collect(),
            stance: setup.stance_foot(),
            is_legged: setup.is_legged(),
            weight_n: robot.tree.total_mass() * scenario.plant.mass_scale * robot.tree.gravity_w().norm(),
            friction: scenario.plant.friction,
            normal_w: slope(scenario).column(2).into(),
            pushes: pushes(setup)?,
            limits: MonitorConfig::default(),
            start: None,
            fell: None,
            last_ns: 0,
        })
    }

    /// Why the robot fell, if it did.
    pub fn fall_cause(&self) -> Option<&str> {
        self.fell.as_deref()
    }

    /// Takes in a state; `exact`: it is without noise, and one of every step.
    pub fn observe(&mut self, state: &PlantState, exact: bool, truth: &mut Truth) {
        let n = state.n_joints as usize;
        let pose_w = base_pose(state);
        let twist_b = Twist {
            angular: state.base_angular_velocity_b.into(),
            linear: state.base_linear_velocity_b.into(),
        };
        let motion = Motion {
            base_link_pose_w: &pose_w,
            base_twist_b: &twist_b,
            position: &state.position[..n],
            velocity: &state.velocity[..n],
            torque: &state.applied_torque[..n],
        };
        self.observer.observe(&motion, truth);
        truth.time_ns = state.time_ns;
        truth.watchdog_level = state.watchdog_level;
        truth.status_flags = state.status_flags & !status::FINISHED;
        self.judge_feet(state, exact, truth);
        if self.observer.floats() {
            self.judge_fall(&pose_w, state.has_sensor(sensor::MOTION_CAPTURE), truth);
        }
        let step_s = state.time_ns.saturating_sub(self.last_ns) as f64 * 1e-9;
        let begin_s = self.last_ns as f64 * 1e-9;
        let force: Vector3<f64> = match step_s > 0.0 {
            true => self.pushes.iter().map(|push| push.force_over(begin_s, step_s)).sum(),
            false => Vector3::zeros(),
        };
        truth.push_force_w = force.into();
        self.last_ns = state.time_ns;
    }

    fn judge_feet(&mut self, state: &PlantState, exact: bool, truth: &mut Truth) {
        let step_s = state.time_ns.saturating_sub(self.last_ns) as f64 * 1e-9;
        truth.feet_touching = 0;
        (truth.sole_tilt_rad, truth.stance_slip_m) = (0.0, 0.0);
        (truth.cop_margin_m, truth.friction_use) = (f64::NAN, f64::NAN);
        for (index, (reading, memory)) in state.feet().iter().zip(&mut self.soles).enumerate() {
            let Some(pose_w) = self.observer.sole_pose_w(index) else { continue };
            let has_wrench = reading.flags & foot::WRENCH != 0;
            let force = Vector3::from(reading.force_s);
            let touching = reading.flags & foot::TOUCHES != 0 || (has_wrench && force.z > 0.0);
            if touching && !memory.touching {
                memory.slip_m = 0.0;
                memory.touchdown_w = Some(pose_w.translation);
            }
            let along_ground = |way: Vector3<f64>| (way - self.normal_w * self.normal_w.dot(&way)).norm();
            let loaded = has_wrench && force.z >= PRESSURE_SHARE * self.weight_n;
            let point = Vector3::new(-reading.torque_s[1] / force.z, reading.torque_s[0] / force.z, 0.0);
            if let (true, true, Some(before_w)) = (loaded, memory.touching, &memory.pose_w) {
                let along = along_ground(pose_w.transform_point(&point) - before_w.transform_point(&point));
                memory.slip_m += if along > SLIP_SPEED * step_s { along } else { 0.0 };
            }
            if let (false, true, Some(touchdown_w)) = (exact, loaded, memory.touchdown_w) {
                memory.slip_m = along_ground(pose_w.translation - touchdown_w);
            }
            (memory.touching, memory.pose_w) = (touching, Some(pose_w));
            truth.foot_slip_m[index] = memory.slip_m;
            truth.feet_touching |= u32::from(touching) << index;
            if index == self.stance {
                truth.stance_torque_b = reading.torque_s;
                truth.stance_force_b = reading.force_s;
            }
            if index != self.stance && !self.is_legged {
                continue;
            }
            // Of several feet the worst one counts.
            truth.stance_slip_m = truth.stance_slip_m.max(memory.slip_m);
            if !loaded {
                continue;
            }
            let force_w = pose_w.rotation * force;
            let normal_n = self.normal_w.dot(&force_w);
            let along_n = (force_w - self.normal_w * normal_n).norm();
            truth.friction_use = truth.friction_use.max(along_n / (self.friction * normal_n));
            if memory.polygon.len() >= 3 {
                let up: Vector3<f64> = pose_w.rotation.column(2).into();
                let tilt = up.cross(&self.normal_w).norm().atan2(up.dot(&self.normal_w));
                truth.sole_tilt_rad = truth.sole_tilt_rad.max(tilt);
                truth.cop_margin_m = truth.cop_margin_m.min(margin(&memory.polygon, [point.x, point.y]));
            }
        }
        truth.contact_flags = truth.feet_touching;
    }

    fn judge_fall(&mut self, base_pose_w: &RigidTransform, base_is_known: bool, truth: &mut Truth) {
        let said = truth.status_flags & status::FELL != 0;
        if base_is_known && self.fell.is_none() {
            let lowest = truth.foot_position_w[..truth.n_feet as usize].iter().map(|place| place[2]);
            let lowest = Some(lowest.fold(f64::INFINITY, f64::min)).filter(|z| z.is_finite()).unwrap_or(0.0);
            let height = truth.com_w[2] - lowest;
            let up_b: Vector3<f64> = base_pose_w.rotation.row(2).transpose();
            let (start_height, start_up_b) = *self.start.get_or_insert((height, up_b));
            let lean = up_b.cross(&start_up_b).norm().atan2(up_b.dot(&start_up_b));
            self.fell = if height < self.limits.min_com_height_share * start_height {
                Some("the mass centre came down to half its height".to_owned())
            } else if lean > self.limits.max_base_tilt {
                Some("the base leans more than a radian from its start".to_owned())
            } else {
                None
            };
        }
        if said && self.fell.is_none() {
            self.fell = Some("the plant says so".to_owned());
        }
        if self.fell.is_some() {
            truth.status_flags |= status::FELL;
        }
    }
}

/// The base link frame; where nothing is told of it, the world's.
fn base_pose(state: &PlantState) -> RigidTransform {
    let [x, y, z, w] = state.base_orientation_w;
    let rotation = UnitQuaternion::try_new(Quaternion::new(w, x, y, z), 0.5)
        .map_or_else(nalgebra::Matrix3::identity, |unit| unit.to_rotation_matrix().into_inner());
    RigidTransform { rotation, translation: state.base_position_w.into() }
}
