//! The root of a floating tree in Algorithm B.1: `6 s` columns at once; letters as in [`super`] and [`crate::floating_base`].

use alloc::vec;
use alloc::vec::Vec;
use nalgebra::Matrix6;

use super::{Interface, MAX_NODES, RecursiveNewton};
use crate::del_residual::DelWorkspace;
use crate::dense_lu::DenseLu;
use crate::errors::FactorError;
use crate::lanes::{Kernel, LANES, Quad, Simd, splat, store};
use crate::newton_direction::{base_matrix, held_rows_matrix, second_order_matrix};
use crate::spatial::{Twist, Wrench};

/// The root block of a floating tree.
#[derive(Clone, Debug)]
pub(super) struct BaseRoot {
    lu: DenseLu,
    /// `C_1ᵀ`: `6 s` output rows; `B_1ᵀ`: `6 s` input rows; scalar, row-major.
    c: Vec<f64>,
    b: Vec<f64>,
    rhs: Vec<f64>,
}

impl BaseRoot {
    /// For `order` = `6 s` columns; 0 for a fixed base. Allocates.
    pub fn new(order: usize, shape: &Interface) -> Self {
        Self {
            lu: DenseLu::new(order),
            c: vec![0.0; order * shape.outputs()],
            b: vec![0.0; order * shape.inputs()],
            rhs: vec![0.0; order],
        }
    }
}

/// The base as root: `6 s` columns, dense.
impl RecursiveNewton {
    pub(super) fn factor_base(&mut self, del: &DelWorkspace) -> Result<(), FactorError> {
        let shape = self.shape;
        let (s, ni, no) = (shape.s, shape.inputs(), shape.outputs());
        let order = 6 * s;
        let nodes = BaseNodes::new(del);
        nodes.fill_b(del, &shape, &mut self.base.b);
        nodes.fill_c(del, &shape, &mut self.base.c);
        let start = self.slot_of[0] * no * self.input_quads;
        let y = |row: usize, column: usize| {
            self.slots[start + row * self.input_quads + column / LANES].0[column % LANES]
        };
        let entries = self.base.lu.entries_mut();
        let mut k_row = [0.0; 12 * MAX_NODES];
        for row in 0..order {
            for (column, k) in k_row.iter_mut().enumerate().take(ni) {
                *k = (0..no).map(|r| self.base.c[row * no + r] * y(r, column)).sum();
            }
            nodes.add_e(del, &shape, row, &mut k_row);
            for column in 0..order {
                entries[row * order + column] =
                    (0..ni).map(|j| k_row[j] * self.base.b[column * ni + j]).sum();
            }
        }
        nodes.add_t(del, s, entries);
        for alpha in 0..s {
            let held = held_rows_matrix(del, alpha);
            for k in 0..6 {
                for l in 0..6 {
                    entries[(k * s + alpha) * order + l * s + s - 1] -= held[(k, l)];
                }
            }
        }
        self.base.lu.factor().map_err(|(_, pivot)| FactorError::SingularPivot { body: 0, pivot })
    }

    pub(super) fn solve_base(&mut self, rhs: &mut [f64]) {
        let shape = self.shape;
        let (s, ni, no) = (shape.s, shape.inputs(), shape.outputs());
        let root = &mut self.base;
        for row in 0..6 * s {
            let pushed: f64 =
                (0..no).map(|r| root.c[row * no + r] * self.outputs[r / LANES].0[r % LANES]).sum();
            root.rhs[row] = rhs[row] - pushed;
        }
        root.lu.solve(&mut root.rhs);
        rhs[..6 * s].copy_from_slice(&root.rhs);
        for j in 0..ni {
            self.inputs[j / LANES].0[j % LANES] =
                (0..6 * s).map(|column| root.b[column * ni + j] * root.rhs[column]).sum();
        }
    }

    pub(super) fn solve_base_transposed(&mut self, rhs: &mut [f64]) {
        let shape = self.shape;
        let (s, ni, no) = (shape.s, shape.inputs(), shape.outputs());
        let root = &mut self.base;
        for column in 0..6 * s {
            let pulled: f64 =
                (0..ni).map(|j| root.b[column * ni + j] * self.inputs[j / LANES].0[j % LANES]).sum();
            root.rhs[column] = rhs[column] + pulled;
        }
        root.lu.solve_transposed(&mut root.rhs);
        rhs[..6 * s].copy_from_slice(&root.rhs);
        self.outputs[..self.output_quads].fill(Quad::ZERO);
        for r in 0..no {
            self.outputs[r / LANES].0[r % LANES] =
                -(0..6 * s).map(|row| root.c[row * no + r] * root.rhs[row]).sum::<f64>();
        }
    }
}

