//! The book that a subscriber keeps of what it was told.
#![allow(dead_code, reason = "tests and benchmarks use their own part")]

use std::collections::BTreeMap;
use std::time::Instant;

use jiff::Timestamp;
use tokio_tungstenite::tungstenite::{self, Message};

use super::support::*;

/// What a subscriber was told: reports and announced holes by camera, in order and without any hole
/// that was not announced.
#[derive(Debug, Default)]
pub struct Ledger {
    pub next: BTreeMap<String, u64>,
    pub epochs: BTreeMap<String, u64>,
    pub reports: u64,
    pub missed: u64,
    /// The age of the oldest report when it was read, seconds.
    pub oldest: f64,
    /// Whether epochs may change.
    new_epochs: bool,
}

impl Ledger {
    /// Of cameras that are paused and resumed: each epoch begins anew.
    pub fn by_epoch() -> Self {
        Self { new_epochs: true, ..Self::default() }
    }

    pub fn take(&mut self, message: &Message) {
        let Message::Text(text) = message else { panic!("not a text message: {message:?}") };
        let message: serde_json::Value = serde_json::from_str(text).unwrap();
        let camera = message["camera"].as_str().unwrap().to_owned();
        let epoch = message["epoch"].as_u64().unwrap();
        let before = self.epochs.insert(camera.clone(), epoch).unwrap_or(epoch);
        if epoch != before {
            assert!(self.new_epochs && epoch > before, "{message}");
            self.next.remove(&camera);
        }
        let (first, last) = match message.get("gap") {
            Some(gap) => (gap["first"].as_u64().unwrap(), gap["last"].as_u64().unwrap()),
            None => (message["seq"].as_u64().unwrap(), message["seq"].as_u64().unwrap()),
        };
        if message.get("gap").is_some() {
            assert!(message.get("seq").is_none() && last >= first, "{message}");
            self.missed += last - first + 1;
        } else {
            self.reports += 1;
            let captured: Timestamp = message["capture_ts"].as_str().unwrap().parse().unwrap();
            self.oldest = self.oldest.max(Timestamp::now().duration_since(captured).as_secs_f64());
        }
        // The first report tells where this subscriber began.
        let expected = self.next.insert(camera, last + 1).unwrap_or(first);
        assert_eq!(first, expected, "a hole that was not announced, or something twice: {message}");
    }

    /// Reads until `enough`, which is asked before every message.
    pub fn read(mut self, mut socket: Socket, enough: impl Fn(&Self) -> bool) -> (Self, Ended) {
        let since = Instant::now();
        while !enough(&self) {
            assert!(since.elapsed() < 4 * PATIENCE, "read on and on: {self:?}");
            match socket.message() {
                Ok(Message::Close(_)) => return (self, Ended::ByService),
                Ok(message) => self.take(&message),
                Err(tungstenite::Error::Io(error)) if error.kind() == std::io::ErrorKind::WouldBlock => {
                    panic!("nothing came for a long time: {self:?}")
                }
                Err(_) => return (self, Ended::ByService),
            }
        }
        (self, Ended::Enough)
    }
}

#[derive(Debug, PartialEq)]
pub enum Ended {
    Enough,
    ByService,
}
