//! Times collected in a loop: their percentiles in memory that does not grow with the run.

use hdrhistogram::Histogram;

/// Longest time told apart from longer ones (ns): ten minutes.
const LONGEST_NS: u64 = 600_000_000_000;
/// Decimal digits of a percentile that are right.
const DIGITS: u8 = 3;

/// A histogram of times. All its memory is there from the beginning.
#[derive(Debug, Clone, Default)]
pub struct Durations {
    histogram: Option<Histogram<u32>>,
    /// The longest one, exactly.
    longest_ns: u64,
}

impl Durations {
    /// Room for any number of times.
    pub fn new() -> Self {
        // The bounds are constants that the histogram accepts.
        Self { histogram: Histogram::new_with_bounds(1, LONGEST_NS, DIGITS).ok(), longest_ns: 0 }
    }

    /// Takes in a time. No allocation.
    pub fn add(&mut self, time_ns: u64) {
        self.longest_ns = self.longest_ns.max(time_ns);
        if let Some(histogram) = &mut self.histogram {
            histogram.saturating_record(time_ns);
        }
    }

    /// A percentile (0..1) by nearest rank, s, right to a part in a thousand; `None` without any time.
    pub fn percentile_s(&self, part: f64) -> Option<f64> {
        let histogram = self.histogram.as_ref().filter(|histogram| !histogram.is_empty())?;
        Some(histogram.value_at_quantile(part).min(self.longest_ns) as f64 * 1e-9)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn percentiles_are_those_of_the_times_to_three_digits_and_the_largest_is_exact() {
        let mut durations = Durations::new();
        assert_eq!(durations.percentile_s(0.5), None);
        (1..=1_000_000).for_each(|time_ns| durations.add(time_ns));
        for (part, expected_s) in [(0.5, 5e-4), (0.999, 9.99e-4), (0.0, 1e-9)] {
            let found_s = durations.percentile_s(part).unwrap();
            assert!((found_s / expected_s - 1.0).abs() < 1e-3, "{part}: {found_s}");
        }
        assert_eq!(durations.percentile_s(1.0), Some(1e-3));
        durations.add(u64::MAX);
        assert!(durations.percentile_s(1.0).unwrap() > 500.0);
    }
}
