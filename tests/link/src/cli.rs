//! The command line.

use std::str::FromStr;
use std::time::Duration;

use clap::{Args, Parser, Subcommand};

use crate::{Blackouts, Endpoint, Impairment, Invalid, Link, Profile, Shape};

const EXAMPLES: &str = "\
Examples:
  teleop-link --wan fair udp/127.0.0.1:7457 udp/127.0.0.1:7447
          then `operator --connect udp/127.0.0.1:7457`, to the robot on this machine
  teleop-link --wan poor --seed 7 tcp/0.0.0.0:7447 tcp/robot:7447
  teleop-link --delay-ms 50 --jitter-ms 20 --loss 30% quic/0.0.0.0:7447 quic/robot:7447
  teleop-link --wan good --rate-mbit 1/8 --blackout \"every 20 for 1\" udp/[::]:7447 udp/robot:7447
  teleop-link profiles

A figure is for both directions, or UP/DOWN: to the target, and back. The same seed gives the same
chances to the same packets. Over udp and quic, losses and blackouts are losses; over tcp and tls
a lost packet comes late, by a round trip and 200 ms, with all those behind it, and a blackout holds
everything up.

Exit codes: 0 done (also after Ctrl-C), 1 failed while running, 2 wrong usage.";

/// A bad network on demand: passes UDP or TCP on, late, limited and with losses.
#[derive(Debug, Parser)]
#[command(name = "teleop-link", version, after_help = EXAMPLES, args_conflicts_with_subcommands = true)]
pub struct Cli {
    /// What to do; relaying if nothing is said.
    #[command(subcommand)]
    pub command: Option<Command>,
    /// What to relay, and how.
    #[command(flatten)]
    pub run: RunArgs,
}

/// What else `teleop-link` can do.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// List the links that --wan knows, with their figures
    Profiles {
        /// As JSON
        #[arg(long)]
        json: bool,
    },
}

/// What to relay, and how.
#[derive(Args, Clone, Debug)]
pub struct RunArgs {
    /// Where to listen: udp/ADDRESS:PORT, quic/..., tcp/... or tls/...
    #[arg(required = true)]
    pub listen: Option<Endpoint>,
    /// Where to pass on to; a name is looked up every two seconds, so the target may come later, or elsewhere again
    #[arg(required = true)]
    pub target: Option<Endpoint>,
    /// The link to start from (see `teleop-link profiles`)
    #[arg(long, default_value = "perfect", value_name = "PROFILE")]
    pub wan: Profile,
    /// Where chance comes from
    #[arg(long, default_value_t = 1, value_name = "NUMBER")]
    pub seed: u64,
    /// Print what was done every so many seconds; 0 for at the end only
    #[arg(long, default_value_t = 5.0, value_name = "SECONDS", value_parser = seconds)]
    pub stats: f64,
    /// Print it as JSON, one object per line
    #[arg(long)]
    pub json: bool,
    /// End after this many seconds
    #[arg(long, value_name = "SECONDS", value_parser = seconds)]
    pub duration: Option<f64>,
    /// Single figures of the link.
    #[command(flatten)]
    pub figures: Figures,
}

/// Figures that replace those of the profile.
#[derive(Args, Clone, Debug, Default)]
#[command(next_help_heading = "Single figures, instead of those of --wan")]
pub struct Figures {
    /// One-way delay
    #[arg(long, value_name = "MS")]
    pub delay_ms: Option<Both<Number>>,
    /// How much the delay varies
    #[arg(long, value_name = "MS")]
    pub jitter_ms: Option<Both<Number>>,
    /// How it varies: uniform (within +- jitter), normal (with this deviation) or pareto (a heavy tail of this mean)
    #[arg(long, value_name = "SHAPE")]
    pub jitter_shape: Option<Shape>,
    /// How much the jitter of a packet resembles that of the one before
    #[arg(long, value_name = "0..1")]
    pub jitter_correlation: Option<Both<Number>>,
    /// Share of packets lost, 0.02 or 2%
    #[arg(long, value_name = "SHARE")]
    pub loss: Option<Both<Share>>,
    /// Mean number of packets lost in a row; 0 for each by itself
    #[arg(long, value_name = "PACKETS")]
    pub burst: Option<Both<Number>>,
    /// Share of packets held back and overtaken
    #[arg(long, value_name = "SHARE")]
    pub reorder: Option<Both<Share>>,
    /// How long these are held back
    #[arg(long, value_name = "MS")]
    pub reorder_ms: Option<Both<Number>>,
    /// Share of packets that come twice
    #[arg(long, value_name = "SHARE")]
    pub duplicate: Option<Both<Share>>,
    /// What passes per second; 0 for any amount
    #[arg(long, value_name = "MBIT")]
    pub rate_mbit: Option<Both<Number>>,
    /// What may wait where the rate is the limit, in 1000 bytes
    #[arg(long, value_name = "KB")]
    pub queue_kb: Option<Both<Number>>,
    /// When nothing passes, in seconds since the start: 10..12,30..31 or "every 20 for 1"
    #[arg(long, value_name = "WHEN")]
    pub blackout: Option<Blackouts>,
}

/// A figure of both directions.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Both<T> {
    /// To the target.
    pub up: T,
    /// Back.
    pub down: T,
}

/// A number that is not negative.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Number(pub f64);

/// A share, 0 to 1; as text also in percent.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Share(pub f64);

