//! Robot models: a URDF file and its companion table, read, checked and turned into a
//! [`KinematicTree`](delmpc_mechanics::tree::KinematicTree).
//!
//! ```
//! # fn main() -> Result<(), delmpc_robots::RobotError> {
//! let file = concat!(env!("CARGO_MANIFEST_DIR"), "/../../configs/robots/atlas.urdf");
//! let atlas = delmpc_robots::load(file)?;
//! assert_eq!(atlas.tree.dof(), 36);
//! let standing = atlas.rooted_at("r_sole_centre")?;
//! assert_eq!(standing.model.tree.dof(), 30);
//! assert_eq!(standing.model.joint_names[0], "r_leg_akx");
//! # Ok(())
//! # }
//! ```
//!
//! | URDF | here |
//! |---|---|
//! | root link with mass | floating base; without (`world`): the links on it hang on {0}. [`BaseChoice`] overrides |
//! | `fixed` | merged into the link that carries it, with inertia, shapes and points |
//! | `revolute`, `continuous`, `prismatic` | one coordinate |
//! | `planar` | three coordinates: two slides and a turn, with massless bodies between |
//! | `floating` from an empty root | floating base; anywhere else refused |
//! | `spherical` | refused |
//! | `<mimic>` | a full coordinate in the tree and a row of [`CoordinateMap`]; see there what works with it |
//! | meshes | never opened; [`RobotModel::meshes`] names their files |
//! | decoration that cannot be read | left out, with a warning ([`LoadOptions::strict`]: an error) |
//! | root link `world` without mass | the world itself: fixed base, with a warning |
//!
//! Joint coordinates are numbered depth-first, branches in the order of the file. Nothing is defaulted silently: what mechanics needs
//! and the file does not have (a mass, the effort of a motor, a possible inertia of what moves) is an error that names the file, the
//! line, the link or joint, the rule and the remedy ([`RobotError`]); what the field leaves out or writes beside the format is read with
//! a warning of the same form ([`RobotModel::warnings`]). Caps on size, depth and number of elements ([`limits`]) bound time and memory
//! on hostile files.
//!
//! Reading order: [`load`], [`RobotModel`], [`RootedModel`], then `document` (XML), `urdf` (description), `assemble` (tree),
//! `companion` (TOML).

mod assemble;
mod companion;
mod document;
mod error;
mod facts;
mod inertia;
pub mod limits;
mod load;
mod mimic;
mod model;
mod rooted;
mod urdf;

pub use companion::companion_schema;
pub use error::{RobotError, Rule, Subject};
pub use load::{BaseChoice, Companion, ImpossibleInertia, LoadOptions, load, load_str, load_with};
pub use mimic::CoordinateMap;
pub use model::{
    Attachment, ContactPoint, Geometry, JointLimits, Mesh, NamedFrame, NamedLink, Posture, RobotModel, Shape,
    ShapeRole, Sole,
};
pub use rooted::RootedModel;
