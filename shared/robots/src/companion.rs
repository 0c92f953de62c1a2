//! The companion file `robot.toml` beside `robot.urdf`: what a URDF cannot say.
//!
//! ```toml
//! format = 1
//! passive = ["ankle"]                       # joints without a motor
//! mesh_folder = "../urdf"                   # where names of meshes are relative to, from here; optional: here
//! accept_impossible_inertia = false         # take inertias that no body has, hold joints that carry no mass
//!
//! [locked]                                  # joints that do not move, and where they stand, rad or m
//! finger = 0.4
//!
//! [[contact]]                               # points that may touch the ground, link frame
//! name = "toe"
//! link = "foot"
//! position_m = [0.17, 0.0, -0.04]
//! radius_m = 0.0                            # optional
//!
//! [[frame]]                                 # named frames, link frame
//! name = "sole"
//! link = "foot"
//! position_m = [0.05, 0.0, -0.04]
//! rpy_rad = [0.0, 0.0, 0.0]                 # optional
//!
//! [[sole]]                                  # support polygons
//! name = "right"
//! frame = "sole"
//! corners = ["heel_right", "toe_right", "toe_left", "heel_left"]
//!
//! [[spring]]                                # joint springs (…_n_per_m and rest_m for a prismatic joint)
//! joint = "ankle"
//! stiffness_nm_per_rad = 0.1
//! rest_rad = 0.0
//!
//! [[posture]]
//! name = "stand"
//! base_position_m = [0.0, 0.0, 0.8]         # pose of the base's link frame, optional
//! base_rpy_rad = [0.0, 0.0, 0.0]
//! [posture.joints]                          # others are 0
//! ankle = 0.1
//! ```
//!
//! Unknown keys are refused.

use std::collections::{BTreeMap, HashSet};
use std::path::{Path, PathBuf};

use delmpc_mechanics::spatial::RigidTransform;
use nalgebra::{Vector2, Vector3};
use schemars::JsonSchema;
use serde::Deserialize;
use toml::Spanned;

use crate::document::line_of;
use crate::error::{RobotError, Rule, Subject, shorten};
use crate::model::{Attachment, ContactPoint, JointLimits, NamedFrame, Posture, RobotModel, Sole};
use crate::urdf::Description;

/// The companion table of a robot: what its URDF cannot say.
#[derive(Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
struct Tables {
    /// Version of the table: 1.
    #[schemars(with = "u32")]
    format: Spanned<u32>,
    /// Joints without a motor.
    #[serde(default)]
    #[schemars(with = "Vec<String>")]
    passive: Vec<Spanned<String>>,
    /// Folder that names of mesh files are relative to, from the table's; that of the table when not given.
    #[schemars(with = "Option<String>")]
    mesh_folder: Option<PathBuf>,
    /// Whether inertias that no body has are taken as they are, and joints that carry no mass are held.
    #[serde(default)]
    accept_impossible_inertia: bool,
    /// Joints that do not move, by name, and where they stand, rad or m.
    #[serde(default)]
    #[schemars(with = "BTreeMap<String, f64>")]
    locked: BTreeMap<Spanned<String>, f64>,
    /// Points that may touch the ground.
    #[serde(default)]
    #[schemars(with = "Vec<ContactTable>")]
    contact: Vec<Spanned<ContactTable>>,
    /// Named frames.
    #[serde(default)]
    #[schemars(with = "Vec<FrameTable>")]
    frame: Vec<Spanned<FrameTable>>,
    /// Feet.
    #[serde(default)]
    #[schemars(with = "Vec<SoleTable>")]
    sole: Vec<Spanned<SoleTable>>,
    /// Springs on joints.
    #[serde(default)]
    #[schemars(with = "Vec<SpringTable>")]
    spring: Vec<Spanned<SpringTable>>,
    /// Postures.
    #[serde(default)]
    #[schemars(with = "Vec<PostureTable>")]
    posture: Vec<Spanned<PostureTable>>,
}

/// A point that may touch the ground.
#[derive(Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
struct ContactTable {
    /// Name of the point.
    name: String,
    /// Link it is on.
    link: String,
    /// Where, in the axes of the link, m.
    position_m: [f64; 3],
    /// Radius of the sphere around it, m; 0: a point.
    #[serde(default)]
    radius_m: f64,
}

