//! The stage with contacts against the oracle vectors: boundary rows, solved step, `A`, `B`, forces, and the lifted stage.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod contact_robots;
mod oracle;
mod sample_robots;

use contact_robots::canonical;
use delmpc_mechanics::contact_stage::{
    BoundaryKinematics, BoundaryState, Contact, ContactKind, ContactProjection, ContactStage, LiftedStage,
    StageNominal,
};
use delmpc_mechanics::prelude::*;
use nalgebra::DMatrix;
use oracle::{assert_close, cases, flat, matrix3, model, vector3};
use serde_json::Value;

fn numbers(value: &Value) -> Vec<usize> {
    value.as_array().unwrap().iter().map(|r| r.as_u64().unwrap() as usize).collect()
}

fn contact(spec: &Value) -> Contact {
    let body = spec["body"].as_u64().unwrap() as usize - 1;
    let point = vector3(&spec["point"]);
    let contact = match spec["kind"].as_str().unwrap() {
        "point" => Contact::point(body, point),
        _ => Contact::foot(body, point, matrix3(&spec["sole"])),
    };
    contact.on(matrix3(&spec["axes"])).rows(&numbers(&spec["rows"]))
}

struct Case {
    name: String,
    json: Value,
    tree: KinematicTree,
    contacts: Vec<Contact>,
    active: Vec<bool>,
    dt: f64,
    u: Vec<f64>,
    start: BoundaryState,
    stage: ContactStage,
    /// Coordinates to compare: all, or those of the plane.
    keep: Vec<usize>,
}

fn boundary(value: &Value, suffix: &str) -> BoundaryState {
    let at = |key: &str| &value[format!("{key}{suffix}")];
    BoundaryState {
        orientation: matrix3(at("R")),
        position_w: vector3(at("p")),
        q: flat(at("q")),
        base_velocity_b: Vector6::from_row_slice(&flat(at("V_body"))),
        rate: flat(at("qd")),
    }
}

fn contact_cases() -> Vec<Case> {
    cases(|n| n.contains("_contact_s")).into_iter().map(|(name, json)| case(name, json)).collect()
}

fn case(name: String, json: Value) -> Case {
    let tree = model(&json);
    let contacts: Vec<Contact> = json["contacts"].as_array().unwrap().iter().map(contact).collect();
    let chosen = numbers(&json["active"]);
    let active = (0..contacts.len()).map(|c| chosen.contains(&c)).collect();
    let rule = LobattoRule::new(json["s"].as_u64().unwrap() as usize).unwrap();
    let stage = ContactStage::new(&tree, &rule, &contacts).unwrap();
    let nv = tree.dof();
    let planar = name.contains("planar");
    let keep = (0..2 * nv).filter(|k| !planar || ![0, 2, 4].contains(&(k % nv))).collect();
    Case {
        start: boundary(&json["state0"], ""),
        dt: json["dt"].as_f64().unwrap(),
        u: flat(&json["u"]),
        name,
        json,
        tree,
        contacts,
        active,
        stage,
        keep,
    }
}

impl Case {
    /// Entries of a matrix in the rows `rows` and the columns kept (with a constant column first and inputs behind).
    fn pick(&self, matrix: &[f64], columns: usize, rows: &[usize], first: usize) -> Vec<f64> {
        let states = 2 * self.tree.dof();
        let mut out = Vec::new();
        for &r in rows {
            for c in 0..columns {
                let state = c.wrapping_sub(first);
                if state >= states || self.keep.contains(&state) {
                    out.push(matrix[r * columns + c]);
                }
            }
        }
        out
    }

    fn compare(&self, what: &str, got: &[f64], want: &Value, columns: usize, rows: &[usize], tolerance: f64) {
        let first = usize::from(columns == 1 + 2 * self.tree.dof() + self.tree.joint_count());
        let (got, want) =
            (self.pick(got, columns, rows, first), self.pick(&flat(want), columns, rows, first));
        assert_close(&format!("{} {what}", self.name), &got, &want, tolerance);
    }

    fn all(&self, rows: usize) -> Vec<usize> {
        (0..rows).collect()
    }

    fn nominal(&self, value: &Value) -> StageNominal {
        let mut nominal = self.stage.nominal();
        nominal.xi = flat(&value["xi"]);
        nominal.q = flat(&value["q"])[self.tree.joint_count()..].to_vec();
        let rows = numbers(&self.json["rows"]);
        for (alpha, values) in value["lam_nodes"].as_array().unwrap().iter().enumerate() {
            for (&row, value) in rows.iter().zip(flat(values)) {
                nominal.multipliers[alpha * self.stage.row_count() + row] = value;
            }
        }
        nominal
    }

