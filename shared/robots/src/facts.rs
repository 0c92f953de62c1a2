//! What the XML says by being there, and the text that `urdf-rs` reads.
//!
//! `urdf-rs` is stricter than the format in what is decoration (a material without a name ends the reading), and laxer in what is mechanics
//! (a missing mass is 0). So the XML is read here first: mechanics must be there and be numbers, decoration that cannot be read is left out
//! with a warning, and what remains is written anew for `urdf-rs`, with every value the format allows to be left out.
//!
//! | left out in the file | taken for |
//! |---|---|
//! | `ixy`, `ixz`, `iyz` | 0, with a warning |
//! | `lower` and `upper` of a turning or sliding joint | no stops, with a warning before version 1.2 |
//! | `effort`, `velocity` | refused before version 1.2 |
//! | `quat_xyzw` of an origin | used from version 1.1 on, before it a warning |

use std::fmt::Write as _;

use nalgebra::{Matrix3, Quaternion, UnitQuaternion};
use roxmltree::Node;

use crate::document::{Document, elements};
use crate::error::{RobotError, Rule, Subject, shorten};

/// Links and joints as the XML has them.
pub(crate) struct Facts {
    pub links: Vec<LinkFacts>,
    pub joints: Vec<JointFacts>,
    /// The URDF without anything that `urdf-rs` could stumble over; links, joints and shapes in the order of the facts.
    pub text: String,
}

pub(crate) struct LinkFacts {
    pub name: String,
    pub line: u32,
    pub inertial: bool,
    /// Rotation of the inertial frame where a quaternion gives it.
    pub inertial_rotation: Option<Matrix3<f64>>,
    /// The same of every shape that is kept.
    pub visual_rotations: Vec<Option<Matrix3<f64>>>,
    pub collision_rotations: Vec<Option<Matrix3<f64>>>,
}

pub(crate) struct JointFacts {
    pub name: String,
    pub line: u32,
    pub limit: bool,
    pub rotation: Option<Matrix3<f64>>,
}

impl Facts {
    pub(crate) fn check(document: &Document<'_>) -> Result<Self, RobotError> {
        let root = document.root();
        let has_xacro = root
            .descendants()
            .any(|node| node.tag_name().namespace().is_some_and(|uri| uri.contains("xacro")));
        if has_xacro {
            let rule = Rule::Xml("it still has xacro elements".to_owned());
            return Err(document.error(root, Subject::File, rule));
        }
        let mut reader = Reader { document, version: version(root), text: String::from("<robot") };
        reader.attribute("name", root.attribute("name").unwrap_or(""));
        reader.text.push_str(">\n");
        for node in elements(root, "material") {
            reader.material(node, &Subject::File);
        }
        let mut facts = Self { links: Vec::new(), joints: Vec::new(), text: String::new() };
        for node in elements(root, "link") {
            facts.links.push(reader.link(node)?);
        }
        if facts.links.is_empty() {
            return Err(document.error(root, Subject::File, Rule::Missing { what: "a <link>" }));
        }
        for node in elements(root, "joint") {
            facts.joints.push(reader.joint(node)?);
        }
        facts.text = reader.text + "</robot>\n";
        Ok(facts)
    }
}

fn version(root: Node<'_, '_>) -> (u32, u32) {
    let parse = |text: &str| {
        let (major, minor) = text.trim().split_once('.')?;
        Some((major.parse().ok()?, minor.parse().ok()?))
    };
    root.attribute("version").and_then(parse).unwrap_or((1, 0))
}

struct Reader<'d, 'i> {
    document: &'d Document<'i>,
    version: (u32, u32),
    text: String,
}

impl<'d, 'i> Reader<'d, 'i> {
    fn attribute(&mut self, name: &str, value: &str) {
        let _ = write!(self.text, " {name}=\"");
        for c in value.chars() {
            match c {
                '&' => self.text.push_str("&amp;"),
                '<' => self.text.push_str("&lt;"),
                '"' => self.text.push_str("&quot;"),
                '\n' | '\r' | '\t' => self.text.push(' '),
                c => self.text.push(c),
            }
        }
        self.text.push('"');
    }

    fn element(&mut self, name: &str, attributes: &[(&str, &str)]) {
        let _ = write!(self.text, "<{name}");
        for (name, value) in attributes {
            self.attribute(name, value);
        }
        self.text.push_str("/>");
    }

    fn numbers(&mut self, name: &str, attributes: &[(&str, &[f64])]) {
        let _ = write!(self.text, "<{name}");
        for (name, values) in attributes {
            let words: Vec<String> = values.iter().map(f64::to_string).collect();
            self.attribute(name, &words.join(" "));
        }
        self.text.push_str("/>");
    }

