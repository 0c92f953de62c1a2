//! Colours, on a terminal only: not in a pipe or a file, and not where the environment says `NO_COLOR` or `TERM=dumb`.

use std::io::IsTerminal;

/// Writes words in colour, or as they are.
#[derive(Debug, Clone, Copy)]
pub struct Colour {
    on: bool,
}

impl Colour {
    /// For what is written to a stream.
    pub fn of(stream: &impl IsTerminal) -> Self {
        let set = |name| std::env::var_os(name).filter(|value| !value.is_empty());
        let unwanted = set("NO_COLOR").is_some() || set("TERM").is_some_and(|term| term == "dumb");
        Self { on: stream.is_terminal() && !unwanted }
    }

    /// Without colours.
    pub const NONE: Self = Self { on: false };

    /// Green.
    pub fn good(self, text: &str) -> String {
        self.wrapped("32", text)
    }

    /// Red and bold.
    pub fn bad(self, text: &str) -> String {
        self.wrapped("1;31", text)
    }

    /// Grey.
    pub fn faint(self, text: &str) -> String {
        self.wrapped("2", text)
    }

    fn wrapped(self, code: &str, text: &str) -> String {
        if self.on { format!("\x1b[{code}m{text}\x1b[0m") } else { text.to_owned() }
    }
}
