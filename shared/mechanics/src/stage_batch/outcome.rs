//! What became of a stage: the marks of a vector of stages read lane by lane, and the reason where one is bad.

use super::StageReport;
use super::memory::{Batch, END, Scratch};
use super::plan::Plan;
use crate::errors::{FactorError, ModelError, StepError};
use crate::stage_lanes::{LARGEST_ANGLE, StageKernel, StageMemory, StageSimd, Stages, load};

/// A pivot block whose determinant is below this part of its two products counts as singular.
const SINGULAR_BLOCK: f64 = 1e-13;
/// Pivots of the mass matrix below this part of the diagonal entry they came from count as zero.
const SINGULAR_MASS: f64 = 1e-14;

/// What [`super::StageBatch::outcome`] is made of, for all stages of a vector.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Marks<M> {
    /// Largest absolute residual and correction of the nodes.
    pub residual: M,
    pub change: M,
    /// Zero when everything is finite, otherwise NaN.
    pub finite: M,
    /// Largest absolute coordinate of a node.
    pub coordinate: M,
    /// Largest ratio of the products in the determinant of a pivot block to the determinant.
    pub block: M,
    /// Largest ratio of the diagonal of the mass matrix to its pivot.
    pub mass: M,
}

/// Takes the marks of one vector of stages; `full` after a linearisation.
pub(crate) struct Examine<'a, M> {
    pub plan: &'a Plan,
    pub batch: &'a Batch<M>,
    pub scratch: &'a Scratch<M>,
    pub marks: &'a mut Marks<M>,
    pub full: bool,
}

impl<M: StageMemory> StageKernel<M> for Examine<'_, M> {
    #[inline(always)]
    fn run<S: StageSimd<Memory = M>>(self, simd: S) {
        let Self { plan, batch, scratch, marks, full } = self;
        let zero = Stages::splat(simd, 0.0);
        let (mut residual, mut change, mut coordinate, mut block, mut mass) = (zero, zero, zero, zero, zero);
        let mut finite = zero;
        for i in 0..plan.n {
            for alpha in 0..3 {
                let q = Stages::load(simd, &batch.nodes[alpha][i]);
                coordinate = coordinate.max_abs(q);
                finite = zero.mul_add(q, finite);
            }
            let [first, second] = load(simd, &batch.residual[i]);
            residual = residual.max_abs(first).max_abs(second);
            let [middle, end, rate] = load(simd, &batch.correction[i]);
            change = change.max_abs(middle).max_abs(end);
            let [determinant, product, pivot, diagonal] = load(simd, &batch.pivots[i]);
            let other = product - determinant;
            block = block.max_abs(product / determinant).max_abs(other / determinant);
            // In pairs: the sum of finite numbers may overflow, their products with zero do not.
            finite = zero.mul_add(first, zero.mul_add(second, finite));
            finite = zero.mul_add(middle, zero.mul_add(end, finite));
            finite = zero.mul_add(determinant, zero.mul_add(product / determinant, finite));
            finite = zero.mul_add(Stages::load(simd, &batch.start_rate[i]), finite);
            finite = zero.mul_add(Stages::load(simd, &batch.force[i]), finite);
            if full {
                mass = mass.max_abs(diagonal / pivot);
                // 2 / SINGULAR_MASS for a negative pivot, otherwise zero.
                mass = mass.max_abs(((pivot - zero.max_abs(pivot)) / pivot).times(1.0 / SINGULAR_MASS));
                finite = zero.mul_add(rate, zero.mul_add(pivot, finite));
                finite = zero.mul_add(diagonal / pivot, finite);
                finite = zero.mul_add(Stages::load(simd, &batch.end_rate[i]), finite);
                // Momenta of the true velocities, which the columns contain but the residual does not.
                let (start, end) = (&batch.start[i].by_q, &scratch.b[END][i]);
                for k in 0..6 {
                    finite = zero.mul_add(Stages::load(simd, &start[k]), finite);
                    finite = zero.mul_add(Stages::load(simd, &end[k]), finite);
                }
            }
        }
        marks.residual = residual.store();
        marks.change = change.store();
        marks.finite = finite.store();
        marks.coordinate = coordinate.store();
        marks.block = block.store();
        marks.mass = mass.store();
    }
}

/// Fills the outcomes of the stages of a vector from their marks.
pub(crate) fn judge<'a, M: StageMemory>(
    plan: &Plan,
    batch: &Batch<M>,
    marks: &Marks<M>,
    outcomes: impl Iterator<Item = &'a mut Result<StageReport, StepError>>,
    full: bool,
) {
    for (lane, outcome) in outcomes.enumerate() {
        let at = |x: &M| x.lanes()[lane];
        let finite = at(&marks.finite) == 0.0;
        let good = finite
            && at(&marks.coordinate) <= LARGEST_ANGLE
            && at(&marks.block) < 1.0 / SINGULAR_BLOCK
            && at(&marks.mass) < 1.0 / SINGULAR_MASS;
        let report = StageReport { residual: at(&marks.residual), change: at(&marks.change) };
        let verdict = if good { Ok(()) } else { verdict(plan, batch, lane, full, finite) };
        *outcome = verdict.map(|()| report);
    }
}

/// What is wrong with a stage, inputs first.
fn verdict<M: StageMemory>(
    plan: &Plan,
    batch: &Batch<M>,
    lane: usize,
    full: bool,
    finite: bool,
) -> Result<(), StepError> {
    let at = |x: &M| x.lanes()[lane];
    let bad = |entries: &[M]| entries.iter().any(|x| !at(x).is_finite());
    for (i, constants) in plan.tree.constants().iter().enumerate() {
        let far = |q: f64| q.is_finite() && q.abs() > LARGEST_ANGLE;
        if constants.revolute && batch.nodes.iter().any(|node| far(at(&node[i]))) {
            let reason = "a joint angle is beyond 1e6 rad";
            return Err(ModelError::Unsupported { body: i, reason }.into());
        }
    }
    let first = |quantity, values: &[M]| match values.iter().position(|x| !at(x).is_finite()) {
        Some(index) => Err(StepError::NonFinite { quantity, index }),
        None => Ok(()),
    };
    first("start node", &batch.nodes[0])?;
    first("interior node", &batch.nodes[1])?;
    first("end node", &batch.nodes[2])?;
    first("start velocity", &batch.start_rate)?;
    first("held joint force", &batch.force)?;
    let residual = batch.residual.iter().position(|r| bad(r));
    if let Some(index) = residual {
        return Err(StepError::NonFinite { quantity: "DEL residual (joint)", index });
    }
    // Leaves first, as the elimination goes. Written so that a NaN counts as singular.
    for body in (0..plan.n).rev() {
        let [determinant, product, mass, diagonal] = batch.pivots[body].map(|x| at(&x));
        let size = product.abs() + (product - determinant).abs();
        let regular = determinant.abs() > SINGULAR_BLOCK * size;
        if !regular {
            return Err(FactorError::SingularPivot { body, pivot: determinant.abs() }.into());
        }
        let positive = mass > SINGULAR_MASS * diagonal.abs();
        if full && !positive {
            return Err(FactorError::SingularPivot { body, pivot: mass }.into());
        }
    }
    // What is left: coordinates beyond 1e6 m of slides, which are none of our business, and overflow.
    if finite {
        return Ok(());
    }
    let index = batch.correction.iter().position(|entries| bad(entries)).unwrap_or(0);
    Err(StepError::NonFinite { quantity: "correction or momentum (joint)", index })
}
