//! Who may do what, route by route; sessions; TLS.

use std::fs;
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::Duration;

use gakp::api::RIGHTS;
use gakp::auth::tls::Certificates;
use gakp::auth::{Gate, Right, Role, TokenFile};
use gakp::types::BBox;
use serde_json::json;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;
use tokio_rustls::TlsConnector;
use tokio_rustls::rustls::pki_types::CertificateDer;
use tokio_rustls::rustls::pki_types::pem::PemObject;
use tokio_rustls::rustls::{ClientConfig, RootCertStore};
use tokio_tungstenite::tungstenite::Message;

use super::support::*;

/// A token of each role without pictures, one of a viewer with them.
pub struct Tokens {
    pub folder: tempfile::TempDir,
    all: Vec<(String, String)>,
}

impl Tokens {
    pub fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let mut file = TokenFile::default();
        let mut make = |name: &str, role, video| {
            (name.to_owned(), file.create(name, role, video).unwrap().reveal().to_owned())
        };
        let all = vec![
            make("viewer", Role::Viewer, false),
            make("watcher", Role::Viewer, true),
            make("operator", Role::Operator, false),
            make("admin", Role::Admin, true),
        ];
        file.write(&TokenFile::path(folder.path())).unwrap();
        Self { folder, all }
    }

    pub fn gate(&self) -> Gate {
        Gate::new(TokenFile::path(self.folder.path()), true).unwrap()
    }

    /// As `gakp token revoke` does for each of them.
    fn revoke_all(&self) {
        let path = TokenFile::path(self.folder.path());
        let mut file = TokenFile::read(&path).unwrap();
        for (name, _) in &self.all {
            file.revoke(name).unwrap();
        }
        file.write(&path).unwrap();
    }

    pub fn bearer(&self, name: &str) -> String {
        format!("Bearer {}", self.all.iter().find(|(n, _)| n == name).unwrap().1)
    }
}

/// Every route with every role: let through or refused as the table says, and never half.
#[tokio::test]
async fn every_route_asks_for_its_right() {
    let tokens = Tokens::new();
    let server = Server::start_behind(tokens.gate(), None).await;
    let door = r#"{"id":"door","points":[[0.5,1],[0.5,0]]}"#;
    for (method, path, right) in RIGHTS {
        // A body that is taken, so that who may do it does it.
        let body = match (method, path) {
            ("POST", "/v1/cameras") => r#"{"id":"new","url":"rtsp://192.0.2.1/x"}"#.to_owned(),
            ("POST" | "PUT", _) if path.contains("/lines") => door.to_owned(),
            ("POST" | "PUT", _) if path.contains("/zones") => door.replace("[0.5,0]", "[0,0],[1,0]"),
            _ => String::new(),
        };
        let target = path.replace("{id}", "gate").replace("{line}", "door").replace("{zone}", "door");
        if path == "/v1/session" && method == "POST" {
            continue;
        }
        let callers = [None, Some("viewer"), Some("watcher"), Some("operator"), Some("admin")];
        for caller in callers {
            server.cameras.put("gate", "rtsp://host/x");
            server.cameras.clear("new");
            let authorization = caller.map(|name| tokens.bearer(name));
            let mut headers = vec![("Content-Type", "application/json")];
            headers.extend(authorization.as_deref().map(|value| ("Authorization", value)));
            // Streams do not end: only their head is read.
            let mut stream = server.open(method, &target, &headers, body.as_bytes()).await;
            let mut head = vec![0; 12];
            patiently(&target, stream.read_exact(&mut head)).await.unwrap();
            let status: u16 = std::str::from_utf8(&head[9..12]).unwrap().parse().unwrap();
            let may = match (right, caller) {
                (Right::Nobody, _) => true,
                (_, None) => false,
                (Right::Video, Some(name)) => ["watcher", "admin"].contains(&name),
                (Right::Role(Role::Viewer), Some(_)) => true,
                (Right::Role(Role::Operator), Some(name)) => ["operator", "admin"].contains(&name),
                (Right::Role(Role::Admin), Some(name)) => name == "admin",
            };
            let refused = if caller.is_none() { 401 } else { 403 };
            assert_eq!(status != refused, may, "{method} {path} by {caller:?}: {status}");
            assert!(status < 500 || status == 503, "{method} {path} by {caller:?}: {status}");
        }
    }
    // What no route is.
    let viewer = tokens.bearer("viewer");
    let by_viewer: &[(&str, &str)] = &[("Authorization", &viewer)];
    assert_eq!(server.request("PATCH", "/v1/cameras", by_viewer, b"").await.status, 405);
    assert_eq!(server.request("GET", "/nowhere", by_viewer, b"").await.status, 404);
    server.stop().await;
}

