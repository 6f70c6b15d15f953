//! A URDF, checked and put in order: one tree, parents before children.

use std::collections::{HashMap, VecDeque};

use nalgebra::{Isometry3, UnitVector3, Vector3};
use urdf_rs::{Geometry, JointType};

use super::link::isometry;
use super::xml::{brief, check_plain};
use super::{HandError, Shape, Visual};

/// Most links; a hand has some thirty.
const MAX_LINKS: usize = 256;
/// Longest name, bytes.
const MAX_NAME: usize = 128;
/// No part of a hand is further from the next than this, m; more means millimetres.
const MAX_LENGTH: f64 = 1.0;
/// A full turn, with room for rounding, rad; more means degrees.
const MAX_ANGLE: f64 = 6.3;
/// Colour of a visual without a material.
const DEFAULT_RGBA: [f32; 4] = [0.7, 0.7, 0.7, 1.0];

pub(super) struct Tree {
    /// Root first, parents before children.
    pub(super) links: Vec<TreeLink>,
    /// What was left out.
    pub(super) warnings: Vec<String>,
}

pub(super) struct TreeLink {
    pub(super) name: String,
    /// Index of the parent link and the joint to it; `None` for the root.
    pub(super) parent: Option<(usize, TreeJoint)>,
    pub(super) visuals: Vec<Visual>,
    pub(super) solids: Vec<Solid>,
}

/// A collision shape, centred on its origin in the link's frame, m.
pub(super) enum Solid {
    Box {
        origin: Isometry3<f64>,
        half: Vector3<f64>,
    },
    /// Along z; a sphere if `half`, half the length of its axis, is zero.
    Capsule {
        origin: Isometry3<f64>,
        radius: f64,
        half: f64,
    },
}

#[derive(Clone)]
pub(super) struct TreeJoint {
    pub(super) name: String,
    pub(super) origin: Isometry3<f64>,
    /// `None` where the joint is fixed.
    pub(super) motion: Option<Motion>,
}

#[derive(Clone, Copy)]
pub(super) struct Motion {
    pub(super) axis: UnitVector3<f64>,
    pub(super) lower: f64,
    pub(super) upper: f64,
    pub(super) velocity: f64,
}

impl Tree {
    pub(super) fn parse(text: &str) -> Result<Self, HandError> {
        check_plain(text).map_err(HandError::UrdfSyntax)?;
        // The parser has panics of its own, for example where a document binds the prefix xmlns anew.
        let robot = std::panic::catch_unwind(|| urdf_rs::read_from_string(text))
            .map_err(|_| HandError::UrdfSyntax("the xml parser gave up; simplify the document".to_owned()))?
            .map_err(|error| HandError::UrdfSyntax(brief(&error.to_string())))?;
        let links = link_indices(&robot.links)?;

        let mut parents: Vec<Option<(usize, TreeJoint)>> = vec![None; robot.links.len()];
        let mut children: Vec<Vec<usize>> = vec![Vec::new(); robot.links.len()];
        let mut names = HashMap::new();
        for joint in &robot.joints {
            let element = format!("joint '{}'", brief(&joint.name));
            if joint.name.is_empty() || joint.name.len() > MAX_NAME {
                return Err(HandError::urdf(element, format!("a name needs 1 to {MAX_NAME} bytes")));
            }
            if names.insert(joint.name.as_str(), ()).is_some() {
                return Err(HandError::urdf(element, "defined twice; rename one of them"));
            }
            let find = |role: &str, name: &str| {
                links.get(name).copied().ok_or_else(|| {
                    HandError::urdf(element.clone(), format!("its {role} link '{}' does not exist", brief(name)))
                })
            };
            let (parent, child) = (find("parent", &joint.parent.link)?, find("child", &joint.child.link)?);
            if let Some((_, other)) = &parents[child] {
                let problem = format!(
                    "link '{}' is a child of joint '{}' already; a link has one parent",
                    joint.child.link, other.name
                );
                return Err(HandError::urdf(element, problem));
            }
            parents[child] = Some((parent, check_joint(joint, &element)?));
            children[parent].push(child);
        }

        let mut roots = (0..robot.links.len()).filter(|&link| parents[link].is_none());
        let root = match (roots.next(), roots.next()) {
            (Some(root), None) => root,
            (Some(first), Some(second)) => {
                let problem = format!(
                    "neither it nor link '{}' has a parent; join them by a fixed joint",
                    robot.links[second].name
                );
                return Err(HandError::urdf(format!("link '{}'", robot.links[first].name), problem));
            }
            (None, _) => return Err(HandError::urdf("robot", "no root: it needs one link that is no joint's child")),
        };

        let materials = materials(&robot)?;
        let mut tree = Self { links: Vec::with_capacity(robot.links.len()), warnings: Vec::new() };
        let mut queue = VecDeque::from([(root, None)]);
        while let Some((index, parent)) = queue.pop_front() {
            let link = &robot.links[index];
            let visuals = visuals(link, &materials, &mut tree.warnings)?;
            let solids = solids(link, &mut tree.warnings)?;
            queue.extend(children[index].iter().map(|&child| (child, Some(tree.links.len()))));
            let parent = parent.zip(parents[index].take().map(|(_, joint)| joint));
            tree.links.push(TreeLink { name: link.name.clone(), parent, visuals, solids });
        }
        // With one root and at most one parent each, links that were not reached run in a circle.
        if let Some(index) = parents.iter().position(Option::is_some) {
            let problem = "is its own ancestor; the joints must form a tree";
            return Err(HandError::urdf(format!("link '{}'", robot.links[index].name), problem));
        }
        Ok(tree)
    }

