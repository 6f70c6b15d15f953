//! The hand as capsules, from the collision shapes of its URDF.
//!
//! A finger's link becomes capsules side by side along its box's longest edge, as thick as its thinnest: they reach
//! the faces of the box and round its edges. Around the box they would be half as thick again, and two fingers could
//! not lie pad to pad. What is fixed to the palm stays a box, with edges rounded by [`EDGE`]. The spheres of the
//! fingertips are those of the description (`center`, `pole`).
//!
//! Watched are all pairs of bodies of different fingers, and all of a finger and the palm, except (see
//! [`Collision::ignored`]) the first two links of a finger and the palm, which only the limits of their joints keep
//! apart where the boxes are coarser than the parts, and pairs that overlap at the hand's home posture.

use nalgebra::{Isometry3, Point3, Vector3};

use super::capsule::{Capsule, RoundedBox, between_segments};
use super::model::Frame;
use super::urdf::{Solid, Tree};
use super::{FingerChain, HandError, Joint, MAX_FINGER_JOINTS, MAX_FINGERS};

/// Most bodies of a finger: its moving links and the tip.
pub const MAX_BODIES: usize = MAX_FINGER_JOINTS + 1;
/// Most capsules of a moving link, and boxes of the palm.
const MAX_SHAPES: usize = 16;
/// How round the palm's edges are, m.
const EDGE: f64 = 0.004;
/// Links of a finger from the palm on that may touch it.
const JOINED: usize = 2;
/// A box wider than its capsules by less than this gets one, m.
const NARROW: f64 = 0.002;
/// A plate's capsules are at least this much of its width thick, which bounds their number.
const PLATE: f64 = 0.25;

/// What moves as one: all shapes of a moving link, or a fingertip.
#[derive(Clone, Debug)]
pub struct Body {
    /// The link in the URDF; of a fingertip its `center`.
    pub link: String,
    /// Which of the finger's joints carries it, counted from the palm.
    pub slot: usize,
    /// Its shape in that joint's frame. A tip has one, a sphere.
    pub capsules: Vec<Capsule>,
    /// A capsule around them all.
    pub bound: Capsule,
    /// True for the fingertip's sphere.
    pub tip: bool,
}

/// A body of a finger: which finger, which body.
pub type BodyIndex = (usize, usize);

/// Shapes of a hand and which of them are kept apart.
#[derive(Clone, Debug, Default)]
pub struct Collision {
    /// By finger, from the palm outwards; at most [`MAX_BODIES`] each, the last is the tip.
    pub fingers: Vec<Vec<Body>>,
    /// What is fixed to the palm, in the palm frame.
    pub palm: Vec<RoundedBox>,
    /// Pairs of bodies that are kept apart.
    pub pairs: Vec<[BodyIndex; 2]>,
    /// Bodies that are kept out of a box of the palm.
    pub palm_pairs: Vec<(BodyIndex, usize)>,
    /// Pairs of links of different fingers, or a finger and the palm, that are not kept apart.
    pub ignored: Vec<[String; 2]>,
}

