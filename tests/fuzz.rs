//! The fuzz targets (`fuzz/`) with every compiler: what people write, mutated without a look at the coverage.
//!
//! `GAKP_FUZZ=N` tries N times as many inputs; `fuzz/run.sh` searches for longer and better.
#![cfg(all(feature = "infer", feature = "ingest", feature = "service"))]

#[path = "../fuzz/src/lib.rs"]
mod fuzz;

use std::panic::{self, AssertUnwindSafe};
use std::sync::atomic::{AtomicUsize, Ordering};

use fastrand::Rng;

/// Mutations of each seed.
const EACH: usize = 20;
/// Panics anywhere, in the server's threads too.
static PANICS: AtomicUsize = AtomicUsize::new(0);

/// A few changes at once: a bit, a byte, a cut, a repetition, a piece of another seed, a number that is at a limit.
fn mutate(rng: &mut Rng, seeds: &[Vec<u8>], data: &mut Vec<u8>) {
    const NUMBERS: [&str; 10] = [
        "-1",
        "0",
        "NaN",
        "inf",
        "1e999",
        "4294967296",
        "18446744073709551616",
        "\"",
        "\u{e9}\u{1f600}",
        "[[",
    ];
    for _ in 0..rng.usize(1..5) {
        let at = rng.usize(..=data.len());
        let rest = data.len() - at;
        match rng.u8(..6) {
            0 if rest > 0 => data[at] ^= 1 << rng.u8(..8),
            1 => data.insert(at, rng.u8(..)),
            2 => drop(data.drain(at..at + rng.usize(..=rest.min(16)))),
            3 => data.extend_from_within(at..at + rng.usize(..=rest.min(64))),
            4 => {
                let other = rng.choice(seeds).expect("there are seeds");
                let from = rng.usize(..=other.len());
                let piece = other[from..].iter().copied().take(rng.usize(1..64));
                drop(data.splice(at..at, piece.collect::<Vec<_>>()));
            }
            _ => {
                let number = rng.choice(NUMBERS).expect("there are numbers");
                drop(data.splice(at..at + rng.usize(..=rest.min(4)), number.bytes()));
            }
        }
    }
}

#[test]
fn no_input_makes_anything_panic() {
    let times =
        std::env::var("GAKP_FUZZ").ok().map_or(1, |times| times.parse().expect("GAKP_FUZZ is a number"));
    let hook = panic::take_hook();
    panic::set_hook(Box::new(move |info| {
        PANICS.fetch_add(1, Ordering::Relaxed);
        hook(info);
    }));
    for (name, _) in fuzz::TARGETS {
        let seeds = fuzz::seeds::of(name);
        let mut rng = Rng::with_seed(5);
        let mut tried = 0;
        for seed in &seeds {
            for mutation in 0..=EACH * times {
                let mut data = seed.clone();
                if mutation > 0 {
                    mutate(&mut rng, &seeds, &mut data);
                }
                let ran = panic::catch_unwind(AssertUnwindSafe(|| fuzz::target(name, &data)));
                tried += 1;
                let panics = PANICS.load(Ordering::Relaxed);
                assert!(
                    ran.is_ok() && panics == 0,
                    "{name}: {panics} panics at {:?}",
                    data.escape_ascii().to_string()
                );
            }
        }
        println!("{name}: {tried} inputs");
    }
}
