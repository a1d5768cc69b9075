//! Headless Chromium, driven over its DevTools protocol through two pipes (`--remote-debugging-pipe`): messages are
//! JSON with a zero byte at the end.

use std::collections::VecDeque;
use std::fs::{File, OpenOptions};
use std::io::{Read, Write};
use std::path::PathBuf;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use base64::Engine;
use serde_json::{Value, json};

const PATIENCE: Duration = Duration::from_secs(60);
/// Size of the window.
pub(crate) const SIZE: [u32; 2] = [1100, 700];

/// A page in a browser of its own.
pub(crate) struct Page {
    child: Child,
    to: File,
    from: File,
    buffer: VecDeque<u8>,
    calls: u64,
    session: String,
    /// What the page has complained of.
    complaints: Vec<String>,
    _folder: tempfile::TempDir,
}

/// The Chromium of this machine, if there is one.
fn chromium() -> Option<PathBuf> {
    let path = std::env::var_os("PATH")?;
    let names = ["chromium", "chromium-browser", "google-chrome"];
    std::env::split_paths(&path).flat_map(|folder| names.map(|name| folder.join(name))).find(|file| file.is_file())
}

impl Page {
    /// Opens `address`; none, with a printed line, where there is no Chromium.
    pub(crate) fn open(address: &str) -> Option<Page> {
        let Some(program) = chromium() else {
            println!("skipped: there is no Chromium in PATH (apt-get install chromium)");
            return None;
        };
        let folder = tempfile::Builder::new().prefix("lt-page-").tempdir_in("/tmp").expect("a folder");
        let [to, from] = ["to", "from"].map(|name| folder.path().join(name));
        let made = Command::new("mkfifo").args([&to, &from]).status().expect("mkfifo");
        assert!(made.success(), "mkfifo: {made}");
        // The browser wants its pipes as descriptors 3 and 4; a shell puts them there.
        let child = Command::new("sh")
            .args(["-c", "to=$1 from=$2; shift 2; exec \"$@\" 3<\"$to\" 4>\"$from\"", "sh"])
            .args([&to, &from, &program])
            .args(["--headless=new", "--remote-debugging-pipe", "--no-sandbox", "--disable-dev-shm-usage"])
            .args(["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-first-run", "--mute-audio"])
            .args(["--disable-background-networking", "--disable-component-update", "--disable-sync"])
            .arg(format!("--user-data-dir={}", folder.path().join("profile").display()))
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(File::create(folder.path().join("stderr")).expect("a file"))
            .spawn()
            .expect("the browser");
        let to = OpenOptions::new().write(true).open(&to).expect("the pipe to the browser");
        let from = File::open(&from).expect("the pipe from the browser");
        let (buffer, complaints) = (VecDeque::new(), Vec::new());
        let mut page = Page { child, to, from, buffer, calls: 0, session: String::new(), complaints, _folder: folder };
        let target = page.call("Target.createTarget", json!({ "url": "about:blank" }));
        let target = target["targetId"].as_str().expect("a target").to_string();
        let attached = page.call("Target.attachToTarget", json!({ "targetId": target, "flatten": true }));
        page.session = attached["sessionId"].as_str().expect("a session").to_string();
        for domain in ["Page", "Runtime", "Log"] {
            page.call(&format!("{domain}.enable"), json!({}));
        }
        let [width, height] = SIZE;
        let metrics = json!({ "width": width, "height": height, "deviceScaleFactor": 1, "mobile": false });
        page.call("Emulation.setDeviceMetricsOverride", metrics);
        page.call("Page.navigate", json!({ "url": address }));
        Some(page)
    }

    fn call(&mut self, method: &str, parameters: Value) -> Value {
        self.calls += 1;
        let mut message = json!({ "id": self.calls, "method": method, "params": parameters });
        if !self.session.is_empty() {
            message["sessionId"] = json!(self.session);
        }
        let mut bytes = message.to_string().into_bytes();
        bytes.push(0);
        self.to.write_all(&bytes).expect("the browser listens");
        loop {
            let answer = self.message();
            if answer["id"] == json!(self.calls) {
                assert!(answer["error"].is_null(), "{method}: {}", answer["error"]);
                return answer["result"].clone();
            }
            let what = &answer["params"];
            match answer["method"].as_str().unwrap_or_default() {
                "Runtime.exceptionThrown" => self.complaints.push(what["exceptionDetails"].to_string()),
                "Runtime.consoleAPICalled" if what["type"] == "error" => self.complaints.push(what["args"].to_string()),
                "Log.entryAdded" if what["entry"]["level"] == "error" => {
                    self.complaints.push(what["entry"].to_string())
                }
                _ => {}
            }
        }
    }

