//! The paper's tables and figures from this program's own mapping: `robot paper`.
//!
//! | module | one line |
//! |---|---|
//! | `live` | a gesture through the control loop in virtual time |
//! | `data` | JSON and CSV |
//! | `plot` | curves, clouds and bars as SVG |
//! | `hands` | pictures of both hands |
//! | `figures` | which plots there are and what is in them |
//! | `page` | one page with everything |

mod data;
mod figures;
mod hands;
mod live;
mod page;
mod plot;

use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::Context as _;
use indicatif::{ProgressBar, ProgressStyle};
use teleop_common::hand::HandModel;
use teleop_common::mapping::MappingParams;
use teleop_common::master::{FINGER_TAPS, Gesture};
use teleop_common::paper::fig2::{self, Loss};
use teleop_common::paper::fig6::{self, Tap};
use teleop_common::paper::motion::{self, Sample};
use teleop_common::paper::smoothness::{self, Smoothness};
use teleop_common::paper::{Check, fig8};
use teleop_common::viz::{PaperCloud, PaperRun, save_paper};

use crate::cli::PaperArgs;
use crate::config::{Config, ConfigError, Overrides};
use crate::control::ControlParams;
use crate::usage::UsageError;

/// Samples per second of the smoothness report.
const RATE: f64 = 100.0;
/// Where smoothness is measured: of the mapping, and of the commands of the control loop.
const STAGES: [&str; 2] = ["before", "after"];
/// The tripods on the time line of Fig. 8.
const TRIPODS: [Gesture; 2] = [Gesture::TripodFig8, Gesture::TripodCloseFig8];

/// Everything that was computed.
struct Paper {
    hand: HandModel,
    losses: Vec<Vec<Loss>>,
    presets: Vec<Preset>,
}

/// What one set of parameters gives.
struct Preset {
    name: String,
    params: MappingParams,
    /// Per gesture, under joint, Cartesian and combined mapping.
    taps: Vec<[Tap; 3]>,
    /// The checks of the taps of Fig. 6.
    tap_checks: Vec<(Gesture, Vec<Check>)>,
    fig8: Vec<Run>,
    /// Per gesture, the [`STAGES`].
    smoothness: Vec<(Gesture, [Smoothness; 2])>,
}

impl Preset {
    fn fig8_checks(&self) -> impl Iterator<Item = (Gesture, &[Check])> {
        self.fig8.iter().map(|run| (run.gesture, run.checks.as_slice()))
    }

    fn tap_checks(&self) -> impl Iterator<Item = (Gesture, &[Check])> {
        self.tap_checks.iter().map(|(gesture, checks)| (*gesture, checks.as_slice()))
    }
}

/// The tripod of Fig. 7 and 8.
struct Run {
    gesture: Gesture,
    samples: Vec<Sample>,
    checks: Vec<Check>,
}

/// Computes everything and writes it into a folder.
///
/// # Errors
/// A preset that does not exist, or a folder or file that cannot be written.
pub fn run(args: &PaperArgs) -> anyhow::Result<()> {
    let started = Instant::now();
    let mut names: Vec<String> = Vec::new();
    for name in &args.preset {
        if !names.contains(name) {
            names.push(name.clone());
        }
    }
    let mut configs = Vec::new();
    for name in names {
        let overrides = Overrides { preset: Some(name.clone()), ..Overrides::default() };
        configs.push((name, Config::load(None, &overrides)?));
    }
    let out = Folder::create(&args.out)?;
    let steps = 4 + configs.len() as u64 * (2 * FINGER_TAPS.len() + TRIPODS.len()) as u64;
    let bar = progress(steps);

    bar.set_message("Fig. 2");
    let losses = fig2::POSTURES_DEG.iter().map(|q| fig2::losses(&q.map(f64::to_radians))).collect();
    bar.inc(1);
    let mut presets = Vec::new();
    let mut hand = None;
    for (name, config) in configs {
        let model = args.source().load(&config)?;
        presets.push(preset(&model, name, config.mapping, config.control, &bar)?);
        hand = Some(model);
    }
    let hand = hand.ok_or_else(|| UsageError("--preset needs a name: paper or default".to_owned()))?;
    let paper = Paper { hand, losses, presets };

    bar.set_message("numbers");
    write_numbers(&out, &paper)?;
    bar.inc(1);
    bar.set_message("figures");
    let figures = figures::all(&paper)?;
    for figure in &figures {
        out.write(&figure.file, &figure.svg)?;
    }
    out.write("index.html", &page::page(&paper, &figures))?;
    bar.inc(1);
    bar.set_message("recording");
    write_recording(&out.path("paper.rrd"), &paper)?;
    bar.finish_and_clear();

    let broken = broken(&paper);
    for check in &broken {
        tracing::warn!("does not hold: {check}");
    }
    tracing::info!(
        "the paper's tables and figures in {:.1} s: open {} in a browser, {} in Rerun",
        started.elapsed().as_secs_f64(),
        out.path("index.html").display(),
        out.path("paper.rrd").display()
    );
    Ok(())
}

