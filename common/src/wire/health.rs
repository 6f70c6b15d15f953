use serde::{Deserialize, Serialize};

use super::codec::sealed::Sealed;
use super::{Header, Kind, Message, WireError, check};
use crate::authority::OperatorName;
use crate::mode::Mode;
use crate::time::Histogram;

/// Number of rejection counters in a health message.
pub const REJECTIONS: usize = 9;

/// Why the robot did not obey a pose. The number is the counter's place in [`HealthMessage::rejected`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[repr(u8)]
pub enum Rejection {
    /// Length, magic or kind is wrong: not a pose at all.
    Malformed = 0,
    /// Another version of the protocol.
    Protocol = 1,
    /// A value out of range.
    Value = 2,
    /// Not newer than the last one: repeated or overtaken.
    Sequence = 3,
    /// Captured too long ago.
    Stale = 4,
    /// From another operator process than the one being followed.
    Operator = 5,
    /// Its age cannot be told: no clock offset yet, or one that is uncertain by more than the oldest age.
    Clock = 6,
    /// Another reason.
    Other = 7,
    /// A takeover that the robot does not permit.
    Takeover = 8,
}

impl Rejection {
    /// All reasons, by counter.
    pub const ALL: [Self; REJECTIONS] = [
        Self::Malformed,
        Self::Protocol,
        Self::Value,
        Self::Sequence,
        Self::Stale,
        Self::Operator,
        Self::Clock,
        Self::Other,
        Self::Takeover,
    ];

    /// Place of its counter.
    #[must_use]
    pub const fn index(self) -> usize {
        self as usize
    }

    /// Lower-case English name, for people.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Malformed => "malformed",
            Self::Protocol => "protocol version",
            Self::Value => "invalid value",
            Self::Sequence => "out of order",
            Self::Stale => "stale",
            Self::Operator => "other operator",
            Self::Clock => "clock unknown",
            Self::Other => "other",
            Self::Takeover => "takeover not permitted",
        }
    }
}

impl From<&WireError> for Rejection {
    fn from(error: &WireError) -> Self {
        match error {
            WireError::Protocol { .. } => Self::Protocol,
            WireError::Value { .. } | WireError::Code { .. } | WireError::Pose(_) | WireError::Name { .. } => {
                Self::Value
            }
            _ => Self::Malformed,
        }
    }
}

/// Median, 95th and 99th percentile, and maximum.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Quantiles {
    /// Median.
    pub p50: f32,
    /// 95th percentile.
    pub p95: f32,
    /// 99th percentile.
    pub p99: f32,
    /// Maximum.
    pub max: f32,
}

impl Quantiles {
    /// Of a histogram, in units of `unit_s` seconds (1e-6 for us, 1e-3 for ms).
    #[must_use]
    pub fn of(histogram: &Histogram, unit_s: f64) -> Self {
        let scaled = |value: std::time::Duration| (value.as_secs_f64() / unit_s) as f32;
        Self {
            p50: scaled(histogram.p50()),
            p95: scaled(histogram.quantile(0.95)),
            p99: scaled(histogram.p99()),
            max: scaled(histogram.max()),
        }
    }

    fn check(&self, field: &'static str) -> Result<(), WireError> {
        check::within(field, &[self.p50, self.p95, self.p99, self.max], 0.0, 1e16, "0 to 1e16")
    }
}

/// Number of stages in a health message.
pub const STAGES: usize = 4;

/// The way of a pose from the human hand to the robot hand. The number is the place in [`HealthMessage::stages`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum Stage {
    /// From the capture to handing it to the network: the operator process.
    Sent = 0,
    /// From there to its arrival: the network, by the estimated clock offset.
    Received = 1,
    /// From there to its use in a control tick: the playout delay.
    Mapped = 2,
    /// From there to the command written to the hand's driver.
    Commanded = 3,
}

impl Stage {
    /// All stages, in their order in time.
    pub const ALL: [Self; STAGES] = [Self::Sent, Self::Received, Self::Mapped, Self::Commanded];

    /// Lower-case English name of what takes the time, for people.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Sent => "operator",
            Self::Received => "network",
            Self::Mapped => "playout",
            Self::Commanded => "control",
        }
    }
}

/// The stages as a line for people, ms.
#[must_use]
pub fn latency_report(stages: &[Quantiles; STAGES], total: &Quantiles) -> String {
    let one =
        |name: &str, of: &Quantiles| format!("{name} {:.2} / {:.2} / {:.2} / {:.2}", of.p50, of.p95, of.p99, of.max);
    let parts: Vec<_> = Stage::ALL.iter().zip(stages).map(|(stage, of)| one(stage.name(), of)).collect();
    format!("latency, ms (p50 / p95 / p99 / max): {}, {}", parts.join(", "), one("in all", total))
}

/// How the robot process is doing.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct HealthMessage {
    /// Header.
    pub header: Header,
    /// [`Mode::to_wire`]
    pub mode: u8,
    /// 0 no fault; any other number is a fault, whether known to the receiver or not.
    pub fault: u8,
    /// Control ticks since the start.
    pub ticks: u64,
    /// Ticks that ended after the next one was due.
    pub overruns: u64,
    /// Time one tick takes, us.
    pub tick_us: Quantiles,
    /// Poses obeyed since the start.
    pub poses_accepted: u64,
    /// Poses not obeyed since the start, by [`Rejection`].
    pub rejected: [u64; REJECTIONS],
    /// Times the hand went to holding because poses stopped.
    pub holds: u64,
    /// Age of the poses obeyed, capture to arrival, ms.
    pub age_ms: Quantiles,
    /// Telemetry records that found their queue full.
    pub telemetry_dropped: u64,
    /// Measured control rate, Hz.
    pub rate_hz: f32,
    /// Name of the operator that has the robot, empty if none.
    pub operator: OperatorName,
    /// Times that the poses obeyed took, by [`Stage`], ms.
    pub stages: [Quantiles; STAGES],
    /// The whole way, from capture to the driver, ms.
    pub total_ms: Quantiles,
}

impl HealthMessage {
    /// The mode, if it is a known one, as it is in every decoded message.
    #[must_use]
    pub fn mode(&self) -> Option<Mode> {
        Mode::from_wire(self.mode)
    }
}

impl Sealed for HealthMessage {}

impl Message for HealthMessage {
    const KIND: Kind = Kind::Health;
    const LEN: usize = 278;

    fn header(&self) -> &Header {
        &self.header
    }

    fn check(&self) -> Result<(), WireError> {
        check::count("mode", self.mode, 0, Mode::ALL.len() - 1, "0 to 7")?;
        self.tick_us.check("tick_us")?;
        self.age_ms.check("age_ms")?;
        self.stages.iter().try_for_each(|stage| stage.check("stages"))?;
        self.total_ms.check("total_ms")?;
        check::name("operator", &self.operator)?;
        check::within("rate_hz", &[self.rate_hz], 0.0, 1e6, "0 to 1e6 Hz")
    }
}
