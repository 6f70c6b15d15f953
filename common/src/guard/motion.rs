//! Commands: keeps bodies out of each other on the way.
//!
//! Two layers, every tick, over the pairs of bodies that are near for their speed:
//!
//! 1. *Slowing* changes the velocities as little as possible so that every gap closes no faster than it can be braked,
//!    and what overlaps parts. This is what makes contacts smooth: bodies slow down, touch, and slide along each other.
//! 2. *Proof*: the new velocities are kept only if braking all joints as hard as allowed right after this tick would
//!    bring the hand to rest without a penetration of more than [`MAX_PENETRATION`] at any tick. Otherwise the fingers
//!    concerned brake instead, which the proof of the tick before has shown to be safe. So by induction every command
//!    is, whatever the targets, for any acceleration limit, and also while the conditioner holds.
//!
//! A pair is near if its gap is smaller than the way that both bodies can cover while braking, by a bound that is a
//! sum over the joints. With velocity v_j, acceleration a_j and lever l_j (no point of the body is further from the
//! joint), the slowing law |d'| <= sqrt(d sum_j |s_j| a_j), of slopes |s_j| <= l_j, cannot ask for anything as long as
//! d >= sum_j l_j v_j^2 / a_j (Cauchy-Schwarz), which is twice the way to brake.

use nalgebra::Vector3;

use super::direction;
use crate::hand::{
    Body, BodyIndex, Capsule, Frame, HandModel, JointVector, MAX_BODIES, MAX_FINGER_JOINTS, MAX_FINGERS, Nearest,
    RoundedBox, between_segments,
};

/// No command brings two bodies further into each other, m. Two fingertips: or [`TIP_SLACK`] more than they may.
pub const MAX_PENETRATION: f64 = 0.001;
/// What rounding may take of it, m.
const ROUNDING: f64 = 1e-6;
/// Overlap of two tips over the allowance before they are held back, m, and before they are stopped.
const SLACK: f64 = 0.0003;
const TIP_SLACK: f64 = 0.0005;

/// How fast an overlap is undone, 1/s.
const PUSH: f64 = 20.0;
/// Sweeps over the contacts when slowing.
const SWEEPS: usize = 8;
/// Contacts slowed at once; of more, those with the largest gaps are left to the proof.
const MAX_CONTACTS: usize = 32;
/// A contact that parts slower than it should by less than this is as good, m/s.
const SETTLED: f64 = 1e-5;
/// Pairs proved at once; with more, everything brakes.
const MAX_NEAR: usize = 192;
/// Ticks of braking looked at; a hand that would take longer brakes before something near.
const MAX_BRAKING: usize = 64;
/// Times that the fingers of a pair are slowed further for the proof.
const MAX_ROUNDS: usize = 8;
/// How much of the way from braking to what was wanted a finger gets, in turns.
const SHARES: [f64; 4] = [1.0, 0.5, 0.2, 0.0];

/// What the guard did in a tick.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Intervention {
    /// Nothing: nothing is near, or it moves away.
    #[default]
    None,
    /// Changed velocities so that bodies do not run into each other.
    Slowed,
    /// Braked, because without the proof could not be given.
    Braked,
}

/// Keeps the commands of one hand from collisions with itself.
#[derive(Clone, Debug)]
pub struct MotionGuard {
    // Overlap at which two tips are held back, and at which they are stopped, m.
    tips: [f64; 2],
    // Furthest that a point of the axes of a body can be from each joint before it, m.
    levers: Box<[[[f64; MAX_FINGER_JOINTS]; MAX_BODIES]; MAX_FINGERS]>,
}

/// What a body may run into.
#[derive(Clone, Copy)]
enum Other {
    Body(BodyIndex),
    Palm(usize),
}

/// A pair that is near, by its number, and the least gap it may get, m.
#[derive(Clone, Copy, Default)]
struct Near {
    pair: usize,
    least: f64,
}

#[derive(Clone)]
struct List<T, const N: usize> {
    items: [T; N],
    len: usize,
}

