//! Drives a headless Chromium over the Chrome DevTools Protocol: open a page, run JavaScript in it,
//! take pictures of it. Needs nothing but the browser.
#![allow(dead_code, reason = "each test binary uses its own part")]

use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use futures::{SinkExt, StreamExt};
use serde_json::{Value, json};
use tokio::net::TcpStream;
use tokio::time::{sleep, timeout};
use tokio_tungstenite::tungstenite::Message;
use tokio_tungstenite::tungstenite::protocol::WebSocketConfig;
use tokio_tungstenite::{WebSocketStream, client_async_with_config};

const CHROMIUM: &str = "/usr/bin/chromium";
const PATIENCE: Duration = Duration::from_secs(30);

/// A running browser with a fresh profile; it ends when dropped.
pub struct Browser {
    child: Child,
    socket: WebSocketStream<TcpStream>,
    next: u64,
    /// What pages wrote to their consoles as errors, and scripts' exceptions.
    errors: Vec<String>,
    _profile: tempfile::TempDir,
}

/// A page (tab) of the browser.
#[derive(Clone, Debug)]
pub struct Page(String);

impl Browser {
    /// Starts a browser; `None`, said loudly, when there is none on this machine. Where the
    /// environment has `CI`, a missing browser is a failure.
    pub async fn start() -> Option<Self> {
        if !Path::new(CHROMIUM).exists() {
            assert!(std::env::var_os("CI").is_none(), "{CHROMIUM} is missing; CI must have it");
            eprintln!("SKIPPED: {CHROMIUM} is missing; install `chromium` to test the page in a browser");
            return None;
        }
        let profile = tempfile::tempdir().expect("a folder for the browser's profile");
        let child = Command::new(CHROMIUM)
            .args(["--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run"])
            .args(["--disable-background-networking", "--disable-component-update", "--disable-sync"])
            .args(["--disable-dev-shm-usage", "--window-size=1280,1000", "--remote-debugging-port=0"])
            .arg(format!("--user-data-dir={}", profile.path().display()))
            .arg("about:blank")
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .expect("the browser starts");
        // It writes its port and path here once it listens.
        let file = profile.path().join("DevToolsActivePort");
        let listening = timeout(PATIENCE, async {
            loop {
                let text = std::fs::read_to_string(&file).unwrap_or_default();
                if let Some((port, path)) = text.split_once('\n').filter(|(_, path)| !path.is_empty()) {
                    return (port.parse::<u16>().expect("a port"), path.trim().to_owned());
                }
                sleep(Duration::from_millis(20)).await;
            }
        });
        let (port, path) = listening.await.expect("the browser listens");
        let stream = TcpStream::connect(("127.0.0.1", port)).await.expect("the browser's port");
        // Screenshots come as one message of some megabytes.
        let config = WebSocketConfig::default().max_message_size(None).max_frame_size(None);
        let url = format!("ws://127.0.0.1:{port}{path}");
        let (socket, _) = client_async_with_config(url, stream, Some(config)).await.expect("the protocol");
        Some(Self { child, socket, next: 1, errors: Vec::new(), _profile: profile })
    }

    /// Opens `url` in a new page.
    pub async fn open(&mut self, url: &str) -> Page {
        let target = self.call(None, "Target.createTarget", json!({"url": "about:blank"})).await;
        let attach = json!({"targetId": target["targetId"], "flatten": true});
        let session = self.call(None, "Target.attachToTarget", attach).await;
        let page = Page(session["sessionId"].as_str().expect("a session").to_owned());
        for domain in ["Runtime.enable", "Log.enable", "Page.enable"] {
            self.call(Some(&page), domain, json!({})).await;
        }
        self.call(Some(&page), "Page.navigate", json!({"url": url})).await;
        page
    }

    /// The value of a JavaScript expression, promises awaited.
    pub async fn eval(&mut self, page: &Page, expression: &str) -> Value {
        let what = json!({"expression": expression, "awaitPromise": true, "returnByValue": true});
        let answer = self.call(Some(page), "Runtime.evaluate", what).await;
        if let Some(problem) = answer.get("exceptionDetails") {
            panic!("{expression}: {problem}");
        }
        answer["result"].get("value").cloned().unwrap_or(Value::Null)
    }

