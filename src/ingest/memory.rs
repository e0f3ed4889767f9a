//! The C library's allocator, held to what is in use.
//!
//! Every connection of a camera starts a dozen short-lived threads of GStreamer's. glibc spreads their allocations over
//! eight arenas a core, and what one of them frees no other takes: memory would go up for hours on reconnections although
//! nothing is held. Other C libraries have one heap and need none of this.

use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

/// Giving back walks the whole heap, a few milliseconds.
const EVERY: Duration = Duration::from_secs(10);

/// An arena a core from now on, for programs with many short-lived threads. To be called before there are any.
pub fn arena_a_core() {
    #[cfg(target_env = "gnu")]
    {
        let cores = std::thread::available_parallelism().map_or(2, |n| n.get().clamp(2, 64));
        // SAFETY: a setting; it takes any number.
        unsafe { libc::mallopt(libc::M_ARENA_MAX, cores as libc::c_int) };
    }
}

/// Gives free pages back to the system, after a connection is closed. Returns at once when somebody else is about to, and
/// else waits until the last time was a while ago.
pub(crate) fn give_back() {
    /// The last time, and whether somebody waits for the next.
    static STATE: Mutex<(Option<Instant>, bool)> = Mutex::new((None, false));
    let state = || STATE.lock().unwrap_or_else(PoisonError::into_inner);
    let last = {
        let (last, waits) = &mut *state();
        if std::mem::replace(waits, true) {
            return;
        }
        *last
    };
    std::thread::sleep(last.map_or(Duration::ZERO, |last| EVERY.saturating_sub(last.elapsed())));
    let start = Instant::now();
    *state() = (Some(start), false);
    #[cfg(target_env = "gnu")]
    // SAFETY: takes no memory that is in use.
    unsafe {
        libc::malloc_trim(0);
    }
    tracing::debug!(took = ?start.elapsed(), "gave free memory back");
}