fn preset(
    hand: &HandModel,
    name: String,
    params: MappingParams,
    control: ControlParams,
    bar: &ProgressBar,
) -> Result<Preset, ConfigError> {
    let (mut taps, mut tap_checks, mut smoothness) = (Vec::new(), Vec::new(), Vec::new());
    for gesture in FINGER_TAPS {
        bar.set_message(format!("{name}: {gesture}"));
        let [joint, cartesian, combined] = fig6::MODES.map(|mode| fig6::tap(hand, &params, gesture, mode));
        let runs = [joint?, cartesian?, combined?];
        if fig6::TAPS.contains(&gesture) {
            tap_checks.push((gesture, fig6::checks(hand, &runs)));
        }
        taps.push(runs);
        bar.inc(1);
        let mapped: Vec<_> = motion::run(hand, &params, gesture, RATE)?.iter().map(|sample| sample.output.q).collect();
        let commanded = live::commands(hand, &params, control, gesture, RATE)?;
        smoothness.push((gesture, [mapped, commanded].map(|samples| smoothness::measure(&samples, 1.0 / RATE))));
        bar.inc(1);
    }
    let mut fig8 = Vec::new();
    for gesture in TRIPODS {
        bar.set_message(format!("{name}: {gesture}"));
        let samples = fig8::signals(hand, &params, gesture)?;
        let checks = fig8::checks(hand, &params, &samples)?;
        fig8.push(Run { gesture, samples, checks });
        bar.inc(1);
    }
    Ok(Preset { name, params, taps, tap_checks, fig8, smoothness })
}

/// `fig8_paper` and `fig8_paper_close`, the stem of the file names of a tripod.
fn stem(figure: &str, preset: &Preset, gesture: Gesture) -> String {
    let close = if gesture == Gesture::TripodCloseFig8 { "_close" } else { "" };
    format!("{figure}_{}{close}", preset.name)
}

fn write_numbers(out: &Folder, paper: &Paper) -> anyhow::Result<()> {
    out.write_json("table1.json", &data::table1(&paper.hand))?;
    out.write_json("fig2.json", &data::fig2(&paper.losses))?;
    out.write("fig2.csv", &data::fig2_csv(&paper.losses))?;
    out.write("fig4.csv", &data::fig4_csv(&paper.presets))?;
    out.write_json("fig6.json", &data::fig6(&paper.presets))?;
    out.write("fig6.csv", &data::fig6_csv(&paper.presets))?;
    for preset in &paper.presets {
        for run in &preset.fig8 {
            let file = format!("{}.csv", stem("fig8", preset, run.gesture));
            out.write(&file, &data::fig8_csv(&paper.hand, &run.samples))?;
        }
    }
    out.write_json("smoothness.json", &data::smoothness(&paper.presets))?;
    out.write("smoothness.csv", &data::smoothness_csv(&paper.presets))?;
    out.write_json("summary.json", &data::summary(paper))
}

fn write_recording(path: &Path, paper: &Paper) -> anyhow::Result<()> {
    let mut clouds = Vec::new();
    for (number, losses) in paper.losses.iter().enumerate() {
        for (object, key, value) in data::FIG2 {
            let points = losses.iter().map(|loss| (loss.lengths, value(loss))).collect();
            clouds.push(PaperCloud { name: format!("{object}_{key}_posture_{}", number + 1), points });
        }
    }
    let runs = paper.presets.iter().flat_map(|preset| {
        preset.fig8.iter().map(|run| PaperRun { name: stem("fig8", preset, run.gesture), samples: &run.samples })
    });
    Ok(save_paper(path, &paper.hand, &clouds, &runs.collect::<Vec<_>>())?)
}

/// The statements that turned out false.
fn broken(paper: &Paper) -> Vec<String> {
    let mut out = Vec::new();
    for preset in &paper.presets {
        for (gesture, checks) in preset.fig8_checks().chain(preset.tap_checks()) {
            let broken = checks.iter().filter(|check| check.holds == Some(false));
            out.extend(broken.map(|check| format!("{} {gesture} {}: {}", preset.name, check.name, check.statement)));
        }
    }
    out
}

/// The folder written to.
struct Folder(PathBuf);

impl Folder {
    fn create(path: &Path) -> anyhow::Result<Self> {
        std::fs::create_dir_all(path)
            .map_err(|error| UsageError(format!("--out {}: the folder cannot be made: {error}", path.display())))?;
        Ok(Self(path.to_owned()))
    }

    fn path(&self, file: &str) -> PathBuf {
        self.0.join(file)
    }

    fn write(&self, file: &str, text: &str) -> anyhow::Result<()> {
        let path = self.path(file);
        std::fs::write(&path, text).with_context(|| format!("cannot write {}", path.display()))
    }

    fn write_json(&self, file: &str, value: &serde_json::Value) -> anyhow::Result<()> {
        self.write(file, &format!("{value:#}\n"))
    }
}

/// A bar over the steps; nothing where nobody would see it.
fn progress(steps: u64) -> ProgressBar {
    let bar = ProgressBar::new(steps);
    if let Ok(style) = ProgressStyle::with_template("paper {wide_bar} {pos}/{len} {msg}") {
        bar.set_style(style);
    }
    bar
}
