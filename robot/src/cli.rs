//! The command line.

use std::path::PathBuf;

use clap::{Args, Parser, Subcommand, ValueEnum};
use teleop_common::hand::HandSide;
use teleop_common::mapping::MappingMode;
use teleop_common::net::{AUTO_INTERFACE, Access, Role, SessionConfig, Tls, runtime};
use teleop_common::viz::Viewer;

use crate::config::{HandSource, Overrides};
use crate::runtime::Realtime;

const EXAMPLES: &str = "\
Examples:
  robot                                     a simulated right Allegro Hand on this machine, picture in the browser
  robot --hand left --name lefty            the left hand, under another name
  robot --listen tcp/0.0.0.0:7447           let an operator on another machine connect
  robot --listen udp/0.0.0.0:7447 --lan     the same, and operators on the local network find it (operator --lan)
  robot --listen quic/0.0.0.0:7447 --tls-ca ca.pem --tls-cert robot.pem --tls-key robot.key --allow-operator ada
                                            over the internet, for the operator whose certificate says ada (files: see
                                            deploy/certificates; which link for which network: deploy/NETWORK.md)
  robot --preset paper --mode cartesian     the paper's parameters, Cartesian mapping only
  robot --viewer connect=192.168.0.5        show in the viewer of another machine
  robot retarget --input hand.csv --output joints.jsonl
  robot paper --out paper                   the paper's tables and figures: open paper/index.html
  robot viewer --bind 0.0.0.0               only the viewer, for other processes to connect to

Configuration file (--config FILE), every value optional:
  preset = \"default\"          # or \"paper\"
  [mapping]                   # mode, r1, r2 (m), scale, anchor, joint_map, gain, thumb_gain,
  r2 = 0.06                   # thumb_map (auto, angles, directions), tuning (operator, fixed): an r1, r2 or scale
                              # given here holds whatever the operator's tuning says;
                              # baseline = { scale, low_pass } of the modes vector and dexpilot
  [control]                   # rate_hz, smoothing_s, engage_speed_rad_s, engage_ramp_s, tip_overlap_m,
  smoothing_s = 0.008         # velocity_scale, acceleration_scale
  [authority]                 # max_age_s, release_after_s (a silent operator loses the robot), relax_after_s,
  hold_after_s = 0.1          # holds still so long after a pose was due
  takeover = \"never\"          # or idle, always: when another operator may take the robot
  relax = \"hold\"              # or yield (less torque), open, off: after holding for relax_after_s
  stop = \"hold\"               # or off: what a stop does once the hand has braked
  [playout]                   # mode (auto, direct, fixed), max_delay_s, tolerance_s, predict_s: poses that arrive
  mode = \"auto\"               # unevenly are played evenly, with as much delay as the link needs and none on a good one

On a terminal SPACE or s stops the hand and r resets the stop; elsewhere the signals SIGUSR1 and SIGUSR2 do.

Exit codes: 0 done (also after Ctrl-C), 1 failed while running, 2 wrong usage or configuration.";

const PAPER: &str = "\
Writes into DIR (made if missing; files of the same names are replaced):
  index.html                  everything on one page: open this
  summary.json                what was checked: P1 to P7 of Fig. 8, the claims of Fig. 6, per preset
  table1.json                 Table 1: phalanx lengths, c_s, d
  fig2.json fig2.csv          Fig. 2: errors of plain Cartesian and joint mapping, 455 fingers
  fig4.csv                    Fig. 4: the gain, corrected and as printed
  fig6.json fig6.csv          Fig. 6: taps under joint, Cartesian and combined mapping
  fig8_PRESET.csv             Fig. 8: the tripod, 80 s; ..._close.csv with the fingers more curled
  smoothness.json, .csv       speed, velocity jumps and jerk, before and after the loop
  fig*.svg smoothness.svg     the plots; fig7_PRESET.svg are frames of fig8_PRESET
  paper.rrd                   Fig. 2 and 8 to turn and play: rerun DIR/paper.rrd

Examples:
  robot paper --out paper
  robot paper --out left --hand left --preset default";

const ROUTER: &str = "\
Robots and operators both connect to it, with certificates of the same authority. Who may pass what is said here, because a
robot sees this router's certificate on all that comes from it, and names only that.

Examples:
  robot router --listen quic/0.0.0.0:7447 --tls-ca ca.pem --tls-cert router.pem --tls-key router.key \\
               --allow-robot robot --allow-operator ada --allow-observer olga
  robot    --listen quic/127.0.0.1:7447 --connect quic/router.example.org:7447 ... --allow-operator router
  operator --router --connect quic/router.example.org:7447 ...

Without --allow-... whoever gets a link may do everything. It is a Zenoh router (what zenohd is, without plugins).";

