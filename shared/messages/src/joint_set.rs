//! A number that stands for an ordered set of joint names, so that two processes notice when they loaded different robots.

const FNV_OFFSET: u64 = 0xcbf2_9ce4_8422_2325;
const FNV_PRIME: u64 = 0x0000_0100_0000_01b3;
/// Ends each name. UTF-8 never contains this byte, so `["ab", "c"]` and `["a", "bc"]` differ.
const END_OF_NAME: u8 = 0xff;

/// FNV-1a (64 bit) over joint names in order, one name at a time.
///
/// # Example
/// ```
/// use delmpc_messages::{JointSetHasher, joint_set_hash};
/// let by_hand = JointSetHasher::new().joint("hip").joint("knee").finish();
/// assert_eq!(by_hand, joint_set_hash(&["hip", "knee"]));
/// assert_ne!(by_hand, joint_set_hash(&["knee", "hip"]));
/// ```
///
/// Source: Fowler, Noll, Vo, "The FNV Non-Cryptographic Hash Algorithm". It guards against mistakes, not against malice.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct JointSetHasher(u64);

impl JointSetHasher {
    /// The hasher of the empty joint set.
    pub const fn new() -> Self {
        Self(FNV_OFFSET)
    }

    /// Adds the next joint of the set.
    #[must_use]
    pub const fn joint(self, name: &str) -> Self {
        let bytes = name.as_bytes();
        let mut hash = self.0;
        let mut i = 0;
        while i < bytes.len() {
            hash = step(hash, bytes[i]);
            i += 1;
        }
        Self(step(hash, END_OF_NAME))
    }

    /// The hash of the joints added so far.
    pub const fn finish(self) -> u64 {
        self.0
    }
}

impl Default for JointSetHasher {
    fn default() -> Self {
        Self::new()
    }
}

/// The hash of a whole joint set given in order. See [`JointSetHasher`] for names that come one at a time.
pub const fn joint_set_hash(names: &[&str]) -> u64 {
    let mut hasher = JointSetHasher::new();
    let mut i = 0;
    while i < names.len() {
        hasher = hasher.joint(names[i]);
        i += 1;
    }
    hasher.finish()
}

const fn step(hash: u64, byte: u8) -> u64 {
    (hash ^ byte as u64).wrapping_mul(FNV_PRIME)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_empty_set_is_the_published_offset_basis() {
        assert_eq!(joint_set_hash(&[]), 0xcbf2_9ce4_8422_2325);
    }

    #[test]
    fn a_byte_follows_the_published_vector() {
        // FNV-1a of "a" is af63dc4c8601ec8c in the authors' test suite.
        assert_eq!(step(FNV_OFFSET, b'a'), 0xaf63_dc4c_8601_ec8c);
    }

    #[test]
    fn order_and_boundaries_of_names_matter() {
        assert_ne!(joint_set_hash(&["a", "b"]), joint_set_hash(&["b", "a"]));
        assert_ne!(joint_set_hash(&["ab", "c"]), joint_set_hash(&["a", "bc"]));
        assert_ne!(joint_set_hash(&["a"]), joint_set_hash(&["a", ""]));
    }

    #[test]
    fn it_is_usable_in_a_constant() {
        const HASH: u64 = joint_set_hash(&["hip", "knee"]);
        assert_eq!(HASH, JointSetHasher::default().joint("hip").joint("knee").finish());
    }
}
