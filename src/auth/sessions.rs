//! Who has signed in at the page: cookies that live in memory and end.

use std::time::{Duration, Instant};

use super::{ByName, random_text, sha256};

/// How long a session lasts from its last use.
pub const SESSION_LIFE: Duration = Duration::from_secs(12 * 3600);
/// Sessions at a time; the one that was not used for longest goes first.
const MOST: usize = 1024;

/// What the cookie holds.
pub struct SessionId(String);

impl SessionId {
    /// The cookie's value.
    pub fn reveal(&self) -> &str {
        &self.0
    }
}

/// Sessions by the hash of their id: a dump of memory opens none that is looked up later.
#[derive(Default)]
pub(super) struct Sessions(ByName<Session>);

struct Session {
    /// The token that it was begun with.
    name: String,
    used: Instant,
}

impl Sessions {
    pub fn begin(&mut self, name: String) -> SessionId {
        self.0.retain(|_, session| session.used.elapsed() < SESSION_LIFE);
        if self.0.len() >= MOST
            && let Some(oldest) = self.0.iter().min_by_key(|(_, s)| s.used).map(|(id, _)| id.clone())
        {
            self.0.remove(&oldest);
        }
        let id = random_text();
        self.0.insert(sha256(&id), Session { name, used: Instant::now() });
        SessionId(id)
    }

    /// The name of the token that a session was begun with.
    pub fn name(&mut self, id: &str) -> Option<String> {
        let session = self.0.get_mut(&sha256(id)).filter(|s| s.used.elapsed() < SESSION_LIFE)?;
        session.used = Instant::now();
        Some(session.name.clone())
    }

    pub fn end(&mut self, id: &str) {
        self.0.remove(&sha256(id));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sessions_begin_and_end_and_do_not_pile_up() {
        let mut sessions = Sessions::default();
        let first = sessions.begin("desk".into());
        assert_eq!(sessions.name(first.reveal()).as_deref(), Some("desk"));
        assert_eq!(sessions.name("x"), None);
        let second = sessions.begin("desk".into());
        sessions.end(first.reveal());
        assert_eq!(sessions.name(first.reveal()), None);
        for _ in 0..MOST {
            sessions.begin("other".into());
        }
        assert_eq!(sessions.0.len(), MOST);
        assert_eq!(sessions.name(second.reveal()), None, "the oldest went");
    }
}
