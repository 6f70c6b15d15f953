use nalgebra::{Matrix3, Vector3};

use super::{Capsule, Collision, Finger, HandSide, JointVector, Link, MAX_FINGER_JOINTS};

/// One actuated joint of the hand.
#[derive(Clone, Debug)]
pub struct Joint {
    /// Name in the URDF.
    pub name: String,
    /// Lower position limit, rad.
    pub lower: f64,
    /// Upper position limit, rad.
    pub upper: f64,
    /// Largest speed, rad/s.
    pub velocity: f64,
    /// Largest acceleration of a command, rad/s².
    pub acceleration: f64,
    /// Proportional gain of the position controller, N m/rad.
    pub kp: f64,
    /// Derivative gain of the position controller, N m s/rad.
    pub kd: f64,
    /// Largest torque, N m.
    pub torque: f64,
    /// Position at rest, where the hand starts and opens to, rad.
    pub home: f64,
}

/// Which point of the fingertip.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TipFrame {
    /// The outermost point of the spherical fingertip along the distal link; what the mapping uses.
    Pole,
    /// The centre of the spherical fingertip; what the vendor's URDF calls the tip.
    Center,
}

/// One revolute joint of a finger, with the fixed transform that leads to it.
#[derive(Clone, Debug)]
pub struct ChainJoint {
    /// Index of the joint in the hand's wire order.
    pub joint: usize,
    /// Joint axis, a unit vector in the joint's own frame.
    pub axis: Vector3<f64>,
    /// Position of the joint's frame in the frame of the previous moving link (palm for the first), m.
    pub translation: Vector3<f64>,
    /// Rotation of the joint's frame at zero, in the same frame.
    pub rotation: Matrix3<f64>,
    // rotation * [axis]x and rotation * [axis]x^2, so that R(q) = rotation + sin q * k1 + (1 - cos q) * k2
    // (Rodrigues) costs no product of matrices.
    k1: Matrix3<f64>,
    k2: Matrix3<f64>,
}

impl ChainJoint {
    /// A joint whose frame lies at `translation`, `rotation` and turns about `axis` (normalised here).
    #[must_use]
    pub fn new(joint: usize, translation: Vector3<f64>, rotation: Matrix3<f64>, axis: Vector3<f64>) -> Self {
        let axis = axis.normalize();
        let cross = axis.cross_matrix();
        let k1 = rotation * cross;
        Self { joint, axis, translation, rotation, k1, k2: k1 * cross }
    }

    /// Rotation of the link behind this joint at angle `q` (rad), in the frame of the previous moving link.
    #[must_use]
    #[inline]
    pub fn rotation_at(&self, q: f64) -> Matrix3<f64> {
        let (sin, cos) = q.sin_cos();
        self.rotation + self.k1 * sin + self.k2 * (1.0 - cos)
    }
}

/// One finger: a serial chain from the palm to the tip.
#[derive(Clone, Debug)]
pub struct FingerChain {
    /// Which finger.
    pub finger: Finger,
    /// Joints from the palm outwards; at most [`MAX_FINGER_JOINTS`].
    pub joints: Vec<ChainJoint>,
    /// Pole of the fingertip in the last link's frame, m.
    pub pole: Vector3<f64>,
    /// Centre of the fingertip's sphere in the last link's frame, m.
    pub center: Vector3<f64>,
    /// o_Si: origin of the finger's base frame O_Si in O_SW, m.
    pub base: Vector3<f64>,
    /// Lengths of the phalanges a_Si1..3 as Table 1 counts them, summed, m.
    pub length: f64,
}

/// Where a moving link is, in the palm frame (m), and the axis of its joint.
#[derive(Clone, Copy, Default)]
pub(crate) struct Frame {
    pub(crate) position: Vector3<f64>,
    pub(crate) rotation: Matrix3<f64>,
    pub(crate) axis: Vector3<f64>,
}

