//! What the robot aims at, at every boundary of a grid: base, joints, feet, and the forces and torques that carry that.
//!
//! 1. The mass centre goes along a path, or over the feet as a walk has it; the base is turned along with the path.
//! 2. The feet are where the schedule has them; one that swings goes by minimum jerk from the one place to the other, lifted by
//!    `16 h τ² (1-τ)²`, `τ` from 0 to 1 over the swing, and ends a little below the ground. It is over its foothold somewhat before it
//!    lands: a foot that lands early lands there too.
//! 3. The legs follow by inverse kinematics, and the base moves until the mass centre is where it shall be.
//! 4. The feet that stand share what carries the mass centre and accelerates it; joint torques are those that hold the posture
//!    under these forces.
//!
//! So posture, torques and forces satisfy the statics of the model: a reference that does not would kick.

use alloc::vec;
use alloc::vec::Vec;

use delmpc_mechanics::contact_stage::{BoundaryKinematics, BoundaryState, Contact};
use delmpc_mechanics::errors::StepError;
use delmpc_mechanics::spatial::{exp_rotation, log_rotation};
use nalgebra::{Matrix3, Vector2, Vector3, Vector6};

use crate::base_path::{BasePath, turned_by, with_height};
use crate::contact_schedule::{ContactSchedule, FootPhase, Foothold, Swing};
use crate::errors::HorizonError;
use crate::leg_kinematics::LegKinematics;
use crate::legged_model::LeggedModel;
use crate::load_sharing::{Share, share_load};
use crate::mass_centre_plan::MassCentrePlan;
use crate::planned_base::PlannedBase;
use crate::stage_grid::StageGrid;

/// Iterations of the inverse kinematics at a boundary, and rounds in which the base follows the mass centre.
const ITERATIONS: usize = 3;
const ROUNDS: usize = 2;

/// Iterations of the inverse kinematics where nothing near is known.
const REACH_ITERATIONS: usize = 20;

/// A moment, s: longer than what makes two times one.
const BEFORE_S: f64 = 4e-6;

/// Part of a swing after which the foot is over its foothold.
const OVER_FOOTHOLD: f64 = 0.85;

/// How long it takes from the begin to the aim, s.
const SETTLED_S: f64 = 1.0;

/// How long it takes to crouch, s.
const CROUCH_S: f64 = 0.6;

/// Where base and mass centre go.
#[derive(Clone, Debug, PartialEq)]
pub struct Aim {
    /// The way of the robot: heading, and place of the mass centre where there is no plan of its own.
    pub path: BasePath,
    /// The way of the mass centre in a walk.
    pub mass_centre: Option<MassCentrePlan>,
    /// Base and mass centre as planned through contact: they replace path, mass centre and height; the ground moves them up and down.
    pub planned: Option<PlannedBase>,
    /// Height of the mass centre, m.
    pub height_m: f64,
    /// It goes down by this before the first step, so that no leg has to stretch, m ...
    pub crouch_m: f64,
    /// ... until then, s.
    pub crouched_s: f64,
    /// Where the height is told, m, and its gradient from there on.
    ground: (Vector2<f64>, Vector2<f64>),
}

impl Aim {
    /// The height is that over `middle` (m); from there on it changes with `gradient`.
    pub fn lean(&mut self, middle: Vector2<f64>, gradient: Vector2<f64>) {
        self.ground = (middle, gradient);
    }

    /// Place, velocity and acceleration of the mass centre at a time.
    pub fn mass_centre_at(&self, time_s: f64) -> [Vector3<f64>; 3] {
        if let Some(planned) = &self.planned {
            let [mut place, velocity, acceleration] = planned.at(time_s).mass_centre_w;
            place.z += self.height_m - planned.begin().mass_centre_w.z;
            return [place, velocity, acceleration];
        }
        let [place, velocity, acceleration] = match &self.mass_centre {
            Some(plan) => plan.at(time_s),
            None => {
                let point = self.path.at(time_s);
                [point.position, point.velocity, point.acceleration]
            }
        };
        let part = 1.0 + ((time_s - self.crouched_s) / CROUCH_S).clamp(-1.0, 0.0);
        let down = part * part * part * (10.0 + part * (6.0 * part - 15.0));
        let speed = 30.0 * part * part * (1.0 - part) * (1.0 - part) / CROUCH_S;
        let change = 60.0 * part * (1.0 - part) * (1.0 - 2.0 * part) / (CROUCH_S * CROUCH_S);
        let (middle, gradient) = &self.ground;
        let height = self.height_m + gradient.dot(&(place - middle));
        [
            with_height(&place, height - self.crouch_m * down),
            with_height(&velocity, gradient.dot(&velocity) - self.crouch_m * speed),
            with_height(&acceleration, -self.crouch_m * change),
        ]
    }
}

