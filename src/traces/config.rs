//! `[traces]` of the configuration, and what it comes to once checked.

use std::fmt;
use std::path::{Path, PathBuf};

use axum::http::{HeaderMap, HeaderName, HeaderValue};
use serde::Deserialize;
use tokio_rustls::TlsConnector;

use crate::outgoing::{Address, HTTP, Secret, trust};

/// What is traced where nothing is said: a hundredth.
const SAMPLE: f64 = 0.01;

/// Where OTLP takes traces, below the collector's address.
const PATH: &str = "/v1/traces";

const ENDPOINT: &str = "OTEL_EXPORTER_OTLP_ENDPOINT";
const SERVICE_NAME: &str = "OTEL_SERVICE_NAME";

/// `[traces]`.
#[derive(Clone, Debug, Default, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TracesOptions {
    /// The collector; may hold a login or a token.
    pub endpoint: Option<Secret>,
    /// The share of frames and requests that is traced, 0 to 1.
    pub sample: Option<f64>,
    /// `service.name`.
    pub service_name: Option<String>,
    /// A file with more headers of the posts, such as a key: `Name: value`, one a line.
    pub headers_file: Option<PathBuf>,
    /// Certificates to trust instead of the system's, PEM.
    pub ca_file: Option<PathBuf>,
}

/// What is wrong with `[traces]`; never quotes a secret.
#[derive(Debug, thiserror::Error)]
#[error("traces: {0}")]
pub struct TracesError(String);

/// Which traces go where, checked.
#[derive(Clone)]
pub struct TracesPlan {
    pub(super) address: Address,
    pub(super) headers: HeaderMap,
    pub(super) sample: f64,
    pub(super) service_name: String,
    pub(super) tls: Option<TlsConnector>,
}

impl TracesPlan {
    /// Whether the collector can be reached; nothing is exported.
    ///
    /// # Errors
    /// Why not, in words.
    pub async fn knock(&self) -> Result<(), String> {
        self.address.knock(self.tls.as_ref()).await
    }

    /// Where the collector is: scheme, host and port.
    pub fn place(&self) -> String {
        self.address.to_string()
    }
}

impl fmt::Debug for TracesPlan {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "TracesPlan({} of all to {})", self.sample, self.address)
    }
}

impl TracesOptions {
    /// Checks `options`, reads the files that they name. What they leave out is looked for in `environment`;
    /// nothing is traced where neither names a collector.
    ///
    /// # Errors
    /// [`TracesError`] names the setting.
    pub fn check(
        options: Option<Self>,
        folder: &Path,
        environment: impl Fn(&str) -> Option<String>,
    ) -> Result<Option<TracesPlan>, TracesError> {
        let environment = |name| environment(name).filter(|value| !value.trim().is_empty());
        let (endpoint, name) = (environment(ENDPOINT), environment(SERVICE_NAME));
        let Some(options) = options.or_else(|| endpoint.as_ref().map(|_| Self::default())) else {
            return Ok(None);
        };
        options.checked(folder, endpoint, name).map(Some).map_err(TracesError)
    }

    fn checked(
        self,
        folder: &Path,
        endpoint: Option<String>,
        name: Option<String>,
    ) -> Result<TracesPlan, String> {
        let (place, endpoint) = match (&self.endpoint, &endpoint) {
            (Some(endpoint), _) => ("its endpoint", endpoint.text()),
            (None, Some(endpoint)) => (ENDPOINT, endpoint.as_str()),
            (None, None) => {
                return Err(format!(
                    "there is no endpoint: name the collector, such as \"http://127.0.0.1:4318\", here or in {ENDPOINT}"
                ));
            }
        };
        let mut address = Address::parse(endpoint, &HTTP).map_err(|e| format!("{place} {e}"))?;
        address.path = below(&address.path);
        let sample = self.sample.unwrap_or(SAMPLE);
        if !(0.0..=1.0).contains(&sample) {
            return Err(format!("sample = {sample}: must be from 0 to 1"));
        }
        let headers = self.headers_file.map(|file| read_headers(&folder.join(file))).transpose()?;
        let ca_file = self.ca_file.map(|file| folder.join(file));
        Ok(TracesPlan {
            tls: address.tls.then(|| trust(ca_file.as_deref())).transpose()?,
            address,
            headers: headers.unwrap_or_default(),
            sample,
            service_name: self.service_name.or(name).unwrap_or_else(|| "gakp".into()),
        })
    }
}

