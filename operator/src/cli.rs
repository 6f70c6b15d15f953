//! The command line.

use std::path::PathBuf;

use clap::{Args, Parser, Subcommand, ValueEnum};
use teleop_common::net::{AUTO_INTERFACE, Role, SessionConfig, Tls, runtime};
use teleop_common::viz::Viewer;

use crate::pilot::ClutchBy;
use crate::robot_hand::RobotHand;

/// Where the robot listens by default.
pub const ROBOT_ENDPOINT: &str = "tcp/127.0.0.1:7447";
/// Where the operator listens for hand data by default.
pub const INPUT_ENDPOINT: &str = "tcp/127.0.0.1:7448";

const EXAMPLES: &str = "\
Examples:
  operator                                       the gesture tour, to the robot on this machine
  operator --source tap_middle --rate 200        one gesture, 200 poses a second
  operator --source hand.csv --loop              a recording, again and again
  operator --source zenoh --calibration me.toml  hand data from any program, see below
  operator --connect tcp/192.168.0.7:7447        a robot on another machine
  operator --connect quic/robot.example.org:7447 --tls-ca ca.pem --tls-cert ada.pem --tls-key ada.key
                                                 over the internet, encrypted (files: see deploy/certificates)
  operator calibrate --source hand.csv --output me.toml
  operator --clutch auto                         a demonstration: follow whenever the robot is ready
  operator watch --json --duration 5             what the robot does, as JSON lines
  operator stop                                  stop the hand, from any terminal; it stays stopped
  operator list                                  robots, what they do and for whom
  operator list --lan                            those on the local network that were started with --lan
  operator gestures                              what --source knows

The robot follows only while the clutch is closed. On a terminal: SPACE closes and opens the clutch, s stops the hand,
r resets the stop, q quits. After a hold (a bad link) the clutch must be closed again.

