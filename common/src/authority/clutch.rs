use crate::mode::Mode;

/// The operator's clutch (deadman switch): how often it was moved. Odd: closed, the robot may follow. Even: open.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Clutch(pub u32);

impl Clutch {
    /// Whether the robot may follow.
    #[must_use]
    pub const fn is_closed(self) -> bool {
        self.0 % 2 == 1
    }

    /// Closed if it was open.
    #[must_use]
    pub const fn close(self) -> Self {
        if self.is_closed() { self } else { Self(self.0.wrapping_add(1)) }
    }

    /// Open if it was closed.
    #[must_use]
    pub const fn open(self) -> Self {
        if self.is_closed() { Self(self.0.wrapping_add(1)) } else { self }
    }

    /// As an operator moves it that wants to be followed at once and always, and sees what the robot does without delay:
    /// closed when the robot is ready, opened after a hold. For simulations; in front of a real hand a person decides.
    #[must_use]
    pub const fn eager(self, robot: Mode) -> Self {
        if matches!(robot, Mode::Armed) || robot.follows() { self.close() } else { self.open() }
    }

    /// Whether it is closed now and was moved since it stood at `before`.
    ///
    /// Counts wrap; of two of them the one less than half the range ahead is the newer.
    #[must_use]
    pub const fn closed_since(self, before: Self) -> bool {
        let moved = self.0.wrapping_sub(before.0);
        self.is_closed() && moved != 0 && moved < u32::MAX / 2
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_counts_its_movements() {
        let open = Clutch::default();
        assert!(!open.is_closed());
        assert_eq!(open.close(), Clutch(1));
        assert_eq!(open.close().close(), Clutch(1));
        assert_eq!(open.close().open(), Clutch(2));
        assert_eq!(open.open(), open);
    }

    #[test]
    fn only_a_new_closing_counts() {
        assert!(Clutch(1).closed_since(Clutch(0)));
        assert!(!Clutch(1).closed_since(Clutch(1)));
        assert!(!Clutch(2).closed_since(Clutch(1)));
        assert!(Clutch(3).closed_since(Clutch(1)));
        assert!(!Clutch(1).closed_since(Clutch(3)), "an old one");
        assert!(Clutch(1).closed_since(Clutch(u32::MAX)), "after a wrap");
    }
}
