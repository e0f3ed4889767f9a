//! Webhooks against real receivers on the loopback interface: signed, in order, tried again, counted when lost.
#![cfg(feature = "service")]

#[path = "webhook/receiver.rs"]
mod receiver;
#[path = "api/support.rs"]
mod support;

use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use axum::http::{StatusCode, header};
use axum::response::IntoResponse;
use gakp::api::Cameras;
use gakp::auth::tls::Certificates;
use gakp::config::Config;
use gakp::notify::{Notifier, WebhookStatus};
use gakp::publish::{EventHub, Hub, HubConfig};
use gakp::types::BBox;
use prometheus::{Registry, TextEncoder};
use receiver::*;
use support::{FakeCameras, eventually, tracks};
use tokio::io::AsyncWriteExt;
use tokio::net::{TcpListener, TcpStream};
use tokio_rustls::TlsAcceptor;
use tokio_rustls::server::TlsStream;

/// The sinks of a configuration on hubs of their own.
struct Running {
    events: EventHub,
    registry: Registry,
    notifier: Notifier,
    published: u64,
}

impl Running {
    async fn start(config: &str) -> Self {
        let plan = Config::parse(config).unwrap().take_notify().unwrap();
        let hub = Hub::new(HubConfig::default(), ["person".to_owned()].into());
        let events = EventHub::new(hub.classes().clone());
        let registry = Registry::new();
        let cameras: Arc<dyn Cameras> = Arc::new(FakeCameras::default());
        let notifier = Notifier::start(plan, &cameras, &hub, &events, &registry).await.unwrap();
        Self { events, registry, notifier, published: 0 }
    }

    /// The n-th event is told of line `line-n`.
    fn publish(&mut self, camera: &str, count: u64) {
        for _ in 0..count {
            self.published += 1;
            let happening = crossing(&format!("line-{}", self.published));
            let bbox = BBox::new(10.0, 20.0, 30.0, 60.0);
            self.events.publish(&tracks(camera, 1, self.published, (320, 240), bbox), &happening);
        }
    }

    fn status(&self, name: &str) -> WebhookStatus {
        self.notifier.webhooks().get(name).unwrap()
    }

    fn metrics(&self) -> String {
        TextEncoder::new().encode_to_string(&self.registry.gather()).unwrap()
    }

    fn outcome(&self, webhook: &str, outcome: &str) -> u64 {
        let series = format!("gakp_webhook_deliveries_total{{outcome=\"{outcome}\",webhook=\"{webhook}\"}} ");
        let metrics = self.metrics();
        let value = metrics.lines().find_map(|line| line.strip_prefix(&series));
        value.unwrap_or_else(|| panic!("no {series} in {metrics}")).parse().unwrap()
    }
}

