//! The pages in a real browser: headless Chromium, spoken to over its debugging protocol.
//!
//! Where there is no Chromium the tests say on standard error that they were skipped. Screenshots are left in the target folder's `tmp`.

mod chromium;

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use chromium::{Browser, Page};
use serde_json::json;

const ROOT: &str = env!("CARGO_MANIFEST_DIR");
const TEMPORARY: &str = env!("CARGO_TARGET_TMPDIR");

/// A short run with reach and push, and its report.
fn reported_run(name: &str) -> PathBuf {
    let folder = Path::new(TEMPORARY).join(format!("browser-{name}"));
    let out = folder.to_str().unwrap();
    let set = |key| ["--set", key];
    let more =
        [set("clock=lockstep"), set("duration_s=0.6"), set("reach.start_s=0.1"), set("reach.deadline_s=0.3")]
            .concat();
    let push = [set("push.start_s=0.3"), set("push.impulse_ns=5"), set("push.duration_s=0.1")].concat();
    let mut command = Command::new(env!("CARGO_BIN_EXE_delmpc"));
    command.args(["run", "--json", "--one-process", "--out", out]).args(more).args(push);
    // Whether the robot meets its criteria in so short a time is not the question here.
    let output = command.current_dir(ROOT).stdin(Stdio::null()).output().unwrap();
    assert!(matches!(output.status.code(), Some(0 | 1)), "{}", String::from_utf8_lossy(&output.stderr));
    folder
}

fn assert_no_problems(page: &mut Page) {
    assert_eq!(page.problems(), Vec::<String>::new());
}

#[test]
fn the_report_shows_the_run() {
    let Some(mut browser) = Browser::start("the_report_shows_the_run") else { return };
    let folder = reported_run("report");
    let url = format!("file://{}", folder.join("report.html").display());
    let mut page = browser.open(&url, [1400, 900], false);

    // The robot's kinematics in the page are those of the plant.
    assert_eq!(page.value("frames.rows"), 61);
    assert_eq!(page.value("cycles.rows"), 120);
    let error_m = page.value("page.handError()").as_f64().unwrap();
    assert!(error_m < 1e-5, "the hand is {error_m} m from where the plant had it");

    // Something is drawn, and something else at another time.
    let picture = "(() => { page.show(); return page.view.canvas.toDataURL(); })()";
    page.value("page.seek(0.0)");
    let first = page.value(picture);
    page.value("page.seek(0.45)");
    let later = page.value(picture);
    assert!(first.as_str().unwrap().len() > 5000, "the picture is empty");
    assert_ne!(first, later);

    // One cursor in all plots; a click into a plot moves the animation.
    let cursors = "new Set(page.axis.plots.map((plot) => plot.cursor.getAttribute('transform').replace(/[^\\d. ]/g, '').split(' ')[0])).size";
    assert_eq!(page.value(cursors), 1, "all plots have the same width here");
    page.value("page.plots.com.svg.scrollIntoView({block: 'center'})");
    let place = page.value("(() => { const b = page.plots.com.svg.getBoundingClientRect(); return [b.left + page.plots.com.x(0.2), b.top + 60]; })()");
    page.click(place[0].as_f64().unwrap(), place[1].as_f64().unwrap());
    let time_s = page.value("page.time").as_f64().unwrap();
    assert!((time_s - 0.2).abs() < 0.01, "{time_s}");

    // Play moves on, the space bar stops.
    page.value("$('speed').value = '0.1'");
    page.value("$('play').click()");
    page.wait_for("page.time > 0.22");
    page.value("document.dispatchEvent(new KeyboardEvent('keydown', {key: ' '}))");
    assert_eq!(page.value("page.playing"), false);

    // Dragging turns the robot.
    page.value("scrollTo(0, 0)");
    let before = page.value("page.view.camera.azimuth");
    page.drag([400.0, 400.0], [520.0, 400.0]);
    assert_ne!(page.value("page.view.camera.azimuth"), before);
    page.screenshot(&Path::new(TEMPORARY).join("report.png"));
    assert_no_problems(&mut page);
    std::fs::remove_dir_all(folder).unwrap();
}

#[test]
fn the_report_fits_a_phone_and_both_schemes() {
    let Some(mut browser) = Browser::start("the_report_fits_a_phone_and_both_schemes") else { return };
    let folder = reported_run("phone");
    let url = format!("file://{}", folder.join("report.html").display());
    let mut page = browser.open(&url, [390, 844], true);
    assert_eq!(page.value("document.documentElement.scrollWidth <= 390"), true, "it can be pushed sideways");
    let narrow = "[...document.querySelectorAll('svg.plot')].every((plot) => plot.clientWidth > 300)";
    assert_eq!(page.value(narrow), true);
    let paper = "getComputedStyle(document.body).backgroundColor";
    let light = page.value(paper);
    page.send(
        "Emulation.setEmulatedMedia",
        &json!({"features": [{"name": "prefers-color-scheme", "value": "dark"}]}),
    );
    page.wait_for(&format!("{paper} !== {light}"));
    page.screenshot(&Path::new(TEMPORARY).join("report-phone.png"));
    assert_no_problems(&mut page);
    std::fs::remove_dir_all(folder).unwrap();
}
