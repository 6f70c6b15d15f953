//! Wiring: from the command line to running threads, and back to an exit code.

use std::io::IsTerminal as _;
use std::process::ExitCode;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::Duration;

use anyhow::Context as _;
use teleop_common::hand::{FingerChain, HandModel, Joint};
use teleop_common::key::Keys;
use teleop_common::net::keyboard::Keyboard;
use teleop_common::net::{Session, clock};
use teleop_common::viz::{Hub, HubOptions, Scene, Viz};
use teleop_common::wire;

use crate::cli::{Cli, Command, LogArgs, RouterArgs, RunArgs, ViewerArgs};
use crate::config::{Config, ConfigError};
use crate::control::Controller;
use crate::driver::SimHand;
use crate::receive::{PoseSubscription, Receiver};
use crate::runtime::{ControlThread, LoopRecord, Shared};
use crate::telemetry::Telemetry;
use crate::usage::{UsageError, is_usage};

/// How long the telemetry thread sleeps between looks at the ring of records.
const TELEMETRY_PERIOD: Duration = Duration::from_millis(3);

/// Runs what the command line asks for. Errors are printed here, once.
#[must_use]
pub fn main(cli: Cli) -> ExitCode {
    let command = cli.command.unwrap_or(Command::Run(cli.run));
    let log = match &command {
        Command::Run(args) => &args.log,
        Command::Retarget(args) => &args.log,
        Command::Paper(args) => &args.log,
        Command::Viewer(args) => &args.log,
        Command::Router(args) => &args.log,
    };
    let result = start_logging(log).and_then(|()| match command {
        Command::Run(args) => run(&args),
        Command::Retarget(args) => crate::retarget::run(&args),
        Command::Paper(args) => crate::paper::run(&args),
        Command::Viewer(args) => view(&args),
        Command::Router(args) => route(&args),
    });
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error:#}");
            // What the user can mend on the command line or in a file is usage.
            ExitCode::from(if error.chain().any(is_usage) { 2 } else { 1 })
        }
    }
}

fn start_logging(args: &LogArgs) -> anyhow::Result<()> {
    use tracing_subscriber::EnvFilter;
    let filter = args.log.clone().or_else(|| std::env::var("RUST_LOG").ok());
    let filter = filter.unwrap_or_else(|| "info,zenoh=error,re_=warn".to_owned());
    let filter = EnvFilter::try_new(&filter).map_err(|error| UsageError(format!("log filter {filter:?}: {error}")))?;
    tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_writer(std::io::stderr)
        .with_target(false)
        .with_ansi(std::io::stderr().is_terminal())
        .init();
    Ok(())
}

fn run(args: &RunArgs) -> anyhow::Result<()> {
    let config = Config::load(args.hand.config.as_deref(), &args.hand.overrides())?;
    let hand = args.hand.source().load(&config)?;
    for warning in &hand.warnings {
        tracing::warn!("{}: {warning}", hand.name);
    }
    let keys = Keys::new(&args.name).map_err(|error| UsageError(format!("--name: {error}")))?;
    let controller =
        Controller::new(hand.clone(), config.mapping.clone(), config.control).map_err(ConfigError::from)?;
    let session = Session::open(&args.network.session())?;
    let epoch = clock::random_epoch();
    let viz = Viz::start(args.viewer.clone(), Scene::robot(&args.name, &hand))?;

    let driver = Box::new(SimHand::new(&hand, 1.0 / config.control.rate));
    let (control, link) = ControlThread::start(controller, driver, config.control.rate, args.realtime)?;
    let shared = link.shared;
    let receiver = Arc::new(Mutex::new(Receiver::new(epoch, config.lease, link.poses, Arc::clone(&shared))));
    let telemetry =
        Telemetry::new(&session, &keys, epoch, Arc::clone(&receiver), viz.logger(), &hand, config.mapping.clone())?;
    let control = Arc::new(control);
    let poses = PoseSubscription::new(&session, &keys, receiver)?;
    let telemetry = TelemetryThread::start(telemetry, link.records, poses, Arc::clone(&control))?;
    let description = describe(&args.name, &hand, &config).into_bytes();
    let server = session.serve(&keys.describe(), move || description.clone())?;
    let token = session.live_token(&keys.live_robot(epoch))?;

    tracing::info!(
        "robot {:?}: {} (simulated), {:.0} Hz{}, operators connect to {}",
        args.name,
        hand.name,
        config.control.rate,
        if control.is_realtime() { " with real-time priority" } else { "" },
        session.locators().join(", ")
    );
    let keyboard = listen_to_keys(&shared);
    if keyboard.is_some() {
        tracing::info!("SPACE or s stops the hand, r resets the stop");
    }
    let end = wait_for_the_end(args.duration, || control.is_running(), Some(&shared));
    drop((keyboard, server, token));
    let stopped_early = !control.is_running();
    let latency = telemetry.finish();
    drop(control);
    viz.shutdown(Duration::from_secs(1));
    session.close().ok();
    end?;
    anyhow::ensure!(!stopped_early, "the control loop ended by itself, see the log");
    if let Some(latency) = latency {
        tracing::info!("{latency}");
    }
    tracing::info!("robot {:?} stopped", args.name);
    Ok(())
}

/// Stop and reset at the robot itself.
fn listen_to_keys(shared: &Arc<Shared>) -> Option<Keyboard> {
    let shared = Arc::clone(shared);
    Keyboard::listen(move |key| match key {
        b' ' | b's' => stop(&shared),
        b'r' => reset(&shared),
        _ => {}
    })
}

