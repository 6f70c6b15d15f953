//! What one direction of a link does to packets.

use std::fmt;
use std::str::FromStr;
use std::time::Duration;

use serde_json::{Value, json};

use crate::Invalid;
use crate::dice::exceedance;

/// Shape of the Pareto tail: its mean exists, its variance too, barely.
const PARETO_SHAPE: f64 = 2.5;
/// The longest jitter of a heavy tail, in multiples of its mean.
const PARETO_LIMIT: f64 = 20.0;
/// The farthest normal jitter, in standard deviations.
const NORMAL_LIMIT: f64 = 3.0;
/// The longest delay, jitter or hold-back.
const LONGEST: Duration = Duration::from_secs(60);
/// The lowest rate, bit/s.
const SLOWEST: f64 = 1e3;

/// How jitter is distributed. No delay gets negative.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Shape {
    /// Evenly within plus and minus `jitter`.
    #[default]
    Uniform,
    /// Normal, `jitter` is the standard deviation; nothing beyond three of them.
    Normal,
    /// A heavy tail on top of the delay (Lomax, shape 2.5): `jitter` is the mean, at most 20 times as much.
    Pareto,
}

/// What one direction of a link does to packets. The default does nothing.
///
/// Jitter alone never changes the order, as in a real queue: who would overtake arrives right behind the one in front.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Impairment {
    /// One-way delay.
    pub delay: Duration,
    /// How much the delay varies, see [`Shape`].
    pub jitter: Duration,
    /// How jitter is distributed.
    pub shape: Shape,
    /// How much a packet's jitter resembles that of the packet before, 0 (not) to 1 (fully, exclusive).
    pub jitter_correlation: f64,
    /// Fraction of packets lost by chance.
    pub loss: f64,
    /// Mean number of packets lost in a row (Gilbert's model); without it each packet is lost or not by itself.
    pub burst: Option<f64>,
    /// Fraction of packets that are held back and overtaken.
    pub reorder: f64,
    /// How long these are held back.
    pub reorder_by: Duration,
    /// Fraction of packets that come twice; the copy has jitter of its own, and comes no sooner than the original.
    pub duplicate: f64,
    /// Payload that passes, bit/s; without it no packet waits for another.
    pub rate: Option<f64>,
    /// Bytes that may wait where `rate` is the bottleneck; packets beyond are dropped.
    pub queue: usize,
}

impl Default for Impairment {
    fn default() -> Self {
        Self {
            delay: Duration::ZERO,
            jitter: Duration::ZERO,
            shape: Shape::Uniform,
            jitter_correlation: 0.0,
            loss: 0.0,
            burst: None,
            reorder: 0.0,
            reorder_by: Duration::from_millis(20),
            duplicate: 0.0,
            rate: None,
            queue: 65_536,
        }
    }
}

impl Impairment {
    /// Checks every figure. A model takes impossible ones for the nearest possible.
    ///
    /// # Errors
    /// What is wrong, with its value and its range.
    pub fn check(&self) -> Result<(), Invalid> {
        for (name, time) in [("delay", self.delay), ("jitter", self.jitter), ("reorder delay", self.reorder_by)] {
            ensure(time <= LONGEST, || format!("{name} {time:?}: must be {LONGEST:?} at most"))?;
        }
        for (name, share) in [("loss", self.loss), ("reorder", self.reorder), ("duplicate", self.duplicate)] {
            ensure((0.0..=1.0).contains(&share), || format!("{name} {share}: must be 0 to 1, or 0% to 100%"))?;
        }
        let correlation = self.jitter_correlation;
        ensure((0.0..1.0).contains(&correlation), || {
            format!("jitter correlation {correlation}: must be 0 to below 1")
        })?;
        if let Some(burst) = self.burst {
            let least = (self.loss / (1.0 - self.loss)).max(1.0);
            ensure(burst.is_finite() && burst >= least, || {
                format!("burst {burst}: with loss {} it must be {least} packets or more", self.loss)
            })?;
        }
        if let Some(rate) = self.rate {
            ensure((SLOWEST..=1e11).contains(&rate), || format!("rate {rate} bit/s: must be 0.001 to 100000 Mbit/s"))?;
        }
        ensure((1_500..=1 << 30).contains(&self.queue), || {
            format!("queue {} bytes: must be 1500 bytes to 1 GiB", self.queue)
        })
    }

