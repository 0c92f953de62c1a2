//! The robot of a setup as a board has it: constants, configuration and watchdog, as values and as Rust source.
//!
//! `delmpc model ROBOT.urdf --emit rust` writes the source; `delmpc controller --board` makes the same controller on this side and holds
//! every answer of the board against it.

use std::fmt::{Debug, Write as _};

use delmpc_controller_core::config::ControllerConfig;
use delmpc_controller_core::control_task::ControlTask;
use delmpc_controller_core::prelude::JointLimits;
use delmpc_controller_core::tables::{BodyTable, PointTable, PoseTable, RobotTable, SoleTable, StanceTable};
use delmpc_estimation::prelude::EstimatorConfig;
use delmpc_mechanics::tree::Body;
use delmpc_plant::prelude::WatchdogConfig;

use crate::robot_controller::{config, estimator_config, joint_limits};
use crate::setup::Setup;
use crate::simulated_robot::watchdog;
use crate::verdict::Failure;

/// Rows the dual of a board's QP has room for: its memory grows with the square. A plan that needs more leaves out the latest.
pub const BOARD_QP_ROWS: usize = 32;

/// A robot's constants, owned.
#[derive(Debug, Clone)]
pub struct BoardRobot {
    name: String,
    joint_names: Vec<String>,
    joint_set_hash: u64,
    gravity_w: [f64; 3],
    bodies: Vec<BodyTable>,
    limits: Vec<JointLimits>,
    posture: Vec<f64>,
    soles: Vec<(String, usize, PoseTable, Vec<[f64; 2]>)>,
    stance: usize,
    imu: (usize, PoseTable),
    sensors: EstimatorConfig,
    hand: Option<PointTable>,
    swing_foot: Option<PointTable>,
    config: ControllerConfig,
    watchdog: WatchdogConfig,
}

impl BoardRobot {
    /// For a setup with a robot on one foot.
    ///
    /// # Errors
    /// [`Failure::Input`] for a robot on several feet, or one that a table cannot say.
    pub fn new(setup: &Setup) -> Result<Self, Failure> {
        let (robot, scenario) = (&setup.robot, &setup.scenario);
        let refused = |what: &str| Failure::Input(format!("{}: {what}", setup.urdf.display()));
        if setup.is_legged() {
            return Err(refused(
                "a board's controller is that of a robot on one foot: name one sole as its stance",
            ));
        }
        let bodies = robot.tree.bodies();
        let plain = |body: &Body| Body::new(body.parent, body.joint, body.inertia) == *body;
        if !bodies.iter().all(plain) || robot.tree.accepts_unreal_inertia() {
            return Err(refused(
                "drag, constant wrenches and impossible inertias have no place in a board's table",
            ));
        }
        let posture = robot
            .posture(&scenario.robot.posture)
            .ok_or_else(|| refused("the posture is missing: name one in the companion table"))?;
        let point = |frame: &str| {
            let frame = robot.frame(frame)?;
            Some(PointTable { body: frame.body?, position: frame.pose.translation.into() })
        };
        let soles = robot.soles.iter().map(|sole| {
            let frame = robot.frame(&sole.frame).filter(|frame| frame.body.is_some());
            let frame = frame.ok_or_else(|| refused("a sole is on no link"))?;
            let polygon = sole.polygon.iter().map(|corner| (*corner).into()).collect();
            Ok((sole.name.clone(), frame.body.unwrap_or(0), PoseTable::of(&frame.pose), polygon))
        });
        let stance_name = scenario.robot.stance.first();
        let other = robot.soles.iter().find(|sole| sole.name != stance_name);
        let (imu_body, imu_mounting) = setup.inertial_unit().map_err(|error| refused(&error))?;
        let mut config = config(setup);
        config.qp.capacity = config.qp.capacity.min(BOARD_QP_ROWS);
        Ok(Self {
            name: robot.name.clone(),
            joint_names: robot.joint_names.clone(),
            joint_set_hash: setup.joint_set_hash(),
            gravity_w: (*robot.tree.gravity_w()).into(),
            bodies: bodies.iter().map(BodyTable::of).collect(),
            limits: joint_limits(robot),
            posture: posture.q.clone(),
            soles: soles.collect::<Result<_, Failure>>()?,
            stance: setup.stance_foot(),
            imu: (imu_body, PoseTable::of(&imu_mounting)),
            sensors: estimator_config(scenario),
            hand: scenario.reach.as_ref().and_then(|reach| point(&reach.hand)),
            swing_foot: other.and_then(|sole| point(&sole.frame)),
            config,
            watchdog: watchdog(setup)?,
        })
    }

