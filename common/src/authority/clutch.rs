use std::time::Duration;

use serde::Deserialize;

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

/// What another program says about the clutch: a pedal, a button.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ClutchInput {
    /// Whether the robot may follow.
    pub closed: bool,
    /// After this time it opens unless this is said again: a deadman pedal.
    pub lasts: Option<Duration>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RawClutch {
    closed: bool,
    #[serde(rename = "for")]
    lasts: Option<f64>,
}

impl ClutchInput {
    /// Of JSON: `{"closed": true}`, or `{"closed": true, "for": 0.3}` for 0.3 s.
    ///
    /// # Errors
    /// Names the field that is missing or unknown, or the time that is none from 0.01 to 60 s.
    pub fn parse(bytes: &[u8]) -> Result<Self, String> {
        let raw: RawClutch = serde_json::from_slice(bytes).map_err(|error| error.to_string())?;
        let lasts = match raw.lasts {
            None => None,
            Some(seconds) if (0.01..=60.0).contains(&seconds) => Some(Duration::from_secs_f64(seconds)),
            Some(seconds) => return Err(format!("for is {seconds}, it must be 0.01 to 60 s")),
        };
        Ok(Self { closed: raw.closed, lasts })
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

    #[test]
    fn other_programs_say_it_in_json() {
        let parse = |text: &str| ClutchInput::parse(text.as_bytes());
        assert_eq!(parse("{\"closed\": true}"), Ok(ClutchInput { closed: true, lasts: None }));
        let pedal = ClutchInput { closed: true, lasts: Some(Duration::from_millis(300)) };
        assert_eq!(parse("{\"closed\": true, \"for\": 0.3}"), Ok(pedal));
        for (bad, why) in [
            ("{}", "missing field `closed`"),
            ("{\"closed\": 1}", "expected a boolean"),
            ("{\"closed\": true, \"open\": false}", "unknown field `open`"),
            ("{\"closed\": true, \"for\": -1}", "for is -1, it must be 0.01 to 60 s"),
            ("{\"closed\": true, \"for\": 1e300}", "it must be 0.01 to 60 s"),
            ("\u{1}", "expected value"),
        ] {
            let error = parse(bad).unwrap_err();
            assert!(error.contains(why), "{bad}: {error}");
        }
    }
}
