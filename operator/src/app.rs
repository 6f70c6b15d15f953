//! The program: logging, signals, exit codes, and which command runs.

use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::Duration;

use anyhow::{Context as _, anyhow};
use teleop_common::key::Keys;
use teleop_common::master::Gesture;
use teleop_common::net::clock::random_epoch;
use teleop_common::net::{Session, SessionConfig, keyboard};

use crate::calibrate;
use crate::cli::{Cli, Command, ListArgs, LogArgs, StopArgs, WatchArgs};
use crate::failure::{Failure, OrFail as _, not_open};
use crate::feedback::Feedback;
use crate::lan::{find, locate};
use crate::list::{LINK_TIMEOUT, list, show};
use crate::request::{Requester, Wish};
use crate::robot_link::RobotLink;
use crate::run::run;
use crate::shutdown::Shutdown;
use crate::terminal::{Terminal, say};
use crate::watch::{WatchOptions, watch};

/// Default log filter. zenoh and Rerun warn of settings that are meant; what matters of them shows in the status line.
const LOG_FILTER: &str = "info,zenoh=error,re_=error,rerun=error";

/// Runs the program.
///
/// # Errors
/// [`Failure`], with the whole chain of causes.
pub fn main(cli: Cli) -> Result<(), Failure> {
    let terminal = Terminal::new();
    let shutdown = Shutdown::default();
    let command = cli.command.unwrap_or(Command::Run(cli.run));
    let log = match &command {
        Command::Run(args) => Some(&args.log),
        Command::Calibrate(args) => Some(&args.log),
        Command::Watch(args) => Some(&args.log),
        Command::Stop(args) => Some(&args.log),
        Command::List(args) => Some(&args.log),
        Command::Gestures => None,
    };
    if let Some(log) = log {
        init_log(log, &terminal)?;
    }
    // Zenoh and Rerun bring their own threads; this runtime waits for signals only.
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(1)
        .enable_all()
        .build()
        .context("cannot start the signal handler")
        .or_runtime()?;
    watch_signals(&runtime, &shutdown).context("cannot watch for signals").or_runtime()?;
    let result = match command {
        Command::Run(mut args) => {
            locate(&mut args.robot, &shutdown)?;
            run(&args, &shutdown, &terminal).map(|summary| say(&summary.to_string()).unwrap_or_default())
        }
        Command::Calibrate(args) => calibrate::calibrate(&args, &shutdown),
        Command::Watch(args) => watch_robot(args, &shutdown),
        Command::Stop(args) => stop_robot(args, &shutdown),
        Command::List(args) => list_robots(&args, &shutdown),
        Command::Gestures => {
            gestures();
            Ok(())
        }
    };
    runtime.shutdown_background();
    result
}

fn init_log(args: &LogArgs, terminal: &Terminal) -> Result<(), Failure> {
    use tracing_subscriber::EnvFilter;
    let text = args.log.clone().or_else(|| std::env::var("RUST_LOG").ok()).unwrap_or_else(|| LOG_FILTER.to_owned());
    // Its own words include their cause already.
    let filter = EnvFilter::try_new(&text)
        .map_err(|error| anyhow!("log filter {text:?} is none ({error}); write for example debug or info,zenoh=debug"))
        .or_usage()?;
    let terminal = terminal.clone();
    tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_target(false)
        .with_ansi(terminal.interactive())
        .with_writer(move || terminal.log_writer())
        .try_init()
        .map_err(|error| Failure::Runtime(anyhow!("cannot start logging: {error}")))
}

/// The first signal ends the process in order, the second at once.
fn watch_signals(runtime: &tokio::runtime::Runtime, shutdown: &Shutdown) -> std::io::Result<()> {
    use tokio::signal::unix::{SignalKind, signal};
    let _context = runtime.enter();
    let (mut interrupt, mut terminate) = (signal(SignalKind::interrupt())?, signal(SignalKind::terminate())?);
    let mut user = signal(SignalKind::user_defined1())?;
    let shutdown = shutdown.clone();
    runtime.spawn(async move {
        loop {
            tokio::select! {
                _ = interrupt.recv() => {}
                _ = terminate.recv() => {}
                _ = user.recv() => {
                    shutdown.nudge();
                    continue;
                }
            }
            if shutdown.requested() {
                keyboard::restore();
                std::process::exit(1);
            }
            shutdown.request();
        }
    });
    Ok(())
}

fn gestures() {
    for gesture in Gesture::ALL {
        say(&format!("{gesture:<18} {:>6.1} s  {}", gesture.duration(), gesture.description())).ok();
    }
}

fn stop_robot(mut args: StopArgs, shutdown: &Shutdown) -> Result<(), Failure> {
    locate(&mut args.robot, shutdown)?;
    let keys = Keys::new(&args.robot.name).or_usage()?;
    let epoch = random_epoch();
    let feedback = Arc::new(Feedback::new(epoch));
    let link = RobotLink::open(args.robot.session(), &keys, None, &feedback).map_err(not_open)?;
    let mut requester = Requester::new(link.sender(), epoch, &feedback);
    if requester.ask(Wish::Stop, &AtomicBool::new(false)).or_runtime()? {
        say(&format!("robot {} is stopped, until the stop is reset", keys.name())).ok();
        return Ok(());
    }
    let at = args.robot.connect.join(", ");
    Err(Failure::Runtime(anyhow!("robot {} did not confirm the stop at {at}: use its own emergency stop", keys.name())))
}

fn list_robots(args: &ListArgs, shutdown: &Shutdown) -> Result<(), Failure> {
    let time = Duration::from_secs_f64(args.time);
    let found = match &args.link.lan {
        None => None,
        Some(interface) => Some(find(&args.link, interface, shutdown)?),
    };
    let connect = found
        .as_ref()
        .map_or_else(|| args.connect.clone(), |found| found.iter().map(|(_, endpoint)| endpoint.clone()).collect());
    if found.is_some() && connect.is_empty() {
        return show(&[], args.json).or_runtime();
    }
    let config = SessionConfig { open_timeout: LINK_TIMEOUT, ..args.link.session(&connect) };
    let session = Session::open(&config).map_err(not_open)?;
    if let Some(mut rows) = list(&session, connect.len(), time, shutdown).or_runtime()? {
        if let Some(found) = found {
            for row in &mut rows {
                // Two of one name are one row.
                let at: Vec<_> =
                    found.iter().filter(|(name, _)| *name == row.robot).map(|(_, at)| at.as_str()).collect();
                row.endpoint = Some(at.join(", "));
            }
        }
        return show(&rows, args.json).or_runtime();
    }
    if shutdown.requested() {
        return Ok(());
    }
    let at = connect.join(", ");
    Err(Failure::Runtime(anyhow!(
        "nobody answers at {at}: is a robot or a router running there, and is --connect right?"
    )))
}

fn watch_robot(mut args: WatchArgs, shutdown: &Shutdown) -> Result<(), Failure> {
    locate(&mut args.robot, shutdown)?;
    let keys = Keys::new(&args.robot.name).or_usage()?;
    let feedback = Arc::new(Feedback::new(random_epoch()));
    let _link = RobotLink::open(args.robot.session(), &keys, None, &feedback).map_err(not_open)?;
    let options = WatchOptions {
        json: args.json,
        duration: args.duration.map(Duration::from_secs_f64),
        timeout: Duration::from_secs_f64(args.timeout),
        name: args.robot.name.clone(),
        endpoints: args.robot.connect.join(", "),
    };
    watch(&feedback, &options, shutdown).or_runtime()
}
