use std::f64::consts::{FRAC_PI_2, PI, TAU};

use nalgebra::{SMatrix, Vector3};

use crate::hand::{Finger, MAX_FINGERS};
use crate::mapping::{Tuning, TuningError};

/// Largest magnitude of a joint angle that is taken as an angle at all, rad: a generous whole turn.
pub const MAX_ANGLE: f64 = TAU;
/// Shortest phalanx taken as one of a hand, m.
const MIN_PHALANX: f64 = 0.003;
/// Longest phalanx taken as one of a hand, m.
const MAX_PHALANX: f64 = 0.150;
/// Farthest a finger's base may be from the wrist, m.
const MAX_BASE: f64 = 0.25;
/// Least radial distance between neighbouring finger bases, m; the mapping divides by it (Eq. 10).
const MIN_BASE_SPACING: f64 = 0.001;

/// Derivatives of a finger's PIP (rows 0-2), DIP (3-5) and tip (6-8) in O_W by its four joint angles, m/rad.
pub type FingerJacobian = SMatrix<f64, 9, 4>;

/// Range of one joint, rad.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct JointRange {
    /// Smallest angle.
    pub min: f64,
    /// Largest angle.
    pub max: f64,
}

impl JointRange {
    /// From degrees.
    pub(super) const fn deg(min: f64, max: f64) -> Self {
        Self { min: min.to_radians(), max: max.to_radians() }
    }

    /// True if `angle` is inside, bounds included.
    #[must_use]
    pub fn contains(&self, angle: f64) -> bool {
        (self.min..=self.max).contains(&angle)
    }
}

/// Joint ranges of the paradigmatic hand, as the authors' later software has them, in the signs used here.
///
/// The thumb's IP joint bends to either side, because its axis is orthogonal to the one before.
pub const JOINT_LIMITS: [[JointRange; 4]; MAX_FINGERS] = {
    const FINGER: [JointRange; 4] = [
        JointRange::deg(-15.0, 15.0),
        JointRange::deg(0.0, 85.0),
        JointRange::deg(0.0, 110.0),
        JointRange::deg(0.0, 70.0),
    ];
    const THUMB: [JointRange; 4] = [
        JointRange { min: 0.0, max: PI },
        JointRange::deg(0.0, 120.0),
        JointRange { min: 0.0, max: FRAC_PI_2 },
        JointRange::deg(-70.0, 70.0),
    ];
    [THUMB, FINGER, FINGER, FINGER, FINGER]
};

/// Why a master pose or geometry cannot be that of a hand.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum MasterError {
    /// A joint angle that is not finite or beyond [`MAX_ANGLE`].
    #[error("joint {joint} of the {} is {value} rad; angles are finite and within +-2 pi", finger.name())]
    Angle {
        /// Its finger.
        finger: Finger,
        /// Which of the four.
        joint: usize,
        /// The angle.
        value: f64,
    },
    /// A phalanx no hand has.
    #[error("phalanx {phalanx} of the {} is {value} m long; expected 0.003 to 0.150 (metres)", finger.name())]
    Phalanx {
        /// Its finger.
        finger: Finger,
        /// 0 proximal to 2 distal.
        phalanx: usize,
        /// Its length, m.
        value: f64,
    },
    /// A finger base that is not finite or too far from the wrist.
    #[error("base of the {} is at {position:?} m; expected within 0.25 m of the wrist", finger.name())]
    Base {
        /// Its finger.
        finger: Finger,
        /// Where it is, m.
        position: [f64; 3],
    },
    /// A tuning no operator can have.
    #[error(transparent)]
    Tuning(#[from] TuningError),
    /// Finger bases that are not in the order index, middle, ring, little from radial to ulnar.
    #[error(
        "base of the {} (x {x} m) must lie at least 1 mm radial of the {}'s (x {next_x} m); x points to the thumb side",
        finger.name(), next.name()
    )]
    BaseOrder {
        /// The finger that should be radial.
        finger: Finger,
        /// Its ulnar neighbour.
        next: Finger,
        /// The finger's x, m.
        x: f64,
        /// The neighbour's x, m.
        next_x: f64,
    },
}

