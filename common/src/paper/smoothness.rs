//! Speed, velocity jumps and jerk of a sampled joint motion.

use crate::hand::JointVector;

/// How smooth a motion is, from its samples and their differences; each the worst of all joints.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Smoothness {
    /// Largest joint speed, rad/s.
    pub peak_speed: f64,
    /// Largest change of a joint's velocity from one sample to the next, rad/s.
    pub velocity_jump: f64,
    /// Largest jerk, rad/s³.
    pub peak_jerk: f64,
    /// Root mean square over time of the jerk, rad/s³.
    pub rms_jerk: f64,
}

/// Measures a motion sampled every `period` seconds.
#[must_use]
pub fn measure(samples: &[JointVector], period: f64) -> Smoothness {
    let mut out = Smoothness::default();
    for joint in 0..samples.first().map_or(0, |sample| sample.len()) {
        let q: Vec<f64> = samples.iter().map(|sample| sample[joint]).collect();
        let rate =
            |values: &[f64]| -> Vec<f64> { values.windows(2).map(|pair| (pair[1] - pair[0]) / period).collect() };
        let velocity = rate(&q);
        let acceleration = rate(&velocity);
        let jerk = rate(&acceleration);
        out.peak_speed = out.peak_speed.max(peak(&velocity));
        out.velocity_jump = out.velocity_jump.max(peak(&acceleration) * period);
        out.peak_jerk = out.peak_jerk.max(peak(&jerk));
        let mean_square = jerk.iter().map(|value| value * value).sum::<f64>() / jerk.len().max(1) as f64;
        out.rms_jerk = out.rms_jerk.max(mean_square.sqrt());
    }
    out
}

fn peak(values: &[f64]) -> f64 {
    values.iter().fold(0.0, |peak, value| value.abs().max(peak))
}
