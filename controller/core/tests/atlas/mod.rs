//! Atlas on its right foot, and a plant whose foot cannot move: enough to close the loop without contact.
#![allow(dead_code)]

use delmpc_controller_core::prelude::*;
use delmpc_estimation::prelude::{EstimatorConfig, EstimatorModel, FootModel};
use delmpc_mechanics::forces::{PointForce, StepForces};
use delmpc_mechanics::kinematics::{Configuration, Kinematics, Velocity, base_link_pose};
use delmpc_mechanics::lobatto::LobattoRule;
use delmpc_mechanics::spatial::{RigidTransform, Twist};
use delmpc_mechanics::state::State;
use delmpc_mechanics::step::{Integrator, StepOptions};
use delmpc_messages::{Command, PlantState, ServoReadings, joint_set_hash, sensor};
use delmpc_robots::{RobotModel, RootedModel, load};
use nalgebra::{UnitQuaternion, Vector3};

pub struct Atlas {
    pub floating: RobotModel,
    pub rooted: RootedModel,
}

pub fn atlas() -> Atlas {
    let file = concat!(env!("CARGO_MANIFEST_DIR"), "/../../configs/robots/atlas.urdf");
    let floating = load(file).unwrap();
    let rooted = floating.rooted_at("r_sole_centre").unwrap();
    Atlas { floating, rooted }
}

impl Atlas {
    pub fn hash(&self) -> u64 {
        let names: Vec<&str> = self.floating.joint_names.iter().map(String::as_str).collect();
        joint_set_hash(&names)
    }

    pub fn point(&self, frame: &str) -> BodyPoint {
        let attachment = self.rooted.model.frame(frame).unwrap();
        BodyPoint { body: attachment.body.unwrap(), position: attachment.pose.translation }
    }

    /// Right and left, as in the messages.
    pub fn feet(&self) -> Vec<FootModel> {
        let foot = |sole: &delmpc_robots::Sole| {
            let frame = self.floating.frame(&sole.frame).unwrap();
            let polygon = sole.polygon.iter().map(|p| [p.x, p.y]).collect();
            FootModel { body: frame.body.unwrap(), sole: frame.pose, polygon }
        };
        assert_eq!(self.floating.soles[0].name, "right");
        self.floating.soles.iter().map(foot).collect()
    }

    pub fn controller_model(&self) -> ControllerModel {
        let rooted = &self.rooted.model;
        let sole = self.floating.sole("right").unwrap();
        ControllerModel {
            tree: rooted.tree.clone(),
            message_joint: ControllerModel::message_joints(&self.rooted.rerooted),
            joint_set_hash: self.hash(),
            limits: rooted
                .limits
                .iter()
                .map(|l| JointLimits {
                    lower: l.lower,
                    upper: l.upper,
                    effort: l.effort,
                    velocity: l.velocity,
                })
                .collect(),
            sole: sole.polygon.iter().map(|p| [p.x, p.y]).collect(),
            hand: Some(self.point("l_hand_point")),
            swing_foot: Some(self.point("l_sole_centre")),
            posture: rooted.posture("one_foot_right").unwrap().q.clone(),
            sensing: Some(Sensing {
                estimator: EstimatorModel {
                    reference_foot: 0,
                    ..EstimatorModel::new(self.floating.tree.clone(), self.feet())
                },
                config: EstimatorConfig::default(),
                stance_foot: 0,
                rerooted: self.rooted.rerooted.clone(),
            }),
        }
    }
}

/// The plant: foot-rooted Atlas at 1 kHz under the servo law of the last valid command.
pub struct WeldedPlant {
    pub model: ControllerModel,
    integrator: Integrator,
    pub state: State,
    pub rate: Vec<f64>,
    pub time_ns: u64,
    pub command: Option<Command>,
    kinematics: Kinematics,
    pub torque: Vec<f64>,
    pub push: Option<PointForce>,
    pub sequence: u64,
    pub worst_torque_ratio: f64,
}

pub const STEP_NS: u64 = 1_000_000;

