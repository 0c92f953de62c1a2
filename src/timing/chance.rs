//! Chances: how likely what was seen is when a threshold is kept.
//!
//! A run has hundreds of cycles, a floor some dozens of ticks; high percentiles of so few are the largest one or two of them, and one tick of
//! a machine busy with other things moves them. So a percentile over its limit is not yet a limit broken: what is counted is how many times
//! lie beyond it, against how many chance alone puts there.

/// Chance of calling a threshold broken that is kept.
pub const SIGNIFICANCE: f64 = 0.05;

/// Chance that the loop misses at least as many deadlines as it did when its share is `ratio` times the floor's.
///
/// Given both counts together, the loop's one is binomial. Source: Przyborowski, Wilenski, "Homogeneity of results in testing samples from
/// Poisson series", Biometrika 31, 1940. Each argument: missed, of how many. Cost: linear in the misses.
pub fn of_so_many_misses(in_loop: (u64, u64), in_floor: (u64, u64), ratio: f64) -> f64 {
    let (misses, cycles) = in_loop;
    let (floor_misses, ticks) = in_floor;
    let weight = ratio * cycles as f64;
    of_so_many(misses, misses + floor_misses, weight / (weight + ticks as f64))
}

/// Chance that at least `count` of `all` are hit when each is with chance `part`: the upper tail of the binomial distribution.
///
/// Cost: linear in `all`.
pub fn of_so_many(count: u64, all: u64, part: f64) -> f64 {
    if count == 0 || part >= 1.0 {
        return 1.0;
    }
    if part.is_nan() || part <= 0.0 || count > all {
        return 0.0;
    }
    let log_ratio = |k: u64| ((all - k) as f64 / (k + 1) as f64).ln() + part.ln() - (-part).ln_1p();
    tail(count, all, all as f64 * (-part).ln_1p(), log_ratio)
}

/// Chance that at least `count` of `all` times are longer than the `rank`-th longest of `floor_all` times of the same distribution, whatever
/// that is.
///
/// Source: Gumbel, von Schelling, "The distribution of the number of exceedances", Annals of Mathematical Statistics 21, 1950. Cost: linear
/// in `all` and `rank`.
pub fn of_so_many_longer(count: u64, all: u64, rank: u64, floor_all: u64) -> f64 {
    if count == 0 {
        return 1.0;
    }
    if rank == 0 || rank > floor_all || count > all {
        return 0.0;
    }
    let log_none = (0..rank).map(|i| ((floor_all - i) as f64 / (all + floor_all - i) as f64).ln()).sum();
    let log_ratio = |k: u64| {
        let more = (k + rank) as f64 / (k + 1) as f64;
        (more * (all - k) as f64 / (floor_all - rank + all - k) as f64).ln()
    };
    tail(count, all, log_none, log_ratio)
}

/// Sum of the terms from `from` to `to` of a distribution over whole numbers: the logarithms of its first term, and of each over the one
/// before it.
fn tail(from: u64, to: u64, log_first: f64, log_ratio: impl Fn(u64) -> f64) -> f64 {
    let mut log_term = log_first + (0..from).map(&log_ratio).sum::<f64>();
    let mut sum = 0.0;
    for k in from..=to {
        sum += log_term.exp();
        if k < to {
            log_term += log_ratio(k);
        }
    }
    sum.min(1.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_chance_of_misses_is_that_of_the_binomial_distribution() {
        // One miss, none in the floor, equal lengths, ratio 1: half.
        assert!((of_so_many_misses((1, 100), (0, 100), 1.0) - 0.5).abs() < 1e-12);
        // Three of three: an eighth; two or more of three: a half.
        assert!((of_so_many_misses((3, 100), (0, 100), 1.0) - 0.125).abs() < 1e-12);
        assert!((of_so_many_misses((2, 100), (1, 100), 1.0) - 0.5).abs() < 1e-12);
        // Twice allowed: (2/3)^10.
        let chance = of_so_many_misses((10, 100), (0, 100), 2.0);
        assert!((chance - (2.0_f64 / 3.0).powi(10)).abs() < 1e-12);
        assert_eq!(of_so_many_misses((0, 100), (0, 100), 2.0), 1.0);
        // Far from the limit on either side, with large counts.
        assert!(of_so_many_misses((5000, 12_000), (1000, 12_000), 2.0) < 1e-12);
        assert!(of_so_many_misses((1000, 12_000), (1000, 12_000), 2.0) > 1.0 - 1e-9);
        // One of 200 beyond what one in a thousand may be is no wonder, two are.
        assert!((of_so_many(1, 200, 0.001) - (1.0 - 0.999_f64.powi(200))).abs() < 1e-12);
        assert!(of_so_many(2, 200, 0.001) < SIGNIFICANCE);
    }

    #[test]
    fn the_chance_of_longer_times_is_that_of_all_orders_counted() {
        // Three of ours and three of the floor's in every order of the six.
        let orders: Vec<u32> = (0..64_u32).filter(|ours| ours.count_ones() == 3).collect();
        for rank in 1..=3_u64 {
            let longer = |ours: u32| {
                let floors = |bit: &u32| ours >> bit & 1 == 0;
                let place = (0..6).rev().filter(floors).nth(rank as usize - 1).unwrap();
                u64::from((ours >> place).count_ones())
            };
            for count in 0..=4 {
                let seen = orders.iter().filter(|ours| longer(**ours) >= count).count();
                let chance = of_so_many_longer(count, 3, rank, 3);
                assert!((chance - seen as f64 / orders.len() as f64).abs() < 1e-12, "{rank} {count}");
            }
        }
        // The longest of 51 is exceeded by 3 of 200 every second time, by 20 hardly ever.
        assert!(of_so_many_longer(3, 200, 1, 51) > 0.4);
        assert!(of_so_many_longer(20, 200, 1, 51) < SIGNIFICANCE);
        assert!(of_so_many_longer(200, 100_000, 500, 50_000) > 1.0 - 1e-9);
    }
}
