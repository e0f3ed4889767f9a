//! A real receiver of webhooks: keeps what is posted, answers by a script.
#![allow(dead_code, reason = "each test binary uses its own part")]

use std::sync::{Arc, Mutex};
use std::time::Instant;

use axum::Router;
use axum::body::Bytes;
use axum::http::{HeaderMap, StatusCode};
use axum::response::{IntoResponse, Response};
use axum::routing::post;
use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use gakp::analytics::{Direction, Happening, Point, RuleId, What};
use gakp::types::{ClassId, TrackId};
use serde_json::Value;
use tokio::net::TcpListener;

/// 32 bytes.
pub const SECRET: &str = "whsec_MDEyMzQ1Njc4OTAxMjM0NTY3ODkwMTIzNDU2Nzg5MDE=";

/// A post as it arrived.
#[derive(Clone)]
pub struct Post {
    pub at: Instant,
    pub headers: HeaderMap,
    body: Bytes,
}

impl Post {
    pub fn header(&self, name: &str) -> &str {
        self.headers.get(name).unwrap_or_else(|| panic!("no {name}: {:?}", self.headers)).to_str().unwrap()
    }

    pub fn json(&self) -> Value {
        serde_json::from_slice(&self.body).unwrap()
    }

    /// By another implementation of HMAC than the one that signed: the two SHA-256 of its definition.
    pub fn is_signed(&self) -> bool {
        use sha2::{Digest, Sha256};
        let mut key = [0u8; 64];
        let secret = STANDARD.decode(SECRET.strip_prefix("whsec_").unwrap()).unwrap();
        key[..secret.len()].copy_from_slice(&secret);
        let [inner, outer] = [0x36u8, 0x5c].map(|pad| key.map(|byte| byte ^ pad));
        let signed = format!("{}.{}.", self.header("webhook-id"), self.header("webhook-timestamp"));
        let hash = Sha256::new().chain_update(inner).chain_update(signed).chain_update(&self.body).finalize();
        let hash = Sha256::new().chain_update(outer).chain_update(hash).finalize();
        self.header("webhook-signature") == format!("v1,{}", STANDARD.encode(hash))
    }
}

pub type Script = fn(usize) -> Response;
pub type Posts = Arc<Mutex<Vec<Post>>>;

pub fn ok(_: usize) -> Response {
    StatusCode::NO_CONTENT.into_response()
}

/// A receiver that answers its n-th post by a script. An answer with the header `x-hang` never comes.
pub fn receiver(script: Script) -> (Router, Posts) {
    let posts = Posts::default();
    let kept = posts.clone();
    let handler = move |headers: HeaderMap, body: Bytes| async move {
        let count = {
            let mut posts = kept.lock().unwrap();
            posts.push(Post { at: Instant::now(), headers, body });
            posts.len() - 1
        };
        let response = script(count);
        if response.headers().contains_key("x-hang") {
            std::future::pending::<()>().await;
        }
        response
    };
    (Router::new().route("/hooks/{token}", post(handler)), posts)
}

pub async fn listen(router: Router) -> std::net::SocketAddr {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = listener.local_addr().unwrap();
    tokio::spawn(async move { axum::serve(listener, router).await });
    address
}

/// Somebody crosses a line.
pub fn crossing(line: &str) -> Happening {
    Happening {
        track: Some((TrackId(3), ClassId(0))),
        place: Point { x: 0.5, y: 0.5 },
        what: What::Crossed { line: RuleId::new(line).unwrap(), direction: Direction::In },
    }
}

/// Lines that posts are about, in their order.
pub fn lines(posts: &Posts) -> Vec<String> {
    let posts = posts.lock().unwrap();
    posts.iter().map(|post| post.json()["subject"].as_str().unwrap().to_owned()).collect()
}
