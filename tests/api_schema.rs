//! The API's description: held to the routes, to what is sent, and to what the running service answers.
#![cfg(all(feature = "cli", feature = "service", feature = "testcam"))]

#[path = "schema/document.rs"]
mod document;
#[path = "schema/messages.rs"]
mod messages;
#[path = "schema/running.rs"]
mod running;
#[path = "service/support.rs"]
mod support;
#[path = "schema/tools.rs"]
mod tools;
