use nalgebra::Vector3;

/// Width of the bend between touching and parting, m: some of a tracker's noise while fingers touch.
pub(super) const KNEE: f64 = 0.008;

/// Takes out of a finger's vector from the thumb what is not there when the fingers touch.
///
/// A tracker's fingertip keypoints lie inside the fingers, so touching ones read some 15 to 30 mm apart. Shortened to
/// f(delta) v / delta, the vector is zero there, and a human touch is a robot touch. f is zero up to `touch`, delta
/// itself from `release` on. In between it bends within 8 mm into delta less the offset o = touch + 4 mm, as skin parts
/// from skin, and gives the offset back in a smooth step. It is twice continuously differentiable, monotone, never above
/// delta, and its slope is at most `1 + 15/8 o / (release - touch)`: that much a tracker's noise grows.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Contact {
    /// Distance of the keypoints at and below which the fingers touch, m; 0 leaves every vector as it is.
    pub touch: f64,
    /// Distance from which on the vector is as measured, m; above `touch`.
    pub release: f64,
}

impl Contact {
    /// f(delta), m.
    #[must_use]
    pub fn distance(&self, delta: f64) -> f64 {
        if self.touch <= 0.0 || delta >= self.release {
            delta
        } else if delta <= self.touch {
            0.0
        } else {
            let (beyond, width) = (delta - self.touch, self.release - self.touch);
            let knee = KNEE.min(width);
            let (bend, step) = ((beyond / knee).min(1.0), beyond / width);
            let parted = knee * bend.powi(3) * (1.0 - 0.5 * bend) + (beyond - knee).max(0.0);
            parted + (self.touch + 0.5 * knee) * step.powi(3) * (10.0 - step * (15.0 - 6.0 * step))
        }
    }

    /// The shortened vector, m.
    #[must_use]
    pub fn relative(&self, vector: &Vector3<f64>) -> Vector3<f64> {
        let delta = vector.norm();
        let distance = self.distance(delta);
        // Bit for bit the vector itself where there is nothing to take out.
        if distance == delta { *vector } else { vector * (distance / delta) }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn is_smooth_monotone_and_bounded(touch in 0.001..0.03_f64, width in 0.02..0.1_f64, u in -0.5..1.5_f64) {
            let contact = Contact { touch, release: touch + width };
            let f = |delta: f64| contact.distance(delta);
            let delta = (touch + u * width).max(0.0);
            let step = 1e-6;
            prop_assert!((0.0..=delta * (1.0 + 1e-12)).contains(&f(delta)));
            let slope = (f(delta + step) - f(delta)) / step;
            let offset = touch + 0.5 * KNEE;
            prop_assert!(slope >= -1e-9 && slope <= 1.0 + 1.875 * offset / width + 1e-6, "slope {slope}");
            // Slopes a micrometre apart are the same wherever that is, the ends of the band included.
            let bend = f(delta + 2.0 * step) - 2.0 * f(delta + step) + f(delta);
            prop_assert!(bend.abs() / (step * step) <= 1.5 / KNEE + 5.8 * offset / (width * width) + 2.0, "bend {bend}");
        }
    }

    #[test]
    fn touching_is_zero_and_far_apart_is_unchanged() {
        let contact = Contact { touch: 0.02, release: 0.08 };
        assert_eq!(contact.relative(&Vector3::new(0.012, 0.0, -0.016)), Vector3::zeros());
        let far = Vector3::new(0.03, -0.04, 0.07);
        assert_eq!(contact.relative(&far), far);
        // Half way, where half of the offset of 24 mm is given back.
        assert!((contact.distance(0.05) - (0.026 + 0.012)).abs() < 1e-15);
        // It rises gently: 3 mm beyond the touch are half a millimetre.
        assert!(contact.distance(0.023) < 0.5e-3);
        let exact = Contact { touch: 0.0, release: 0.08 };
        let near = Vector3::new(1e-3, 2e-3, -3e-3);
        assert_eq!(exact.relative(&near), near);
        assert_eq!(exact.relative(&Vector3::zeros()), Vector3::zeros());
    }
}
