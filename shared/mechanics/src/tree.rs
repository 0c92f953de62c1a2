//! The immutable model: a tree of rigid bodies on revolute and prismatic joints, with a fixed or a floating base.
//!
//! Bodies are numbered parent-first (`parent(i) < i`), not necessarily depth-first. Every body but a floating base hangs
//! on one joint with one coordinate. The *link frame* of a body moves with its joint; the paper's *body frame* {i} is
//! the link frame moved to the mass centre. Frame {0} is the world.
//!
//! ```text
//! link pose:  X_i = X_parent · placement_i · joint_i(q_i)       revolute: exp(axis^ q), prismatic: translation axis·q
//! ```
//!
//! | generalised coordinates | fixed base | floating base |
//! |---|---|---|
//! | number `n` ([`KinematicTree::dof`]) | bodies | 6 + bodies - 1 |
//! | coordinate of body i's joint ([`KinematicTree::joint_dof`]) | i | 6 + i - 1 |

use alloc::vec;
use alloc::vec::Vec;
use nalgebra::{Matrix3, Vector3, Vector6};

use crate::errors::ModelError;
use crate::spatial::{RigidTransform, SpatialInertia, Wrench, skew};

/// What a joint lets its body do.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum JointKind {
    /// Rotation about the axis; coordinate in rad.
    Revolute,
    /// Translation along the axis; coordinate in m.
    Prismatic,
}

/// A joint with one coordinate, and the forces that live in it: `u - damping·q̇ - stiffness·(q - rest)`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Joint {
    /// Revolute or prismatic.
    pub kind: JointKind,
    /// Unit axis in the joint frame.
    pub axis: Vector3<f64>,
    /// Pose of the joint frame in the parent's link frame (in {0} for a root) at coordinate 0.
    pub placement: RigidTransform,
    /// Viscous damping, N·m·s/rad or N·s/m.
    pub damping: f64,
    /// Spring stiffness, N·m/rad or N/m.
    pub stiffness: f64,
    /// Coordinate at which the spring is relaxed, rad or m.
    pub rest: f64,
}

impl Joint {
    /// A revolute joint about `axis` (joint frame) placed at `placement`, without damping or spring.
    pub fn revolute(axis: Vector3<f64>, placement: RigidTransform) -> Self {
        Self { kind: JointKind::Revolute, axis, placement, damping: 0.0, stiffness: 0.0, rest: 0.0 }
    }

    /// A prismatic joint along `axis` (joint frame) placed at `placement`, without damping or spring.
    pub fn prismatic(axis: Vector3<f64>, placement: RigidTransform) -> Self {
        Self { kind: JointKind::Prismatic, ..Self::revolute(axis, placement) }
    }

    /// The same joint with viscous damping (N·m·s/rad or N·s/m).
    pub fn with_damping(self, damping: f64) -> Self {
        Self { damping, ..self }
    }

    /// The same joint with a spring (N·m/rad or N/m) relaxed at `rest` (rad or m).
    pub fn with_spring(self, stiffness: f64, rest: f64) -> Self {
        Self { stiffness, rest, ..self }
    }

    /// Motion of the joint: pose of the link frame in the joint frame at coordinate `q`.
    pub fn motion(&self, q: f64) -> RigidTransform {
        match self.kind {
            JointKind::Revolute => RigidTransform {
                rotation: crate::spatial::exp_rotation(&(self.axis * q)),
                translation: Vector3::zeros(),
            },
            JointKind::Prismatic => RigidTransform::from_translation(self.axis * q),
        }
    }
}

/// Mass distribution of one link.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LinkInertia {
    /// Mass, kg.
    pub mass: f64,
    /// Mass centre in the link frame, m.
    pub com: Vector3<f64>,
    /// Inertia about the mass centre, axes parallel to the link frame, kg·m².
    pub inertia: Matrix3<f64>,
}

impl LinkInertia {
    /// No mass at all (legal for intermediate bodies).
    pub fn massless() -> Self {
        Self { mass: 0.0, com: Vector3::zeros(), inertia: Matrix3::zeros() }
    }