/// `S, Ṡ, N, Ṅ` and wrenches of the base at every node.
struct BaseNodes {
    twist: [Matrix6<f64>; MAX_NODES],
    rate: [Matrix6<f64>; MAX_NODES],
    momentum: [Wrench; MAX_NODES],
    impulse: [Wrench; MAX_NODES],
}

impl BaseNodes {
    fn new(del: &DelWorkspace) -> Self {
        let mut nodes = Self {
            twist: [Matrix6::zeros(); MAX_NODES],
            rate: [Matrix6::zeros(); MAX_NODES],
            momentum: [Wrench::default(); MAX_NODES],
            impulse: [Wrench::default(); MAX_NODES],
        };
        for alpha in 0..=del.unknown_nodes() {
            nodes.twist[alpha] = base_matrix(del, alpha);
            nodes.rate[alpha] = base_rate_matrix(del, alpha);
            (nodes.momentum[alpha], nodes.impulse[alpha]) = del.body_momentum_and_impulse(0, alpha);
        }
        nodes
    }

    /// `δξ^β = c X` for the column block γ.
    fn follow(beta: usize, gamma: usize, s: usize) -> f64 {
        let mut c = 0.0;
        if beta == gamma {
            c += 1.0;
        }
        if beta == 0 && gamma == s {
            c -= 1.0;
        }
        c
    }

    /// `δξ̇^β = d X` for the column block γ.
    fn slope(del: &DelWorkspace, beta: usize, gamma: usize) -> f64 {
        let mut d = del.rule.derivative(beta, gamma);
        if gamma == del.unknown_nodes() {
            d -= del.rule.derivative(beta, 0);
        }
        d / del.time_step
    }

    fn fill_b(&self, del: &DelWorkspace, shape: &Interface, b: &mut [f64]) {
        let (s, ni) = (shape.s, shape.inputs());
        b.fill(0.0);
        for k in 0..6 {
            for gamma in 1..=s {
                let row = &mut b[(k * s + gamma - 1) * ni..][..ni];
                for node in 1..s {
                    let mut column = self.twist[node].column(k) * Self::follow(node, gamma, s);
                    if gamma == s {
                        column += self.twist[0].column(k);
                    }
                    for r in 0..shape.eta {
                        row[shape.eta_at(node) + r] = column[r];
                    }
                }
                for beta in 0..=s {
                    let column = self.twist[beta].column(k) * Self::slope(del, beta, gamma)
                        + self.rate[beta].column(k) * Self::follow(beta, gamma, s);
                    for r in 0..6 {
                        row[shape.nu_at(beta, r)] = column[r];
                    }
                }
            }
        }
    }

    fn fill_c(&self, del: &DelWorkspace, shape: &Interface, c: &mut [f64]) {
        let (s, no) = (shape.s, shape.outputs());
        let rule = &del.rule;
        let step = |alpha: usize| rule.weights()[alpha] * del.time_step;
        c.fill(0.0);
        for k in 0..6 {
            for alpha in 0..s {
                let row = &mut c[(k * s + alpha) * no..][..no];
                for beta in 0..=s {
                    let mut factor = rule.weighted_derivative(alpha, beta);
                    let mut rate = if beta == alpha { step(alpha) } else { 0.0 };
                    if alpha == 0 {
                        factor -= rule.weighted_derivative(s, beta);
                        if beta == s {
                            rate -= step(s);
                        }
                    }
                    let column = self.twist[beta].column(k) * factor + self.rate[beta].column(k) * rate;
                    for r in 0..6 {
                        row[shape.momentum_at(beta, r)] = column[r];
                    }
                }
                for node in shape.first_impulse..s {
                    let mut column = self.twist[node].column(k) * f64::from(u8::from(node == alpha));
                    if alpha == 0 {
                        column += self.twist[s].column(k);
                    }
                    for r in 0..6 {
                        row[shape.impulse_at(node) + r] = column[r];
                    }
                }
            }
        }
    }

    fn add_e(&self, del: &DelWorkspace, shape: &Interface, row: usize, k_row: &mut [f64]) {
        let s = shape.s;
        let (k, alpha) = (row / s, row % s);
        let mut add = |node: usize, sign: f64| {
            let twist = Twist::from_vector(&self.twist[node].column(k).into_owned());
            let turned = self.momentum[node].dual_bracket(&twist).to_vector();
            let step = sign * del.rule.weights()[node] * del.time_step;
            for r in 0..6 {
                k_row[shape.nu_at(node, r)] += step * turned[r];
            }
        };
        add(alpha, -1.0);
        if alpha == 0 {
            add(s, 1.0);
        }
    }

