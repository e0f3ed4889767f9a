//! An event as CloudEvents 1.0 in structured JSON, and its signature by the Standard Webhooks scheme.

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use bytes::Bytes;
use serde::{Deserialize, Serialize};
use serde_json::value::RawValue;

use crate::publish::NumberedEvent;

/// The body's media type.
pub(super) const MEDIA_TYPE: &str = "application/cloudevents+json; charset=utf-8";

#[derive(Serialize)]
struct CloudEvent<'a> {
    specversion: &'static str,
    id: &'a str,
    source: String,
    #[serde(rename = "type")]
    kind: String,
    #[serde(skip_serializing_if = "Option::is_none")]
    subject: Option<&'a str>,
    time: &'a str,
    datacontenttype: &'static str,
    data: &'a RawValue,
}

/// What of the event's own message the envelope repeats.
#[derive(Deserialize)]
struct Told<'a> {
    time: &'a str,
    line: Option<&'a str>,
    zone: Option<&'a str>,
}

/// The body of a post: `data` is the event as `/v1/events` tells it, byte for byte.
pub(super) fn body(event: &NumberedEvent) -> serde_json::Result<Bytes> {
    let data: &RawValue = serde_json::from_slice(&event.json)?;
    let told: Told = serde_json::from_str(data.get())?;
    let cloud_event = CloudEvent {
        specversion: "1.0",
        id: &event.id,
        source: format!("/cameras/{}", event.camera),
        kind: format!("gakp.{}", event.kind),
        subject: told.line.or(told.zone),
        time: told.time,
        datacontenttype: "application/json",
        data,
    };
    serde_json::to_vec(&cloud_event).map(Bytes::from)
}

/// The body of a post that only tries whether a receiver takes posts.
pub(super) fn trial(id: &str, webhook: &str, time: &str) -> serde_json::Result<Bytes> {
    let data: &RawValue = serde_json::from_str(r#"{"type":"test"}"#)?;
    let cloud_event = CloudEvent {
        specversion: "1.0",
        id,
        source: format!("/webhooks/{webhook}"),
        kind: "gakp.test".into(),
        subject: None,
        time,
        datacontenttype: "application/json",
        data,
    };
    serde_json::to_vec(&cloud_event).map(Bytes::from)
}

/// The value of `webhook-signature`.
pub(super) fn signature(key: &ring::hmac::Key, id: &str, timestamp: i64, body: &[u8]) -> String {
    let mut context = ring::hmac::Context::with_key(key);
    context.update(format!("{id}.{timestamp}.").as_bytes());
    context.update(body);
    format!("v1,{}", STANDARD.encode(context.sign()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::notify::queue::tests::event;

    #[test]
    fn a_body_is_exactly_this() {
        let json = r#"{"id":"1-1","type":"line.crossed","camera":"gate","time":"2026-01-02T03:04:05.000000006Z","line":"door","place":[0.5,1.0]}"#;
        let event = NumberedEvent { id: "1-1".into(), kind: "line.crossed", json: json.into(), ..event(1) };
        let expected = format!(
            "{}{json}}}",
            concat!(
                r#"{"specversion":"1.0","id":"1-1","source":"/cameras/gate","type":"gakp.line.crossed","#,
                r#""subject":"door","time":"2026-01-02T03:04:05.000000006Z","datacontenttype":"application/json","data":"#,
            )
        );
        assert_eq!(std::str::from_utf8(&body(&event).unwrap()).unwrap(), expected);
    }

    /// The example of the Standard Webhooks specification's reference libraries.
    #[test]
    fn a_signature_is_that_of_the_reference() {
        let secret = STANDARD.decode("MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSw").unwrap();
        let key = ring::hmac::Key::new(ring::hmac::HMAC_SHA256, &secret);
        let signed =
            signature(&key, "msg_p5jXN8AQM9LWM0D4loKWxJek", 1_614_265_330, br#"{"test": 2432232314}"#);
        assert_eq!(signed, "v1,g0hM9SsE+OTPJTGt/tmIKtSyZlE3uFJELVlNIOLJ1OE=");
    }
}