    fn link(&mut self, node: Node<'_, 'i>) -> Result<LinkFacts, RobotError> {
        let document = self.document;
        let name = document.text(node, "name", "the name of a link", &Subject::File)?.to_owned();
        let subject = Subject::Link(name.clone());
        self.text.push_str("<link");
        self.attribute("name", &name);
        self.text.push('>');
        let inertial = document.child(node, "inertial", &subject)?;
        let inertial_rotation = match inertial {
            Some(inertial) => self.inertial(inertial, &subject)?,
            None => None,
        };
        let mut rotations = [Vec::new(), Vec::new()];
        for (role, rotations) in ["visual", "collision"].into_iter().zip(&mut rotations) {
            for shape in elements(node, role) {
                let before = self.text.len();
                match self.shape(shape, role, &subject) {
                    Ok(rotation) => rotations.push(rotation),
                    Err(error) => {
                        self.text.truncate(before);
                        document.warn(error, "the shape is left out");
                    }
                }
            }
        }
        self.text.push_str("</link>\n");
        let [visual_rotations, collision_rotations] = rotations;
        Ok(LinkFacts {
            name,
            line: document.line(node),
            inertial: inertial.is_some(),
            inertial_rotation,
            visual_rotations,
            collision_rotations,
        })
    }

    fn inertial(
        &mut self,
        node: Node<'_, 'i>,
        subject: &Subject,
    ) -> Result<Option<Matrix3<f64>>, RobotError> {
        let document = self.document;
        self.text.push_str("<inertial>");
        let rotation = self.origin(node, subject)?;
        let mass = document.required(node, "mass", "<mass> of <inertial>", subject)?;
        document.text(mass, "value", "the value of <mass>", subject)?;
        let [value] = document.finite::<1>(mass, "value", subject)?.unwrap_or_default();
        self.numbers("mass", &[("value", &[value])]);
        let inertia = document.required(node, "inertia", "<inertia> of <inertial>", subject)?;
        let mut moments = [0.0; 6];
        for (moment, (attribute, what, off_diagonal)) in moments.iter_mut().zip([
            ("ixx", "ixx of <inertia>", false),
            ("ixy", "ixy of <inertia>", true),
            ("ixz", "ixz of <inertia>", true),
            ("iyy", "iyy of <inertia>", false),
            ("iyz", "iyz of <inertia>", true),
            ("izz", "izz of <inertia>", false),
        ]) {
            if off_diagonal && inertia.attribute(attribute).is_none() {
                let missing = document.error(inertia, subject.clone(), Rule::Missing { what });
                document.warn(missing, "it is taken for 0");
                continue;
            }
            document.text(inertia, attribute, what, subject)?;
            [*moment] = document.finite::<1>(inertia, attribute, subject)?.unwrap_or_default();
        }
        let [ixx, ixy, ixz, iyy, iyz, izz] = moments;
        let values: [(&str, &[f64]); 6] = [
            ("ixx", &[ixx]),
            ("ixy", &[ixy]),
            ("ixz", &[ixz]),
            ("iyy", &[iyy]),
            ("iyz", &[iyz]),
            ("izz", &[izz]),
        ];
        self.numbers("inertia", &values);
        self.text.push_str("</inertial>");
        Ok(rotation)
    }

    /// A shape; what cannot be read of its material is left out of it.
    fn shape(
        &mut self,
        node: Node<'_, 'i>,
        role: &str,
        subject: &Subject,
    ) -> Result<Option<Matrix3<f64>>, RobotError> {
        let document = self.document;
        let _ = write!(self.text, "<{role}>");
        let rotation = self.origin(node, subject)?;
        let geometry = document.required(node, "geometry", "<geometry> of a shape", subject)?;
        self.geometry(geometry, subject)?;
        if role == "visual" {
            for material in elements(node, "material").take(1) {
                self.material(material, subject);
            }
        }
        let _ = write!(self.text, "</{role}>");
        Ok(rotation)
    }

    /// Name and colour of a material, as far as it has them; textures are never opened.
    fn material(&mut self, node: Node<'_, 'i>, subject: &Subject) {
        let document = self.document;
        let name = document.text(node, "name", "the name of <material>", subject).unwrap_or_else(|error| {
            document.warn(error, "the material is known at this place only");
            ""
        });
        let color = elements(node, "color").next().and_then(|color| {
            let given = document.text(color, "rgba", "rgba of <color>", subject);
            let rgba = given.and_then(|_| document.finite::<4>(color, "rgba", subject));
            rgba.unwrap_or_else(|error| {
                document.warn(error, "the colour is left out");
                None
            })
        });
        for texture in elements(node, "texture") {
            if let Err(error) = document.text(texture, "filename", "the filename of <texture>", subject) {
                document.warn(error, "the texture is left out");
            }
        }
        self.text.push_str("<material");
        self.attribute("name", name);
        self.text.push('>');
        if let Some(rgba) = color {
            self.numbers("color", &[("rgba", &rgba)]);
        }
        self.text.push_str("</material>");
    }

