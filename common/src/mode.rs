//! What the robot is doing, as both ends call it. How it gets from one mode to another: [`crate::authority`].

/// The robot's mode.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
#[repr(u8)]
pub enum Mode {
    /// No operator has the robot: the hand holds where it is.
    #[default]
    Disarmed = 0,
    /// An operator has the robot and its poses are good; its clutch is open and the hand holds.
    Armed = 1,
    /// The clutch was closed: the hand moves to the operator's posture, slowly at first.
    Engaging = 2,
    /// Following the operator's poses.
    Engaged = 3,
    /// Poses stopped or were not usable while the hand followed: it holds until the clutch is closed again.
    Holding = 4,
    /// Holding went on for long: the hand does what was configured for that (holds, gives way, opens or lets go).
    Relaxed = 5,
    /// Somebody pressed stop: nothing moves until the stop is reset.
    Stopped = 6,
    /// The hand or the process failed; only a restart ends it.
    Faulted = 7,
}

impl Mode {
    /// All modes, by wire value.
    pub const ALL: [Self; 8] = [
        Self::Disarmed,
        Self::Armed,
        Self::Engaging,
        Self::Engaged,
        Self::Holding,
        Self::Relaxed,
        Self::Stopped,
        Self::Faulted,
    ];

    /// The mode with this number on the wire.
    #[must_use]
    pub fn from_wire(value: u8) -> Option<Self> {
        Self::ALL.get(usize::from(value)).copied()
    }

    /// The number on the wire.
    #[must_use]
    pub const fn to_wire(self) -> u8 {
        self as u8
    }

    /// Whether the hand goes where the operator's hand is.
    #[must_use]
    pub const fn follows(self) -> bool {
        matches!(self, Self::Engaging | Self::Engaged)
    }

    /// Lower-case English name, for people.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Disarmed => "disarmed",
            Self::Armed => "armed",
            Self::Engaging => "engaging",
            Self::Engaged => "engaged",
            Self::Holding => "holding",
            Self::Relaxed => "relaxed",
            Self::Stopped => "stopped",
            Self::Faulted => "faulted",
        }
    }
}

impl std::fmt::Display for Mode {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.name())
    }
}