/// Path and query of the collector with OTLP's path added, if it is not there.
fn below(path: &str) -> String {
    let (path, query) = path.split_once('?').map_or((path, None), |(path, query)| (path, Some(query)));
    let path = path.trim_end_matches('/');
    let path = format!("{}{PATH}", path.strip_suffix(PATH).unwrap_or(path));
    query.map_or(path.clone(), |query| format!("{path}?{query}"))
}

/// The headers of a file; errors name the line and do not repeat it.
fn read_headers(file: &Path) -> Result<HeaderMap, String> {
    let text = std::fs::read_to_string(file);
    let text = text.map_err(|e| format!("cannot read headers_file {}: {e}", file.display()))?;
    let mut headers = HeaderMap::new();
    for (index, line) in text.lines().enumerate().filter(|(_, line)| !line.trim().is_empty()) {
        let header = line.split_once(':').and_then(|(name, value)| {
            let mut value: HeaderValue = value.trim().parse().ok()?;
            value.set_sensitive(true);
            Some((name.trim().parse::<HeaderName>().ok()?, value))
        });
        let (name, value) = header.ok_or_else(|| {
            format!("headers_file {} line {}: must be Name: value", file.display(), index + 1)
        })?;
        headers.append(name, value);
    }
    Ok(headers)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn check(text: Option<&str>, environment: &[(&str, &str)]) -> Result<Option<TracesPlan>, String> {
        let options = text.map(toml::from_str).transpose();
        let options = options.map_err(|e: toml::de::Error| e.message().to_owned())?;
        let find = |name: &str| environment.iter().find(|(n, _)| *n == name).map(|(_, v)| (*v).to_owned());
        TracesOptions::check(options, Path::new(""), find).map_err(|e| e.to_string())
    }

    #[test]
    fn it_is_off_until_a_collector_is_named() {
        assert!(check(None, &[]).unwrap().is_none());
        assert!(check(None, &[(ENDPOINT, " "), (SERVICE_NAME, "north")]).unwrap().is_none());
        let plan = check(None, &[(ENDPOINT, "http://h:4318/"), (SERVICE_NAME, "north")]).unwrap().unwrap();
        assert_eq!((plan.address.path.as_str(), plan.sample, plan.address.port), (PATH, SAMPLE, 4318));
        assert_eq!(plan.service_name, "north");
        let text =
            "endpoint = \"http://u:hunter2@file/base?key=s3cret\"\nsample = 1\nservice_name = \"south\"";
        let plan = check(Some(text), &[(ENDPOINT, "http://h"), (SERVICE_NAME, "north")]).unwrap().unwrap();
        assert_eq!((plan.address.host.as_str(), plan.service_name.as_str()), ("file", "south"));
        assert_eq!(plan.address.path, "/base/v1/traces?key=s3cret");
        assert_eq!(format!("{plan:?}"), "TracesPlan(1 of all to http://file/...)");
        let plan = check(Some("sample = 0.5"), &[(ENDPOINT, "http://h/x/v1/traces")]).unwrap().unwrap();
        assert_eq!((plan.address.path.as_str(), plan.sample), ("/x/v1/traces", 0.5));
    }

    #[test]
    fn mistakes_are_named_and_no_secret_is_quoted() {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), "Api-Key: k\n\nhunter2\n").unwrap();
        let headers = format!("endpoint = \"http://h\"\nheaders_file = {:?}", file.path());
        for (text, expected) in [
            ("", ENDPOINT),
            ("endpoint = 4711", "must be a text in quotes"),
            ("endpoint = \"grpc://u:hunter2@h\"", "its endpoint does not begin with http:// or https://"),
            ("endpoint = \"http://h\"\nsample = 2", "sample = 2"),
            ("endpoint = \"http://h\"\nsample = nan", "sample = NaN"),
            ("endpoint = \"http://h\"\nheaders_file = \"/no/such\"", "headers_file /no/such"),
            ("endpoint = \"https://h\"\nca_file = \"/no/such\"", "/no/such"),
            ("endpoint = \"http://h\"\nsamples = 1", "samples"),
            (&headers, "line 3"),
        ] {
            let error = check(Some(text), &[]).unwrap_err();
            assert!(error.contains(expected) && !error.contains("hunter2"), "{text}: {error}");
            assert!(!error.contains("4711"), "{error}");
        }
        let error = check(None, &[(ENDPOINT, "hunter2")]).unwrap_err();
        assert!(error.contains(ENDPOINT) && !error.contains("hunter2"), "{error}");
    }
}