/// A named frame.
#[derive(Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
struct FrameTable {
    /// Name of the frame.
    name: String,
    /// Link it is on.
    link: String,
    /// Its origin in the axes of the link, m.
    position_m: [f64; 3],
    /// Its axes: roll, pitch, yaw, rad. z of a sole points out of the ground, x forward.
    #[serde(default)]
    rpy_rad: [f64; 3],
}

/// A foot.
#[derive(Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
struct SoleTable {
    /// Name of the foot.
    name: String,
    /// Frame in whose x, y plane it is.
    frame: String,
    /// Contacts that are its corners, counter-clockwise from above; one: a foot that is a point or a sphere.
    corners: Vec<String>,
}

/// A spring on a joint.
#[derive(Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
struct SpringTable {
    /// The joint.
    joint: String,
    /// Its stiffness, N m/rad; of a sliding joint `stiffness_n_per_m`.
    #[serde(alias = "stiffness_n_per_m")]
    stiffness_nm_per_rad: f64,
    /// Where it is relaxed, rad; of a sliding joint `rest_m`.
    #[serde(default, alias = "rest_m")]
    rest_rad: f64,
}

/// A posture.
#[derive(Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
struct PostureTable {
    /// Name of the posture.
    name: String,
    /// The root link's origin in the world, m; a scenario needs it.
    base_position_m: Option<[f64; 3]>,
    /// Its axes there: roll, pitch, yaw, rad.
    base_rpy_rad: Option<[f64; 3]>,
    /// Joints by name, rad or m; those that are not named are at 0.
    #[serde(default)]
    joints: BTreeMap<String, f64>,
}

/// The JSON schema of companion tables, for editors and for the list of keys.
pub fn companion_schema() -> schemars::Schema {
    schemars::schema_for!(Tables)
}

/// A parsed companion file, not yet compared with the robot.
pub(crate) struct CompanionFile {
    path: PathBuf,
    text: String,
    tables: Tables,
}

/// A spring on a joint coordinate.
pub(crate) struct Spring {
    pub stiffness: f64,
    pub rest: f64,
}

impl CompanionFile {
    pub(crate) fn read(path: &Path, text: &str) -> Result<Self, RobotError> {
        let tables: Tables = toml::from_str(text).map_err(|error| {
            let line = error.span().map(|span| line_of(text, span.start));
            let message: String = error.message().chars().take(300).collect();
            RobotError::new(path, line, Subject::File, Rule::Toml(message))
        })?;
        let companion = Self { path: path.to_owned(), text: text.to_owned(), tables };
        if *companion.tables.format.get_ref() != 1 {
            let rule = Rule::Toml("format is not 1, the only one there is".to_owned());
            return Err(companion.error(&companion.tables.format, "format", rule));
        }
        Ok(companion)
    }

    fn error<T>(&self, at: &Spanned<T>, entry: &str, rule: Rule) -> RobotError {
        let line = line_of(&self.text, at.span().start);
        RobotError::new(&self.path, Some(line), Subject::Entry(entry.to_owned()), rule)
    }

    /// Whether the table says so.
    pub(crate) fn accepts_impossible_inertia(&self) -> bool {
        self.tables.accept_impossible_inertia
    }

    /// Makes the joints that the table locks fixed ones, at their places.
    pub(crate) fn lock(&self, description: &mut Description) -> Result<(), RobotError> {
        for (name, &value) in &self.tables.locked {
            let entry = format!("locked `{}`", shorten(name.get_ref()));
            let refuse = |rule| self.error(name, &entry, rule);
            let found = description.joints.iter_mut().find(|joint| joint.name == *name.get_ref());
            let Some(joint) = found else {
                return Err(refuse(Rule::Unknown { kind: "joint", name: shorten(name.get_ref()) }));
            };
            if !value.is_finite() {
                return Err(refuse(Rule::BadNumber { key: "the place of a locked joint" }));
            }
            joint.hold_at(value).map_err(|kind| refuse(Rule::UnsupportedJoint { kind }))?;
        }
        Ok(())
    }

