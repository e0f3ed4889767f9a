//! The HTTP, WebSocket and gRPC edge, against a real server in this process with cameras that are made up.
#![cfg(feature = "service")]

#[path = "api/auth.rs"]
mod auth;
#[path = "api/grpc.rs"]
mod grpc;
#[path = "grpc/client.rs"]
mod grpc_client;
#[path = "webhook/receiver.rs"]
mod receiver;
#[path = "api/rest.rs"]
mod rest;
#[path = "api/rules.rs"]
mod rules;
#[path = "api/support.rs"]
mod support;
#[path = "api/tracks.rs"]
mod tracks;
#[path = "api/video.rs"]
mod video;
#[path = "api/webhooks.rs"]
mod webhooks;
