//! Where a camera or a receiver of someone who is no admin may be: on the network, not in this machine.

use std::io;

use super::problem::Problem;
use crate::auth::{Identity, Role};
use crate::ingest::SourceSpec;
use crate::outgoing::Reach;

/// How far what somebody names may lead.
pub(super) fn reach(identity: Option<&Identity>) -> Reach {
    match identity {
        Some(identity) if identity.role >= Role::Admin => Reach::Anywhere,
        _ => Reach::Network,
    }
}

/// Refuses anybody but an admin a camera that only an admin may add. A host name is resolved here and again when the camera is
/// opened: who rules its DNS may answer differently then.
pub(super) async fn check_camera(identity: Option<&Identity>, url: &str) -> Result<(), Problem> {
    if reach(identity) == Reach::Anywhere {
        return Ok(());
    }
    // Whatever is wrong with it is told by whoever opens it.
    let Ok(spec) = SourceSpec::parse(url) else { return Ok(()) };
    let Some((host, port)) = spec.url.rtsp_host() else {
        return Err(Problem::forbidden(
            "only an admin's token may add a source that is no rtsp:// or rtsps:// URL",
        ));
    };
    check_host(identity, "camera", host, port).await
}

/// Refuses anybody but an admin a host of this machine, or one that does not resolve.
pub(super) async fn check_host(
    identity: Option<&Identity>,
    what: &str,
    host: &str,
    port: u16,
) -> Result<(), Problem> {
    let reach = reach(identity);
    if reach == Reach::Anywhere {
        return Ok(());
    }
    match reach.resolve(host, port).await {
        Ok(_) => Ok(()),
        Err(error) if error.kind() == io::ErrorKind::PermissionDenied => Err(Problem::forbidden(format!(
            "only an admin's token may add a {what} on this machine or on a link-local address"
        ))),
        Err(_) => Err(Problem::bad_request(format!("the {what}'s host name cannot be resolved"))),
    }
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
            ("rtsp://user:pw@127.1.2.3:8554/stream", false),
            ("rtsp://localhost/stream", false),
            ("rtsp://[::1]/stream", false),
            ("http://192.168.1.20/stream", false),
            ("file:///etc/passwd", false),
            ("/etc/passwd", false),
            ("v4l2:///dev/video0", false),
            ("test:", false),
        ] {
            assert_eq!(check_camera(Some(&bearer(Role::Operator)), url).await.is_ok(), allowed, "{url}");
            assert_eq!(check_camera(None, url).await.is_ok(), allowed, "{url}");
            assert!(check_camera(Some(&bearer(Role::Admin)), url).await.is_ok(), "{url}");
        }
    }
}
