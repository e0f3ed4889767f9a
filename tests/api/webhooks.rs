//! Webhooks that are added, changed, tried and removed while the service runs.

use axum::http::{StatusCode, header};
use axum::response::IntoResponse;
use gakp::types::BBox;
use serde_json::{Value, json};

use super::auth::Tokens;
use super::receiver::*;
use super::support::*;

impl Server {
    async fn send(&self, method: &str, path: &str, body: &Value) -> Response {
        let body = if body.is_null() { String::new() } else { body.to_string() };
        self.request(method, path, &[("Content-Type", "application/json")], body.as_bytes()).await
    }

    fn cross(&self, line: &str) {
        let bbox = BBox::new(10.0, 20.0, 30.0, 60.0);
        self.events.publish(&tracks("gate", 1, 1, (320, 240), bbox), &crossing(line));
    }

    async fn webhook(&self, name: &str) -> Value {
        self.get(&format!("/v1/webhooks/{name}")).await.json()
    }
}

/// [`eventually`] of what takes a request to know.
async fn soon(what: &str, mut so: impl AsyncFnMut() -> bool) {
    patiently(what, async {
        while !so().await {
            tokio::time::sleep(std::time::Duration::from_millis(5)).await;
        }
    })
    .await;
}

#[tokio::test]
async fn a_webhook_is_added_tried_changed_and_removed() {
    let server = Server::start().await;
    let (router, posts) = receiver(ok);
    let address = listen(router).await;
    let (url, elsewhere) = (format!("http://{address}/hooks/T0KEN"), format!("http://{address}/hooks/0THER"));
    let added = json!({"name": "alarm", "url": url, "secret": SECRET, "types": ["line.crossed"]});
    let answer = server.send("POST", "/v1/webhooks", &added).await;
    assert_eq!(answer.status, 201, "{}", answer.text());
    assert!(answer.head.to_lowercase().contains("location: /v1/webhooks/alarm"), "{}", answer.head);
    let expected = json!({"name": "alarm", "source": "api", "url": format!("http://{address}/..."), "signed": true,
        "cameras": [], "types": ["line.crossed"], "timeout_s": 10.0, "give_up_after_s": 3600.0, "queue": 1000,
        "delivered": 0, "failed": 0, "pending": 0, "last_error": null, "last_error_time": null});
    assert_eq!(answer.json(), expected);
    assert_eq!(server.get("/v1/webhooks").await.json(), json!({"webhooks": [expected]}));

    // It is tried, then told what happens.
    let trial = server.send("POST", "/v1/webhooks/alarm/test", &Value::Null).await.json();
    assert_eq!(
        (&trial["delivered"], &trial["status"], &trial["error"]),
        (&json!(true), &json!(204), &Value::Null)
    );
    let first = posts.lock().unwrap()[0].clone();
    assert!(first.is_signed() && first.json()["type"] == "gakp.test", "{:?}", first.json());
    assert_eq!(first.json()["source"], "/webhooks/alarm");
    posts.lock().unwrap().clear();
    server.cross("a");
    soon("the event", async || server.webhook("alarm").await["delivered"] == 1).await;
    assert_eq!((lines(&posts), posts.lock().unwrap()[0].is_signed()), (vec!["a".to_owned()], true));

    // Other types, no secret. What is not named stays.
    let patch = json!({"types": ["zone.left"], "secret": null, "queue": 5});
    let changed = server.send("PATCH", "/v1/webhooks/alarm", &patch).await.json();
    assert_eq!(
        (&changed["types"], &changed["signed"], &changed["queue"]),
        (&json!(["zone.left"]), &json!(false), &json!(5))
    );
    server.cross("b");
    let patch = json!({"types": []});
    assert_eq!(server.send("PATCH", "/v1/webhooks/alarm", &patch).await.status, 200);
    server.cross("c");
    soon("the next event", async || server.webhook("alarm").await["delivered"] == 2).await;
    assert_eq!(lines(&posts), ["a", "c"], "b was not asked for");
    assert!(posts.lock().unwrap()[1].headers.get("webhook-signature").is_none());

    // A receiver that wants to be left alone for an hour: what waits is kept, and posted at once when the URL is mended.
    let (busy, _) =
        receiver(|_| (StatusCode::TOO_MANY_REQUESTS, [(header::RETRY_AFTER, "3600")]).into_response());
    let busy = listen(busy).await;
    let patch = json!({"url": format!("http://{busy}/hooks/T0KEN")});
    assert_eq!(server.send("PATCH", "/v1/webhooks/alarm", &patch).await.status, 200);
    let trial = server.send("POST", "/v1/webhooks/alarm/test", &Value::Null).await.json();
    assert!(
        trial["delivered"] == false && trial["error"].as_str().unwrap().contains("answered 429"),
        "{trial}"
    );
    for line in ["d", "e", "f"] {
        server.cross(line);
    }
    soon("a failure", async || {
        let status = server.webhook("alarm").await;
        status["pending"] == 3 && status["last_error"].is_string()
    })
    .await;
    assert_eq!(server.send("PATCH", "/v1/webhooks/alarm", &json!({"url": elsewhere})).await.status, 200);
    soon("the rest", async || server.webhook("alarm").await["delivered"] == 5).await;
    assert_eq!(lines(&posts), ["a", "c", "d", "e", "f"]);

    // Gone, with its figures.
    let metrics = server.get("/metrics").await;
    let metrics = metrics.text();
    assert!(
        metrics.contains("gakp_webhook_deliveries_total{outcome=\"delivered\",webhook=\"alarm\"} 5"),
        "{metrics}"
    );
    assert_eq!(server.send("DELETE", "/v1/webhooks/alarm", &Value::Null).await.status, 204);
    server.cross("g");
    assert_eq!(server.get("/v1/webhooks").await.json(), json!({"webhooks": []}));
    assert!(!server.get("/metrics").await.text().contains("alarm"));
    // Anew under the same name it counts from nothing, and g does not come.
    assert_eq!(server.send("POST", "/v1/webhooks", &added).await.status, 201);
    server.cross("h");
    soon("its event", async || server.webhook("alarm").await["delivered"] == 1).await;
    assert_eq!(lines(&posts).last().unwrap(), "h");
    assert!(!lines(&posts).contains(&"g".to_owned()));
    server.stop().await;
}

