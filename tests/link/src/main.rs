//! Entry point of the `teleop-link` process.

use std::io::Write as _;
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use clap::Parser as _;
use signal_hook::consts::{SIGINT, SIGTERM};
use teleop_link::cli::{Cli, Command, RunArgs};
use teleop_link::relay::RelayError;
use teleop_link::{Counts, Endpoint, Link, Profile, Relay, Stats};

/// How soon a signal is noticed.
const POLL: Duration = Duration::from_millis(20);

fn main() -> ExitCode {
    let cli = Cli::parse();
    match (cli.command, &cli.run.listen, &cli.run.target) {
        (Some(Command::Profiles { json }), ..) => profiles(json),
        (None, Some(listen), Some(target)) => return relay(&cli.run, listen, target),
        // The parser has refused a relay without them.
        (None, ..) => return ExitCode::from(2),
    }
    ExitCode::SUCCESS
}

/// A reader that has gone is none of our business.
fn say(text: &str) {
    writeln!(std::io::stdout(), "{text}").ok();
}

fn fail(error: &dyn std::error::Error, code: u8) -> ExitCode {
    let causes: String =
        std::iter::successors(error.source(), |error| error.source()).map(|cause| format!(": {cause}")).collect();
    writeln!(std::io::stderr(), "error: {error}{causes}").ok();
    ExitCode::from(code)
}

fn profiles(json: bool) {
    for profile in Profile::ALL {
        if json {
            let mut line = profile.link().json();
            line["name"] = profile.name.into();
            line["about"] = profile.about.into();
            say(&line.to_string());
        } else {
            say(&format!("{:<10} {}\n{:<10} {}", profile.name, profile.about, "", profile.link()));
        }
    }
    if !json {
        say("\nFigures are typical ones, not measurements of a certain network. Options change single figures.");
    }
}

fn relay(args: &RunArgs, listen: &Endpoint, target: &Endpoint) -> ExitCode {
    let link = match args.figures.apply(args.wan.link()) {
        Ok(link) => link,
        Err(error) => return fail(&error, 2),
    };
    let stop = Arc::new(AtomicBool::new(false));
    for signal in [SIGINT, SIGTERM] {
        // The second signal ends it at once.
        let watched = signal_hook::flag::register_conditional_shutdown(signal, 1, Arc::clone(&stop))
            .and_then(|_| signal_hook::flag::register(signal, Arc::clone(&stop)));
        if let Err(error) = watched {
            return fail(&error, 1);
        }
    }
    let relay = match Relay::start(listen, target, &link, args.seed) {
        Ok(relay) => relay,
        Err(error @ RelayError::Listen { .. }) => return fail(&error, 1),
        Err(error) => return fail(&error, 2),
    };
    // The port that the system chose, if it was to.
    greet(args, &listen.clone().with_port(relay.address().port()), target, &link);
    let start = Instant::now();
    let end = args.duration.map(|seconds| start + Duration::from_secs_f64(seconds));
    let period = Duration::from_secs_f64(args.stats);
    let mut next = start + period;
    while !stop.load(Ordering::Relaxed) && end.is_none_or(|end| Instant::now() < end) {
        if !period.is_zero() && Instant::now() >= next {
            next += period;
            report(&relay, start, args.json);
        }
        std::thread::sleep(POLL);
    }
    report(&relay, start, args.json);
    ExitCode::SUCCESS
}

fn greet(args: &RunArgs, listen: &Endpoint, target: &Endpoint, link: &Link) {
    if args.json {
        let mut line = link.json();
        line["listen"] = listen.to_string().into();
        line["target"] = target.to_string().into();
        line["profile"] = args.wan.name.into();
        line["seed"] = args.seed.into();
        say(&line.to_string());
    } else {
        say(&format!("{listen} -> {target}, seed {}, {}: {link}", args.seed, args.wan.name));
    }
}

fn report(relay: &Relay, start: Instant, json: bool) {
    let stats = relay.stats();
    if json {
        let target = relay.target().map(|address| address.to_string());
        let time = start.elapsed().as_secs_f64();
        say(&serde_json::json!({ "t": time, "target": target, "stats": stats }).to_string());
        return;
    }
    let Stats { up, down, clients, refused, blackout_s } = stats;
    let mut line =
        format!("{:.0} s, clients {clients}; up {}; down {}", start.elapsed().as_secs_f64(), list(&up), list(&down));
    if blackout_s > 0.0 {
        line += &format!("; dark for {blackout_s:.1} s");
    }
    if refused > 0 {
        line += &format!("; {refused} refused");
    }
    if relay.target().is_none() {
        line += "; the target's name is not known (yet)";
    }
    say(&line);
}

/// What there is to tell of one direction.
fn list(counts: &Counts) -> String {
    let mut text = format!("{} of {} passed ({} kB)", counts.forwarded, counts.received, counts.bytes / 1000);
    for (count, what) in [
        (counts.lost, "lost"),
        (counts.dropped, "dropped by a full queue"),
        (counts.blacked_out, "lost in the dark"),
        (counts.duplicated, "doubled"),
        (counts.failed, "failed"),
    ] {
        if count > 0 {
            text += &format!(", {count} {what}");
        }
    }
    text
}