    /// From mass (kg), mass centre (m) and inertia about it (kg·m²).
    pub fn new(mass: f64, com: Vector3<f64>, inertia: Matrix3<f64>) -> Self {
        Self { mass, com, inertia }
    }

    /// About the origin of the link frame.
    pub fn spatial(&self) -> SpatialInertia {
        SpatialInertia::from_central(self.mass, &self.com, &self.inertia)
    }
}

/// One body of the tree as the builder takes it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Body {
    /// Index of the parent body; `None` for a body that hangs on {0}.
    pub parent: Option<usize>,
    /// The joint to the parent. Ignored for a floating base.
    pub joint: Joint,
    /// Mass distribution.
    pub inertia: LinkInertia,
    /// Diagonal body drag: the wrench `-drag ∘ v_b` acts at the mass centre (link axes), N·m·s/rad and N·s/m.
    pub drag: Vector6<f64>,
    /// Constant wrench at the mass centre in link axes.
    pub constant_wrench_b: Wrench,
}

impl Body {
    /// A body without drag or constant wrench.
    pub fn new(parent: Option<usize>, joint: Joint, inertia: LinkInertia) -> Self {
        Self { parent, joint, inertia, drag: Vector6::zeros(), constant_wrench_b: Wrench::default() }
    }
}

/// How the tree is attached to the world.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Base {
    /// Roots hang on {0} by their own joints.
    Fixed,
    /// Body 0 floats freely; see [`crate::floating_base`].
    Floating,
}

/// Builds a [`KinematicTree`] and checks every body.
#[derive(Clone, Debug)]
pub struct TreeBuilder {
    base: Base,
    gravity_w: Vector3<f64>,
    bodies: Vec<Body>,
    ground_inertia_w: SpatialInertia,
    accept_unreal_inertia: bool,
}

impl TreeBuilder {
    /// A tree whose roots hang on {0}. Gravity is in frame {0}, m/s².
    pub fn fixed_base(gravity_w: Vector3<f64>) -> Self {
        Self {
            base: Base::Fixed,
            gravity_w,
            bodies: Vec::new(),
            ground_inertia_w: SpatialInertia::default(),
            accept_unreal_inertia: false,
        }
    }

    /// A tree whose body 0 floats, with the given mass distribution. Gravity is in frame {0}, m/s².
    pub fn floating_base(gravity_w: Vector3<f64>, base: LinkInertia) -> Self {
        let joint = Joint::revolute(Vector3::z(), RigidTransform::identity());
        let body = Body::new(None, joint, base);
        Self { base: Base::Floating, bodies: vec![body], ..Self::fixed_base(gravity_w) }
    }

    /// Adds a body and returns its index.
    pub fn add(&mut self, body: Body) -> usize {
        self.bodies.push(body);
        self.bodies.len() - 1
    }

    /// Drag and constant wrench of the floating base (link axes, at its mass centre).
    pub fn set_base_wrenches(&mut self, drag: Vector6<f64>, constant_wrench_b: Wrench) {
        if let (Base::Floating, Some(base)) = (self.base, self.bodies.first_mut()) {
            base.drag = drag;
            base.constant_wrench_b = constant_wrench_b;
        }
    }

    /// Mass that is welded to {0} (a stance foot): it counts in total mass and mass centre, not in the motion.
    pub fn set_ground_inertia(&mut self, inertia_w: SpatialInertia) {
        self.ground_inertia_w = inertia_w;
    }

    /// Accepts inertias that break the triangle inequality: no real body has them, but the mathematics goes through.
    pub fn accept_unreal_inertia(&mut self) {
        self.accept_unreal_inertia = true;
    }

    /// Checks everything and freezes the model.
    ///
    /// # Errors
    /// The first rule broken, with the body's index.
    pub fn build(self) -> Result<KinematicTree, ModelError> {
        if self.bodies.is_empty() {
            return Err(ModelError::Empty);
        }
        if !self.gravity_w.iter().all(|x| x.is_finite()) {
            return Err(ModelError::NotFinite { body: 0, quantity: "gravity" });
        }
        for (index, body) in self.bodies.iter().enumerate() {
            let is_base = index == 0 && self.base == Base::Floating;
            check_body(index, body, is_base, self.accept_unreal_inertia)?;
            if self.base == Base::Floating && index > 0 && body.parent.is_none() {
                return Err(ModelError::Unsupported {
                    body: index,
                    reason: "a floating tree has one root: every other body needs a parent",
                });
            }
        }
        KinematicTree::assemble(self)
    }
}

