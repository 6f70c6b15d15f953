//! Table 1: the hands' phalanx lengths, and the ratios that the Cartesian mapping takes from them.

use nalgebra::{Matrix3, Vector3};

use crate::hand::{Finger, FingerChain, HandModel};
use crate::master::MasterGeometry;

/// a_S1..3 of the Allegro Hand as printed in Table 1, proximal to distal, m; one row per finger, thumb first.
pub const ALLEGRO: [(Finger, [f64; 3]); 4] = [
    (Finger::Thumb, [0.057, 0.051, 0.054]),
    (Finger::Index, [0.054, 0.038, 0.038]),
    (Finger::Middle, [0.054, 0.038, 0.038]),
    (Finger::Ring, [0.054, 0.038, 0.038]),
];

/// c_s of the printed lengths: the thumbs' lengths, slave to master (162 mm to 60 mm).
#[must_use]
pub fn printed_scale() -> f64 {
    let [(_, thumb), ..] = ALLEGRO;
    thumb.iter().sum::<f64>() / MasterGeometry::PARADIGMATIC.phalanges[Finger::Thumb.index()].iter().sum::<f64>()
}

/// a_S1..3 of a finger of the model, proximal to distal, m: measured along the stretched finger from its base to the
/// last joint but one, from there to the last joint, and to the pole of the fingertip. `None` below two joints.
#[must_use]
pub fn lengths(hand: &HandModel, chain: &FingerChain) -> Option<[f64; 3]> {
    let points = points(hand, chain, &[0.0; crate::hand::MAX_FINGER_JOINTS]);
    let [.., second, third, tip] = points[..] else { return None };
    let distal = (tip - third).normalize();
    Some([(second - chain.base).dot(&distal), (third - second).norm(), (tip - third).norm()])
}

/// d_{l,t} of Eq. 10: spacings of neighbouring finger bases, slave to master.
#[must_use]
pub fn spacing_ratios(hand: &HandModel, geometry: &MasterGeometry) -> Vec<(Finger, Finger, f64)> {
    let fingers: Vec<_> = hand.fingers.iter().filter(|chain| chain.finger != Finger::Thumb).collect();
    let base = |finger: Finger| geometry.bases[finger.index()][0];
    fingers
        .windows(2)
        .map(|pair| {
            let ratio = (pair[0].base.x - pair[1].base.x) / (base(pair[0].finger) - base(pair[1].finger));
            (pair[0].finger, pair[1].finger, ratio)
        })
        .collect()
}

/// Origins of a finger's joints, palm outwards, and the pole of its tip, in O_SW, m; `own` are its joint angles, rad.
#[must_use]
pub fn points(hand: &HandModel, chain: &FingerChain, own: &[f64]) -> Vec<Vector3<f64>> {
    let (mut position, mut rotation) = (Vector3::zeros(), Matrix3::identity());
    let mut points = Vec::with_capacity(chain.joints.len() + 1);
    for (joint, &angle) in chain.joints.iter().zip(own) {
        position += rotation * joint.translation;
        rotation *= joint.rotation_at(angle);
        points.push(hand.anatomical_from_palm * position);
    }
    points.push(hand.anatomical_from_palm * (position + rotation * chain.pole));
    points
}
