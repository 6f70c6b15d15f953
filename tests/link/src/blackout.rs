//! When nothing passes.

use std::fmt;
use std::str::FromStr;
use std::time::Duration;

use crate::Invalid;

/// Most windows of one schedule.
const MOST: usize = 1000;

/// A schedule of blackouts, in time since the link's start. The default is none.
///
/// As text either windows in seconds, `10..12, 30..31.5`, or a period, `every 20 for 1`: dark for 1 s after 20, 40, 60 ...
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Blackouts {
    /// `[from, to)`, in order, apart from each other.
    windows: Vec<(Duration, Duration)>,
    /// Period and length of those that return.
    every: Option<(Duration, Duration)>,
}

impl Blackouts {
    /// Dark in each `[from, to)`.
    ///
    /// # Errors
    /// If a window is empty, they are not in order, or there are more than 1000.
    pub fn windows(windows: Vec<(Duration, Duration)>) -> Result<Self, Invalid> {
        if windows.len() > MOST {
            return Err(Invalid(format!("{} blackouts: at most {MOST}", windows.len())));
        }
        let mut end = Duration::ZERO;
        for (from, to) in &windows {
            if from >= to || *from < end {
                return Err(Invalid(format!(
                    "blackout {}..{}: must end after it begins, and begin after the one before has ended",
                    from.as_secs_f64(),
                    to.as_secs_f64()
                )));
            }
            end = *to;
        }
        Ok(Self { windows, every: None })
    }

    /// Dark for `length` after each whole `period`.
    ///
    /// # Errors
    /// If the length is zero or not below the period.
    pub fn every(period: Duration, length: Duration) -> Result<Self, Invalid> {
        if length.is_zero() || length >= period {
            let [period, length] = [period, length].map(|time| time.as_secs_f64());
            return Err(Invalid(format!("blackout every {period} for {length}: must be shorter than its period")));
        }
        Ok(Self { windows: Vec::new(), every: Some((period, length)) })
    }

    /// Whether there is any.
    #[must_use]
    pub const fn is_empty(&self) -> bool {
        self.windows.is_empty() && self.every.is_none()
    }

    /// Whether nothing passes at `time`.
    #[must_use]
    pub fn dark(&self, time: Duration) -> bool {
        self.lit_after(time) > time
    }

    /// The first time from `time` on at which something passes.
    #[must_use]
    pub fn lit_after(&self, time: Duration) -> Duration {
        let mut lit = time;
        let next = self.windows.partition_point(|(_, to)| *to <= lit);
        for (from, to) in &self.windows[next..] {
            if lit < *from {
                break;
            }
            lit = *to;
        }
        if let Some((period, length)) = self.every {
            let phase = Duration::from_nanos((lit.as_nanos() % period.as_nanos()) as u64);
            if lit >= period && phase < length {
                lit += length - phase;
            }
        }
        lit
    }
}

impl FromStr for Blackouts {
    type Err = Invalid;

    fn from_str(text: &str) -> Result<Self, Invalid> {
        let wrong = || Invalid(format!("blackout {text:?}: write 10..12,30..31 or \"every 20 for 1\", in seconds"));
        let seconds = |text: &str| {
            let time = text.trim().parse().ok().filter(|time| (0.0..=1e7).contains(time));
            time.map(Duration::from_secs_f64).ok_or_else(wrong)
        };
        if let Some(rest) = text.trim().strip_prefix("every") {
            let (period, length) = rest.split_once("for").ok_or_else(wrong)?;
            return Self::every(seconds(period)?, seconds(length)?);
        }
        let window = |part: &str| {
            let (from, to) = part.split_once("..").ok_or_else(wrong)?;
            Ok((seconds(from)?, seconds(to)?))
        };
        Self::windows(text.split(',').map(window).collect::<Result<_, Invalid>>()?)
    }
}

/// As it is read.
impl fmt::Display for Blackouts {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if let Some((period, length)) = self.every {
            return write!(f, "every {} for {}", period.as_secs_f64(), length.as_secs_f64());
        }
        for (index, (from, to)) in self.windows.iter().enumerate() {
            let comma = if index == 0 { "" } else { "," };
            write!(f, "{comma}{}..{}", from.as_secs_f64(), to.as_secs_f64())?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(schedule: &str, seconds: f64) -> f64 {
        let schedule: Blackouts = schedule.parse().unwrap();
        let time = Duration::from_secs_f64(seconds);
        assert_eq!(schedule.dark(time), schedule.lit_after(time) != time);
        schedule.lit_after(time).as_secs_f64()
    }

    #[test]
    fn windows_and_periods() {
        for (time, lit) in
            [(0.0, 0.0), (9.9, 9.9), (10.0, 12.0), (11.9, 12.0), (12.0, 12.0), (30.2, 31.5), (99.0, 99.0)]
        {
            assert_eq!(at("10..12, 30..31.5", time), lit, "{time}");
        }
        // Two that touch are one.
        assert_eq!(at("1..2,2..3", 1.5), 3.0);
        for (time, lit) in [(0.0, 0.0), (0.5, 0.5), (19.9, 19.9), (20.0, 21.0), (21.0, 21.0), (400.5, 401.0)] {
            assert_eq!(at("every 20 for 1", time), lit, "{time}");
        }
    }

    #[test]
    fn text_goes_both_ways_and_nonsense_is_refused() {
        for text in ["10..12,30..31.5", "every 20 for 0.5"] {
            assert_eq!(text.parse::<Blackouts>().unwrap().to_string(), text);
        }
        for text in
            ["", "10", "10..", "12..10", "1..3,2..4", "every 1", "every 1 for 1", "every 0 for 0", "-1..2", "nan..1"]
        {
            let error = text.parse::<Blackouts>().unwrap_err().to_string();
            assert!(error.contains("blackout"), "{text}: {error}");
        }
    }
}
