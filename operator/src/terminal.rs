//! What people see: a status line (with a progress bar for a recording) on a terminal, a line every two seconds in a
//! log file.

use std::fmt::Write as _;
use std::io::{IsTerminal as _, Write as _};
use std::time::{Duration, Instant};

use indicatif::{MultiProgress, ProgressBar, ProgressStyle};
use teleop_common::mode::Mode;
use teleop_common::wire::WireError;

use crate::feedback::{Reason, Snapshot};
use crate::pipeline::Progress;

/// Status lines of a program that is not watched on a terminal.
const LINE_EVERY: Duration = Duration::from_secs(2);
/// A robot that is there answers within this time; only then its absence is told.
const GRACE: Duration = Duration::from_millis(600);
/// Steps of the progress bar.
const PROGRESS_STEPS: u64 = 1000;

/// What the source is doing.
#[derive(Clone, Debug, Default, PartialEq)]
pub enum Activity {
    /// Giving poses.
    #[default]
    Streaming,
    /// Measuring the hand; how far, 0 to 1.
    Calibrating(f64),
    /// Getting a hand that cannot be followed; nothing is sent.
    Refused,
    /// Waiting for something, which is named.
    Waiting(&'static str),
    /// The recording is over.
    Finished,
}

/// All that a status line tells.
#[derive(Clone, Debug)]
pub struct Status {
    /// The robot's name.
    pub name: String,
    /// Where it should be.
    pub endpoints: String,
    /// The robot as last heard.
    pub robot: Snapshot,
    /// The source thread.
    pub progress: Progress,
    /// Poses sent per second, of late.
    pub rate: f64,
    /// Frames missing in the recording that is being written.
    pub lost: u64,
}

/// The status line.
#[must_use]
pub fn status_line(status: &Status) -> String {
    let Status { name, endpoints, robot, progress, rate, lost } = status;
    let mut line = format!("robot {name}  ");
    let joints = robot.joints.as_ref().filter(|_| robot.connected);
    match (joints.and_then(|joints| joints.mode()), robot.reason) {
        (None, _) => write!(line, "not connected ({endpoints})").ok(),
        (Some(mode), None) => write!(line, "{mode}").ok(),
        (Some(mode), Some(reason)) => write!(line, "{mode}: {reason}").ok(),
    };
    let mut part = |text: String| {
        line.push_str("  |  ");
        line.push_str(&text);
    };
    match &progress.activity {
        Activity::Streaming => part(format!("{rate:.1} Hz")),
        Activity::Calibrating(done) => part(format!("calibrating {:.0} %", 100.0 * done)),
        Activity::Refused => part("not streaming".to_owned()),
        Activity::Waiting(what) => part(format!("waiting for {what}")),
        Activity::Finished => part("finished".to_owned()),
    }
    if let Some(round_trip) = robot.round_trip {
        part(format!("rtt {:.1} ms", round_trip.as_secs_f64() * 1e3));
    }
    if robot.connected
        && robot.reason != Some(Reason::OtherOperator)
        && let Some(health) = robot.health.as_ref().filter(|health| health.poses_accepted > 0)
    {
        part(format!("pose age at robot {:.1} ms (p99)", health.age_ms.p99));
    }
    if robot.connected && robot.delivery.twice() {
        part(format!("{:.0} % lost, sent twice", 100.0 * robot.delivery.lost()));
    }
    if let Some(residual) = progress.residual {
        part(format!("fit {:.1} mm", residual * 1e3));
    }
    if progress.skipped > 0 {
        part(format!("{} skipped", progress.skipped));
    }
    if progress.bad > 0 {
        part(format!("{} bad inputs", progress.bad));
    }
    match robot.first_bad {
        // Nothing else that it says can be read.
        Some(error @ WireError::Protocol { .. }) => part(format!("ERROR: {error}")),
        Some(error) => part(format!("{} bad messages, the first: {error}", robot.bad)),
        None => {}
    }
    if robot.rivals {
        part(format!("ERROR: two robots are called {name}"));
    }
    if *lost > 0 {
        part(format!("ERROR: {lost} frames missing in the recording"));
    }
    if let Some(problem) = &progress.problem {
        part(format!("ERROR: {problem}"));
    }
    line
}

/// Whether what matters to people changed, so that it should be told at once.
fn is_news(before: &Status, after: &Status) -> bool {
    let key = |status: &Status| {
        let mode: Option<Mode> = status.robot.joints.as_ref().and_then(|joints| joints.mode());
        (
            status.robot.connected,
            mode,
            std::mem::discriminant(&status.progress.activity),
            status.lost > 0,
            status.robot.rivals,
        )
    };
    key(before) != key(after)
}

/// How many times a second something was counted, of late.
#[derive(Clone, Debug, Default)]
pub struct RateMeter {
    samples: std::collections::VecDeque<(Instant, u64)>,
}

impl RateMeter {
    /// The window of the average.
    const WINDOW: Duration = Duration::from_secs(2);

