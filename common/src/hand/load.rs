//! From the two texts to a checked [`HandModel`].

use std::collections::HashMap;
use std::fmt::Write as _;

use nalgebra::{Isometry3, Matrix3, Vector3};

use super::description::{Anatomical, Description, FingerEntry, Joints};
use super::joint_map::joint_maps;
use super::urdf::{Motion, Tree, TreeJoint};
use super::{
    ChainJoint, Collision, Finger, FingerChain, HandError, HandModel, HandSide, Joint, Link, MAX_FINGER_JOINTS,
    MAX_JOINTS,
};

/// Largest text of either kind, bytes.
const MAX_TEXT: usize = 1 << 20;
/// Longest name of a hand or a joint map, bytes.
const MAX_NAME: usize = 64;

impl HandModel {
    /// Reads and checks a URDF and its description.
    ///
    /// # Errors
    /// If either text is broken, or they contradict each other; the error names the element and the remedy.
    pub fn load(urdf_xml: &str, description_toml: &str) -> Result<Self, HandError> {
        if let Some(problem) = too_large(urdf_xml) {
            return Err(HandError::UrdfSyntax(problem));
        }
        if let Some(problem) = too_large(description_toml) {
            return Err(HandError::DescriptionSyntax(problem));
        }
        let mut tree = Tree::parse(urdf_xml)?;
        let description: Description = toml::from_str(description_toml).map_err(|error| {
            let line = error.span().map_or(0, |span| description_toml[..span.start].matches('\n').count());
            HandError::DescriptionSyntax(format!("line {}: {}", line + 1, error.message()))
        })?;
        check_name("name", &description.name)?;
        let anatomical_from_palm = anatomical(&description.anatomical, description.side)?;
        let wrist = Vector3::from(description.anatomical.wrist);
        if !(0.0..1.0).contains(&wrist.norm()) {
            let problem = format!("{:?} must be within 1 m of the root link", description.anatomical.wrist);
            return Err(HandError::description("anatomical.wrist", problem));
        }
        let joints = joints(&tree, &description.joints)?;
        let wire: HashMap<&str, usize> =
            joints.iter().enumerate().map(|(index, joint)| (joint.name.as_str(), index)).collect();
        let fingers = fingers(&tree, &wire, &description.finger, &anatomical_from_palm)?;
        check_use(&tree, &wire, &fingers)?;
        let entry = |chain: &FingerChain| description.finger.iter().find(|entry| entry.name == chain.finger);
        let centers: Vec<&str> = fingers.iter().filter_map(entry).map(|entry| entry.center.as_str()).collect();
        let collision = Collision::build(&mut tree, &fingers, &centers, &joints)?;
        let joint_maps = joint_maps(&description.joint_map, &joints)?;
        let links = tree
            .links
            .into_iter()
            .map(|link| {
                let (parent, joint) = link.parent.unzip();
                let motion = joint.as_ref().and_then(|joint| joint.motion);
                Link {
                    name: link.name,
                    parent,
                    joint: joint.as_ref().and_then(|joint| wire.get(joint.name.as_str()).copied()),
                    parent_from_link: joint.map_or_else(Isometry3::identity, |joint| joint.origin),
                    axis: motion.map_or_else(Vector3::z_axis, |motion| motion.axis),
                    visuals: link.visuals,
                }
            })
            .collect();
        drop(wire);
        Ok(Self {
            name: description.name,
            side: description.side,
            joints,
            fingers,
            anatomical_from_palm,
            wrist,
            joint_maps,
            links,
            collision,
            warnings: tree.warnings,
        })
    }
}

fn too_large(text: &str) -> Option<String> {
    let size = text.len();
    (size > MAX_TEXT).then(|| format!("{size} bytes are more than the {MAX_TEXT} allowed; is this the right file?"))
}

pub(super) fn check_name(entry: &str, name: &str) -> Result<(), HandError> {
    if name.is_empty() || name.len() > MAX_NAME || name.contains(char::is_control) {
        return Err(HandError::description(entry, format!("a name needs 1 to {MAX_NAME} printable bytes")));
    }
    Ok(())
}

