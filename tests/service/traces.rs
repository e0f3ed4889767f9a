//! Traces over the wire: a receiver of OTLP/HTTP on the loopback interface, and what a real service sends to it.

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::path::Path;
use std::sync::atomic::{AtomicU16, Ordering};
use std::sync::{Arc, Mutex, mpsc};
use std::time::Duration;

use axum::Router;
use axum::body::Bytes;
use axum::http::{HeaderMap, StatusCode, Uri};
use axum::routing::any;
use opentelemetry_proto::tonic::collector::trace::v1::{
    ExportTraceServiceRequest, ExportTraceServiceResponse,
};
use opentelemetry_proto::tonic::common::v1::KeyValue;
use opentelemetry_proto::tonic::common::v1::any_value::Value;
use opentelemetry_proto::tonic::trace::v1::Span;
use opentelemetry_proto::tonic::trace::v1::span::SpanKind;
use opentelemetry_proto::tonic::trace::v1::status::StatusCode as SpanStatus;
use prost::Message;

use super::support::*;

/// What each trace of a tracked frame has, in this order. Link scores are asked for where there are pairs.
const STEPS: [&str; 7] = ["wait", "detect", "embed", "predict", "link", "update", "publish"];

/// A post as it came.
struct Post {
    uri: Uri,
    headers: HeaderMap,
    body: Bytes,
}

/// A collector.
struct Collector {
    address: SocketAddr,
    /// What it answers.
    status: Arc<AtomicU16>,
    posts: Arc<Mutex<Vec<Post>>>,
    /// Of the posts that it took.
    spans: Arc<Mutex<Vec<Span>>>,
}

impl Collector {
    fn start(status: StatusCode) -> Self {
        let status = Arc::new(AtomicU16::new(status.as_u16()));
        let (posts, spans) = (Arc::<Mutex<Vec<Post>>>::default(), Arc::<Mutex<Vec<Span>>>::default());
        let (answer, told, taken) = (status.clone(), posts.clone(), spans.clone());
        let take = move |uri: Uri, headers: HeaderMap, body: Bytes| async move {
            let status = StatusCode::from_u16(answer.load(Ordering::SeqCst)).unwrap();
            if status == StatusCode::OK {
                let request = ExportTraceServiceRequest::decode(body.clone()).expect("OTLP's message");
                let scopes = request.resource_spans.into_iter().flat_map(|resource| resource.scope_spans);
                taken.lock().unwrap().extend(scopes.flat_map(|scope| scope.spans));
            }
            told.lock().unwrap().push(Post { uri, headers, body });
            (status, ExportTraceServiceResponse::default().encode_to_vec())
        };
        let (tell, address) = mpsc::channel();
        // Until the test's process ends.
        std::thread::spawn(move || {
            let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
            runtime.block_on(async {
                let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
                tell.send(listener.local_addr().unwrap()).unwrap();
                axum::serve(listener, Router::new().fallback(any(take))).await.unwrap();
            });
        });
        let address = address.recv().unwrap();
        Self { address, status, posts, spans }
    }

    fn spans(&self) -> Vec<Span> {
        self.spans.lock().unwrap().clone()
    }

    /// The frames of a camera.
    fn frames(&self, camera: &str) -> Vec<Span> {
        let of = |span: &Span| span.name == "frame" && text(span, "gakp.camera") == camera;
        self.spans().into_iter().filter(of).collect()
    }
}

fn attribute<'a>(span: &'a Span, key: &str) -> Option<&'a Value> {
    let of = |attribute: &&KeyValue| attribute.key == key;
    span.attributes.iter().find(of)?.value.as_ref()?.value.as_ref()
}

#[track_caller]
fn text<'a>(span: &'a Span, key: &str) -> &'a str {
    let Some(Value::StringValue(text)) = attribute(span, key) else { panic!("no text {key}: {span:?}") };
    text
}

#[track_caller]
fn int(span: &Span, key: &str) -> u64 {
    let Some(Value::IntValue(int)) = attribute(span, key) else { panic!("no number {key}: {span:?}") };
    u64::try_from(*int).unwrap()
}

