//! Inverse of the s x s pivot blocks, by Gauss-Jordan elimination with partial pivoting.

/// A pivot smaller than this, relative to the largest entry of the block, counts as zero.
const SINGULAR: f64 = 1e-13;

/// Inverts the leading `s x s` part of `block`; otherwise the size of the pivot that vanished.
#[inline(always)]
pub(crate) fn invert<const N: usize>(block: [[f64; N]; N], s: usize) -> Result<[[f64; N]; N], f64> {
    let mut a = block;
    let mut inverse = [[0.0; N]; N];
    let mut largest = 0.0f64;
    for r in 0..s {
        inverse[r][r] = 1.0;
        for c in 0..s {
            largest = largest.max(a[r][c].abs());
        }
    }
    for k in 0..s {
        let mut pivot = k;
        for r in k + 1..s {
            if a[r][k].abs() > a[pivot][k].abs() {
                pivot = r;
            }
        }
        a.swap(k, pivot);
        inverse.swap(k, pivot);
        let size = a[k][k].abs();
        if size <= SINGULAR * largest || size.is_nan() {
            return Err(size);
        }
        let scale = 1.0 / a[k][k];
        for c in 0..s {
            a[k][c] *= scale;
            inverse[k][c] *= scale;
        }
        for r in 0..s {
            if r == k {
                continue;
            }
            let factor = a[r][k];
            for c in 0..s {
                a[r][c] -= factor * a[k][c];
                inverse[r][c] -= factor * inverse[k][c];
            }
        }
    }
    Ok(inverse)
}

#[cfg(test)]
mod tests {
    use super::invert;

    #[test]
    fn product_with_the_inverse_is_the_identity() {
        let a = [[0.0, 2.0, 1.0], [1.0, -1.0, 0.5], [3.0, 0.25, -2.0]];
        let inverse = invert(a, 3).unwrap();
        for r in 0..3 {
            for c in 0..3 {
                let sum: f64 = (0..3).map(|k| a[r][k] * inverse[k][c]).sum();
                assert!((sum - f64::from(u8::from(r == c))).abs() < 1e-15);
            }
        }
        assert!(invert([[1.0, 2.0], [2.0, 4.0]], 2).is_err());
        assert!(invert([[f64::NAN]], 1).is_err());
    }
}