Any program can feed a hand with `--source zenoh`: connect it to tcp/127.0.0.1:7448 and put JSON on
the Zenoh key allegro/v1/<name>/in/hand, one message per frame, either of
  {\"t\": 1.25, \"q\": [20 joint angles, rad: thumb, index, middle, ring, little, four each]}
  {\"t\": 1.25, \"keypoints\": [[x, y, z], ... 21 points, m, in the order of MediaPipe]}
With --clutch input the clutch is moved on allegro/v1/<name>/in/clutch: {\"closed\": true} or {\"closed\": false}; a
pedal says {\"closed\": true, \"for\": 0.3} again and again while it is pressed. SIGUSR1 does what SPACE does.

Exit codes: 0 done (also after Ctrl-C), 1 failed while running, 2 wrong usage or configuration.";

/// Streams a human hand to a robot hand.
#[derive(Debug, Parser)]
#[command(name = "operator", version, after_help = EXAMPLES, args_conflicts_with_subcommands = true)]
pub struct Cli {
    /// What to do; streaming if nothing is said.
    #[command(subcommand)]
    pub command: Option<Command>,
    /// Options of `run`.
    #[command(flatten)]
    pub run: RunArgs,
}

/// What `operator` can do.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Stream a hand to the robot (this is what `operator` alone does)
    #[command(after_help = EXAMPLES)]
    Run(RunArgs),
    /// Measure a person's hand from keypoints, tune the mapping for it, and save both for `--calibration`
    Calibrate(CalibrateArgs),
    /// Show what the robot does, without driving it
    Watch(WatchArgs),
    /// Stop the robot's hand; the stop lasts until it is reset at the robot, or by the operator that drives it
    Stop(StopArgs),
    /// List the robots that can be reached, what they do, for whom, and how fast
    List(ListArgs),
    /// List the scripted gestures
    Gestures,
}

/// Which robot, and where.
#[derive(Args, Clone, Debug)]
pub struct RobotArgs {
    /// The robot's name, as in its --name
    #[arg(long, default_value = "allegro", value_name = "NAME")]
    pub name: String,
    /// Where the robot listens; repeatable
    #[arg(long, default_value = ROBOT_ENDPOINT, value_name = "ENDPOINT")]
    pub connect: Vec<String>,
    /// How to connect.
    #[command(flatten)]
    pub link: LinkArgs,
}

impl RobotArgs {
    /// The session with the robot.
    pub(crate) fn session(&self) -> SessionConfig {
        self.link.session(&self.connect)
    }
}

/// Through a router or not, and certificates for quic/ and tls/ endpoints.
#[derive(Args, Clone, Debug)]
pub struct LinkArgs {
    /// --connect names routers (robot router, zenohd), which the robot is connected to as well
    #[arg(long)]
    pub router: bool,
    /// Look for robots on the local network instead of --connect; those answer that were started with --lan as well.
    /// Another network interface than the system's choice: --lan=INTERFACE
    #[arg(long, value_name = "INTERFACE", num_args = 0..=1, require_equals = true, default_missing_value = AUTO_INTERFACE,
        conflicts_with_all = ["connect", "router"])]
    pub lan: Option<String>,
    /// Certificate authority (PEM): only a robot that has a certificate of it is connected to
    #[arg(long, value_name = "FILE", requires_all = ["tls_cert", "tls_key"], help_heading = "Security")]
    pub tls_ca: Option<PathBuf>,
    /// This operator's certificate (PEM); its common name is what the robot's --allow-operator names
    #[arg(long, value_name = "FILE", requires_all = ["tls_ca", "tls_key"], help_heading = "Security")]
    pub tls_cert: Option<PathBuf>,
    /// The certificate's private key (PEM)
    #[arg(long, value_name = "FILE", requires_all = ["tls_ca", "tls_cert"], help_heading = "Security")]
    pub tls_key: Option<PathBuf>,
}

impl LinkArgs {
    /// A session that connects to `endpoints`.
    pub(crate) fn session(&self, endpoints: &[String]) -> SessionConfig {
        let tls = match (&self.tls_ca, &self.tls_cert, &self.tls_key) {
            (Some(ca), Some(certificate), Some(key)) => {
                Some(Tls { ca: ca.clone(), certificate: certificate.clone(), key: key.clone() })
            }
            _ => None,
        };
        let role = if self.router { Role::Client } else { Role::Peer };
        SessionConfig { role, tls, ..SessionConfig::connecting(endpoints.iter().cloned()) }
    }
}

impl Cli {
    /// Whether zenoh must keep to one thread: there may be `tls/` links.
    #[must_use]
    pub fn needs_one_thread(&self) -> bool {
        let (connect, link) = match self.command.as_ref() {
            None => (&self.run.robot.connect, &self.run.robot.link),
            Some(Command::Run(args)) => (&args.robot.connect, &args.robot.link),
            Some(Command::Watch(args)) => (&args.robot.connect, &args.robot.link),
            Some(Command::Stop(args)) => (&args.robot.connect, &args.robot.link),
            Some(Command::List(args)) => (&args.connect, &args.link),
            Some(Command::Calibrate(_) | Command::Gestures) => return false,
        };
        runtime::needs_one_thread(connect) || (link.lan.is_some() && link.tls_ca.is_some())
    }
}

/// How much to tell.
#[derive(Args, Clone, Debug)]
pub struct LogArgs {
    /// What to log to stderr, as in RUST_LOG (which it overrides): a level, or target=level pairs
    #[arg(long, value_name = "FILTER", help_heading = "Logging")]
    pub log: Option<String>,
}

/// Options of `operator run`.
#[derive(Args, Clone, Debug)]
pub struct RunArgs {
    /// Where the hand comes from: tour, a gesture (see `operator gestures`), FILE.csv, FILE.jsonl, or zenoh
    #[arg(long, default_value = "tour", value_name = "SOURCE")]
    pub source: String,
    /// Which robot.
    #[command(flatten)]
    pub robot: RobotArgs,
    /// Poses per second of a gesture (1 to 1000)
    #[arg(long, default_value_t = 100.0, value_name = "HZ", value_parser = rate)]
    pub rate: f64,
    /// Play a recording at this multiple of its own speed (0.05 to 20)
    #[arg(long, default_value_t = 1.0, value_name = "FACTOR", value_parser = speed)]
    pub speed: f64,
    /// Play a recording again and again; the pose jumps where it starts over, which the robot turns into a bounded move
    #[arg(long = "loop")]
    pub repeat: bool,
    /// Sizes of the person's hand, from `operator calibrate`; without it keypoints are measured first: a recording as
    /// a whole before it plays, a live hand for 3 s before it is followed
    #[arg(long, value_name = "FILE")]
    pub calibration: Option<PathBuf>,
    /// Take the tracker's noise out of keypoints; joint angles are sent as they are
    #[arg(long, value_enum, default_value = "on")]
    pub filter: Switch,
    /// The robot hand that the mapping of keypoints is tuned for, unless the calibration file says how already
    #[arg(long, value_enum, default_value_t, value_name = "HAND")]
    pub robot_hand: RobotHand,
    /// Where hand data of `--source zenoh`, and `--clutch input`, may arrive; repeatable
    #[arg(long, default_value = INPUT_ENDPOINT, value_name = "ENDPOINT")]
    pub listen: Vec<String>,
    /// How the clutch is moved, which lets the robot follow [default: key on a terminal, start elsewhere]
    #[arg(long, value_enum, value_name = "HOW", help_heading = "Authority")]
    pub clutch: Option<ClutchBy>,
    /// Take the robot from another operator, if the robot's configuration permits it
    #[arg(long, help_heading = "Authority")]
    pub takeover: bool,
    /// Who drives, for people (16 characters) [default: user and host]
    #[arg(long, value_name = "NAME", help_heading = "Authority")]
    pub operator: Option<String>,
    /// Record what is streamed (joint angles, with the hand's sizes) into this new file, JSON lines
    #[arg(long, value_name = "FILE.jsonl")]
    pub record: Option<PathBuf>,
    /// The picture: web, web=ADDRESS, connect=URL, save=FILE.rrd or off
    #[arg(long, default_value = "web", value_name = "VIEWER")]
    pub viewer: Viewer,
    /// End after this many seconds
    #[arg(long, value_name = "SECONDS", value_parser = seconds)]
    pub duration: Option<f64>,
    /// Logging.
    #[command(flatten)]
    pub log: LogArgs,
}

/// Options of `operator calibrate`.
#[derive(Args, Clone, Debug)]
pub struct CalibrateArgs {
    /// Keypoints: FILE.csv, FILE.jsonl, or zenoh for live ones on allegro/v1/NAME/in/hand
    #[arg(long, value_name = "SOURCE")]
    pub source: String,
    /// The robot hand that the mapping is to be tuned for
    #[arg(long, value_enum, default_value_t, value_name = "HAND")]
    pub robot_hand: RobotHand,
    /// Where to save the sizes
    #[arg(long, value_name = "FILE")]
    pub output: PathBuf,
    /// How long to measure a live hand (default: 5), or how much of a recording to use (default: all)
    #[arg(long, value_name = "SECONDS", value_parser = seconds)]
    pub seconds: Option<f64>,
    /// The robot's name in the key of live keypoints
    #[arg(long, default_value = "allegro", value_name = "NAME")]
    pub name: String,
    /// Where live keypoints may arrive; repeatable
    #[arg(long, default_value = INPUT_ENDPOINT, value_name = "ENDPOINT")]
    pub listen: Vec<String>,
    /// Logging.
    #[command(flatten)]
    pub log: LogArgs,
}

/// Options of `operator stop`.
#[derive(Args, Clone, Debug)]
pub struct StopArgs {
    /// Which robot.
    #[command(flatten)]
    pub robot: RobotArgs,
    /// Logging.
    #[command(flatten)]
    pub log: LogArgs,
}

/// Options of `operator list`.
#[derive(Args, Clone, Debug)]
pub struct ListArgs {
    /// A robot or a router that robots are connected to; repeatable
    #[arg(long, default_value = ROBOT_ENDPOINT, value_name = "ENDPOINT")]
    pub connect: Vec<String>,
    /// How to connect.
    #[command(flatten)]
    pub link: LinkArgs,
    /// How long to listen to the robots found
    #[arg(long, default_value_t = 1.0, value_name = "SECONDS", value_parser = seconds)]
    pub time: f64,
    /// One JSON object per robot
    #[arg(long)]
    pub json: bool,
    /// Logging.
    #[command(flatten)]
    pub log: LogArgs,
}

/// Options of `operator watch`.
#[derive(Args, Clone, Debug)]
pub struct WatchArgs {
    /// Which robot.
    #[command(flatten)]
    pub robot: RobotArgs,
    /// One JSON object per line, ten a second
    #[arg(long)]
    pub json: bool,
    /// End after this many seconds
    #[arg(long, value_name = "SECONDS", value_parser = seconds)]
    pub duration: Option<f64>,
    /// Fail if the robot has not been heard for this long
    #[arg(long, default_value_t = 5.0, value_name = "SECONDS", value_parser = seconds)]
    pub timeout: f64,
    /// Logging.
    #[command(flatten)]
    pub log: LogArgs,
}

/// On or off.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Switch {
    /// Yes.
    On,
    /// No.
    Off,
}