/// A pair of capsules: how fast its gap grows by the joints of the two fingers.
#[derive(Clone, Copy, Default)]
struct Contact {
    joints: [usize; 2 * MAX_FINGER_JOINTS],
    slopes: [f64; 2 * MAX_FINGER_JOINTS],
    // Of the finger that gives way. Without one that may, both do.
    moves: [bool; 2 * MAX_FINGER_JOINTS],
    len: usize,
    room: f64,
}

/// The hand in a posture.
struct World {
    frames: [[Frame; MAX_FINGER_JOINTS]; MAX_FINGERS],
    bounds: [[Capsule; MAX_BODIES]; MAX_FINGERS],
}

impl MotionGuard {
    /// A guard of `hand` that lets the spheres of fingertips overlap by `allowance` (m).
    #[must_use]
    pub fn new(hand: &HandModel, allowance: f64) -> Self {
        let mut levers = Box::new([[[0.0; MAX_FINGER_JOINTS]; MAX_BODIES]; MAX_FINGERS]);
        for ((chain, bodies), levers) in hand.fingers.iter().zip(&hand.collision.fingers).zip(levers.iter_mut()) {
            for (body, levers) in bodies.iter().zip(levers) {
                let ends = body.capsules.iter().flat_map(|capsule| &capsule.ends);
                let mut lever = ends.map(Vector3::norm).fold(0.0, f64::max);
                for slot in (0..=body.slot).rev() {
                    levers[slot] = lever;
                    lever += chain.joints[slot].translation.norm();
                }
            }
        }
        Self { tips: [allowance + SLACK, (allowance + TIP_SLACK).max(MAX_PENETRATION)], levers }
    }

    /// How far any two bodies that are kept apart are inside each other at `q` (rad, wire order), m; negative if all are
    /// apart. Fingertips count by what they overlap beyond what they may.
    #[must_use]
    pub fn deepest(&self, hand: &HandModel, q: &JointVector) -> f64 {
        let world = World::new(hand, q);
        (0..pairs(hand)).map(|pair| self.may(hand, pair)[0] - world.gap(hand, pair)).fold(f64::NEG_INFINITY, f64::max)
    }

    /// Changes `velocity` (rad/s, wire order), about to be commanded at posture `q` (rad) for `period` seconds, so that
    /// nothing collides.
    ///
    /// Each joint stays between `low` and `high` (rad/s), which is what it can do in this tick and contains the hardest
    /// braking. `movable` says which of the hand's fingers give way; the others do if that is not enough. Does not
    /// allocate; bounded work.
    pub fn guard(
        &self,
        hand: &HandModel,
        q: &JointVector,
        movable: &[bool; MAX_FINGERS],
        velocity: &mut JointVector,
        [low, high]: [&JointVector; 2],
        period: f64,
    ) -> Intervention {
        let mut world = World::new(hand, q);
        let mut travel = JointVector::zeros(q.len());
        for (index, joint) in hand.joints.iter().enumerate() {
            let speed = low[index].abs().max(high[index].abs());
            travel[index] = speed * speed / joint.acceleration + 2.0 * speed * period;
        }
        let mut near = List::<Near, MAX_NEAR>::new();
        let mut contacts = List::<Contact, MAX_CONTACTS>::new();
        let mut complete = true;
        for pair in 0..pairs(hand) {
            let [hold, stop] = self.may(hand, pair);
            let reach = self.reach(hand, pair, &travel);
            if world.clear(hand, pair, reach) {
                continue;
            }
            let mut gap = f64::INFINITY;
            world.each(hand, pair, |points, radii| {
                let own = (points[1] - points[0]).norm() - radii;
                gap = gap.min(own);
                if own + hold < reach {
                    contacts.push_worst(world.contact(hand, pair, points, own + hold, movable));
                }
            });
            if gap + hold < reach {
                complete &= near.push(Near { pair, least: gap.min(ROUNDING - stop) });
            }
        }
        if near.len == 0 {
            return Intervention::None;
        }
        let wanted = *velocity;
        let contacts = &contacts.items[..contacts.len];
        if !relax(hand, contacts, velocity, [low, high], period, false) {
            relax(hand, contacts, velocity, [low, high], period, true);
        }
        let slowed = if *velocity == wanted { Intervention::None } else { Intervention::Slowed };

        // As close to what is wanted as can be proved.
        let wanted = *velocity;
        let mut turns = [if complete { 0 } else { SHARES.len() - 1 }; MAX_FINGERS];
        for _ in 0..MAX_ROUNDS {
            for (chain, turn) in hand.fingers.iter().zip(&turns) {
                for joint in &chain.joints {
                    let (joint, share) = (joint.joint, SHARES[*turn]);
                    let braked = 0.0_f64.max(low[joint]).min(high[joint]);
                    velocity[joint] =
                        if *turn == 0 { wanted[joint] } else { braked + (wanted[joint] - braked) * share };
                }
            }
            let Some(pair) = self.collides(hand, q, velocity, &near, &mut world, period) else {
                return if turns == [0; MAX_FINGERS] { slowed } else { Intervention::Braked };
            };
            let mut changed = false;
            let ((a, _), other) = members(hand, pair);
            let b = if let Other::Body((b, _)) = other { b } else { a };
            for finger in [a, b] {
                changed |= turns[finger] + 1 < SHARES.len();
                turns[finger] = (turns[finger] + 1).min(SHARES.len() - 1);
            }
            if !changed {
                break;
            }
        }
        velocity.iter_mut().enumerate().for_each(|(joint, own)| *own = 0.0_f64.max(low[joint]).min(high[joint]));
        Intervention::Braked
    }

