//! Where a camera of someone who is no admin may be: on the network, not in this machine.
//!
//! An address that the service opens for somebody else is a way into what only the service can reach: files and
//! devices, servers on its loopback interface, a cloud's metadata server on a link-local address. Private networks
//! are where cameras are, so those are allowed.

use std::net::{IpAddr, Ipv6Addr};

use super::problem::Problem;
use crate::auth::{Identity, Role};
use crate::ingest::SourceSpec;

/// Refuses anybody but an admin what only an admin may add. A host name is resolved here and again when the camera is opened: who
/// rules its DNS may answer differently then.
pub(super) async fn check(identity: Option<&Identity>, url: &str) -> Result<(), Problem> {
    if identity.is_some_and(|identity| identity.role >= Role::Admin) {
        return Ok(());
    }
    // Whatever is wrong with it is told by whoever opens it.
    let Ok(spec) = SourceSpec::parse(url) else { return Ok(()) };
    let Some((host, port)) = spec.url.rtsp_host() else {
        return Err(Problem::forbidden(
            "only an admin's token may add a source that is no rtsp:// or rtsps:// URL",
        ));
    };
    let host = host.trim_start_matches('[').trim_end_matches(']');
    let addresses = tokio::net::lookup_host((host, port))
        .await
        .map_err(|_| Problem::bad_request("the camera's host name cannot be resolved"))?;
    for address in addresses {
        if is_inside(address.ip()) {
            return Err(Problem::forbidden(
                "only an admin's token may add a camera on this machine or on a link-local address",
            ));
        }
    }
    Ok(())
}

/// Whether an address is this machine's own, link-local, or no host's at all.
fn is_inside(address: IpAddr) -> bool {
    match address {
        IpAddr::V4(v4) => {
            v4.is_loopback()
                || v4.is_unspecified()
                || v4.is_link_local()
                || v4.is_multicast()
                || v4.is_broadcast()
                || v4.octets()[0] == 0
        }
        IpAddr::V6(v6) => match embedded(v6) {
            Some(v4) => is_inside(v4),
            None => {
                v6.is_loopback() || v6.is_unspecified() || v6.is_unicast_link_local() || v6.is_multicast()
            }
        },
    }
}

/// The IPv4 address in a mapped (`::ffff:a.b.c.d`) or NAT64 (`64:ff9b::a.b.c.d`) one.
fn embedded(v6: Ipv6Addr) -> Option<IpAddr> {
    let [a, b, c, d, ..] = v6.segments();
    let nat64 = [a, b, c, d] == [0x64, 0xff9b, 0, 0];
    let [.., w, x, y, z] = v6.octets();
    v6.to_ipv4_mapped().map(IpAddr::V4).or_else(|| nat64.then(|| IpAddr::from([w, x, y, z])))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn bearer(role: Role) -> Identity {
        Identity { name: "t".into(), role, video: false }
    }

    #[tokio::test]
    async fn cameras_are_on_the_network() {
        for (url, allowed) in [
            ("rtsp://192.168.1.20/stream", true),
            ("rtsps://10.0.0.2:322/stream", true),
            ("rtsp://[fd00::5]/stream", true),
            ("rtsp://127.0.0.1/stream", false),
            ("rtsp://user:pw@127.1.2.3:8554/stream", false),
            ("rtsp://localhost/stream", false),
            ("rtsp://0.0.0.0/stream", false),
            ("rtsp://169.254.169.254/latest", false),
            ("rtsp://[::1]/stream", false),
            ("rtsp://[::ffff:127.0.0.1]/stream", false),
            ("rtsp://[64:ff9b::7f00:1]/stream", false),
            ("rtsp://[fe80::1]/stream", false),
            ("rtsp://2130706433/stream", false),
            ("http://192.168.1.20/stream", false),
            ("file:///etc/passwd", false),
            ("/etc/passwd", false),
            ("v4l2:///dev/video0", false),
            ("test:", false),
        ] {
            assert_eq!(check(Some(&bearer(Role::Operator)), url).await.is_ok(), allowed, "{url}");
            assert_eq!(check(None, url).await.is_ok(), allowed, "{url}");
            assert!(check(Some(&bearer(Role::Admin)), url).await.is_ok(), "{url}");
        }
    }
}
