//! Times a function once per input and prints quantiles: a real-time step is judged by its tail, not by its mean.

use std::time::Instant;

/// Runs `step` on each of `inputs`, a thousand more before to warm up, and prints a line.
pub(crate) fn report<T>(name: &str, inputs: &[T], mut step: impl FnMut(&T)) {
    for input in inputs.iter().cycle().take(1000) {
        step(std::hint::black_box(input));
    }
    let mut times: Vec<u128> = inputs
        .iter()
        .map(|input| {
            let start = Instant::now();
            step(std::hint::black_box(input));
            start.elapsed().as_nanos()
        })
        .collect();
    times.sort_unstable();
    let at = |p: f64| times[((times.len() - 1) as f64 * p) as usize] as f64 * 1e-3;
    println!("{name:<32} p50 {:>8.2} us   p99 {:>8.2} us   max {:>8.1} us", at(0.5), at(0.99), at(1.0));
}
