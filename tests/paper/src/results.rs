//! Tables, bars and `paper.json`.

use std::fmt::Write as _;
use std::path::Path;

use serde::Serialize;
use serde_json::Value;

/// A table that becomes a CSV file.
#[derive(Clone, Debug, Default)]
pub struct Table {
    header: Vec<&'static str>,
    rows: Vec<Vec<String>>,
}

impl Table {
    /// With the names of its columns.
    pub fn new(header: &[&'static str]) -> Self {
        Self { header: header.to_vec(), rows: Vec::new() }
    }

    /// Appends a row.
    pub fn push(&mut self, row: Vec<String>) {
        self.rows.push(row);
    }

    /// Comma-separated, one line per row.
    pub fn csv(&self) -> String {
        let mut text = self.header.join(",");
        for row in &self.rows {
            let _ = write!(text, "\n{}", row.join(","));
        }
        text.push('\n');
        text
    }
}

/// Seven digits, short.
pub fn number(x: f64) -> String {
    if x == 0.0 || (1e-3..1e6).contains(&x.abs()) {
        let text = format!("{x:.7}");
        text.trim_end_matches('0').trim_end_matches('.').to_owned()
    } else {
        format!("{x:.6e}")
    }
}

/// Which side of a bar is good.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Side {
    /// The value must reach the bar.
    AtLeast,
    /// The value must not pass it.
    AtMost,
}

/// A figure with the bar it is held against.
#[derive(Clone, Debug, Serialize)]
pub struct Claim {
    /// What it is.
    pub claim: String,
    /// As measured.
    pub value: f64,
    /// Good side of the bar.
    pub side: Side,
    /// The bar.
    pub bar: f64,
    /// Whether the value is on the good side.
    pub met: bool,
}

impl Claim {
    /// `value` must reach `bar`.
    pub fn at_least(claim: impl Into<String>, value: f64, bar: f64) -> Self {
        Self { claim: claim.into(), value, side: Side::AtLeast, bar, met: value >= bar }
    }

    /// `value` must not pass `bar`.
    pub fn at_most(claim: impl Into<String>, value: f64, bar: f64) -> Self {
        Self { claim: claim.into(), value, side: Side::AtMost, bar, met: value <= bar }
    }
}

/// What a part of the campaign hands back.
#[derive(Clone, Debug, Default)]
pub struct Part {
    /// Name in `paper.json`.
    pub key: &'static str,
    /// Figures with bars.
    pub claims: Vec<Claim>,
    /// Everything else.
    pub facts: Value,
    /// File name and content.
    pub files: Vec<(String, String)>,
}

/// Writes text files of a part.
///
/// # Errors
/// Those of the file system.
pub fn write_files(folder: &Path, part: &Part) -> std::io::Result<()> {
    part.files.iter().try_for_each(|(name, text)| std::fs::write(folder.join(name), text))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn claims_and_numbers() {
        assert!(Claim::at_least("a", 2.0, 2.0).met && !Claim::at_most("b", 2.1, 2.0).met);
        assert!(!Claim::at_least("c", f64::NAN, 2.0).met && !Claim::at_most("d", f64::NAN, 2.0).met);
        assert_eq!(
            (number(0.25), number(1.5e-9), number(0.0)),
            ("0.25".into(), "1.500000e-9".into(), "0".into())
        );
        let mut table = Table::new(&["x", "y"]);
        table.push(vec!["1".into(), "2".into()]);
        assert_eq!(table.csv(), "x,y\n1,2\n");
    }
}
