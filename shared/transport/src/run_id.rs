//! What tells runs apart.

use std::fmt;
use std::path::PathBuf;
use std::str::FromStr;

use crate::{LinkError, SplitMix64};

/// All names in shared memory and all folders of ours begin with this.
const FAMILY: &str = "delmpc_";

/// The identity of one run. Written as 16 hexadecimal digits.
///
/// # Example
/// ```
/// use delmpc_transport::RunId;
/// let run = RunId::from_seeds(1_700_000_000_000_000_000, 4711); // time and process id of the supervisor
/// assert_eq!(run.to_string().parse::<RunId>()?, run);
/// # Ok::<(), delmpc_transport::LinkError>(())
/// ```
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct RunId(pub u64);

impl RunId {
    /// An identity mixed from two numbers that no two runs share as a pair, such as the time and the process id of the supervisor.
    pub fn from_seeds(time_ns: u64, process_id: u32) -> Self {
        let salt = SplitMix64::new(u64::from(process_id)).next_u64();
        Self(SplitMix64::new(time_ns ^ salt).next_u64())
    }

    /// The beginning of every name this run has in shared memory.
    pub(crate) fn prefix(self) -> String {
        format!("{FAMILY}{self}_")
    }

    /// The folder in which this run keeps its service files.
    pub(crate) fn root_path(self) -> PathBuf {
        std::env::temp_dir().join(format!("{FAMILY}{self}"))
    }

    /// The run a file or folder belongs to, if it is one of ours.
    pub(crate) fn of_file(name: &str) -> Option<Self> {
        name.strip_prefix(FAMILY)?.get(..16)?.parse().ok()
    }
}

impl fmt::Display for RunId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:016x}", self.0)
    }
}

impl FromStr for RunId {
    type Err = LinkError;

    fn from_str(text: &str) -> Result<Self, LinkError> {
        let digits = text.len() == 16 && text.bytes().all(|byte| byte.is_ascii_hexdigit());
        let value = u64::from_str_radix(text, 16).ok().filter(|_| digits);
        value.map(Self).ok_or_else(|| LinkError::InvalidRunId { text: text.to_owned() })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_reads_back_what_it_wrote_and_refuses_everything_else() {
        let run = RunId(0x12ab);
        assert_eq!(run.to_string(), "00000000000012ab");
        assert_eq!("00000000000012ab".parse::<RunId>().unwrap(), run);
        for text in ["", "12ab", "+0000000000012ab", "00000000000012ag", "00000000000012ab0"] {
            assert!(matches!(text.parse::<RunId>(), Err(LinkError::InvalidRunId { .. })), "{text:?}");
        }
    }

    #[test]
    fn it_recognises_its_own_files_only() {
        let run = RunId(0x12ab);
        assert_eq!(RunId::of_file(&format!("{}x.data", run.prefix())), Some(run));
        assert_eq!(RunId::of_file(&run.root_path().file_name().unwrap().to_string_lossy()), Some(run));
        assert_eq!(RunId::of_file("delmpc_short"), None);
        assert_eq!(RunId::of_file("iox2_00000000000012ab"), None);
    }

    #[test]
    fn runs_of_the_same_moment_or_process_differ() {
        assert_ne!(RunId::from_seeds(1, 2), RunId::from_seeds(2, 1));
        assert_ne!(RunId::from_seeds(1, 2), RunId::from_seeds(1, 3));
    }
}