    fn linearize(&mut self, nominal: &StageNominal, end: &BoundaryState) -> LiftedStage {
        let mut lifted = self.stage.lifted();
        let Self { stage, tree, dt, active, start, u, .. } = self;
        stage.linearize(tree, *dt, active, start, nominal, u, end, &mut lifted).unwrap();
        lifted
    }
}

fn a(lifted: &LiftedStage) -> Vec<f64> {
    let n = 2 * lifted.dof();
    (0..n * n).map(|k| lifted.a(k / n, k % n)).collect()
}

fn b(lifted: &LiftedStage) -> Vec<f64> {
    let (n, m) = (2 * lifted.dof(), lifted.inputs());
    (0..n * m).map(|k| lifted.b(k / m, k % m)).collect()
}

#[test]
fn boundary_rows_match_the_vectors() {
    for case in contact_cases() {
        let (tree, nv) = (&case.tree, case.tree.dof());
        let mut boundary = BoundaryKinematics::new(tree).unwrap();
        boundary.update(tree, &case.start).unwrap();
        let want = &case.json["contact0"];
        let (mut y, mut g, mut gradient) = (Vec::new(), Vec::new(), Vec::new());
        let (mut x, mut sole) = (Vec::new(), Vec::new());
        for contact in &case.contacts {
            let m = contact.row_count();
            let (mut yc, mut gc) = (vec![0.0; m], vec![0.0; m * nv]);
            boundary.contact_rows_into(tree, contact, &mut yc, &mut gc).unwrap();
            let mut dc = vec![0.0; m * nv];
            boundary.contact_velocity_gradient_into(tree, contact, &mut dc).unwrap();
            y.extend(yc);
            g.extend(gc);
            gradient.extend(dc);
            let placement = boundary.placement(tree, contact);
            x.extend_from_slice(placement.point_w.as_slice());
            sole.extend_from_slice(placement.sole_w.transpose().as_slice());
        }
        let name = &case.name;
        assert_close(&format!("{name} x"), &x, &flat(&want["x"]), 1e-12);
        if case.contacts.iter().all(|c| c.kind == ContactKind::Foot) {
            assert_close(&format!("{name} sole"), &sole, &flat(&want["sole"]), 1e-12);
        }
        let scale = flat(&want["G"]).iter().fold(0.0f64, |a, b| a.max(b.abs()));
        let worst = y.iter().zip(flat(&want["y"])).fold(0.0f64, |m, (a, b)| m.max((a - b).abs()));
        assert!(worst <= 1e-12 * scale, "{name} y: {worst:e}");
        assert_close(&format!("{name} G"), &g, &flat(&want["G"]), 1e-12);
        assert_close(&format!("{name} dy"), &gradient, &flat(&want["dy_dconf"]), 1e-12);
        assert_close(&format!("{name} M"), boundary.mass_matrix(), &flat(&want["M_body"]), 1e-12);
        let mut state = State::zeros(tree);
        boundary.state_into(&mut state).unwrap();
        let mut momenta = flat(&case.json["state0"]["P"]);
        momenta.extend(flat(&case.json["state0"]["pj"]));
        assert_close(&format!("{name} momenta"), &state.p, &momenta, 1e-12);

        let mut projection = ContactProjection::new(tree, &case.contacts);
        projection.factor(tree, &boundary, &case.contacts, &case.active, 0.0).unwrap();
        let mut velocity = boundary.velocity().to_vec();
        let impulse = projection.project(&mut velocity).unwrap().to_vec();
        let want = &case.json["impact0"];
        let scale = flat(&want["impulse"]).iter().fold(1e-3f64, |a, b| a.max(b.abs()));
        let worst = impulse.iter().zip(flat(&want["impulse"])).fold(0.0f64, |m, (a, b)| m.max((a - b).abs()));
        assert!(worst <= 1e-11 * scale, "{name} impulse: {worst:e}");
        let mut after = flat(&want["V_body"]);
        after.extend(flat(&want["qd"]));
        assert_close(&format!("{name} impact"), &velocity, &after, 1e-11);
    }
}