impl Aim {
    /// How the base is turned at a time from its orientation at home without its heading, `upright`; and its angular velocity.
    fn turn_at(&self, time_s: f64, upright: &Matrix3<f64>) -> (Matrix3<f64>, Vector3<f64>) {
        if let Some(planned) = &self.planned {
            let point = planned.at(time_s);
            return (point.orientation * upright.transpose(), point.orientation * point.spin_b);
        }
        let point = self.path.at(time_s);
        (rotation_z(point.yaw), Vector3::new(0.0, 0.0, point.yaw_rate))
    }
}

/// How a foot swings.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SwingShape {
    /// Lift in the middle, m.
    pub lift_m: f64,
    /// Where it ends below the ground, m.
    pub depth_m: f64,
}

/// The aim at one boundary.
#[derive(Clone, Debug, PartialEq)]
pub struct Target {
    /// Pose, joints and their velocities.
    pub state: BoundaryState,
    /// Mass centre, m, and its velocity, m/s.
    pub mass_centre_w: Vector3<f64>,
    /// See above.
    pub mass_centre_velocity_w: Vector3<f64>,
    /// Places of all feet.
    pub feet: Vec<Foothold>,
    /// Forces in the stage that begins here, rows of all contacts.
    pub force: Vec<f64>,
    /// Joint torques in it.
    pub torque: Vec<f64>,
}

/// Aims at all boundaries.
#[derive(Clone, Debug)]
pub struct MotionReference {
    aim: Aim,
    swing: SwingShape,
    legs: LegKinematics,
    kinematics: BoundaryKinematics,
    contacts: Vec<Contact>,
    rows: Vec<usize>,
    shares: Vec<Option<Share>>,
    /// Orientation at home without its heading.
    upright: Matrix3<f64>,
    /// From the base to the mass centre at home, in axes that only have the heading.
    to_mass_centre: Vector3<f64>,
    targets: Vec<Target>,
    begin: Begin,
}

/// How the robot differs from its aim when it begins.
#[derive(Clone, Copy, Debug, Default)]
struct Begin {
    time_s: f64,
    /// Rotation of the base, in its axes.
    turn: Vector3<f64>,
    /// Mass centre, m.
    way: Vector3<f64>,
}

impl Begin {
    /// What is left of the difference, by minimum jerk.
    fn left(&self, time_s: f64) -> f64 {
        let part = ((time_s - self.time_s) / SETTLED_S).clamp(0.0, 1.0);
        1.0 - part * part * part * (10.0 + part * (6.0 * part - 15.0))
    }
}

impl MotionReference {
    /// For a robot that stands still on `places`, its mass centre over them as at home. Allocates.
    ///
    /// # Errors
    /// When the mechanics refuse the model.
    pub fn new(
        model: &LeggedModel,
        stages: usize,
        swing: SwingShape,
        places: &[Foothold],
    ) -> Result<Self, HorizonError> {
        let home = &model.posture;
        let mut kinematics = BoundaryKinematics::new(&model.tree)?;
        kinematics.update(&model.tree, home)?;
        let yaw = heading(&home.orientation);
        let mass_centre = kinematics.mass_centre_w(&model.tree);
        let contacts = model.contacts();
        let rows: Vec<usize> = contacts.iter().map(Contact::row_count).collect();
        let soles: Vec<Vector3<f64>> =
            contacts.iter().map(|contact| kinematics.placement(&model.tree, contact).point_w).collect();
        let count = soles.len().max(1) as f64;
        let middle_home = soles.iter().sum::<Vector3<f64>>() / count;
        let middle = places.iter().map(|place| place.position_w).sum::<Vector3<f64>>() / count;
        let turned = heading_of(places) - heading_of_home(model, &kinematics, &contacts);
        let offset = turned_by(&(mass_centre.xy() - middle_home.xy()), turned);
        let aim = Aim {
            path: BasePath::still(middle.xy() + offset, yaw + turned),
            mass_centre: None,
            planned: None,
            height_m: middle.z + mass_centre.z - middle_home.z,
            crouch_m: 0.0,
            crouched_s: 0.0,
            ground: (Vector2::zeros(), Vector2::zeros()),
        };
        let target = Target {
            state: home.clone(),
            mass_centre_w: mass_centre,
            mass_centre_velocity_w: Vector3::zeros(),
            feet: places.to_vec(),
            force: vec![0.0; rows.iter().sum()],
            torque: vec![0.0; model.tree.joint_count()],
        };
        let level = rotation_z(-yaw);
        Ok(Self {
            aim,
            swing,
            legs: LegKinematics::new(model),
            kinematics,
            shares: vec![None; contacts.len()],
            contacts,
            rows,
            upright: level * home.orientation,
            to_mass_centre: level * (mass_centre - home.position_w),
            targets: vec![target; stages + 1],
            begin: Begin::default(),
        })
    }

