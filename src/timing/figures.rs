//! Times as figures: counts, percentiles and the histogram behind them.

use hdrhistogram::Histogram;
use serde::Serialize;

/// Significant digits of a histogram.
const DIGITS: u8 = 3;
/// Everything up to this time is in the first bar (ns).
const SHORTEST_NS: f64 = 100.0;
/// Bars of a histogram per decade of time.
const BARS_PER_DECADE: f64 = 20.0;

/// A collection of times.
#[derive(Debug, Clone, PartialEq)]
pub struct Times {
    /// There is always one: only an impossible number of digits is refused.
    histogram: Option<Histogram<u64>>,
}

/// What a collection comes to. Times in s.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Figures {
    /// How many.
    pub count: u64,
    /// Median.
    pub p50_s: f64,
    /// 90 %.
    pub p90_s: f64,
    /// 99 %.
    pub p99_s: f64,
    /// 99.9 %.
    pub p999_s: f64,
    /// Longest.
    pub max_s: f64,
}

impl Times {
    /// Of times in ns.
    pub fn of(times_ns: impl IntoIterator<Item = u64>) -> Self {
        let mut histogram = Histogram::new(DIGITS).ok();
        if let Some(histogram) = &mut histogram {
            histogram.auto(true);
            for time in times_ns {
                let _ = histogram.record(time);
            }
        }
        Self { histogram }
    }

    /// How many there are.
    pub fn count(&self) -> u64 {
        self.histogram.as_ref().map_or(0, Histogram::len)
    }

    /// A part (0..1) of the times is at most this (ns); `None` without a time.
    pub fn at_ns(&self, part: f64) -> Option<u64> {
        let histogram = self.histogram.as_ref().filter(|histogram| !histogram.is_empty())?;
        Some(histogram.value_at_quantile(part))
    }

    /// How many are longer than this (ns), as far as the histogram can tell.
    pub fn count_over(&self, time_ns: u64) -> u64 {
        self.histogram.as_ref().map_or(0, |histogram| histogram.len() - histogram.count_between(0, time_ns))
    }

    /// How many are this long (ns) or longer, as far as the histogram can tell.
    pub fn count_from(&self, time_ns: u64) -> u64 {
        let Some(histogram) = &self.histogram else { return 0 };
        let below = histogram.lowest_equivalent(time_ns).checked_sub(1);
        histogram.len() - below.map_or(0, |below| histogram.count_between(0, below))
    }

    /// The figures; `None` without a time.
    pub fn figures(&self) -> Option<Figures> {
        let histogram = self.histogram.as_ref().filter(|histogram| !histogram.is_empty())?;
        let at = |part| histogram.value_at_quantile(part) as f64 * 1e-9;
        Some(Figures {
            count: histogram.len(),
            p50_s: at(0.5),
            p90_s: at(0.9),
            p99_s: at(0.99),
            p999_s: at(0.999),
            max_s: histogram.max() as f64 * 1e-9,
        })
    }

    /// The histogram over logarithmic time: edges of each bar (s) and how many are in it. Empty bars are left out.
    pub fn bars(&self) -> Vec<Bar> {
        let mut bars = Vec::new();
        let Some(histogram) = &self.histogram else { return bars };
        let factor = 10_f64.powf(1.0 / BARS_PER_DECADE);
        let (mut low_ns, mut high_ns) = (0.0_f64, SHORTEST_NS);
        let mut below = 0;
        while below < histogram.len() {
            let up_to = histogram.count_between(0, high_ns as u64);
            if up_to > below {
                bars.push(Bar { from_s: low_ns * 1e-9, to_s: high_ns * 1e-9, count: up_to - below });
            }
            below = up_to;
            low_ns = high_ns;
            high_ns *= factor;
        }
        bars
    }
}

/// A bar of a histogram.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Bar {
    /// Lower edge.
    pub from_s: f64,
    /// Upper edge.
    pub to_s: f64,
    /// Times between them.
    pub count: u64,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn figures_are_those_of_the_times() {
        let figures = Times::of((1..=10_000).map(|us| us * 1_000)).figures().unwrap();
        assert_eq!(figures.count, 10_000);
        for (value, expected) in [
            (figures.p50_s, 5e-3),
            (figures.p90_s, 9e-3),
            (figures.p99_s, 9.9e-3),
            (figures.p999_s, 9.99e-3),
            (figures.max_s, 10e-3),
        ] {
            assert!((value - expected).abs() <= 1e-3 * expected, "{value} {expected}");
        }
        assert_eq!(Times::of([]).figures(), None);
        let times = Times::of([10, 20, 20, 30, 4000]);
        assert_eq!([0, 10, 19, 20, 100, 9000].map(|time_ns| times.count_over(time_ns)), [5, 4, 4, 2, 1, 0]);
        assert_eq!([0, 10, 11, 20, 100, 4001].map(|time_ns| times.count_from(time_ns)), [5, 5, 4, 4, 1, 1]);
        assert_eq!((Times::of([]).count_over(0), Times::of([]).count_from(0)), (0, 0));
    }

    #[test]
    fn every_time_is_in_one_bar() {
        let times = [0, 1, 99, 5_000, 5_001, 2_000_000, 30_000_000_000];
        let bars = Times::of(times).bars();
        assert_eq!(bars.iter().map(|bar| bar.count).sum::<u64>(), times.len() as u64);
        assert!(bars.windows(2).all(|pair| pair[0].to_s <= pair[1].from_s));
        assert!(bars.iter().any(|bar| bar.count == 2 && bar.from_s <= 5e-6 && bar.to_s >= 5.001e-6));
    }
}