/// Sizes of a paradigmatic hand: a person's, or Table 1's.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MasterGeometry {
    /// o_i: origin of each finger's base frame in O_W, m.
    pub bases: [[f64; 3]; 5],
    /// a_i1..3: phalanx lengths, m.
    pub phalanges: [[f64; 3]; 5],
}

/// A posture of the human hand, with the hand it belongs to.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MasterPose {
    /// Joint angles, rad.
    pub q: [f64; 20],
    /// The hand.
    pub geometry: MasterGeometry,
    /// What the mapping should know about the operator; `None` leaves it to the robot.
    pub tuning: Option<Tuning>,
}

impl MasterGeometry {
    /// The paradigmatic hand of the paper (Table 1; bases of SynGrasp turned into O_W).
    pub const PARADIGMATIC: Self = Self {
        bases: [
            [0.037, 0.045, 0.0],
            [0.024, 0.073, 0.0],
            [0.008, 0.073, 0.0],
            [-0.008, 0.073, 0.0],
            [-0.024, 0.073, 0.0],
        ],
        phalanges: [
            [0.025, 0.020, 0.015],
            [0.037, 0.030, 0.015],
            [0.040, 0.035, 0.017],
            [0.037, 0.030, 0.015],
            [0.027, 0.025, 0.010],
        ],
    };

    /// The four points of a finger in O_W (m): base (MCP, CMC for the thumb), PIP (MCP), DIP (IP), tip.
    ///
    /// `q` are the finger's four joint angles, rad. Closed forms of the Denavit-Hartenberg product of SynGrasp's
    /// paradigmatic hand.
    #[must_use]
    pub fn finger_points(&self, finger: Finger, q: &[f64; 4]) -> [Vector3<f64>; 4] {
        let base = Vector3::from(self.bases[finger.index()]);
        let [a1, a2, a3] = self.phalanges[finger.index()];
        let (s0, c0) = q[0].sin_cos();
        let (s1, c1) = q[1].sin_cos();
        let (s2, c2) = (q[1] + q[2]).sin_cos();
        // In the finger's plane: `along` in the palm's plane, `up` palmar.
        let along = Vector3::new(s0, c0, 0.0);
        let up = Vector3::z();
        let second = base + (along * c1 + up * s1) * a1;
        let direction = along * c2 + up * s2;
        let third = second + direction * a2;
        let tip = if finger == Finger::Thumb {
            // The thumb's last axis is orthogonal to the ones before it: it bends out of the finger's plane.
            let (s3, c3) = q[3].sin_cos();
            third + (direction * c3 + Vector3::new(c0, -s0, 0.0) * s3) * a3
        } else {
            let (s3, c3) = (q[1] + q[2] + q[3]).sin_cos();
            third + (along * c3 + up * s3) * a3
        };
        [base, second, third, tip]
    }

