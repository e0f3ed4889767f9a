//! Where what somebody else named may lead: on the network, or anywhere.
//!
//! An address that the service connects to for somebody else is a way into what only the service can reach: servers
//! on its loopback interface, a cloud's metadata server on a link-local address. Private networks are where cameras
//! and receivers are, so those are allowed.

use std::io;
use std::net::{IpAddr, Ipv6Addr, SocketAddr, UdpSocket};

/// How far a connection may go.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) enum Reach {
    /// Who named it may do everything anyway.
    #[default]
    Anywhere,
    /// Not to this machine, nor to a link-local address.
    Network,
}

impl Reach {
    /// The addresses of a host.
    ///
    /// # Errors
    /// The name cannot be resolved, or one of its addresses is out of reach ([`io::ErrorKind::PermissionDenied`]).
    pub async fn resolve(self, host: &str, port: u16) -> io::Result<Vec<SocketAddr>> {
        let host = host.trim_start_matches('[').trim_end_matches(']');
        let found: Vec<_> = tokio::net::lookup_host((host, port)).await?.collect();
        let is_out_of_reach = |ip| is_inside(ip) || is_own(ip);
        if self == Reach::Network && found.iter().any(|address| is_out_of_reach(address.ip())) {
            return Err(io::Error::new(
                io::ErrorKind::PermissionDenied,
                "the address is this machine's own or link-local, which only an admin may name",
            ));
        }
        Ok(found)
    }
}

/// Whether an interface of this machine has the address. Nothing is sent.
fn is_own(address: IpAddr) -> bool {
    match address {
        // Bound may also be what is no own address (net.ipv4.ip_nonlocal_bind), but then no route begins there. The
        // routes' own choice says less: for an interface's second address it is the first.
        IpAddr::V4(_) => path(address, address).is_ok(),
        IpAddr::V6(v6) => match embedded(v6) {
            Some(v4) => is_own(v4),
            // Here the routes choose the address itself, and a path from a foreign address may begin.
            None => path(Ipv6Addr::UNSPECIFIED.into(), address).is_ok_and(|source| source == address),
        },
    }
}

/// The address from which another is reached, where it may be any or is given.
fn path(from: IpAddr, to: IpAddr) -> io::Result<IpAddr> {
    let socket = UdpSocket::bind((from, 0))?;
    // Any port but 0 does.
    socket.connect((to, 9))?;
    Ok(socket.local_addr()?.ip())
}

/// Whether an address is of a kind that does not leave this machine, is link-local, or is no host's at all.
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
                v6.is_loopback()
                    || v6.is_unspecified()
                    || v6.is_unicast_link_local()
                    || v6.is_multicast()
                    // A cloud's metadata server.
                    || v6.segments() == [0xfd00, 0xec2, 0, 0, 0, 0, 0, 0x254]
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
    use std::net::Ipv4Addr;

    use super::*;

    #[tokio::test]
    async fn this_machines_address_on_the_network_is_its_own() {
        let elsewhere = IpAddr::from([198, 51, 100, 1]);
        assert!(!is_own(elsewhere));
        // Both are reached from the first, as an interface's second address is.
        assert!(is_own([127, 0, 0, 1].into()) && is_own([127, 1, 2, 3].into()));
        assert_eq!(path(Ipv4Addr::UNSPECIFIED.into(), [127, 1, 2, 3].into()).unwrap(), Ipv4Addr::LOCALHOST);
        let Ok(own) = path(Ipv4Addr::UNSPECIFIED.into(), elsewhere) else {
            eprintln!("SKIPPED: the machine is on no network");
            return;
        };
        for own in [own.to_string(), format!("[::ffff:{own}]"), format!("[64:ff9b::{own}]")] {
            let refused = Reach::Network.resolve(&own, 80).await.unwrap_err();
            assert_eq!(refused.kind(), io::ErrorKind::PermissionDenied, "{own}");
        }
    }

    #[tokio::test]
    async fn this_machine_is_out_of_reach_and_the_network_is_not() {
        for (host, allowed) in [
            ("192.168.1.20", true),
            ("10.0.0.2", true),
            ("[fd00::5]", true),
            ("127.0.0.1", false),
            ("127.1.2.3", false),
            ("localhost", false),
            ("0.0.0.0", false),
            ("169.254.169.254", false),
            ("[::1]", false),
            ("[::ffff:127.0.0.1]", false),
            ("[64:ff9b::7f00:1]", false),
            ("[fe80::1]", false),
            ("[fd00:ec2::254]", false),
            ("2130706433", false),
        ] {
            let found = Reach::Network.resolve(host, 80).await;
            assert_eq!(found.is_ok(), allowed, "{host}: {found:?}");
            if let Err(error) = found {
                assert_eq!(error.kind(), io::ErrorKind::PermissionDenied, "{host}");
            }
            assert!(Reach::Anywhere.resolve(host, 80).await.is_ok(), "{host}");
        }
    }
}
