//! The contact law against the reference implementation's vectors.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod common;

use common::{GRAVITY, error_over, flat, model, read, relative_error, vector3};
use delmpc_mechanics::branch_lu::BranchLu;
use delmpc_mechanics::del_residual::ForceCapacity;
use delmpc_mechanics::load_response::{BoundaryMotion, LoadPoint, LoadResponse};
use delmpc_mechanics::newton_direction::NewtonDirection;
use delmpc_mechanics::prelude::*;
use delmpc_plant::contact_law::{ContactLaw, ContactProblem, Regularisation};
use delmpc_plant::contact_step::{ContactOptions, ContactPoint, ContactStep};
use delmpc_plant::terrain::Terrain;
use serde_json::Value;

const CASES: [&str; 4] =
    ["contact_box_rest", "contact_box_slide_spin", "contact_box_corner_impact", "contact_leg_stand"];

struct Case {
    json: Value,
    tree: KinematicTree,
    contacts: Vec<ContactPoint>,
    state: State,
    u: Vec<f64>,
    dt: f64,
}

impl Case {
    fn load(name: &str) -> Self {
        let json = read(&format!("{name}.json"));
        let tree = model(&json);
        let contacts = json["contacts"].as_array().unwrap().iter().map(|contact| ContactPoint {
            body: contact["body"].as_u64().unwrap() as usize - 1,
            point: vector3(&contact["point"]),
            radius: 0.0,
            friction: contact["mu"].as_f64().unwrap(),
        });
        let mut state = State::zeros(&tree);
        state.q = flat(&json["q0"]);
        state.p = flat(&json["p0"]);
        Self {
            contacts: contacts.collect(),
            u: flat(&json["u"]),
            dt: json["dt"].as_f64().unwrap(),
            tree,
            state,
            json,
        }
    }

    fn points(&self) -> Vec<LoadPoint> {
        let point = |c: &ContactPoint| LoadPoint {
            body: c.body,
            point_b: c.point - self.tree.bodies()[c.body].inertia.com,
        };
        self.contacts.iter().map(point).collect()
    }

    /// The solved step with the given impulses, its motion, and W of the contacts named.
    fn response(&self, impulses: &[f64], which: &[usize]) -> (State, BoundaryMotion, Vec<f64>) {
        let points = self.points();
        let capacity = ForceCapacity { points: points.len(), laws: false };
        let options = StepOptions { forces: capacity, ..StepOptions::default() };
        let rule = LobattoRule::new(self.json["s"].as_u64().unwrap() as usize).unwrap();
        let mut integrator = Integrator::new(&self.tree, &rule, self.dt, options).unwrap();
        let forces: Vec<PointForce> = points
            .iter()
            .zip(impulses.chunks_exact(3))
            .map(|(point, impulse)| PointForce {
                body: point.body,
                point_b: point.point_b,
                force_w: Vector3::from_column_slice(impulse) / self.dt,
            })
            .collect();
        let step = StepForces::held(&self.u).with_points(&forces);
        integrator.solve(&self.tree, &self.state, &step).unwrap();
        let next = integrator.next_state().clone();
        let mut motion = BoundaryMotion::new(&self.tree);
        motion.update(&self.tree, &next).unwrap();
        let del = integrator.del();
        let mut lu = BranchLu::new(&self.tree, del);
        lu.factor(&self.tree, del).unwrap();
        let mut response = LoadResponse::new(&self.tree, del, &lu, points.len());
        let loads: Vec<LoadPoint> = which.iter().map(|&i| points[i]).collect();
        response.solve(&self.tree, del, &mut lu, &loads).unwrap();
        let mut w = vec![0.0; 9 * which.len() * which.len()];
        response
            .velocity_response_into(&self.tree, &mut motion, rule.unknown_nodes(), &loads, &mut w)
            .unwrap();
        (next, motion, w)
    }

    fn velocities(&self, motion: &BoundaryMotion) -> Vec<f64> {
        let velocity = |p: &LoadPoint| {
            let v = motion.velocity_at_w(p.body, &motion.point_w(p));
            [v.x, v.y, v.z]
        };
        self.points().iter().flat_map(velocity).collect()
    }

    fn options(&self) -> ContactOptions {
        let number = |key: &str| self.json[key].as_f64().unwrap();
        ContactOptions {
            correction: number("beta"),
            regularisation: Regularisation { strength: number("rho_rel"), forgetting: number("eps") },
            tolerance: 1e-11,
            ..ContactOptions::default()
        }
    }

    fn stepped(&self) -> (ContactStep, delmpc_plant::contact_step::ContactReport, State) {
        let mut contact =
            ContactStep::new(&self.tree, self.dt, &self.contacts, Terrain::plane(0.0), self.options())
                .unwrap();
        let last: Vec<Vector3<f64>> =
            flat(&self.json["lambda_prev"]).chunks_exact(3).map(Vector3::from_column_slice).collect();
        contact.set_last_impulses(&last).unwrap();
        let mut state = self.state.clone();
        let report = contact.step(&self.tree, &mut state, &self.u, &[]).unwrap();
        (contact, report, state)
    }
}

