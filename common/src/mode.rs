//! What the robot is doing, as both ends call it.

/// The robot's mode.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
#[repr(u8)]
pub enum Mode {
    /// Running, no operator seen yet: the hand holds where it was found.
    #[default]
    Idle = 0,
    /// Following the operator's poses.
    Engaged = 1,
    /// Poses stopped, came too late or were not valid: the hand holds its last posture until they are good again.
    Holding = 2,
    /// The hand or the process failed; only a restart ends it.
    Faulted = 3,
}

impl Mode {
    /// All modes, by wire value.
    pub const ALL: [Self; 4] = [Self::Idle, Self::Engaged, Self::Holding, Self::Faulted];

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

    /// Lower-case English name, for people.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Idle => "idle",
            Self::Engaged => "engaged",
            Self::Holding => "holding",
            Self::Faulted => "faulted",
        }
    }
}

impl std::fmt::Display for Mode {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.name())
    }
}