    /// Moves by `velocity` for a tick, then brakes: the pair that gets too far into each other, if any does.
    fn collides(
        &self,
        hand: &HandModel,
        q: &JointVector,
        velocity: &JointVector,
        near: &List<Near, MAX_NEAR>,
        world: &mut World,
        period: f64,
    ) -> Option<usize> {
        let (mut x, mut v, mut open) = (*q, *velocity, near.clone());
        let mut travel = JointVector::zeros(q.len());
        for _ in 0..MAX_BRAKING {
            let mut involved = [false; MAX_FINGERS];
            for item in &open.items[..open.len] {
                let ((a, _), other) = members(hand, item.pair);
                involved[a] = true;
                if let Other::Body((b, _)) = other {
                    involved[b] = true;
                }
            }
            for (finger, chain) in hand.fingers.iter().enumerate().filter(|(finger, _)| involved[*finger]) {
                for joint in &chain.joints {
                    let (index, limits) = (joint.joint, &hand.joints[joint.joint]);
                    x[index] = (x[index] + v[index] * period).clamp(limits.lower, limits.upper);
                    let speed = (v[index].abs() - limits.acceleration * period).max(0.0);
                    v[index] = speed.copysign(v[index]);
                    // What is left to go: n a dt + (n - 1) a dt + .. for n ticks, and a rest of less than a tick.
                    travel[index] = speed * speed / (2.0 * limits.acceleration) + speed * period;
                }
                world.place(hand, finger, &x);
            }
            let mut index = 0;
            while index < open.len {
                let Near { pair, least } = open.items[index];
                let reach = self.reach(hand, pair, &travel);
                if world.clear(hand, pair, least + reach) {
                    open.remove(index);
                    continue;
                }
                let gap = world.gap(hand, pair);
                if gap < least - 1e-9 {
                    return Some(pair);
                }
                if gap >= least + reach - 1e-9 { open.remove(index) } else { index += 1 }
            }
            if open.len == 0 {
                return None;
            }
        }
        Some(open.items[0].pair)
    }

    /// Overlap (m) at which a pair is held back, and at which it is stopped.
    fn may(&self, hand: &HandModel, pair: usize) -> [f64; 2] {
        match members(hand, pair) {
            (a, Other::Body(b)) if body(hand, a).tip && body(hand, b).tip => self.tips,
            _ => [0.0, MAX_PENETRATION],
        }
    }

    /// The most that a pair can close if each joint travels as far as `travel` (rad), m.
    fn reach(&self, hand: &HandModel, pair: usize, travel: &JointVector) -> f64 {
        let way = |(finger, body): BodyIndex| {
            let joints = hand.fingers[finger].joints.iter();
            joints.zip(&self.levers[finger][body]).map(|(joint, lever)| lever * travel[joint.joint]).sum::<f64>()
        };
        match members(hand, pair) {
            (a, Other::Body(b)) => way(a) + way(b),
            (a, Other::Palm(_)) => way(a),
        }
    }
}