/// Round-off allowed in unit vectors, rotations and symmetric matrices of a model file with about 10 digits.
const MODEL_ROUND_OFF: f64 = 1e-9;

fn check_body(index: usize, body: &Body, is_base: bool, accept_unreal: bool) -> Result<(), ModelError> {
    let finite = |values: &[f64], quantity| {
        if values.iter().all(|x| x.is_finite()) {
            Ok(())
        } else {
            Err(ModelError::NotFinite { body: index, quantity })
        }
    };
    let LinkInertia { mass, com, inertia } = &body.inertia;
    finite(&[*mass], "mass")?;
    finite(com.as_slice(), "mass centre")?;
    finite(inertia.as_slice(), "inertia")?;
    finite(body.drag.as_slice(), "drag")?;
    finite(body.constant_wrench_b.to_vector().as_slice(), "constant wrench")?;
    if *mass < 0.0 {
        return Err(ModelError::NegativeMass { body: index, mass: *mass });
    }
    check_inertia(index, *mass, inertia, accept_unreal)?;
    if let Some(&coefficient) = body.drag.iter().find(|&&c| c < 0.0) {
        return Err(ModelError::NegativeDrag { body: index, coefficient });
    }
    if is_base {
        return Ok(());
    }
    let joint = &body.joint;
    finite(joint.axis.as_slice(), "joint axis")?;
    finite(joint.placement.rotation.as_slice(), "placement rotation")?;
    finite(joint.placement.translation.as_slice(), "placement translation")?;
    finite(&[joint.damping], "joint damping")?;
    finite(&[joint.stiffness, joint.rest], "joint spring")?;
    let length = joint.axis.norm();
    if (length - 1.0).abs() > MODEL_ROUND_OFF {
        return Err(ModelError::AxisNotUnit { body: index, length });
    }
    let rotation = &joint.placement.rotation;
    let defect = (rotation.tr_mul(rotation) - Matrix3::identity()).amax();
    if defect > MODEL_ROUND_OFF || rotation.determinant() < 0.0 {
        let defect = if rotation.determinant() < 0.0 { f64::INFINITY } else { defect };
        return Err(ModelError::PlacementNotRotation { body: index, defect });
    }
    if joint.damping < 0.0 {
        return Err(ModelError::NegativeDamping { body: index, damping: joint.damping });
    }
    match body.parent {
        Some(parent) if parent >= index => Err(ModelError::ParentAfterChild { body: index, parent }),
        _ => Ok(()),
    }
}

fn check_inertia(
    index: usize,
    mass: f64,
    inertia: &Matrix3<f64>,
    accept_unreal: bool,
) -> Result<(), ModelError> {
    let scale = inertia.amax();
    let defect = (inertia - inertia.transpose()).amax();
    if defect > MODEL_ROUND_OFF * scale {
        return Err(ModelError::InertiaNotSymmetric { body: index, defect });
    }
    if mass == 0.0 && scale > 0.0 {
        return Err(ModelError::InertiaWithoutMass { body: index });
    }
    let mut moments = inertia.symmetric_eigenvalues();
    moments.as_mut_slice().sort_unstable_by(f64::total_cmp);
    if moments[0] < -MODEL_ROUND_OFF * scale {
        return Err(ModelError::InertiaNotPositive { body: index, moment: moments[0] });
    }
    let excess = moments[2] - moments[1] - moments[0];
    // Real model files round their entries: a thin rod may sit on the boundary.
    if excess > 1e-6 * scale && !accept_unreal {
        return Err(ModelError::InertiaTriangle { body: index, excess });
    }
    Ok(())
}

