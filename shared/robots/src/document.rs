//! XML with positions and caps: a scan that bounds depth and size, then a read-only tree, then checked attributes.
//!
//! The scan comes first because neither urdf-rs nor the libraries below it bound anything: nesting, attributes per element
//! and elements are counted over the raw bytes, in one pass and without memory.

use std::borrow::Cow;
use std::cell::RefCell;
use std::fmt;
use std::path::Path;

use roxmltree::{Node, ParsingOptions};

use crate::error::{RobotError, Rule, Subject, shorten};
use crate::limits::{MAX_ATTRIBUTES, MAX_DEPTH, MAX_ELEMENTS};

/// A parsed file and its name for messages.
pub(crate) struct Document<'input> {
    pub file: &'input Path,
    xml: roxmltree::Document<'input>,
    /// Offsets of all line ends: every link and joint asks for its line.
    line_ends: Vec<u32>,
    warnings: RefCell<Vec<Warning>>,
}

/// Something that is read although it is not as it should be.
#[derive(Clone, Debug)]
pub(crate) struct Warning {
    /// What is wrong.
    pub error: RobotError,
    /// What is done instead.
    pub instead: &'static str,
}

impl fmt::Display for Warning {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: {}", self.error.fault(), self.instead)
    }
}

impl<'input> Document<'input> {
    /// Scans, then parses `text`; the root must be `<robot>`.
    pub(crate) fn parse(file: &'input Path, text: &'input str) -> Result<Self, RobotError> {
        scan(text.as_bytes()).map_err(|(offset, rule)| {
            RobotError::new(file, Some(line_of(text, offset)), Subject::File, rule)
        })?;
        let options = ParsingOptions {
            allow_dtd: false,
            nodes_limit: 8 * MAX_ELEMENTS as u32,
            ..ParsingOptions::default()
        };
        let xml = roxmltree::Document::parse_with_options(text, options).map_err(|error| {
            let line = error.pos().row;
            RobotError::new(file, Some(line), Subject::File, Rule::Xml(shorten(&error.to_string())))
        })?;
        let line_ends =
            (0u32..).zip(text.bytes()).filter(|&(_, byte)| byte == b'\n').map(|(at, _)| at).collect();
        let document = Self { file, xml, line_ends, warnings: RefCell::default() };
        let root = document.root();
        if root.tag_name().name() != "robot" {
            let found = shorten(root.tag_name().name());
            return Err(document.error(root, Subject::File, Rule::NotARobot { found }));
        }
        Ok(document)
    }

    pub(crate) fn root(&self) -> Node<'_, 'input> {
        self.xml.root_element()
    }

    pub(crate) fn line(&self, node: Node<'_, '_>) -> u32 {
        let start = node.range().start;
        1 + self.line_ends.partition_point(|&end| (end as usize) < start) as u32
    }

    pub(crate) fn error(&self, node: Node<'_, '_>, subject: Subject, rule: Rule) -> RobotError {
        RobotError::new(self.file, Some(self.line(node)), subject, rule)
    }

    /// Remembers something that is read all the same.
    pub(crate) fn warn(&self, error: RobotError, instead: &'static str) {
        self.warnings.borrow_mut().push(Warning { error, instead });
    }

    /// Everything that was remembered.
    pub(crate) fn take_warnings(&self) -> Vec<Warning> {
        self.warnings.take()
    }

