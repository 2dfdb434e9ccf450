//! A headless Chromium, driven over the DevTools protocol through a pipe: nothing to install beside
//! the browser itself.
#![allow(dead_code, clippy::unwrap_used, clippy::expect_used, clippy::panic)] // a panic is how a test fails
pub mod pictures;

use serde_json::{Value, json};
use std::io::{BufRead, BufReader, Write};
use std::process::{Child, ChildStdin, Command, Stdio};
use std::sync::mpsc::{Receiver, channel};
use std::time::{Duration, Instant};

/// Software rendering on two busy cores is slow.
const TIMEOUT: Duration = Duration::from_secs(90);

/// Usual names in Debian, Ubuntu, Fedora and from Google; `CHROMIUM` overrides.
const NAMES: [&str; 4] = ["chromium", "chromium-browser", "google-chrome", "google-chrome-stable"];

/// A Chromium on this machine; otherwise `None`, and a line that names the missing program.
pub fn installed() -> Option<String> {
    let named = std::env::var("CHROMIUM").ok();
    let runs = |name: &String| Command::new(name).arg("--version").output().is_ok_and(|o| o.status.success());
    let found = named.into_iter().chain(NAMES.map(String::from)).find(runs);
    if found.is_none() {
        println!("SKIPPED: no Chromium here; install the package chromium, or name the program in CHROMIUM");
    }
    found
}

/// One page of a browser, which ends when this value is dropped.
pub struct Page {
    child: Child,
    to: ChildStdin,
    from: Receiver<Value>,
    session: String,
    next: u64,
    /// Warnings and errors that the page logged, and exceptions.
    pub complaints: Vec<String>,
    /// URLs that the page requested.
    pub requests: Vec<String>,
    _profile: tempfile::TempDir,
}

impl Page {
    /// Opens an empty page in a window of this size, CSS pixels; `phone` adds touch.
    pub fn open(program: &str, width: u32, height: u32, phone: bool) -> Page {
        let profile = tempfile::tempdir().unwrap();
        // The browser reads commands from descriptor 3 and writes to 4: here its standard input and
        // output.
        let mut child = Command::new("sh")
            .args(["-c", "exec \"$@\" 3<&0 4>&1 0</dev/null 1>&2 2>/dev/null", "sh", program])
            .args([
                "--headless=new",
                "--remote-debugging-pipe",
                "--no-first-run",
                "--no-default-browser-check",
            ])
            // Chromium's sandbox does not start as root or in containers; the page is trusted.
            .args(["--no-sandbox", "--disable-dev-shm-usage", "--hide-scrollbars", "--mute-audio"])
            .args(["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-gpu-watchdog"])
            .args(["--disable-background-networking", "--disable-component-update", "--disable-sync"])
            .arg(format!("--user-data-dir={}", profile.path().display()))
            .arg(format!("--window-size={width},{height}"))
            .arg("about:blank")
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn()
            .unwrap();
        let (to, out) = (child.stdin.take().unwrap(), child.stdout.take().unwrap());
        let (sender, from) = channel();
        std::thread::spawn(move || {
            for message in BufReader::new(out).split(0).map_while(Result::ok) {
                if let Ok(value) = serde_json::from_slice(&message)
                    && sender.send(value).is_err()
                {
                    break;
                }
            }
        });
        let mut page = Page {
            child,
            to,
            from,
            session: String::new(),
            next: 0,
            complaints: Vec::new(),
            requests: Vec::new(),
            _profile: profile,
        };
        let target = page.call("Target.createTarget", json!({ "url": "about:blank" }))["targetId"].clone();
        let attach = json!({ "targetId": target, "flatten": true });
        page.session = page.call("Target.attachToTarget", attach)["sessionId"].as_str().unwrap().to_owned();
        for domain in ["Page", "Runtime", "Log", "Network"] {
            page.call(&format!("{domain}.enable"), json!({}));
        }
        page.call(
            "Emulation.setDeviceMetricsOverride",
            json!({ "width": width, "height": height, "deviceScaleFactor": 1, "mobile": phone }),
        );
        page.call("Emulation.setTouchEmulationEnabled", json!({ "enabled": phone }));
        page
    }

    /// Sends a command and waits for its result.
    pub fn call(&mut self, method: &str, params: Value) -> Value {
        self.next += 1;
        let id = self.next;
        let mut message = json!({ "id": id, "method": method, "params": params });
        if !self.session.is_empty() {
            message["sessionId"] = self.session.clone().into();
        }
        self.to.write_all(format!("{message}\0").as_bytes()).unwrap();
        let start = Instant::now();
        loop {
            let left = TIMEOUT.checked_sub(start.elapsed()).unwrap_or_default();
            let reply = self.from.recv_timeout(left).unwrap_or_else(|e| panic!("{method}: {e}"));
            if reply["id"] == id {
                assert!(reply["error"].is_null(), "{method}: {}", reply["error"]);
                return reply["result"].clone();
            }
            self.note(&reply);
        }
    }