impl Frame {
    #[inline]
    pub(crate) fn point(&self, own: &Vector3<f64>) -> Vector3<f64> {
        self.position + self.rotation * own
    }

    #[inline]
    pub(crate) fn capsule(&self, own: &Capsule) -> Capsule {
        Capsule { ends: [self.point(&own.ends[0]), self.point(&own.ends[1])], radius: own.radius }
    }
}

/// Linear Jacobian of a fingertip, 3 x n (columns beyond the finger's joints are zero), m/rad, in the palm frame.
pub type TipJacobian = nalgebra::SMatrix<f64, 3, MAX_FINGER_JOINTS>;

impl FingerChain {
    /// Position of the tip in the palm frame (m), for the finger's own joint angles `q` (rad), palm outwards.
    #[must_use]
    pub fn tip(&self, q: &[f64], frame: TipFrame) -> Vector3<f64> {
        let mut position = Vector3::zeros();
        let mut rotation = Matrix3::identity();
        for (joint, &angle) in self.joints.iter().zip(q) {
            position += rotation * joint.translation;
            rotation *= joint.rotation_at(angle);
        }
        position + rotation * self.offset(frame)
    }

    /// Position of the tip in the palm frame (m) and its linear Jacobian.
    #[must_use]
    pub fn tip_and_jacobian(&self, q: &[f64], frame: TipFrame) -> (Vector3<f64>, TipJacobian) {
        // A number of joints that the compiler knows unrolls the loops, and that of the fingers we know is four.
        if let Ok(q) = <&[f64; 4]>::try_from(&q[..self.joints.len().min(q.len())]) {
            self.columns(q, frame)
        } else {
            self.columns(
                &std::array::from_fn::<_, MAX_FINGER_JOINTS, _>(|slot| q.get(slot).copied().unwrap_or(0.0)),
                frame,
            )
        }
    }

    fn columns<const C: usize>(&self, q: &[f64; C], frame: TipFrame) -> (Vector3<f64>, TipJacobian) {
        let (tip, columns, _) = self.differential(q, frame);
        let mut jacobian = TipJacobian::zeros();
        for (slot, column) in columns.iter().enumerate() {
            jacobian.set_column(slot, column);
        }
        (tip, jacobian)
    }

    /// Tip, columns of the Jacobian, and the joint axes (unit vectors), all in the palm frame; zero for angles beyond
    /// the finger's joints.
    #[inline]
    pub(crate) fn differential<const C: usize>(
        &self,
        q: &[f64; C],
        frame: TipFrame,
    ) -> (Vector3<f64>, [Vector3<f64>; C], [Vector3<f64>; C]) {
        let mut position = Vector3::zeros();
        let mut rotation = Matrix3::identity();
        let mut origins = [Vector3::zeros(); C];
        let mut axes = [Vector3::zeros(); C];
        for (slot, (joint, &angle)) in self.joints.iter().zip(q).enumerate() {
            position += rotation * joint.translation;
            rotation *= joint.rotation_at(angle);
            origins[slot] = position;
            // A rotation about the axis leaves the axis where it is, so the turned frame gives it too.
            axes[slot] = rotation * joint.axis;
        }
        let tip = position + rotation * self.offset(frame);
        (tip, std::array::from_fn(|slot| axes[slot].cross(&(tip - origins[slot]))), axes)
    }

    /// Frames of the moving links, palm outwards, for the finger's own joint angles `q` (rad).
    #[inline]
    pub(crate) fn frames(&self, q: &[f64], out: &mut [Frame; MAX_FINGER_JOINTS]) {
        let mut position = Vector3::zeros();
        let mut rotation = Matrix3::identity();
        for ((joint, &angle), frame) in self.joints.iter().zip(q).zip(out) {
            position += rotation * joint.translation;
            rotation *= joint.rotation_at(angle);
            *frame = Frame { position, rotation, axis: rotation * joint.axis };
        }
    }

