use std::f64::consts::PI;

use super::GainShape;

/// The gain k over the distance of a master fingertip from its thumb tip (Eq. 14).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Gain {
    /// r1: at and below this distance the mapping is Cartesian, m.
    pub r1: f64,
    /// r2: at and above this distance the mapping is joint-to-joint, m.
    pub r2: f64,
    /// How it falls in between.
    pub shape: GainShape,
}

impl Gain {
    /// k(delta), 1 at r1 and below, 0 at r2 and above, monotone in between; `delta` in m.
    ///
    /// The printed Eq. 14 has `cos(delta pi / (r2 - r1))`, which is discontinuous at both radii (for r2 = 2 r1 it is
    /// even inverted); the argument must start at r1.
    #[must_use]
    pub fn at(&self, delta: f64) -> f64 {
        if delta <= self.r1 {
            1.0
        } else if delta >= self.r2 {
            0.0
        } else {
            let u = (delta - self.r1) / (self.r2 - self.r1);
            match self.shape {
                GainShape::Cosine => 0.5 * (1.0 + (PI * u).cos()),
                GainShape::Quintic => 1.0 - u * u * u * (10.0 - u * (15.0 - 6.0 * u)),
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const PAPER: Gain = Gain { r1: 0.020, r2: 0.040, shape: GainShape::Cosine };

    #[test]
    fn spot_values() {
        assert!((PAPER.at(0.030) - 0.5).abs() < 1e-12);
        assert!((PAPER.at(0.025) - 0.853_553).abs() < 1e-6);
        assert!((PAPER.at(0.035) - 0.146_447).abs() < 1e-6);
        assert_eq!((PAPER.at(0.0), PAPER.at(0.020), PAPER.at(0.040), PAPER.at(1.0)), (1.0, 1.0, 0.0, 0.0));
    }

    proptest! {
        #[test]
        fn is_monotone_continuous_and_point_symmetric(
            u in 0.0..=1.0_f64, step in 0.0..0.01_f64, quintic: bool, r1 in 0.005..0.05_f64, width in 0.002..0.1_f64,
        ) {
            let shape = if quintic { GainShape::Quintic } else { GainShape::Cosine };
            let gain = Gain { r1, r2: r1 + width, shape };
            let k = |u: f64| gain.at(r1 + u * width);
            prop_assert!((k(u) + k(1.0 - u) - 1.0).abs() < 1e-9);
            prop_assert!(k(u + step) <= k(u));
            // Steepest in the middle: pi/2 (cosine) and 15/8 (quintic) per unit of u.
            prop_assert!(k(u) - k(u + step) <= 1.875 * step + 1e-9);
        }
    }
}
