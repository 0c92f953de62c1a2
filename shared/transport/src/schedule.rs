//! Which messages of a series something happens to.

use crate::SplitMix64;

/// Decides, message by message, whether a fault strikes. Messages are counted from 0.
///
/// # Example
/// ```
/// use delmpc_transport::Schedule;
/// let mut in_a_row = Schedule::in_a_row(2, 3); // messages 2, 3, 4
/// let hits: Vec<bool> = (0..7).map(|_| in_a_row.strikes()).collect();
/// assert_eq!(hits, [false, false, true, true, true, false, false]);
/// ```
#[derive(Debug, Clone, PartialEq)]
pub struct Schedule {
    rule: Rule,
    count: u64,
}

#[derive(Debug, Clone, PartialEq)]
enum Rule {
    InARow { first: u64, length: u64 },
    Every { period: u64, length: u64 },
    Random { first: u64, length: u64, probability: f64, random: SplitMix64 },
}

impl Schedule {
    /// Never.
    pub fn never() -> Self {
        Self::in_a_row(0, 0)
    }

    /// Every message.
    pub fn always() -> Self {
        Self::in_a_row(0, u64::MAX)
    }

    /// Once: `length` messages in a row, beginning with message `first`.
    pub fn in_a_row(first: u64, length: u64) -> Self {
        Self { rule: Rule::InARow { first, length }, count: 0 }
    }

    /// Again and again: the last `length` messages of every `period` messages. A period of 0 counts as 1.
    pub fn every(period: u64, length: u64) -> Self {
        Self { rule: Rule::Every { period: period.max(1), length }, count: 0 }
    }

    /// Each message with this probability, independently of the others.
    pub fn random(probability: f64, seed: u64) -> Self {
        Self::random_among(0, u64::MAX, probability, seed)
    }

    /// Each of `length` messages, beginning with message `first`, with this probability.
    pub fn random_among(first: u64, length: u64, probability: f64, seed: u64) -> Self {
        Self { rule: Rule::Random { first, length, probability, random: SplitMix64::new(seed) }, count: 0 }
    }

    /// Counts the next message and says whether it is struck.
    pub fn strikes(&mut self) -> bool {
        let message = self.count;
        self.count = message.wrapping_add(1);
        match &mut self.rule {
            Rule::InARow { first, length } => among(message, *first, *length),
            Rule::Every { period, length } => message % *period >= period.saturating_sub(*length),
            Rule::Random { first, length, probability, random } => {
                among(message, *first, *length) && random.uniform() < *probability
            }
        }
    }
}

fn among(message: u64, first: u64, length: u64) -> bool {
    message >= first && message - first < length
}

#[cfg(test)]
mod tests {
    use super::*;

    fn struck(mut schedule: Schedule, messages: usize) -> Vec<usize> {
        (0..messages).filter(|_| schedule.strikes()).collect()
    }

    #[test]
    fn rules_strike_where_they_say() {
        assert_eq!(struck(Schedule::never(), 100), []);
        assert_eq!(struck(Schedule::always(), 3), [0, 1, 2]);
        assert_eq!(struck(Schedule::in_a_row(5, 2), 100), [5, 6]);
        assert_eq!(struck(Schedule::every(4, 1), 10), [3, 7]);
        assert_eq!(struck(Schedule::every(3, 2), 7), [1, 2, 4, 5]);
        assert_eq!(struck(Schedule::every(0, 1), 2), [0, 1]);
    }

    #[test]
    fn random_strikes_repeat_with_the_seed_and_hit_their_rate() {
        let hits = struck(Schedule::random(0.1, 42), 10_000);
        assert_eq!(hits, struck(Schedule::random(0.1, 42), 10_000));
        assert_ne!(hits, struck(Schedule::random(0.1, 43), 10_000));
        // Binomial(10000, 0.1): mean 1000, deviation 30; five deviations.
        assert!((850..1_150).contains(&hits.len()), "{} of 10000", hits.len());
        assert_eq!(struck(Schedule::random(0.0, 1), 100), []);
        assert_eq!(struck(Schedule::random(1.0, 1), 100).len(), 100);
        assert_eq!(struck(Schedule::random_among(3, 4, 1.0, 1), 100), [3, 4, 5, 6]);
    }
}
