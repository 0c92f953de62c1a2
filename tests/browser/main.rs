//! The pages in a real browser: headless Chromium, spoken to over its debugging protocol.
//!
//! Where there is no Chromium the tests say on standard error that they were skipped. Screenshots are left in the target folder's `tmp`.

#![allow(clippy::unwrap_used, clippy::panic, reason = "a test that cannot go on has failed")]

mod chromium;

use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};

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
    let cursors = "new Set(page.axis.plots.map((plot) => plot.cursor.style.transform)).size";
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

/// A browser without WebGL, and a printer: both show the robot all the same.
#[test]
fn the_report_shows_the_robot_without_webgl_and_on_paper() {
    let Some(mut browser) = Browser::start("the_report_shows_the_robot_without_webgl_and_on_paper") else {
        return;
    };
    let folder = reported_run("painter");
    let url = format!("file://{}", folder.join("report.html").display());
    let without = "const real = HTMLCanvasElement.prototype.getContext; \
        HTMLCanvasElement.prototype.getContext = function (kind, ...more) { \
        return kind.startsWith('webgl') ? null : real.call(this, kind, ...more); }";
    let mut page = browser.open_after(without, &url, [1400, 900], false);
    assert_eq!(page.value("page.view.gl"), serde_json::Value::Null);

    // The colours of the robot's right and left side and of the ball are in the picture.
    page.value(
        "globalThis.painted = (canvas) => { page.show(); \
         const pixels = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data; \
         const count = {orange: 0, blue: 0, yellow: 0}; \
         for (let i = 0; i < pixels.length; i += 4) { const [r, g, b] = pixels.subarray(i, i + 3); \
         if (r > 1.5 * b && r > 1.4 * g) count.orange++; else if (b > 1.4 * r) count.blue++; \
         else if (r > 150 && g > 120 && b < 60) count.yellow++; } return count; }",
    );
    let assert_painted = |painted: &serde_json::Value| {
        for colour in ["orange", "blue", "yellow"] {
            assert!(painted[colour].as_u64().unwrap() > 100, "{painted}");
        }
    };
    let first = page.value("painted(page.view.canvas)");
    assert_painted(&first);
    page.value("page.seek(0.45)");
    assert_ne!(page.value("painted(page.view.canvas)"), first, "the robot does not move");
    page.screenshot(&Path::new(TEMPORARY).join("report-painter.png"));

    // On paper the animation is replaced by a still copy of it, and there is nothing to press.
    page.send("Emulation.setEmulatedMedia", &json!({"media": "print"}));
    page.value("dispatchEvent(new Event('beforeprint'))");
    assert_painted(&page.value("painted($('print'))"));
    assert_eq!(page.value("getComputedStyle($('print')).display"), "block");
    assert_eq!(page.value("getComputedStyle($('transport')).display"), "none");
    page.screenshot(&Path::new(TEMPORARY).join("report-print.png"));
    assert_no_problems(&mut page);
    std::fs::remove_dir_all(folder).unwrap();
}

/// A run with a live page, and the page's address.
struct LiveRun {
    child: Child,
    address: String,
    folder: PathBuf,
}

impl LiveRun {
    fn start(name: &str, more: &[&str]) -> Self {
        let folder = Path::new(TEMPORARY).join(format!("browser-{name}"));
        let mut command = Command::new(env!("CARGO_BIN_EXE_delmpc"));
        command
            .args(["run", "--view", "--json", "--out", folder.to_str().unwrap()])
            .args(more)
            .current_dir(ROOT);
        let mut child =
            command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap();
        let mut lines = BufReader::new(child.stderr.take().unwrap()).lines().map_while(Result::ok);
        let address =
            lines.find_map(|line| Some(line.strip_prefix("open ")?.strip_suffix(" to begin")?.to_owned()));
        std::thread::spawn(move || lines.for_each(drop));
        Self { child, address: address.unwrap(), folder }
    }
}

