//! What a process holds: memory, threads, descriptors.

use std::fs;

/// Of one moment.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Vitals {
    /// Resident memory, MB.
    pub resident: f64,
    pub threads: usize,
    pub descriptors: usize,
}

impl Vitals {
    pub fn of(process: u32) -> Self {
        let folder = format!("/proc/{process}");
        let count = |what: &str| fs::read_dir(format!("{folder}/{what}")).expect("a process").count();
        let status = fs::read_to_string(format!("{folder}/status")).expect("a process");
        let resident = status.lines().find_map(|line| line.strip_prefix("VmRSS:"));
        let kilobytes = resident.and_then(|line| line.split_whitespace().next()?.parse::<f64>().ok());
        let resident = kilobytes.expect("VmRSS in kB") * 1024e-6;
        Self { resident, threads: count("task"), descriptors: count("fd") }
    }
}

/// Least squares of (x, y), in y an x, and the standard error of it.
#[allow(dead_code, reason = "not every user looks at slopes")]
pub fn slope(looks: &[(f64, f64)]) -> (f64, f64) {
    let n = looks.len() as f64;
    let mean = |of: &dyn Fn(&(f64, f64)) -> f64| looks.iter().map(of).sum::<f64>() / n;
    let (x, y) = (mean(&|look| look.0), mean(&|look| look.1));
    let variance = mean(&|look| (look.0 - x).powi(2));
    let slope = mean(&|look| (look.0 - x) * (look.1 - y)) / variance;
    let rest = mean(&|look| (look.1 - y - slope * (look.0 - x)).powi(2));
    (slope, (rest / (n - 2.0) / variance).sqrt())
}
