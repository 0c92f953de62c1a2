//! Dense panels for the Riccati recursion: columns of whole registers, and the few products it needs of them.
//!
//! A panel is a matrix stored by columns, its rows padded with zeros to a multiple of eight doubles and aligned to cache lines,
//! so that every instruction set loads whole registers and no kernel has a remainder loop over rows. The products have one shape,
//!
//! ```text
//! C += A Bᵀ        C(i, j) += Σ_l A(i, l) B(j, l)
//! ```
//!
//! computed in tiles of `R` registers by six columns that stay in registers while `l` runs: per `l`, `R` loads and six
//! broadcasts feed `6 R` multiply-adds. Products with a symmetric matrix fit that shape as well (`P = Pᵀ`).
//!
//! Source: K. Goto, R. van de Geijn, *Anatomy of high-performance matrix multiplication*, ACM TOMS 34, 2008; column panels for
//! small matrices: G. Frison et al., *BLASFEO*, ACM TOMS 44, 2018.

use alloc::vec;
use alloc::vec::Vec;
use core::ops::Range;

use bytemuck::{Pod, Zeroable, cast_slice, cast_slice_mut};
use faer::MatRef;
use pulp::Simd;

/// Doubles in a block: the widest register.
pub(crate) const BLOCK: usize = 8;
/// Columns of a tile.
pub(crate) const TILE: usize = 6;

#[derive(Clone, Copy, Debug, Pod, Zeroable)]
#[repr(C, align(64))]
struct Block([f64; BLOCK]);

/// Rows rounded up to whole blocks.
pub(crate) const fn padded(rows: usize) -> usize {
    rows.div_ceil(BLOCK) * BLOCK
}

/// A matrix in padded columns. Rows beyond `rows` are zero unless a kernel documents otherwise.
#[derive(Clone, Debug)]
pub struct Panel {
    data: Vec<Block>,
    /// Doubles from a column to the next.
    stride: usize,
    columns: usize,
}

impl Panel {
    /// Zeros. `rows` is rounded up.
    pub fn zeros(rows: usize, columns: usize) -> Self {
        let stride = padded(rows);
        // A tile may read up to five rows beyond the last column's end.
        Self { data: vec![Block([0.0; BLOCK]); stride / BLOCK * columns + 1], stride, columns }
    }

    /// Number of columns.
    pub fn columns(&self) -> usize {
        self.columns
    }

    /// Doubles from a column to the next: the padded number of rows.
    pub fn stride(&self) -> usize {
        self.stride
    }

    /// All entries, column after column.
    pub fn entries(&self) -> &[f64] {
        cast_slice(&self.data)
    }

    /// All entries, to write.
    pub fn entries_mut(&mut self) -> &mut [f64] {
        cast_slice_mut(&mut self.data)
    }

    /// One padded column.
    pub fn column(&self, column: usize) -> &[f64] {
        &self.entries()[column * self.stride..][..self.stride]
    }

    /// One padded column, to write.
    pub fn column_mut(&mut self, column: usize) -> &mut [f64] {
        let stride = self.stride;
        &mut self.entries_mut()[column * stride..][..stride]
    }

    /// A padded column, and the next one to write.
    pub fn pair_mut(&mut self, column: usize) -> (&[f64], &mut [f64]) {
        let stride = self.stride;
        let (front, back) = self.entries_mut().split_at_mut((column + 1) * stride);
        (&front[column * stride..], &mut back[..stride])
    }

    /// The first `rows` rows as a matrix.
    pub fn view(&self, rows: usize) -> MatRef<'_, f64> {
        MatRef::from_column_major_slice_with_stride(self.entries(), rows, self.columns, self.stride)
    }

    /// The registers of an instruction set, column after column.
    #[inline(always)]
    pub fn registers<S: Simd>(&self) -> &[S::f64s] {
        cast_slice(&self.data)
    }

    /// The registers, to write.
    #[inline(always)]
    pub fn registers_mut<S: Simd>(&mut self) -> &mut [S::f64s] {
        cast_slice_mut(&mut self.data)
    }
}

/// Square root in the instruction set of the caller: one outside it would stall the vector unit.
#[inline(always)]
pub(crate) fn sqrt(x: f64) -> f64 {
    #[cfg(feature = "std")]
    return x.sqrt();
    #[cfg(not(feature = "std"))]
    return libm::sqrt(x);
}

/// `out = a bᵀ` where `b` has up to [`TILE`] rows and `out` as many columns.
pub(crate) fn times_transposed(a: &Panel, b: &Panel, out: &mut Panel) {
    pulp::Arch::new().dispatch(TimesTransposed { a, b, out });
}

struct TimesTransposed<'a> {
    a: &'a Panel,
    b: &'a Panel,
    out: &'a mut Panel,
}

impl pulp::WithSimd for TimesTransposed<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { a, b, out } = self;
        let (rows, columns) = (0..out.stride / S::F64_LANES, 0..out.columns);
        fill(simd, &ByTransposed { a, b }, out, rows, columns, false);
    }
}

