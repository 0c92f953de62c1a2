//! No memory is taken in a warm call: a counting allocator around every call that a control cycle makes.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]
#![allow(unsafe_code, reason = "a global allocator that counts; it passes every call on to the system's")]

mod sample_robots;

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;

use delmpc_mechanics::del_residual::ForceCapacity;
use delmpc_mechanics::forces::{BodySample, WrenchSample};
use delmpc_mechanics::newton_direction::NewtonMethod;
use delmpc_mechanics::prelude::*;
use delmpc_mechanics::step::NewtonVariant;
use nalgebra::Matrix6;
use sample_robots::{Forces, GRAVITY, arms, moving_state, quadruped, spatial_chain, spread};

struct Counting;

thread_local! {
    /// Calls of the allocator by this thread; tests run on threads of their own.
    static CALLS: Cell<usize> = const { Cell::new(0) };
}

fn count() {
    // A thread that is being torn down has no counter any more.
    let _ = CALLS.try_with(|calls| calls.set(calls.get() + 1));
}

// SAFETY: every method passes its arguments unchanged to the system allocator, which keeps the contract.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        count();
        // SAFETY: the caller's promise is passed on.
        unsafe { System.alloc(layout) }
    }
    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        count();
        // SAFETY: the caller's promise is passed on.
        unsafe { System.dealloc(pointer, layout) }
    }
    unsafe fn realloc(&self, pointer: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        count();
        // SAFETY: the caller's promise is passed on.
        unsafe { System.realloc(pointer, layout, size) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// Calls of the allocator, freeing included, while `work` runs.
fn allocations<T>(work: impl FnOnce() -> T) -> (usize, T) {
    let before = CALLS.with(Cell::get);
    let result = work();
    (CALLS.with(Cell::get) - before, result)
}

fn none<T>(what: &str, work: impl FnOnce() -> T) -> T {
    let (count, result) = allocations(work);
    assert_eq!(count, 0, "{what}: {count} calls of the allocator");
    result
}

/// A viscous wrench on one body.
struct Viscous(usize);

impl WrenchLaw for Viscous {
    fn body(&self) -> usize {
        self.0
    }
    fn evaluate(&self, sample: &BodySample) -> WrenchSample {
        let drag = -0.1 * sample.velocity_w.to_vector();
        WrenchSample {
            wrench_w: Wrench::from_vector(&drag),
            d_pose: Matrix6::zeros(),
            d_velocity: Matrix6::identity() * -0.1,
        }
    }
}

const METHODS: [Option<NewtonMethod>; 4] =
    [None, Some(NewtonMethod::BranchLu), Some(NewtonMethod::Recursive), Some(NewtonMethod::Dense)];

#[test]
fn the_counter_counts() {
    let (count, _) = allocations(|| vec![1.0; 100]);
    assert_eq!(count, 1);
}

#[test]
fn warm_steps_solves_and_velocities_take_no_memory() {
    for tree in
        [spatial_chain(GRAVITY, Forces::All), arms(GRAVITY, Forces::All), quadruped(GRAVITY, Forces::Springs)]
    {
        let start = moving_state(&tree, 2.0, 0.5);
        let torque = spread(tree.joint_count(), 0.3);
        let law = Viscous(1);
        let laws: [&dyn WrenchLaw; 1] = [&law];
        let points = [PointForce {
            body: 2,
            point_b: Vector3::new(0.1, 0.0, 0.0),
            force_w: Vector3::new(1.0, 0.0, 2.0),
        }];
        for method in METHODS {
            for variant in [
                NewtonVariant::Exact,
                NewtonVariant::Simplified,
                NewtonVariant::Broyden,
                NewtonVariant::Inertial,
            ] {
                for s in [1, 2, 3, 4] {
                    let name = format!("{} joints, {method:?}, {variant:?}, s = {s}", tree.joint_count());
                    let nodes = spread(tree.joint_count() * (s + 1), 0.3);
                    let capacity = ForceCapacity { points: 1, laws: true };
                    let options = StepOptions { method, variant, forces: capacity, ..StepOptions::default() };
                    let rule = LobattoRule::new(s).unwrap();
                    let mut integrator = Integrator::new(&tree, &rule, 0.005, options).unwrap();
                    let mut state = start.clone();
                    let mut velocity = vec![0.0; tree.dof()];
                    let held = StepForces::held(&torque);
                    let full = StepForces::per_node(&nodes).with_points(&points).with_laws(&laws);
                    none(&format!("{name}: first step"), || {
                        integrator.step(&tree, &mut state, &held).unwrap()
                    });
                    none(&format!("{name}: step that continues"), || {
                        (0..5).for_each(|_| _ = integrator.step(&tree, &mut state, &held).unwrap());
                    });
                    none(&format!("{name}: step with every force"), || {
                        integrator.step(&tree, &mut state, &full).unwrap()
                    });
                    none(&format!("{name}: solve"), || integrator.solve(&tree, &start, &full).unwrap());
                    none(&format!("{name}: velocity"), || {
                        integrator.velocities().velocity_into(&tree, &state, &mut velocity).unwrap();
                        integrator.velocities().set_velocity(&tree, &mut state, &velocity).unwrap();
                    });
                    none(&format!("{name}: refused step"), || {
                        assert!(integrator.step(&tree, &mut state, &StepForces::held(&[])).is_err());
                    });
                    none(&format!("{name}: new time step"), || integrator.set_time_step(0.004).unwrap());
                    none(&format!("{name}: failed step"), || {
                        let far = 1e8;
                        let wild = [far; 12];
                        let wild = StepForces::held(&wild[..tree.joint_count()]);
                        assert!(integrator.step(&tree, &mut state, &wild).is_err());
                    });
                }
            }
        }
    }
}

#[test]
fn warm_linearisations_and_adjoint_products_take_no_memory() {
    for tree in
        [spatial_chain(GRAVITY, Forces::All), arms(GRAVITY, Forces::All), quadruped(GRAVITY, Forces::Springs)]
    {
        let start = moving_state(&tree, 2.0, 0.5);
        let torque = spread(tree.joint_count(), 0.3);
        for method in METHODS {
            for s in [1, 2, 3] {
                let options = StepOptions { method, ..StepOptions::default() };
                let rule = LobattoRule::new(s).unwrap();
                let mut integrator = Integrator::new(&tree, &rule, 0.005, options).unwrap();
                integrator.solve(&tree, &start, &StepForces::held(&torque)).unwrap();
                for coordinates in [StateCoordinates::Momentum, StateCoordinates::Velocity] {
                    for hold in [InputHold::Held, InputHold::PerNode] {
                        let name = format!(
                            "{} joints, {method:?}, s = {s}, {coordinates:?}, {hold:?}",
                            tree.joint_count()
                        );
                        let Ok(mut work) = Linearizer::new(&tree, &integrator, coordinates, hold) else {
                            assert!(
                                tree.is_floating() && coordinates == StateCoordinates::Velocity,
                                "{name}"
                            );
                            continue;
                        };
                        let inputs = work.linear_step().inputs();
                        none(&format!("{name}: linearize"), || {
                            _ = work.linearize(&tree, &mut integrator).unwrap()
                        });
                        if coordinates == StateCoordinates::Velocity {
                            continue;
                        }
                        none(&format!("{name}: by tangent"), || {
                            _ = work.linearize_by_tangent(&tree, &mut integrator).unwrap();
                        });
                        if tree.is_floating() {
                            continue;
                        }
                        let lambda = spread(2 * tree.dof(), 1.0);
                        let (mut a, mut b) = (vec![0.0; 2 * tree.dof()], vec![0.0; inputs]);
                        none(&format!("{name}: adjoint"), || {
                            work.adjoint_into(&tree, &mut integrator, &lambda, &mut a, &mut b).unwrap();
                        });
                    }
                }
            }
        }
    }
}

#[test]
fn warm_batches_of_stages_take_no_memory() {
    use delmpc_mechanics::stage_batch::{InstructionSet, StageBatch, StageInput, TransitionSlice};
    let tree = spatial_chain(GRAVITY, Forces::Springs);
    let (n, stages) = (tree.dof(), 9);
    let (q, rate, force) = (spread(n, 0.4), spread(n, 0.5), spread(n, 0.3));
    let mut values = vec![0.0; stages * 6 * n * n];
    let mut end = vec![0.0; 2 * n];
    for set in [InstructionSet::Portable, InstructionSet::Avx2, InstructionSet::Avx512] {
        let rule = LobattoRule::new(2).unwrap();
        let Ok(mut batch) = StageBatch::with_instructions(&tree, &rule, stages, set) else { continue };
        none(&format!("{set:?}"), || {
            for k in 0..stages {
                let input = StageInput { nodes: [&q; 3], rate: &rate, force: &force, time_step: 0.02 };
                batch.set_stage(k, &input).unwrap();
            }
            batch.set_end_node(&q, &rate).unwrap();
            batch.iterate(2);
            let mut output = TransitionSlice {
                values: &mut values,
                stage_stride: 6 * n * n,
                row_stride: 3 * n,
                first_state: n,
            };
            batch.linearize(&mut output).unwrap();
            for k in 0..stages {
                batch.outcome(k).unwrap();
                batch.end_state_into(k, &mut end).unwrap();
                batch.set_deviation(k, &force, &q, &rate).unwrap();
            }
            batch.move_interior();
            batch.interior_node_into(0, &mut end[..n]).unwrap();
        });
        let bad = StageInput { nodes: [&q; 3], rate: &rate, force: &[f64::NAN; 3], time_step: 0.02 };
        none(&format!("{set:?}: bad stage"), || {
            batch.set_stage(1, &bad).unwrap();
            batch.iterate(1);
            assert!(batch.outcome(1).is_err());
        });
    }
}

#[test]
fn warm_stages_with_contacts_take_no_memory() {
    use delmpc_mechanics::contact_stage::{BoundaryState, Contact, ContactStage};
    let tree = quadruped(GRAVITY, Forces::Springs);
    let mut contacts: Vec<Contact> =
        (0..4).map(|leg| Contact::point(9 + leg, Vector3::new(0.0, 0.0, -0.25))).collect();
    contacts.push(Contact::foot(12, Vector3::new(0.0, 0.0, -0.25), Matrix3::identity()));
    let mut start = BoundaryState::zeros(&tree);
    start.q[4..8].fill(0.5);
    start.q[8..].fill(-1.0);
    start.rate = spread(12, 0.2);
    let u = spread(12, 0.3);
    for s in [1, 2, 3] {
        let rule = LobattoRule::new(s).unwrap();
        let mut stage = ContactStage::new(&tree, &rule, &contacts).unwrap();
        let (mut nominal, mut lifted) = (stage.nominal(), stage.lifted());
        let mut end = start.clone();
        let (x, force) = (spread(2 * tree.dof(), 1e-3), spread(stage.row_count(), 1.0));
        for active in [
            [true, true, true, true, false],
            [true, false, false, true, false],
            [false; 5],
            [true, false, false, false, true],
        ] {
            none(&format!("s = {s}, {active:?}"), || {
                stage.solve(&tree, 0.01, &active, &start, &u, &mut nominal, &mut end).unwrap();
                stage.linearize(&tree, 0.01, &active, &start, &nominal, &u, &end, &mut lifted).unwrap();
                nominal.advance(&lifted, &x, &u);
                nominal.interpolate(&rule, 0.02, &start, &end, &force);
                stage.linearize(&tree, 0.02, &active, &start, &nominal, &u, &end, &mut lifted).unwrap();
                end.retract(&x);
            });
        }
        none("refused stage", || {
            let both = [false, false, false, true, true];
            assert!(stage.solve(&tree, 0.01, &both, &start, &u, &mut nominal, &mut end).is_err());
        });
    }
}