    fn note(&mut self, event: &Value) {
        let params = &event["params"];
        match event["method"].as_str().unwrap_or_default() {
            "Runtime.exceptionThrown" => self.complaints.push(params["exceptionDetails"].to_string()),
            "Runtime.consoleAPICalled" if params["type"] == "error" || params["type"] == "warning" => {
                self.complaints.push(params["args"].to_string());
            }
            // Software rendering is slow, about which the driver warns.
            "Log.entryAdded" if !params["entry"]["text"].as_str().unwrap_or("").contains("GPU stall") => {
                self.complaints.push(params["entry"].to_string());
            }
            "Network.requestWillBeSent" => {
                self.requests.push(params["request"]["url"].as_str().unwrap_or_default().to_owned());
            }
            _ => {}
        }
    }

    /// Navigates to a URL and waits until the view is ready.
    pub fn go(&mut self, url: &str) {
        self.call("Page.navigate", json!({ "url": url }));
        let start = Instant::now();
        while self.run("document.readyState + typeof splatvk") != "completeobject" {
            assert!(start.elapsed() < TIMEOUT, "{url} does not load: {:?}", self.complaints);
            std::thread::sleep(Duration::from_millis(50));
        }
        self.run("splatvk.ready.then(() => splatvk.settled())");
    }

    /// Value of an expression; promises are awaited.
    pub fn run(&mut self, expression: &str) -> Value {
        let params = json!({ "expression": expression, "awaitPromise": true, "returnByValue": true });
        let result = self.call("Runtime.evaluate", params);
        assert!(result["exceptionDetails"].is_null(), "{expression}: {}", result["exceptionDetails"]);
        result["result"]["value"].clone()
    }

    /// Clicks the mouse, CSS pixels of the page.
    pub fn click(&mut self, x: f64, y: f64) {
        for kind in ["mousePressed", "mouseReleased"] {
            let params =
                json!({ "type": kind, "x": x, "y": y, "button": "left", "buttons": 1, "clickCount": 1 });
            self.call("Input.dispatchMouseEvent", params);
        }
        self.run("splatvk.settled()");
    }

    /// Presses and releases a key.
    pub fn press(&mut self, key: &str) {
        let mut params = json!({ "type": "keyDown", "key": key });
        if key.chars().count() == 1 {
            params["text"] = key.into();
        } else if key == "Enter" {
            params["text"] = "\r".into();
            params["windowsVirtualKeyCode"] = 13.into();
        }
        self.call("Input.dispatchKeyEvent", params);
        self.call("Input.dispatchKeyEvent", json!({ "type": "keyUp", "key": key }));
    }

    /// Clicks on the first element of a selector.
    pub fn click_on(&mut self, selector: &str) {
        self.run(&format!("document.querySelector({}).click()", json!(selector)));
    }

    /// Waits until an expression is true.
    pub fn wait_for(&mut self, expression: &str) {
        let look = format!(
            "new Promise((done, fail) => {{ const end = performance.now() + 30000; \
             const look = () => ({expression}) ? done(true) : performance.now() > end ? fail(Error('never')) : setTimeout(look, 20); look(); }})"
        );
        assert_eq!(self.run(&look), true, "{expression}");
    }

    /// Fills the field of a name and presses Enter.
    pub fn enter(&mut self, label: &str, text: &str) {
        self.run(&format!("document.querySelector('[aria-label=\"{label}\"]').focus()"));
        self.write(text);
        self.press("Enter");
    }

    /// Draws with the left button along positions of the page.
    pub fn draw(&mut self, path: &[[f64; 2]]) {
        let mut send = |kind: &str, [x, y]: [f64; 2]| {
            let button =
                json!({ "type": kind, "x": x, "y": y, "button": "left", "buttons": 1, "clickCount": 1 });
            self.call("Input.dispatchMouseEvent", button);
        };
        send("mousePressed", path[0]);
        path.iter().for_each(|at| send("mouseMoved", *at));
        send("mouseReleased", path[path.len() - 1]);
    }

    /// Types a text into the focused element.
    pub fn write(&mut self, text: &str) {
        self.call("Input.insertText", json!({ "text": text }));
    }

    /// The screen as PNG.
    pub fn screenshot(&mut self) -> Vec<u8> {
        let shot = self.call("Page.captureScreenshot", json!({ "format": "png" }));
        decoded(shot["data"].as_str().unwrap())
    }

    /// The view rendered from a photo's camera, at the photo's size.
    pub fn picture(&mut self, view: usize) -> image::RgbImage {
        let url = self.run(&format!(
            "splatvk.picture({view}).then((blob) => new Promise((done) => {{ const r = new FileReader(); \
             r.onload = () => done(r.result.split(',')[1]); r.readAsDataURL(blob); }}))"
        ));
        image::load_from_memory(&decoded(url.as_str().unwrap())).unwrap().to_rgb8()
    }
}

fn decoded(base64: &str) -> Vec<u8> {
    use base64::Engine;
    base64::engine::general_purpose::STANDARD.decode(base64).unwrap()
}

impl Drop for Page {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