    /// The nearest with which nothing overflows.
    pub(crate) fn bounded(self) -> Self {
        let [delay, jitter, reorder_by] = [self.delay, self.jitter, self.reorder_by].map(|time| time.min(LONGEST));
        let rate = self.rate.filter(|rate| rate.is_finite()).map(|rate| rate.max(SLOWEST));
        Self { delay, jitter, reorder_by, rate, jitter_correlation: self.jitter_correlation.clamp(0.0, 1.0), ..self }
    }

    /// The delay of a packet whose jitter is at `z` on the scale of a standard normal number.
    pub(crate) fn delay_at(&self, z: f64) -> Duration {
        if self.jitter.is_zero() {
            return self.delay;
        }
        let share = match self.shape {
            Shape::Uniform => 1.0 - 2.0 * exceedance(z),
            Shape::Normal => z.clamp(-NORMAL_LIMIT, NORMAL_LIMIT),
            Shape::Pareto => {
                let excess = exceedance(z).powf(-1.0 / PARETO_SHAPE) - 1.0;
                (excess * (PARETO_SHAPE - 1.0)).clamp(0.0, PARETO_LIMIT)
            }
        };
        Duration::from_secs_f64((self.delay.as_secs_f64() + self.jitter.as_secs_f64() * share).max(0.0))
    }

    /// How long the line is busy with so many bytes.
    pub(crate) fn passing(&self, bytes: f64) -> Duration {
        self.rate.map_or(Duration::ZERO, |rate| Duration::from_secs_f64(bytes * 8.0 / rate))
    }

    /// The figures, for machines; times in ms, rate in Mbit/s.
    #[must_use]
    pub fn json(&self) -> Value {
        json!({
            "delay_ms": ms(self.delay),
            "jitter_ms": ms(self.jitter),
            "jitter_shape": self.shape.to_string(),
            "jitter_correlation": self.jitter_correlation,
            "loss": self.loss,
            "burst": self.burst,
            "reorder": self.reorder,
            "reorder_ms": ms(self.reorder_by),
            "duplicate": self.duplicate,
            "rate_mbit": self.rate.map(|rate| rate / 1e6),
            "queue_bytes": self.queue,
        })
    }
}

fn ensure(holds: bool, message: impl FnOnce() -> String) -> Result<(), Invalid> {
    if holds { Ok(()) } else { Err(Invalid(message())) }
}

fn ms(time: Duration) -> f64 {
    time.as_secs_f64() * 1e3
}

impl FromStr for Shape {
    type Err = Invalid;

    fn from_str(name: &str) -> Result<Self, Invalid> {
        match name {
            "uniform" => Ok(Self::Uniform),
            "normal" => Ok(Self::Normal),
            "pareto" => Ok(Self::Pareto),
            _ => Err(Invalid(format!("{name:?} is none of uniform, normal, pareto"))),
        }
    }
}

impl fmt::Display for Shape {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Uniform => "uniform",
            Self::Normal => "normal",
            Self::Pareto => "pareto",
        })
    }
}

/// In words, such as `25 ms +- 4 ms normal, loss 0.5 % in bursts of 2, 20 Mbit/s`.
impl fmt::Display for Impairment {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let percent = |share: f64| (share * 1e6).round() / 1e4;
        write!(f, "{} ms", ms(self.delay))?;
        if !self.jitter.is_zero() {
            let sign = if self.shape == Shape::Pareto { "+" } else { "+-" };
            write!(f, " {sign} {} ms {}", ms(self.jitter), self.shape)?;
        }
        if self.loss > 0.0 {
            write!(f, ", loss {} %", percent(self.loss))?;
        }
        if let (true, Some(burst)) = (self.loss > 0.0, self.burst) {
            write!(f, " in bursts of {burst}")?;
        }
        if self.reorder > 0.0 {
            write!(f, ", {} % overtaken by {} ms", percent(self.reorder), ms(self.reorder_by))?;
        }
        if self.duplicate > 0.0 {
            write!(f, ", {} % twice", percent(self.duplicate))?;
        }
        if let Some(rate) = self.rate {
            write!(f, ", {} Mbit/s", rate / 1e6)?;
        }
        Ok(())
    }
}