/// `a bᵀ`.
struct ByTransposed<'a> {
    a: &'a Panel,
    b: &'a Panel,
}

impl Tiled for ByTransposed<'_> {
    #[inline(always)]
    fn tile<S: Simd, const R: usize>(&self, simd: S, row: usize, column: usize) -> Tile<S, R> {
        let mut tile = zero_tile::<S, R>(simd);
        accumulate(simd, &mut tile, (self.a, row), (self.b, column), 0..self.a.columns);
        tile
    }
}

/// Writes the first `columns` columns of a tile.
#[inline(always)]
pub(crate) fn store<S: Simd, const R: usize>(
    _: S,
    panel: &mut Panel,
    tile: &Tile<S, R>,
    row: usize,
    column: usize,
    columns: usize,
) {
    let stride = panel.stride / S::F64_LANES;
    let registers = panel.registers_mut::<S>();
    for (c, sums) in tile.iter().enumerate().take(columns) {
        registers[(column + c) * stride + row..][..R].copy_from_slice(sums);
    }
}

/// `out_j = column_j · vector`, over as many rows as the vector has; one per column.
pub(crate) fn transposed_times(panel: &Panel, vector: &[f64], out: &mut [f64]) {
    pulp::Arch::new().dispatch(TransposedTimes { panel, vector, out });
}

struct TransposedTimes<'a> {
    panel: &'a Panel,
    vector: &'a [f64],
    out: &'a mut [f64],
}

impl pulp::WithSimd for TransposedTimes<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { panel, vector, out } = self;
        let (vector, _) = S::as_simd_f64s(vector);
        let height = panel.stride / S::F64_LANES;
        let registers = panel.registers::<S>();
        let length = vector.len().min(height);
        // Four columns at a time: as many chains of additions as hide their latency.
        for (four, out) in out.chunks_mut(4).enumerate() {
            let mut sums = [simd.splat_f64s(0.0); 4];
            for (c, sum) in sums.iter_mut().enumerate().take(out.len()) {
                let column = &registers[(4 * four + c) * height..][..length];
                for (entry, value) in column.iter().zip(vector) {
                    *sum = simd.mul_add_e_f64s(*entry, *value, *sum);
                }
            }
            for (out, sum) in out.iter_mut().zip(sums) {
                *out = simd.reduce_sum_f64s(sum);
            }
        }
    }
}

/// Copies the lower triangle of a column-major square matrix onto the upper one within the tiles of the diagonal.
pub(crate) fn mirror_diagonal_tiles(matrix: &mut [f64], stride: usize, size: usize) {
    for column in 0..size {
        for row in column - column % TILE..column {
            matrix[column * stride + row] = matrix[row * stride + column];
        }
    }
}

/// The tile of these columns of a panel at `row` (in registers).
#[inline(always)]
pub(crate) fn load_tile<S: Simd, const R: usize>(
    simd: S,
    panel: &Panel,
    columns: Range<usize>,
    row: usize,
) -> Tile<S, R> {
    let mut tile = zero_tile::<S, R>(simd);
    let stride = panel.stride / S::F64_LANES;
    let registers = panel.registers::<S>();
    for (column, entries) in columns.zip(&mut tile) {
        entries.copy_from_slice(&registers[column * stride + row..][..R]);
    }
    tile
}

/// Sums in registers: six columns of `R` registers.
pub(crate) type Tile<S, const R: usize> = [[<S as Simd>::f64s; R]; TILE];

/// A tile of zeros.
#[inline(always)]
pub(crate) fn zero_tile<S: Simd, const R: usize>(simd: S) -> Tile<S, R> {
    [[simd.splat_f64s(0.0); R]; TILE]
}

/// `tile(r, c) += Σ_l a(row + r, l) b(column + c, l)`, `row` in registers, `column` in doubles, over these columns `l` of both.
#[inline(always)]
pub(crate) fn accumulate<S: Simd, const R: usize>(
    simd: S,
    tile: &mut Tile<S, R>,
    (a, row): (&Panel, usize),
    (b, column): (&Panel, usize),
    depths: Range<usize>,
) {
    let a_stride = a.stride / S::F64_LANES;
    let (a, b_entries) = (a.registers::<S>(), b.entries());
    let mut sums = *tile;
    for l in depths {
        let a = &a[l * a_stride + row..][..R];
        let b = &b_entries[l * b.stride + column..][..TILE];
        for c in 0..TILE {
            let factor = simd.splat_f64s(b[c]);
            for r in 0..R {
                sums[c][r] = simd.mul_add_e_f64s(a[r], factor, sums[c][r]);
            }
        }
    }
    *tile = sums;
}

