//! Seeded chance.

use std::f64::consts::TAU;

/// A seeded stream of numbers (splitmix64).
#[derive(Clone, Debug)]
pub struct Dice(u64);

impl Dice {
    /// The stream of number `stream` under a seed.
    #[must_use]
    pub const fn new(seed: u64, stream: u64) -> Self {
        Self(seed ^ stream.wrapping_mul(0xa076_1d64_78bd_642f))
    }

    /// Even in 0..1.
    pub fn roll(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut bits = self.0;
        bits = (bits ^ (bits >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        bits = (bits ^ (bits >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((bits ^ (bits >> 31)) >> 11) as f64 / (1_u64 << 53) as f64
    }

    /// A standard normal number from two rolls (Box and Muller).
    pub fn normal(&mut self) -> f64 {
        let (radius, angle) = (1.0 - self.roll(), TAU * self.roll());
        (-2.0 * radius.ln()).sqrt() * angle.cos()
    }
}

/// How probable it is that a standard normal number exceeds `z` (Abramowitz and Stegun 26.2.17, to within 7.5e-8).
#[must_use]
pub fn exceedance(z: f64) -> f64 {
    let t = 1.0 / (1.0 + 0.231_641_9 * z.abs());
    let poly =
        t * (0.319_381_530 + t * (-0.356_563_782 + t * (1.781_477_937 + t * (-1.821_255_978 + t * 1.330_274_429))));
    let tail = poly * (-z * z / 2.0).exp() / TAU.sqrt();
    if z >= 0.0 { tail } else { 1.0 - tail }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn normal_numbers_are_normal() {
        let mut dice = Dice::new(1, 0);
        let numbers: Vec<f64> = (0..100_000).map(|_| dice.normal()).collect();
        let mean = numbers.iter().sum::<f64>() / 1e5;
        let variance = numbers.iter().map(|z| z * z).sum::<f64>() / 1e5;
        assert!(mean.abs() < 0.015 && (variance - 1.0).abs() < 0.02, "{mean}, {variance}");
        for z in [-2.0, -0.5, 0.0, 1.0, 2.5] {
            let share = numbers.iter().filter(|number| **number > z).count() as f64 / 1e5;
            assert!((share - exceedance(z)).abs() < 0.007, "{z}: {share}");
        }
        // Of a table.
        assert!((exceedance(1.959_964) - 0.025).abs() < 1e-6 && (exceedance(-1.0) - 0.841_344_7).abs() < 1e-6);
    }
}
