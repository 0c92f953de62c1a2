//! What the chart-free floating base costs beside six virtual joints: a step of a free-floating Atlas in both forms.
//!
//! `cargo bench -p delmpc-mechanics --bench floating_base` prints both times and their ratio, and fails when the chart-free step is the
//! dearer one. The robot (30 joints, the foot of `atlas_v4_rfoot_s2.json` as base of 20 kg) tumbles freely; the same motion, step and
//! Newton matrix for both; steps are measured in turns, the figures are the least of several medians.
//!
//! `.. -- --profile chart-free|virtual S REPEATS` only runs steps: for `valgrind --tool=callgrind`, to see where instructions go.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

#[path = "../tests/oracle/mod.rs"]
mod oracle;

use std::process::ExitCode;
use std::time::Instant;

use delmpc_mechanics::prelude::*;

const TIME_STEP: f64 = 0.005;
/// Steps of one stretch of motion; the first ones, from a cold guess, are not timed.
const STEPS: usize = 40;
const WARM_UP: usize = 4;

fn base() -> LinkInertia {
    LinkInertia::new(20.0, Vector3::zeros(), Matrix3::from_diagonal(&Vector3::new(0.6, 0.5, 0.4)))
}

/// Adds the robot's bodies to a builder whose base is body `base`.
fn with_robot(mut builder: TreeBuilder, robot: &KinematicTree, base: usize) -> KinematicTree {
    for body in robot.bodies() {
        let parent = body.parent.map_or(base, |parent| parent + base + 1);
        builder.add(Body { parent: Some(parent), ..*body });
    }
    builder.build().unwrap()
}

fn chart_free(robot: &KinematicTree) -> KinematicTree {
    with_robot(TreeBuilder::floating_base(*robot.gravity_w(), base()), robot, 0)
}

/// Three prismatic and three revolute joints; the first five bodies have no mass.
fn virtual_joints(robot: &KinematicTree) -> KinematicTree {
    let mut builder = TreeBuilder::fixed_base(*robot.gravity_w());
    let place = RigidTransform::identity;
    let joints = [
        Joint::prismatic(Vector3::x(), place()),
        Joint::prismatic(Vector3::y(), place()),
        Joint::prismatic(Vector3::z(), place()),
        Joint::revolute(Vector3::z(), place()),
        Joint::revolute(Vector3::y(), place()),
        Joint::revolute(Vector3::x(), place()),
    ];
    let mut parent = None;
    for (k, joint) in joints.into_iter().enumerate() {
        let inertia = if k == 5 { base() } else { LinkInertia::massless() };
        parent = Some(builder.add(Body::new(parent, joint, inertia)));
    }
    with_robot(builder, robot, 5)
}

struct Run {
    tree: KinematicTree,
    integrator: Integrator,
    begun: State,
    torque: Vec<f64>,
    steps: usize,
    iterations: usize,
}

impl Run {
    fn new(tree: KinematicTree, method: NewtonMethod, s: usize, q: &[f64]) -> Self {
        let rule = LobattoRule::new(s).unwrap();
        let options = StepOptions { method: Some(method), ..StepOptions::default() };
        let mut integrator = Integrator::new(&tree, &rule, TIME_STEP, options).unwrap();
        let mut begun = State::zeros(&tree);
        let skipped = begun.q.len() - q.len();
        begun.q[skipped..].copy_from_slice(q);
        let mut rate: Vec<f64> = (0..tree.dof()).map(|k| 0.2 * ((k as f64 + 1.0) * 12.9898).sin()).collect();
        // Chart-free: (angular, linear); virtual joints: x, y, z, then about z, y, x.
        let turn = [0.8, -0.5, 0.3];
        let first = if tree.is_floating() { turn } else { [0.0; 3] };
        let last = if tree.is_floating() { [0.0; 3] } else { [turn[2], turn[1], turn[0]] };
        rate[..3].copy_from_slice(&first);
        rate[3..6].copy_from_slice(&last);
        integrator.velocities().set_velocity(&tree, &mut begun, &rate).unwrap();
        let torque = vec![0.0; tree.joint_count()];
        Self { tree, integrator, begun, torque, steps: 0, iterations: 0 }
    }

    /// Median time of a warm step of the stretch, µs.
    fn stretch(&mut self) -> f64 {
        let mut state = self.begun.clone();
        self.integrator.forget();
        let mut samples = Vec::with_capacity(STEPS);
        for step in 0..STEPS {
            let start = Instant::now();
            let report =
                self.integrator.step(&self.tree, &mut state, &StepForces::held(&self.torque)).unwrap();
            if step >= WARM_UP {
                samples.push(start.elapsed().as_secs_f64() * 1e6);
                self.steps += 1;
                self.iterations += report.iterations;
            }
        }
        samples.sort_by(f64::total_cmp);
        samples[samples.len() / 2]
    }
}

fn main() -> ExitCode {
    let case = oracle::Case::new("atlas".into(), oracle::read("atlas_v4_rfoot_s2.json"));
    let arguments: Vec<String> = std::env::args().skip(1).filter(|a| a != "--bench").collect();
    if let [mode, form, s, repeats] = arguments.as_slice()
        && mode == "--profile"
    {
        let tree = if form == "virtual" { virtual_joints(&case.tree) } else { chart_free(&case.tree) };
        let mut run = Run::new(tree, NewtonMethod::BranchLu, s.parse().unwrap(), &case.state.q);
        for _ in 0..repeats.parse().unwrap() {
            run.stretch();
        }
        return ExitCode::SUCCESS;
    }
    let mut kept = true;
    println!(
        "| s | chart-free, µs (iterations) | six virtual joints, µs (iterations) | ratio |\n|---|---|---|---|"
    );
    for s in [1, 2, 3] {
        let mut runs = [chart_free(&case.tree), virtual_joints(&case.tree)]
            .map(|tree| Run::new(tree, NewtonMethod::BranchLu, s, &case.state.q));
        let mut best = [f64::INFINITY; 2];
        for _ in 0..60 {
            for (run, best) in runs.iter_mut().zip(&mut best) {
                *best = best.min(run.stretch());
            }
        }
        let ratio = best[0] / best[1];
        kept &= ratio <= 1.0;
        let mean = |run: &Run| run.iterations as f64 / run.steps as f64;
        println!(
            "| {s} | {:.1} ({:.2}) | {:.1} ({:.2}) | {ratio:.2} |",
            best[0],
            mean(&runs[0]),
            best[1],
            mean(&runs[1])
        );
    }
    if kept {
        return ExitCode::SUCCESS;
    }
    eprintln!("the chart-free step costs more than six virtual joints");
    ExitCode::FAILURE
}