    /// The one child element `name`, if there is one.
    pub(crate) fn child<'a>(
        &self,
        parent: Node<'a, 'input>,
        name: &str,
        subject: &Subject,
    ) -> Result<Option<Node<'a, 'input>>, RobotError> {
        let mut found = elements(parent, name);
        let first = found.next();
        match found.next() {
            Some(second) => {
                Err(self.error(second, subject.clone(), Rule::Repeated { element: name.to_owned() }))
            }
            None => Ok(first),
        }
    }

    /// As [`Document::child`], and it must be there; `what` is its name in the message.
    pub(crate) fn required<'a>(
        &self,
        parent: Node<'a, 'input>,
        name: &str,
        what: &'static str,
        subject: &Subject,
    ) -> Result<Node<'a, 'input>, RobotError> {
        self.child(parent, name, subject)?
            .ok_or_else(|| self.error(parent, subject.clone(), Rule::Missing { what }))
    }

    /// A non-empty attribute; `what` is its name in the message.
    pub(crate) fn text<'a>(
        &self,
        node: Node<'a, 'input>,
        attribute: &str,
        what: &'static str,
        subject: &Subject,
    ) -> Result<&'a str, RobotError> {
        match node.attribute(attribute) {
            Some(text) if !text.trim().is_empty() => Ok(text),
            _ => Err(self.error(node, subject.clone(), Rule::Missing { what })),
        }
    }

    /// Checks that an attribute, if present, is `N` finite numbers.
    pub(crate) fn finite<const N: usize>(
        &self,
        node: Node<'_, 'input>,
        attribute: &'static str,
        subject: &Subject,
    ) -> Result<Option<[f64; N]>, RobotError> {
        let expected = match N {
            1 => "one finite number",
            3 => "three finite numbers",
            _ => "four finite numbers",
        };
        self.numbers(node, attribute, subject, expected, f64::is_finite)
    }

    /// Checks that an attribute, if present, is one number, perhaps infinite.
    pub(crate) fn limit(
        &self,
        node: Node<'_, 'input>,
        attribute: &'static str,
        subject: &Subject,
    ) -> Result<Option<f64>, RobotError> {
        let value = self.numbers::<1>(node, attribute, subject, "one number", |x| !x.is_nan())?;
        Ok(value.map(|[value]| value))
    }

    fn numbers<const N: usize>(
        &self,
        node: Node<'_, 'input>,
        attribute: &'static str,
        subject: &Subject,
        expected: &'static str,
        accepted: impl Fn(f64) -> bool,
    ) -> Result<Option<[f64; N]>, RobotError> {
        let Some(text) = node.attribute(attribute) else { return Ok(None) };
        let mut numbers = [0.0; N];
        let mut words = text.split_whitespace();
        let complete = numbers.iter_mut().all(|number| {
            words.next().and_then(|word| word.parse().ok()).is_some_and(|value| {
                *number = value;
                accepted(value)
            })
        });
        if complete && words.next().is_none() {
            return Ok(Some(numbers));
        }
        let element = node.tag_name().name().to_owned();
        let rule = Rule::NotNumbers { element, attribute, text: shorten(text), expected };
        Err(self.error(node, subject.clone(), rule))
    }
}

/// Child elements of one name, in order.
pub(crate) fn elements<'a, 'input: 'a>(
    parent: Node<'a, 'input>,
    name: &str,
) -> impl Iterator<Item = Node<'a, 'input>> {
    parent.children().filter(move |node| node.is_element() && node.tag_name().name() == name)
}

/// Line number, from 1, of a byte offset.
pub(crate) fn line_of(text: &str, offset: usize) -> u32 {
    let before = &text.as_bytes()[..offset.min(text.len())];
    1 + before.iter().filter(|&&byte| byte == b'\n').count() as u32
}

/// The text with the content of comments that hold two dashes blanked out, and the lines of these. Many files have them as rulers; a
/// parser of XML has to refuse them.
pub(crate) fn without_dashes(text: &str) -> (Cow<'_, str>, Vec<u32>) {
    let (mut clean, mut lines) = (String::new(), Vec::new());
    let (mut at, mut copied, mut line) = (0, 0, 1);
    while let Some(open) = find(text.as_bytes(), at, b"<!--") {
        let Some(end) = find(text.as_bytes(), open + 4, b"-->") else { break };
        line += count_lines(&text[at..open]);
        let content = &text[open + 4..end];
        if content.contains("--") || content.ends_with('-') {
            clean.push_str(&text[copied..open + 4]);
            clean.extend(content.bytes().map(|byte| if byte == b'\n' { '\n' } else { ' ' }));
            copied = end;
            lines.push(line);
        }
        line += count_lines(&text[open..end + 3]);
        at = end + 3;
    }
    if lines.is_empty() {
        return (Cow::Borrowed(text), lines);
    }
    (Cow::Owned(clean + &text[copied..]), lines)
}