    /// The controller and servo of a board.
    ///
    /// # Errors
    /// [`Failure::Input`] when the robot cannot be controlled like that.
    pub fn task(&self) -> Result<ControlTask, Failure> {
        let refused = |error: &dyn std::fmt::Display| Failure::Input(format!("{}: {error}", self.name));
        let soles: Vec<SoleTable<'_>> = self
            .soles
            .iter()
            .map(|(_, body, frame, polygon)| SoleTable { body: *body, frame: *frame, polygon })
            .collect();
        let table = RobotTable {
            joint_set_hash: self.joint_set_hash,
            gravity_w: self.gravity_w,
            bodies: &self.bodies,
            limits: &self.limits,
            posture: &self.posture,
            stance: Some(StanceTable {
                soles: &soles,
                stance: self.stance,
                imu_body: self.imu.0,
                imu_mounting: self.imu.1,
                sensors: self.sensors,
            }),
            hand: self.hand,
            swing_foot: self.swing_foot,
        };
        let model = table.model().map_err(|error| refused(&error))?;
        ControlTask::with_active_set(model, self.config.clone(), self.watchdog.clone())
            .map_err(|error| refused(&error))
    }

    /// The same as Rust source for a `no_std` build.
    pub fn rust(&self) -> String {
        let joints = self.joint_names.len();
        let mut text = String::new();
        let mut put = |line: &str| {
            text.push_str(line);
            text.push('\n');
        };
        put(&format!(
            "//! {}: {joints} joints. Written by `delmpc model --emit rust`; change the URDF or the scenario, not this.\n//!\n\
             //! SI units; joints and bodies in the order of the messages, body 0 is the floating base.",
            self.name
        ));
        put("#![allow(clippy::all, dead_code, unused_imports)]\n#![cfg_attr(rustfmt, rustfmt_skip)]\n");
        put(
            "use delmpc_controller_core::config::{ConstraintConfig, ControllerConfig, ControllerKind, StageBlock};",
        );
        put("use delmpc_controller_core::fallback::FallbackConfig;");
        put("use delmpc_controller_core::prelude::{JointLimits, Reach, TaskWeights};");
        put(
            "use delmpc_controller_core::tables::{BodyTable, PointTable, PoseTable, RobotTable, SoleTable, StanceTable};",
        );
        put("use delmpc_estimation::prelude::EstimatorConfig;");
        put("use delmpc_lq::projected_qp::ProjectedQpOptions;");
        put("use delmpc_servo::prelude::{AffineLaw, WatchdogConfig};\n");
        put("/// Joint names.");
        put(&constant("JOINT_NAMES", &format!("[&str; {joints}]"), &self.joint_names));
        put("/// The floating tree.");
        put(&list("BODIES", "BodyTable", &self.bodies));
        put("/// Limits of the joints.");
        put(&list("LIMITS", "JointLimits", &self.limits));
        put("/// Home posture.");
        put(&list("POSTURE", "f64", &self.posture));
        for (index, (name, _, _, polygon)) in self.soles.iter().enumerate() {
            put(&format!("/// Corners of the sole `{name}`."));
            put(&list(&format!("SOLE_{index}"), "[f64; 2]", polygon));
        }
        put("/// The soles.");
        put(&format!("pub const SOLES: [SoleTable<'static>; {}] = [", self.soles.len()));
        for (index, (_, body, frame, _)) in self.soles.iter().enumerate() {
            put(&format!(
                "    SoleTable {{ body: {body}, frame: {}, polygon: &SOLE_{index} }},",
                source(frame)
            ));
        }
        put("];\n/// The robot.\npub const ROBOT: RobotTable<'static> = RobotTable {");
        put(&format!("    joint_set_hash: {:#018x},", self.joint_set_hash));
        put(&format!("    gravity_w: {},", source(&self.gravity_w)));
        put(
            "    bodies: &BODIES,\n    limits: &LIMITS,\n    posture: &POSTURE,\n    stance: Some(StanceTable {",
        );
        put(&format!("        soles: &SOLES, stance: {}, imu_body: {},", self.stance, self.imu.0));
        put(&format!("        imu_mounting: {},", source(&self.imu.1)));
        put(&format!("        sensors: {},\n    }}),", source(&self.sensors)));
        put(&format!("    hand: {},", source(&self.hand)));
        put(&format!("    swing_foot: {},\n}};", source(&self.swing_foot)));
        text.push_str(&self.rust_configuration());
        text
    }