    fn message(&mut self) -> Value {
        loop {
            if let Some(end) = self.buffer.iter().position(|byte| *byte == 0) {
                let message: Vec<u8> = self.buffer.drain(..=end).collect();
                return serde_json::from_slice(&message[..end]).expect("JSON of the browser");
            }
            let mut bytes = vec![0; 1 << 16];
            let read = self.from.read(&mut bytes).expect("the browser answers");
            assert!(read > 0, "the browser has ended");
            self.buffer.extend(&bytes[..read]);
        }
    }

    /// The value of a JavaScript expression.
    pub(crate) fn value(&mut self, expression: &str) -> Value {
        let parameters = json!({ "expression": expression, "returnByValue": true, "awaitPromise": true });
        let result = self.call("Runtime.evaluate", parameters);
        assert!(result["exceptionDetails"].is_null(), "{expression}: {}", result["exceptionDetails"]);
        result["result"]["value"].clone()
    }

    /// Waits until an expression is true.
    pub(crate) fn wait_for(&mut self, expression: &str) {
        let start = Instant::now();
        while self.value(expression) != json!(true) {
            let seen = self.value("document.body.innerText");
            assert!(
                start.elapsed() < PATIENCE,
                "never true: {expression}\nthe page says: {seen}\n{:?}",
                self.complaints
            );
            std::thread::sleep(Duration::from_millis(30));
        }
    }

    /// The pixels of the canvas as they are on the screen.
    pub(crate) fn canvas(&mut self) -> Picture {
        let place = self.value(
            "(() => { const b = document.getElementById('view').getBoundingClientRect(); \
             return { x: b.x, y: b.y, width: b.width, height: b.height, scale: 1 }; })()",
        );
        // Two frames later everything that was asked for is drawn.
        self.value("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(() => done(1))))");
        let shot = self.call("Page.captureScreenshot", json!({ "format": "png", "clip": place }));
        decoded(shot["data"].as_str().expect("a picture"))
    }

    /// Keeps a picture of the whole page for people, where they say a folder for it.
    pub(crate) fn keep_picture(&mut self, name: &str) {
        let Some(folder) = std::env::var_os("LOOMTREE_TEST_PICTURES") else { return };
        let shot = self.call("Page.captureScreenshot", json!({ "format": "png" }));
        let bytes = base64::engine::general_purpose::STANDARD.decode(shot["data"].as_str().expect("a picture"));
        std::fs::write(PathBuf::from(folder).join(name), bytes.expect("base64")).expect("a picture");
    }

    /// What the page has complained of so far: errors of the console, exceptions.
    pub(crate) fn complaints(&mut self) -> Vec<String> {
        self.value("1");
        self.complaints.clone()
    }
}

impl Drop for Page {
    fn drop(&mut self) {
        // The browser ends its own processes when it is asked to.
        let _ = self.to.write_all(b"{\"id\":0,\"method\":\"Browser.close\"}\0");
        let start = Instant::now();
        while matches!(self.child.try_wait(), Ok(None)) && start.elapsed() < Duration::from_secs(10) {
            std::thread::sleep(Duration::from_millis(10));
        }
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Pixels of a part of the page.
pub(crate) struct Picture {
    /// From the top left, row by row.
    pub(crate) pixels: Vec<[u8; 3]>,
}

impl Picture {
    /// Share of the pixels that `is` holds for.
    pub(crate) fn share(&self, is: impl Fn([u8; 3]) -> bool) -> f64 {
        self.pixels.iter().filter(|pixel| is(**pixel)).count() as f64 / self.pixels.len() as f64
    }

    /// Share of the pixels that differ clearly from those of another picture of the same size.
    pub(crate) fn differs(&self, other: &Picture) -> f64 {
        assert_eq!(self.pixels.len(), other.pixels.len(), "two pictures of the same size");
        let apart = |a: &[u8; 3], b: &[u8; 3]| a.iter().zip(b).any(|(a, b)| a.abs_diff(*b) > 24);
        let pairs = self.pixels.iter().zip(&other.pixels);
        pairs.filter(|(a, b)| apart(a, b)).count() as f64 / self.pixels.len() as f64
    }
}

fn decoded(base64: &str) -> Picture {
    let bytes = base64::engine::general_purpose::STANDARD.decode(base64).expect("base64");
    let mut reader = png::Decoder::new(std::io::Cursor::new(bytes)).read_info().expect("a PNG");
    let mut pixels = vec![0; reader.output_buffer_size().expect("a size")];
    let info = reader.next_frame(&mut pixels).expect("pixels");
    let channels = info.color_type.samples();
    Picture { pixels: pixels.chunks_exact(channels).map(|pixel| [pixel[0], pixel[1], pixel[2]]).collect() }
}