fn count_lines(text: &str) -> u32 {
    text.bytes().filter(|&byte| byte == b'\n').count() as u32
}

/// Bounds nesting, elements and attributes. Malformed XML is left to the parser.
fn scan(text: &[u8]) -> Result<(), (usize, Rule)> {
    let (mut depth, mut elements) = (0usize, 0usize);
    let mut at = 0;
    while let Some(open) = find(text, at, b"<") {
        let rest = &text[open..];
        at = if rest.starts_with(b"<!--") {
            after(text, open + 4, b"-->")
        } else if rest.starts_with(b"<![CDATA[") {
            after(text, open + 9, b"]]>")
        } else if rest.starts_with(b"<?") {
            after(text, open + 2, b"?>")
        } else if rest.starts_with(b"<!") {
            return Err((open, Rule::DocumentType));
        } else if rest.starts_with(b"</") {
            depth = depth.saturating_sub(1);
            after(text, open + 2, b">")
        } else {
            elements += 1;
            depth += 1;
            if elements > MAX_ELEMENTS {
                return Err((open, Rule::TooMany { what: "elements", limit: MAX_ELEMENTS }));
            }
            if depth > MAX_DEPTH {
                return Err((open, Rule::TooMany { what: "levels of nesting", limit: MAX_DEPTH }));
            }
            let (end, attributes, empty) = tag(text, open + 1);
            if attributes > MAX_ATTRIBUTES {
                return Err((open, Rule::TooMany { what: "attributes", limit: MAX_ATTRIBUTES }));
            }
            if empty {
                depth -= 1;
            }
            end
        };
    }
    Ok(())
}

/// End of a tag that starts before `at`, the number of its attributes, and whether it closes itself.
fn tag(text: &[u8], at: usize) -> (usize, usize, bool) {
    let mut quote = None;
    let mut attributes = 0;
    let mut last = 0;
    for (place, &byte) in text.iter().enumerate().skip(at) {
        match (quote, byte) {
            (Some(open), _) if byte == open => quote = None,
            (Some(_), _) => {}
            (None, b'"' | b'\'') => quote = Some(byte),
            (None, b'=') => attributes += 1,
            (None, b'>') => return (place + 1, attributes, last == b'/'),
            (None, _) => {}
        }
        last = byte;
    }
    (text.len(), attributes, false)
}

fn find(text: &[u8], at: usize, pattern: &[u8]) -> Option<usize> {
    let rest = text.get(at..)?;
    rest.windows(pattern.len()).position(|window| window == pattern).map(|place| at + place)
}

fn after(text: &[u8], at: usize, pattern: &[u8]) -> usize {
    find(text, at, pattern).map_or(text.len(), |place| place + pattern.len())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ordinary_xml_passes_the_scan() {
        let text = b"<?xml version='1.0'?><!-- <<< <a> == --><robot><a b='x > />' c=\"=\"/><d><![CDATA[<e>]]></d></robot>";
        assert_eq!(scan(text), Ok(()));
    }

    #[test]
    fn nesting_attributes_and_doctypes_are_bounded() {
        let deep = "<a>".repeat(MAX_DEPTH + 1);
        assert!(matches!(scan(deep.as_bytes()), Err((_, Rule::TooMany { what: "levels of nesting", .. }))));
        let wide = format!("<a {}/>", "b='' ".repeat(MAX_ATTRIBUTES + 1));
        assert!(matches!(scan(wide.as_bytes()), Err((0, Rule::TooMany { what: "attributes", .. }))));
        let many = "<a/>".repeat(MAX_ELEMENTS + 1);
        assert!(matches!(scan(many.as_bytes()), Err((_, Rule::TooMany { what: "elements", .. }))));
        assert_eq!(scan(b"<!DOCTYPE a [<!ENTITY b 'c'>]><a/>"), Err((0, Rule::DocumentType)));
    }

    #[test]
    fn unfinished_constructs_end_the_scan() {
        for text in ["<", "<a", "<a b='", "<!--", "<?", "</", "<![CDATA[", "<a b=c"] {
            assert_eq!(scan(text.as_bytes()), Ok(()), "{text}");
        }
    }
}
