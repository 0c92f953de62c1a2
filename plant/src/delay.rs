//! A delay of a fixed number of steps.

/// Ring of values: what is pushed comes out a fixed number of pushes later.
#[derive(Clone, Debug)]
pub(crate) struct DelayLine<T> {
    slots: Vec<T>,
    next: usize,
}

impl<T: Clone> DelayLine<T> {
    /// Delays by `steps`; before anything was pushed, `initial` comes out.
    pub fn new(steps: usize, initial: T) -> Self {
        Self { slots: vec![initial; steps + 1], next: 0 }
    }

    /// Where the next value goes. Call [`DelayLine::advance`] after writing it.
    pub fn newest(&mut self) -> &mut T {
        &mut self.slots[self.next]
    }

    pub fn advance(&mut self) {
        self.next = (self.next + 1) % self.slots.len();
    }

    /// The value pushed the delay ago: after `advance`, the oldest slot.
    pub fn oldest(&self) -> &T {
        &self.slots[self.next % self.slots.len()]
    }

    /// All slots take this value.
    pub fn fill(&mut self, value: &T) {
        for slot in &mut self.slots {
            slot.clone_from(value);
        }
    }
}

/// Whole steps nearest to a delay.
pub(crate) fn delay_steps(delay: f64, time_step: f64) -> usize {
    (delay / time_step).round() as usize
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_come_out_as_many_pushes_later() {
        for steps in 0..4 {
            let mut line = DelayLine::new(steps, 0);
            let out: Vec<i32> = (1..=6)
                .map(|value| {
                    *line.newest() = value;
                    line.advance();
                    *line.oldest()
                })
                .collect();
            let expected: Vec<i32> = (1..=6).map(|value| (value - steps as i32).max(0)).collect();
            assert_eq!(out, expected, "{steps}");
        }
    }
}
