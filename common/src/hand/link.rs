use nalgebra::{Isometry3, UnitQuaternion, UnitVector3, Vector3};

use super::HandModel;

/// A primitive shape, centred on its own origin.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Shape {
    /// A box with edges along the axes.
    Box {
        /// Edge lengths, m.
        size: [f64; 3],
    },
    /// A cylinder about z.
    Cylinder {
        /// Radius, m.
        radius: f64,
        /// Length along z, m.
        length: f64,
    },
    /// A sphere.
    Sphere {
        /// Radius, m.
        radius: f64,
    },
}

/// A coloured shape on a link.
#[derive(Clone, Debug, PartialEq)]
pub struct Visual {
    /// The shape.
    pub shape: Shape,
    /// Pose of the shape in the link's frame, m.
    pub origin: Isometry3<f64>,
    /// Red, green, blue, opacity, each 0 to 1.
    pub rgba: [f32; 4],
}

/// A link of the hand, for drawing it.
#[derive(Clone, Debug)]
pub struct Link {
    /// Name in the URDF.
    pub name: String,
    /// Index of the parent in [`HandModel::links`]; `None` for the root alone.
    pub parent: Option<usize>,
    /// Wire index of the joint that carries the link; `None` where it is fixed to its parent.
    pub joint: Option<usize>,
    /// Pose in the parent's frame with the joint at zero, m.
    pub parent_from_link: Isometry3<f64>,
    /// Axis of the joint in the link's frame (of no meaning without a joint).
    pub axis: UnitVector3<f64>,
    /// What the link looks like.
    pub visuals: Vec<Visual>,
}

impl Link {
    /// Pose in the parent's frame with the joint at `angle`, rad.
    #[must_use]
    pub fn parent_from_link_at(&self, angle: f64) -> Isometry3<f64> {
        self.parent_from_link * UnitQuaternion::from_axis_angle(&self.axis, angle)
    }
}

impl HandModel {
    /// Poses of all links in the palm frame, in the order of [`HandModel::links`], for joint angles `q` (rad, wire
    /// order; joints beyond its end are at zero). Replaces what is in `out`.
    pub fn link_poses(&self, q: &[f64], out: &mut Vec<Isometry3<f64>>) {
        out.clear();
        for link in &self.links {
            let angle = link.joint.and_then(|joint| q.get(joint)).copied().unwrap_or(0.0);
            // Parents come before their children, so the parent's pose is there already.
            let parent = link.parent.and_then(|parent| out.get(parent)).copied().unwrap_or_else(Isometry3::identity);
            out.push(parent * link.parent_from_link_at(angle));
        }
    }

    /// Index of a link in [`HandModel::links`].
    #[must_use]
    pub fn link(&self, name: &str) -> Option<usize> {
        self.links.iter().position(|link| link.name == name)
    }
}

pub(super) fn isometry(xyz: [f64; 3], rpy: [f64; 3]) -> Isometry3<f64> {
    let [roll, pitch, yaw] = rpy;
    Isometry3::from_parts(Vector3::from(xyz).into(), UnitQuaternion::from_euler_angles(roll, pitch, yaw))
}