    /// Joint coordinates without a motor, and the springs, by coordinate.
    pub(crate) fn joints(&self, names: &[String]) -> Result<(Vec<bool>, Vec<Option<Spring>>), RobotError> {
        let find = |name: &str| names.iter().position(|joint| joint == name);
        let unknown = |name: &str| Rule::Unknown { kind: "joint", name: shorten(name) };
        let mut passive = vec![false; names.len()];
        for name in &self.tables.passive {
            let joint =
                find(name.get_ref()).ok_or_else(|| self.error(name, "passive", unknown(name.get_ref())))?;
            passive[joint] = true;
        }
        let mut springs: Vec<Option<Spring>> = names.iter().map(|_| None).collect();
        for spring in &self.tables.spring {
            let SpringTable { joint: name, stiffness_nm_per_rad: stiffness, rest_rad: rest } =
                spring.get_ref();
            let entry = format!("spring on `{}`", shorten(name));
            let joint = find(name).ok_or_else(|| self.error(spring, &entry, unknown(name)))?;
            if springs[joint].is_some() {
                return Err(self.error(spring, &entry, Rule::DuplicateName));
            }
            if !(stiffness.is_finite() && *stiffness >= 0.0) {
                return Err(self.error(spring, &entry, Rule::BadNumber { key: "stiffness" }));
            }
            if !rest.is_finite() {
                return Err(self.error(spring, &entry, Rule::BadNumber { key: "rest" }));
            }
            springs[joint] = Some(Spring { stiffness: *stiffness, rest: *rest });
        }
        Ok((passive, springs))
    }

    /// Adds contacts, frames, soles and postures to a model whose links and joints are complete.
    pub(crate) fn complete(&self, model: &mut RobotModel) -> Result<(), RobotError> {
        let here = self.path.parent().unwrap_or(Path::new(""));
        model.mesh_folder = self.tables.mesh_folder.as_ref().map(|folder| here.join(folder));
        self.add_contacts(model)?;
        self.add_frames(model)?;
        self.add_soles(model)?;
        self.add_postures(model)
    }

    fn add_contacts(&self, model: &mut RobotModel) -> Result<(), RobotError> {
        let mut names = HashSet::new();
        for contact in &self.tables.contact {
            let table = contact.get_ref();
            let entry = format!("contact `{}`", shorten(&table.name));
            let refuse = |rule| Err(self.error(contact, &entry, rule));
            if !names.insert(table.name.as_str()) {
                return refuse(Rule::DuplicateName);
            }
            if !table.position_m.iter().all(|x| x.is_finite()) {
                return refuse(Rule::BadNumber { key: "position_m" });
            }
            if !(table.radius_m.is_finite() && table.radius_m >= 0.0) {
                return refuse(Rule::BadNumber { key: "radius_m" });
            }
            let Some(link) = model.link(&table.link) else {
                return refuse(Rule::Unknown { kind: "link", name: shorten(&table.link) });
            };
            let point = ContactPoint {
                name: table.name.clone(),
                link: table.link.clone(),
                body: link.body,
                position: link.pose.transform_point(&Vector3::from(table.position_m)),
                radius: table.radius_m,
            };
            model.contacts.push(point);
        }
        Ok(())
    }

    fn add_frames(&self, model: &mut RobotModel) -> Result<(), RobotError> {
        let mut names = HashSet::new();
        for frame in &self.tables.frame {
            let table = frame.get_ref();
            let entry = format!("frame `{}`", shorten(&table.name));
            let refuse = |rule| Err(self.error(frame, &entry, rule));
            if !names.insert(table.name.as_str()) || model.link(&table.name).is_some() {
                return refuse(Rule::DuplicateName);
            }
            if !table.position_m.iter().chain(&table.rpy_rad).all(|x| x.is_finite()) {
                return refuse(Rule::BadNumber { key: "position_m or rpy_rad" });
            }
            let Some(link) = model.link(&table.link) else {
                return refuse(Rule::Unknown { kind: "link", name: shorten(&table.link) });
            };
            let in_link =
                RigidTransform::from_xyz_rpy(Vector3::from(table.position_m), Vector3::from(table.rpy_rad));
            let attachment = Attachment { body: link.body, pose: link.pose * in_link };
            let frame = NamedFrame { name: table.name.clone(), link: table.link.clone(), attachment };
            model.frames.push(frame);
        }
        Ok(())
    }