/// Drives a robot hand with the poses of a human hand.
#[derive(Debug, Parser)]
#[command(name = "robot", version, after_help = EXAMPLES, args_conflicts_with_subcommands = true)]
pub struct Cli {
    /// What to do; driving the hand if nothing is said.
    #[command(subcommand)]
    pub command: Option<Command>,
    /// Options of `run`.
    #[command(flatten)]
    pub run: RunArgs,
}

/// What `robot` can do.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Drive the hand (this is what `robot` alone does)
    #[command(after_help = EXAMPLES)]
    Run(RunArgs),
    /// Map a whole recording to joint angles, as fast as possible
    Retarget(RetargetArgs),
    /// Compute the paper's tables and figures: numbers, plots, one page that shows them all
    #[command(after_help = PAPER)]
    Paper(PaperArgs),
    /// Host the viewer for other processes (--viewer connect=HOST) and nothing else
    Viewer(ViewerArgs),
    /// Pass on what robots and operators send that cannot reach each other, and nothing else
    #[command(after_help = ROUTER)]
    Router(RouterArgs),
}

impl Cli {
    /// Whether zenoh must keep to one thread: there may be `tls/` links.
    #[must_use]
    pub fn needs_one_thread(&self) -> bool {
        let args = match &self.command {
            None => &self.run,
            Some(Command::Run(args)) => args,
            Some(Command::Router(args)) => {
                return runtime::needs_one_thread(args.listen.iter().chain(&args.connect));
            }
            Some(Command::Retarget(_) | Command::Paper(_) | Command::Viewer(_)) => return false,
        };
        // What a zenoh configuration says shows only when it is read.
        let NetworkArgs { listen, connect, zenoh, .. } = &args.network;
        zenoh.is_some() || runtime::needs_one_thread(listen.iter().chain(connect))
    }
}

/// Which hand.
#[derive(Clone, Copy, Debug, ValueEnum)]
pub enum Side {
    /// The right hand.
    Right,
    /// The left hand.
    Left,
}

/// Which mapping.
#[derive(Clone, Copy, Debug, ValueEnum)]
pub enum Mode {
    /// Joint mapping far from the thumb, Cartesian near it.
    Combined,
    /// Joint angles only.
    Joint,
    /// Fingertip positions only.
    Cartesian,
    /// Baseline: the objective of AnyTeleop.
    Vector,
    /// Baseline: the objective of DexPilot.
    #[value(name = "dexpilot")]
    DexPilot,
}

/// The hand and its mapping.
#[derive(Args, Clone, Debug)]
pub struct HandArgs {
    /// Which Allegro Hand
    #[arg(long, value_enum, default_value = "right", help_heading = "Hand")]
    pub hand: Side,
    /// A URDF instead of the built-in one
    #[arg(long, value_name = "FILE", help_heading = "Hand")]
    pub urdf: Option<PathBuf>,
    /// A hand description (TOML) instead of the built-in one
    #[arg(long, value_name = "FILE", help_heading = "Hand")]
    pub description: Option<PathBuf>,
    /// How the human hand is mapped [default: combined]
    #[arg(long, value_enum, help_heading = "Mapping")]
    pub mode: Option<Mode>,
    /// Parameters to start from: default or paper [default: default]
    #[arg(long, value_name = "NAME", help_heading = "Mapping")]
    pub preset: Option<String>,
    /// Configuration file, see below
    #[arg(long, value_name = "FILE", help_heading = "Mapping")]
    pub config: Option<PathBuf>,
    /// Control ticks per second [default: 333]
    #[arg(long, value_name = "HZ", help_heading = "Mapping")]
    pub rate: Option<f64>,
}

/// How much to tell.
#[derive(Args, Clone, Debug)]
pub struct LogArgs {
    /// What to log to stderr, as in RUST_LOG (which it overrides): a level, or target=level pairs
    #[arg(long, value_name = "FILTER", help_heading = "Logging")]
    pub log: Option<String>,
}

/// Where operators connect, and who may.
#[derive(Args, Clone, Debug)]
pub struct NetworkArgs {
    /// Where operators connect; repeatable. quic/ and tls/ are encrypted, udp/ and tcp/ are not
    #[arg(long, default_value = "tcp/127.0.0.1:7447", value_name = "ENDPOINT", help_heading = "Network")]
    pub listen: Vec<String>,
    /// A router to connect to, over which operators reach this robot; repeatable
    #[arg(long, value_name = "ENDPOINT", help_heading = "Network")]
    pub connect: Vec<String>,
    /// Answer operators that look for robots on the local network (operator list --lan), which tells anybody there where
    /// this robot listens. Another network interface than the system's choice: --lan=INTERFACE
    #[arg(long, value_name = "INTERFACE", num_args = 0..=1, require_equals = true, default_missing_value = AUTO_INTERFACE,
        help_heading = "Network")]
    pub lan: Option<String>,
    /// A zenoh configuration file for link options
    #[arg(long, value_name = "FILE", help_heading = "Network")]
    pub zenoh: Option<PathBuf>,
    /// Certificates, and who may do what.
    #[command(flatten)]
    pub security: SecurityArgs,
}

