use nalgebra::Vector3;

/// Takes out of a finger's vector from the thumb what is not there when the fingers touch.
///
/// A tracker's fingertip keypoints lie inside the fingers, so touching ones read some 15 to 28 mm apart. Shortened to
/// f(delta) v / delta, the vector is zero there, and a human touch is a robot touch. f is zero up to `touch`, delta
/// itself from `release` on, and in between the polynomial of fifth degree that has value, slope and curvature of
/// either side: twice continuously differentiable, monotone, never above delta. Its slope is at most
/// `1.512 + 15/8 touch / (release - touch)`: that much the tracker's noise grows where it is steepest.
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
            let width = self.release - self.touch;
            let u = (delta - self.touch) / width;
            u * u * u * (self.touch * (10.0 - u * (15.0 - 6.0 * u)) + width * (6.0 - u * (8.0 - 3.0 * u)))
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
            prop_assert!(slope >= -1e-9 && slope <= 1.512 + 1.875 * touch / width + 1e-6, "slope {slope}");
            // Two steps of a micrometre see the same slope wherever they are, the ends of the band included:
            // curvature is bounded, |S''| by 5.8 and |B''| by 4.1.
            let curvature = (f(delta + 2.0 * step) - 2.0 * f(delta + step) + f(delta)) / step;
            prop_assert!(curvature.abs() <= step * (5.8 * touch / width + 4.1) / width + 1e-9, "jump {curvature}");
        }
    }

    #[test]
    fn touching_is_zero_and_far_apart_is_unchanged() {
        let contact = Contact { touch: 0.02, release: 0.08 };
        assert_eq!(contact.relative(&Vector3::new(0.012, 0.0, -0.016)), Vector3::zeros());
        let far = Vector3::new(0.03, -0.04, 0.07);
        assert_eq!(contact.relative(&far), far);
        // Half way: f = (0.02 + 0.06 (6 - 4 + 0.75) / 4) / 2.
        assert!((contact.distance(0.05) - (0.01 + 0.06 * 2.75 / 8.0)).abs() < 1e-15);
        // It rises gently: 5 mm beyond the touch are half a millimetre.
        assert!(contact.distance(0.025) < 0.5e-3);
        let exact = Contact { touch: 0.0, release: 0.08 };
        let near = Vector3::new(1e-3, 2e-3, -3e-3);
        assert_eq!(exact.relative(&near), near);
        assert_eq!(exact.relative(&Vector3::zeros()), Vector3::zeros());
    }
}