#[tokio::test]
async fn events_are_signed_and_tried_until_they_arrive_in_order() {
    let (router, posts) = receiver(|count| match count {
        0 => StatusCode::INTERNAL_SERVER_ERROR.into_response(),
        1 => [("x-hang", "")].into_response(),
        2 => (StatusCode::TOO_MANY_REQUESTS, [(header::RETRY_AFTER, "3")]).into_response(),
        _ => ok(count),
    });
    let address = listen(router).await;
    let config = format!(
        "[[webhook]]\nname = \"alarm\"\nurl = \"http://user:hunter2@{address}/hooks/T0KEN\"\nsecret = \"{SECRET}\"\n\
         timeout_s = 0.5\n"
    );
    let mut running = Running::start(&config).await;
    running.publish("gate", 5);
    eventually("all events", || running.status("alarm").delivered == 5).await;

    let expected = ["line-1", "line-1", "line-1", "line-1", "line-2", "line-3", "line-4", "line-5"];
    assert_eq!(lines(&posts), expected);
    let posts = posts.lock().unwrap().clone();
    let ids: Vec<_> = posts.iter().map(|post| post.header("webhook-id")).collect();
    assert!(ids[..4].iter().all(|id| *id == ids[0]), "the same event has the same id: {ids:?}");
    assert_eq!(ids.iter().collect::<std::collections::BTreeSet<_>>().len(), 5, "{ids:?}");
    assert!(posts[3].at - posts[2].at >= Duration::from_secs(3), "Retry-After is respected");
    for post in &posts {
        assert!(post.is_signed(), "{:?}", post.headers);
        assert_eq!(post.header("content-type"), "application/cloudevents+json; charset=utf-8");
        assert_eq!(post.header("authorization"), "Basic dXNlcjpodW50ZXIy");
        let now = jiff::Timestamp::now().as_second();
        let sent: i64 = post.header("webhook-timestamp").parse().unwrap();
        assert!((now - 120..=now).contains(&sent), "{sent}");
        let event = post.json();
        assert_eq!((&event["specversion"], &event["type"]), (&"1.0".into(), &"gakp.line.crossed".into()));
        assert_eq!(
            (&event["source"], &event["id"]),
            (&"/cameras/gate".into(), &post.header("webhook-id").into())
        );
        assert_eq!(event["data"]["line"], event["subject"]);
        assert_eq!(event["data"]["time"], event["time"]);
        assert_eq!(event["data"]["id"], event["id"]);
    }
    assert!(running.metrics().contains("gakp_webhook_retries_total{webhook=\"alarm\"} 3"));
    let status = running.status("alarm");
    assert_eq!((status.failed, status.pending), (0, 0));
    assert_eq!(status.last_error.as_deref(), Some("answered 429 Too Many Requests"));
    let told = format!("{status:?} {}", running.metrics());
    assert!(!told.contains("hunter2") && !told.contains("T0KEN") && !told.contains("whsec"), "{told}");
}

#[tokio::test]
async fn what_is_refused_is_not_tried_again() {
    let (router, posts) = receiver(|count| match count {
        0 => StatusCode::GONE.into_response(),
        1 => (StatusCode::FOUND, [(header::LOCATION, "/hooks/elsewhere")]).into_response(),
        _ => ok(count),
    });
    let address = listen(router).await;
    let mut running = Running::start(&format!("[[webhook]]\nurl = \"http://{address}/hooks/a\"")).await;
    running.publish("gate", 3);
    eventually("the last event", || running.status("webhook-1").delivered == 1).await;
    assert_eq!(lines(&posts), ["line-1", "line-2", "line-3"]);
    assert_eq!(running.outcome("webhook-1", "refused"), 2);
    let error = running.status("webhook-1").last_error.unwrap();
    assert!(error.contains("redirects are not followed"), "{error}");
}

#[tokio::test]
async fn one_that_is_down_for_good_loses_only_its_own() {
    let (router, posts) = receiver(ok);
    let address = listen(router).await;
    // Nothing listens there any more.
    let gone = TcpListener::bind("127.0.0.1:0").await.unwrap().local_addr().unwrap();
    let mut running = Running::start(&format!(
        "[[webhook]]\nname = \"gone\"\nurl = \"http://{gone}/hooks/T0KEN\"\nqueue = 3\ngive_up_after_s = 1\n\
         [[webhook]]\nname = \"there\"\nurl = \"http://{address}/hooks/a\"\n"
    ))
    .await;
    running.publish("gate", 20);
    eventually("all events there", || running.status("there").delivered == 20).await;
    eventually("none is pending", || running.status("gone").pending == 0).await;
    eventually("all are counted", || running.status("gone").failed == 20).await;
    let (dropped, given_up) = (running.outcome("gone", "dropped"), running.outcome("gone", "given_up"));
    assert!(given_up >= 3 && dropped + given_up == 20, "{dropped} {given_up}");
    assert_eq!((running.outcome("gone", "delivered"), running.outcome("there", "dropped")), (0, 0));
    let expected: Vec<_> = (1..=20).map(|n| format!("line-{n}")).collect();
    assert_eq!(lines(&posts), expected);
    assert!(running.metrics().contains("gakp_webhook_up{webhook=\"gone\"} 0"));
    assert!(running.metrics().contains("gakp_webhook_up{webhook=\"there\"} 1"));
}