    /// `<origin>` of an element, where it has one; the rotation comes back when it is a quaternion.
    fn origin(
        &mut self,
        parent: Node<'_, 'i>,
        subject: &Subject,
    ) -> Result<Option<Matrix3<f64>>, RobotError> {
        let document = self.document;
        let Some(origin) = document.child(parent, "origin", subject)? else { return Ok(None) };
        let xyz = document.finite::<3>(origin, "xyz", subject)?.unwrap_or_default();
        let rpy = document.finite::<3>(origin, "rpy", subject)?;
        let quaternion = document.finite::<4>(origin, "quat_xyzw", subject)?;
        self.numbers("origin", &[("xyz", &xyz), ("rpy", &rpy.unwrap_or_default())]);
        let Some([x, y, z, w]) = quaternion else { return Ok(None) };
        let refuse = |what: &str| document.error(origin, subject.clone(), Rule::Xml(what.to_owned()));
        if self.version < (1, 1) {
            let unknown = refuse("quat_xyzw of <origin> does not exist before version 1.1 of the format");
            document.warn(unknown, "it is not used: write rpy, or version=\"1.1\" into <robot>");
            return Ok(None);
        }
        if rpy.is_some() {
            return Err(refuse("<origin> has both rpy and quat_xyzw"));
        }
        let quaternion = Quaternion::new(w, x, y, z);
        let norm = quaternion.norm();
        if !(norm > 0.0 && norm.is_finite()) {
            return Err(refuse("quat_xyzw of <origin> has no direction"));
        }
        Ok(Some(UnitQuaternion::from_quaternion(quaternion).to_rotation_matrix().into_inner()))
    }

