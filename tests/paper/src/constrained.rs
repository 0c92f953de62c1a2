//! A constrained pendulum: order of the errors with the tip pinned (three rows), in angles and momenta.
//!
//! Six rods with joint axes that alternate between y and x, tip held where it starts. Equation (6) of the paper with the momentum
//! projection it lacks (`delmpc_mechanics::constraints`). Reference: `s = 4` at short steps.

use std::f64::consts::PI;

use delmpc_mechanics::constraints::{ConstrainedIntegrator, Constraint, ConstraintKind};
use delmpc_mechanics::kinematics::{Configuration, Kinematics};
use delmpc_mechanics::prelude::*;
use serde_json::json;

use crate::pendulum::{Uniform, initial_conditions};
use crate::plot::{Figure, Legend, Line, Panel, Scale, Style};
use crate::results::{Claim, Part, Table, number};
use crate::stopwatch::exponent;
use crate::trajectory::distance;
use crate::{Campaign, Failure};

const LINKS: usize = 6;
/// s.
const DURATION: f64 = 0.64;
const REFERENCE_NODES: usize = 4;
/// Highest order of the table.
const NODES: [usize; 3] = [1, 2, 3];

fn chain() -> Result<KinematicTree, ModelError> {
    let link = LinkInertia::new(
        1.0,
        Vector3::new(0.0, 0.0, -0.5),
        Matrix3::from_diagonal(&Vector3::new(1.0 / 12.0, 1.0 / 12.0, 0.02)),
    );
    let mut builder = TreeBuilder::fixed_base(Vector3::new(0.0, 0.0, -9.81));
    let mut parent = None;
    for i in 0..LINKS {
        let height = if i == 0 { 0.0 } else { -1.0 };
        let axis = if i % 2 == 0 { Vector3::y() } else { Vector3::x() };
        let placement = RigidTransform::from_translation(Vector3::new(0.0, 0.0, height));
        parent = Some(builder.add(Body::new(parent, Joint::revolute(axis, placement), link)));
    }
    builder.build()
}

struct Pinned {
    tree: KinematicTree,
    constraint: Constraint,
    start: State,
}

impl Pinned {
    fn new(seed: u64) -> Result<Self, Failure> {
        let tree = chain()?;
        let initial = &initial_conditions(LINKS, 1, PI / 6.0, seed)[0];
        let mut kinematics = Kinematics::new(&tree);
        kinematics.update_positions(&tree, &Configuration::fixed(&initial.q))?;
        let point = Vector3::new(0.0, 0.0, -1.0);
        let target_w = kinematics.point_w(LINKS - 1, &point);
        let constraint = Constraint::new(ConstraintKind::Point { body: LINKS - 1, point, target_w });
        let mut start = State::zeros(&tree);
        start.q.copy_from_slice(&initial.q);
        let rates = Uniform::new(seed + 1).vector(LINKS, 1.0);
        let mut pinned = Self { tree, constraint, start };
        let mut integrator = pinned.integrator(1, 0.01)?;
        integrator.velocities().set_velocity(&pinned.tree, &mut pinned.start, &rates)?;
        integrator.project(&pinned.tree, &mut pinned.start)?;
        Ok(pinned)
    }

    fn integrator(&self, s: usize, time_step: f64) -> Result<ConstrainedIntegrator, ModelError> {
        let rule = LobattoRule::new(s)?;
        let constraints = [self.constraint];
        ConstrainedIntegrator::new(&self.tree, &constraints, &rule, time_step, None, Default::default())
    }

    fn end(&self, s: usize, steps: usize) -> Result<State, Failure> {
        let mut integrator = self.integrator(s, DURATION / steps as f64)?;
        let mut state = self.start.clone();
        for _ in 0..steps {
            integrator.step(&self.tree, &mut state, &StepForces::held(&[0.0; LINKS]))?;
        }
        Ok(state)
    }
}

/// Cells of the campaign.
pub const CELLS: usize = 1;

/// Runs it.
///
/// # Errors
/// A step that fails; a picture that cannot be drawn.
pub fn run(campaign: &Campaign) -> Result<Part, Failure> {
    campaign.say("constrained");
    let pinned = Pinned::new(campaign.seed)?;
    let reference = pinned.end(REFERENCE_NODES, 512)?;
    let mut part = Part { key: "constrained", ..Part::default() };
    let mut table = Table::new(&["unknown_nodes", "time_step_s", "error_q_rad", "error_p"]);
    let mut lines = [Vec::new(), Vec::new()];
    let mut orders = Vec::new();
    for s in NODES {
        let (mut by_q, mut by_p) = (Vec::new(), Vec::new());
        for steps in [16, 32, 64, 128] {
            let end = pinned.end(s, steps)?;
            let step = DURATION / steps as f64;
            let error = (distance(&end.q, &reference.q), distance(&end.p, &reference.p));
            table.push(vec![s.to_string(), number(step), number(error.0), number(error.1)]);
            by_q.push((step, error.0));
            by_p.push((step, error.1));
        }
        // The two shortest steps that are above round-off.
        let order = |points: &[(f64, f64)]| {
            let clean: Vec<(f64, f64)> = points.iter().copied().filter(|p| p.1 > 1e-11).collect();
            exponent(&clean[clean.len().saturating_sub(2)..])
        };
        let measured = (order(&by_q), order(&by_p));
        orders.push(json!({ "s": s, "order_q": measured.0, "order_p": measured.1 }));
        if s <= 2 {
            let bar = 2.0 * s as f64 - 0.2;
            part.claims.push(Claim::at_least(format!("tip pinned, s = {s}: order in q"), measured.0, bar));
            part.claims.push(Claim::at_least(format!("tip pinned, s = {s}: order in p"), measured.1, bar));
        }
        for (points, list) in [(&by_q, 0), (&by_p, 1)] {
            lines[list].push(Line {
                title: format!("s = {s}, order {:.2}", if list == 0 { measured.0 } else { measured.1 }),
                style: Style::Mark,
                colour: [5, 0, 2][s - 1],
                points: points.iter().map(|(x, y)| (x * 1e3, *y)).collect(),
            });
        }
    }
    part.facts = json!({ "links": LINKS, "rows": 3, "duration_s": DURATION, "orders": orders });
    part.files.push(("constrained.csv".into(), table.csv()));
    let [q, p] = lines;
    let panel = |title: &str, y_label: &str, lines: Vec<Line>| Panel {
        title: title.into(),
        x_label: "time step (ms)".into(),
        y_label: y_label.into(),
        x: Scale::Log,
        y: Scale::Log,
        x_range: None,
        y_range: None,
        lines,
        legend: Legend::Corner,
    };
    let figure = Figure {
        columns: 2,
        panels: vec![
            panel("Tip pinned: angles", "error (rad)", q),
            panel("Tip pinned: momenta", "error (kg m²/s)", p),
        ],
    };
    campaign.draw("constrained", &figure)?;
    campaign.tick(1.0);
    Ok(part)
}