fn rate(text: &str) -> Result<f64, String> {
    within(text, 1.0, 1000.0, "Hz")
}

fn speed(text: &str) -> Result<f64, String> {
    within(text, 0.05, 20.0, "")
}

fn seconds(text: &str) -> Result<f64, String> {
    within(text, 0.1, 1e7, "s")
}

fn within(text: &str, low: f64, high: f64, unit: &str) -> Result<f64, String> {
    let value: f64 = text.parse().map_err(|_error| format!("{text:?} is not a number"))?;
    let space = if unit.is_empty() { "" } else { " " };
    if (low..=high).contains(&value) { Ok(value) } else { Err(format!("must be {low} to {high}{space}{unit}")) }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(line: &str) -> Result<Cli, String> {
        Cli::try_parse_from(line.split_whitespace()).map_err(|error| error.to_string())
    }

    #[test]
    fn the_definition_is_sound() {
        use clap::CommandFactory as _;
        Cli::command().debug_assert();
    }

    #[test]
    fn alone_it_streams_the_tour_to_this_machine() {
        let cli = parse("operator").unwrap();
        assert!(cli.command.is_none());
        assert_eq!(cli.run.source, "tour");
        assert_eq!(cli.run.robot.connect, [ROBOT_ENDPOINT]);
        assert_eq!((cli.run.rate, cli.run.viewer), (100.0, Viewer::default()));
    }

    #[test]
    fn run_may_be_said_or_not() {
        for line in ["operator --source fist --rate 50", "operator run --source fist --rate 50"] {
            let cli = parse(line).unwrap();
            let args = match cli.command {
                Some(Command::Run(args)) => args,
                _ => cli.run,
            };
            assert_eq!((args.source.as_str(), args.rate), ("fist", 50.0), "{line}");
        }
    }

    #[test]
    fn errors_name_the_value_and_the_rule() {
        for (line, expected) in [
            ("operator --rate 0", "must be 1 to 1000 Hz"),
            ("operator --rate nan", "must be 1 to 1000 Hz"),
            ("operator --rate fast", "\"fast\" is not a number"),
            ("operator --speed 100", "must be 0.05 to 20"),
            ("operator --duration 0", "must be 0.1 to 10000000 s"),
            ("operator --viewer screen", "\"screen\" is unknown"),
            ("operator --sourc tour", "--source"),
            ("operator calibrate --source x.csv", "--output"),
        ] {
            let message = parse(line).unwrap_err();
            assert!(message.contains(expected), "{line}: {message}");
        }
    }
}
