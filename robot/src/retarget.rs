//! Offline mapping of recordings and whole data sets: `robot retarget`.

mod batch;
mod frames;
mod output;

use std::fs::File;
use std::io::{BufReader, BufWriter, Write as _};
use std::path::Path;
use std::time::{Duration, Instant};

use anyhow::Context as _;
use indicatif::{ProgressBar, ProgressStyle};
use teleop_common::authority::{Clutch, Latch};
use teleop_common::hand::{HandModel, JointVector, TipFrame};
use teleop_common::mapping::{FingerSignals, MappingOutput, Retargeter};
use teleop_common::master::MasterPose;
use teleop_common::quality::{Quality, Sample};
use teleop_common::time::MonoTime;

use self::batch::Job;
use self::frames::{Frames, HandFrame};
use self::output::{Partial, Row};
use crate::cli::{RetargetArgs, Switch};
use crate::config::{Config, ConfigError};
use crate::control::{ControlParams, Controller, PoseSample};
use crate::driver::JointState;
use crate::usage::UsageError;

/// After this long without a frame the hand stands still, whatever it did before.
const SETTLED: Duration = Duration::from_secs(3);

/// Frames that are read, then mapped, then written at a time: each of the three finds its code and data in the caches.
const BLOCK: usize = 64;

/// Maps recordings, frame by frame, as many at a time as there are threads.
///
/// # Errors
/// Input that cannot be used (with its line), or a file that cannot be written. The output file then does not appear.
/// Of several recordings the others are still mapped.
pub fn run(args: &RetargetArgs) -> anyhow::Result<()> {
    let config = Config::load(args.hand.config.as_deref(), &args.hand.overrides())?;
    let hand = args.hand.source().load(&config)?;
    // Wrong parameters are told before anything is read.
    Retargeter::new(hand.clone(), config.mapping.clone()).map_err(ConfigError::from)?;
    let jobs = batch::jobs(&args.input, &args.output)?;
    if args.quality.is_some() && jobs.len() > 1 {
        let text = format!("--quality measures one recording; --input names {}", jobs.len());
        return Err(UsageError(text).into());
    }
    let cores = || std::thread::available_parallelism().map_or(1, std::num::NonZero::get);
    let threads = args.threads.unwrap_or_else(cores).min(jobs.len());
    let started = Instant::now();
    let bar = progress(&jobs);
    let results = batch::each(&jobs, threads, |job| {
        let result = one(job, args, &config, &hand, &bar);
        if let (Err(error), true) = (&result, jobs.len() > 1) {
            tracing::error!("{}: {error:#}", job.input.display());
        }
        result
    });
    bar.finish_and_clear();
    let elapsed = started.elapsed().as_secs_f64();
    let mut stats = Stats::default();
    let (mut failed, mut first) = (0, None);
    for result in results {
        match result {
            Ok(own) => stats.steps.extend(own.steps),
            Err(error) => {
                failed += 1;
                first.get_or_insert(error);
            }
        }
    }
    match first {
        Some(error) if jobs.len() == 1 => return Err(error),
        Some(error) => return Err(error.context(format!("{failed} of {} recordings failed", jobs.len()))),
        None => {}
    }
    tracing::info!(
        "{} frames to {} in {elapsed:.2} s, {:.0} frames/s on {threads} thread{}; mapping {} per frame (median)",
        stats.steps.len(),
        args.output.display(),
        stats.steps.len() as f64 / elapsed,
        if threads == 1 { "" } else { "s" },
        stats.quantile(0.5).map_or_else(|| "none".to_owned(), |us| format!("{us:.1} us")),
    );
    if let Some(path) = &args.stats {
        write_json(path, &stats.summary(threads, elapsed))?;
    }
    Ok(())
}