    /// The terms of `δr` that contain `δξ`, `δξ̇` or `η` explicitly.
    fn add_t(&self, del: &DelWorkspace, s: usize, entries: &mut [f64]) {
        let rule = &del.rule;
        let order = 6 * s;
        let step = |alpha: usize| rule.weights()[alpha] * del.time_step;
        let mut curved = [Matrix6::zeros(); MAX_NODES];
        let mut curved_rate = [Matrix6::zeros(); MAX_NODES];
        let mut curved_impulse = [Matrix6::zeros(); MAX_NODES];
        for alpha in 0..=s {
            curved[alpha] = second_order_matrix(del, alpha, &self.momentum[alpha]);
            curved_rate[alpha] = second_order_rate_matrix(del, alpha, &self.momentum[alpha]);
            curved_impulse[alpha] = second_order_matrix(del, alpha, &self.impulse[alpha]);
        }
        let before_end = del.base_momentum_before_end();
        let row_terms = |alpha: usize, gamma: usize, with_impulse: bool| {
            let follow = Self::follow(alpha, gamma, s);
            let mut block =
                (curved_rate[alpha] * follow + curved[alpha] * Self::slope(del, alpha, gamma)) * step(alpha);
            if with_impulse {
                block += curved_impulse[alpha] * follow;
            }
            for beta in 0..=s {
                block +=
                    curved[beta] * (rule.weighted_derivative(alpha, beta) * Self::follow(beta, gamma, s));
            }
            block
        };
        for gamma in 1..=s {
            for alpha in 0..s {
                let mut block = row_terms(alpha, gamma, true);
                if alpha == 0 {
                    block -= row_terms(s, gamma, false);
                    block += second_order_matrix(del, 0, &del.start_momentum()) * Self::follow(0, gamma, s);
                    block += second_order_matrix(del, s, &before_end) * Self::follow(s, gamma, s);
                    block += self.twist[s].tr_mul(&self.turned_impulses(&before_end, gamma, s));
                }
                for k in 0..6 {
                    for l in 0..6 {
                        entries[(k * s + alpha) * order + l * s + gamma - 1] += block[(k, l)];
                    }
                }
            }
        }
    }

    /// `ad^D_G η^s - Σ_{α<s} ad^D_{Γ^α} η^α` for the column block γ.
    fn turned_impulses(&self, before_end: &Wrench, gamma: usize, s: usize) -> Matrix6<f64> {
        let eta = |alpha: usize| {
            let mut twists = self.twist[alpha] * Self::follow(alpha, gamma, s);
            if gamma == s {
                twists += self.twist[0];
            }
            twists
        };
        let turn = |wrench: &Wrench, twists: Matrix6<f64>| {
            let mut out = Matrix6::zeros();
            for c in 0..6 {
                let twist = Twist::from_vector(&twists.column(c).into_owned());
                out.set_column(c, &wrench.dual_bracket(&twist).to_vector());
            }
            out
        };
        let mut total = turn(before_end, eta(s));
        for alpha in 0..s {
            total -= turn(&self.impulse[alpha], eta(alpha));
        }
        total
    }
}

/// `Ṡ^α` of the base.
fn base_rate_matrix(del: &DelWorkspace, alpha: usize) -> Matrix6<f64> {
    let base = &del.base[alpha / LANES];
    let lane = alpha % LANES;
    let z = nalgebra::Matrix3::from_fn(|r, c| base.z[3 * r + c].0[lane]);
    let z_dot = nalgebra::Matrix3::from_fn(|r, c| base.z_dot[3 * r + c].0[lane]);
    let position = nalgebra::Vector3::from_fn(|r, _| base.position[r].0[lane]);
    let velocity = nalgebra::Vector3::from_fn(|r, _| base.position_dot[r].0[lane]);
    let mut rate = Matrix6::zeros();
    rate.fixed_view_mut::<3, 3>(0, 0).copy_from(&z_dot);
    let lower = crate::spatial::skew(&velocity) * z + crate::spatial::skew(&position) * z_dot;
    rate.fixed_view_mut::<3, 3>(3, 0).copy_from(&lower);
    rate
}

/// `Ṅ^α(X)` of the base.
fn second_order_rate_matrix(del: &DelWorkspace, alpha: usize, x: &Wrench) -> Matrix6<f64> {
    struct Rate<'a>(&'a DelWorkspace, usize, &'a Wrench);
    impl Kernel for Rate<'_> {
        type Output = Matrix6<f64>;
        #[inline(always)]
        fn run<S: Simd>(self, simd: S) -> Matrix6<f64> {
            let Self(del, alpha, wrench) = self;
            let wrench: [f64; 6] = wrench.to_vector().into();
            let lanes =
                crate::floating_base::second_order_rate(simd, &del.base[alpha / LANES], splat(simd, &wrench));
            let n = store(lanes);
            Matrix6::from_fn(|r, c| if c < 3 { n[3 * r + c].0[alpha % LANES] } else { 0.0 })
        }
    }
    del.instructions.dispatch(Rate(del, alpha, x))
}
