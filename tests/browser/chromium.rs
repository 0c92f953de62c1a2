//! A headless Chromium and its pages, over the debugging protocol.

use std::io::{BufRead, BufReader, Write};
use std::net::TcpStream;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use serde_json::{Value, json};
use tungstenite::stream::MaybeTlsStream;
use tungstenite::{Message, WebSocket};

/// A page that does not come within this time never will.
const PATIENCE: Duration = Duration::from_secs(120);

/// A running browser; ended when dropped.
pub struct Browser {
    child: Child,
    address: String,
    profile: PathBuf,
}

impl Browser {
    /// Starts the browser; where there is none, says that the test is skipped.
    pub fn start(test: &str) -> Option<Self> {
        let profile =
            Path::new(env!("CARGO_TARGET_TMPDIR")).join(format!("chromium-{test}-{}", std::process::id()));
        let started = ["chromium", "chromium-browser", "google-chrome"].into_iter().find_map(|name| {
            let mut command = Command::new(name);
            command.args([
                "--headless=new",
                "--no-sandbox",
                "--remote-debugging-port=0",
                "--no-first-run",
                "--disable-quic",
            ]);
            command.args(["--disable-background-networking", "--disable-component-update", "--disable-sync"]);
            // WebGL without a graphics card.
            command.args(["--use-angle=swiftshader", "--enable-unsafe-swiftshader"]);
            command.arg(format!("--user-data-dir={}", profile.display())).arg("about:blank");
            command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::piped()).spawn().ok()
        });
        let Some(mut child) = started else {
            // Past the capture of the test harness: who runs this should know.
            let _ = writeln!(std::io::stderr(), "SKIPPED {test}: there is no Chromium here");
            return None;
        };
        let mut lines = BufReader::new(child.stderr.take().unwrap()).lines().map_while(Result::ok);
        let address = lines.find_map(|line| line.strip_prefix("DevTools listening on ").map(str::to_owned));
        // Its further words must go somewhere.
        std::thread::spawn(move || lines.for_each(drop));
        Some(Self { child, address: address.unwrap(), profile })
    }

    /// Opens a page and waits until its script is through.
    pub fn open(&mut self, url: &str, size: [u32; 2], mobile: bool) -> Page {
        self.open_after("", url, size, mobile)
    }

    /// The same after a script of ours has run in the empty page.
    pub fn open_after(&mut self, script: &str, url: &str, [width, height]: [u32; 2], mobile: bool) -> Page {
        let (socket, _) = tungstenite::connect(&self.address).unwrap();
        if let MaybeTlsStream::Plain(stream) = socket.get_ref() {
            stream.set_read_timeout(Some(PATIENCE)).unwrap();
        }
        let mut page = Page { socket, session: None, count: 0, problems: Vec::new() };
        let target = page.send("Target.createTarget", &json!({"url": "about:blank"}))["targetId"].clone();
        let session = page.send("Target.attachToTarget", &json!({"targetId": target, "flatten": true}));
        page.session = session["sessionId"].as_str().map(str::to_owned);
        for domain in ["Page.enable", "Runtime.enable", "Log.enable"] {
            page.send(domain, &json!({}));
        }
        let metrics = json!({"width": width, "height": height, "deviceScaleFactor": 1, "mobile": mobile});
        page.send("Emulation.setDeviceMetricsOverride", &metrics);
        page.send("Page.addScriptToEvaluateOnNewDocument", &json!({"source": script}));
        page.send("Page.navigate", &json!({"url": url}));
        page.wait_for("typeof page === 'object'");
        page
    }
}

impl Drop for Browser {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
        let _ = std::fs::remove_dir_all(&self.profile);
    }
}

/// A page in the browser.
pub struct Page {
    socket: WebSocket<MaybeTlsStream<TcpStream>>,
    session: Option<String>,
    count: u64,
    problems: Vec<String>,
}