    /// Evaluates until it is truthy (at most half a minute); the value.
    pub async fn wait_for(&mut self, page: &Page, what: &str, expression: &str) -> Value {
        let expression = format!("(() => {{ try {{ return {expression}; }} catch {{ return null; }} }})()");
        for _ in 0..PATIENCE.as_millis() / 50 {
            let value = self.eval(page, &expression).await;
            if !matches!(value, Value::Null | Value::Bool(false)) && value != json!(0) && value != json!("") {
                return value;
            }
            sleep(Duration::from_millis(50)).await;
        }
        let body = self.eval(page, "document.body?.innerText").await;
        panic!("waited in vain: {what}\nthe page says: {body}\nerrors: {:?}", self.errors);
    }

    /// The visible part of the page as PNG.
    pub async fn screenshot(&mut self, page: &Page) -> Vec<u8> {
        let shot = self.call(Some(page), "Page.captureScreenshot", json!({"format": "png"})).await;
        base64(shot["data"].as_str().expect("a picture"))
    }

    /// Sets the size of the page in CSS pixels, and whether the user prefers dark colours.
    pub async fn emulate(&mut self, page: &Page, (width, height): (u32, u32), dark: bool) {
        let metrics =
            json!({"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 600});
        self.call(Some(page), "Emulation.setDeviceMetricsOverride", metrics).await;
        let scheme = if dark { "dark" } else { "light" };
        let media = json!({"features": [{"name": "prefers-color-scheme", "value": scheme}]});
        self.call(Some(page), "Emulation.setEmulatedMedia", media).await;
    }

    /// Errors of pages since the last call.
    pub fn take_errors(&mut self) -> Vec<String> {
        std::mem::take(&mut self.errors)
    }

    /// Calls a method of the protocol; panics with its error.
    pub async fn call(&mut self, page: Option<&Page>, method: &str, params: Value) -> Value {
        let id = self.next;
        self.next += 1;
        let mut request = json!({"id": id, "method": method, "params": params});
        if let Some(Page(session)) = page {
            request["sessionId"] = json!(session);
        }
        self.socket.send(Message::Text(request.to_string().into())).await.expect("the browser listens");
        loop {
            let message = timeout(PATIENCE, self.socket.next()).await;
            let message =
                message.unwrap_or_else(|_| panic!("{method}: no answer")).expect("the browser is there");
            let Message::Text(text) = message.expect("a sound message") else { continue };
            let mut message: Value = serde_json::from_str(&text).expect("JSON");
            if message["id"] == json!(id) {
                assert!(message.get("error").is_none(), "{method}: {}", message["error"]);
                return message["result"].take();
            }
            self.note(&message);
        }
    }

    fn note(&mut self, event: &Value) {
        let params = &event["params"];
        let error = match event["method"].as_str() {
            Some("Runtime.exceptionThrown") => &params["exceptionDetails"],
            Some("Runtime.consoleAPICalled") if params["type"] == "error" => &params["args"],
            Some("Log.entryAdded") if params["entry"]["level"] == "error" => &params["entry"],
            _ => return,
        };
        self.errors.push(error.to_string());
    }
}

impl Drop for Browser {
    fn drop(&mut self) {
        // Its helper processes end with it.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Decodes standard base64 (RFC 4648) as the protocol sends it.
fn base64(text: &str) -> Vec<u8> {
    let value = |c: u8| match c {
        b'A'..=b'Z' => c - b'A',
        b'a'..=b'z' => c - b'a' + 26,
        b'0'..=b'9' => c - b'0' + 52,
        b'+' => 62,
        b'/' => 63,
        _ => panic!("{c} is not base64"),
    };
    let digits: Vec<u8> = text.bytes().filter(|c| *c != b'=').map(value).collect();
    let mut bytes = Vec::with_capacity(digits.len() * 3 / 4);
    for group in digits.chunks(4) {
        let bits = group.iter().fold(0u32, |bits, d| bits << 6 | u32::from(*d)) << (6 * (4 - group.len()));
        bytes.extend(&bits.to_be_bytes()[1..group.len()]);
    }
    bytes
}
