//! What is refused is told in words on standard error: the first of a kind, since the next thousand say nothing new.

use std::fmt::Display;
use std::io::Write;

/// Kinds of refusals that are told apart; numbers beyond share the last one.
const KINDS: usize = 128;

/// Remembers which kinds of refusals were told.
#[derive(Debug, Clone)]
pub struct Refusals {
    told: [bool; KINDS],
}

impl Default for Refusals {
    fn default() -> Self {
        Self { told: [false; KINDS] }
    }
}

impl Refusals {
    /// Says why something is refused, if nothing of this kind was told before. Nothing is put into words otherwise.
    pub fn tell<W: Display>(&mut self, kind: u32, words: impl FnOnce() -> W) {
        let told = &mut self.told[(kind as usize).min(KINDS - 1)];
        if !std::mem::replace(told, true) {
            // That nobody listens is no reason to stop.
            let _ = writeln!(std::io::stderr(), "warning: {} (told once)", words());
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_kind_is_put_into_words_once() {
        let (mut refusals, mut times) = (Refusals::default(), 0);
        for kind in [5, 5, 6, 5, 1000, 2000] {
            refusals.tell(kind, || {
                times += 1;
                "no"
            });
        }
        assert_eq!(times, 3);
    }
}