impl Drop for LiveRun {
    fn drop(&mut self) {
        // Asked to end, it ends its processes too.
        let pid = rustix::process::Pid::from_child(&self.child);
        let _ = rustix::process::kill_process(pid, rustix::process::Signal::TERM);
        let _ = self.child.wait();
    }
}

#[test]
fn a_person_pulls_at_the_running_robot_and_pauses() {
    let Some(mut browser) = Browser::start("a_person_pulls_at_the_running_robot_and_pauses") else { return };
    let mut run = LiveRun::start(
        "live",
        &[
            "--set",
            "clock=lockstep",
            "--set",
            "duration_s=600",
            "--set",
            "push.impulse_ns=0",
            // It has to be where the page said a moment ago.
            "--set",
            "reach.start_s=3600",
        ],
    );
    let mut page = browser.open(&run.address, [1000, 640], false);
    page.wait_for("frames.rows > 20");

    // Press high on the torso, draw a little to the side, hold.
    let torso = "run.robot.bodies.findIndex((body) => body.name === 'utorso')";
    let place = format!(
        "(() => {{ const box = $('view').getBoundingClientRect(), body = {torso}; \
         const [x, y] = page.view.project(moved(page.motion.poses[body], [-0.2, 0, 0.7])); \
         return [x + box.left, y + box.top]; }})()"
    );
    let place = page.value(&place);
    let [x, y] = [0, 1].map(|i| place[i].as_f64().unwrap());
    page.mouse("mouseMoved", [x, y], false);
    page.mouse("mousePressed", [x, y], true);
    assert_eq!(page.value("page.live.held?.link"), "utorso");
    for step in 1..=6 {
        page.mouse("mouseMoved", [x + 3.0 * f64::from(step), y], true);
        std::thread::sleep(std::time::Duration::from_millis(30));
    }
    let push_n = "Math.hypot(...[0, 1, 2].map((i) => frames.at('push', frames.rows - 1, i)))";
    page.wait_for(&format!("{push_n} > 5"));
    page.screenshot(&Path::new(TEMPORARY).join("live.png"));
    page.mouse("mouseReleased", [x + 18.0, y], false);
    page.wait_for(&format!("{push_n} === 0"));

    // The world stands still until it goes on.
    page.value("$('play').click()");
    page.wait_for("$('outcome').textContent.includes('paused')");
    std::thread::sleep(std::time::Duration::from_millis(300));
    let stands_at = page.value("frames.end");
    std::thread::sleep(std::time::Duration::from_millis(300));
    assert_eq!(page.value("frames.end"), stands_at);
    page.value("$('play').click()");
    page.wait_for(&format!("frames.end > {stands_at}"));

    // Somebody ends it: the page is told, and remains to look back.
    let pid = rustix::process::Pid::from_child(&run.child);
    rustix::process::kill_process(pid, rustix::process::Signal::INT).unwrap();
    page.wait_for("page.live.over");
    assert_ne!(page.value("run.outcome"), serde_json::Value::Null, "the page was not told how it ended");
    assert_no_problems(&mut page);
    assert_eq!(run.child.wait().unwrap().code(), Some(130));

    // What the person did is in the log, and a replay does it again, bit by bit.
    let log = std::fs::read(run.folder.join("log.mcap")).unwrap();
    let messages =
        mcap::MessageStream::new(&log).unwrap().map(|message| message.unwrap().channel.topic.clone());
    let pulls = messages.filter(|topic| topic == delmpc::log::PULL).count();
    assert!(pulls >= 2, "{pulls} changes of the pull");
    let mut command = Command::new(env!("CARGO_BIN_EXE_delmpc"));
    let replay = command.args(["replay", run.folder.to_str().unwrap(), "--verify"]).output().unwrap();
    assert_eq!(replay.status.code(), Some(0), "{}", String::from_utf8_lossy(&replay.stdout));
    std::fs::remove_dir_all(&run.folder).unwrap();
}