impl Collision {
    pub(super) fn build(
        tree: &mut Tree,
        fingers: &[FingerChain],
        centers: &[&str],
        joints: &[Joint],
    ) -> Result<Self, HandError> {
        let mut out = Self { fingers: vec![Vec::new(); fingers.len()], ..Self::default() };
        if tree.links.iter().all(|link| link.solids.is_empty()) {
            tree.warnings.push("no collision shapes: only the fingertips are kept apart".to_owned());
        }
        for (link, (carrier, pose)) in tree.links.iter().zip(carriers(tree, fingers, joints)) {
            let Some((finger, slot)) = carrier else {
                out.palm.extend(link.solids.iter().map(|solid| solid.rounded(&pose)));
                continue;
            };
            let (chain, bodies) = (&fingers[finger], &mut out.fingers[finger]);
            let mut capsules: Vec<Capsule> = link.solids.iter().flat_map(|solid| solid.capsules(&pose)).collect();
            // The tip's sphere comes below.
            capsules.retain(|capsule| slot + 1 < chain.joints.len() || !capsule.is(&tip(chain)));
            match bodies.iter_mut().find(|body| body.slot == slot) {
                _ if capsules.is_empty() => {}
                Some(body) => body.capsules.extend(capsules),
                None => bodies.push(Body { link: link.name.clone(), slot, bound: capsules[0], capsules, tip: false }),
            }
        }
        if out.palm.len() > MAX_SHAPES {
            let problem = format!("{} collision shapes are more than the {MAX_SHAPES} allowed", out.palm.len());
            return Err(HandError::urdf("palm", problem));
        }
        for ((bodies, chain), center) in out.fingers.iter_mut().zip(fingers).zip(centers) {
            for body in bodies.iter_mut() {
                let count = body.capsules.len();
                if count > MAX_SHAPES {
                    let problem = format!(
                        "its collision shapes make {count} capsules, more than the {MAX_SHAPES} allowed; use fewer boxes"
                    );
                    return Err(HandError::urdf(format!("link '{}'", body.link), problem));
                }
                body.bound = around(&body.capsules);
            }
            let (slot, tip) = (chain.joints.len() - 1, tip(chain));
            bodies.push(Body { link: (*center).to_owned(), slot, capsules: vec![tip], bound: tip, tip: true });
        }
        out.choose(fingers, joints, &tree.links[0].name);
        Ok(out)
    }

    /// Fills the lists of pairs.
    fn choose(&mut self, fingers: &[FingerChain], joints: &[Joint], palm: &str) {
        let home: Vec<f64> = joints.iter().map(|joint| joint.home).collect();
        let mut world: Vec<Vec<Vec<Capsule>>> = Vec::new();
        for (chain, bodies) in fingers.iter().zip(&self.fingers) {
            let mut frames = [Frame::default(); MAX_FINGER_JOINTS];
            chain.frames(&chain.select(&home), &mut frames);
            let at = |body: &Body| body.capsules.iter().map(|capsule| frames[body.slot].capsule(capsule)).collect();
            world.push(bodies.iter().map(at).collect());
        }
        let gap = |[p, q]: [Vector3<f64>; 2], radii: f64| (q - p).norm() - radii;
        for (a, one) in world.iter().enumerate() {
            for (i, capsules) in one.iter().enumerate() {
                let body = &self.fingers[a][i];
                let mut touches = body.slot < JOINED && !body.tip;
                for block in &self.palm {
                    touches |=
                        capsules.iter().any(|own| gap(block.nearest(&own.ends), own.radius + block.radius) < 0.0);
                }
                if touches && !self.palm.is_empty() {
                    self.ignored.push([body.link.clone(), palm.to_owned()]);
                } else {
                    self.palm_pairs.extend((0..self.palm.len()).map(|block| ((a, i), block)));
                }
                for (b, other) in world.iter().enumerate().skip(a + 1) {
                    for (j, others) in other.iter().enumerate() {
                        let overlap = |own: &Capsule, other: &Capsule| {
                            gap(between_segments(&own.ends, &other.ends), own.radius + other.radius) < 0.0
                        };
                        if capsules.iter().any(|own| others.iter().any(|other| overlap(own, other))) {
                            self.ignored.push([body.link.clone(), self.fingers[b][j].link.clone()]);
                        } else {
                            self.pairs.push([(a, i), (b, j)]);
                        }
                    }
                }
            }
        }
        debug_assert!(self.fingers.len() <= MAX_FINGERS);
    }
}

