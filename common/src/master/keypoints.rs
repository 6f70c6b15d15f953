//! The 21 keypoints of a tracked hand and the palm frame they define.

use nalgebra::{Matrix3, Vector3};

use crate::hand::{Finger, HandSide};

/// Names of the keypoints in MediaPipe's order, as in the columns of a CSV recording.
pub const KEYPOINT_NAMES: [&str; 21] = [
    "wrist",
    "thumb_cmc",
    "thumb_mcp",
    "thumb_ip",
    "thumb_tip",
    "index_mcp",
    "index_pip",
    "index_dip",
    "index_tip",
    "middle_mcp",
    "middle_pip",
    "middle_dip",
    "middle_tip",
    "ring_mcp",
    "ring_pip",
    "ring_dip",
    "ring_tip",
    "pinky_mcp",
    "pinky_pip",
    "pinky_dip",
    "pinky_tip",
];

/// Plausible distance from the wrist to the middle knuckle, m.
const PALM_LENGTH: std::ops::RangeInclusive<f64> = 0.030..=0.200;
/// Longest plausible distance between neighbouring keypoints of a finger, m.
const MAX_BONE: f64 = 0.150;
/// Shortest, m: a phalanx's keypoints never coincide.
const MIN_BONE: f64 = 0.0005;
/// Least plausible distance between the knuckles of index and little finger, m.
const MIN_PALM_WIDTH: f64 = 0.010;

/// 21 keypoints of one hand, m, in any one Cartesian frame; finite and of a hand's size.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Keypoints([[f64; 3]; 21]);

/// Why points cannot be those of a hand.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum KeypointsError {
    /// A coordinate is not a number.
    #[error("keypoint {name} has a coordinate that is not finite")]
    NotFinite {
        /// Which keypoint.
        name: &'static str,
    },
    /// The hand is far too large or small.
    #[error("palm (wrist to middle_mcp) is {length} m long; expected 0.03 to 0.2{}", unit_hint(*.length))]
    PalmLength {
        /// The length, m.
        length: f64,
    },
    /// Neighbours coincide or are too far apart.
    #[error("{from} and {to} are {length} m apart; expected 0.0005 to 0.15")]
    BoneLength {
        /// Nearer the wrist.
        from: &'static str,
        /// Nearer the tip.
        to: &'static str,
        /// The distance, m.
        length: f64,
    },
    /// Wrist and knuckles lie on a line: there is no palm.
    #[error("wrist, index_mcp and pinky_mcp span no palm (knuckles {width} m apart across the hand; expected 0.01)")]
    FlatPalm {
        /// Extent across the hand, m.
        width: f64,
    },
}

fn unit_hint(length: f64) -> &'static str {
    match length {
        30.0..=200.0 => "; are the coordinates in millimetres?",
        3.0..=20.0 => "; are the coordinates in centimetres?",
        _ => "",
    }
}

impl Keypoints {
    /// Checks 21 points (m, MediaPipe's order).
    ///
    /// # Errors
    /// Names the first keypoint that is not finite, or the first length no hand has.
    pub fn new(points: [[f64; 3]; 21]) -> Result<Self, KeypointsError> {
        for (point, name) in points.iter().zip(KEYPOINT_NAMES) {
            if !point.iter().all(|x| x.is_finite()) {
                return Err(KeypointsError::NotFinite { name });
            }
        }
        let keypoints = Self(points);
        let length = (keypoints.base(Finger::Middle) - keypoints.wrist()).norm();
        if !PALM_LENGTH.contains(&length) {
            return Err(KeypointsError::PalmLength { length });
        }
        for finger in Finger::ALL {
            let start = 1 + finger.index() * 4;
            let chain = [0, start, start + 1, start + 2, start + 3];
            for pair in chain.windows(2) {
                let length = (keypoints.point(pair[1]) - keypoints.point(pair[0])).norm();
                let longest = if pair[0] == 0 { *PALM_LENGTH.end() } else { MAX_BONE };
                if !(MIN_BONE..=longest).contains(&length) {
                    let (from, to) = (KEYPOINT_NAMES[pair[0]], KEYPOINT_NAMES[pair[1]]);
                    return Err(KeypointsError::BoneLength { from, to, length });
                }
            }
        }
        let distal = (keypoints.base(Finger::Middle) - keypoints.wrist()) / length;
        let across = keypoints.base(Finger::Index) - keypoints.base(Finger::Little);
        let width = (across - distal * across.dot(&distal)).norm();
        if !(width >= MIN_PALM_WIDTH && keypoints.palm_area().cross(&distal).norm() > 0.0) {
            return Err(KeypointsError::FlatPalm { width });
        }
        Ok(keypoints)
    }