/// Certificates, and who may do what.
#[derive(Args, Clone, Debug)]
pub struct SecurityArgs {
    /// Certificate authority (PEM): only who has a certificate of it can connect
    #[arg(long, value_name = "FILE", requires_all = ["tls_cert", "tls_key"], help_heading = "Security")]
    pub tls_ca: Option<PathBuf>,
    /// This process's certificate (PEM), with the names that others connect to
    #[arg(long, value_name = "FILE", requires_all = ["tls_ca", "tls_key"], help_heading = "Security")]
    pub tls_cert: Option<PathBuf>,
    /// The certificate's private key (PEM)
    #[arg(long, value_name = "FILE", requires_all = ["tls_ca", "tls_cert"], help_heading = "Security")]
    pub tls_key: Option<PathBuf>,
    /// Common name of a certificate that may drive, stop and watch; repeatable. With this or --allow-observer whoever is
    /// not named may nothing
    #[arg(long, value_name = "NAME", value_parser = common_name, help_heading = "Security")]
    pub allow_operator: Vec<String>,
    /// Common name of a certificate that may stop and watch; repeatable
    #[arg(long, value_name = "NAME", value_parser = common_name, help_heading = "Security")]
    pub allow_observer: Vec<String>,
}

impl SecurityArgs {
    fn tls(&self) -> Option<Tls> {
        match (&self.tls_ca, &self.tls_cert, &self.tls_key) {
            (Some(ca), Some(certificate), Some(key)) => {
                Some(Tls { ca: ca.clone(), certificate: certificate.clone(), key: key.clone() })
            }
            _ => None,
        }
    }

    fn access(&self) -> Access {
        let (operators, observers) = (self.allow_operator.clone(), self.allow_observer.clone());
        Access { operators, observers, ..Access::default() }
    }
}

impl NetworkArgs {
    /// The session with operators.
    #[must_use]
    pub fn session(&self) -> SessionConfig {
        let access = self.security.access();
        SessionConfig {
            listen: self.listen.clone(),
            connect: self.connect.clone(),
            tls: self.security.tls(),
            access: (access != Access::default()).then_some(access),
            zenoh_config_file: self.zenoh.clone(),
            lan: self.lan.clone(),
            ..SessionConfig::default()
        }
    }
}

fn common_name(text: &str) -> Result<String, String> {
    if text.is_empty() { Err("it must be a name".to_owned()) } else { Ok(text.to_owned()) }
}

/// Options of `robot run`.
#[derive(Args, Clone, Debug)]
pub struct RunArgs {
    /// The robot's name; operators use the same
    #[arg(long, default_value = "allegro", value_name = "NAME")]
    pub name: String,
    /// Hand and mapping.
    #[command(flatten)]
    pub hand: HandArgs,
    /// Network.
    #[command(flatten)]
    pub network: NetworkArgs,
    /// The picture: web, web=ADDRESS, connect=URL, save=FILE.rrd or off
    #[arg(long, default_value = "web", value_name = "VIEWER")]
    pub viewer: Viewer,
    /// Real-time priority of the control thread
    #[arg(long, value_enum, default_value = "auto")]
    pub realtime: Realtime,
    /// End after this many seconds
    #[arg(long, value_name = "SECONDS", value_parser = seconds)]
    pub duration: Option<f64>,
    /// Logging.
    #[command(flatten)]
    pub log: LogArgs,
}

/// Options of `robot retarget`.
#[derive(Args, Clone, Debug)]
pub struct RetargetArgs {
    /// Recordings: JSON lines with `q` or `keypoints`, or CSV of keypoints; of a folder all .jsonl and .csv files
    #[arg(long, value_name = "FILE|DIR", num_args = 1.., required = true)]
    pub input: Vec<PathBuf>,
    /// Where to write, JSON lines, one per frame; a folder for several recordings. Appears only when complete
    #[arg(long, value_name = "FILE|DIR")]
    pub output: PathBuf,
    /// Recordings mapped at a time [default: one per core]
    #[arg(long, value_name = "N", value_parser = threads)]
    pub threads: Option<usize>,
    /// Hand and mapping.
    #[command(flatten)]
    pub hand: HandArgs,
    /// off: the pure mapping; on: what the live robot commands when it gets these frames at these times
    #[arg(long, value_enum, default_value = "off")]
    pub conditioning: Switch,
    /// Sizes of the person's hand, from `operator calibrate`; without it keypoints are measured from the recording
    #[arg(long, value_name = "FILE")]
    pub calibration: Option<PathBuf>,
    /// Take the tracker's noise out of keypoints; joint angles are mapped as they are
    #[arg(long, value_enum, default_value = "on")]
    pub filter: Switch,
    /// Write how well the robot follows the recorded hand, JSON: pinch gaps, lag, smoothness, limits (lengths in m)
    #[arg(long, value_name = "FILE")]
    pub quality: Option<PathBuf>,
    /// Write the time that the mapping takes per frame, JSON
    #[arg(long, value_name = "FILE")]
    pub stats: Option<PathBuf>,
    /// Logging.
    #[command(flatten)]
    pub log: LogArgs,
}

