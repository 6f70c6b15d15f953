//! Round shapes and how far they are apart.

use nalgebra::{Matrix3, Vector3};

/// A segment with a radius; a sphere if its ends are one point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Capsule {
    /// Ends of the axis, m.
    pub ends: [Vector3<f64>; 2],
    /// Radius, m.
    pub radius: f64,
}

/// A box with round edges: everything within `radius` of its core, a smaller box.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RoundedBox {
    /// Centre, m.
    pub center: Vector3<f64>,
    /// Directions of the edges, by column.
    pub edges: Matrix3<f64>,
    /// Half the core's edges, m; may be zero.
    pub half: Vector3<f64>,
    /// Radius of the edges, m.
    pub radius: f64,
}

/// The nearest points of the two axes (for a box: of its core); the gap is their distance less both radii.
pub(crate) type Nearest = [Vector3<f64>; 2];

/// The nearest points of two segments.
///
/// The segment parameters minimise a convex quadratic over the unit square: the best of the first on the free line,
/// clipped, then the second for it, clipped, then the first again.
#[inline]
pub(crate) fn between_segments(a: &[Vector3<f64>; 2], b: &[Vector3<f64>; 2]) -> Nearest {
    let (along_a, along_b, offset) = (a[1] - a[0], b[1] - b[0], a[0] - b[0]);
    let (aa, bb, ab) = (along_a.norm_squared(), along_b.norm_squared(), along_a.dot(&along_b));
    let (ao, bo) = (along_a.dot(&offset), along_b.dot(&offset));
    // A sphere, or parallel segments: any point of the first will do to begin with.
    let share = |up: f64, down: f64| if down > 1e-18 { (up / down).clamp(0.0, 1.0) } else { 0.0 };
    let spread = aa * bb - ab * ab;
    let s = if spread > 1e-9 * aa * bb { share(ab * bo - ao * bb, spread) } else { 0.0 };
    let t = share(ab * s + bo, bb);
    let s = share(ab * t - ao, aa);
    [a[0] + along_a * s, b[0] + along_b * t]
}

impl RoundedBox {
    /// Squared distance of a point and the core, m^2.
    #[inline]
    pub(crate) fn squared(&self, point: &Vector3<f64>) -> f64 {
        let local = self.edges.tr_mul(&(point - self.center));
        local.zip_map(&self.half, |value, half| (value.abs() - half).max(0.0)).norm_squared()
    }

    /// The nearest points of a segment and the core.
    ///
    /// The squared distance along the segment is convex with a derivative that is linear between the planes of the
    /// faces, so its zero is between the two of those crossings that bracket it.
    #[inline]
    pub(crate) fn nearest(&self, segment: &[Vector3<f64>; 2]) -> Nearest {
        let local = segment.map(|end| self.edges.tr_mul(&(end - self.center)));
        let along = local[1] - local[0];
        let inside = |at: Vector3<f64>| at.zip_map(&self.half, |value, half| value.clamp(-half, half));
        let slope = |t: f64| {
            let at = local[0] + along * t;
            along.dot(&(at - inside(at)))
        };
        let (mut low, mut high) = ((0.0, slope(0.0)), (1.0, slope(1.0)));
        let t = if low.1 >= 0.0 {
            0.0
        } else if high.1 <= 0.0 {
            1.0
        } else {
            for axis in (0..3).filter(|&axis| along[axis].abs() > 1e-12) {
                for face in [-self.half[axis], self.half[axis]] {
                    let t = (face - local[0][axis]) / along[axis];
                    if t > low.0 && t < high.0 {
                        let value = slope(t);
                        if value < 0.0 { low = (t, value) } else { high = (t, value) }
                    }
                }
            }
            low.0 - low.1 * (high.0 - low.0) / (high.1 - low.1)
        };
        let at = local[0] + along * t;
        [at, inside(at)].map(|point| self.center + self.edges * point)
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Rotation3;
    use proptest::prelude::*;

    use super::*;

    fn point() -> impl Strategy<Value = Vector3<f64>> {
        prop::array::uniform3(prop_oneof![4 => -0.1..0.1_f64, 1 => Just(0.0), 1 => Just(0.05)]).prop_map(Vector3::from)
    }

    /// Golden section on a convex function of 0..1.
    fn least(f: impl Fn(f64) -> f64) -> f64 {
        let (mut low, mut high) = (0.0, 1.0);
        for _ in 0..80 {
            let third = (high - low) / 3.0;
            if f(low + third) < f(high - third) { high -= third } else { low += third }
        }
        f(0.5 * (low + high)).min(f(0.0)).min(f(1.0))
    }

    proptest! {
        #[test]
        fn segments_are_as_near_as_a_search_finds(a in [point(), point()], b in [point(), point()]) {
            let [p, q] = between_segments(&a, &b);
            let at = |ends: &[Vector3<f64>; 2], t: f64| ends[0] + (ends[1] - ends[0]) * t;
            let best = least(|s| least(|t| (at(&a, s) - at(&b, t)).norm_squared())).sqrt();
            prop_assert!(((q - p).norm() - best).abs() < 1e-6, "{} for {best}", (q - p).norm());
            for (point, ends) in [(p, &a), (q, &b)] {
                let back = least(|t| (at(ends, t) - point).norm_squared());
                prop_assert!(back < 1e-12, "the point is not on its segment");
            }
        }

        #[test]
        fn a_box_is_as_near_as_a_search_finds(
            ends in [point(), point()],
            half in prop::array::uniform3(prop_oneof![Just(0.0), 0.0..0.06_f64]),
            place in point(),
            turn in prop::array::uniform3(-3.0..3.0_f64),
        ) {
            let edges = Rotation3::new(Vector3::from(turn)).into_inner();
            let shape = RoundedBox { center: place, edges, half: Vector3::from(half), radius: 0.0 };
            let [p, q] = shape.nearest(&ends);
            let best = least(|t| shape.squared(&(ends[0] + (ends[1] - ends[0]) * t)))
            .sqrt();
            prop_assert!(((q - p).norm() - best).abs() < 1e-6, "{} for {best}", (q - p).norm());
        }
    }
}