    /// The finger's own joint angles out of the whole hand's `q`, palm outwards.
    #[must_use]
    pub fn select(&self, q: &[f64]) -> [f64; MAX_FINGER_JOINTS] {
        let mut out = [0.0; MAX_FINGER_JOINTS];
        for (slot, joint) in self.joints.iter().enumerate() {
            out[slot] = q[joint.joint];
        }
        out
    }

    /// Writes the finger's own joint angles back into the whole hand's `q`.
    pub fn scatter(&self, own: &[f64], q: &mut [f64]) {
        for (joint, &angle) in self.joints.iter().zip(own) {
            q[joint.joint] = angle;
        }
    }

    fn offset(&self, frame: TipFrame) -> &Vector3<f64> {
        match frame {
            TipFrame::Pole => &self.pole,
            TipFrame::Center => &self.center,
        }
    }
}

/// One term of M_Q: `gain * q_master`, or `gain * max(0, q_master - above)` if `above` is given.
#[derive(Clone, Copy, Debug)]
pub struct JointMapTerm {
    /// Index into the master's 20 joints.
    pub master: usize,
    /// Factor.
    pub gain: f64,
    /// Only what exceeds this angle (rad) counts.
    pub above: Option<f64>,
}

/// The joint mapping M_Q (Eq. 1 and 7): for every slave joint an offset (rad) and terms of master joints.
#[derive(Clone, Debug)]
pub struct JointMap {
    /// Name, for example `split`.
    pub name: String,
    /// One row per slave joint, in wire order.
    pub rows: Vec<(f64, Vec<JointMapTerm>)>,
}

impl JointMap {
    /// M_Q(q), not clipped: 20 master angles to one angle per slave joint, rad.
    #[must_use]
    pub fn apply(&self, master: &[f64; 20]) -> JointVector {
        let mut out = JointVector::zeros(self.rows.len());
        for (value, (offset, terms)) in out.iter_mut().zip(&self.rows) {
            *value = terms.iter().fold(*offset, |sum, term| {
                let angle = master[term.master];
                sum + term.gain * term.above.map_or(angle, |above| (angle - above).max(0.0))
            });
        }
        out
    }
}

/// A robot hand, checked and flattened.
#[derive(Clone, Debug)]
pub struct HandModel {
    /// Name of the model, for example `allegro-v4-right`.
    pub name: String,
    /// Which hand.
    pub side: HandSide,
    /// Joints in wire order.
    pub joints: Vec<Joint>,
    /// Fingers, thumb first, then in the master's order. The thumb and at least one other finger are always there.
    pub fingers: Vec<FingerChain>,
    /// Rotation (a reflection too for a left hand) from the palm frame into O_SW.
    pub anatomical_from_palm: Matrix3<f64>,
    /// Where the wrist of a human hand of this size would be, in the palm frame, m.
    pub wrist: Vector3<f64>,
    /// The joint maps the description offers.
    pub joint_maps: Vec<JointMap>,
    /// All links with their shapes, for drawing: the root (the palm frame) first, parents before children.
    pub links: Vec<Link>,
    /// The hand's shape and what of it is kept apart.
    pub collision: Collision,
    /// What the texts contain but the model leaves out, for the caller to log.
    pub warnings: Vec<String>,
}

impl HandModel {
    /// `q` clipped into the joint limits.
    #[must_use]
    pub fn clip(&self, q: &JointVector) -> JointVector {
        let mut out = *q;
        for (value, joint) in out.iter_mut().zip(&self.joints) {
            *value = value.clamp(joint.lower, joint.upper);
        }
        out
    }

    /// The rest posture.
    #[must_use]
    pub fn home(&self) -> JointVector {
        let mut out = JointVector::zeros(self.joints.len());
        for (value, joint) in out.iter_mut().zip(&self.joints) {
            *value = joint.home;
        }
        out
    }

    /// The joint map called `name`.
    #[must_use]
    pub fn joint_map(&self, name: &str) -> Option<&JointMap> {
        self.joint_maps.iter().find(|map| map.name == name)
    }
}
