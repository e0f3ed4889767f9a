//! Ways out to receivers that the configuration names: addresses, TLS, posts, and how much is said of their troubles.

mod endpoint;
mod post;
mod secret;
mod sparing;

pub(crate) use endpoint::{Address, HTTP, Login, Scheme, trust};
pub(crate) use post::Poster;
pub use secret::Secret;
pub(crate) use sparing::{Sparing, backoff};
