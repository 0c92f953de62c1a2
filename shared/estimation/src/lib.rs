//! Where the base and the feet of a legged robot are: from its inertial unit, its encoders and the wrenches on its feet.
//!
//! | what | where |
//! |---|---|
//! | model, configuration and one measurement | [`model`] |
//! | whether a foot carries load, with hysteresis and debounce | [`contact`] |
//! | the contact-aided Kalman filter of the base | [`base_filter`] |
//! | all of it, one call a measurement | [`estimator`] |
//!
//! `no_std`, allocation in constructors only. Frames: {0} is level, its z axis up; its origin and heading are those of the reference
//! foot's sole at the first measurement. Suffix `_w`: in {0}; `_b`: in the base link; `_s`: in a sole; `_i`: in the inertial unit.
//!
//! ```
//! use delmpc_estimation::prelude::*;
//! use delmpc_mechanics::prelude::*;
//! // A block of 10 kg with a foot under it, its inertial unit at the block's origin.
//! let block = LinkInertia::new(10.0, Vector3::zeros(), Matrix3::identity());
//! let tree = TreeBuilder::floating_base(Vector3::new(0.0, 0.0, -9.81), block).build()?;
//! let sole = RigidTransform::from_translation(Vector3::new(0.0, 0.0, -0.5));
//! let polygon = vec![[-0.1, -0.1], [0.1, -0.1], [0.1, 0.1], [-0.1, 0.1]];
//! let model = EstimatorModel::new(tree, vec![FootModel { body: 0, sole, polygon }]);
//! let mut estimator = Estimator::new(model, EstimatorConfig::default())?;
//! let weight = FootMeasurement { wrench_s: Some(Wrench::new(Vector3::zeros(), Vector3::new(0.0, 0.0, 98.1))), touches: true };
//! let imu = Inertial { angular_velocity: Vector3::zeros(), specific_force: Vector3::new(0.0, 0.0, 9.81), sums: None };
//! for k in 0..100 {
//!     let measurement = Measurement {
//!         time_s: 0.005 * f64::from(k),
//!         position: &[],
//!         velocity: &[],
//!         inertial: Some(imu),
//!         feet: &[weight],
//!         motion_capture: None,
//!     };
//!     estimator.update(&measurement)?;
//! }
//! assert!((estimator.estimate().base_link_pose_w.translation.z - 0.5).abs() < 1e-3);
//! # Ok::<(), EstimationError>(())
//! ```

#![no_std]
#![forbid(unsafe_code)]

extern crate alloc;
#[cfg(test)]
extern crate std;

pub mod base_filter;
pub mod contact;
pub mod estimator;
pub mod model;

/// What most users need.
pub mod prelude {
    pub use crate::contact::FootEstimate;
    pub use crate::estimator::{BaseEstimate, EstimationError, Estimator};
    pub use crate::model::{
        EstimatorConfig, EstimatorModel, FootMeasurement, FootModel, Inertial, Measurement,
    };
}