/// A receiver that takes a post and says nothing, for as long as five minutes: neither a change nor a removal waits for
/// it.
#[tokio::test]
async fn a_hanging_post_holds_nothing_up() {
    let server = Server::start().await;
    let (hanging, taken) = receiver(|_| [("x-hang", "")].into_response());
    let (router, posts) = receiver(ok);
    let (silent, address) = (listen(hanging).await, listen(router).await);
    let (silent, url) = (format!("http://{silent}/hooks/a"), format!("http://{address}/hooks/a"));
    let added = json!({"name": "alarm", "url": silent, "timeout_s": 300});
    assert_eq!(server.send("POST", "/v1/webhooks", &added).await.status, 201);
    for line in ["a", "b"] {
        server.cross(line);
    }
    eventually("the post", || taken.lock().unwrap().len() == 1).await;
    // What is told of it changes: the post stays where it is.
    let patch = json!({"types": ["line.crossed"], "queue": 7});
    assert_eq!(server.send("PATCH", "/v1/webhooks/alarm", &patch).await.json()["pending"], 2);
    // Where it goes changes: the post that hangs is made there, too.
    assert_eq!(server.send("PATCH", "/v1/webhooks/alarm", &json!({"url": url})).await.status, 200);
    soon("both events", async || server.webhook("alarm").await["delivered"] == 2).await;
    assert_eq!((lines(&taken), lines(&posts)), (vec!["a".to_owned()], vec!["a".to_owned(), "b".to_owned()]));

    // Back, and deleted while it hangs.
    assert_eq!(server.send("PATCH", "/v1/webhooks/alarm", &json!({"url": silent})).await.status, 200);
    server.cross("c");
    eventually("the next post", || taken.lock().unwrap().len() == 2).await;
    assert_eq!(server.send("DELETE", "/v1/webhooks/alarm", &Value::Null).await.status, 204);
    let added = json!({"name": "alarm", "url": url});
    assert_eq!(server.send("POST", "/v1/webhooks", &added).await.status, 201);
    server.cross("d");
    soon("its event", async || server.webhook("alarm").await["delivered"] == 1).await;
    assert_eq!(lines(&posts), ["a", "b", "d"]);
    server.stop().await;
}