    fn geometry(&mut self, node: Node<'_, 'i>, subject: &Subject) -> Result<(), RobotError> {
        let document = self.document;
        let what = "one of <box>, <cylinder>, <capsule>, <sphere>, <mesh> in <geometry>";
        let mut shapes = node.children().filter(Node::is_element);
        let (Some(shape), None) = (shapes.next(), shapes.next()) else {
            return Err(document.error(node, subject.clone(), Rule::Missing { what }));
        };
        let length = |attribute: &'static str, what| {
            document.text(shape, attribute, what, subject)?;
            Ok::<_, RobotError>(document.finite::<1>(shape, attribute, subject)?.unwrap_or_default())
        };
        self.text.push_str("<geometry>");
        match shape.tag_name().name() {
            "box" => {
                document.text(shape, "size", "the size of <box>", subject)?;
                let size = document.finite::<3>(shape, "size", subject)?.unwrap_or_default();
                self.numbers("box", &[("size", &size)]);
            }
            name @ ("cylinder" | "capsule") => {
                let radius = length("radius", "the radius of a shape")?;
                let length = length("length", "the length of a shape")?;
                self.numbers(name, &[("radius", &radius), ("length", &length)]);
            }
            "sphere" => {
                let radius = length("radius", "the radius of a shape")?;
                self.numbers("sphere", &[("radius", &radius)]);
            }
            "mesh" => self.mesh(shape, subject)?,
            _ => return Err(document.error(node, subject.clone(), Rule::Missing { what })),
        }
        self.text.push_str("</geometry>");
        Ok(())
    }

    fn mesh(&mut self, node: Node<'_, 'i>, subject: &Subject) -> Result<(), RobotError> {
        let document = self.document;
        let file = document.text(node, "filename", "the filename of <mesh>", subject)?;
        let scale = match document.finite::<1>(node, "scale", subject) {
            Ok(Some([all])) => {
                let rule = Rule::Xml("scale of <mesh> is one number, the format has three".to_owned());
                document.warn(document.error(node, subject.clone(), rule), "it is taken for all three axes");
                Some([all; 3])
            }
            Ok(None) => None,
            Err(_) => document.finite::<3>(node, "scale", subject)?,
        };
        let [x, y, z] = scale.unwrap_or([1.0; 3]);
        self.element("mesh", &[("filename", file), ("scale", &format!("{x} {y} {z}"))]);
        Ok(())
    }

    fn joint(&mut self, node: Node<'_, 'i>) -> Result<JointFacts, RobotError> {
        let document = self.document;
        let name = document.text(node, "name", "the name of a joint", &Subject::File)?.to_owned();
        let subject = Subject::Joint(name.clone());
        let kind = document.text(node, "type", "the type of the joint", &subject)?;
        let known = ["revolute", "continuous", "prismatic", "fixed", "floating", "planar", "spherical"]
            .contains(&kind);
        if !known {
            let rule = Rule::Xml(format!("`{}` is not a joint type", shorten(kind)));
            return Err(document.error(node, subject, rule));
        }
        self.text.push_str("<joint");
        self.attribute("name", &name);
        self.attribute("type", kind);
        self.text.push('>');
        let rotation = self.origin(node, &subject)?;
        for (element, what, link) in
            [("parent", "<parent>", "the link of <parent>"), ("child", "<child>", "the link of <child>")]
        {
            let end = document.required(node, element, what, &subject)?;
            let link = document.text(end, "link", link, &subject)?;
            self.element(element, &[("link", link)]);
        }
        if let Some(axis) = document.child(node, "axis", &subject)? {
            document.text(axis, "xyz", "xyz of <axis>", &subject)?;
            let xyz = document.finite::<3>(axis, "xyz", &subject)?.unwrap_or_default();
            self.numbers("axis", &[("xyz", &xyz)]);
        }
        if let Some(dynamics) = document.child(node, "dynamics", &subject)? {
            let damping = document.finite::<1>(dynamics, "damping", &subject)?.unwrap_or_default();
            let friction = document.finite::<1>(dynamics, "friction", &subject)?.unwrap_or_default();
            self.numbers("dynamics", &[("damping", &damping), ("friction", &friction)]);
        }
        if let Some(mimic) = document.child(node, "mimic", &subject)? {
            let followed = document.text(mimic, "joint", "the joint of <mimic>", &subject)?;
            let multiplier = document.finite::<1>(mimic, "multiplier", &subject)?.unwrap_or([1.0]);
            let offset = document.finite::<1>(mimic, "offset", &subject)?.unwrap_or_default();
            let [multiplier, offset] = [multiplier, offset].map(|[value]| value.to_string());
            self.element("mimic", &[("joint", followed), ("multiplier", &multiplier), ("offset", &offset)]);
        }
        let limit = self.limit(node, kind, &subject)?;
        self.text.push_str("</joint>\n");
        Ok(JointFacts { name, line: document.line(node), limit, rotation })
    }

    /// `<limit>` of a joint; whether it has one.
    fn limit(&mut self, node: Node<'_, 'i>, kind: &str, subject: &Subject) -> Result<bool, RobotError> {
        let document = self.document;
        let missing = |at, what| document.error(at, subject.clone(), Rule::Missing { what });
        let bounded = kind == "revolute" || kind == "prismatic";
        let Some(limit) = document.child(node, "limit", subject)? else {
            if bounded {
                let what = "<limit> (a turning joint without stops is of type continuous)";
                return Err(missing(node, what));
            }
            return Ok(false);
        };
        let [lower, upper, effort, velocity] = [
            document.limit(limit, "lower", subject)?,
            document.limit(limit, "upper", subject)?,
            document.limit(limit, "effort", subject)?,
            document.limit(limit, "velocity", subject)?,
        ];
        let unlimited_by_default = self.version >= (1, 2);
        if !unlimited_by_default && effort.is_none() {
            return Err(missing(limit, "effort of <limit> (readers take it for 0)"));
        }
        if !unlimited_by_default && velocity.is_none() {
            return Err(missing(limit, "velocity of <limit>"));
        }
        let stops = match (lower, upper) {
            (None, None) => {
                if bounded && !unlimited_by_default {
                    let error = missing(limit, "lower and upper of <limit>");
                    document.warn(error, "it is taken for a joint without stops (other readers: 0 to 0)");
                }
                [f64::NEG_INFINITY, f64::INFINITY]
            }
            (lower, upper) if unlimited_by_default => {
                [lower.unwrap_or(f64::NEG_INFINITY), upper.unwrap_or(f64::INFINITY)]
            }
            (lower, upper) => [lower.unwrap_or(0.0), upper.unwrap_or(0.0)],
        };
        let [lower, upper] = stops;
        if kind == "continuous" && lower < upper && lower.abs().min(upper.abs()).is_finite() {
            let rule = Rule::Xml(format!("a continuous joint has no stops, but lower={lower} upper={upper}"));
            let error = document.error(limit, subject.clone(), rule);
            document.warn(error, "they are not used: make it a revolute joint if they are meant");
        }
        let unlimited = [f64::INFINITY];
        let effort = effort.map_or(unlimited, |value| [value]);
        let velocity = velocity.map_or(unlimited, |value| [value]);
        let values: [(&str, &[f64]); 4] =
            [("lower", &[lower]), ("upper", &[upper]), ("effort", &effort), ("velocity", &velocity)];
        self.numbers("limit", &values);
        Ok(true)
    }
}
