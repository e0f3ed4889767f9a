#![no_main]
libfuzzer_sys::fuzz_target!(
    init: {
        // As every Rust program does whose `main` is its own: a client that hangs up is an error, not the end.
        // SAFETY: there is one thread yet.
        unsafe { libc::signal(libc::SIGPIPE, libc::SIG_IGN) };
    },
    |data: &[u8]| gakp_fuzz::target("api", data)
);
