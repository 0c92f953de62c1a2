//! Scenario files: everything that decides a run, in one TOML file.
//!
//! ```
//! use delmpc_scenario::{Clock, Document};
//! let text = "seed = 7\nduration_s = 2.0\n[robot]\nurdf = \"atlas.urdf\"\n";
//! let mut document = Document::parse("stand.toml", text)?;
//! document.set("clock=lockstep")?;
//! let scenario = document.scenario()?;
//! assert_eq!((scenario.seed, scenario.clock), (7, Clock::Lockstep));
//! assert_eq!(scenario.plant.step_s, 0.001); // defaults fill the rest
//!
//! let error = Document::parse("stand.toml", "seed = 7\nduration = 2.0\n").unwrap_err();
//! assert!(error.to_string().contains("line 2: unknown key `duration`: did you mean `duration_s`?"));
//! # Ok::<(), delmpc_scenario::ScenarioError>(())
//! ```
//!
//! - Every key carries its unit; nothing is defaulted that has no sensible default.
//! - A key nobody understands is refused with its line, a value out of range with the rule and a remedy ([`ScenarioError`]).
//! - `key=value` overrides are typed like the key they replace ([`Document::set`]).
//! - [`Scenario::to_toml`] writes the *effective* configuration: every key, in the same format, readable again.
//!
//! Reading order: `scenario` and `fault` (the keys), `range` (their rules), `document` (text to scenario), `error`.
#![allow(
    clippy::result_large_err,
    reason = "an error here ends the reading of a file; its size costs nothing"
)]

mod document;
mod error;
mod fault;
mod feet;
mod ground;
mod list;
mod plan;
mod range;
mod scenario;
mod timing;

pub use document::Document;
pub use error::{Place, ScenarioError};
pub use fault::{FaultKind, FaultSettings, FaultTarget};
pub use feet::{GaitKind, GaitSettings, LeggedSettings, Stance, StepSettings};
pub use ground::{Base, BoxSettings, GapSettings, RobotSettings, StartSettings, TerrainSettings};
pub use plan::{PlanBound, PlanGap, PlanObstacle, PlanSettings, PlanSpring, PlanStep, PlanWeightSettings};
pub use scenario::{
    Clock, ConstraintSettings, ControllerKind, ControllerSettings, PlantSettings, ProcessSettings,
    PushSettings, ReachSettings, Scenario, SensorSettings, SuccessSettings, WeightSettings,
};
pub use timing::TimingSettings;