impl Figures {
    /// The link of a profile with these figures instead of its own.
    ///
    /// # Errors
    /// If they do not make a link.
    pub fn apply(&self, mut link: Link) -> Result<Link, Invalid> {
        let ms = |ms: f64| Duration::from_secs_f64(ms.min(1e9) / 1e3);
        let mut set = |value: &Option<Both<Number>>, put: &dyn Fn(&mut Impairment, f64)| {
            if let Some(Both { up, down }) = value {
                put(&mut link.up, up.0);
                put(&mut link.down, down.0);
            }
        };
        let plain =
            |share: Option<Both<Share>>| share.map(|Both { up, down }| Both { up: Number(up.0), down: Number(down.0) });
        set(&self.delay_ms, &|way, value| way.delay = ms(value));
        set(&self.jitter_ms, &|way, value| way.jitter = ms(value));
        set(&self.jitter_correlation, &|way, value| way.jitter_correlation = value);
        set(&plain(self.loss), &|way, value| way.loss = value);
        set(&self.burst, &|way, value| way.burst = (value != 0.0).then_some(value));
        set(&plain(self.reorder), &|way, value| way.reorder = value);
        set(&self.reorder_ms, &|way, value| way.reorder_by = ms(value));
        set(&plain(self.duplicate), &|way, value| way.duplicate = value);
        set(&self.rate_mbit, &|way, value| way.rate = (value != 0.0).then_some(value * 1e6));
        set(&self.queue_kb, &|way, value| way.queue = (value * 1e3) as usize);
        if let Some(shape) = self.jitter_shape {
            (link.up.shape, link.down.shape) = (shape, shape);
        }
        if let Some(blackouts) = &self.blackout {
            link.blackouts = blackouts.clone();
        }
        link.check()?;
        Ok(link)
    }
}

impl<T: FromStr<Err = Invalid> + Copy> FromStr for Both<T> {
    type Err = Invalid;

    fn from_str(text: &str) -> Result<Self, Invalid> {
        let (up, down) = text.split_once('/').unwrap_or((text, text));
        Ok(Self { up: up.parse()?, down: down.parse()? })
    }
}

impl FromStr for Number {
    type Err = Invalid;

    fn from_str(text: &str) -> Result<Self, Invalid> {
        let value = text.trim().parse().ok().filter(|value: &f64| value.is_finite() && *value >= 0.0);
        value.map(Self).ok_or_else(|| Invalid(format!("{text:?} is not a number from 0 on")))
    }
}

impl FromStr for Share {
    type Err = Invalid;

    fn from_str(text: &str) -> Result<Self, Invalid> {
        let (number, unit) = text.trim().strip_suffix('%').map_or((text, 1.0), |percent| (percent, 100.0));
        let value = number.parse::<Number>()?.0 / unit;
        if value <= 1.0 {
            Ok(Self(value))
        } else {
            Err(Invalid(format!("{text:?} is more than all: write 0.02 or 2%")))
        }
    }
}

fn seconds(text: &str) -> Result<f64, String> {
    let value = text.parse::<Number>().map_err(|error| error.to_string())?.0;
    if value <= 1e7 { Ok(value) } else { Err("must be 0 to 10000000 s".to_owned()) }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(line: &str) -> Result<RunArgs, String> {
        Cli::try_parse_from(line.split_whitespace()).map(|cli| cli.run).map_err(|error| error.to_string())
    }

    fn link(options: &str) -> Result<Link, String> {
        let args = parse(&format!("teleop-link udp/a:1 udp/b:2 {options}"))?;
        args.figures.apply(args.wan.link()).map_err(|error| error.to_string())
    }

    #[test]
    fn the_definition_is_sound() {
        use clap::CommandFactory as _;
        Cli::command().debug_assert();
        let cli = Cli::try_parse_from(["teleop-link", "profiles", "--json"]).unwrap();
        assert!(matches!(cli.command, Some(Command::Profiles { json: true })));
    }

    #[test]
    fn figures_replace_those_of_the_profile() {
        let fair = link("--wan fair").unwrap();
        assert_eq!(fair, "fair".parse::<Profile>().unwrap().link());
        let changed = link("--wan fair --delay-ms 40/60 --loss 2% --burst 0 --rate-mbit 0 --blackout 1..2").unwrap();
        assert_eq!((changed.up.delay.as_millis(), changed.down.delay.as_millis()), (40, 60));
        for way in [changed.up, changed.down] {
            assert_eq!((way.loss, way.burst, way.rate, way.jitter), (0.02, None, None, fair.up.jitter));
        }
        assert_eq!(changed.blackouts.to_string(), "1..2");
        assert_eq!(link("--jitter-ms 3 --jitter-shape pareto").unwrap().down.shape, Shape::Pareto);
    }

    #[test]
    fn errors_name_the_value_and_the_rule() {
        for (options, expected) in [
            ("--wan bad", "none of perfect, lan"),
            ("--loss 3", "write 0.02 or 2%"),
            ("--loss -1", "-1"),
            ("--delay-ms fast", "\"fast\" is not a number"),
            ("--delay-ms 1/nan", "\"nan\" is not a number"),
            ("--delay-ms 100000", "must be 60s at most"),
            ("--loss 0.9 --burst 2", "must be 9"),
            ("--rate-mbit 1e9", "must be 0.001 to 100000 Mbit/s"),
            ("--queue-kb 1", "must be 1500 bytes to 1 GiB"),
            ("--jitter-correlation 1", "below 1"),
            ("--jitter-shape flat", "\"flat\" is none of uniform, normal, pareto"),
            ("--blackout 3..2", "must end after it begins"),
            ("--duration never", "not a number"),
            ("more", "more"),
        ] {
            let message = link(options).unwrap_err();
            assert!(message.contains(expected), "{options}: {message}");
        }
        assert!(parse("teleop-link udp/a:1").unwrap_err().contains("TARGET"));
        assert!(parse("teleop-link a:1 udp/b:2").unwrap_err().contains("has no protocol"));
    }
}