    /// Takes in the count at `now` and gives the rate over the last two seconds, Hz.
    pub fn rate(&mut self, count: u64, now: Instant) -> f64 {
        while self.samples.len() > 1 && self.samples.front().is_some_and(|(at, _)| now - *at > Self::WINDOW) {
            self.samples.pop_front();
        }
        let rate = match self.samples.front() {
            Some((at, before)) if now > *at => count.saturating_sub(*before) as f64 / (now - *at).as_secs_f64(),
            _ => 0.0,
        };
        self.samples.push_back((now, count));
        rate
    }
}

/// The terminal, or the log file in its place. Clones share it.
#[derive(Clone, Debug)]
pub struct Terminal {
    bars: MultiProgress,
    interactive: bool,
}

impl Terminal {
    /// The process's terminal.
    #[must_use]
    pub fn new() -> Self {
        Self { bars: MultiProgress::new(), interactive: std::io::stderr().is_terminal() }
    }

    /// Whether somebody watches.
    #[must_use]
    pub fn interactive(&self) -> bool {
        self.interactive
    }

    /// A writer for log lines that does not tear the status line apart.
    #[must_use]
    pub fn log_writer(&self) -> LogWriter {
        LogWriter(self.clone())
    }

    /// Starts the status display; with a progress bar if there is an end to progress to.
    #[must_use]
    pub fn display(&self, with_progress: bool) -> Display {
        let bars = self.interactive.then(|| {
            let progress = with_progress.then(|| {
                let style = ProgressStyle::with_template("{bar:40.cyan/dim} {percent:>3} %").ok();
                let bar = self.bars.add(ProgressBar::new(PROGRESS_STEPS));
                if let Some(style) = style {
                    bar.set_style(style);
                }
                bar
            });
            let line = self.bars.add(ProgressBar::new_spinner());
            if let Ok(style) = ProgressStyle::with_template("{wide_msg}") {
                line.set_style(style);
            }
            Bars { line, progress }
        });
        Display { bars, start: Instant::now(), last: None }
    }
}

impl Default for Terminal {
    fn default() -> Self {
        Self::new()
    }
}

struct Bars {
    line: ProgressBar,
    progress: Option<ProgressBar>,
}

/// The status on display; dropping it takes it off the terminal.
pub struct Display {
    bars: Option<Bars>,
    start: Instant,
    last: Option<(Instant, Status)>,
}

impl Display {
    /// Shows `status`; to be called some times a second. True if something happened that people should know.
    pub fn show(&mut self, status: &Status) -> bool {
        if !status.robot.connected && self.start.elapsed() < GRACE {
            return false;
        }
        let news = self.last.as_ref().is_none_or(|(_, before)| is_news(before, status));
        if let Some(bars) = &self.bars {
            bars.line.set_message(status_line(status));
            if let (Some(bar), Some(progress)) = (&bars.progress, status.progress.fraction) {
                bar.set_position((progress.clamp(0.0, 1.0) * PROGRESS_STEPS as f64) as u64);
            }
            self.last = Some((Instant::now(), status.clone()));
        } else if news || self.last.as_ref().is_some_and(|(at, _)| at.elapsed() >= LINE_EVERY) {
            let progress =
                status.progress.fraction.map_or_else(String::new, |done| format!("  |  {:.0} %", 100.0 * done));
            // A reader that went away is no reason to stop streaming.
            say(&format!("{}{progress}", status_line(status))).ok();
            self.last = Some((Instant::now(), status.clone()));
        }
        news
    }
}

impl Drop for Display {
    fn drop(&mut self) {
        if let Some(bars) = &self.bars {
            if let Some(bar) = &bars.progress {
                bar.finish_and_clear();
            }
            bars.line.finish_and_clear();
        }
    }
}

/// An error with its causes, as one line.
#[must_use]
pub fn chain(error: &dyn std::error::Error) -> String {
    let mut line = error.to_string();
    let mut cause = error.source();
    while let Some(error) = cause {
        line.push_str(": ");
        line.push_str(&error.to_string());
        cause = error.source();
    }
    line
}

/// Prints a line on standard output.
///
/// # Errors
/// Nobody reads it any more.
pub fn say(line: &str) -> std::io::Result<()> {
    writeln!(std::io::stdout(), "{line}")
}

/// Writes log lines to stderr around the status line.
#[derive(Clone, Debug)]
pub struct LogWriter(Terminal);

impl std::io::Write for LogWriter {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        self.0.bars.suspend(|| std::io::stderr().write(bytes))
    }