fn anatomical(axes: &Anatomical, side: HandSide) -> Result<Matrix3<f64>, HandError> {
    let [radial, distal, palmar] = [axes.radial, axes.distal, axes.palmar].map(|axis| Vector3::from(axis.vector()));
    let rows = Matrix3::from_rows(&[radial.transpose(), distal.transpose(), palmar.transpose()]);
    let handedness = rows.determinant();
    if handedness.abs() < 0.5 {
        return Err(HandError::description("anatomical", "radial, distal and palmar must be three different axes"));
    }
    if (handedness > 0.0) != (side == HandSide::Right) {
        let problem = format!(
            "these axes are those of the other hand, not of a {} one; radial points to the thumb's side: reverse it, \
             or change side",
            side.name()
        );
        return Err(HandError::description("anatomical", problem));
    }
    Ok(rows)
}

fn joints(tree: &Tree, entries: &Joints) -> Result<Vec<Joint>, HandError> {
    let count = entries.order.len();
    if count > MAX_JOINTS {
        let problem = format!("{count} joints are more than the {MAX_JOINTS} supported");
        return Err(HandError::description("joints.order", problem));
    }
    let columns = [
        ("home", &entries.home),
        ("acceleration", &entries.acceleration),
        ("kp", &entries.kp),
        ("kd", &entries.kd),
        ("torque", &entries.torque),
    ];
    for (key, values) in columns {
        if values.len() != count {
            let problem = format!("{} values for the {count} joints of joints.order; give one each", values.len());
            return Err(HandError::description(format!("joints.{key}"), problem));
        }
    }
    let moving: HashMap<&str, &TreeJoint> = tree.joints().map(|joint| (joint.name.as_str(), joint)).collect();
    let mut joints: Vec<Joint> = Vec::with_capacity(count);
    for (index, name) in entries.order.iter().enumerate() {
        if joints.iter().any(|joint| joint.name == *name) {
            return Err(HandError::description("joints.order", format!("joint '{name}' is listed twice")));
        }
        let Motion { lower, upper, velocity, .. } = find_moving(&moving, "joints.order", name)?;
        let [home, acceleration, kp, kd, torque] = columns.map(|(_, values)| values[index]);
        for (key, value) in [("acceleration", acceleration), ("kp", kp), ("torque", torque)] {
            if !(value > 0.0 && value.is_finite()) {
                let problem = format!("{value} for joint '{name}' must be finite and above 0");
                return Err(HandError::description(format!("joints.{key}"), problem));
            }
        }
        if !(kd >= 0.0 && kd.is_finite()) {
            let problem = format!("{kd} for joint '{name}' must be finite and not negative");
            return Err(HandError::description("joints.kd", problem));
        }
        if !(lower..=upper).contains(&home) {
            let problem = format!("{home} rad for joint '{name}' is outside its limits {lower} to {upper}");
            return Err(HandError::description("joints.home", problem));
        }
        joints.push(Joint { name: name.clone(), lower, upper, velocity, acceleration, kp, kd, torque, home });
    }
    Ok(joints)
}

fn find_moving(joints: &HashMap<&str, &TreeJoint>, entry: &str, name: &str) -> Result<Motion, HandError> {
    let Some(joint) = joints.get(name) else {
        return Err(HandError::description(entry, format!("joint '{name}' is not in the urdf")));
    };
    joint.motion.ok_or_else(|| {
        HandError::description(entry, format!("joint '{name}' is fixed in the urdf; list moving joints only"))
    })
}

fn fingers(
    tree: &Tree,
    wire: &HashMap<&str, usize>,
    entries: &[FingerEntry],
    anatomical_from_palm: &Matrix3<f64>,
) -> Result<Vec<FingerChain>, HandError> {
    let mut fingers: Vec<FingerChain> = Vec::new();
    for entry in entries {
        if fingers.iter().any(|other| other.finger == entry.name) {
            return Err(HandError::description(format!("finger '{}'", entry.name.name()), "described twice"));
        }
        fingers.push(finger(tree, wire, entry, anatomical_from_palm)?);
    }
    fingers.sort_by_key(|finger| finger.finger);
    if fingers.first().is_none_or(|finger| finger.finger != Finger::Thumb) {
        return Err(HandError::description("finger", "no thumb; add a [[finger]] with name = \"thumb\""));
    }
    if fingers.len() < 2 {
        return Err(HandError::description("finger", "a thumb alone cannot grasp; add a second [[finger]]"));
    }
    // The mapping of the thumb (Eq. 10) interpolates between the bases in this order.
    for pair in fingers[1..].windows(2) {
        let [radial, ulnar] = [&pair[0], &pair[1]];
        if radial.base.x <= ulnar.base.x {
            let problem = format!(
                "its base ({:.4} m) is not on the thumb's side of the {} finger's ({:.4} m); is this the other \
                 hand's urdf, or numbered from the other side?",
                radial.base.x,
                ulnar.finger.name(),
                ulnar.base.x
            );
            return Err(HandError::description(format!("finger '{}'", radial.finger.name()), problem));
        }
    }
    Ok(fingers)
}

