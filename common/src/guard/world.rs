//! The hand's bodies in a posture: which pairs are watched, how far they are apart, and how their joints change that.

use nalgebra::Vector3;

use super::direction;
use crate::hand::{
    Body, BodyIndex, Frame, HandModel, JointVector, MAX_BODIES, MAX_FINGER_JOINTS, MAX_FINGERS, Nearest,
    between_segments,
};

/// Room for the bodies of all fingers, those of one finger in a row.
pub(super) const BODIES: usize = MAX_FINGERS * MAX_BODIES;

/// Two bodies, or a body and a box of the palm.
#[derive(Clone, Copy, Debug)]
pub(super) struct Pair {
    pub(super) a: usize,
    pub(super) other: Other,
    // Overlap at which they are held back, and at which they are stopped, m.
    pub(super) hold: f64,
    pub(super) stop: f64,
}

#[derive(Clone, Copy, Debug)]
pub(super) enum Other {
    Body(usize),
    Palm(usize),
}

/// A pair of capsules: how fast its gap grows by the joints of the two fingers.
#[derive(Clone, Copy, Default)]
pub(super) struct Contact {
    pub(super) slopes: [f64; 2 * MAX_FINGER_JOINTS],
    pub(super) joints: [u8; 2 * MAX_FINGER_JOINTS],
    // Of the finger that gives way. Without one that may, both do.
    pub(super) moves: [bool; 2 * MAX_FINGER_JOINTS],
    pub(super) len: u8,
    pub(super) room: f64,
}

/// The hand in a posture.
pub(super) struct World {
    pub(super) frames: [[Frame; MAX_FINGER_JOINTS]; MAX_FINGERS],
    // Axis of the capsule around each body, and its middle.
    pub(super) axes: [[Vector3<f64>; 2]; BODIES],
    pub(super) middles: [Vector3<f64>; BODIES],
}

impl Pair {
    /// The most that the gap can close, m.
    pub(super) fn way(&self, ways: &[f64; BODIES]) -> f64 {
        ways[self.a] + if let Other::Body(b) = self.other { ways[b] } else { 0.0 }
    }

    pub(super) fn fingers(&self) -> impl Iterator<Item = usize> {
        let other = if let Other::Body(b) = self.other { Some(b / MAX_BODIES) } else { None };
        std::iter::once(self.a / MAX_BODIES).chain(other)
    }
}

impl Contact {
    /// Joints that give way, and what they do to the gap, m/rad.
    pub(super) fn own(&self, all: bool) -> impl Iterator<Item = (usize, f64)> {
        let joints = self.joints.iter().zip(&self.slopes).zip(&self.moves).take(usize::from(self.len));
        joints.filter(move |(_, moves)| all || **moves).map(|((&joint, &slope), _)| (usize::from(joint), slope))
    }
}

impl World {
    pub(super) fn new(hand: &HandModel, q: &JointVector) -> Self {
        let mut out = Self {
            frames: [[Frame::default(); MAX_FINGER_JOINTS]; MAX_FINGERS],
            axes: [[Vector3::zeros(); 2]; BODIES],
            middles: [Vector3::zeros(); BODIES],
        };
        for finger in 0..hand.fingers.len() {
            out.place(hand, finger, q);
        }
        out
    }

    pub(super) fn place(&mut self, hand: &HandModel, finger: usize, q: &JointVector) {
        let chain = &hand.fingers[finger];
        let frames = &mut self.frames[finger];
        chain.frames(&chain.select(q)[..chain.joints.len()], frames);
        for (index, body) in hand.collision.fingers[finger].iter().enumerate() {
            let axis = frames[body.slot].capsule(&body.bound).ends;
            self.middles[flat((finger, index))] = (axis[0] + axis[1]) * 0.5;
            self.axes[flat((finger, index))] = axis;
        }
    }

    /// The same by the capsules around the bodies.
    pub(super) fn bounds_clear(&self, hand: &HandModel, pair: &Pair, reach: f64) -> bool {
        let own = &self.axes[pair.a];
        let ([p, q], radius) = match pair.other {
            Other::Body(b) => (between_segments(own, &self.axes[b]), body(hand, b).bound.radius),
            Other::Palm(block) => (hand.collision.palm[block].nearest(own), hand.collision.palm[block].radius),
        };
        let size = body(hand, pair.a).bound.radius + radius + reach;
        (q - p).norm_squared() > size * size
    }

    /// The gap of a pair, m.
    pub(super) fn gap(&self, hand: &HandModel, pair: &Pair) -> f64 {
        let mut gap = f64::INFINITY;
        self.each(hand, pair, |points, radii| gap = gap.min((points[1] - points[0]).norm() - radii));
        gap
    }

    /// The nearest points of the axes of all the capsules of a pair, and the sum of their radii.
    pub(super) fn each(&self, hand: &HandModel, pair: &Pair, mut visit: impl FnMut(Nearest, f64)) {
        let frame = |index: usize| &self.frames[index / MAX_BODIES][body(hand, index).slot];
        for own in &body(hand, pair.a).capsules {
            let own = frame(pair.a).capsule(own);
            match pair.other {
                Other::Body(b) => {
                    for other in &body(hand, b).capsules {
                        let other = frame(b).capsule(other);
                        visit(between_segments(&own.ends, &other.ends), own.radius + other.radius);
                    }
                }
                Other::Palm(block) => {
                    let block = &hand.collision.palm[block];
                    visit(block.nearest(&own.ends), own.radius + block.radius);
                }
            }
        }
    }

    pub(super) fn contact(
        &self,
        hand: &HandModel,
        pair: &Pair,
        points: Nearest,
        room: f64,
        movable: &[bool; MAX_FINGERS],
    ) -> Contact {
        let normal = direction(points[1] - points[0]);
        let mut out = Contact { room, ..Contact::default() };
        let anyone = pair.fingers().any(|finger| movable[finger]);
        let mut add = |index: usize, point: Vector3<f64>, sign: f64| {
            let finger = index / MAX_BODIES;
            let slots = 0..=body(hand, index).slot;
            for (joint, frame) in hand.fingers[finger].joints[slots].iter().zip(&self.frames[finger]) {
                let slot = usize::from(out.len);
                out.joints[slot] = joint.joint as u8;
                out.slopes[slot] = sign * frame.axis.cross(&(point - frame.position)).dot(&normal);
                out.moves[slot] = movable[finger] || !anyone;
                out.len += 1;
            }
        };
        add(pair.a, points[0], -1.0);
        if let Other::Body(b) = pair.other {
            add(b, points[1], 1.0);
        }
        out
    }
}

/// The number of a body.
pub(super) const fn flat((finger, index): BodyIndex) -> usize {
    finger * MAX_BODIES + index
}

pub(super) fn body(hand: &HandModel, index: usize) -> &Body {
    &hand.collision.fingers[index / MAX_BODIES][index % MAX_BODIES]
}
