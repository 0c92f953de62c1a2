//! Everything that can go wrong, as values: what, where, how much.

/// Why a model, an order or an argument was refused. Bodies and joints are named by index (0-based, in the tree's order).
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum ModelError {
    /// The processor lacks AVX2 or fused multiply-add and the crate was built without code for it.
    #[error(
        "this processor has no AVX2 with fused multiply-add: build delmpc-mechanics with the feature `portable`"
    )]
    Processor,
    /// Number of unknown nodes outside `1..=limit`.
    #[error("{unknown_nodes} unknown nodes per step are not supported: use 1 to {limit}")]
    UnsupportedOrder {
        /// What was asked for.
        unknown_nodes: usize,
        /// The largest supported number.
        limit: usize,
    },
    /// A number of the model is NaN or infinite.
    #[error("body {body}: {quantity} is not finite")]
    NotFinite {
        /// Body index.
        body: usize,
        /// Which quantity.
        quantity: &'static str,
    },
    /// The joint axis is not a unit vector.
    #[error("body {body}: the joint axis has length {length}, it must be 1 (normalise it)")]
    AxisNotUnit {
        /// Body index.
        body: usize,
        /// Length found.
        length: f64,
    },
    /// The rotation of the joint placement is not a rotation matrix.
    #[error("body {body}: the placement's rotation is off orthonormal by {defect:e} (or mirrored)")]
    PlacementNotRotation {
        /// Body index.
        body: usize,
        /// Largest entry of `RᵀR - 1`, or infinity for a reflection.
        defect: f64,
    },
    /// Negative mass.
    #[error("body {body}: mass {mass} kg is negative")]
    NegativeMass {
        /// Body index.
        body: usize,
        /// Mass, kg.
        mass: f64,
    },
    /// The rotational inertia is not symmetric.
    #[error(
        "body {body}: the inertia about the mass centre is not symmetric (largest difference {defect:e} kg·m²)"
    )]
    InertiaNotSymmetric {
        /// Body index.
        body: usize,
        /// Largest difference of mirrored entries.
        defect: f64,
    },
    /// A principal moment of inertia is negative.
    #[error("body {body}: smallest principal moment of inertia {moment:e} kg·m² is negative")]
    InertiaNotPositive {
        /// Body index.
        body: usize,
        /// The offending principal moment.
        moment: f64,
    },
    /// The principal moments break `I1 + I2 >= I3`: no mass distribution has them.
    #[error(
        "body {body}: principal moments break the triangle inequality by {excess:e} kg·m²; no real body has them"
    )]
    InertiaTriangle {
        /// Body index.
        body: usize,
        /// `I3 - I1 - I2`.
        excess: f64,
    },
    /// A body without mass but with inertia.
    #[error("body {body}: no mass but rotational inertia; give it a mass")]
    InertiaWithoutMass {
        /// Body index.
        body: usize,
    },
    /// A joint that moves no mass at all: the mass matrix would be singular.
    #[error("body {body}: neither it nor any body it carries has mass; its joint cannot be simulated")]
    MasslessSubtree {
        /// Body index.
        body: usize,
    },
    /// The parent has an index that is not smaller than the body's own.
    #[error("body {body}: parent {parent} must come before its child")]
    ParentAfterChild {
        /// Body index.
        body: usize,
        /// Parent index given.
        parent: usize,
    },
    /// A joint's damping is negative.
    #[error("body {body}: joint damping {damping} is negative")]
    NegativeDamping {
        /// Body index.
        body: usize,
        /// Damping given.
        damping: f64,
    },
    /// A body drag coefficient is negative.
    #[error("body {body}: drag coefficient {coefficient} is negative")]
    NegativeDrag {
        /// Body index.
        body: usize,
        /// Coefficient given.
        coefficient: f64,
    },
    /// A tree of no bodies.
    #[error("the tree has no bodies")]
    Empty,
    /// The time step is not a positive finite number.
    #[error("time step {time_step} s is not a positive finite number")]
    TimeStep {
        /// The step given, s.
        time_step: f64,
    },
    /// A slice has the wrong length.
    #[error("{quantity} has {got} entries, {expected} are needed")]
    Length {
        /// Which argument.
        quantity: &'static str,
        /// Entries given.
        got: usize,
        /// Entries needed.
        expected: usize,
    },
    /// An operation is not defined for this kind of base or body index.
    #[error("{reason} (body {body})")]
    Unsupported {
        /// Body index it concerns.
        body: usize,
        /// What is not possible.
        reason: &'static str,
    },
}

/// Why a factorisation of the Newton matrix failed.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum FactorError {
    /// The pivot block of a body is singular to working precision.
    #[error("the pivot block of body {body} is singular (smallest pivot {pivot:e})")]
    SingularPivot {
        /// Body whose block is singular.
        body: usize,
        /// Magnitude of the smallest pivot met.
        pivot: f64,
    },
}

/// Why a step was not taken. The state is untouched.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum StepError {
    /// Newton's method did not converge.
    #[error(
        "Newton's method stopped after {iterations} iterations with a last change of {change:e} and residual {residual:e}"
    )]
    NotConverged {
        /// Largest absolute entry of the residual at the last iterate.
        residual: f64,
        /// Largest absolute entry of the last change of the nodes.
        change: f64,
        /// Iterations made.
        iterations: usize,
    },
    /// The Newton matrix could not be factorised, not even with pivoting.
    #[error(transparent)]
    Singular(#[from] FactorError),
    /// An input or an intermediate value is NaN or infinite.
    #[error("{quantity} is not finite at index {index}")]
    NonFinite {
        /// Which quantity.
        quantity: &'static str,
        /// Index in it.
        index: usize,
    },
    /// Newton converged to a solution that is not the continuation of the motion.
    #[error(
        "coordinate {dof} ends {change} rad from its extrapolation (limit {limit}): a spurious solution; use a smaller time step"
    )]
    SpuriousSolution {
        /// Coordinate index.
        dof: usize,
        /// Its distance from the guess (a floating base: its rotation), rad.
        change: f64,
        /// The largest change accepted.
        limit: f64,
    },
    /// Constraints that depend on each other, or contradict the state.
    #[error("constraint row {row} depends on the others (pivot {pivot:e} relative to the largest): drop it")]
    RedundantConstraint {
        /// Row index.
        row: usize,
        /// Relative pivot met.
        pivot: f64,
    },
    /// An argument has the wrong shape or an unusable value.
    #[error(transparent)]
    Argument(#[from] ModelError),
}
