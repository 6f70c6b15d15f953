use nalgebra::Vector3;

use crate::hand::Finger;

/// Sizes of a paradigmatic hand: a person's, or Table 1's.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
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
}