/// More at once than the hub keeps for a listener: it says how many it missed, and they are counted.
#[tokio::test]
async fn every_event_of_a_flood_is_accounted_for() {
    let (router, posts) = receiver(ok);
    let (hanging, _) = receiver(|_| [("x-hang", "")].into_response());
    let (address, silent) = (listen(router).await, listen(hanging).await);
    let mut running = Running::start(&format!(
        "[[webhook]]\nname = \"there\"\nurl = \"http://{address}/hooks/a\"\nqueue = 2000\n\
         [[webhook]]\nname = \"silent\"\nurl = \"http://{silent}/hooks/a\"\nqueue = 100\n"
    ))
    .await;
    running.publish("gate", 3000);
    let accounted = |running: &Running, name: &str| {
        let status = running.status(name);
        status.delivered + status.failed + status.pending as u64
    };
    eventually("the rest", || running.status("there").delivered == 1024).await;
    eventually("all of them", || accounted(&running, "silent") == 3000).await;
    assert_eq!((running.outcome("there", "dropped"), accounted(&running, "there")), (1976, 3000));
    assert!((100..=101).contains(&running.status("silent").pending), "{:?}", running.status("silent"));
    let expected: Vec<_> = (1977..=3000).map(|n| format!("line-{n}")).collect();
    assert_eq!(lines(&posts), expected);
    assert!(running.metrics().contains("gakp_webhook_queue_length{webhook=\"there\"} 0"));
}

#[tokio::test]
async fn only_what_is_asked_for_is_posted() {
    let (router, posts) = receiver(ok);
    let address = listen(router).await;
    let mut running = Running::start(&format!(
        "[[webhook]]\nname = \"hall\"\nurl = \"http://{address}/hooks/a\"\ncameras = [\"hall\"]\n\
         types = [\"line.crossed\"]\n\
         [[webhook]]\nname = \"zones\"\nurl = \"http://{address}/hooks/b\"\ntypes = [\"zone.left\"]\n"
    ))
    .await;
    running.publish("gate", 2);
    running.publish("hall", 1);
    eventually("the event of the hall", || running.status("hall").delivered == 1).await;
    assert_eq!(lines(&posts), ["line-3"]);
    assert_eq!(running.status("zones").delivered, 0);
}

#[tokio::test]
async fn what_is_pending_at_the_end_is_still_delivered() {
    let (router, posts) = receiver(ok);
    let address = listen(router).await;
    let mut running = Running::start(&format!("[[webhook]]\nurl = \"http://{address}/hooks/a\"")).await;
    running.publish("gate", 10);
    running.notifier.stop().await;
    assert_eq!((running.status("webhook-1").delivered, running.status("webhook-1").pending), (10, 0));
    assert_eq!(lines(&posts).len(), 10);
}

#[tokio::test]
async fn what_cannot_be_delivered_at_the_end_is_counted() {
    let (router, _) = receiver(|_| [("x-hang", "")].into_response());
    let address = listen(router).await;
    let mut running = Running::start(&format!("[[webhook]]\nurl = \"http://{address}/hooks/a\"")).await;
    // None of them has been taken from the hub when it stops.
    running.publish("gate", 900);
    running.notifier.stop().await;
    assert_eq!((running.status("webhook-1").failed, running.status("webhook-1").pending), (900, 0));
    assert_eq!(running.outcome("webhook-1", "stopped"), 900);
}

/// The last attempt fails at once, while events are still being collected.
#[tokio::test]
async fn what_is_collected_after_the_last_attempt_is_counted_too() {
    // Nothing listens there any more.
    let gone = TcpListener::bind("127.0.0.1:0").await.unwrap().local_addr().unwrap();
    let mut running = Running::start(&format!("[[webhook]]\nurl = \"http://{gone}/hooks/a\"")).await;
    running.publish("gate", 1);
    eventually("a failure", || running.status("webhook-1").last_error.is_some()).await;
    running.publish("gate", 899);
    running.notifier.stop().await;
    assert_eq!((running.status("webhook-1").failed, running.status("webhook-1").pending), (900, 0));
    assert_eq!(running.outcome("webhook-1", "stopped"), 900);
}