    /// The points, m.
    #[must_use]
    pub const fn points(&self) -> &[[f64; 3]; 21] {
        &self.0
    }

    /// The wrist, m.
    #[must_use]
    pub fn wrist(&self) -> Vector3<f64> {
        self.point(0)
    }

    /// A finger's base, PIP, DIP and tip (thumb: CMC, MCP, IP, tip), m.
    #[must_use]
    pub fn finger(&self, finger: Finger) -> [Vector3<f64>; 4] {
        let start = 1 + finger.index() * 4;
        [self.point(start), self.point(start + 1), self.point(start + 2), self.point(start + 3)]
    }

    /// The same hand seen in a mirror: x negated.
    #[must_use]
    pub fn mirrored(&self) -> Self {
        Self(self.0.map(|[x, y, z]| [-x, y, z]))
    }

    pub(super) fn base(&self, finger: Finger) -> Vector3<f64> {
        self.point(1 + finger.index() * 4)
    }

    /// Twice the area vector of the polygon wrist, index, middle, ring, little MCP: it uses every knuckle, so it
    /// is steadier than the normal of any three. It points out of the palm of a right hand, out of the back of a
    /// left one.
    fn palm_area(&self) -> Vector3<f64> {
        let wrist = self.wrist();
        let spoke = |finger| self.base(finger) - wrist;
        spoke(Finger::Index).cross(&spoke(Finger::Middle))
            + spoke(Finger::Middle).cross(&spoke(Finger::Ring))
            + spoke(Finger::Ring).cross(&spoke(Finger::Little))
    }

    fn point(&self, index: usize) -> Vector3<f64> {
        Vector3::from(self.0[index])
    }
}

/// The palm in the frame of the keypoints. Right-handed whichever hand it is: `normal` is palmar for a right hand
/// and dorsal for a left one.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PalmFrame {
    /// The wrist, m.
    pub origin: Vector3<f64>,
    /// Unit vector towards the thumb side.
    pub radial: Vector3<f64>,
    /// Unit vector from the wrist to the middle knuckle.
    pub distal: Vector3<f64>,
    /// Unit vector, `radial` x `distal`.
    pub normal: Vector3<f64>,
}

impl PalmFrame {
    /// From the wrist and the four knuckles, whatever the fingers do.
    #[must_use]
    pub fn estimate(keypoints: &Keypoints) -> Self {
        let origin = keypoints.wrist();
        let distal = (keypoints.base(Finger::Middle) - origin).normalize();
        // Keypoints::new has refused palms for which this is zero.
        let radial = distal.cross(&keypoints.palm_area()).normalize();
        Self { origin, radial, distal, normal: radial.cross(&distal) }
    }

    /// `point` (m, frame of the keypoints) in O_W of a hand of this side: radial, distal, palmar.
    #[must_use]
    pub fn to_hand(&self, side: HandSide, point: &Vector3<f64>) -> Vector3<f64> {
        let offset = point - self.origin;
        let palmar = match side {
            HandSide::Right => self.normal,
            HandSide::Left => -self.normal,
        };
        Vector3::new(offset.dot(&self.radial), offset.dot(&self.distal), offset.dot(&palmar))
    }

    /// Columns normal, radial, distal: the identity for keypoints in the palm frame of the recordings.
    #[must_use]
    pub fn rotation(&self) -> Matrix3<f64> {
        Matrix3::from_columns(&[self.normal, self.radial, self.distal])
    }
}
