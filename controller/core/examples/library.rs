//! The controller as a library: no process, no file, no URDF. A mass of 40 kg on an ankle leans 6 degrees too far forward and is brought
//! upright, the pressure point kept in the sole.
//!
//! `cargo run --package delmpc-controller-core --example library`

use std::error::Error;

use delmpc_controller_core::prelude::*;
use delmpc_mechanics::prelude::*;
use delmpc_messages::{PlantState, ServoReadings, joint_set_hash};

/// Brings the mass upright, and fails when it is not.
pub fn main() -> Result<(), Box<dyn Error>> {
    let (tree, limits) = robot()?;
    let mut real = Simulation::new(&tree, [0.0, 0.05])?;

    // --8<-- quoted in README.md
    let joints = joint_set_hash(&["ankle_roll", "ankle_pitch"]);
    let sole = vec![[-0.08, -0.06], [0.17, -0.06], [0.17, 0.06], [-0.08, 0.06]];
    let model = ControllerModel::standing(tree.clone(), joints, limits, sole, vec![0.0, -0.05]);
    let config = ControllerConfig { delay_s: 0.0, ..ControllerConfig::default() };
    let mut controller = Controller::new(model, config)?;

    let mut state = PlantState::new(1, joints, 2);
    let mut torque = [0.0; 2];
    for now_ns in (0..3_000_000_000).step_by(5_000_000) {
        let (position, velocity) = real.encoders();
        state.header.sequence += 1;
        state.time_ns = now_ns;
        state.position[..2].copy_from_slice(&position);
        state.velocity[..2].copy_from_slice(&velocity);
        let command = controller.cycle(&state, now_ns, &StoppedClock);
        // The command is a feedback law: evaluate it as often as there are encoder readings.
        for servo_ns in (now_ns..now_ns + 5_000_000).step_by(1_000_000) {
            let (position, velocity) = real.encoders();
            let readings = ServoReadings::joints(&position, &velocity);
            command.torque_into(servo_ns, &readings, &mut torque)?;
            real.drive(&torque)?;
        }
    }
    // --8<--

    let (position, _) = real.encoders();
    println!("after 3 s: roll {:+.4} rad, pitch {:+.4} rad", position[0], position[1]);
    let off = position[0].abs().max((position[1] + 0.05).abs());
    if off < 2e-3 { Ok(()) } else { Err(format!("{off:.4} rad from where it should stand").into()) }
}

/// An ankle of two joints 0.1 m above the sole, which is {0}, and 40 kg on it. From a URDF: `delmpc_robots::load`, `rooted_at`.
fn robot() -> Result<(KinematicTree, Vec<JointLimits>), Box<dyn Error>> {
    let ankle = RigidTransform::from_translation(Vector3::new(0.0, 0.0, 0.1));
    let talus = LinkInertia::new(1.0, Vector3::zeros(), Matrix3::identity() * 0.005);
    let rest = LinkInertia::new(39.0, Vector3::new(0.08, 0.0, 0.7), Matrix3::identity());
    let mut tree = TreeBuilder::fixed_base(Vector3::new(0.0, 0.0, -9.81));
    let roll = tree.add(Body::new(None, Joint::revolute(Vector3::x(), ankle), talus));
    tree.add(Body::new(Some(roll), Joint::revolute(Vector3::y(), RigidTransform::identity()), rest));
    let limits = JointLimits { lower: -0.5, upper: 0.5, effort: 150.0, velocity: 6.0 };
    Ok((tree.build()?, vec![limits; 2]))
}

/// What stands for the real robot here: the same tree, integrated at 1 kHz.
struct Simulation {
    tree: KinematicTree,
    integrator: Integrator,
    state: State,
    rate: Vec<f64>,
}

impl Simulation {
    fn new(tree: &KinematicTree, position: [f64; 2]) -> Result<Self, Box<dyn Error>> {
        let simpson = LobattoRule::new(2)?;
        let integrator = Integrator::new(tree, &simpson, 1e-3, StepOptions::default())?;
        let mut state = State::zeros(tree);
        state.q.copy_from_slice(&position);
        Ok(Self { tree: tree.clone(), integrator, state, rate: vec![0.0; 2] })
    }

    /// Positions and velocities of the joints.
    fn encoders(&self) -> (Vec<f64>, Vec<f64>) {
        (self.state.q.clone(), self.rate.clone())
    }

    /// A millisecond under these torques.
    fn drive(&mut self, torque: &[f64]) -> Result<(), Box<dyn Error>> {
        self.integrator.step(&self.tree, &mut self.state, &StepForces::held(torque))?;
        self.integrator.velocities().velocity_into(&self.tree, &self.state, &mut self.rate)?;
        Ok(())
    }
}
