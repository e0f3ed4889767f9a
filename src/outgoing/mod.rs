//! Ways out to receivers: addresses, how far they may lead, TLS, posts, and how much is said of their troubles.

mod endpoint;
mod post;
mod reach;
mod secret;
mod sparing;

pub(crate) use endpoint::{Address, HTTP, KNOCK, Login, Scheme, trust};
pub(crate) use post::Poster;
pub(crate) use reach::Reach;
pub use secret::Secret;
pub(crate) use secret::{reveal, reveal_some};
pub(crate) use sparing::{Sparing, backoff};