/// Constants of one body in the form the recursions use; all lengths refer to mass centres.
#[derive(Clone, Debug)]
pub(crate) struct BodyConstants {
    /// Parent index, `NO_PARENT` for a root.
    pub parent: usize,
    pub revolute: bool,
    /// Rotation to the parent's axes is `e0 + sin q e1 + (1 - cos q) e2` (row-major; prismatic: `e0`).
    pub e0: [f64; 9],
    pub e1: [f64; 9],
    pub e2: [f64; 9],
    /// Joint origin from the parent's mass centre, parent axes.
    pub joint_origin: [f64; 3],
    /// Joint axis in the parent's axes (the joint does not change it).
    pub axis: [f64; 3],
    /// Mass centre from the joint origin, own axes.
    pub com: [f64; 3],
    pub mass: f64,
    /// Mass of the body and all it carries.
    pub subtree_mass: f64,
    /// Inertia about the mass centre, own axes: xx, yy, zz, xy, xz, yz.
    pub inertia: [f64; 6],
    pub damping: f64,
    pub stiffness: f64,
    pub rest: f64,
    pub drag: Option<[f64; 6]>,
    pub constant_wrench: Option<[f64; 6]>,
}

/// Parent index of a body that hangs on {0}.
pub(crate) const NO_PARENT: usize = usize::MAX;

/// An immutable, checked tree of rigid bodies. Build it with [`TreeBuilder`].
#[derive(Clone, Debug)]
pub struct KinematicTree {
    base: Base,
    gravity_w: Vector3<f64>,
    bodies: Vec<Body>,
    ground_inertia_w: SpatialInertia,
    accepts_unreal_inertia: bool,
    constants: Vec<BodyConstants>,
    /// Coordinates on the branch of every joint body, root first, itself last, one after the other.
    paths: Vec<u32>,
    path_starts: Vec<usize>,
}

impl KinematicTree {
    /// Whether it was built with [`TreeBuilder::accept_unreal_inertia`]: trees made from it have to be, too.
    pub fn accepts_unreal_inertia(&self) -> bool {
        self.accepts_unreal_inertia
    }

    fn assemble(builder: TreeBuilder) -> Result<Self, ModelError> {
        let TreeBuilder { base, gravity_w, bodies, ground_inertia_w, accept_unreal_inertia } = builder;
        let mut subtree_mass: Vec<f64> = bodies.iter().map(|b| b.inertia.mass).collect();
        for i in (1..bodies.len()).rev() {
            if let Some(parent) = bodies[i].parent {
                subtree_mass[parent] += subtree_mass[i];
            }
        }
        if let Some(body) = subtree_mass.iter().position(|&m| m <= 0.0) {
            return Err(ModelError::MasslessSubtree { body });
        }
        let constants = bodies
            .iter()
            .zip(&subtree_mass)
            .map(|(body, &mass)| body_constants(&bodies, body, mass))
            .collect();
        let mut tree = Self {
            base,
            gravity_w,
            ground_inertia_w,
            accepts_unreal_inertia: accept_unreal_inertia,
            constants,
            paths: Vec::new(),
            path_starts: vec![0],
            bodies,
        };
        for i in 0..tree.bodies.len() {
            let start = tree.paths.len();
            if tree.is_base(i) {
                tree.paths.extend(0..6);
            } else {
                if let Some(parent) = tree.bodies[i].parent {
                    let (from, to) = (tree.path_starts[parent], tree.path_starts[parent + 1]);
                    tree.paths.extend_from_within(from..to);
                }
                tree.paths.push(tree.joint_dof(i) as u32);
            }
            debug_assert!(tree.paths.len() > start);
            tree.path_starts.push(tree.paths.len());
        }
        Ok(tree)
    }

    /// Fixed or floating.
    pub fn base(&self) -> Base {
        self.base
    }

    /// Whether body 0 floats.
    pub fn is_floating(&self) -> bool {
        self.base == Base::Floating
    }

    /// Whether `body` is the floating base.
    #[inline(always)]
    pub(crate) fn is_base(&self, body: usize) -> bool {
        body == 0 && self.is_floating()
    }

    /// Gravity in frame {0}, m/s².
    pub fn gravity_w(&self) -> &Vector3<f64> {
        &self.gravity_w
    }

    /// The same tree under another gravity (frame {0}, m/s²).
    pub fn with_gravity(&self, gravity_w: Vector3<f64>) -> Self {
        Self { gravity_w, ..self.clone() }
    }

