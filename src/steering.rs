//! What a person does to a running plant: pull at a link, pause the world.
//!
//! The plant stays the authority. Wishes come as lines over a pipe from the supervisor, a thread of ordinary priority reads them, and the
//! loop looks at the latest one before each step, without ever waiting. A pull is a force on a point of a link, it acts from step to step
//! until it changes or the pipe closes, and every change is logged ([`crate::log::PULL`]), so that a replay pulls just as much.
//!
//! | line | wish |
//! |---|---|
//! | `pull BODY PX PY PZ FX FY FZ` | force in the world (N) on a point of the body's link frame (m) |
//! | `release` | no force |
//! | `pause`, `resume` | the simulated world stands still, goes on |

use std::io::BufRead;
use std::sync::{Arc, Mutex, PoisonError};

use bytemuck::{Pod, Zeroable};

/// Largest force of a pull (N); larger wishes are cut to it.
pub const LARGEST_PULL_N: f64 = 400.0;
/// Farthest point of a link frame that can be pulled at (m).
const FARTHEST_POINT_M: f64 = 3.0;

/// A force on a point of a link: one record of the log. Plain data without padding.
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct Pull {
    /// From when on, by the plant's clock (ns).
    pub time_ns: u64,
    /// Body of the tree.
    pub body: u32,
    /// 1 while it acts, 0 from its end on.
    pub acts: u32,
    /// Point in the body's link frame (m).
    pub point_b: [f64; 3],
    /// Force in the world (N).
    pub force_w: [f64; 3],
}

impl Pull {
    /// No pull.
    pub fn none() -> Self {
        Self::zeroed()
    }
}

/// What is wished for now.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Wish {
    /// Force.
    pub pull: Pull,
    /// Whether the world stands still.
    pub paused: bool,
}

impl Wish {
    /// Nothing but to run.
    pub fn none() -> Self {
        Self { pull: Pull::none(), paused: false }
    }

    /// Changes the wish by a line of the pipe; a line that says nothing sensible changes nothing. `bodies`: how many there are.
    pub fn hear(&mut self, line: &str, bodies: usize) {
        let mut words = line.split_whitespace();
        match words.next() {
            Some("pause") => self.paused = true,
            Some("resume") => self.paused = false,
            Some("release") => self.pull = Pull::none(),
            Some("pull") => {
                let body = words.next().and_then(|word| word.parse::<u32>().ok());
                let numbers: Vec<f64> = words.filter_map(|word| word.parse().ok()).collect();
                let (Some(body), &[x, y, z, fx, fy, fz]) = (body, numbers.as_slice()) else { return };
                let near = [x, y, z].iter().all(|x| x.abs() <= FARTHEST_POINT_M);
                let size = [fx, fy, fz].iter().map(|f| f * f).sum::<f64>().sqrt();
                if body as usize >= bodies || !near || !size.is_finite() {
                    return;
                }
                let share = if size > LARGEST_PULL_N { LARGEST_PULL_N / size } else { 1.0 };
                let force_w = [fx, fy, fz].map(|f| f * share);
                self.pull = Pull { time_ns: 0, body, acts: 1, point_b: [x, y, z], force_w };
            }
            _ => {}
        }
    }
}

/// The loop's end: the latest wish.
#[derive(Debug, Clone)]
pub struct Steering {
    latest: Option<Arc<Mutex<Wish>>>,
    seen: Wish,
}

impl Steering {
    /// Nobody steers.
    pub fn none() -> Self {
        Self { latest: None, seen: Wish::none() }
    }

    /// Steered by the lines of a pipe. The world begins paused. When the pipe closes, nothing pulls any more and the world goes on.
    pub fn by_lines(lines: impl BufRead + Send + 'static, bodies: usize) -> Self {
        let start = Wish { paused: true, ..Wish::none() };
        let latest = Arc::new(Mutex::new(start));
        let heard = latest.clone();
        let listener = std::thread::Builder::new().spawn(move || {
            let wish = || heard.lock().unwrap_or_else(PoisonError::into_inner);
            for line in lines.lines().map_while(Result::ok) {
                wish().hear(&line, bodies);
            }
            *wish() = Wish::none();
        });
        match listener {
            Ok(_) => Self { latest: Some(latest), seen: start },
            // Nobody can be heard: the world goes on.
            Err(_) => Self::none(),
        }
    }

    /// The latest wish; while another one is just being written, the one before. Never waits.
    pub fn wish(&mut self) -> Wish {
        if let Some(Ok(latest)) = self.latest.as_ref().map(|latest| latest.try_lock()) {
            self.seen = *latest;
        }
        self.seen
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn wishes_are_heard_cut_and_refused() {
        let mut wish = Wish::none();
        wish.hear("pull 3 0 0.1 0 0 -30 40", 5);
        let pull =
            Pull { time_ns: 0, body: 3, acts: 1, point_b: [0.0, 0.1, 0.0], force_w: [0.0, -30.0, 40.0] };
        assert_eq!(wish, Wish { pull, paused: false });
        for nonsense in [
            "",
            "pull",
            "pull 5 0 0 0 1 1 1",
            "pull 3 0 0 0 nan 0 0",
            "pull 3 99 0 0 1 0 0",
            "pull 3 0 0",
            "fly",
        ] {
            wish.hear(nonsense, 5);
            assert_eq!(wish.pull, pull, "{nonsense}");
        }
        wish.hear("pull 0 0 0 0 0 3000 4000", 5);
        assert_eq!(wish.pull.force_w, [0.0, 0.6 * LARGEST_PULL_N, 0.8 * LARGEST_PULL_N]);
        wish.hear("pause", 5);
        wish.hear("release", 5);
        assert_eq!(wish, Wish { pull: Pull::none(), paused: true });
    }

    #[test]
    fn when_the_pipe_closes_nothing_pulls_and_the_world_goes_on() {
        let mut steering = Steering::by_lines(&b"pull 0 0 0 0 1 0 0\npause\n"[..], 1);
        for _ in 0..1000 {
            if steering.wish() == Wish::none() {
                return;
            }
            std::thread::sleep(std::time::Duration::from_millis(5));
        }
        panic!("still {:?}", steering.wish());
    }
}