    /// The robot begins in `state`: from there it goes to its aim in a second, by minimum jerk.
    ///
    /// # Errors
    /// When the state does not fit the model.
    pub fn begin_at(
        &mut self,
        model: &LeggedModel,
        state: &BoundaryState,
        time_s: f64,
    ) -> Result<(), HorizonError> {
        self.kinematics.update(&model.tree, state)?;
        let [place, ..] = self.aim.mass_centre_at(time_s);
        let aimed = self.aim.turn_at(time_s, &self.upright).0 * self.upright;
        self.begin = Begin {
            time_s,
            turn: log_rotation(&aimed.tr_mul(&state.orientation)),
            way: self.kinematics.mass_centre_w(&model.tree) - place,
        };
        for target in &mut self.targets {
            target.state.q.copy_from_slice(&state.q);
        }
        Ok(())
    }

    /// The joints from which the inverse kinematics of the first boundary begins.
    pub fn restore_joints(&mut self, q: &[f64]) {
        self.targets[0].state.q.copy_from_slice(q);
    }

    /// Where base and mass centre go.
    pub fn aim(&self) -> &Aim {
        &self.aim
    }

    /// The same, to change.
    pub fn aim_mut(&mut self) -> &mut Aim {
        &mut self.aim
    }

    /// The aim at a boundary of the last grid.
    pub fn target(&self, boundary: usize) -> &Target {
        &self.targets[boundary]
    }

    /// How well the legs reach their footholds at a time with the mass centre where the aim has it: the error that is left of the feet (m, rad), and
    /// the least distance of a leg's joint from its stops (rad).
    ///
    /// # Errors
    /// When the mechanics refuse a posture.
    pub fn reach(
        &mut self,
        model: &LeggedModel,
        schedule: &ContactSchedule,
        time_s: f64,
    ) -> Result<(f64, f64), StepError> {
        self.place(model, 0, time_s, schedule)?;
        let target = &mut self.targets[0];
        let pose = target.state.base_pose_w();
        let error = self.legs.solve(model, &pose, &target.feet, &mut target.state.q, REACH_ITERATIONS)?;
        let joints = (0..model.feet.len()).flat_map(|foot| self.legs.leg(foot).iter());
        let margin = |joint: &usize| {
            let (q, limit) = (target.state.q[*joint], &model.limits[*joint]);
            (q - limit.lower).min(limit.upper - q)
        };
        Ok((error, joints.map(margin).fold(f64::INFINITY, f64::min)))
    }

    /// Aims at all boundaries of `grid` with the feet as in `schedule`. No allocation.
    ///
    /// # Errors
    /// When the mechanics refuse a posture.
    pub fn update(
        &mut self,
        model: &LeggedModel,
        grid: &StageGrid,
        schedule: &ContactSchedule,
    ) -> Result<(), StepError> {
        let stages = grid.stages();
        for k in 0..=stages {
            let time_s = grid.times()[k];
            // Every boundary begins where the one before it ended.
            if k > 0 {
                let (before, after) = self.targets.split_at_mut(k);
                after[0].state.q.copy_from_slice(&before[k - 1].state.q);
            }
            let inside = if k < stages { grid.inside(k) } else { time_s };
            self.place(model, k, time_s, schedule)?;
            self.load(model, k, inside, schedule)?;
        }
        for k in 0..=stages {
            self.rates(k, grid);
        }
        Ok(())
    }

    /// Base, feet and legs.
    fn place(
        &mut self,
        model: &LeggedModel,
        k: usize,
        time_s: f64,
        schedule: &ContactSchedule,
    ) -> Result<(), StepError> {
        let Self { aim, swing, legs, targets, upright, to_mass_centre, begin, .. } = self;
        let target = &mut targets[k];
        let (turn, spin_w) = aim.turn_at(time_s, upright);
        let [place, velocity, _] = aim.mass_centre_at(time_s);
        let left = begin.left(time_s);
        let place = place + begin.way * left;
        (target.mass_centre_w, target.mass_centre_velocity_w) = (place, velocity);
        target.state.orientation = turn * *upright * exp_rotation(&(begin.turn * left));
        target.state.position_w = place - turn * *to_mass_centre;
        for (foot, out) in target.feet.iter_mut().enumerate() {
            // At its touchdown a foot is still where its swing ends.
            *out = match schedule.phase(foot, time_s - BEFORE_S) {
                FootPhase::Stance(stance) => stance.place,
                FootPhase::Swing(swinging) => swing_place(&swinging, swing, time_s),
            };
        }
        // Where a leg is stretched it could as well bend the other way.
        if let Some(planned) = &aim.planned {
            planned.joints_at(time_s, &mut target.state.q);
        }
        for _ in 0..ROUNDS {
            let pose = target.state.base_pose_w();
            legs.solve(model, &pose, &target.feet, &mut target.state.q, ITERATIONS)?;
            target.state.position_w += place - legs.mass_centre_w(model);
        }
        let spin = target.state.orientation.tr_mul(&spin_w);
        let linear = target.state.orientation.tr_mul(&velocity);
        target.state.base_velocity_b = Vector6::new(spin.x, spin.y, spin.z, linear.x, linear.y, linear.z);
        Ok(())
    }