/// Slows until every contact parts as fast as it should; false if some cannot. `all`: everybody gives way.
///
/// Least change in the squares by Gauss-Seidel over the contacts, among the joints that are not at their end.
fn relax(
    hand: &HandModel,
    contacts: &[Contact],
    velocity: &mut JointVector,
    [low, high]: [&JointVector; 2],
    period: f64,
    all: bool,
) -> bool {
    let mut allowed = [0.0; MAX_CONTACTS];
    for (allowed, contact) in allowed.iter_mut().zip(contacts) {
        let gain: f64 = contact.own(all).map(|(joint, slope)| slope.abs() * hand.joints[joint].acceleration).sum();
        // Half of what the joints can do is left to what else they have to do.
        *allowed = if contact.room > 0.0 {
            -(gain * contact.room).sqrt().min(0.5 * contact.room / period)
        } else {
            -contact.room * PUSH
        };
    }
    for _ in 0..SWEEPS {
        let mut settled = true;
        for (contact, allowed) in contacts.iter().zip(&allowed) {
            let joints = contact.joints.iter().zip(&contact.slopes).take(contact.len);
            let parting: f64 = joints.map(|(&joint, slope)| slope * velocity[joint]).sum();
            if parting >= allowed - SETTLED {
                continue;
            }
            settled = false;
            let free = |joint: usize, slope: f64| {
                if slope > 0.0 { velocity[joint] < high[joint] } else { velocity[joint] > low[joint] }
            };
            let grip: f64 =
                contact.own(all).filter(|&(joint, slope)| free(joint, slope)).map(|(_, slope)| slope * slope).sum();
            if grip < 1e-12 {
                continue;
            }
            let share = (allowed - parting) / grip;
            for (joint, slope) in contact.own(all) {
                velocity[joint] = (velocity[joint] + slope * share).max(low[joint]).min(high[joint]);
            }
        }
        if settled {
            return true;
        }
    }
    false
}

impl Contact {
    /// Joints that give way, and what they do to the gap, m/rad.
    fn own(&self, all: bool) -> impl Iterator<Item = (usize, f64)> {
        let joints = self.joints.iter().copied().zip(self.slopes.iter().copied()).zip(self.moves).take(self.len);
        joints.filter(move |(_, moves)| all || *moves).map(|(joint, _)| joint)
    }
}

impl World {
    fn new(hand: &HandModel, q: &JointVector) -> Self {
        let nothing = Capsule { ends: [Vector3::zeros(); 2], radius: 0.0 };
        let mut out = Self {
            frames: [[Frame::default(); MAX_FINGER_JOINTS]; MAX_FINGERS],
            bounds: [[nothing; MAX_BODIES]; MAX_FINGERS],
        };
        for finger in 0..hand.fingers.len() {
            out.place(hand, finger, q);
        }
        out
    }

    fn place(&mut self, hand: &HandModel, finger: usize, q: &JointVector) {
        let chain = &hand.fingers[finger];
        chain.frames(&chain.select(q)[..chain.joints.len()], &mut self.frames[finger]);
        for (body, bound) in hand.collision.fingers[finger].iter().zip(&mut self.bounds[finger]) {
            *bound = self.frames[finger][body.slot].capsule(&body.bound);
        }
    }

    /// True if a pair is further apart than `reach` for sure.
    fn clear(&self, hand: &HandModel, pair: usize, reach: f64) -> bool {
        let ((finger, body), other) = members(hand, pair);
        let own = &self.bounds[finger][body];
        // Spheres first, they are cheap.
        let middle = |ends: &[Vector3<f64>; 2]| (ends[0] + ends[1]) * 0.5;
        let half = |ends: &[Vector3<f64>; 2]| (ends[1] - ends[0]).norm_squared().sqrt() * 0.5;
        let far = |center: Vector3<f64>, radius: f64| {
            let apart = own.radius + half(&own.ends) + radius + reach;
            (center - middle(&own.ends)).norm_squared() > apart * apart
        };
        let (points, radius) = match other {
            Other::Body((finger, body)) => {
                let other = &self.bounds[finger][body];
                if far(middle(&other.ends), other.radius + half(&other.ends)) {
                    return true;
                }
                (between_segments(&own.ends, &other.ends), other.radius)
            }
            Other::Palm(block) => {
                let block = &hand.collision.palm[block];
                if far(block.pose.translation.vector, block.radius + block.half.norm()) {
                    return true;
                }
                (block.nearest(&own.ends), block.radius)
            }
        };
        let apart = own.radius + radius + reach;
        (points[1] - points[0]).norm_squared() > apart * apart
    }

