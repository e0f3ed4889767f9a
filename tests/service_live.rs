//! `gakp serve` as a real process: real RTSP cameras in, WebSocket, REST, metrics and the page out.
#![cfg(all(feature = "cli", feature = "service", feature = "testcam"))]

#[path = "service/account.rs"]
mod account;
#[path = "service/analytics.rs"]
mod analytics;
#[path = "service/clients.rs"]
mod clients;
#[path = "service/crashes.rs"]
mod crashes;
#[path = "service/ending.rs"]
mod ending;
#[path = "faults/expected.rs"]
mod expected;
#[path = "service/failures.rs"]
mod failures;
#[path = "service/faults.rs"]
mod faults;
#[path = "service/grpc.rs"]
mod grpc;
#[path = "grpc/client.rs"]
mod grpc_client;
#[path = "service/history.rs"]
mod history;
#[path = "service/ledger.rs"]
mod ledger;
#[path = "service/masks.rs"]
mod masks;
#[path = "service/overload.rs"]
mod overload;
#[path = "service/page.rs"]
mod page;
#[path = "browser/playwright.rs"]
mod playwright;
#[path = "webhook/receiver.rs"]
mod receiver;
#[path = "service/reload.rs"]
mod reload;
#[path = "service/rest.rs"]
mod rest;
#[path = "service/scores.rs"]
mod scores;
#[path = "service/secrets.rs"]
mod secrets;
#[path = "postgres/server.rs"]
mod server;
#[path = "service/support.rs"]
mod support;
#[path = "service/traces.rs"]
mod traces;
#[path = "service/tracks.rs"]
mod tracks;
#[path = "service/truth.rs"]
mod truth;
#[path = "service/typescript.rs"]
mod typescript;
#[path = "service/webhooks.rs"]
mod webhooks;