    pub(super) fn find(&self, name: &str) -> Option<usize> {
        self.links.iter().position(|link| link.name == name)
    }

    /// The joints from the root to a link.
    pub(super) fn path(&self, link: usize) -> Vec<&TreeJoint> {
        let mut path = Vec::new();
        let mut at = link;
        while let Some((parent, joint)) = &self.links[at].parent {
            path.push(joint);
            at = *parent;
        }
        path.reverse();
        path
    }

    pub(super) fn joints(&self) -> impl Iterator<Item = &TreeJoint> {
        self.links.iter().filter_map(|link| link.parent.as_ref().map(|(_, joint)| joint))
    }
}

fn link_indices(links: &[urdf_rs::Link]) -> Result<HashMap<&str, usize>, HandError> {
    if links.len() > MAX_LINKS {
        return Err(HandError::urdf("robot", format!("{} links are more than the {MAX_LINKS} allowed", links.len())));
    }
    let mut indices = HashMap::new();
    for (index, link) in links.iter().enumerate() {
        let element = || format!("link '{}'", brief(&link.name));
        if link.name.is_empty() || link.name.len() > MAX_NAME {
            return Err(HandError::urdf(element(), format!("a name needs 1 to {MAX_NAME} bytes")));
        }
        if indices.insert(link.name.as_str(), index).is_some() {
            return Err(HandError::urdf(element(), "defined twice; rename one of them"));
        }
    }
    Ok(indices)
}

fn check_joint(joint: &urdf_rs::Joint, element: &str) -> Result<TreeJoint, HandError> {
    let fail = |problem: String| Err(HandError::urdf(element, problem));
    let origin = check_origin(&joint.origin, element)?;
    if joint.joint_type == JointType::Fixed {
        return Ok(TreeJoint { name: joint.name.clone(), origin, motion: None });
    }
    if joint.joint_type != JointType::Revolute {
        return fail(format!(
            "type '{}' is not supported; make it revolute with limits, or fixed",
            format!("{:?}", joint.joint_type).to_lowercase()
        ));
    }
    if let Some(mimic) = &joint.mimic {
        return fail(format!(
            "mimics '{}', but coupled joints are not supported; make it independent or fixed",
            brief(&mimic.joint)
        ));
    }
    let axis = Vector3::from(*joint.axis.xyz);
    if !(axis.norm() > 1e-6 && axis.norm().is_finite()) {
        return fail(format!("axis {:?} has no direction", joint.axis.xyz.0));
    }
    let limit = &joint.limit;
    if !(limit.lower.abs() <= MAX_ANGLE && limit.upper.abs() <= MAX_ANGLE) {
        return fail(format!("limits {} to {} must be finite angles in radians", limit.lower, limit.upper));
    }
    if limit.lower >= limit.upper {
        let (lower, upper) = (limit.lower, limit.upper);
        return fail(format!("limits {lower} to {upper} leave no room; give <limit> a lower below its upper"));
    }
    if !(limit.velocity > 0.0 && limit.velocity.is_finite()) {
        return fail(format!("velocity limit {} must be finite and above 0 rad/s", limit.velocity));
    }
    let motion = Motion {
        axis: UnitVector3::new_normalize(axis),
        lower: limit.lower,
        upper: limit.upper,
        velocity: limit.velocity,
    };
    Ok(TreeJoint { name: joint.name.clone(), origin, motion: Some(motion) })
}

fn check_origin(origin: &urdf_rs::Pose, element: &str) -> Result<Isometry3<f64>, HandError> {
    let (xyz, rpy) = (*origin.xyz, *origin.rpy);
    if !xyz.iter().all(|value| value.abs() <= MAX_LENGTH) {
        let problem = format!("origin xyz {xyz:?} must be finite and within {MAX_LENGTH} m; are these millimetres?");
        return Err(HandError::urdf(element, problem));
    }
    if !rpy.iter().all(|value| value.abs() <= MAX_ANGLE) {
        let problem = format!("origin rpy {rpy:?} must be finite and within a turn; are these degrees?");
        return Err(HandError::urdf(element, problem));
    }
    Ok(isometry(xyz, rpy))
}

