//! `NAME.plan.html`: a plan to look at, in one file that needs nothing else: animation, contact bars, forces, clearance.

use delmpc_mechanics::kinematics::{Configuration, Kinematics};
use delmpc_planner::check::{Bounds, Findings, terrain_of};
use delmpc_planner::execution::Execution;
use delmpc_planner::outline::leg_outline;
use delmpc_planner::plan_file::Plan;
use delmpc_planner::robot::PlanRobot;
use delmpc_planner::stage::{WEIGHTS, polynomial};
use nalgebra::Vector3;
use serde_json::{Value, json};

use crate::verdict::Failure;

const PAGE: &str = include_str!("report/template/plan.html");
const STYLE: &str = include_str!("report/template/style.css");
const SCRIPT: &str = include_str!("report/template/plan.js");

/// Pictures per stage.
const FRAMES_PER_STAGE: usize = 6;

/// The page of a plan.
///
/// # Errors
/// When the mechanics refuse a posture or the data cannot be written as JSON.
pub fn page(
    plan: &Plan,
    robot: &PlanRobot,
    findings: &Findings,
    found: Option<&Execution>,
) -> Result<String, Failure> {
    let data = json!({
        "name": plan.name,
        "robot": plan.robot,
        "note": plan.note,
        "horizon_s": plan.horizon_s,
        "times": plan.t,
        "frames": frames(plan, robot)?,
        "links": links(robot),
        "terrain": terrain_of(plan),
        "names": plan.coordinates.iter().chain(&plan.contacts).collect::<Vec<_>>(),
        "contacts": plan.contacts,
        "forces": forces(plan),
        // Per contact and stage: `#` loaded, `+` touchdown at the end, `.` in the air.
        "loaded": plan.sets(),
        "actuated": plan.actuated,
        "torques": plan.u,
        "judged": judged(findings, found),
    });
    // A closing tag inside of a string would end the script element.
    let text = serde_json::to_string(&data).map_err(Failure::fault)?.replace("</", "<\\/");
    let name = plan.name.replace('&', "&amp;").replace('<', "&lt;");
    Ok(PAGE
        .replace("{{title}}", &name)
        .replace("{{style}}", STYLE)
        .replace("{{script}}", SCRIPT)
        .replace("{{data}}", &text))
}

/// Drawn segments as pairs of points: from a link to its parent, and from a link to its contact points and frames.
fn links(robot: &PlanRobot) -> Vec<[usize; 2]> {
    let n = robot.dof();
    let mut list = Vec::new();
    for (body, it) in robot.tree.bodies().iter().enumerate() {
        if let Some(parent) = it.parent.filter(|&parent| parent + 1 >= robot.base_coordinates) {
            list.push([parent, body]);
        }
    }
    for (i, contact) in robot.contacts.iter().enumerate() {
        list.push([contact.body, n + i]);
        // The sole between two contact points of one link.
        if let Some(j) = robot.contacts[..i].iter().position(|other| other.body == contact.body) {
            list.push([n + j, n + i]);
        }
    }
    list
}

/// Per frame: time, x and z of every link's origin and of every contact point, height of the lowest point of the legs.
fn frames(plan: &Plan, robot: &PlanRobot) -> Result<Vec<Value>, Failure> {
    let outline = leg_outline(robot, 9, 9).map_err(Failure::fault)?;
    let mut kinematics = Kinematics::new(&robot.tree);
    let mut list = Vec::new();
    for k in 0..plan.stages {
        let last = usize::from(k + 1 == plan.stages);
        for step in 0..FRAMES_PER_STAGE + last {
            let c = step as f64 / FRAMES_PER_STAGE as f64;
            let w = polynomial(c);
            let q: Vec<f64> = (0..robot.dof())
                .map(|j| w[0] * plan.q[k][j] + w[1] * plan.q_mid[k][j] + w[2] * plan.q[k + 1][j])
                .collect();
            kinematics.update_positions(&robot.tree, &Configuration::fixed(&q)).map_err(Failure::fault)?;
            let origins = (0..robot.dof()).map(|body| kinematics.point_w(body, &Vector3::zeros()));
            let contacts = robot.contacts.iter().map(|p| kinematics.point_w(p.body, &Vector3::from(p.point)));
            let points: Vec<[f64; 2]> = origins.chain(contacts).map(|p| [p.x, p.z]).collect();
            let terrain = terrain_of(plan);
            let clearance = outline
                .iter()
                .map(|point| {
                    let x = kinematics.point_w(point.body, &Vector3::from(point.point));
                    let z = x.z - point.radius;
                    (z - terrain.height(x.x).value).min(terrain.distance_to_boxes(x.x, z))
                })
                .fold(f64::INFINITY, f64::min);
            let time = plan.t[k] + c * (plan.t[k + 1] - plan.t[k]);
            let clearance = clearance.is_finite().then_some(clearance);
            list.push(json!({"t": time, "p": points, "clearance": clearance}));
        }
    }
    Ok(list)
}

/// Per contact and stage: mean normal force, mean friction force, N, and the impulse at the end beyond the mean load, N s.
fn forces(plan: &Plan) -> Vec<Vec<[f64; 3]>> {
    let of = |k: usize, i: usize| {
        let dt = plan.t[k + 1] - plan.t[k];
        let nodes = &plan.impulse[k][i];
        let normal = |node: usize| nodes[node].last().copied().unwrap_or(0.0);
        let across: f64 = nodes.iter().map(|node| node.first().copied().unwrap_or(0.0)).sum();
        let standing = normal(0) + normal(1);
        let load = standing / (WEIGHTS[0] + WEIGHTS[1]);
        let impact = (normal(2) - WEIGHTS[2] * load).max(0.0);
        [load / dt, across / dt, impact]
    };
    (0..plan.contacts.len()).map(|i| (0..plan.stages).map(|k| of(k, i)).collect()).collect()
}

/// Figures of the check and of the fine integration.
fn judged(findings: &Findings, found: Option<&Execution>) -> Vec<Value> {
    let mut list: Vec<Value> = findings
        .judged(&Bounds::default())
        .iter()
        .map(|(name, value, bound, unit, holds)| {
            json!({"name": name, "value": value, "bound": bound, "unit": unit, "holds": holds})
        })
        .collect();
    let mut plain = |name: &str, value: f64, unit: &str| {
        list.push(json!({"name": name, "value": value, "unit": unit}));
    };
    plain("mean speed", findings.mean_speed_m_s, "m/s");
    plain("longest flight", findings.longest_flight_s, "s");
    plain("longest stage", findings.longest_stage_s, "s");
    if let Some(clearance) = findings.clearance_m {
        plain("clearance to the box", clearance, "m");
    }
    if let Some(edge) = findings.edge_m {
        plain("footholds to edges", edge, "m");
    }
    if let Some(found) = found {
        plain("fine integration, position", found.position, "rad");
        plain("fine integration, rate", found.rate, "rad/s");
        plain("touchdown", found.touchdown_m_s, "m/s");
    }
    list
}