    /// The gap of a pair, m.
    fn gap(&self, hand: &HandModel, pair: usize) -> f64 {
        let mut gap = f64::INFINITY;
        self.each(hand, pair, |points, radii| gap = gap.min((points[1] - points[0]).norm() - radii));
        gap
    }

    /// The nearest points of the axes of all the capsules of a pair, and the sum of their radii.
    fn each(&self, hand: &HandModel, pair: usize, mut visit: impl FnMut(Nearest, f64)) {
        let (a, other) = members(hand, pair);
        for own in &body(hand, a).capsules {
            let own = self.frames[a.0][body(hand, a).slot].capsule(own);
            match other {
                Other::Body(b) => {
                    let frame = &self.frames[b.0][body(hand, b).slot];
                    for other in &body(hand, b).capsules {
                        let other = frame.capsule(other);
                        visit(between_segments(&own.ends, &other.ends), own.radius + other.radius);
                    }
                }
                Other::Palm(block) => {
                    let block: &RoundedBox = &hand.collision.palm[block];
                    visit(block.nearest(&own.ends), own.radius + block.radius);
                }
            }
        }
    }

    fn contact(
        &self,
        hand: &HandModel,
        pair: usize,
        points: Nearest,
        room: f64,
        movable: &[bool; MAX_FINGERS],
    ) -> Contact {
        let normal = direction(points[1] - points[0]);
        let (a, other) = members(hand, pair);
        let mut out = Contact { room, ..Contact::default() };
        let mut add = |(finger, index): BodyIndex, point: Vector3<f64>, sign: f64, moves: bool| {
            let slots = 0..=body(hand, (finger, index)).slot;
            for (joint, frame) in hand.fingers[finger].joints[slots].iter().zip(&self.frames[finger]) {
                out.joints[out.len] = joint.joint;
                out.slopes[out.len] = sign * frame.axis.cross(&(point - frame.position)).dot(&normal);
                out.moves[out.len] = moves;
                out.len += 1;
            }
        };
        if let Other::Body(b) = other {
            let neither = !movable[a.0] && !movable[b.0];
            add(a, points[0], -1.0, movable[a.0] || neither);
            add(b, points[1], 1.0, movable[b.0] || neither);
        } else {
            add(a, points[0], -1.0, true);
        }
        out
    }
}

/// How many pairs there are; those of fingers come first.
fn pairs(hand: &HandModel) -> usize {
    hand.collision.pairs.len() + hand.collision.palm_pairs.len()
}

fn members(hand: &HandModel, pair: usize) -> (BodyIndex, Other) {
    let collision = &hand.collision;
    match collision.pairs.get(pair) {
        Some(&[a, b]) => (a, Other::Body(b)),
        None => {
            let (a, block) = collision.palm_pairs[pair - collision.pairs.len()];
            (a, Other::Palm(block))
        }
    }
}

fn body(hand: &HandModel, (finger, index): BodyIndex) -> &Body {
    &hand.collision.fingers[finger][index]
}

impl<T: Copy + Default, const N: usize> List<T, N> {
    fn new() -> Self {
        Self { items: [T::default(); N], len: 0 }
    }

    /// False if there is no room for it.
    fn push(&mut self, item: T) -> bool {
        let room = self.len < N;
        if room {
            self.items[self.len] = item;
            self.len += 1;
        }
        room
    }

    fn remove(&mut self, index: usize) {
        self.len -= 1;
        self.items[index] = self.items[self.len];
    }
}

impl<const N: usize> List<Contact, N> {
    /// Takes the place of the one with the largest gap where there is no room.
    fn push_worst(&mut self, contact: Contact) {
        if !self.push(contact)
            && let Some(last) = self.items.iter_mut().max_by(|a, b| a.room.total_cmp(&b.room))
            && contact.room < last.room
        {
            *last = contact;
        }
    }
}
