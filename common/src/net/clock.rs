//! The clocks of this process.

use std::hash::{BuildHasher, Hasher, RandomState};
use std::time::{SystemTime, UNIX_EPOCH};

use rustix::time::{ClockId, clock_gettime};

use crate::time::MonoTime;

/// Now, by `CLOCK_MONOTONIC`: the same clock in all processes of a host, stopped while the host is suspended.
#[must_use]
pub fn now() -> MonoTime {
    let time = clock_gettime(ClockId::Monotonic);
    MonoTime(u64::try_from(i128::from(time.tv_sec) * 1_000_000_000 + i128::from(time.tv_nsec)).unwrap_or(0))
}

/// UNIX time minus monotonic time, ns: labels recordings and log lines; it jumps when the wall clock is set.
#[must_use]
pub fn wall_offset_ns() -> i64 {
    let before = i128::from(now().0);
    let wall = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |wall| wall.as_nanos() as i128);
    let after = i128::from(now().0);
    i64::try_from(wall - before - (after - before) / 2).unwrap_or(0)
}

/// A random number, not 0, to tell this start of this process from all others.
#[must_use]
pub fn random_epoch() -> u64 {
    // The standard library seeds its hash maps from the operating system.
    RandomState::new().build_hasher().finish().max(1)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn clocks() {
        let first = now();
        assert!(first.0 > 0 && now() >= first);
        let wall = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH).unwrap().as_nanos() as i128;
        let ours = i128::from(now().0) + i128::from(wall_offset_ns());
        assert!((ours - wall).abs() < 1_000_000_000, "{ours} {wall}");
        assert_ne!(random_epoch(), random_epoch());
    }
}
