//! What is fuzzed. Each target takes any bytes, and fails by a panic: one of the code, or of an assertion about what came out.
//!
//! | target | input | what must hold |
//! |---|---|---|
//! | [`urdf`], [`companion`] | the text of a file | a model or an error |
//! | [`scenario`] | a scenario file | a scenario that can be written and read again, or an error |
//! | [`overrides`] | lines of `--set` | the same |
//! | [`at`] | a file of `model --at` | JSON without `null`, or an error |
//! | [`mcap`] | a log | its items, bounded, and how it ends |
//! | [`messages`] | commands and states as bytes | what is taken is finite, and the next good command acts |
//! | [`cycle`] | states of a robot, damaged | a valid command, always |
//! | [`qp`] | a small dual problem | an answer that solves it, or an error; the next good problem is solved |
//! | [`mechanics`] | a tree, a step, a state | a step that ends in numbers, or an error |

mod control;
mod mechanics;
mod messages;
mod numbers;
mod texts;

pub use control::{cycle, qp};
pub use mechanics::mechanics;
pub use messages::{mcap, messages};
pub use texts::{at, companion, overrides, scenario, urdf};
