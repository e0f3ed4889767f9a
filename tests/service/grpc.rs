//! gRPC from the running service, beside a WebSocket.

use std::collections::BTreeMap;

use gakp::publish::wire::{TrackMessage, track_message::Message as Payload};
use prost::Message as _;
use serde_json::json;

use super::grpc_client::Stubs;
use super::support::*;

#[test]
fn grpc_tells_what_the_websocket_tells() {
    let Some(stubs) = Stubs::make() else { return };
    let state = tempfile::tempdir().unwrap();
    let Some(service) = Service::demo(state.path()) else { return };
    let mut socket = service.protobuf_socket("/v1/tracks?camera=demo&state=confirmed");
    let request = json!({"camera": ["demo"], "state": ["TRACK_STATE_CONFIRMED"]});
    let calls = stubs.call(service.address, &json!([{"request": request}]));
    // Of both, until there is somebody to be seen in enough of them.
    let mut by_socket = BTreeMap::new();
    let (mut compared, mut seen) = (0, 0);
    while compared < 20 || seen < 5 {
        let Some(Payload::Frame(told)) = calls.message().message else { panic!("not a frame") };
        while !by_socket.contains_key(&told.seq) {
            let message = TrackMessage::decode(&socket.binary()[..]).unwrap();
            let Some(Payload::Frame(frame)) = message.message else { panic!("not a frame") };
            assert!(frame.seq <= told.seq, "the WebSocket, which was open before, missed {}", told.seq);
            by_socket.insert(frame.seq, frame);
        }
        assert_eq!(by_socket[&told.seq], told);
        compared += 1;
        seen += usize::from(!told.tracks.is_empty());
    }
    assert!(service.metrics().get("gakp_hub_subscribers") >= 2.0);
    service.stop();
    assert_eq!(calls.end(), "UNAVAILABLE the service stops");
}
