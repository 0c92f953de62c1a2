//! Stage boundaries from the clock: short stages first, cut where a foot lifts off or touches down.
//!
//! A switch that comes within 1.4 of a stage's length ends the stage; one that comes within twice of it halves the way. So no stage is
//! shorter than 0.4 of what it was to be, but for a first one just before a switch.

use alloc::vec::Vec;

/// A switch that comes sooner than this has come, s.
const NOW_S: f64 = 1e-3;
/// A stage may be this much longer than it was to be.
const LONGER: f64 = 1.4;

/// The stages of a horizon.
#[derive(Clone, Debug, PartialEq)]
pub struct StageGrid {
    /// Lengths as they are without switches, s.
    lengths: Vec<f64>,
    /// Boundaries, one more than stages, s.
    times: Vec<f64>,
}

impl StageGrid {
    /// For stages of these lengths (s).
    pub fn new(lengths: Vec<f64>) -> Self {
        let mut times = alloc::vec![0.0];
        for length in &lengths {
            times.push(times[times.len() - 1] + length);
        }
        Self { lengths, times }
    }

    /// Number of stages.
    pub fn stages(&self) -> usize {
        self.lengths.len()
    }

    /// Cuts a horizon that begins at `start_s`; `next_switch(t)` tells the first switch after `t`.
    pub fn cut(&mut self, start_s: f64, mut next_switch: impl FnMut(f64) -> Option<f64>) {
        self.times[0] = start_s;
        for (k, &length) in self.lengths.iter().enumerate() {
            let begin = self.times[k];
            let to_switch = next_switch(begin + NOW_S).map_or(f64::INFINITY, |switch| switch - begin);
            self.times[k + 1] = begin
                + match to_switch / length {
                    near if near <= LONGER => to_switch,
                    far if far < 2.0 => 0.5 * to_switch,
                    _ => length,
                };
        }
    }

    /// Boundaries, s.
    pub fn times(&self) -> &[f64] {
        &self.times
    }

    /// Length of a stage, s.
    pub fn length(&self, stage: usize) -> f64 {
        self.times[stage + 1] - self.times[stage]
    }

    /// A time at which the contacts of a stage are those of all of it, s.
    pub fn inside(&self, stage: usize) -> f64 {
        // A switch that has nearly come has come.
        self.times[stage] + NOW_S.min(0.5 * self.length(stage))
    }

    /// The stage a time lies in, clamped to the horizon.
    pub fn stage_at(&self, time_s: f64) -> usize {
        (1..self.stages()).take_while(|&k| self.times[k] <= time_s + 1e-9).count()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn switches_are_boundaries_and_no_stage_is_tiny() {
        let switches = [0.37, 0.61];
        for start in 0..200 {
            let start_s = 1e-3 * f64::from(start);
            let mut grid = StageGrid::new([alloc::vec![0.01; 2], alloc::vec![0.02; 20]].concat());
            grid.cut(start_s, |t| switches.iter().copied().find(|s| *s > t));
            for switch in switches.iter().filter(|s| **s < grid.times()[22]) {
                assert!(grid.times().iter().any(|t| (t - switch).abs() < 1e-9), "{start_s}: {switch}");
            }
            for k in 1..22 {
                let wanted = if k < 2 { 0.01 } else { 0.02 };
                assert!(grid.length(k) > 0.39 * wanted && grid.length(k) < 1.41 * wanted);
            }
        }
    }
}