/// `tile(r, c) += Σ_l a(row + r, l) b(l, column + c)`: the same with the second panel by its columns. Columns that `b` does not have
/// give numbers without meaning.
#[inline(always)]
pub(crate) fn accumulate_columns<S: Simd, const R: usize>(
    simd: S,
    tile: &mut Tile<S, R>,
    (a, row): (&Panel, usize),
    (b, column): (&Panel, usize),
    depths: Range<usize>,
) {
    let a_stride = a.stride / S::F64_LANES;
    let a = a.registers::<S>();
    let mut factors = [b.entries(); TILE];
    for c in 0..TILE {
        factors[c] = &b.column((column + c).min(b.columns - 1))[..depths.end];
    }
    let mut sums = *tile;
    for l in depths {
        let a = &a[l * a_stride + row..][..R];
        for c in 0..TILE {
            let factor = simd.splat_f64s(factors[c][l]);
            for r in 0..R {
                sums[c][r] = simd.mul_add_e_f64s(a[r], factor, sums[c][r]);
            }
        }
    }
    *tile = sums;
}

/// A matrix that is computed tile by tile.
pub(crate) trait Tiled {
    /// The tile at `row` (in registers) and `column`. Implementations must be inlined always.
    fn tile<S: Simd, const R: usize>(&self, simd: S, row: usize, column: usize) -> Tile<S, R>;
}

/// Writes rows (in registers) and columns of a matrix to a panel; with `lower` only the tiles that reach the diagonal or below.
///
/// Bands of rows outside, columns inside: the band of the first factor stays in the first-level cache while the second one, the smaller,
/// passes by; a band is as high as the registers hold sums for beside the operands, 32 registers of 512 bits, 16 of 256.
#[inline(always)]
pub(crate) fn fill<S: Simd>(
    simd: S,
    matrix: &impl Tiled,
    out: &mut Panel,
    rows: Range<usize>,
    columns: Range<usize>,
    lower: bool,
) {
    let wide = S::F64_LANES == BLOCK;
    let height = if wide { 4 } else { 2 };
    for band in rows.clone().step_by(height) {
        let end = rows.end.min(band + height);
        for column in columns.clone().step_by(TILE) {
            let row = if lower { band.max(column / S::F64_LANES) } else { band };
            let count = TILE.min(columns.end - column);
            match end.saturating_sub(row) {
                0 => break,
                1 => store(simd, out, &matrix.tile::<S, 1>(simd, row, column), row, column, count),
                2 => store(simd, out, &matrix.tile::<S, 2>(simd, row, column), row, column, count),
                3 if wide => store(simd, out, &matrix.tile::<S, 3>(simd, row, column), row, column, count),
                _ if wide => store(simd, out, &matrix.tile::<S, 4>(simd, row, column), row, column, count),
                _ => break,
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    struct Product<'a>(&'a Panel, &'a Panel, usize);

    impl pulp::WithSimd for Product<'_> {
        type Output = Vec<f64>;
        #[inline(always)]
        fn with_simd<S: Simd>(self, simd: S) -> Vec<f64> {
            let Product(a, b, depth) = self;
            let mut tile = zero_tile::<S, 1>(simd);
            accumulate(simd, &mut tile, (a, 0), (b, 3), 0..depth);
            tile.iter().map(|column| cast_slice::<S::f64s, f64>(column)[0]).collect()
        }
    }

    #[test]
    fn a_tile_is_the_product_of_two_panels() {
        let fill = |seed: f64| {
            let mut panel = Panel::zeros(13, 5);
            for column in 0..5 {
                for row in 0..13 {
                    panel.column_mut(column)[row] = (seed + row as f64) * 0.3 - column as f64;
                }
            }
            panel
        };
        let (a, b) = (fill(1.0), fill(-2.0));
        let product = pulp::Arch::new().dispatch(Product(&a, &b, 5));
        for (c, value) in product.iter().enumerate() {
            let expected: f64 = (0..5).map(|l| a.column(l)[0] * b.column(l)[3 + c]).sum();
            assert!((value - expected).abs() < 1e-12);
        }
        assert_eq!(a.stride(), 16);
        assert_eq!(a.view(13)[(12, 4)], a.column(4)[12]);
    }

    #[test]
    fn mirroring_keeps_to_the_tiles_of_the_diagonal() {
        let mut square: Vec<f64> = (0..16 * 11).map(f64::from).collect();
        let before = square.clone();
        mirror_diagonal_tiles(&mut square, 16, 11);
        for column in 0..11 {
            for row in 0..16 {
                let mirrored = row < column && row / TILE == column / TILE;
                let from = if mirrored { row * 16 + column } else { column * 16 + row };
                assert_eq!(square[column * 16 + row], before[from]);
            }
        }
    }

    #[test]
    fn columns_times_a_vector() {
        let mut panel = Panel::zeros(13, 7);
        for column in 0..7 {
            for row in 0..13 {
                panel.column_mut(column)[row] = (row as f64 - 4.0) * 0.25 + column as f64;
            }
        }
        let mut vector = Panel::zeros(13, 1);
        (0..13).for_each(|row| vector.column_mut(0)[row] = 1.0 - 0.5 * row as f64);
        let mut out = [0.0; 7];
        transposed_times(&panel, vector.column(0), &mut out);
        for (column, out) in out.iter().enumerate() {
            let expected: f64 = panel.column(column).iter().zip(vector.column(0)).map(|(a, b)| a * b).sum();
            assert!((out - expected).abs() < 1e-13);
        }
    }
}