impl WeldedPlant {
    pub fn new(atlas: &Atlas) -> Self {
        let model = atlas.controller_model();
        let rule = LobattoRule::new(2).unwrap();
        let integrator = Integrator::new(
            &model.tree,
            &rule,
            STEP_NS as f64 * 1e-9,
            StepOptions {
                forces: delmpc_mechanics::del_residual::ForceCapacity { points: 1, ..Default::default() },
                ..Default::default()
            },
        )
        .unwrap();
        let mut state = State::zeros(&model.tree);
        state.q.copy_from_slice(&model.posture);
        Self {
            kinematics: Kinematics::new(&model.tree),
            rate: vec![0.0; model.tree.dof()],
            torque: vec![0.0; model.tree.dof()],
            integrator,
            state,
            time_ns: 0,
            command: None,
            push: None,
            sequence: 0,
            worst_torque_ratio: 0.0,
            model,
        }
    }

    /// One step of 1 ms.
    pub fn step(&mut self) {
        let n = self.rate.len();
        let (mut position, mut velocity) = (vec![0.0; n], vec![0.0; n]);
        for (i, &joint) in self.model.message_joint.iter().enumerate() {
            position[joint] = self.state.q[i];
            velocity[joint] = self.rate[i];
        }
        let mut message_torque = vec![0.0; n];
        if let Some(command) = &self.command {
            let readings = ServoReadings::joints(&position, &velocity);
            command.torque_into(self.time_ns, &readings, &mut message_torque).unwrap();
        }
        for (i, &joint) in self.model.message_joint.iter().enumerate() {
            let limit = self.model.limits[i].effort;
            self.worst_torque_ratio = self.worst_torque_ratio.max(message_torque[joint].abs() / limit);
            self.torque[i] = message_torque[joint].clamp(-limit, limit);
        }
        let points: Vec<PointForce> = self.push.into_iter().collect();
        let forces = StepForces::held(&self.torque).with_points(&points);
        self.integrator.step(&self.model.tree, &mut self.state, &forces).unwrap();
        self.integrator.velocities().velocity_into(&self.model.tree, &self.state, &mut self.rate).unwrap();
        self.time_ns += STEP_NS;
    }

    pub fn measure(&mut self) -> PlantState {
        let n = self.rate.len();
        let mut out = PlantState::new(1, self.model.joint_set_hash, n as u32);
        self.sequence += 1;
        out.header.sequence = self.sequence;
        out.time_ns = self.time_ns;
        for (i, &joint) in self.model.message_joint.iter().enumerate() {
            out.position[joint] = self.state.q[i];
            out.velocity[joint] = self.rate[i];
        }
        self.update_kinematics();
        let sensing = self.model.sensing.as_ref().unwrap();
        let (rerooted, floating) = (&sensing.rerooted, &sensing.estimator.tree);
        let base = rerooted.base_pose_w(&self.kinematics, &RigidTransform::identity());
        let link = base_link_pose(floating, &base);
        let twist_w = rerooted.base_twist_w(&self.kinematics, &RigidTransform::identity(), &Twist::default());
        let twist_b = link.inverse_transform_twist(&twist_w);
        out.sensors = sensor::MOTION_CAPTURE;
        out.base_angular_velocity_b = twist_b.angular.into();
        out.base_linear_velocity_b = twist_b.linear.into();
        out.base_position_w = link.translation.into();
        let rotation = nalgebra::Rotation3::from_matrix_unchecked(link.rotation);
        let quaternion = UnitQuaternion::from_rotation_matrix(&rotation);
        out.base_orientation_w = quaternion.coords.into();
        out
    }

    fn update_kinematics(&mut self) {
        self.kinematics
            .update(&self.model.tree, &Configuration::fixed(&self.state.q), &Velocity::fixed(&self.rate))
            .unwrap();
    }

    pub fn com(&mut self) -> (Vector3<f64>, Vector3<f64>) {
        self.update_kinematics();
        let tree = &self.model.tree;
        (self.kinematics.mass_centre_of_tree_w(tree), self.kinematics.mass_centre_velocity_w(tree))
    }

    pub fn hand(&mut self) -> Vector3<f64> {
        self.update_kinematics();
        let hand = self.model.hand.unwrap();
        self.kinematics.point_w(hand.body, &hand.position)
    }

    pub fn swing_foot(&mut self) -> Vector3<f64> {
        self.update_kinematics();
        let foot = self.model.swing_foot.unwrap();
        self.kinematics.point_w(foot.body, &foot.position)
    }

    /// Total momentum about the origin.
    pub fn momentum(&mut self) -> delmpc_mechanics::spatial::Momentum {
        self.update_kinematics();
        delmpc_mechanics::energy::total_momentum_w(&self.model.tree, &self.kinematics)
    }
}