fn finger(
    tree: &Tree,
    wire: &HashMap<&str, usize>,
    entry: &FingerEntry,
    anatomical_from_palm: &Matrix3<f64>,
) -> Result<FingerChain, HandError> {
    let element = format!("finger '{}'", entry.name.name());
    let fail = |problem: String| HandError::description(element.clone(), problem);
    let path = |key: &str, link: &str| {
        let index = tree.find(link).ok_or_else(|| fail(format!("{key} link '{link}' is not in the urdf")))?;
        Ok(tree.path(index))
    };
    if entry.joints.is_empty() || entry.joints.len() > MAX_FINGER_JOINTS {
        return Err(fail(format!("{} joints; a finger needs 1 to {MAX_FINGER_JOINTS}", entry.joints.len())));
    }
    for name in &entry.joints {
        if !wire.contains_key(name.as_str()) {
            return Err(fail(format!("joint '{name}' is not in joints.order")));
        }
    }
    let to_center = path("center", &entry.center)?;
    for (key, link, joints) in
        [("center", &entry.center, &to_center), ("pole", &entry.pole, &path("pole", &entry.pole)?)]
    {
        let moving: Vec<_> = joints.iter().filter(|joint| joint.motion.is_some()).map(|joint| &joint.name).collect();
        if !moving.iter().copied().eq(&entry.joints) {
            let mut problem = format!("joints must be those that lead to its {key} '{link}', from the palm outwards:");
            let _ = moving.iter().try_for_each(|name| write!(problem, " {name}"));
            return Err(fail(problem));
        }
    }
    let to_base = path("base", &entry.base)?;
    if !to_base.iter().zip(&to_center).all(|(a, b)| a.name == b.name) || to_base.len() > to_center.len() {
        return Err(fail(format!("base link '{}' is not between the palm and its center", entry.base)));
    }
    if !entry.phalanges.iter().all(|&length| length > 0.0 && length < 1.0) {
        return Err(fail(format!("phalanges {:?} must be lengths above 0 in metres", entry.phalanges)));
    }

    let (joints, center) = fold(wire, &to_center);
    let (_, pole) = fold(wire, &path("pole", &entry.pole)?);
    let base = to_base.iter().fold(Isometry3::identity(), |pose, joint| pose * joint.origin);
    Ok(FingerChain {
        finger: entry.name,
        joints,
        pole,
        center,
        base: anatomical_from_palm * base.translation.vector,
        length: entry.phalanges.iter().sum(),
    })
}

/// Folds fixed joints into the moving ones: the chain, and the position of the path's end in the last moving link.
fn fold(wire: &HashMap<&str, usize>, path: &[&TreeJoint]) -> (Vec<ChainJoint>, Vector3<f64>) {
    let mut chain = Vec::new();
    let mut pose = Isometry3::identity();
    for joint in path {
        pose *= joint.origin;
        if let (Some(motion), Some(&index)) = (joint.motion, wire.get(joint.name.as_str())) {
            let rotation = pose.rotation.to_rotation_matrix().into_inner();
            chain.push(ChainJoint::new(index, pose.translation.vector, rotation, motion.axis.into_inner()));
            pose = Isometry3::identity();
        }
    }
    (chain, pose.translation.vector)
}

/// Every joint that moves belongs to exactly one finger.
fn check_use(tree: &Tree, wire: &HashMap<&str, usize>, fingers: &[FingerChain]) -> Result<(), HandError> {
    for joint in tree.joints().filter(|joint| joint.motion.is_some()) {
        let Some(index) = wire.get(joint.name.as_str()) else {
            let problem = format!("joint '{}' moves but is not listed; add it, or make it fixed", joint.name);
            return Err(HandError::description("joints.order", problem));
        };
        let users: Vec<_> =
            fingers.iter().filter(|finger| finger.joints.iter().any(|used| used.joint == *index)).collect();
        if users.len() != 1 {
            let names: Vec<_> = users.iter().map(|finger| finger.finger.name()).collect();
            let problem = format!(
                "joint '{}' is used by {} fingers ({}); every joint belongs to one",
                joint.name,
                names.len(),
                names.join(", ")
            );
            return Err(HandError::description("finger", problem));
        }
    }
    Ok(())
}
