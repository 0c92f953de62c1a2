//! The controller process of delmpc, and what all its processes share.
//!
//! | module | what it does |
//! |---|---|
//! | [`clock`] | the machine's monotonic clock, a timer that does not drift |
//! | [`machine`] | priority, memory and cores asked of the operating system |
//! | [`awake`] | keeps a core from falling asleep |
//! | [`presence`] | signs of life, given and followed |
//! | [`stop`] | signals |
//! | [`membership`] | the three together: a process's part in a run |
//! | [`controller_loop`] | receive, cycle, send, by the wall clock or state by state |
//! | [`figures`] | what the cycles cost |
//! | [`records`] | every cycle and every plant step with its times, for the timing report |
//! | [`usage`] | page faults, context switches and CPU time of the calling thread |

pub mod awake;
pub mod clock;
pub mod controller_loop;
pub mod durations;
pub mod figures;
pub mod machine;
pub mod membership;
pub mod presence;
pub mod records;
pub mod refusals;
pub mod stop;
pub mod usage;