impl Page {
    /// Sends a command and waits for its answer; what is reported meanwhile is kept.
    pub fn send(&mut self, method: &str, parameters: &Value) -> Value {
        self.count += 1;
        let mut request = json!({"id": self.count, "method": method, "params": parameters});
        if let Some(session) = &self.session {
            request["sessionId"] = json!(session);
        }
        self.socket.send(Message::text(request.to_string())).unwrap();
        loop {
            let Message::Text(text) = self.socket.read().unwrap() else { continue };
            let answer: Value = serde_json::from_str(&text).unwrap();
            let parameters = &answer["params"];
            match answer["method"].as_str() {
                Some("Runtime.exceptionThrown") => {
                    self.problems.push(parameters["exceptionDetails"].to_string())
                }
                Some("Log.entryAdded") if parameters["entry"]["level"] == "error" => {
                    self.problems.push(parameters["entry"].to_string());
                }
                _ => {}
            }
            if answer["id"] == self.count {
                assert_eq!(answer.get("error"), None, "{method}");
                return answer["result"].clone();
            }
        }
    }

    /// The value of an expression in the page.
    pub fn value(&mut self, expression: &str) -> Value {
        let parameters = json!({"expression": expression, "returnByValue": true, "awaitPromise": true});
        let answer = self.send("Runtime.evaluate", &parameters);
        assert_eq!(answer.get("exceptionDetails"), None, "{expression}");
        answer["result"]["value"].clone()
    }

    /// Waits until an expression is true.
    pub fn wait_for(&mut self, expression: &str) {
        let begin = Instant::now();
        while self.value(&format!("Boolean({expression})")) != true {
            assert!(begin.elapsed() < PATIENCE, "{expression} did not become true: {:?}", self.problems);
            std::thread::sleep(Duration::from_millis(20));
        }
    }

    /// What went wrong in the page so far.
    pub fn problems(&mut self) -> Vec<String> {
        self.value("0");
        self.problems.clone()
    }

    /// A mouse event at a place of the window.
    pub fn mouse(&mut self, kind: &str, [x, y]: [f64; 2], pressed: bool) {
        let button = if pressed || kind == "mouseReleased" { "left" } else { "none" };
        let buttons = u32::from(pressed);
        let event =
            json!({"type": kind, "x": x, "y": y, "button": button, "buttons": buttons, "clickCount": 1});
        self.send("Input.dispatchMouseEvent", &event);
    }

    /// A click.
    pub fn click(&mut self, x: f64, y: f64) {
        self.mouse("mouseMoved", [x, y], false);
        self.mouse("mousePressed", [x, y], true);
        self.mouse("mouseReleased", [x, y], false);
    }

    /// Press, move in steps, release.
    pub fn drag(&mut self, from: [f64; 2], to: [f64; 2]) {
        self.mouse("mouseMoved", from, false);
        self.mouse("mousePressed", from, true);
        for step in 1..=8 {
            let part = f64::from(step) / 8.0;
            self.mouse("mouseMoved", [0, 1].map(|i| from[i] + part * (to[i] - from[i])), true);
        }
        self.mouse("mouseReleased", to, false);
    }

    /// Leaves a picture of the window.
    pub fn screenshot(&mut self, file: &Path) {
        let answer = self.send("Page.captureScreenshot", &json!({}));
        let mut bits = 0_u32;
        let mut count = 0;
        let mut bytes = Vec::new();
        for letter in answer["data"].as_str().unwrap().bytes() {
            let digit = match letter {
                b'A'..=b'Z' => letter - b'A',
                b'a'..=b'z' => letter - b'a' + 26,
                b'0'..=b'9' => letter - b'0' + 52,
                b'+' => 62,
                b'/' => 63,
                _ => break,
            };
            bits = bits << 6 | u32::from(digit);
            count += 6;
            if count >= 8 {
                count -= 8;
                bytes.push((bits >> count) as u8);
            }
        }
        std::fs::write(file, bytes).unwrap();
    }
}
