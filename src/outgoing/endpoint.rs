//! Where a receiver is: a webhook, a broker, a collector, and the way there. What may be secret in its URL is never shown.

use std::fmt;
use std::io;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use axum::http::Uri;
use percent_encoding::percent_decode_str;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::net::TcpStream;
use tokio::time::timeout;
use tokio_rustls::TlsConnector;
use tokio_rustls::rustls::pki_types::pem::PemObject;
use tokio_rustls::rustls::pki_types::{CertificateDer, ServerName};
use tokio_rustls::rustls::{self, ClientConfig, RootCertStore};

use super::reach::Reach;

/// A scheme that an address may have.
#[derive(Clone, Copy, PartialEq)]
pub(crate) struct Scheme {
    pub name: &'static str,
    pub tls: bool,
    pub port: u16,
}

/// Those of posts.
pub(crate) const HTTP: [Scheme; 2] =
    [Scheme { name: "http", tls: false, port: 80 }, Scheme { name: "https", tls: true, port: 443 }];

/// How long a receiver may take that is only tried.
pub(crate) const KNOCK: Duration = Duration::from_secs(10);

/// User and password, percent-decoded.
#[derive(Clone, PartialEq)]
pub(crate) struct Login {
    pub user: String,
    pub password: String,
}

/// A URL taken apart. `Display` and `Debug` show scheme, host and port: a path or a query may be a token.
#[derive(Clone, PartialEq)]
pub(crate) struct Address {
    scheme: Scheme,
    pub tls: bool,
    pub host: String,
    pub port: u16,
    pub login: Option<Login>,
    /// Path and query.
    pub path: String,
    /// How far it may lead; asked at each connection, for a name may have another address then.
    pub reach: Reach,
}

impl Address {
    /// Takes a URL apart; the error says what is wrong and repeats nothing of it.
    pub fn parse(url: &str, schemes: &[Scheme]) -> Result<Self, String> {
        let known = || schemes.iter().map(|s| format!("{}://", s.name)).collect::<Vec<_>>().join(" or ");
        let uri: Uri = url.trim().parse().map_err(|_| format!("is no URL that begins with {}", known()))?;
        let scheme = uri.scheme_str().unwrap_or_default();
        let scheme = schemes
            .iter()
            .find(|s| s.name.eq_ignore_ascii_case(scheme))
            .ok_or_else(|| format!("does not begin with {}", known()))?;
        let authority = uri.authority().ok_or("has no host")?.as_str();
        let login = match authority.rsplit_once('@') {
            None => None,
            Some((login, _)) => {
                let (user, password) = login.split_once(':').unwrap_or((login, ""));
                let decode = |text| {
                    let text = percent_decode_str(text).decode_utf8();
                    text.map(String::from).map_err(|_| "has a login that is not percent-encoded UTF-8")
                };
                Some(Login { user: decode(user)?, password: decode(password)? })
            }
        };
        let host = uri.host().unwrap_or_default().to_owned();
        if host.is_empty() {
            return Err("has no host".into());
        }
        let rest = authority.rsplit('@').next().unwrap_or_default();
        if rest.len() > host.len() && uri.port_u16().is_none() {
            return Err("has a port that is none".into());
        }
        let path = uri.path_and_query().map_or("/", |path| path.as_str()).to_owned();
        let port = uri.port_u16().unwrap_or(scheme.port);
        Ok(Self { scheme: *scheme, tls: scheme.tls, host, port, login, path, reach: Reach::Anywhere })
    }

    /// `host:port`, or the host alone where the port is the scheme's own.
    pub fn authority(&self) -> String {
        if self.port == self.scheme.port { self.host.clone() } else { format!("{}:{}", self.host, self.port) }
    }

    /// Connects; over TLS where the scheme says so.
    pub async fn connect(&self, tls: Option<&TlsConnector>) -> io::Result<Box<dyn Stream>> {
        let host = self.host.trim_start_matches('[').trim_end_matches(']');
        let addresses = self.reach.resolve(host, self.port).await?;
        let stream = TcpStream::connect(addresses.as_slice()).await?;
        // Messages are small and wanted at once.
        let _ = stream.set_nodelay(true);
        let Some(tls) = tls.filter(|_| self.tls) else { return Ok(Box::new(stream)) };
        let name = ServerName::try_from(host.to_owned()).map_err(io::Error::other)?;
        Ok(Box::new(tls.connect(name, stream).await?))
    }