    fn flush(&mut self) -> std::io::Result<()> {
        std::io::stderr().flush()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::feedback::Feedback;
    use teleop_common::authority::OperatorName;
    use teleop_common::net::Arrival;
    use teleop_common::time::MonoTime;
    use teleop_common::wire::{
        Echo, Header, HealthMessage, JointStateMessage, MAX_MESSAGE, Message, Quantiles, REJECTIONS, STAGES,
        encode_into, pack_joints,
    };

    fn bytes<M: Message>(message: &M) -> Vec<u8> {
        let mut buffer = [0; MAX_MESSAGE];
        let length = encode_into(message, &mut buffer).unwrap();
        buffer[..length].to_vec()
    }

    fn status(mode: Option<Mode>) -> Status {
        let feedback = Feedback::new(7);
        let now = MonoTime(20_000_000);
        if let Some(mode) = mode {
            feedback.on_sent(MonoTime(1_000_000));
            let joints = JointStateMessage {
                header: Header::new::<JointStateMessage>(9, 1, MonoTime(3_000_000)),
                echo: Echo { epoch: 7, sent: MonoTime(1_000_000), received: MonoTime(2_000_000) },
                mode: mode.to_wire(),
                joints: 16,
                tick: 1,
                wall_offset_ns: 0,
                pose_epoch: 7,
                pose_seq: 1,
                pose_captured: MonoTime(0),
                q: pack_joints(&[]),
                dq: pack_joints(&[]),
                tau: pack_joints(&[]),
                q_command: pack_joints(&[]),
                stop: 0,
                holder: 7,
            };
            feedback.on_joints(Arrival { payload: Ok(&bytes(&joints)), at: MonoTime(3_200_000) });
            let health = HealthMessage {
                header: Header::new::<HealthMessage>(9, 1, MonoTime(3_000_000)),
                mode: mode.to_wire(),
                fault: 0,
                ticks: 1,
                overruns: 0,
                tick_us: Quantiles::default(),
                poses_accepted: 5,
                rejected: [0; REJECTIONS],
                holds: 0,
                age_ms: Quantiles { p50: 1.0, p95: 2.0, p99: 3.12, max: 4.0 },
                telemetry_dropped: 0,
                rate_hz: 333.0,
                operator: OperatorName::default(),
                stages: [Quantiles::default(); STAGES],
                total_ms: Quantiles::default(),
            };
            feedback.on_health(Arrival { payload: Ok(&bytes(&health)), at: now });
        }
        Status {
            name: "allegro".to_owned(),
            endpoints: "tcp/127.0.0.1:7447".to_owned(),
            robot: feedback.snapshot(now),
            progress: Progress::default(),
            rate: 99.96,
            lost: 0,
        }
    }

    #[test]
    fn lines() {
        assert_eq!(
            status_line(&status(Some(Mode::Engaged))),
            "robot allegro  engaged  |  100.0 Hz  |  rtt 1.2 ms  |  pose age at robot 3.1 ms (p99)"
        );
        assert_eq!(status_line(&status(None)), "robot allegro  not connected (tcp/127.0.0.1:7447)  |  100.0 Hz");
        assert!(
            status_line(&status(Some(Mode::Holding)))
                .starts_with("robot allegro  holding: close the clutch anew (SPACE)  |")
        );
        let progress = Progress {
            activity: Activity::Calibrating(0.4),
            residual: Some(0.0031),
            skipped: 2,
            bad: 3,
            problem: Some("keypoints are those of a left hand".to_owned()),
            ..Progress::default()
        };
        let busy = Status { progress, lost: 4, ..status(None) };
        assert_eq!(
            status_line(&busy),
            "robot allegro  not connected (tcp/127.0.0.1:7447)  |  calibrating 40 %  |  fit 3.1 mm  |  2 skipped  |  \
             3 bad inputs  |  ERROR: 4 frames missing in the recording  |  ERROR: keypoints are those of a left hand"
        );
    }

    #[test]
    fn a_robot_of_another_release_is_told_of() {
        let feedback = Feedback::new(7);
        let header = Header::new::<HealthMessage>(9, 1, MonoTime(0));
        let mut other = [0; HealthMessage::LEN];
        other[..4].copy_from_slice(&header.magic());
        other[4] = 99;
        feedback.on_joints(Arrival { payload: Ok(&other), at: MonoTime(0) });
        let robot = feedback.snapshot(MonoTime(0));
        let line = status_line(&Status { robot, ..status(None) });
        assert!(line.contains("not connected") && line.contains("ERROR: peer speaks wire protocol 99"), "{line}");
        // It may be replaced by the right one, but not for ever.
        assert_eq!(robot.foreign, None);
        for ms in (0..4000).step_by(10) {
            feedback.on_joints(Arrival { payload: Ok(&other), at: MonoTime(ms * 1_000_000) });
        }
        assert!(feedback.snapshot(MonoTime(4_000_000_000)).foreign.is_some());
        assert_eq!(feedback.snapshot(MonoTime(5_000_000_000)).foreign, None, "it is silent");
        feedback.on_joints(Arrival { payload: Ok(b"hello"), at: MonoTime(0) });
        assert!(status_line(&Status { robot: feedback.snapshot(MonoTime(0)), ..status(None) }).contains("ERROR"));
    }

    #[test]
    fn a_change_of_mode_is_news_and_a_change_of_rate_is_not() {
        let engaged = status(Some(Mode::Engaged));
        assert!(is_news(&engaged, &status(Some(Mode::Holding))));
        assert!(is_news(&engaged, &status(None)));
        assert!(!is_news(&engaged, &Status { rate: 3.0, ..engaged.clone() }));
    }
}