/// What waits for one is not sent to another that has its place, and so its name, in the file that is read again.
#[tokio::test]
async fn one_without_a_name_leaves_its_place_but_not_its_events() {
    let (hanging, _) = receiver(|_| [("x-hang", "")].into_response());
    let (router, posts) = receiver(ok);
    let (silent, address) = (listen(hanging).await, listen(router).await);
    let hook = |address| format!("[[webhook]]\nurl = \"http://{address}/hooks/a\"\n");
    let mut running = Running::start(&(hook(silent) + &hook(address))).await;
    running.publish("gate", 3);
    eventually("the events", || running.status("webhook-2").delivered == 3).await;
    assert_eq!(running.status("webhook-1").pending, 3);
    let plan = Config::parse(&hook(address)).unwrap().take_notify().unwrap();
    let mut done = running.notifier.configure(plan).await;
    done.webhooks.sort();
    assert_eq!((done.webhooks, done.failed), (vec!["webhook-1".to_owned(), "webhook-2".to_owned()], vec![]));
    running.publish("gate", 1);
    eventually("the next event", || running.status("webhook-1").delivered == 1).await;
    assert_eq!(lines(&posts), ["line-1", "line-2", "line-3", "line-4"]);
    assert_eq!((running.status("webhook-1").pending, running.notifier.webhooks().list().len()), (0, 1));
}

/// Connections over TLS for axum.
struct Tls {
    listener: TcpListener,
    acceptor: TlsAcceptor,
}

impl axum::serve::Listener for Tls {
    type Io = TlsStream<TcpStream>;
    type Addr = std::net::SocketAddr;

    async fn accept(&mut self) -> (Self::Io, Self::Addr) {
        loop {
            let (stream, address) = self.listener.accept().await.unwrap();
            // Who does not trust the certificate hangs up: the next one.
            if let Ok(mut stream) = self.acceptor.accept(stream).await {
                stream.flush().await.unwrap();
                return (stream, address);
            }
        }
    }

    fn local_addr(&self) -> std::io::Result<Self::Addr> {
        self.listener.local_addr()
    }
}

/// A certificate for `localhost` in a folder, and its key.
fn certificate(folder: &Path, name: &str) -> (String, String) {
    let made = rcgen::generate_simple_self_signed(["localhost".to_owned()]).unwrap();
    let [cert, key] = ["pem", "key"].map(|kind| folder.join(format!("{name}.{kind}")));
    std::fs::write(&cert, made.cert.pem()).unwrap();
    std::fs::write(&key, made.signing_key.serialize_pem()).unwrap();
    (cert.to_str().unwrap().to_owned(), key.to_str().unwrap().to_owned())
}

#[tokio::test]
async fn over_tls_only_to_whom_is_trusted() {
    let folder = tempfile::tempdir().unwrap();
    let (cert, key) = certificate(folder.path(), "server");
    let (other, _) = certificate(folder.path(), "other");
    let server = Certificates::read(cert.as_ref(), key.as_ref()).unwrap().server().unwrap();
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let port = listener.local_addr().unwrap().port();
    let (router, posts) = receiver(ok);
    let tls = Tls { listener, acceptor: TlsAcceptor::from(server) };
    tokio::spawn(async move { axum::serve(tls, router).await });
    let url = format!("https://localhost:{port}/hooks/a");
    let mut running = Running::start(&format!(
        "[[webhook]]\nname = \"good\"\nurl = \"{url}\"\nca_file = \"{cert}\"\n\
         [[webhook]]\nname = \"bad\"\nurl = \"{url}\"\nca_file = \"{other}\"\ngive_up_after_s = 0.1\n"
    ))
    .await;
    running.publish("gate", 2);
    eventually("both events", || running.status("good").delivered == 2).await;
    eventually("neither event", || running.outcome("bad", "given_up") == 2).await;
    let error = running.status("bad").last_error.unwrap();
    assert!(error.contains("certificate"), "{error}");
    assert_eq!(posts.lock().unwrap().len(), 2);
}