/// Colours by material name: those of the robot, and those that a visual defines and others refer to.
fn materials(robot: &urdf_rs::Robot) -> Result<HashMap<&str, [f32; 4]>, HandError> {
    let inline = robot.links.iter().flat_map(|link| &link.visual).filter_map(|visual| visual.material.as_ref());
    let mut colours = HashMap::new();
    for material in robot.materials.iter().chain(inline) {
        if let Some(color) = &material.color {
            colours.entry(material.name.as_str()).or_insert(check_colour(&material.name, *color.rgba)?);
        } else if material.texture.is_some() {
            colours.entry(material.name.as_str()).or_insert(DEFAULT_RGBA);
        }
    }
    Ok(colours)
}

fn check_colour(name: &str, rgba: [f64; 4]) -> Result<[f32; 4], HandError> {
    if rgba.iter().all(|value| (0.0..=1.0).contains(value)) {
        return Ok(rgba.map(|value| value as f32));
    }
    Err(HandError::urdf(format!("material '{}'", brief(name)), format!("rgba {rgba:?} must be within 0 to 1")))
}

fn visuals(
    link: &urdf_rs::Link,
    materials: &HashMap<&str, [f32; 4]>,
    warnings: &mut Vec<String>,
) -> Result<Vec<Visual>, HandError> {
    let element = format!("link '{}'", link.name);
    let mut out = Vec::with_capacity(link.visual.len());
    for visual in &link.visual {
        let origin = check_origin(&visual.origin, &element)?;
        let rgba = match &visual.material {
            None => DEFAULT_RGBA,
            Some(urdf_rs::Material { name, color: Some(color), .. }) => check_colour(name, *color.rgba)?,
            Some(material) => *materials.get(material.name.as_str()).ok_or_else(|| {
                HandError::urdf(element.clone(), format!("material '{}' is not defined", brief(&material.name)))
            })?,
        };
        let size = |value: f64| check_size(value, "visual", &element);
        let mut push = |shape, origin| out.push(Visual { shape, origin, rgba });
        match &visual.geometry {
            Geometry::Box { size: edges } => {
                let [x, y, z] = **edges;
                push(Shape::Box { size: [size(x)?, size(y)?, size(z)?] }, origin);
            }
            Geometry::Cylinder { radius, length } => {
                push(Shape::Cylinder { radius: size(*radius)?, length: size(*length)? }, origin);
            }
            Geometry::Sphere { radius } => push(Shape::Sphere { radius: size(*radius)? }, origin),
            Geometry::Capsule { radius, length } => {
                let (radius, length) = (size(*radius)?, size(*length)?);
                push(Shape::Cylinder { radius, length }, origin);
                for end in [-0.5, 0.5] {
                    let cap = nalgebra::Translation3::new(0.0, 0.0, end * length);
                    push(Shape::Sphere { radius }, origin * cap);
                }
            }
            Geometry::Mesh { filename, .. } => {
                warnings.push(format!(
                    "{element}: mesh '{}' is not drawn; only box, cylinder, capsule and sphere are",
                    brief(filename)
                ));
            }
        }
    }
    Ok(out)
}

fn solids(link: &urdf_rs::Link, warnings: &mut Vec<String>) -> Result<Vec<Solid>, HandError> {
    let element = format!("link '{}'", link.name);
    let size = |value: f64| check_size(value, "collision shape", &element);
    let mut out = Vec::with_capacity(link.collision.len());
    for collision in &link.collision {
        let origin = check_origin(&collision.origin, &element)?;
        out.push(match &collision.geometry {
            Geometry::Box { size: edges } => {
                let [x, y, z] = **edges;
                Solid::Box { origin, half: Vector3::new(size(x)?, size(y)?, size(z)?) * 0.5 }
            }
            // A flat one is nearer to a box than to a capsule.
            Geometry::Cylinder { radius, length } if size(*length)? < 2.0 * size(*radius)? => {
                Solid::Box { origin, half: Vector3::new(*radius, *radius, 0.5 * length) }
            }
            Geometry::Cylinder { radius, length } => {
                Solid::Capsule { origin, radius: *radius, half: 0.5 * length - radius }
            }
            Geometry::Capsule { radius, length } => {
                Solid::Capsule { origin, radius: size(*radius)?, half: 0.5 * size(*length)? }
            }
            Geometry::Sphere { radius } => Solid::Capsule { origin, radius: size(*radius)?, half: 0.0 },
            Geometry::Mesh { filename, .. } => {
                warnings.push(format!(
                    "{element}: collision mesh '{}' is not watched; only box, cylinder, capsule and sphere are",
                    brief(filename)
                ));
                continue;
            }
        });
    }
    Ok(out)
}

fn check_size(value: f64, what: &str, element: &str) -> Result<f64, HandError> {
    if value > 0.0 && value <= MAX_LENGTH {
        return Ok(value);
    }
    Err(HandError::urdf(element, format!("a {what}'s size of {value} must be above 0 and within {MAX_LENGTH} m")))
}
