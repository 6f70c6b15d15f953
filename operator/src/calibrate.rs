//! `operator calibrate`: measures a person's hand, tunes the mapping for it, and saves both.

use std::path::Path;
use std::time::{Duration, Instant};

use anyhow::{Context as _, anyhow};
use teleop_common::key::Keys;
use teleop_common::master::{Calibration, Calibrator, SideVerdict};
use teleop_common::recording::FrameData;

use crate::cli::CalibrateArgs;
use crate::failure::{Failure, OrFail as _, listening_session};
use crate::shutdown::Shutdown;
use crate::source::{Poll, RecordingFile, Source, SourceSpec, ZenohSource};
use crate::terminal::say;

/// How long a live hand is measured if nothing is said.
const LIVE: Duration = Duration::from_secs(5);
/// Longest wait for the first live keypoints.
const PATIENCE: Duration = Duration::from_secs(30);

/// Runs the command.
///
/// # Errors
/// [`Failure`]
pub fn calibrate(args: &CalibrateArgs, shutdown: &Shutdown) -> Result<(), Failure> {
    let calibrator = match args.source.parse::<SourceSpec>().or_usage()? {
        SourceSpec::File(path) => RecordingFile::scan_first(&path, args.seconds).or_usage()?.calibrator,
        SourceSpec::Zenoh => live(args, shutdown)?,
        SourceSpec::Gesture(gesture) => {
            let error = anyhow!("gesture {gesture} has no keypoints to measure; give FILE.csv, FILE.jsonl or zenoh");
            return Err(Failure::Usage(error));
        }
    };
    let mut calibration =
        calibrator.finish().with_context(|| format!("cannot calibrate from {:?}", args.source)).or_runtime()?;
    let tuned = args.robot_hand.tune(&mut calibration);
    save(&calibration, &args.output).or_runtime()?;
    for line in calibration.report().into_iter().chain(tuned) {
        say(&line).ok();
    }
    say(&format!("saved to {}", args.output.display())).ok();
    Ok(())
}

/// Writes beside the file and renames, so that there is never half a calibration.
fn save(calibration: &Calibration, path: &Path) -> anyhow::Result<()> {
    let context = || format!("cannot save the calibration to {}", path.display());
    let name = path.file_name().ok_or_else(|| anyhow!("it has no file name")).with_context(context)?;
    let mut beside = name.to_owned();
    beside.push(".new");
    let beside = path.with_file_name(beside);
    std::fs::write(&beside, calibration.to_text()).with_context(context)?;
    std::fs::rename(&beside, path).with_context(context)
}

/// Reads a calibration file.
///
/// # Errors
/// Names the file and what is wrong.
pub(crate) fn load(path: &Path) -> anyhow::Result<Calibration> {
    let text =
        std::fs::read_to_string(path).with_context(|| format!("cannot read the calibration {}", path.display()))?;
    Calibration::from_text(&text).with_context(|| format!("cannot use the calibration {}", path.display()))
}

fn live(args: &CalibrateArgs, shutdown: &Shutdown) -> Result<Calibrator, Failure> {
    let keys = Keys::new(&args.name).or_usage()?;
    let session = listening_session(&args.listen)?;
    let mut source = Source::Zenoh(ZenohSource::subscribe(&session, &keys).or_runtime()?);
    let time = args.seconds.map_or(LIVE, Duration::from_secs_f64);
    say(&format!("waiting for keypoints on {} at {}", keys.hand_input(), args.listen.join(", "))).ok();
    let mut calibrator = Calibrator::default();
    let began = Instant::now();
    let mut first = None;
    let mut told = 0;
    loop {
        match source.poll(began.elapsed()).or_runtime()? {
            Poll::Frame(frame) => match &frame.hand {
                FrameData::Keypoints(keypoints) => {
                    calibrator.push(keypoints);
                    if first.is_none() {
                        say(&format!("open and close the hand for {:.0} s", time.as_secs_f64())).ok();
                    }
                    let since = first.get_or_insert_with(Instant::now).elapsed();
                    if since >= time {
                        return Ok(calibrator);
                    }
                    if since.as_secs() > told {
                        told = since.as_secs();
                        let side = match calibrator.inspector().side() {
                            SideVerdict::Hand(side) => side.name(),
                            SideVerdict::Undecided => "?",
                        };
                        say(&format!("calibrating {:.0} %, hand: {side}", 100.0 * since.div_duration_f64(time))).ok();
                    }
                }
                FrameData::Joints(_) => {
                    let error = anyhow!("joint angles arrive on {}; calibration needs keypoints", keys.hand_input());
                    return Err(Failure::Runtime(error));
                }
            },
            _ => {
                let _came = source.wait(Duration::from_millis(50));
            }
        }
        let silent = first.is_none() && began.elapsed() > PATIENCE;
        let stalled = first.is_some_and(|first: Instant| first.elapsed() > time + Duration::from_secs(2));
        if silent || stalled {
            let seen = calibrator.frames();
            let error = anyhow!("only {seen} keypoint frames arrived on {}: is the sender running?", keys.hand_input());
            return Err(Failure::Runtime(error));
        }
        if shutdown.requested() {
            return Err(Failure::Runtime(anyhow!("stopped before the calibration was done; nothing saved")));
        }
    }
}
