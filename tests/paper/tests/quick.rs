//! `paper --quick` runs through, and what it leaves behind is complete. Whether bars are met depends on the machine and is not asserted,
//! except where only numbers decide.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

use std::path::Path;
use std::process::Command;

use serde_json::Value;

const PARTS: [&str; 7] = ["figure_1", "figure_2", "figure_3", "table_1", "beyond", "energy", "constrained"];
const PICTURES: [&str; 5] = ["figure_1", "figure_2", "figure_3", "beyond", "energy"];

/// Claims about numbers, not times.
const CERTAIN: [&str; 8] = [
    "success, Newton minus quasi-Newton",
    "success of Newton up to 10 ms",
    "automatic differentiation gives",
    "uncertainty of the reference",
    "table 1",
    "order of",
    "energy error of the best",
    "tip pinned",
];

fn lines(path: &Path) -> usize {
    std::fs::read_to_string(path).unwrap().lines().count()
}

#[test]
fn the_quick_campaign_is_complete() {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("paper_quick");
    let output =
        Command::new(env!("CARGO_BIN_EXE_paper")).args(["--quick", "--out"]).arg(&folder).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let summary: Value = serde_json::from_slice(&std::fs::read(folder.join("paper.json")).unwrap()).unwrap();
    assert_eq!(summary["quick"], true);
    assert!(summary["machine"].as_str().is_some_and(|name| !name.is_empty()));
    let mut count = 0;
    for part in PARTS {
        let claims = summary["parts"][part]["claims"].as_array().expect(part);
        assert!(!claims.is_empty(), "{part}");
        for claim in claims {
            count += 1;
            let text = claim["claim"].as_str().unwrap();
            for key in ["value", "bar", "met", "side"] {
                assert!(claim.get(key).is_some(), "{text}: {key}");
            }
            if CERTAIN.iter().any(|certain| text.contains(certain)) {
                assert_eq!(claim["met"], true, "{text}: {}", claim["value"]);
            }
        }
        assert!(summary["parts"][part]["figures"].is_object(), "{part}");
        assert!(lines(&folder.join(format!("{part}.csv"))) > 2, "{part}");
    }
    assert_eq!(summary["bars"], count);
    for picture in PICTURES.iter().chain(&["constrained"]) {
        let png = std::fs::read(folder.join(format!("{picture}.png"))).unwrap();
        assert!(png.starts_with(b"\x89PNG") && png.len() > 10_000, "{picture}");
        let svg = std::fs::read_to_string(folder.join(format!("{picture}.svg"))).unwrap();
        assert!(svg.contains("<text") && svg.trim_end().ends_with("</svg>"), "{picture}");
    }
}

#[test]
fn an_unwritable_folder_is_told_by_name() {
    let output =
        Command::new(env!("CARGO_BIN_EXE_paper")).args(["--quick", "--out", "/proc/paper"]).output().unwrap();
    assert!(!output.status.success());
    assert!(String::from_utf8_lossy(&output.stderr).contains("/proc/paper"));
}