fn stop(shared: &Shared) {
    if shared.latch.stop() {
        tracing::warn!("stop: asked for at the robot");
    }
}

fn reset(shared: &Shared) {
    if shared.latch.reset_any() {
        tracing::warn!("stop reset at the robot");
    }
}

fn view(args: &ViewerArgs) -> anyhow::Result<()> {
    let hub = Hub::open(&HubOptions { bind: args.bind, ..HubOptions::default() })?;
    tracing::info!("viewer: open {} in a browser; processes connect with --viewer connect=HOST", hub.page());
    wait_for_the_end(None, || true, None)
}

fn route(args: &RouterArgs) -> anyhow::Result<()> {
    let session = Session::open(&args.session())?;
    tracing::info!("router: robots and operators connect to {}", session.locators().join(", "));
    wait_for_the_end(None, || true, None)?;
    session.close()?;
    Ok(())
}

/// Blocks until Ctrl-C, SIGTERM, the end of `duration` seconds, or `alive` turning false. Meanwhile SIGUSR1 stops the
/// hand of `shared` and SIGUSR2 resets the stop.
fn wait_for_the_end(duration: Option<f64>, alive: impl Fn() -> bool, shared: Option<&Shared>) -> anyhow::Result<()> {
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build()?;
    runtime.block_on(async {
        use tokio::signal::unix::{SignalKind, signal};
        let mut interrupt = signal(SignalKind::interrupt()).context("cannot wait for Ctrl-C")?;
        let mut terminate = signal(SignalKind::terminate()).context("cannot wait for SIGTERM")?;
        let deadline = async {
            match duration {
                Some(seconds) => tokio::time::sleep(Duration::from_secs_f64(seconds)).await,
                None => std::future::pending().await,
            }
        };
        let dead = async {
            while alive() {
                tokio::time::sleep(Duration::from_millis(100)).await;
            }
        };
        let buttons = async {
            let Some(shared) = shared else { return std::future::pending().await };
            let both = signal(SignalKind::user_defined1()).and_then(|a| Ok((a, signal(SignalKind::user_defined2())?)));
            let Ok((mut press, mut release)) = both else { return std::future::pending().await };
            loop {
                tokio::select! {
                    _ = press.recv() => stop(shared),
                    _ = release.recv() => reset(shared),
                }
            }
        };
        tokio::select! {
            () = buttons => {}
            _ = interrupt.recv() => {}
            _ = terminate.recv() => {}
            () = deadline => {}
            () = dead => {}
        }
        Ok(())
    })
}

/// What operators and tools may want to know, as JSON.
fn describe(name: &str, hand: &HandModel, config: &Config) -> String {
    let joint = |joint: &Joint| {
        serde_json::json!({
            "name": joint.name, "lower": joint.lower, "upper": joint.upper,
            "velocity": joint.velocity, "acceleration": joint.acceleration, "home": joint.home,
        })
    };
    let finger = |chain: &FingerChain| {
        let joints: Vec<_> = chain.joints.iter().map(|joint| joint.joint).collect();
        serde_json::json!({ "name": chain.finger.name(), "joints": joints })
    };
    serde_json::json!({
        "robot": name,
        "version": env!("CARGO_PKG_VERSION"),
        "protocol": wire::PROTOCOL,
        "model": hand.name,
        "hand": hand.side.name(),
        "driver": "simulated",
        "joints": hand.joints.iter().map(joint).collect::<Vec<_>>(),
        "fingers": hand.fingers.iter().map(finger).collect::<Vec<_>>(),
        "mapping": config.mapping,
        "control": {
            "rate_hz": config.control.rate,
            "smoothing_s": config.control.smoothing,
            "engage_speed_rad_s": config.control.engage_speed,
            "engage_ramp_s": config.control.engage_ramp,
            "tip_overlap_m": config.control.tip_overlap,
        },
        "authority": {
            "hold_after_s": config.control.hold_after.as_secs_f64(),
            "max_age_s": config.lease.max_age.as_secs_f64(),
            "release_after_s": config.lease.release_after.as_secs_f64(),
            "takeover": config.lease.takeover,
            "relax": config.control.relax,
            "relax_after_s": config.control.relax_after.as_secs_f64(),
            "stop": config.control.stop,
        },
    })
    .to_string()
}

/// Reads the control loop's records, and keeps the subscription to poses alive, until dropped.
struct TelemetryThread {
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<Option<String>>>,
}

impl TelemetryThread {
    fn start(
        mut telemetry: Telemetry,
        mut records: rtrb::Consumer<LoopRecord>,
        mut poses: PoseSubscription,
        control: Arc<ControlThread>,
    ) -> std::io::Result<Self> {
        let stop = Arc::new(AtomicBool::new(false));
        let stopped = Arc::clone(&stop);
        let thread = std::thread::Builder::new().name("telemetry".to_owned()).spawn(move || {
            while !stopped.load(Ordering::Relaxed) {
                while let Ok(record) = records.pop() {
                    telemetry.on_record(&record, control.dropped());
                }
                if let Err(error) = poses.refresh(clock::now()) {
                    tracing::error!("poses cannot be received: {error}");
                }
                std::thread::sleep(TELEMETRY_PERIOD);
            }
            telemetry.latency_report()
        })?;
        Ok(Self { stop, thread: Some(thread) })
    }

    /// Ends it, and says where the time went on the way from the human hand to the robot hand.
    fn finish(mut self) -> Option<String> {
        self.stop.store(true, Ordering::Relaxed);
        self.thread.take()?.join().ok()?
    }
}

impl Drop for TelemetryThread {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            thread.join().ok();
        }
    }
}