/// Maps one recording.
fn one(job: &Job, args: &RetargetArgs, config: &Config, hand: &HandModel, bar: &ProgressBar) -> anyhow::Result<Stats> {
    let mut retargeter = Retargeter::new(hand.clone(), config.mapping.clone()).map_err(ConfigError::from)?;
    let mut live = match args.conditioning {
        Switch::On => Some(Live::new(hand, config)?),
        Switch::Off => None,
    };
    let filtered = args.filter == Switch::On;
    let frames = Frames::open(&job.input, args.calibration.as_deref(), hand, &config.mapping, filtered)?;
    let mut output = Partial::create(&job.output)?;
    let mut samples = args.quality.is_some().then(Vec::new);
    let mut stats = Stats::default();

    // Writes a frame's row; with conditioning, after the live loop ran until `next`.
    let mut finish = |frame: &HandFrame, mut mapping: MappingOutput, next: f64| {
        if let Some(live) = &mut live {
            mapping = live.run(frame.t, &frame.pose, next, hand, &mapping);
        }
        if let Some(samples) = &mut samples {
            samples.push(Sample::new(hand, frame.t, frame.human, &mapping));
        }
        output.write(&Row::new(frame.t, &frame.pose, &mapping))
    };
    // One frame behind: what the live robot commands for a frame is known when the next one comes.
    let mut waiting: Option<(HandFrame, MappingOutput)> = None;
    let (mut period, mut done) = (0.0, 0);
    let mut frames = frames.fuse();
    let (mut block, mut mapped) = (Vec::with_capacity(BLOCK), Vec::with_capacity(BLOCK));
    loop {
        for frame in frames.by_ref().take(BLOCK) {
            block.push(frame?);
        }
        if block.is_empty() {
            break;
        }
        for frame in &block {
            let begun = Instant::now();
            let mapping = retargeter.map(&frame.pose);
            stats.record(begun.elapsed());
            mapped.push(mapping);
        }
        for (frame, mapping) in block.drain(..).zip(mapped.drain(..)) {
            let (t, read) = (frame.t, frame.read);
            if let Some((before, mapping)) = waiting.replace((frame, mapping)) {
                finish(&before, mapping, t)?;
                period = t - before.t;
            }
            bar.inc(read - done);
            done = read;
        }
    }
    if let Some((last, mapping)) = waiting {
        finish(&last, mapping, last.t + period)?;
    }
    output.complete()?;
    if let (Some(path), Some(samples)) = (&args.quality, samples) {
        let Some(quality) = Quality::measure(hand, &samples) else {
            let text = format!("{}: too short to measure --quality: it needs 3 frames", job.input.display());
            return Err(UsageError(text).into());
        };
        write_json(path, &quality)?;
    }
    Ok(stats)
}

/// The live robot in virtual time, with a hand that does exactly what it is told.
struct Live {
    controller: Controller,
    params: ControlParams,
    state: JointState,
    // The command before the last.
    before: JointVector,
    tick: u64,
    start: Option<f64>,
    sequence: u64,
    clutch: Clutch,
}

impl Live {
    fn new(hand: &HandModel, config: &Config) -> Result<Self, ConfigError> {
        let still = JointVector::zeros(hand.joints.len());
        Ok(Self {
            controller: Controller::new(hand.clone(), config.mapping.clone(), config.control)?,
            params: config.control,
            state: JointState { q: hand.home(), dq: still, tau: still },
            before: hand.home(),
            tick: 0,
            start: None,
            sequence: 0,
            clutch: Clutch::default(),
        })
    }

    /// The ticks from `t` (s), when `pose` arrives, to before `next`; returns `mapping` with the posture commanded
    /// until then: the way from one command to the next takes a tick, and this is where on it the hand is at `next`,
    /// so that rows differ by no more than the limits allow in the time between them.
    fn run(
        &mut self,
        t: f64,
        pose: &MasterPose,
        next: f64,
        hand: &HandModel,
        mapping: &MappingOutput,
    ) -> MappingOutput {
        let start = *self.start.get_or_insert(t);
        let at = |seconds: f64| MonoTime(((seconds - start) * 1e9).max(0.0) as u64);
        self.sequence += 1;
        // A recording wants to be followed from the first frame to the last, whatever the gaps.
        self.clutch = self.clutch.eager(self.controller.mode());
        let sample = PoseSample::instant(at(t), self.sequence, *pose, self.clutch);
        self.controller.admit(&sample);
        let end = at(next);
        loop {
            let now = MonoTime((self.tick as f64 * 1e9 / self.params.rate) as u64);
            if now >= end {
                break;
            }
            self.tick += 1;
            if now.since(sample.received) > self.params.hold_after + SETTLED {
                // The rest of a long gap changes nothing.
                self.tick = self.tick.max((end.0 as f64 * 1e-9 * self.params.rate) as u64);
                continue;
            }
            let record = self.controller.tick(now, Latch::default(), &self.state);
            self.before = self.state.q;
            self.state.q = record.command.q;
            self.state.dq = record.command.dq;
        }
        let last = MonoTime((self.tick.saturating_sub(1) as f64 * 1e9 / self.params.rate) as u64);
        let share = (end.since(last).as_secs_f64() * self.params.rate).min(1.0);
        let mut q = self.before;
        q.iter_mut().zip(self.state.q.iter()).for_each(|(value, next)| *value += (next - *value) * share);
        commanded(hand, mapping, &q)
    }
}

