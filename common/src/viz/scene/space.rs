//! Geometry for the 3D views. Both hands are shown palm towards the viewer, fingers up: x right, y up (distal), z
//! towards the viewer (palmar).

use nalgebra::{Matrix3, UnitQuaternion, Vector3};
use rerun::Quaternion;

use crate::hand::{HandModel, HandSide};

/// A human point from O_W into the view. O_W is radial-distal-palmar for either hand, so a left hand is mirrored here.
pub(in crate::viz) fn from_master(point: &Vector3<f64>, side: HandSide) -> Vector3<f64> {
    match side {
        HandSide::Right => *point,
        HandSide::Left => Vector3::new(-point.x, point.y, point.z),
    }
}

/// Rotation from the palm frame into the view: a proper one for either hand.
pub(super) fn from_palm(hand: &HandModel) -> UnitQuaternion<f64> {
    let distal = hand.anatomical_from_palm.row(1).transpose();
    let palmar = hand.anatomical_from_palm.row(2).transpose();
    let right = distal.cross(&palmar);
    UnitQuaternion::from_matrix(&Matrix3::from_columns(&[right, distal, palmar]).transpose())
}

/// The rotation that takes z to `direction`; the identity if that is zero.
pub(super) fn along(direction: &Vector3<f64>) -> UnitQuaternion<f64> {
    if direction.norm_squared() < 1e-18 {
        return UnitQuaternion::identity();
    }
    UnitQuaternion::rotation_between(&Vector3::z(), direction)
        .unwrap_or_else(|| UnitQuaternion::from_axis_angle(&Vector3::x_axis(), std::f64::consts::PI))
}

pub(in crate::viz) fn point(v: &Vector3<f64>) -> [f32; 3] {
    [v.x as f32, v.y as f32, v.z as f32]
}

pub(super) fn quaternion(q: &UnitQuaternion<f64>) -> Quaternion {
    let v = q.as_vector();
    Quaternion::from_xyzw([v.x as f32, v.y as f32, v.z as f32, v.w as f32])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn both_hands_are_seen_from_the_palm_with_the_fingers_up() {
        for (side, thumb_side) in [(HandSide::Right, 1.0), (HandSide::Left, -1.0)] {
            let hand = HandModel::allegro_v4(side);
            let turn = from_palm(&hand);
            let [thumb, middle] = [0, 2].map(|i| {
                let finger = &hand.fingers[i];
                turn * finger.tip(&finger.select(&hand.home()), crate::hand::TipFrame::Pole)
            });
            assert!(middle.y > 0.1 && thumb.y < middle.y, "{side:?}: {middle}");
            assert!((thumb.x - middle.x) * thumb_side > 0.05, "{side:?}: {thumb} {middle}");
            let palmar = turn * (hand.anatomical_from_palm.transpose() * Vector3::z());
            assert!((palmar - Vector3::z()).norm() < 1e-9, "{side:?}: {palmar}");
            assert!(from_master(&Vector3::x(), side).x * thumb_side > 0.0);
        }
    }

    #[test]
    fn along_turns_z_into_any_direction() {
        for direction in [Vector3::x(), -Vector3::z(), Vector3::z(), Vector3::new(1.0, -2.0, 0.5)] {
            let turned = along(&direction) * Vector3::z();
            assert!((turned - direction.normalize()).norm() < 1e-12, "{direction}");
        }
        assert_eq!(along(&Vector3::zeros()), UnitQuaternion::identity());
    }
}
