//! Fig. 4: the gain over the distance between thumb and fingertip.

use std::f64::consts::PI;

use crate::mapping::Gain;

/// Eq. 14 to the letter, for comparison with [`Gain::at`]; `delta` in m.
///
/// Its cosine starts at 0 and not at r1, so for r2 = 2 r1 it rises from 0 to 1 where it should fall from 1 to 0.
#[must_use]
pub fn as_printed(gain: &Gain, delta: f64) -> f64 {
    if delta < gain.r1 {
        1.0
    } else if delta > gain.r2 {
        0.0
    } else {
        0.5 * (1.0 + (delta * PI / (gain.r2 - gain.r1)).cos())
    }
}