    fn add_soles(&self, model: &mut RobotModel) -> Result<(), RobotError> {
        let mut names = HashSet::new();
        for sole in &self.tables.sole {
            let table = sole.get_ref();
            let entry = format!("sole `{}`", shorten(&table.name));
            let refuse = |rule| Err(self.error(sole, &entry, rule));
            if !names.insert(table.name.as_str()) {
                return refuse(Rule::DuplicateName);
            }
            let Some(&frame) = model.frame(&table.frame) else {
                return refuse(Rule::Unknown { kind: "frame", name: shorten(&table.frame) });
            };
            let (mut polygon, mut contacts, mut in_plane) = (Vec::new(), Vec::new(), true);
            for corner in &table.corners {
                let Some(index) = model.contacts.iter().position(|contact| contact.name == *corner) else {
                    return refuse(Rule::Unknown { kind: "contact", name: shorten(corner) });
                };
                let contact = &model.contacts[index];
                let point = frame.pose.inverse().transform_point(&contact.position);
                // A tenth of a millimetre: soles in model files are flat to their last digit.
                let is_point = table.corners.len() == 1;
                in_plane &= contact.body == frame.body && (is_point || point.z.abs() < 1e-4);
                polygon.push(point.xy());
                contacts.push(index);
            }
            // One corner: a foot that stands on a point or a sphere.
            if !in_plane || (polygon.len() != 1 && !is_convex(&polygon)) {
                return refuse(Rule::SolePolygon);
            }
            model.soles.push(Sole {
                name: table.name.clone(),
                frame: table.frame.clone(),
                polygon,
                contacts,
            });
        }
        Ok(())
    }

    fn add_postures(&self, model: &mut RobotModel) -> Result<(), RobotError> {
        let mut names = HashSet::new();
        for posture in &self.tables.posture {
            let table = posture.get_ref();
            let entry = format!("posture `{}`", shorten(&table.name));
            let refuse = |rule| Err(self.error(posture, &entry, rule));
            if !names.insert(table.name.as_str()) {
                return refuse(Rule::DuplicateName);
            }
            let given = table.base_position_m.is_some() || table.base_rpy_rad.is_some();
            let (position, rpy) =
                (table.base_position_m.unwrap_or_default(), table.base_rpy_rad.unwrap_or_default());
            if !position.iter().chain(&rpy).all(|x| x.is_finite()) {
                return refuse(Rule::BadNumber { key: "base_position_m or base_rpy_rad" });
            }
            let base =
                given.then(|| RigidTransform::from_xyz_rpy(Vector3::from(position), Vector3::from(rpy)));
            let mut q = vec![0.0; model.joint_names.len()];
            for (name, &value) in &table.joints {
                let Some(joint) = model.joint(name) else {
                    return refuse(Rule::Unknown { kind: "joint", name: shorten(name) });
                };
                if !value.is_finite() {
                    return refuse(Rule::BadNumber { key: "a joint coordinate" });
                }
                q[joint] = value;
            }
            // Those that are not named too, which are at 0.
            for ((name, limits), value) in model.joint_names.iter().zip(&model.limits).zip(&q) {
                if *value < limits.lower || *value > limits.upper {
                    let (name, JointLimits { lower, upper, .. }) = (shorten(name), limits);
                    let warning = format!(
                        "{entry}: joint `{name}` at {value} is outside its limits {lower} to {upper}"
                    );
                    model.warnings.push(warning);
                }
            }
            model.postures.push(Posture {
                name: table.name.clone(),
                base_link_pose_w: base.filter(|_| model.tree.is_floating()),
                q,
            });
        }
        Ok(())
    }
}

/// Whether the corners are a convex polygon in counter-clockwise order: every corner is left of every edge it is not on.
fn is_convex(polygon: &[Vector2<f64>]) -> bool {
    let count = polygon.len();
    count >= 3
        && (0..count).all(|i| {
            let (from, to) = (polygon[i], polygon[(i + 1) % count]);
            (0..count)
                .filter(|&k| k != i && k != (i + 1) % count)
                .all(|k| (to - from).perp(&(polygon[k] - from)) > 0.0)
        })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn convex_means_counter_clockwise_and_simple() {
        let square = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]].map(Vector2::from);
        assert!(is_convex(&square));
        let mut clockwise = square;
        clockwise.reverse();
        assert!(!is_convex(&clockwise));
        assert!(!is_convex(&[square[0], square[2], square[1], square[3]]));
        assert!(!is_convex(&square[..2]));
        assert!(!is_convex(&[square[0], square[1], square[1], square[3]]));
    }
}