    /// Whether it can be reached, by TLS where the scheme says so; nothing is asked.
    ///
    /// # Errors
    /// Why not, in words.
    pub async fn knock(&self, tls: Option<&TlsConnector>) -> Result<(), String> {
        match timeout(KNOCK, self.connect(tls)).await {
            Ok(Ok(_)) => Ok(()),
            Ok(Err(error)) => Err(error.to_string()),
            Err(_) => Err(format!("no connection within {} s", KNOCK.as_secs())),
        }
    }
}

impl fmt::Display for Address {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let more = if self.path == "/" { "" } else { "/..." };
        write!(f, "{}://{}{more}", self.scheme.name, self.authority())
    }
}

impl fmt::Debug for Address {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Address({self})")
    }
}

/// A connection, encrypted or not.
pub(crate) trait Stream: AsyncRead + AsyncWrite + Unpin + Send + Sync {}

impl<T: AsyncRead + AsyncWrite + Unpin + Send + Sync> Stream for T {}

/// The client's side of TLS: who is trusted is in `ca_file`, or what the system trusts. The error says what to do.
pub(crate) fn trust(ca_file: Option<&Path>) -> Result<TlsConnector, String> {
    let mut roots = RootCertStore::empty();
    match ca_file {
        Some(file) => {
            let found = CertificateDer::pem_file_iter(file).and_then(Iterator::collect::<Result<Vec<_>, _>>);
            let found =
                found.map_err(|e| format!("cannot read certificates from {}: {e}", file.display()))?;
            for certificate in found {
                roots.add(certificate).map_err(|e| format!("{}: {e}", file.display()))?;
            }
        }
        None => {
            roots.add_parsable_certificates(rustls_native_certs::load_native_certs().certs);
        }
    }
    if roots.is_empty() {
        let place = ca_file.map_or("the system".into(), |file| file.display().to_string());
        return Err(format!(
            "{place} has no certificates to trust: install ca-certificates, or name a ca_file in the configuration"
        ));
    }
    let provider = Arc::new(rustls::crypto::ring::default_provider());
    let config = ClientConfig::builder_with_provider(provider)
        .with_safe_default_protocol_versions()
        .map_err(|e| e.to_string())?
        .with_root_certificates(roots)
        .with_no_client_auth();
    Ok(TlsConnector::from(Arc::new(config)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_address_shows_no_secret() {
        let url = "https://user:hunt%40er2@hooks.example/services/T0KEN?key=s3cret";
        let address = Address::parse(url, &HTTP).unwrap();
        assert_eq!((address.host.as_str(), address.port, address.tls), ("hooks.example", 443, true));
        assert_eq!(address.path, "/services/T0KEN?key=s3cret");
        let login = Login { user: "user".into(), password: "hunt@er2".into() };
        assert!(address.login == Some(login));
        assert_eq!(
            format!("{address} {address:?}"),
            "https://hooks.example/... Address(https://hooks.example/...)"
        );
        let plain = Address::parse("http://[::1]:8080", &HTTP).unwrap();
        assert_eq!((plain.to_string().as_str(), plain.path.as_str()), ("http://[::1]:8080", "/"));
    }

    #[tokio::test]
    async fn how_far_it_may_lead_is_asked_at_the_connection() {
        let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
        let url = format!("http://{}/", listener.local_addr().unwrap());
        let mut address = Address::parse(&url, &HTTP).unwrap();
        assert!(address.connect(None).await.is_ok());
        address.reach = Reach::Network;
        let Err(refused) = address.connect(None).await else { panic!("connected") };
        assert_eq!(refused.kind(), io::ErrorKind::PermissionDenied);
    }

    #[test]
    fn what_is_no_address_is_refused_without_repeating_it() {
        for url in [
            "",
            "hunter2",
            "ftp://hunter2@h/",
            "http://",
            "http://h:hunter2/",
            "/hunter2",
            "http://u:hunter2@/",
        ] {
            let error = Address::parse(url, &HTTP).unwrap_err();
            assert!(!error.contains("hunter2"), "{url}: {error}");
        }
    }
}