    /// Forces and torques of the stage that begins at a boundary.
    fn load(
        &mut self,
        model: &LeggedModel,
        k: usize,
        inside_s: f64,
        schedule: &ContactSchedule,
    ) -> Result<(), StepError> {
        let Self { aim, kinematics, contacts, rows, shares, targets, .. } = self;
        let target = &mut targets[k];
        target.state.rate.fill(0.0);
        for (foot, share) in shares.iter_mut().enumerate() {
            *share = match schedule.phase(foot, inside_s) {
                FootPhase::Stance(stance) => Some(Share {
                    kind: contacts[foot].kind,
                    position_w: stance.place.position_w,
                    axes_w: stance.place.axes_w,
                    part: 1.0,
                }),
                FootPhase::Swing(_) => None,
            };
            if let Some(share) = share {
                contacts[foot].axes_w = share.axes_w;
            }
        }
        let [_, _, acceleration] = aim.mass_centre_at(inside_s);
        let carried = (acceleration - model.tree.gravity_w()) * model.tree.total_mass();
        let wrench = Vector6::new(0.0, 0.0, 0.0, carried.x, carried.y, carried.z);
        share_load(shares, rows, &target.mass_centre_w, &wrench, &mut target.force);
        kinematics.update(&model.tree, &target.state)?;
        kinematics.static_torques_into(&model.tree, contacts, &target.force, &mut target.torque)?;
        for (torque, limit) in target.torque.iter_mut().zip(&model.limits) {
            *torque = torque.clamp(-limit.effort, limit.effort);
        }
        Ok(())
    }

    /// Joint rates from the joints of the boundaries beside.
    fn rates(&mut self, k: usize, grid: &StageGrid) {
        let last = grid.stages();
        let (from, to) = (k.saturating_sub(1), (k + 1).min(last));
        let duration = grid.times()[to] - grid.times()[from];
        for j in 0..self.targets[k].state.q.len() {
            let change = self.targets[to].state.q[j] - self.targets[from].state.q[j];
            self.targets[k].state.rate[j] = change / duration;
        }
    }
}

/// Where a foot in the air shall be.
pub fn swing_place(swing: &Swing, shape: &SwingShape, time_s: f64) -> Foothold {
    let part = ((time_s - swing.begin_s) / (swing.planned_end_s - swing.begin_s)).clamp(0.0, 1.0);
    let part = if part.is_finite() { part } else { 1.0 };
    let minimum_jerk = |x: f64| x * x * x * (10.0 + x * (6.0 * x - 15.0));
    let s = minimum_jerk((part / OVER_FOOTHOLD).min(1.0));
    let lift = 16.0 * shape.lift_m * part * part * (1.0 - part) * (1.0 - part);
    let mut position_w = swing.from.position_w * (1.0 - s) + swing.to.position_w * s;
    position_w.z += lift - shape.depth_m * minimum_jerk(part);
    let turn = log_rotation(&swing.from.axes_w.tr_mul(&swing.to.axes_w));
    Foothold { position_w, axes_w: swing.from.axes_w * exp_rotation(&(turn * s)) }
}

/// Heading of the x axis, rad.
fn heading(axes: &Matrix3<f64>) -> f64 {
    libm::atan2(axes[(1, 0)], axes[(0, 0)])
}

/// Mean heading of the soles.
fn heading_of(places: &[Foothold]) -> f64 {
    let forward: Vector2<f64> =
        places.iter().map(|place| Vector2::new(place.axes_w[(0, 0)], place.axes_w[(1, 0)])).sum();
    libm::atan2(forward.y, forward.x)
}

fn heading_of_home(model: &LeggedModel, kinematics: &BoundaryKinematics, contacts: &[Contact]) -> f64 {
    let mut forward = Vector2::zeros();
    for (foot, contact) in model.feet.iter().zip(contacts) {
        let pose = kinematics.kinematics().link_poses_w()[contact.body];
        let axis: Vector3<f64> = (pose.rotation * foot.sole.rotation).column(0).into();
        forward += axis.xy();
    }
    libm::atan2(forward.y, forward.x)
}

fn rotation_z(yaw: f64) -> Matrix3<f64> {
    let (s, c) = (libm::sin(yaw), libm::cos(yaw));
    Matrix3::new(c, -s, 0.0, s, c, 0.0, 0.0, 0.0, 1.0)
}