#[tokio::test]
async fn what_is_wrong_with_a_webhook_is_said_without_its_secrets() {
    let server = Server::start().await;
    let problem =
        |answer: &Response| answer.json()["type"].as_str().unwrap().rsplit(':').next().unwrap().to_owned();
    for (body, says) in [
        (json!({"name": "a"}), "missing field `url`"),
        (json!({"name": "a b", "url": "http://h"}), "name is not usable"),
        (json!({"name": "a", "url": "ftp://u:hunter2@h/"}), "http:// or https://"),
        (json!({"name": "a", "url": 4711}), "must be a text"),
        (json!({"name": "a", "url": "http://h", "secret": "hunter2"}), "openssl rand"),
        (json!({"name": "a", "url": "http://h", "types": ["line.crosed"]}), "is none of line.crossed"),
        (json!({"name": "a", "url": "http://h", "queue": 10_001}), "from 1 to 10000"),
        (json!({"name": "a", "url": "http://h", "secret_file": "/etc/shadow"}), "unknown field"),
        (json!({"name": "a", "url": "http://h", "ca_file": "/etc/shadow"}), "unknown field"),
    ] {
        let answer = server.send("POST", "/v1/webhooks", &body).await;
        let text = answer.text();
        assert!(answer.status == 400 && text.contains(says), "{body}: {text}");
        assert!(!text.contains("hunter2") && !text.contains("4711"), "{text}");
    }
    let added = json!({"name": "a", "url": "http://127.0.0.1:9/"});
    assert_eq!(server.send("POST", "/v1/webhooks", &added).await.status, 201);
    let again = server.send("POST", "/v1/webhooks", &added).await;
    assert_eq!((again.status, problem(&again).as_str()), (409, "webhook-exists"));
    for (method, path) in
        [("GET", "/v1/webhooks/b"), ("DELETE", "/v1/webhooks/b"), ("POST", "/v1/webhooks/b/test")]
    {
        let answer = server.send(method, path, &Value::Null).await;
        assert_eq!((answer.status, problem(&answer).as_str()), (404, "unknown-webhook"), "{path}");
    }
    assert_eq!(server.send("PATCH", "/v1/webhooks/b", &json!({})).await.status, 404);
    let wrong = server.send("PATCH", "/v1/webhooks/a", &json!({"timeout_s": -1})).await;
    assert!(wrong.status == 400 && wrong.text().contains("timeout_s"), "{}", wrong.text());
    assert_eq!(server.webhook("a").await["timeout_s"], 10.0);
    for n in 1..32 {
        let body = json!({"name": format!("w{n}"), "url": "http://127.0.0.1:9/"});
        assert_eq!(server.send("POST", "/v1/webhooks", &body).await.status, 201);
    }
    let answer =
        server.send("POST", "/v1/webhooks", &json!({"name": "one-more", "url": "http://127.0.0.1:9/"})).await;
    assert_eq!((answer.status, problem(&answer).as_str()), (409, "webhook-limit"));
    server.stop().await;
}

/// The way into the machine that an operator does not have, and an admin does.
#[tokio::test]
async fn an_operators_webhook_does_not_lead_to_this_machine() {
    let tokens = Tokens::new();
    let server = Server::start_behind(tokens.gate(), None).await;
    let (router, posts) = receiver(|_| StatusCode::OK.into_response());
    let address = listen(router).await;
    let send = async |who: &str, method: &str, path: &str, body: Value| {
        let bearer = tokens.bearer(who);
        let headers = [("Authorization", bearer.as_str()), ("Content-Type", "application/json")];
        server.request(method, path, &headers, body.to_string().as_bytes()).await
    };
    for url in [
        format!("http://{address}/hooks/a"),
        format!("http://localhost:{}/hooks/a", address.port()),
        format!("http://[::ffff:127.0.0.1]:{}/hooks/a", address.port()),
        "http://169.254.169.254/latest/meta-data".to_owned(),
    ] {
        let answer = send("operator", "POST", "/v1/webhooks", json!({"name": "in", "url": url})).await;
        assert_eq!(answer.status, 403, "{url}: {}", answer.text());
    }
    // One on the network that is then to lead elsewhere.
    let answer =
        send("operator", "POST", "/v1/webhooks", json!({"name": "out", "url": "http://192.0.2.1/"})).await;
    assert_eq!(answer.status, 201, "{}", answer.text());
    let inside = json!({"url": format!("http://{address}/hooks/a")});
    assert_eq!(send("operator", "PATCH", "/v1/webhooks/out", inside.clone()).await.status, 403);
    assert_eq!(server.get("/v1/webhooks").await.status, 401);
    assert_eq!(send("viewer", "GET", "/v1/webhooks", Value::Null).await.status, 403);
    // An admin's may, also after an operator has changed what it is told.
    let added = json!({"name": "in", "url": format!("http://{address}/hooks/a")});
    assert_eq!(send("admin", "POST", "/v1/webhooks", added).await.status, 201);
    let patch = json!({"types": ["line.crossed"]});
    assert_eq!(send("operator", "PATCH", "/v1/webhooks/in", patch).await.status, 200);
    server.cross("a");
    soon("the event", async || !posts.lock().unwrap().is_empty()).await;
    server.stop().await;
}
