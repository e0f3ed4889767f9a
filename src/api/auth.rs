//! Who may call what: the rights of every route, and signing in at the page.

use axum::extract::{MatchedPath, Request, State};
use axum::http::{HeaderMap, HeaderValue, Method, StatusCode, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use axum::{Extension, Json};
use serde::{Deserialize, Serialize};

use super::ApiState;
use super::extract::JsonBody;
use super::problem::Problem;
use super::socket::same_origin;
use crate::auth::{Gate, Identity, Right, Role, SESSION_LIFE};

/// The cookie of the page's session.
const COOKIE: &str = "gakp_session";

const VIEW: Right = Right::Role(Role::Viewer);
const CHANGE: Right = Right::Role(Role::Operator);
const ADMIN: Right = Right::Role(Role::Admin);

/// What each route asks for. One that is not here asks for an admin. `HEAD` asks for what `GET` does.
pub const RIGHTS: [(&str, &str, Right); 56] = [
    ("GET", "/v1/cameras", VIEW),
    ("POST", "/v1/cameras", CHANGE),
    ("GET", "/v1/cameras/{id}", VIEW),
    ("PATCH", "/v1/cameras/{id}", CHANGE),
    ("DELETE", "/v1/cameras/{id}", CHANGE),
    ("GET", "/v1/cameras/{id}/snapshot.jpg", Right::Video),
    ("GET", "/v1/cameras/{id}/stream.mjpeg", Right::Video),
    ("GET", "/v1/cameras/{id}/live", Right::Video),
    ("GET", "/v1/cameras/{id}/lines", VIEW),
    ("POST", "/v1/cameras/{id}/lines", CHANGE),
    ("GET", "/v1/cameras/{id}/lines/{line}", VIEW),
    ("PUT", "/v1/cameras/{id}/lines/{line}", CHANGE),
    ("DELETE", "/v1/cameras/{id}/lines/{line}", CHANGE),
    ("GET", "/v1/cameras/{id}/zones", VIEW),
    ("POST", "/v1/cameras/{id}/zones", CHANGE),
    ("GET", "/v1/cameras/{id}/zones/{zone}", VIEW),
    ("PUT", "/v1/cameras/{id}/zones/{zone}", CHANGE),
    ("DELETE", "/v1/cameras/{id}/zones/{zone}", CHANGE),
    ("GET", "/v1/cameras/{id}/masks", VIEW),
    ("POST", "/v1/cameras/{id}/masks", ADMIN),
    ("GET", "/v1/cameras/{id}/masks/{mask}", VIEW),
    ("PUT", "/v1/cameras/{id}/masks/{mask}", ADMIN),
    ("DELETE", "/v1/cameras/{id}/masks/{mask}", ADMIN),
    ("GET", "/v1/cameras/{id}/counts", VIEW),
    ("GET", "/v1/cameras/{id}/heatmap", VIEW),
    ("GET", "/v1/tracks", VIEW),
    ("GET", "/v1/tracks/stream", VIEW),
    ("POST", "/gakp.v1.Tracks/Subscribe", VIEW),
    ("GET", "/v1/events", VIEW),
    ("GET", "/v1/events/live", VIEW),
    ("GET", "/v1/history", VIEW),
    ("GET", "/v1/history/tracks", VIEW),
    ("GET", "/v1/history/tracks/{camera}/{epoch}/{track}", VIEW),
    ("GET", "/v1/history/tracks/{camera}/{epoch}/{track}/snapshot.jpg", Right::Video),
    ("GET", "/v1/history/tracks.csv", VIEW),
    ("GET", "/v1/history/tracks.txt", VIEW),
    ("GET", "/v1/history/events", VIEW),
    ("GET", "/v1/history/events.csv", VIEW),
    ("GET", "/v1/history/counts", VIEW),
    ("GET", "/v1/webhooks", CHANGE),
    ("POST", "/v1/webhooks", CHANGE),
    ("GET", "/v1/webhooks/{name}", CHANGE),
    ("PATCH", "/v1/webhooks/{name}", CHANGE),
    ("DELETE", "/v1/webhooks/{name}", CHANGE),
    ("POST", "/v1/webhooks/{name}/test", CHANGE),
    ("GET", "/v1/session", Right::Nobody),
    ("POST", "/v1/session", Right::Nobody),
    ("DELETE", "/v1/session", Right::Nobody),
    ("GET", "/v1/openapi.json", Right::Nobody),
    ("GET", "/v1/log", ADMIN),
    ("PUT", "/v1/log", ADMIN),
    ("POST", "/v1/reload", ADMIN),
    ("GET", "/metrics", VIEW),
    ("GET", "/healthz", Right::Nobody),
    ("GET", "/readyz", Right::Nobody),
    ("GET", "/", Right::Nobody),
];

fn right(method: &Method, path: &str) -> Right {
    let method = if method == Method::HEAD { "GET" } else { method.as_str() };
    if method == "GET" && path.starts_with("/page/") {
        return Right::Nobody;
    }
    let found = RIGHTS.iter().find(|(m, p, _)| *m == method && *p == path);
    found.map_or(Right::Role(Role::Admin), |(_, _, right)| *right)
}

/// Lets through who may, and tells the handler who it is.
pub(super) async fn guard(
    State(state): State<ApiState>,
    path: MatchedPath,
    mut request: Request,
    next: Next,
) -> Result<Response, Problem> {
    let right = right(request.method(), path.as_str());
    let identity = match identify(&state.gate, request.method(), request.headers()) {
        Ok(identity) => identity,
        // Health, the page and signing in are for everybody, with a stale cookie too.
        Err(problem) if right != Right::Nobody => return Err(problem),
        Err(_) => None,
    };
    if right != Right::Nobody {
        let Some(identity) = &identity else {
            return Err(Problem::unauthenticated(
                "send `Authorization: Bearer TOKEN`, or sign in at the page",
            ));
        };
        if !right.is_of(identity) {
            return Err(Problem::forbidden(match right {
                Right::Role(least) => {
                    let (name, role) = (&identity.name, identity.role.as_str());
                    format!("token {name:?} is a {role}'s; this needs a token of role {}", least.as_str())
                }
                _ => format!("token {:?} may not see pictures; make one with --video", identity.name),
            }));
        }
    }
    request.extensions_mut().insert(identity);
    Ok(next.run(request).await)
}

/// Who asks; `None` for who does not say. A token or session that is not known is an error.
fn identify(gate: &Gate, method: &Method, headers: &HeaderMap) -> Result<Option<Identity>, Problem> {
    if gate.is_open() {
        // A page of another site can make its visitor's browser come here under a name of its own
        // (DNS rebinding), but not by address.
        if !by_address(headers) {
            return Err(Problem::forbidden(
                "without tokens the service answers only to its address or localhost; \
                 `gakp token create` makes a token",
            ));
        }
        return Ok(Some(Identity { name: "anybody".into(), role: Role::Admin, video: true }));
    }
    if let Some(value) = headers.get(header::AUTHORIZATION) {
        let token = value.to_str().ok().and_then(|text| {
            let (scheme, token) = text.split_once(' ')?;
            scheme.eq_ignore_ascii_case("bearer").then(|| token.trim())
        });
        let identity = token.and_then(|token| gate.bearer(token));
        return match identity {
            Some(identity) => Ok(Some(identity)),
            None => Err(Problem::unauthenticated("the token is not known; it may have been revoked")),
        };
    }
    let Some(session) = cookie(headers) else { return Ok(None) };
    let Some(identity) = gate.session(session) else {
        return Err(Problem::unauthenticated("the session has ended; sign in again"));
    };
    // The cookie is SameSite=Strict; this is the second lock.
    if !method.is_safe() && !same_origin(headers) {
        return Err(Problem::forbidden_origin("a session is used only by pages of this service"));
    }
    Ok(Some(identity))
}

/// Whether the request names the service by an IP address or as localhost.
fn by_address(headers: &HeaderMap) -> bool {
    // HTTP/1.0 clients need not say.
    let Some(host) = headers.get(header::HOST) else { return true };
    let Ok(host) = host.to_str() else { return false };
    let name = match host.strip_prefix('[') {
        Some(rest) => rest.split(']').next().unwrap_or(""),
        None => host.rsplit_once(':').map_or(host, |(name, _)| name),
    };
    name.eq_ignore_ascii_case("localhost") || name.parse::<std::net::IpAddr>().is_ok()
}

fn cookie(headers: &HeaderMap) -> Option<&str> {
    let all = headers.get_all(header::COOKIE).iter().filter_map(|value| value.to_str().ok());
    let mut pairs = all.flat_map(|text| text.split(';')).filter_map(|pair| pair.trim().split_once('='));
    pairs.find(|(name, _)| *name == COOKIE).map(|(_, value)| value)
}

/// `GET /v1/session`: who asks, as far as is known.
#[derive(Serialize)]
pub(super) struct SessionBody {
    /// `open`: nobody needs a token. `required`: everybody does.
    auth: &'static str,
    name: Option<String>,
    role: Option<&'static str>,
    video: Option<bool>,
}

impl SessionBody {
    fn new(gate: &Gate, identity: Option<&Identity>) -> Self {
        Self {
            auth: if gate.is_open() { "open" } else { "required" },
            name: identity.map(|i| i.name.clone()),
            role: identity.map(|i| i.role.as_str()),
            video: identity.map(|i| i.video),
        }
    }
}

pub(super) async fn session(
    State(state): State<ApiState>,
    Extension(identity): Extension<Option<Identity>>,
) -> Json<SessionBody> {
    Json(SessionBody::new(&state.gate, identity.as_ref()))
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct SignIn {
    token: String,
}

/// `POST /v1/session`: a cookie for a token.
pub(super) async fn sign_in(
    State(state): State<ApiState>,
    headers: HeaderMap,
    JsonBody(SignIn { token }): JsonBody<SignIn>,
) -> Result<Response, Problem> {
    if !same_origin(&headers) {
        return Err(Problem::forbidden_origin("sign in from a page of this service"));
    }
    let Some((session, identity)) = state.gate.sign_in(token.trim()) else {
        return Err(Problem::unauthenticated("the token is not known; `gakp token create` makes one"));
    };
    let cookie = set_cookie(&state, session.reveal(), SESSION_LIFE.as_secs());
    let body = Json(SessionBody::new(&state.gate, Some(&identity)));
    Ok(([(header::SET_COOKIE, cookie)], body).into_response())
}

/// `DELETE /v1/session`: the cookie's session ends.
pub(super) async fn sign_out(State(state): State<ApiState>, headers: HeaderMap) -> Result<Response, Problem> {
    if !same_origin(&headers) {
        return Err(Problem::forbidden_origin("sign out from a page of this service"));
    }
    if let Some(session) = cookie(&headers) {
        state.gate.sign_out(session);
    }
    Ok((StatusCode::NO_CONTENT, [(header::SET_COOKIE, set_cookie(&state, "", 0))]).into_response())
}

fn set_cookie(state: &ApiState, value: &str, seconds: u64) -> HeaderValue {
    let secure = if state.secure { "; Secure" } else { "" };
    let text = format!("{COOKIE}={value}; Path=/; HttpOnly; SameSite=Strict; Max-Age={seconds}{secure}");
    // Hexadecimal digits and the words above are always a header.
    HeaderValue::from_str(&text).unwrap_or_else(|_| HeaderValue::from_static(""))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_of_others_are_no_address() {
        for (host, expected) in [
            ("127.0.0.1:8080", true),
            ("localhost:8080", true),
            ("LOCALHOST", true),
            ("[::1]:8080", true),
            ("10.0.0.7", true),
            ("rebind.example:8080", false),
            ("localhost.example", false),
            ("127.0.0.1.example", false),
            ("", false),
        ] {
            let mut headers = HeaderMap::new();
            headers.insert(header::HOST, host.parse().unwrap());
            assert_eq!(by_address(&headers), expected, "{host}");
        }
    }

    #[test]
    fn what_is_not_in_the_table_asks_for_an_admin() {
        assert_eq!(right(&Method::PATCH, "/v1/cameras"), Right::Role(Role::Admin));
        assert_eq!(right(&Method::GET, "/v1/new"), Right::Role(Role::Admin));
        assert_eq!(right(&Method::HEAD, "/v1/cameras"), VIEW);
        assert_eq!(right(&Method::GET, "/page/app.js"), Right::Nobody);
    }
}
