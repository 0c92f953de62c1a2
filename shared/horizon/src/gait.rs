//! A gait: when every foot lifts off and touches down, and where, for a path of the base.
//!
//! Foot `i` is in the air from `t_0 + (k + φ_i) T` on for the swing time, `k = 0, 1, ..`. It lands where it stands under the base as at
//! home in the middle of its next stance: that is home, plus the velocity times half of the stance, and turned along.
//!
//! Source: M. H. Raibert, *Legged Robots That Balance*, 1986, for the neutral point.

use alloc::vec::Vec;

use nalgebra::Vector2;

use crate::base_path::{BasePath, turned_by, with_height};
use crate::contact_schedule::{ContactSchedule, Foothold};

/// A foot that is this near to where it shall stand at the end stays, m.
const THERE_M: f64 = 2e-3;

/// Times of a gait.
#[derive(Clone, Debug, PartialEq)]
pub struct Gait {
    /// `T`, s.
    pub period_s: f64,
    /// Time in the air, s.
    pub swing_s: f64,
    /// `φ_i` for every foot, 0 to 1.
    pub phase: Vec<f64>,
}

impl Gait {
    /// Diagonal pairs. Phases of four feet are in the order front left, front right, back left, back right.
    pub const TROT: [f64; 4] = [0.0, 0.5, 0.5, 0.0];
    /// The two of a side.
    pub const PACE: [f64; 4] = [0.0, 0.5, 0.0, 0.5];
    /// The front ones and the back ones.
    pub const BOUND: [f64; 4] = [0.0, 0.0, 0.5, 0.5];
    /// One after the other.
    pub const WALK: [f64; 4] = [0.0, 0.5, 0.75, 0.25];
    /// All at once.
    pub const JUMP: [f64; 4] = [0.0; 4];
}

/// A gait along a path, and how far it has been laid out.
#[derive(Clone, Debug, PartialEq)]
pub struct GaitWalk {
    /// The times.
    pub gait: Gait,
    /// The way.
    pub path: BasePath,
    /// Where every foot stands under the base at home, in the path's axes, m; and its heading, rad.
    pub home: Vec<(Vector2<f64>, f64)>,
    /// Next stride of every foot.
    pub stride: Vec<u32>,
}

impl GaitWalk {
    /// For a robot that stands at `places`, its path at the origin of `path`. Allocates.
    pub fn new(gait: Gait, path: BasePath, places: &[Foothold]) -> Self {
        let home = places.iter().map(|place| {
            (turned_by(&(place.position_w.xy() - path.origin), -path.yaw), place.yaw() - path.yaw)
        });
        Self { gait, path, home: home.collect(), stride: alloc::vec![0; places.len()] }
    }

    /// The place of a foot that is at home at a time, on level ground at height 0.
    pub fn home_at(&self, foot: usize, time_s: f64) -> Foothold {
        let point = self.path.at(time_s);
        let (place, yaw) = self.home[foot];
        let position = point.position + turned_by(&place, point.yaw);
        Foothold::level(with_height(&position, 0.0), point.yaw + yaw)
    }

    /// Lays out the strides that begin before `until_s`. A foot that stands at the end of the path where it belongs lifts off no more.
    pub fn extend(&mut self, schedule: &mut ContactSchedule, until_s: f64) {
        let Gait { period_s, swing_s, .. } = self.gait;
        for foot in 0..self.home.len() {
            loop {
                let lift_s =
                    self.path.start_s + (f64::from(self.stride[foot]) + self.gait.phase[foot]) * period_s;
                if lift_s >= until_s {
                    break;
                }
                let touch_s = lift_s + swing_s;
                let to = self.home_at(foot, touch_s + 0.5 * (period_s - swing_s));
                let last = schedule.stances(foot).last();
                let there = last
                    .is_some_and(|last| (last.place.position_w.xy() - to.position_w.xy()).norm() < THERE_M);
                let over = lift_s >= self.path.stop_s - 0.5 * period_s;
                let stays = there && over;
                if !stays && !schedule.step(foot, lift_s, touch_s, to) {
                    break;
                }
                self.stride[foot] += 1;
            }
        }
    }
}