fn seconds(span: &Span) -> f64 {
    (span.end_time_unix_nano - span.start_time_unix_nano) as f64 * 1e-9
}

fn is_error(span: &Span) -> bool {
    span.status.as_ref().is_some_and(|status| status.code == SpanStatus::Error as i32)
}

/// A service with a film and with a camera that sends more than one core detects in.
fn start(folder: &Path, traces: &str) -> Option<Service> {
    let (film, _) = (film()?, models()?);
    let config = folder.join("gakp.toml");
    let text = format!(
        "[[camera]]\nid = \"demo\"\nurl = {:?}\nloop = true\n\
         [[camera]]\nid = \"burst\"\nurl = \"test:?fps=60&width=320&height=240\"\n{traces}",
        film.to_str().unwrap()
    );
    std::fs::write(&config, text).unwrap();
    let args = ["--config", config.to_str().unwrap(), "--threads", "1", "--detector-size", "320x256"];
    Some(Service::start(&folder.join("state"), &args))
}

#[test]
fn every_frame_and_request_has_its_trace() {
    let (collector, folder) = (Collector::start(StatusCode::OK), tempfile::tempdir().unwrap());
    std::fs::write(folder.path().join("headers"), "X-Api-Key: k3y-of-hunter2\n").unwrap();
    let traces = format!(
        "[traces]\nendpoint = \"http://user:hunter2@{}/base/\"\nsample = 1\nservice_name = \"north\"\n\
         headers_file = \"headers\"\n",
        collector.address
    );
    let Some(service) = start(folder.path(), &traces) else { return };
    let cameras = ["demo", "burst"];
    service.wait_for_frames("demo", 20);
    let parent = "traceparent: 00-4bf92f3577b34da6a3ce929d0e0e4736-00f067aa0ba902b7-01\r\n\
                  Authorization: Bearer hunter2-and-more\r\n";
    service.request_with(parent, "GET", "/v1/cameras/demo?token=hunter2", None);
    // Its caller records nothing.
    let parent = parent.replace("-01\r", "-00\r").replace("4bf92f", "5bf92f");
    service.request_with(&parent, "GET", "/v1/cameras/demo", None);
    for name in cameras {
        let pause = service.request("PATCH", &format!("/v1/cameras/{name}"), Some(r#"{"paused": true}"#));
        assert_eq!(pause.status, 200, "{pause:?}");
    }

    // Nothing comes in any more: each frame of the account has its trace, with the account's outcome.
    let accounts = |metrics: &Metrics| cameras.map(|name| metrics.account(name));
    let metrics = eventually("the accounts to be balanced", || {
        let metrics = service.metrics();
        accounts(&metrics).iter().all(|[all, tracked, dropped]| *all == tracked + dropped).then_some(metrics)
    });
    let accounts = accounts(&metrics);
    for (name, [all, tracked, dropped]) in cameras.into_iter().zip(accounts) {
        eventually("the traces of all frames", || (collector.frames(name).len() as u64 >= all).then_some(()));
        let frames = collector.frames(name);
        let mut outcomes = BTreeMap::<_, u64>::new();
        for frame in &frames {
            *outcomes.entry(text(frame, "gakp.outcome").to_owned()).or_default() += 1;
        }
        assert_eq!(outcomes.remove("tracked").unwrap_or_default(), tracked, "{name}");
        for (reason, count) in &outcomes {
            assert_eq!(metrics.dropped(name, reason), *count as f64, "{name} {reason}");
        }
        assert_eq!((frames.len() as u64, outcomes.values().sum()), (all, dropped), "{name}");
        let epoch = service.camera(name)["epoch"].as_u64().unwrap();
        let mut indices: Vec<_> = frames.iter().filter_map(|frame| attribute(frame, "gakp.frame")).collect();
        let decoded = indices.len();
        indices.sort_by_key(|index| format!("{index:?}"));
        indices.dedup();
        assert_eq!(indices.len(), decoded, "each frame of {name} once");
        assert!(frames.iter().all(|frame| int(frame, "gakp.epoch") <= epoch), "{name}");
    }
    assert!(accounts[0][1] >= 20 && accounts[1][2] > 0, "the test was too gentle: {accounts:?}");
    check_children(&collector.spans(), &metrics);
    let frames: u64 = accounts.iter().map(|[all, ..]| all).sum();
    let exported = eventually("the figures", || {
        let exported = service.metrics().get("gakp_traces_exported_total");
        (exported >= frames as f64).then_some(exported)
    });
    assert!(exported <= collector.spans().iter().filter(|span| is_root(span)).count() as f64);
    let metrics = service.metrics();
    assert_eq!(metrics.get("gakp_traces_dropped_total"), 0.0);
    assert_eq!(metrics.get("gakp_traces_failures_total"), 0.0);

    // Requests.
    let spans = eventually("the requests' traces", || {
        let spans = collector.spans();
        spans.iter().any(|span| span.name == "PATCH /v1/cameras/{id}").then_some(spans)
    });
    let mine: Vec<_> = spans.iter().filter(|span| !span.parent_span_id.is_empty() && is_root(span)).collect();
    let [request] = mine[..] else { panic!("one request was part of a trace: {mine:?}") };
    assert_eq!((request.name.as_str(), request.kind), ("GET /v1/cameras/{id}", SpanKind::Server as i32));
    assert_eq!(request.trace_id, 0x4bf9_2f35_77b3_4da6_a3ce_929d_0e0e_4736_u128.to_be_bytes());
    assert_eq!(request.parent_span_id, 0x00f0_67aa_0ba9_02b7_u64.to_be_bytes());
    let told = ["http.request.method", "http.route"].map(|key| text(request, key));
    assert_eq!(told, ["GET", "/v1/cameras/{id}"]);
    assert!((200..500).contains(&int(request, "http.response.status_code")) && !is_error(request));

    let log = service.stop();
    assert!(log.contains("traces are exported") && !log.contains("hunter2"), "{log}");
    for Post { uri, headers, body } in collector.posts.lock().unwrap().iter() {
        assert_eq!(uri.path(), "/base/v1/traces");
        let header = |name: &str| headers[name].to_str().unwrap();
        let told = ["content-type", "authorization", "x-api-key"].map(header);
        assert_eq!(told, ["application/x-protobuf", "Basic dXNlcjpodW50ZXIy", "k3y-of-hunter2"]);
        let secret = body.windows(7).any(|window| window == b"hunter2");
        assert!(!secret, "a secret is in the spans: {}", String::from_utf8_lossy(body));
        let request = ExportTraceServiceRequest::decode(body.clone()).unwrap();
        let resource = request.resource_spans[0].resource.as_ref().unwrap();
        let name = resource.attributes.iter().find(|attribute| attribute.key == "service.name").unwrap();
        let name = name.value.as_ref().unwrap().value.as_ref().unwrap();
        assert_eq!(name, &Value::StringValue("north".into()));
    }
}

fn is_root(span: &Span) -> bool {
    span.name == "frame" || span.kind == SpanKind::Server as i32
}

/// Children lie in their frame's time, one after the other in the order of the flow, and come to what the
/// histograms of the stages say.
fn check_children(spans: &[Span], metrics: &Metrics) {
    let mut children = BTreeMap::<_, Vec<_>>::new();
    let mut sums = BTreeMap::<_, f64>::new();
    for span in spans.iter().filter(|span| !is_root(span)) {
        children.entry((&span.trace_id, &span.parent_span_id)).or_default().push(span);
    }
    let mut linked = 0;
    for frame in spans.iter().filter(|span| span.name == "frame") {
        assert!(frame.parent_span_id.is_empty() && frame.trace_id.len() == 16 && frame.span_id.len() == 8);
        let outcome = text(frame, "gakp.outcome");
        assert_eq!(is_error(frame), ["corrupt", "inference"].contains(&outcome), "{frame:?}");
        let steps = children.remove(&(&frame.trace_id, &frame.span_id)).unwrap_or_default();
        let mut time = frame.start_time_unix_nano;
        for step in &steps {
            assert!(time <= step.start_time_unix_nano, "{step:?} before {time}: {frame:?}");
            assert!(step.start_time_unix_nano <= step.end_time_unix_nano, "{step:?}");
            time = step.end_time_unix_nano;
        }
        assert!(time <= frame.end_time_unix_nano, "{steps:?} after {frame:?}");
        let names: Vec<_> = steps.iter().map(|step| step.name.as_str()).collect();
        match outcome {
            "tracked" => {
                let link = names.contains(&"link");
                linked += u32::from(link);
                let expected = STEPS.into_iter().filter(|name| link || *name != "link");
                assert_eq!(names, expected.collect::<Vec<_>>());
            }
            "overload" => assert_eq!(names, ["wait"]),
            _ => {}
        }
        if outcome != "overload" {
            steps.iter().for_each(|step| *sums.entry(step.name.as_str()).or_default() += seconds(step));
        }
    }
    assert!(children.is_empty(), "spans without their frame: {children:?}");
    assert!(linked > 0, "nobody was followed");
    for (stage, steps) in [
        ("wait", &["wait"][..]),
        ("detect", &["detect"]),
        ("embed", &["embed"]),
        ("link", &["link"]),
        ("track", &["predict", "update"]),
    ] {
        let told = metrics.get(&format!("gakp_stage_seconds_sum{{stage=\"{stage}\"}}"));
        let traced: f64 = steps.iter().map(|step| sums[step]).sum();
        assert!((told - traced).abs() < 0.05 * told + 0.01, "{stage}: {told} s, by the traces {traced} s");
    }
}

#[test]
fn a_collector_that_is_away_stops_nothing() {
    let (collector, folder) =
        (Collector::start(StatusCode::SERVICE_UNAVAILABLE), tempfile::tempdir().unwrap());
    let traces = format!("[traces]\nendpoint = \"http://{}\"\nsample = 1\n", collector.address);
    let Some(service) = start(folder.path(), &traces) else { return };
    let failures = || service.metrics().get("gakp_traces_failures_total");
    eventually("two failures", || (failures() >= 2.0).then_some(()));
    service.wait_for_frames("demo", 10);
    assert_eq!(collector.spans(), []);
    collector.status.store(200, Ordering::SeqCst);
    // What was refused is tried again.
    eventually("the first frame", || {
        collector.frames("demo").iter().any(|frame| int(frame, "gakp.frame") == 0).then_some(())
    });
    assert!(service.metrics().get("gakp_traces_exported_total") > 0.0);
    // What was finished just before the end arrives.
    service.get("/v1/openapi.json");
    let log = service.stop();
    assert!(collector.spans().iter().any(|span| span.name == "GET /v1/openapi.json"));
    assert_eq!(log.matches("traces cannot be exported").count(), 1, "{log}");
    assert!(!log.contains("traces are lost"), "{log}");
}

#[test]
fn the_end_waits_for_no_collector() {
    let refusing = Refusing::start();
    // One takes the post and never answers.
    for address in [refusing.address(), strange_server(b"")] {
        let folder = tempfile::tempdir().unwrap();
        let traces = format!("[traces]\nendpoint = \"http://{address}\"\nsample = 1\n");
        let Some(service) = start(folder.path(), &traces) else { return };
        service.wait_for_frames("demo", 10);
        std::thread::sleep(Duration::from_millis(1500));
        let log = service.stop();
        assert!(!log.contains("draining took too long") && log.contains("traces are lost"), "{log}");
    }
}

#[test]
fn without_a_collector_nothing_is_traced() {
    let folder = tempfile::tempdir().unwrap();
    let Some(service) = start(folder.path(), "") else { return };
    service.wait_for_frames("demo", 5);
    assert!(!service.get("/metrics").body.contains("gakp_traces"));
    assert!(!service.stop().contains("traces"));
}