    /// The bodies as given.
    pub fn bodies(&self) -> &[Body] {
        &self.bodies
    }

    /// Number of bodies, a floating base included.
    pub fn body_count(&self) -> usize {
        self.bodies.len()
    }

    /// Number of joints: bodies without a floating base.
    pub fn joint_count(&self) -> usize {
        self.bodies.len() - usize::from(self.is_floating())
    }

    /// Number of generalised coordinates per node: joints, plus 6 for a floating base.
    pub fn dof(&self) -> usize {
        self.joint_count() + self.base_dof()
    }

    /// 6 for a floating base, else 0.
    #[inline(always)]
    pub fn base_dof(&self) -> usize {
        if self.is_floating() { 6 } else { 0 }
    }

    /// Generalised coordinate of the joint of `body` (which must not be a floating base).
    #[inline(always)]
    pub fn joint_dof(&self, body: usize) -> usize {
        if self.is_floating() { body + 5 } else { body }
    }

    /// Index of the first body with a joint: 1 behind a floating base, else 0.
    #[inline(always)]
    pub fn first_joint_body(&self) -> usize {
        usize::from(self.is_floating())
    }

    /// Generalised coordinates on the branch from the root to `body`, root first, its own last.
    #[inline(always)]
    pub fn branch(&self, body: usize) -> &[u32] {
        &self.paths[self.path_starts[body]..self.path_starts[body + 1]]
    }

    /// Mass welded to {0}, about the origin of {0}.
    pub fn ground_inertia_w(&self) -> &SpatialInertia {
        &self.ground_inertia_w
    }

    /// Total mass, kg, the mass welded to the ground included.
    pub fn total_mass(&self) -> f64 {
        self.bodies.iter().map(|b| b.inertia.mass).sum::<f64>() + self.ground_inertia_w.mass
    }

    /// Whether any body feels drag (a wrench that depends on velocity).
    pub fn has_drag(&self) -> bool {
        self.constants.iter().any(|c| c.drag.is_some())
    }

    /// Whether any body feels drag or a constant wrench.
    pub(crate) fn has_body_wrenches(&self) -> bool {
        self.has_drag() || self.constants.iter().any(|c| c.constant_wrench.is_some())
    }

    #[inline(always)]
    pub(crate) fn constants(&self) -> &[BodyConstants] {
        &self.constants
    }
}

fn body_constants(bodies: &[Body], body: &Body, subtree_mass: f64) -> BodyConstants {
    let joint = &body.joint;
    let placement = &joint.placement;
    let parent_com = body.parent.map_or_else(Vector3::zeros, |p| bodies[p].inertia.com);
    let axis_cross = skew(&joint.axis);
    let (e1, e2) = match joint.kind {
        JointKind::Revolute => {
            (placement.rotation * axis_cross, placement.rotation * axis_cross * axis_cross)
        }
        JointKind::Prismatic => (Matrix3::zeros(), Matrix3::zeros()),
    };
    let i = &body.inertia.inertia;
    let row_major = |m: Matrix3<f64>| {
        let t = m.transpose();
        let mut out = [0.0; 9];
        out.copy_from_slice(t.as_slice());
        out
    };
    let nonzero = |v: Vector6<f64>| (v.amax() > 0.0).then(|| v.into());
    BodyConstants {
        parent: body.parent.unwrap_or(NO_PARENT),
        revolute: joint.kind == JointKind::Revolute,
        e0: row_major(placement.rotation),
        e1: row_major(e1),
        e2: row_major(e2),
        joint_origin: (placement.translation - parent_com).into(),
        axis: (placement.rotation * joint.axis).into(),
        com: body.inertia.com.into(),
        mass: body.inertia.mass,
        subtree_mass,
        inertia: [i[(0, 0)], i[(1, 1)], i[(2, 2)], i[(0, 1)], i[(0, 2)], i[(1, 2)]],
        damping: joint.damping,
        stiffness: joint.stiffness,
        rest: joint.rest,
        drag: nonzero(body.drag),
        constant_wrench: nonzero(body.constant_wrench_b.to_vector()),
    }
}