/// The mapping's signals with the posture that was commanded in place of the one that was mapped.
fn commanded(hand: &HandModel, mapping: &MappingOutput, q: &JointVector) -> MappingOutput {
    let mut signals = Vec::with_capacity(mapping.fingers().len());
    for (chain, mapped) in hand.fingers.iter().zip(mapping.fingers()) {
        let (own, joint) = (chain.select(q), chain.select(&mapping.q_joint));
        let p = chain.tip(&own, TipFrame::Pole);
        signals.push(FingerSignals {
            p,
            e_q: own.iter().zip(&joint).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt(),
            e_c: (mapped.p_cartesian - p).norm(),
            ..*mapped
        });
    }
    MappingOutput::new(mapping.q_joint, *q, &signals)
}

/// Durations of the mapping steps.
#[derive(Default)]
struct Stats {
    // ns
    steps: Vec<u32>,
}

impl Stats {
    fn record(&mut self, step: Duration) {
        self.steps.push(u32::try_from(step.as_nanos()).unwrap_or(u32::MAX));
    }

    /// us
    fn quantile(&self, p: f64) -> Option<f64> {
        let mut sorted = self.steps.clone();
        let last = sorted.len().checked_sub(1)?;
        let rank = ((last as f64) * p).round() as usize;
        Some(f64::from(*sorted.select_nth_unstable(rank.min(last)).1) * 1e-3)
    }

    fn summary(&self, threads: usize, elapsed: f64) -> serde_json::Value {
        serde_json::json!({
            "frames": self.steps.len(),
            "seconds": self.steps.iter().map(|&step| f64::from(step) * 1e-9).sum::<f64>(),
            "step_us": { "p50": self.quantile(0.5), "p99": self.quantile(0.99), "max": self.quantile(1.0) },
            "threads": threads,
            "elapsed_seconds": elapsed,
            "frames_per_second": self.steps.len() as f64 / elapsed,
        })
    }
}

fn write_json(path: &Path, value: &impl serde::Serialize) -> anyhow::Result<()> {
    let file = File::create(path).with_context(|| format!("cannot write {}", path.display()))?;
    let mut file = BufWriter::new(file);
    let written = serde_json::to_writer_pretty(&mut file, value).map_err(std::io::Error::from);
    written
        .and_then(|()| writeln!(file))
        .and_then(|()| file.flush())
        .with_context(|| format!("cannot write {}", path.display()))
}

/// A bar over the bytes of the inputs; nothing where nobody would see it.
fn progress(jobs: &[Job]) -> ProgressBar {
    let bytes = |job: &Job| std::fs::metadata(&job.input).map_or(0, |meta| meta.len());
    let bar = ProgressBar::new(jobs.iter().map(bytes).sum());
    if let Ok(style) =
        ProgressStyle::with_template("retarget {wide_bar} {percent:>3} % {binary_bytes_per_sec}  {eta} left")
    {
        bar.set_style(style);
    }
    bar
}

fn open(path: &Path) -> anyhow::Result<BufReader<File>> {
    let file = File::open(path).map_err(|error| UsageError(format!("cannot open {}: {error}", path.display())))?;
    Ok(BufReader::with_capacity(1 << 16, file))
}
