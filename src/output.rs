//! What is written to a terminal, a pipe or a file: nobody listening is no failure, a full disk is, and names cannot give a terminal orders.

use std::borrow::Cow;
use std::fmt::Write as _;
use std::io::{self, ErrorKind, Write as _};

use crate::verdict::Failure;

/// Writes text to standard output. A reader that has gone away has seen enough.
///
/// # Errors
/// [`Failure::Fault`] when it cannot be written, for example to a full disk.
pub fn print(text: &str) -> Result<(), Failure> {
    let mut out = io::stdout().lock();
    match out.write_all(text.as_bytes()).and_then(|()| out.flush()) {
        Err(error) if error.kind() != ErrorKind::BrokenPipe => {
            Err(Failure::Fault(format!("standard output cannot be written: {error}")))
        }
        _ => Ok(()),
    }
}

/// Writes a line to standard output, as [`print()`].
///
/// # Errors
/// As [`print()`].
pub fn line(text: impl std::fmt::Display) -> Result<(), Failure> {
    print(&format!("{text}\n"))
}

/// Writes a line to standard error, escaped; that nobody listens is no reason to stop.
pub fn say(text: &str) {
    let _ = writeln!(io::stderr(), "{}", printable(text));
}

/// A text whose control characters are escaped, ends of lines aside: a terminal obeys them, wherever they come from. So are characters that
/// change the direction of writing, which make a line look like another one.
pub fn printable(text: &str) -> Cow<'_, str> {
    let plain = |c: char| c == '\n' || !(c.is_control() || turns_writing(c));
    if text.chars().all(plain) {
        return Cow::Borrowed(text);
    }
    let mut escaped = String::with_capacity(text.len() + 16);
    for c in text.chars() {
        match c {
            '\t' => escaped.push(' '),
            c if plain(c) => escaped.push(c),
            c => {
                let _ = write!(escaped, "{}", c.escape_unicode());
            }
        }
    }
    Cow::Owned(escaped)
}

fn turns_writing(c: char) -> bool {
    matches!(c, '\u{200e}' | '\u{200f}' | '\u{202a}'..='\u{202e}' | '\u{2066}'..='\u{2069}')
}

/// A name for a column of a table: escaped, and cut where it would push the others out of sight.
pub fn name_in_table(name: &str) -> String {
    const MOST: usize = 60;
    let name = printable(name);
    match name.chars().count() {
        0..=MOST => name.into_owned(),
        _ => name.chars().take(MOST - 1).chain(['…']).collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_a_terminal_would_obey_is_escaped() {
        assert_eq!(printable("\u{1b}]0;owned\u{7}\u{1b}[2J"), "\\u{1b}]0;owned\\u{7}\\u{1b}[2J");
        assert_eq!(printable("a\u{9b}31m\u{7f}\r"), "a\\u{9b}31m\\u{7f}\\u{d}");
        assert_eq!(printable("\u{202e}evil"), "\\u{202e}evil");
        assert_eq!(printable("Füße\n2 – ✓"), "Füße\n2 – ✓");
    }

    #[test]
    fn long_names_are_cut_in_tables() {
        assert_eq!(name_in_table("l_arm"), "l_arm");
        let cut = name_in_table(&"x".repeat(70_000));
        assert!(cut.chars().count() == 60 && cut.ends_with('…'));
    }
}
