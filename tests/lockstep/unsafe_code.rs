//! `unsafe` is where SECURITY.md says, as often as it says, and every block says why it is sound.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

const ROOT: &str = env!("CARGO_MANIFEST_DIR");
/// Lines above a block in which its SAFETY comment has to be.
const NEAR: usize = 8;

/// Every Rust file of the repository.
fn sources(folder: &Path, list: &mut Vec<PathBuf>) {
    for entry in fs::read_dir(folder).unwrap().flatten() {
        let (path, name) = (entry.path(), entry.file_name().to_string_lossy().into_owned());
        if path.is_dir() && !path.is_symlink() && name != "target" && name != "runs" && !name.starts_with('.')
        {
            sources(&path, list);
        } else if name.ends_with(".rs") {
            list.push(path);
        }
    }
}

/// Source without comments and texts, line by line: what is left of them is blank.
fn code(source: &str) -> Vec<String> {
    let chars: Vec<char> = source.chars().collect();
    let mut out = String::new();
    let mut at = 0;
    let blank = |c: char| if c == '\n' { '\n' } else { ' ' };
    while at < chars.len() {
        let rest = &chars[at..];
        let length = match rest {
            ['/', '/', ..] => rest.iter().position(|c| *c == '\n').unwrap_or(rest.len()),
            ['/', '*', ..] => {
                let end = rest.windows(2).skip(2).position(|pair| pair == ['*', '/']);
                end.map_or(rest.len(), |end| end + 4)
            }
            ['r', '#', ..] | ['r', '"', ..] if at == 0 || !is_word(chars[at - 1]) => raw_text(rest),
            ['"', ..] => text(rest),
            // A character, no lifetime.
            ['\'', '\\', ..] => 3 + rest[2..].iter().skip(1).position(|c| *c == '\'').unwrap_or(0) + 1,
            ['\'', _, '\'', ..] => 3,
            _ => 0,
        };
        if length == 0 {
            out.push(chars[at]);
            at += 1;
        } else {
            out.extend(rest.iter().take(length).map(|c| blank(*c)));
            at += length;
        }
    }
    out.lines().map(str::to_owned).collect()
}

fn is_word(c: char) -> bool {
    c.is_alphanumeric() || c == '_'
}

/// Length of a text from its quote on.
fn text(rest: &[char]) -> usize {
    let mut at = 1;
    while at < rest.len() {
        match rest[at] {
            '\\' => at += 2,
            '"' => return at + 1,
            _ => at += 1,
        }
    }
    rest.len()
}

/// Length of a raw text; 0: it is none, but a raw name.
fn raw_text(rest: &[char]) -> usize {
    let hashes = rest[1..].iter().take_while(|c| **c == '#').count();
    if rest.get(1 + hashes) != Some(&'"') {
        return 0;
    }
    let end: Vec<char> = std::iter::once('"').chain(std::iter::repeat_n('#', hashes)).collect();
    let body = &rest[2 + hashes..];
    let found = body.windows(end.len()).position(|window| window == end);
    found.map_or(rest.len(), |found| 2 + hashes + found + end.len())
}

/// Columns at which the word stands in a line.
fn words(line: &str) -> Vec<usize> {
    line.match_indices("unsafe")
        .map(|(at, _)| at)
        .filter(|&at| {
            let before = line[..at].chars().next_back().is_none_or(|c| !is_word(c));
            before && line[at + 6..].chars().next().is_none_or(|c| !is_word(c))
        })
        .collect()
}

/// The table of SECURITY.md: file and count.
fn documented() -> BTreeMap<String, usize> {
    let text = fs::read_to_string(Path::new(ROOT).join(".github/SECURITY.md")).unwrap();
    let section = text.split("## Unsafe code").nth(1).unwrap().split("\n## ").next().unwrap();
    let rows = section.lines().filter(|line| line.starts_with("| `"));
    rows.map(|row| {
        let cells: Vec<&str> = row.split('|').map(str::trim).collect();
        (cells[1].trim_matches('`').to_owned(), cells[2].parse().unwrap())
    })
    .collect()
}

#[test]
fn unsafe_code_is_where_security_md_says_and_says_why() {
    let mut list = Vec::new();
    sources(Path::new(ROOT), &mut list);
    assert!(list.len() > 200, "{} files", list.len());
    let mut found = BTreeMap::new();
    for path in list {
        let source = fs::read_to_string(&path).unwrap();
        let name = path.strip_prefix(ROOT).unwrap().to_str().unwrap().to_owned();
        let (lines, original): (Vec<String>, Vec<&str>) = (code(&source), source.lines().collect());
        let mut count = 0;
        for (number, line) in lines.iter().enumerate() {
            for at in words(line) {
                count += 1;
                let after = line[at + 6..].trim_start();
                if after.starts_with('{') || after.starts_with("impl") {
                    let above = &original[number.saturating_sub(NEAR)..=number];
                    let explained = above.iter().any(|line| line.contains("SAFETY"));
                    assert!(explained, "{name}:{}: no SAFETY comment", number + 1);
                }
            }
        }
        if count > 0 {
            found.insert(name, count);
        }
    }
    assert_eq!(
        found,
        documented(),
        "found in the code on the left, written in .github/SECURITY.md on the right"
    );
}

#[test]
fn comments_and_texts_are_no_code() {
    let source = "let a = \"unsafe\"; // unsafe\n/* unsafe\nunsafe */ let b = r#\"unsafe \" \"#; let c = '\"'; unsafe {}\n#![allow(unsafe_code)]";
    let counts: Vec<usize> = code(source).iter().map(|line| words(line).len()).collect();
    assert_eq!(counts, [0, 0, 1, 0]);
}