#[tokio::test]
async fn a_token_is_asked_for_in_words_and_can_be_revoked() {
    let tokens = Tokens::new();
    let server = Server::start_behind(tokens.gate(), None).await;
    let nobody = server.get("/v1/cameras").await;
    assert_eq!(
        (nobody.status, nobody.json()["type"].as_str()),
        (401, Some("urn:gakp:problem:unauthenticated"))
    );
    assert!(nobody.head.to_lowercase().contains("www-authenticate: bearer"), "{}", nobody.head);
    let viewer = tokens.bearer("viewer");
    for wrong in ["Bearer gakp_x", "Bearer ", "Basic eDp5", &viewer[..viewer.len() - 1]] {
        let answer = server.request("GET", "/v1/cameras", &[("Authorization", wrong)], b"").await;
        assert_eq!(answer.status, 401, "{wrong}");
        assert!(!answer.text().contains("gakp_"), "a token is not repeated: {}", answer.text());
    }
    let by_viewer: &[(&str, &str)] = &[("Authorization", &viewer), ("Content-Type", "application/json")];
    let refused = server.request("POST", "/v1/cameras", by_viewer, b"{}").await;
    assert_eq!(refused.status, 403);
    assert!(refused.text().contains("needs a token of role operator"), "{}", refused.text());
    assert!(server.socket("/v1/tracks", &[]).await.is_err());
    let value: &'static str = viewer.clone().leak();
    let mut stream = server.socket("/v1/tracks", &[("authorization", value)]).await.unwrap();

    // Revoked in the file: noticed within seconds. The last token's end opens nothing.
    tokens.revoke_all();
    known_to_be_revoked(&server, &viewer).await;
    assert_eq!(stream.closed().await, 1008, "its streams end");
    assert_eq!(server.get("/v1/cameras").await.status, 401);
    server.stop().await;
}

