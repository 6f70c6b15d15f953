//! Runs the kernels: with a clock by default, with exact counts for an instruction counter on `--count`.

use std::fmt::Write as _;
use std::hint::black_box;
use std::time::{Duration, Instant};

/// How long a kernel is measured, and how often its inputs are gone through at most.
const MEASURE: Duration = Duration::from_millis(600);
const MAX_PASSES: usize = 40;
/// Passes at least; the first of them is to get used to the inputs.
const MIN_PASSES: usize = 4;

/// A run over all kernels, or over those whose name contains `filter`.
pub(crate) struct Suite {
    filter: String,
    counting: bool,
    // Quietest time of reading the clock, us.
    clock: f64,
    // Mean of the first kernel, us.
    unit: Option<f64>,
}

impl Suite {
    /// From the command line: `[--count] [FILTER]`. Prints the head of the table.
    pub(crate) fn from_args() -> Self {
        // Cargo adds `--bench`.
        let arguments: Vec<String> = std::env::args().skip(1).filter(|argument| argument != "--bench").collect();
        let counting = arguments.iter().any(|argument| argument == "--count");
        let filter = arguments.into_iter().find(|argument| !argument.starts_with("--")).unwrap_or_default();
        let clock = (0..1000).map(|_| Instant::now().elapsed().as_nanos()).min().unwrap_or(0) as f64 * 1e-3;
        if !counting {
            println!("| kernel | inputs | p50 us | p99 us | max us | mean us | in FK + Jacobian |");
            println!("|---|--:|--:|--:|--:|--:|--:|");
        }
        Self { filter, counting, clock, unit: None }
    }

    /// Measures `step` on each of `inputs`, in their order, again and again: a step that remembers the one before sees
    /// one long motion.
    ///
    /// Of every input the quietest of its times counts, less that of reading the clock. So the quantiles are over the
    /// inputs, and what else the machine did is not in them. The first kernel is the unit of the last column.
    pub(crate) fn run<T>(&mut self, name: &str, inputs: &[T], mut step: impl FnMut(&T)) {
        let is_unit = self.unit.is_none();
        if inputs.is_empty() || !(name.contains(&self.filter) || is_unit) {
            return;
        }
        if self.counting {
            self.unit = Some(0.0);
            inputs.iter().for_each(&mut step);
            counted(inputs, step);
            println!("{name}\t{}", inputs.len());
            return;
        }
        let mut quietest = vec![f64::INFINITY; inputs.len()];
        let start = Instant::now();
        for pass in 0..MAX_PASSES {
            for (time, input) in quietest.iter_mut().zip(inputs) {
                let start = Instant::now();
                step(black_box(input));
                let elapsed = start.elapsed().as_nanos() as f64 * 1e-3 - self.clock;
                *time = if pass == 0 { *time } else { time.min(elapsed.max(0.0)) };
            }
            if pass + 1 >= MIN_PASSES && start.elapsed() > MEASURE {
                break;
            }
        }
        quietest.sort_unstable_by(f64::total_cmp);
        let mean = quietest.iter().sum::<f64>() / quietest.len() as f64;
        let unit = *self.unit.get_or_insert(mean);
        let mut line = format!("| {name} | {}", inputs.len());
        for p in [0.5, 0.99, 1.0] {
            let _ = write!(line, " | {:.2}", quietest[((quietest.len() - 1) as f64 * p) as usize]);
        }
        println!("{line} | {mean:.2} | {:.1} |", mean / unit);
    }
}

/// The one function that an instruction counter is to look into: once through `inputs`.
#[inline(never)]
fn counted<T>(inputs: &[T], step: impl FnMut(&T)) {
    black_box(inputs).iter().for_each(step);
}