/// Of every link the joint that carries it (finger and place in it; none for what is fixed to the palm), and its pose in
/// that joint's frame.
fn carriers(tree: &Tree, fingers: &[FingerChain], joints: &[Joint]) -> Vec<(Option<BodyIndex>, Isometry3<f64>)> {
    let mut out: Vec<(Option<BodyIndex>, Isometry3<f64>)> = Vec::with_capacity(tree.links.len());
    for link in &tree.links {
        let own = link.parent.as_ref().map(|(parent, joint)| {
            let wire = joints.iter().position(|other| other.name == joint.name);
            let mover = fingers.iter().enumerate().find_map(|(finger, chain)| {
                chain.joints.iter().position(|own| Some(own.joint) == wire).map(|slot| (finger, slot))
            });
            // Parents come before their children.
            let (carrier, pose) = out[*parent];
            if mover.is_some() { (mover, Isometry3::identity()) } else { (carrier, pose * joint.origin) }
        });
        out.push(own.unwrap_or_else(|| (None, Isometry3::identity())));
    }
    out
}

fn tip(chain: &FingerChain) -> Capsule {
    Capsule { ends: [chain.center; 2], radius: (chain.pole - chain.center).norm() }
}

impl Capsule {
    /// True if it is the same but for rounding.
    fn is(&self, other: &Self) -> bool {
        let off = self.ends.iter().zip(&other.ends).map(|(a, b)| (a - b).norm()).fold(0.0, f64::max);
        off.max((self.radius - other.radius).abs()) < 1e-6
    }
}

impl Solid {
    /// As capsules in the frame in which the link has pose `pose`.
    fn capsules(&self, pose: &Isometry3<f64>) -> Vec<Capsule> {
        let make = |origin: &Isometry3<f64>, ends: [Vector3<f64>; 2], radius: f64| Capsule {
            ends: ends.map(|end| (pose * origin * Point3::from(end)).coords),
            radius,
        };
        match self {
            Self::Capsule { origin, radius, half } => {
                vec![make(origin, [-1.0, 1.0].map(|end| Vector3::z() * (end * half)), *radius)]
            }
            Self::Box { origin, half } => {
                let mut order = [0, 1, 2];
                order.sort_by(|&a, &b| half[b].total_cmp(&half[a]));
                let [long, wide, thin] = order;
                let radius = half[thin].max(PLATE * half[wide]);
                let (reach, side) = (half[long] - radius, half[wide] - radius);
                let count = if 2.0 * side < NARROW { 1 } else { 1 + (2.0 * side / radius).ceil() as usize };
                (0..count)
                    .map(|index| {
                        let share = if count == 1 { 0.0 } else { 2.0 * index as f64 / (count - 1) as f64 - 1.0 };
                        let mut ends = [Vector3::zeros(); 2];
                        for (end, sign) in ends.iter_mut().zip([-1.0, 1.0]) {
                            end[long] = sign * reach;
                            end[wide] = share * side;
                        }
                        make(origin, ends, radius)
                    })
                    .collect()
            }
        }
    }

    /// As a box in the frame in which the link has pose `pose`.
    fn rounded(&self, pose: &Isometry3<f64>) -> RoundedBox {
        let (origin, half, radius) = match self {
            Self::Capsule { origin, radius, half } => (origin, Vector3::z() * *half, *radius),
            Self::Box { origin, half } => {
                let radius = half.min().min(EDGE);
                (origin, half.map(|half| half - radius), radius)
            }
        };
        let pose = pose * origin;
        RoundedBox {
            center: pose.translation.vector,
            edges: pose.rotation.to_rotation_matrix().into_inner(),
            half,
            radius,
        }
    }
}

/// A capsule around `capsules`: between the means of their ends, which none leaves further at any point than at one of
/// its ends.
fn around(capsules: &[Capsule]) -> Capsule {
    let mean = |end: usize| capsules.iter().map(|own| own.ends[end]).sum::<Vector3<f64>>() / capsules.len() as f64;
    let ends = [mean(0), mean(1)];
    let off = |own: &Capsule| own.radius + (0..2).map(|end| (own.ends[end] - ends[end]).norm()).fold(0.0, f64::max);
    Capsule { ends, radius: capsules.iter().map(off).fold(0.0, f64::max) }
}
