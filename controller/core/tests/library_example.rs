//! The example of the README: it compiles, it does what it says, and the README quotes it as it is.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

#[path = "../examples/library.rs"]
mod library;

#[test]
fn the_example_stands_upright_in_the_end() {
    library::main().unwrap();
}

#[test]
fn the_readme_quotes_the_example_as_it_is() {
    let read =
        |file: &str| std::fs::read_to_string(format!("{}/{file}", env!("CARGO_MANIFEST_DIR"))).unwrap();
    let (example, readme) = (read("examples/library.rs"), read("../../README.md"));
    let lines = example.lines().skip_while(|line| !line.contains("--8<--")).skip(1);
    let quoted: Vec<&str> = lines
        .take_while(|line| !line.contains("--8<--"))
        .map(|line| line.strip_prefix("    ").unwrap_or(line))
        .collect();
    assert!((15..=25).contains(&quoted.len()), "{} lines", quoted.len());
    let quoted = quoted.join("\n");
    assert!(readme.contains(quoted.trim()), "README.md has another text than\n{quoted}");
}