    fn rust_configuration(&self) -> String {
        let c = &self.config;
        let mut text = String::new();
        text.push_str(&list("STAGES", "StageBlock", &c.stages));
        text.push_str(&constant("WEIGHTS", "TaskWeights", &c.weights));
        text.push_str(&constant("CONSTRAINTS", "ConstraintConfig", &c.constraints));
        text.push_str(&constant("QP", "ProjectedQpOptions", &c.qp));
        text.push_str("\n/// Times, weights and limits of the controller.\npub fn config() -> ControllerConfig {\n    ControllerConfig {\n");
        let kind = format!("ControllerKind::{:?}", c.kind);
        let fields = [
            ("kind", kind),
            ("period_s", source(&c.period_s)),
            ("servo_period_s", source(&c.servo_period_s)),
            ("delay_s", source(&c.delay_s)),
            ("stages", "STAGES.to_vec()".to_owned()),
            ("weights", "WEIGHTS".to_owned()),
            ("constraints", "CONSTRAINTS".to_owned()),
            ("qp", "QP".to_owned()),
            ("reach", source(&c.reach)),
            ("fallback", source(&c.fallback)),
            ("max_state_age_s", source(&c.max_state_age_s)),
            ("command_life_s", source(&c.command_life_s)),
            ("budget_s", source(&c.budget_s)),
            ("trim_s", source(&c.trim_s)),
            ("mismatch_rate", source(&c.mismatch_rate)),
        ];
        for (name, value) in fields {
            let _ = writeln!(text, "        {name}: {value},");
        }
        text.push_str("    }\n}\n\n");
        let w = &self.watchdog;
        if let Some(law) = &w.law {
            text.push_str(&list("HOLD_TORQUE", "f64", &law.torque));
            text.push_str(&list("HOLD_POSITION", "f64", &law.position_ref));
        }
        text.push_str(&list("HOLD_STIFFNESS", "f64", &w.stiffness));
        text.push_str(&list("HOLD_DAMPING", "f64", &w.damping));
        text.push_str("\n/// What the servo does without a command.\npub fn watchdog() -> WatchdogConfig {\n    WatchdogConfig {\n");
        let law = match w.law {
            Some(_) => {
                "Some(AffineLaw::joint_stiffness(&HOLD_TORQUE, &HOLD_POSITION, &HOLD_STIFFNESS, &HOLD_DAMPING))"
            }
            None => "None",
        };
        for (name, value) in [
            ("hold_gains", source(&w.hold_gains)),
            ("static_law", source(&w.static_law)),
            ("gravity_hold", source(&w.gravity_hold)),
            ("damping_only", source(&w.damping_only)),
            ("law", law.to_owned()),
            ("stiffness", "HOLD_STIFFNESS.to_vec()".to_owned()),
            ("damping", "HOLD_DAMPING.to_vec()".to_owned()),
            ("good_commands", source(&w.good_commands)),
        ] {
            let _ = writeln!(text, "        {name}: {value},");
        }
        text.push_str("    }\n}\n");
        text
    }
}

/// A value as an expression: what `derive(Debug)` writes of structures of numbers is one, but for infinity.
fn source(value: &impl Debug) -> String {
    format!("{value:?}").replace("-inf", "f64::NEG_INFINITY").replace("inf", "f64::INFINITY")
}

fn constant(name: &str, kind: &str, value: &impl Debug) -> String {
    format!("pub const {name}: {kind} = {};\n", source(value))
}

fn list<T: Debug>(name: &str, kind: &str, values: &[T]) -> String {
    let mut text = format!("pub const {name}: [{kind}; {}] = [\n", values.len());
    for value in values {
        let _ = writeln!(text, "    {},", source(value));
    }
    text.push_str("];\n");
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_written_so_that_they_are_read_back_exactly() {
        let limit = JointLimits {
            lower: f64::NEG_INFINITY,
            upper: 0.1 + 0.2,
            effort: 1e-300,
            velocity: f64::INFINITY,
        };
        assert_eq!(
            source(&limit),
            "JointLimits { lower: f64::NEG_INFINITY, upper: 0.30000000000000004, effort: 1e-300, velocity: f64::INFINITY }"
        );
    }
}