/// Options of `robot paper`.
#[derive(Args, Clone, Debug)]
pub struct PaperArgs {
    /// Folder to write to
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Which Allegro Hand
    #[arg(long, value_enum, default_value = "right")]
    pub hand: Side,
    /// Parameters of the mapping, paper or default; repeatable
    #[arg(long, value_name = "NAME", default_values = ["paper", "default"])]
    pub preset: Vec<String>,
    /// Logging.
    #[command(flatten)]
    pub log: LogArgs,
}

/// Options of `robot viewer`.
#[derive(Args, Clone, Debug)]
pub struct ViewerArgs {
    /// Address to serve on; 0.0.0.0 for all
    #[arg(long, default_value = "127.0.0.1", value_name = "IP")]
    pub bind: std::net::IpAddr,
    /// Logging.
    #[command(flatten)]
    pub log: LogArgs,
}

/// Options of `robot router`.
#[derive(Args, Clone, Debug)]
pub struct RouterArgs {
    /// Where robots, operators and other routers connect; repeatable
    #[arg(long, default_value = "tcp/127.0.0.1:7447", value_name = "ENDPOINT", help_heading = "Network")]
    pub listen: Vec<String>,
    /// Another router to connect to; repeatable
    #[arg(long, value_name = "ENDPOINT", help_heading = "Network")]
    pub connect: Vec<String>,
    /// Certificates, and who may do what.
    #[command(flatten)]
    pub security: SecurityArgs,
    /// Common name of a certificate that is a robot's; repeatable
    #[arg(long, value_name = "NAME", value_parser = common_name, help_heading = "Security")]
    pub allow_robot: Vec<String>,
    /// Common name of a certificate that is another router's, which may pass on what anybody may; repeatable
    #[arg(long, value_name = "NAME", value_parser = common_name, help_heading = "Security")]
    pub allow_router: Vec<String>,
    /// Logging.
    #[command(flatten)]
    pub log: LogArgs,
}

impl RouterArgs {
    /// The session that passes everything on.
    #[must_use]
    pub fn session(&self) -> SessionConfig {
        let (robots, routers) = (self.allow_robot.clone(), self.allow_router.clone());
        let access = Access { robots, routers, ..self.security.access() };
        SessionConfig {
            listen: self.listen.clone(),
            connect: self.connect.clone(),
            role: Role::Router,
            tls: self.security.tls(),
            access: (access != Access::default()).then_some(access),
            ..SessionConfig::default()
        }
    }
}

fn threads(text: &str) -> Result<usize, String> {
    match text.parse() {
        Ok(count @ 1..=1024) => Ok(count),
        _ => Err("must be a number from 1 to 1024".to_owned()),
    }
}

/// On or off.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Switch {
    /// Yes.
    On,
    /// No.
    Off,
}

impl Side {
    const fn model(self) -> HandSide {
        match self {
            Self::Right => HandSide::Right,
            Self::Left => HandSide::Left,
        }
    }
}

impl PaperArgs {
    /// Where the hand comes from.
    #[must_use]
    pub fn source(&self) -> HandSource {
        HandSource { side: self.hand.model(), urdf: None, description: None }
    }
}

impl HandArgs {
    /// What overrides the configuration file.
    #[must_use]
    pub fn overrides(&self) -> Overrides {
        let mode = self.mode.map(|mode| match mode {
            Mode::Combined => MappingMode::Combined,
            Mode::Joint => MappingMode::Joint,
            Mode::Cartesian => MappingMode::Cartesian,
            Mode::Vector => MappingMode::Vector,
            Mode::DexPilot => MappingMode::DexPilot,
        });
        Overrides { preset: self.preset.clone(), mode, rate: self.rate }
    }

    /// Where the hand comes from.
    #[must_use]
    pub fn source(&self) -> HandSource {
        HandSource { side: self.hand.model(), urdf: self.urdf.clone(), description: self.description.clone() }
    }
}

fn seconds(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(value) if value > 0.0 && value <= 1e7 => Ok(value),
        _ => Err("it must be a number of seconds above 0".to_owned()),
    }
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory as _;

    use super::*;

    #[test]
    fn the_command_line_is_consistent() {
        Cli::command().debug_assert();
    }
}