#[test]
fn the_response_matrix_and_the_free_step_are_those_of_the_vectors() {
    for name in CASES {
        let case = Case::load(name);
        let all: Vec<usize> = (0..case.contacts.len()).collect();
        let (next, motion, w) = case.response(&vec![0.0; 3 * all.len()], &all);
        let free = &case.json["free"];
        let state_error = relative_error(&next.p, &flat(&free["p1"]));
        let velocity_error = relative_error(&case.velocities(&motion), &flat(&free["y"]));
        let w_error = relative_error(&w, &flat(&free["W"]));
        let impulses = flat(&case.json["solution"]["impulse"]);
        let which: Vec<usize> =
            flat(&case.json["solution"]["candidates"]).iter().map(|&i| i as usize - 1).collect();
        let (_, _, w) = case.response(&impulses, &which);
        let loaded = relative_error(&w, &flat(&case.json["solution"]["W"]));
        println!(
            "{name}: p {state_error:.1e}, y {velocity_error:.1e}, W {w_error:.1e}, loaded W {loaded:.1e}"
        );
        assert!(state_error < 1e-10 && velocity_error < 1e-10, "{name}");
        assert!(w_error < 1e-9 && loaded < 1e-9, "{name}");
    }
}

#[test]
fn the_step_with_contacts_is_that_of_the_vectors() {
    for name in CASES {
        let case = Case::load(name);
        let (contact, report, state) = case.stepped();
        let solution = &case.json["solution"];
        let candidates: Vec<f64> = contact.candidates().map(|i| i as f64 + 1.0).collect();
        assert_eq!(candidates, flat(&solution["candidates"]), "{name}");
        let start = &case.json["start"];
        let gaps: Vec<f64> = contact.results().iter().map(|r| r.gap).collect();
        let gap_error = relative_error(&gaps, &flat(&start["phi"]));
        let qbar = flat(&solution["qbar"]);
        let q_error = relative_error(&state.q, &qbar[qbar.len() - state.q.len()..]);
        // A state at rest has momenta of round-off size: what a step's gravity moves is the floor.
        let fall = GRAVITY * case.dt;
        let p_error = error_over(&state.p, &flat(&solution["p1"]), case.tree.total_mass() * fall);
        let rate_error = error_over(contact.end_motion().velocity(), &flat(&solution["qd1"]), fall);
        let impulses: Vec<f64> =
            contact.results().iter().flat_map(|r| [r.impulse_w.x, r.impulse_w.y, r.impulse_w.z]).collect();
        let impulse_error = relative_error(&impulses, &flat(&solution["impulse"]));
        let all: Vec<usize> = (0..case.contacts.len()).collect();
        let wrench = contact.wrench_w(&all);
        let force_error = relative_error(wrench.force.as_slice(), &flat(&case.json["wrench"]["force"]));
        let moment_error =
            relative_error(wrench.torque.as_slice(), &flat(&case.json["wrench"]["moment_about_origin"]));
        println!(
            "{name}: gap {gap_error:.1e} q {q_error:.1e} p {p_error:.1e} qd {rate_error:.1e} λ {impulse_error:.1e} \
             force {force_error:.1e} moment {moment_error:.1e}; {report:?}"
        );
        assert!(report.converged, "{name}");
        assert!(gap_error < 1e-10 && q_error < 1e-8 && p_error < 1e-8 && rate_error < 1e-8, "{name}");
        assert!(impulse_error < 1e-5, "{name}");
        assert!(force_error < 1e-8 && moment_error < 1e-8, "{name}");
    }
}

#[test]
fn the_published_impulses_satisfy_the_law() {
    for name in CASES {
        let case = Case::load(name);
        let solution = &case.json["solution"];
        let which: Vec<usize> = flat(&solution["candidates"]).iter().map(|&i| i as usize - 1).collect();
        let pick = |values: Vec<f64>| -> Vec<f64> {
            which.iter().flat_map(|&i| values[3 * i..3 * i + 3].to_vec()).collect()
        };
        let w = flat(&solution["W"]);
        let n = 3 * which.len();
        let symmetric: Vec<f64> = (0..n * n).map(|k| 0.5 * (w[k] + w[(k % n) * n + k / n])).collect();
        let friction: Vec<f64> = which.iter().map(|&i| case.contacts[i].friction).collect();
        let regularisation = case.options().regularisation;
        let mut law = ContactLaw::new(which.len(), regularisation).unwrap();
        let (impulse, last) = (pick(flat(&solution["impulse"])), pick(flat(&case.json["lambda_prev"])));
        let b = flat(&solution["b"]);
        let problem = ContactProblem {
            response: &symmetric,
            free_velocity: &b,
            friction: &friction,
            last_impulse: &last,
        };
        let residual = law.residual(&problem, &impulse);
        let mut found = vec![0.0; n];
        let report = law.solve(&problem, &mut found);
        let error = relative_error(&found, &impulse);
        println!("{name}: residual of the vector {residual:.1e}; solved {error:.1e} by {report:?}");
        assert!(residual < 1e-11, "{name}");
        assert!(report.converged && error < 1e-5, "{name}");
    }
}