    /// Derivatives of PIP, DIP and tip by the finger's joint angles `q` (rad), with the points themselves.
    #[must_use]
    pub fn finger_jacobian(&self, finger: Finger, q: &[f64; 4]) -> ([Vector3<f64>; 4], FingerJacobian) {
        let base = Vector3::from(self.bases[finger.index()]);
        let [a1, a2, a3] = self.phalanges[finger.index()];
        let (s0, c0) = q[0].sin_cos();
        let (s1, c1) = q[1].sin_cos();
        let (s2, c2) = (q[1] + q[2]).sin_cos();
        let along = Vector3::new(s0, c0, 0.0);
        let side = Vector3::new(c0, -s0, 0.0);
        let up = Vector3::z();
        // Directions of the phalanges, and those directions turned by a quarter in the finger's plane.
        let d1 = along * c1 + up * s1;
        let t1 = (up * c1 - along * s1) * a1;
        let d2 = along * c2 + up * s2;
        let t2 = (up * c2 - along * s2) * a2;
        let second = base + d1 * a1;
        let third = second + d2 * a2;
        let side1 = side * (c1 * a1);
        let side2 = side1 + side * (c2 * a2);

        let (tip, tip_side, tip_flexion, tip_last) = if finger == Finger::Thumb {
            let (s3, c3) = q[3].sin_cos();
            let d3 = d2 * c3 + side * s3;
            let turned = (side * (c2 * c3) - along * s3) * a3;
            (third + d3 * a3, turned, (up * c2 - along * s2) * (c3 * a3), (side * c3 - d2 * s3) * a3)
        } else {
            let (s3, c3) = (q[1] + q[2] + q[3]).sin_cos();
            let t3 = (up * c3 - along * s3) * a3;
            (third + (along * c3 + up * s3) * a3, side * (c3 * a3), t3, t3)
        };
        let mut jacobian = FingerJacobian::zeros();
        jacobian.fixed_view_mut::<3, 1>(0, 0).copy_from(&side1);
        jacobian.fixed_view_mut::<3, 1>(0, 1).copy_from(&t1);
        jacobian.fixed_view_mut::<3, 1>(3, 0).copy_from(&side2);
        jacobian.fixed_view_mut::<3, 1>(3, 1).copy_from(&(t1 + t2));
        jacobian.fixed_view_mut::<3, 1>(3, 2).copy_from(&t2);
        jacobian.fixed_view_mut::<3, 1>(6, 0).copy_from(&(side2 + tip_side));
        jacobian.fixed_view_mut::<3, 1>(6, 1).copy_from(&(t1 + t2 + tip_flexion));
        jacobian.fixed_view_mut::<3, 1>(6, 2).copy_from(&(t2 + tip_flexion));
        jacobian.fixed_view_mut::<3, 1>(6, 3).copy_from(&tip_last);
        ([base, second, third, tip], jacobian)
    }

    /// Checks that this can be a hand, as data from a file or the network must be.
    ///
    /// # Errors
    /// Names the first phalanx or base that is not finite, out of its range or out of order.
    pub fn validate(&self) -> Result<(), MasterError> {
        for finger in Finger::ALL {
            let position = self.bases[finger.index()];
            // A range, so that NaN fails too.
            if !(0.0..=MAX_BASE).contains(&Vector3::from(position).norm()) {
                return Err(MasterError::Base { finger, position });
            }
            for (phalanx, &value) in self.phalanges[finger.index()].iter().enumerate() {
                if !(MIN_PHALANX..=MAX_PHALANX).contains(&value) {
                    return Err(MasterError::Phalanx { finger, phalanx, value });
                }
            }
        }
        for pair in [[Finger::Index, Finger::Middle], [Finger::Middle, Finger::Ring], [Finger::Ring, Finger::Little]] {
            let [finger, next] = pair;
            let (x, next_x) = (self.bases[finger.index()][0], self.bases[next.index()][0]);
            if x - next_x < MIN_BASE_SPACING {
                return Err(MasterError::BaseOrder { finger, next, x, next_x });
            }
        }
        Ok(())
    }
}

impl MasterPose {
    /// The finger's four joint angles, rad.
    #[must_use]
    pub fn finger(&self, finger: Finger) -> [f64; 4] {
        let start = finger.index() * 4;
        [self.q[start], self.q[start + 1], self.q[start + 2], self.q[start + 3]]
    }

    /// p_i: the fingertip in O_W, m.
    #[must_use]
    pub fn tip(&self, finger: Finger) -> Vector3<f64> {
        self.geometry.finger_points(finger, &self.finger(finger))[3]
    }

    /// Checks angles, geometry and tuning, as data from a file or the network must be.
    ///
    /// # Errors
    /// Names the first angle that is not finite or beyond [`MAX_ANGLE`], or what is wrong with geometry or tuning.
    pub fn validate(&self) -> Result<(), MasterError> {
        validate_angles(&self.q)?;
        self.geometry.validate()?;
        Ok(self.tuning.map_or(Ok(()), |tuning| tuning.validate())?)
    }
}

/// Checks 20 joint angles, rad.
///
/// # Errors
/// Names the first that is not finite or beyond [`MAX_ANGLE`].
pub(crate) fn validate_angles(q: &[f64; 20]) -> Result<(), MasterError> {
    for finger in Finger::ALL {
        for joint in 0..4 {
            let value = q[finger.index() * 4 + joint];
            if !(-MAX_ANGLE..=MAX_ANGLE).contains(&value) {
                return Err(MasterError::Angle { finger, joint, value });
            }
        }
    }
    Ok(())
}
