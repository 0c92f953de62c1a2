//! Times of short calls: processor time of the thread.
//!
//! All that is timed computes on one thread without waiting; its processor time is the wall time of a machine that does nothing else.
//! What the neighbours do to caches and clock rate stays in it. Reading the clock takes some 0.2 µs.

use std::hint::black_box;

use rustix::time::{ClockId, clock_gettime};

/// Processor time of this thread, s.
fn now() -> f64 {
    let time = clock_gettime(ClockId::ThreadCPUTime);
    time.tv_sec as f64 + 1e-9 * time.tv_nsec as f64
}

/// Seconds of one call.
pub fn once<T>(call: impl FnOnce() -> T) -> (f64, T) {
    let start = now();
    let value = black_box(call());
    (now() - start, value)
}

/// Least seconds of `repeats` calls: what the work takes without what else the machine does.
pub fn least<T>(repeats: usize, mut call: impl FnMut() -> T) -> f64 {
    (0..repeats).map(|_| once(&mut call).0).fold(f64::INFINITY, f64::min)
}

/// Seconds of one call, least of five batches of at least `batch` seconds each.
pub fn batched<T>(batch: f64, mut call: impl FnMut() -> T) -> f64 {
    let mut count = 1u32;
    loop {
        let seconds = once(|| (0..count).for_each(|_| drop(black_box(call())))).0;
        if seconds >= batch || count > 1 << 24 {
            break;
        }
        count *= 2;
    }
    least(5, || (0..count).for_each(|_| drop(black_box(call())))) / f64::from(count)
}

/// Median; 0 of nothing.
pub fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    let middle = values.len() / 2;
    match values.len() {
        0 => 0.0,
        n if n % 2 == 1 => values[middle],
        _ => 0.5 * (values[middle - 1] + values[middle]),
    }
}

/// Slope of the least-squares line through `(ln x, ln y)`.
pub fn exponent(points: &[(f64, f64)]) -> f64 {
    let n = points.len() as f64;
    let logs: Vec<(f64, f64)> = points.iter().map(|(x, y)| (x.ln(), y.ln())).collect();
    let (mx, my) = logs.iter().fold((0.0, 0.0), |(a, b), (x, y)| (a + x / n, b + y / n));
    let (above, below) =
        logs.iter().fold((0.0, 0.0), |(a, b), (x, y)| (a + (x - mx) * (y - my), b + (x - mx) * (x - mx)));
    above / below
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exponents_and_medians() {
        let points: Vec<(f64, f64)> =
            [2.0, 5.0, 11.0].iter().map(|&x: &f64| (x, 3.0 * x.powf(1.7))).collect();
        assert!((exponent(&points) - 1.7).abs() < 1e-12);
        assert_eq!((median(vec![3.0, 1.0, 2.0]), median(vec![4.0, 1.0, 2.0, 3.0])), (2.0, 2.5));
        assert_eq!(median(vec![]), 0.0);
    }
}
