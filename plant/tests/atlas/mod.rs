//! Atlas for the plant's tests.
#![allow(dead_code)]

use std::path::PathBuf;

use delmpc_mechanics::load_response::BoundaryMotion;
use delmpc_mechanics::state::State;
use delmpc_messages::JointSetHasher;
use delmpc_plant::prelude::*;
use delmpc_robots::RobotModel;

pub fn load() -> RobotModel {
    let file = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../configs/robots/atlas.urdf");
    delmpc_robots::load(file).unwrap()
}

pub fn model(robot: &RobotModel, friction: f64) -> PlantModel {
    let contacts = robot.contacts.iter().map(|contact| ContactPoint {
        body: contact.body.unwrap(),
        point: contact.position,
        radius: 0.0,
        friction,
    });
    let feet = robot.soles.iter().map(|sole| {
        let frame = robot.frame(&sole.frame).unwrap();
        Foot {
            body: frame.body.unwrap(),
            sole: frame.pose,
            contacts: sole.contacts.clone(),
            polygon: sole.polygon.iter().map(|corner| [corner.x, corner.y]).collect(),
        }
    });
    let hasher = robot.joint_names.iter().fold(JointSetHasher::new(), |hasher, name| hasher.joint(name));
    PlantModel {
        contacts: contacts.collect(),
        feet: feet.collect(),
        joint_set_hash: hasher.finish(),
        tree: robot.tree.clone(),
    }
}

pub fn posture(robot: &RobotModel, name: &str) -> State {
    let posture = robot.posture(name).unwrap();
    let mut state = State::zeros(&robot.tree);
    state.q.copy_from_slice(&posture.q);
    state.base_pose = robot.base_pose_w(posture).unwrap();
    state
}

/// Holding torques of a posture, from the expected numbers.
pub fn static_torques(robot: &RobotModel, name: &str) -> Vec<f64> {
    let table = crate::common::read("robots/atlas_static_torques.json");
    robot.joint_names.iter().map(|joint| table[name][joint].as_f64().unwrap()).collect()
}

pub fn limits(robot: &RobotModel) -> Vec<ActuatorLimits> {
    let limit = |limit: &delmpc_robots::JointLimits| ActuatorLimits {
        effort: limit.effort,
        velocity: limit.velocity,
        rate: f64::INFINITY,
    };
    robot.limits.iter().map(limit).collect()
}

/// A plant that stands on both feet by joint stiffness about the double-support posture.
pub fn standing(robot: &RobotModel, config: PlantConfig) -> Plant {
    let model = model(robot, 0.8);
    let state = posture(robot, "double_support");
    let torque = static_torques(robot, "double_support");
    // Arms and neck are light: gains by the inertia each joint sees, stable at 1 kHz.
    let mut motion = BoundaryMotion::new(&model.tree);
    motion.update(&model.tree, &state).unwrap();
    let (mut stiffness, mut damping) = (Vec::new(), Vec::new());
    for (joint, name) in robot.joint_names.iter().enumerate() {
        let mut unit = vec![0.0; model.tree.dof()];
        unit[6 + joint] = 1.0;
        motion.factor().solve_in_place(&mut unit).unwrap();
        let inertia = 1.0 / unit[6 + joint];
        // A foot in the air is as light as a hand, but the ankles must carry.
        let (most_stiffness, most_damping) = (0.5e6 * inertia, 300.0 * inertia);
        let carries = name.contains("leg") || name.contains("back");
        stiffness.push(if carries { most_stiffness.min(3000.0) } else { inertia * 3600.0 });
        damping.push(if carries { most_damping.min(60.0) } else { inertia * 84.0 });
    }
    let law = AffineLaw::joint_stiffness(&torque, &state.q, &stiffness, &damping);
    let watchdog = WatchdogConfig { law: Some(law), ..WatchdogConfig::default() };
    let mut plant = Plant::new(&model, &PlantConfig { watchdog, ..config }, &state).unwrap();
    plant.preset_torque(&torque).unwrap();
    plant
}