#[test]
fn solved_stages_match_the_vectors() {
    for mut case in contact_cases() {
        let want = case.json["step_C"].clone();
        let (mut nominal, mut end) = (case.stage.nominal(), case.start.clone());
        let Case { stage, tree, dt, active, start, u, .. } = &mut case;
        stage.solve(tree, *dt, active, start, u, &mut nominal, &mut end).unwrap();
        let exact = case.nominal(&want);
        let name = case.name.clone();
        assert_close(&format!("{name} xi"), &nominal.xi, &exact.xi, 1e-11);
        assert_close(&format!("{name} q"), &nominal.q, &exact.q, 1e-11);
        assert_close(&format!("{name} λ"), &nominal.multipliers, &exact.multipliers, 1e-11);
        let target = boundary(&want, "1");
        assert_close(&format!("{name} R1"), end.orientation.as_slice(), target.orientation.as_slice(), 1e-11);
        assert_close(&format!("{name} p1"), end.position_w.as_slice(), target.position_w.as_slice(), 1e-11);
        assert_close(&format!("{name} q1"), &end.q, &target.q, 1e-11);
        let velocity =
            |s: &BoundaryState| s.base_velocity_b.iter().chain(&s.rate).copied().collect::<Vec<f64>>();
        assert_close(&format!("{name} v1"), &velocity(&end), &velocity(&target), 1e-11);

        let lifted = case.linearize(&nominal, &end);
        let nv = case.tree.dof();
        let (n, nu, m) = (2 * nv, case.tree.joint_count(), lifted.row_count());
        case.compare("A", &a(&lifted), &want["A"], n, &case.keep, 1e-9);
        case.compare("B", &b(&lifted), &want["B"], nu, &case.keep, 1e-9);
        let forces: Vec<f64> = (0..m).flat_map(|r| lifted.force_row(r).to_vec()).collect();
        let columns = lifted.columns();
        let part = |first: usize, count: usize| -> Vec<f64> {
            (0..m * count).map(|k| forces[k / count * columns + first + k % count]).collect()
        };
        assert_close(&format!("{name} f"), &part(0, 1), &flat(&want["mean_force"]), 1e-9);
        case.compare("force_x", &part(1, n), &want["force_x"], n, &case.all(m), 1e-9);
        assert_close(&format!("{name} force_u"), &part(1 + n, nu), &flat(&want["force_u"]), 1e-9);
        let d = (0..n).fold(0.0f64, |a, r| a.max(lifted.d(r).abs()));
        assert!(d < 1e-11, "{name} d {d:e}");
        let map = |state: &BoundaryState| canonical(&case.tree, state);
        let to_velocities = map(&case.start).lu().try_inverse().unwrap();
        let [a, b] = [(a(&lifted), n), (b(&lifted), nu)]
            .map(|(values, columns)| map(&end) * DMatrix::from_row_slice(n, columns, &values));
        let a = (a * to_velocities).transpose();
        case.compare("A canonical", a.as_slice(), &want["A_canonical"], n, &case.keep, 1e-9);
        case.compare("B canonical", b.transpose().as_slice(), &want["B_canonical"], nu, &case.keep, 1e-9);
    }
}

#[test]
fn unsolved_stages_match_the_vectors() {
    for mut case in contact_cases() {
        let want = case.json["lifted"].clone();
        let nominal = case.nominal(&want);
        let end = boundary(&want["end"], "");
        let lifted = case.linearize(&nominal, &end);
        let nv = case.tree.dof();
        let (m, s) = (lifted.row_count(), lifted.unknown_nodes());
        let name = &case.name;
        let residual: Vec<f64> = (0..s * nv).map(|k| case.stage.residual()[k % nv * s + k / nv]).collect();
        assert_close(&format!("{name} residual"), &residual, &flat(&want["residual"]), 1e-12);
        let mut h = vec![0.0; s * m];
        for (gamma, h) in h.chunks_exact_mut(m).enumerate() {
            case.stage.leaf_defect_into(gamma + 1, h).unwrap();
        }
        assert_close(&format!("{name} h"), &h, &flat(&want["h"]), 1e-12);
        let want = &want["C"];
        let (n, nu) = (2 * nv, case.tree.joint_count());
        let columns = lifted.columns();
        case.compare("A", &a(&lifted), &want["A"], n, &case.keep, 1e-9);
        case.compare("B", &b(&lifted), &want["B"], nu, &case.keep, 1e-9);
        let d: Vec<f64> = (0..n).map(|r| lifted.d(r)).collect();
        case.compare("d", &d, &want["d"], 1, &case.keep, 1e-9);
        let forces: Vec<f64> = (0..m).flat_map(|r| lifted.force_row(r).to_vec()).collect();
        case.compare("force", &forces, &want["force"], columns, &case.all(m), 1e-9);
        let multipliers: Vec<f64> =
            (0..(s + 1) * m).flat_map(|r| lifted.multiplier_row(r / m, r % m).to_vec()).collect();
        case.compare("λ map", &multipliers, &want["lam"], columns, &case.all((s + 1) * m), 1e-9);
        let nodes: Vec<f64> = (0..s * nv).flat_map(|r| lifted.node_row(r).to_vec()).collect();
        let kept: Vec<usize> = (0..s * nv).filter(|r| case.keep.contains(&(r % nv))).collect();
        case.compare("node map", &nodes, &want["nodes"], columns, &kept, 1e-9);
    }
}
