//! What tells runs apart.

use std::fmt;
use std::path::PathBuf;
use std::str::FromStr;

use delmpc_messages::joint_set_hash;

use crate::private_root::{random_number, runtime_folder, shared_number};
use crate::{Channel, LinkError};

/// All names of ours in shared memory begin with this.
const FAMILY: &str = "delmpc_";
/// Longest name of a run that somebody chooses.
const LONGEST_NAME: usize = 64;

/// The identity of one run. Written as 16 hexadecimal digits; a name stands for its hash ([`RunId::of_name`]).
///
/// # Example
/// ```
/// use delmpc_transport::RunId;
/// let run = RunId::random()?;
/// assert_eq!(run.to_string().parse::<RunId>()?, run);
/// # Ok::<(), delmpc_transport::LinkError>(())
/// ```
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct RunId(pub u64);

impl RunId {
    /// An identity nobody else has or can guess: names made of it cannot be taken beforehand.
    ///
    /// # Errors
    /// [`LinkError::NoRandomness`] when the operating system has no random numbers.
    pub fn random() -> Result<Self, LinkError> {
        random_number().map(Self).map_err(|source| LinkError::NoRandomness { source })
    }

    /// The identity that all processes of this user make alike from a text, such as a scenario, and that other users cannot guess.
    ///
    /// # Errors
    /// [`LinkError::NotPrivate`], [`LinkError::NoRuntimeFolder`] when the user's private folder is unusable.
    pub fn of_text(text: &str) -> Result<Self, LinkError> {
        shared_number(text).map(Self)
    }

    /// The identity that anybody makes alike from a name: its FNV-1a hash, as of a set of one joint.
    ///
    /// # Errors
    /// [`LinkError::InvalidRunId`] for a name that is empty, longer than 64 characters, holds others than letters, digits, `.`, `_`, `-`, or
    /// could be a number that lacks digits.
    pub fn of_name(name: &str) -> Result<Self, LinkError> {
        let plain = |byte: u8| byte.is_ascii_alphanumeric() || b"._-".contains(&byte);
        let is_a_number = name.bytes().all(|byte| byte.is_ascii_hexdigit());
        match name.len() <= LONGEST_NAME && name.bytes().all(plain) && !is_a_number {
            true => Ok(Self(joint_set_hash(&[name]))),
            false => Err(LinkError::InvalidRunId { text: name.to_owned() }),
        }
    }

    /// The name of a channel's service.
    pub fn service_name(self, channel: Channel) -> String {
        format!("delmpc/{self}/{}", channel.name())
    }

    /// The beginning of every name this run has in shared memory.
    pub fn prefix(self) -> String {
        format!("{FAMILY}{self}_")
    }

    /// The folder in which this run keeps its service files, within the user's private folder.
    ///
    /// # Errors
    /// [`LinkError::NotPrivate`], [`LinkError::NoRuntimeFolder`].
    pub fn root_path(self) -> Result<PathBuf, LinkError> {
        Ok(runtime_folder()?.join(self.to_string()))
    }

    /// The run a file in shared memory belongs to, if it is one of ours.
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
        value.map(Self).map_or_else(|| Self::of_name(text), Ok)
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
        for text in
            ["", "12ab", "+0000000000012ab", "00000000000012ab0", "two words", "../x", "é", &"x".repeat(65)]
        {
            assert!(matches!(text.parse::<RunId>(), Err(LinkError::InvalidRunId { .. })), "{text:?}");
        }
    }

    #[test]
    fn a_name_is_the_hash_that_another_language_makes_of_it() {
        // FNV-1a over "bench-3" and one byte 0xff, computed by hand in Python.
        assert_eq!("bench-3".parse::<RunId>().unwrap().to_string(), "5976d8699b458526");
    }

    #[test]
    fn it_recognises_its_own_files_only() {
        let run = RunId(0x12ab);
        assert_eq!(RunId::of_file(&format!("{}x.data", run.prefix())), Some(run));
        assert_eq!(RunId::of_file("delmpc_short"), None);
        assert_eq!(RunId::of_file("iox2_00000000000012ab"), None);
    }

    #[test]
    fn random_runs_differ_and_those_of_a_text_are_the_same() {
        assert_ne!(RunId::random().unwrap(), RunId::random().unwrap());
        let run = RunId::of_text("seed = 1").unwrap();
        assert_eq!(RunId::of_text("seed = 1").unwrap(), run);
        assert_ne!(RunId::of_text("seed = 2").unwrap(), run);
    }
}