/// Waits until the service has noticed.
async fn known_to_be_revoked(server: &Server, bearer: &str) {
    patiently("the token to be gone", async {
        while server.request("GET", "/v1/cameras", &[("Authorization", bearer)], b"").await.status != 401 {
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
    })
    .await;
}

/// Messages of a megabyte for clients that take five a second, with always more of them waiting: what is under way when
/// the token ends is a message and what the kernel holds, not as many as a stream sends in a row.
#[tokio::test]
async fn a_slow_clients_stream_ends_with_its_token_as_well() {
    let tokens = Tokens::new();
    let server = Server::start_behind(tokens.gate(), None).await;
    server.cameras.put("gate", "rtsp://host/gate");
    let hub = server.hub.clone();
    let publisher = tokio::spawn(async move {
        let bbox = BBox::new(10.0, 20.0, 30.0, 60.0);
        for seq in 0.. {
            let mut report = tracks("gate", 1, seq, (320, 240), bbox);
            report.tracks = vec![report.tracks[0]; 6000];
            hub.publish(Arc::new(report));
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
    });
    let viewer = tokens.bearer("viewer");
    let taken = AtomicU32::new(0);
    let mut slow = vec![];
    for _ in 0..4 {
        let mut client = server.narrow_socket("/v1/tracks", &[("authorization", &viewer)]).await;
        let taken = &taken;
        slow.push(async move {
            while !matches!(client.message().await, Message::Close(_)) {
                taken.fetch_add(1, Ordering::Relaxed);
                tokio::time::sleep(Duration::from_millis(200)).await;
            }
        });
    }
    let revoked = async {
        eventually("a few messages", || taken.load(Ordering::Relaxed) >= 40).await;
        tokens.revoke_all();
        known_to_be_revoked(&server, &viewer).await;
        taken.load(Ordering::Relaxed)
    };
    let (before, _) = tokio::join!(revoked, futures::future::join_all(slow));
    let after = taken.load(Ordering::Relaxed) - before;
    assert!(after <= 16, "{after} messages went out after the tokens' end");
    publisher.abort();
    server.stop().await;
}

#[tokio::test]
async fn a_page_signs_in_and_out() {
    let tokens = Tokens::new();
    let server = Server::start_behind(tokens.gate(), None).await;
    let token = tokens.bearer("operator").replace("Bearer ", "");
    let sign_in = |token: &str, origin: &str| {
        let headers = [("Content-Type", "application/json".to_owned()), ("Origin", origin.to_owned())];
        (headers, json!({ "token": token }).to_string())
    };
    let own = format!("http://{}", server.addr);
    for (token, origin, status) in [("gakp_0", own.as_str(), 401), (&token, "http://evil.example", 403)] {
        let (headers, body) = sign_in(token, origin);
        let headers: Vec<_> = headers.iter().map(|(k, v)| (*k, v.as_str())).collect();
        assert_eq!(server.request("POST", "/v1/session", &headers, body.as_bytes()).await.status, status);
    }
    let nobody = json!({"auth": "required", "name": null, "role": null, "video": null});
    assert_eq!(server.get("/v1/session").await.json(), nobody);
    let (headers, body) = sign_in(&token, &own);
    let headers: Vec<_> = headers.iter().map(|(k, v)| (*k, v.as_str())).collect();
    let signed_in = server.request("POST", "/v1/session", &headers, body.as_bytes()).await;
    let operator = json!({"auth": "required", "name": "operator", "role": "operator", "video": false});
    assert_eq!((signed_in.status, signed_in.json()), (200, operator.clone()));
    let head = signed_in.head.clone();
    let (_, rest) = head.split_once("set-cookie: ").unwrap_or_else(|| panic!("{head}"));
    let set = rest.lines().next().unwrap();
    // The test's client reads heads in lower case.
    assert!(set.contains("httponly") && set.contains("samesite=strict") && !set.contains(&token), "{set}");
    let cookie: &'static str = set.split(';').next().unwrap().to_owned().leak();

    assert_eq!(server.request("GET", "/v1/session", &[("Cookie", cookie)], b"").await.json(), operator);
    assert_eq!(server.request("GET", "/v1/cameras", &[("Cookie", cookie)], b"").await.status, 200);
    drop(server.socket("/v1/events/live", &[("cookie", cookie)]).await.unwrap());
    // Another site's page may make the browser send the cookie after all: its origin betrays it.
    let new = br#"{"id":"new","url":"rtsp://192.0.2.1/x"}"#;
    for (origin, status) in [("http://evil.example", 403), (own.as_str(), 201)] {
        let headers = [("Cookie", cookie), ("Content-Type", "application/json"), ("Origin", origin)];
        assert_eq!(server.request("POST", "/v1/cameras", &headers, new).await.status, status, "{origin}");
    }
    let out = server.request("DELETE", "/v1/session", &[("Cookie", cookie), ("Origin", &own)], b"").await;
    assert_eq!(out.status, 204);
    assert_eq!(server.request("GET", "/v1/cameras", &[("Cookie", cookie)], b"").await.status, 401);
    assert_eq!(
        server.request("GET", "/", &[("Cookie", cookie)], b"").await.status,
        200,
        "the page still comes"
    );
    server.stop().await;
}

#[tokio::test]
async fn without_tokens_only_its_address_opens_it() {
    let server = Server::start().await;
    let open = json!({"auth": "open", "name": "anybody", "role": "admin", "video": true});
    assert_eq!(server.get("/v1/session").await.json(), open);
    let mut stream = TcpStream::connect(server.addr).await.unwrap();
    stream.write_all(b"GET /v1/cameras HTTP/1.0\r\nHost: rebind.example\r\n\r\n").await.unwrap();
    let mut answer = String::new();
    stream.read_to_string(&mut answer).await.unwrap();
    assert!(answer.starts_with("HTTP/1.0 403") && answer.contains("gakp token create"), "{answer}");
    server.stop().await;
}

/// Files, devices and this machine's own servers are for an admin alone.
#[tokio::test]
async fn who_is_no_admin_adds_cameras_on_the_network_alone() {
    let tokens = Tokens::new();
    let server = Server::start_behind(tokens.gate(), None).await;
    for (by, url, status) in [
        ("operator", "rtsp://192.0.2.7/stream", 201),
        ("operator", "rtsp://127.0.0.1:8554/stream", 403),
        ("operator", "rtsp://169.254.169.254/latest", 403),
        ("operator", "file:///etc/passwd", 403),
        ("operator", "http://192.0.2.7/clip.mp4", 403),
        ("admin", "rtsp://127.0.0.1:8554/stream", 201),
        ("admin", "file:///tmp/clip.mp4", 201),
    ] {
        server.cameras.clear("new");
        let bearer = tokens.bearer(by);
        let headers = [("Authorization", bearer.as_str()), ("Content-Type", "application/json")];
        let body = json!({"id": "new", "url": url}).to_string();
        let answer = server.request("POST", "/v1/cameras", &headers, body.as_bytes()).await;
        assert_eq!(answer.status, status, "{by} {url}: {}", answer.text());
    }
    server.stop().await;
}

#[tokio::test]
async fn tls_by_certificate_files() {
    let folder = tempfile::tempdir().unwrap();
    let (cert, key) = (folder.path().join("cert.pem"), folder.path().join("key.pem"));
    // A certificate of its own at each call.
    let issue = || {
        let made = rcgen::generate_simple_self_signed(["localhost".to_owned()]).unwrap();
        fs::write(&cert, made.cert.pem()).unwrap();
        fs::write(&key, made.signing_key.serialize_pem()).unwrap();
        CertificateDer::from_pem_file(&cert).unwrap()
    };
    let first = issue();
    for (cert, key, expected) in [
        (&folder.path().join("missing.pem"), &key, "cannot read a certificate"),
        (&key, &key, "there is none in it"),
        (&cert, &cert, "cannot read a private key"),
    ] {
        let error = Certificates::read(cert, key).unwrap_err().to_string();
        assert!(error.contains(expected), "{error}");
    }
    let certificates = Certificates::read(&cert, &key).unwrap();
    let server = Server::start_behind(Gate::open(), Some(certificates.server().unwrap())).await;
    let ask = async |trusted: &CertificateDer<'static>| -> std::io::Result<String> {
        let mut roots = RootCertStore::empty();
        roots.add(trusted.clone()).unwrap();
        let provider = Arc::new(tokio_rustls::rustls::crypto::ring::default_provider());
        let client = ClientConfig::builder_with_provider(provider)
            .with_safe_default_protocol_versions()
            .unwrap()
            .with_root_certificates(roots)
            .with_no_client_auth();
        let stream = TcpStream::connect(server.addr).await?;
        let name = "localhost".try_into().unwrap();
        let mut stream = TlsConnector::from(Arc::new(client)).connect(name, stream).await?;
        stream.write_all(b"GET /healthz HTTP/1.0\r\nHost: localhost\r\n\r\n").await?;
        let mut answer = String::new();
        stream.read_to_string(&mut answer).await?;
        Ok(answer)
    };
    let answer = ask(&first).await.unwrap();
    assert!(answer.starts_with("HTTP/1.0 200"), "{answer}");
    // Renewed: who trusts the new one alone is let in once it was read. Half a renewal changes nothing.
    let second = issue();
    assert!(ask(&second).await.is_err());
    certificates.read_again().unwrap();
    assert!(ask(&second).await.is_ok() && ask(&first).await.is_err());
    fs::write(&key, rcgen::KeyPair::generate().unwrap().serialize_pem()).unwrap();
    assert!(certificates.read_again().is_err());
    assert!(ask(&second).await.is_ok());
    // Plain HTTP is no TLS: the connection ends, the service goes on.
    let mut plain = TcpStream::connect(server.addr).await.unwrap();
    plain.write_all(b"GET /healthz HTTP/1.0\r\n\r\n").await.unwrap();
    let mut refused = vec![];
    let _ = patiently("the end", plain.read_to_end(&mut refused)).await;
    assert!(!refused.starts_with(b"HTTP"), "{refused:?}");
    server.stop().await;
}
