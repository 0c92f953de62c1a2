//! The plant: a floating robot on hard frictional ground, with its actuators, sensors, disturbances and watchdog.
//!
//! A library: no process, no transport, no clock. Time is counted in steps, everything random comes from one seed, and two plants with the
//! same inputs give the same bits.
//!
//! ```text
//! Command --> servo --> actuators --> contact step (Simpson + contact law) --> sensors --> PlantState
//!             watchdog                 pushes, model errors                     monitor: feet, falls, energy
//! ```
//!
//! Reading order: [`plant`], [`contact_step`], [`contact_law`], [`friction_cone`], [`cone_program`], [`terrain`], [`monitor`],
//! [`delmpc_servo`], [`watchdog_gains`], [`actuators`], [`joint_stops`], [`sensors`], [`inertial_unit`], [`disturbances`].
//!
//! Allocation: none in a warm [`plant::Plant::step`], except what Clarabel takes when a cone program is solved (measured in
//! `tests/allocation.rs`); at rest none is.
//!
//! # Example
//! ```
//! use delmpc_mechanics::prelude::*;
//! use delmpc_plant::prelude::*;
//! // A ball of 1 kg falls on the ground.
//! let ball = LinkInertia::new(1.0, Vector3::zeros(), Matrix3::identity() * 0.01);
//! let tree = TreeBuilder::floating_base(Vector3::new(0.0, 0.0, -9.81), ball).build()?;
//! let lowest = ContactPoint { body: 0, point: Vector3::new(0.0, 0.0, -0.1), radius: 0.0, friction: 0.5 };
//! let model = PlantModel { contacts: vec![lowest], feet: vec![], joint_set_hash: 0, tree };
//! let mut state = State::zeros(&model.tree);
//! state.base_pose.translation.z = 0.3;
//! let mut plant = Plant::new(&model, &PlantConfig::default(), &state)?;
//! for _ in 0..1000 {
//!     plant.step()?;
//! }
//! assert!((plant.state().base_pose.translation.z - 0.1).abs() < 1e-6);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
#![forbid(unsafe_code)]

pub mod actuators;
pub mod cone_program;
pub mod contact_law;
pub mod contact_step;
pub(crate) mod delay;
pub(crate) mod dense;
pub mod disturbances;
pub mod error;
pub mod friction_cone;
pub mod inertial_unit;
pub mod joint_stops;
pub mod monitor;
pub mod plant;
pub mod random;
pub mod sensors;
pub(crate) mod step_newton;
pub mod terrain;
pub mod watchdog_gains;

/// What most users need.
pub mod prelude {
    pub use crate::actuators::{ActuatorConfig, ActuatorLimits};
    pub use crate::contact_law::Regularisation;
    pub use crate::contact_step::{
        ContactOptions, ContactPoint, ContactReport, ContactResult, ContactStep, GroundGive,
    };
    pub use crate::disturbances::{ModelErrors, Push};
    pub use crate::error::PlantError;
    pub use crate::inertial_unit::{InertialReading, InertialUnitConfig};
    pub use crate::joint_stops::JointStops;
    pub use crate::monitor::{FallCause, Foot, FootReport, Monitor, MonitorConfig, Totals};
    pub use crate::plant::{Plant, PlantConfig, PlantModel, PlantStep};
    pub use crate::sensors::{Readings, SensorConfig};
    pub use crate::terrain::{Terrain, TerrainBox, TerrainGap};
    pub use crate::watchdog_gains::{HoldingGains, joint_inverse_inertia, spectral_radius};
    pub use delmpc_servo::prelude::{AffineLaw, CommandRefused, WatchdogConfig};
}
