//! What a client of the service sees: its metrics, its WebSocket.

use std::collections::BTreeMap;
use std::net::{SocketAddr, TcpStream};

use serde_json::Value;
use tokio_tungstenite::tungstenite::client::IntoClientRequest;
use tokio_tungstenite::tungstenite::{self, Message, WebSocket};

/// `/metrics`, by the series' full name.
#[derive(Debug)]
pub struct Metrics(BTreeMap<String, f64>);

impl Metrics {
    pub fn parse(text: &str) -> Self {
        let lines = text.lines().filter(|line| !line.starts_with('#'));
        Self(
            lines.map(|l| l.rsplit_once(' ').unwrap()).map(|(k, v)| (k.into(), v.parse().unwrap())).collect(),
        )
    }

    /// The value of a series such as `gakp_camera_up{camera="gate"}`.
    #[track_caller]
    pub fn get(&self, series: &str) -> f64 {
        *self.0.get(series).unwrap_or_else(|| panic!("no series {series} in {:?}", self.0.keys()))
    }

    pub fn of(&self, name: &str, camera: &str) -> f64 {
        self.get(&format!("{name}{{camera=\"{camera}\"}}"))
    }

    pub fn dropped(&self, camera: &str, reason: &str) -> f64 {
        self.get(&format!("gakp_frames_dropped_total{{camera=\"{camera}\",reason=\"{reason}\"}}"))
    }

    /// A camera's account: frames in, tracked, dropped for any reason.
    pub fn account(&self, camera: &str) -> [u64; 3] {
        let prefix = format!("gakp_frames_dropped_total{{camera=\"{camera}\",");
        let dropped = self.0.iter().filter(|(series, _)| series.starts_with(&prefix)).map(|(_, v)| v).sum();
        let counts = [self.of("gakp_frames_in_total", camera), self.of("gakp_frames_tracked_total", camera)];
        [counts[0], counts[1], dropped].map(|count: f64| count as u64)
    }
}

/// A WebSocket client.
pub struct Socket {
    socket: WebSocket<TcpStream>,
}

impl Socket {
    pub fn open(stream: TcpStream, address: SocketAddr, path: &str, protocol: Option<&str>) -> Self {
        let header = protocol.map(|protocol| ("sec-websocket-protocol", protocol));
        Self::open_with(stream, address, path, header)
    }

    pub fn open_with(
        stream: TcpStream,
        address: SocketAddr,
        path: &str,
        header: Option<(&'static str, &str)>,
    ) -> Self {
        let mut request = format!("ws://{address}{path}").into_client_request().unwrap();
        if let Some((name, value)) = header {
            request.headers_mut().insert(name, value.parse().unwrap());
        }
        let (socket, _) = tungstenite::client(request, stream).expect("the handshake");
        Self { socket }
    }

    /// The next message that is no ping; an error when the connection is gone.
    pub fn message(&mut self) -> tungstenite::Result<Message> {
        loop {
            match self.socket.read()? {
                Message::Ping(_) | Message::Pong(_) => {}
                message => return Ok(message),
            }
        }
    }

    #[track_caller]
    pub fn json(&mut self) -> Value {
        match self.message() {
            Ok(Message::Text(text)) => serde_json::from_str(&text).unwrap(),
            other => panic!("not a text message: {other:?}"),
        }
    }

    #[track_caller]
    pub fn binary(&mut self) -> Vec<u8> {
        match self.message() {
            Ok(Message::Binary(bytes)) => bytes.into(),
            other => panic!("not a binary message: {other:?}"),
        }
    }

    /// Reads until the server closes; its close code.
    #[track_caller]
    pub fn closed(&mut self) -> u16 {
        loop {
            match self.message() {
                Ok(Message::Close(frame)) => return frame.expect("a close code").code.into(),
                Ok(_) => {}
                Err(error) => panic!("no goodbye: {error}"),
            }
        }
    }
}
