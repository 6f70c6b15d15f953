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

use super::world::{BODIES, Contact, Other, Pair, World, flat};
use crate::hand::{BodyIndex, HandModel, JointVector, MAX_FINGER_JOINTS, MAX_FINGERS};

/// No command brings two bodies further into each other, m. Two fingertips: or `TIP_SLACK` more than they may.
pub const MAX_PENETRATION: f64 = 0.001;
/// Bodies that start further inside each other than that by this (m) are left alone until they are not: nothing says
/// which way is out.
const LOST: f64 = 0.005;
/// What rounding may take of the penetration, m.
const ROUNDING: f64 = 1e-6;
/// Gaps that differ by less are the same, m.
const SAME: f64 = 1e-9;
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
const MAX_NEAR: usize = 128;
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
    pairs: Vec<Pair>,
    // By body: radius of a sphere around it, m; furthest that a point of its axes can be from each joint before it, m.
    sizes: [f64; BODIES],
    levers: [[f64; MAX_FINGER_JOINTS]; BODIES],
}

/// A pair that is near: its number, its gap, and the least that it may get, m.
#[derive(Clone, Copy, Default)]
struct Near {
    pair: u16,
    gap: f64,
    least: f64,
}

#[derive(Clone)]
struct List<T, const N: usize> {
    items: [T; N],
    len: usize,
}

impl MotionGuard {
    /// A guard of `hand` that lets the spheres of fingertips overlap by `allowance` (m).
    #[must_use]
    pub fn new(hand: &HandModel, allowance: f64) -> Self {
        let (mut sizes, mut levers) = ([0.0; BODIES], [[0.0; MAX_FINGER_JOINTS]; BODIES]);
        for (finger, (chain, bodies)) in hand.fingers.iter().zip(&hand.collision.fingers).enumerate() {
            for (index, body) in bodies.iter().enumerate() {
                let [start, end] = body.bound.ends;
                sizes[flat((finger, index))] = body.bound.radius + 0.5 * (end - start).norm();
                let ends = body.capsules.iter().flat_map(|capsule| &capsule.ends);
                let mut lever = ends.map(Vector3::norm).fold(0.0, f64::max);
                for slot in (0..=body.slot).rev() {
                    levers[flat((finger, index))][slot] = lever;
                    lever += chain.joints[slot].translation.norm();
                }
            }
        }
        let collision = &hand.collision;
        let tip = |(finger, index): BodyIndex| collision.fingers[finger][index].tip;
        let fingers = collision.pairs.iter().map(|&[a, b]| {
            let [hold, stop] = if tip(a) && tip(b) {
                [allowance + SLACK, (allowance + TIP_SLACK).max(MAX_PENETRATION)]
            } else {
                [0.0, MAX_PENETRATION]
            };
            Pair { a: flat(a), other: Other::Body(flat(b)), hold, stop }
        });
        let palm = collision.palm_pairs.iter().map(|&(a, block)| Pair {
            a: flat(a),
            other: Other::Palm(block),
            hold: 0.0,
            stop: MAX_PENETRATION,
        });
        Self { pairs: fingers.chain(palm).collect(), sizes, levers }
    }

    /// The least gap of any two bodies that are kept apart, at `q` (rad, wire order), m; negative if they overlap.
    #[must_use]
    pub fn least_gap(&self, hand: &HandModel, q: &JointVector) -> f64 {
        let world = World::new(hand, q);
        self.pairs.iter().map(|pair| world.gap(hand, pair)).fold(f64::INFINITY, f64::min)
    }

    /// Changes `velocity` (rad/s, wire order), about to be commanded at posture `q` (rad) for `period` seconds, so that
    /// nothing collides.
    ///
    /// Each joint stays between `low` and `high` (rad/s), which is what it can do in this tick and contains the hardest
    /// braking. `movable` says which of the hand's fingers give way; the others do if that is not enough. The proof holds
    /// if the hand starts at rest and in every tick either passes through here or brakes as hard as it can, as
    /// [`Conditioner`](crate::conditioner::Conditioner) does in a hold. Does not allocate; bounded work.
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
        // By what the joints can do in this tick, and by what they do and are to do.
        let mut travels = [JointVector::zeros(q.len()); 2];
        for (index, joint) in hand.joints.iter().enumerate() {
            let (most, now) = (low[index].abs().max(high[index].abs()), 0.5 * (low[index] + high[index]).abs());
            for (travel, speed) in travels.iter_mut().zip([most, now.max(velocity[index].abs())]) {
                travel[index] = speed * speed / joint.acceleration + 2.0 * speed * period;
            }
        }
        let [ways, asked] = travels.map(|travel| self.ways(hand, &travel));
        let mut near = List::<Near, MAX_NEAR>::new();
        let mut contacts = List::<Contact, MAX_CONTACTS>::new();
        let mut complete = true;
        for (index, pair) in self.pairs.iter().enumerate() {
            let reach = pair.way(&ways);
            if self.clear(hand, &world, pair, reach) {
                continue;
            }
            let gap = world.gap(hand, pair);
            if gap + pair.hold >= reach || gap < -pair.stop - LOST {
                continue;
            }
            complete &= near.push(Near { pair: index as u16, gap, least: gap.min(ROUNDING - pair.stop) });
            let reach = pair.way(&asked);
            if gap + pair.hold >= reach.max(SAME) {
                continue;
            }
            world.each(hand, pair, |points, radii| {
                let room = (points[1] - points[0]).norm() - radii + pair.hold;
                if room < reach.max(SAME) {
                    contacts.push_worst(world.contact(hand, pair, points, room, movable));
                }
            });
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
            for finger in self.pairs[pair].fingers() {
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
        let (mut x, mut v) = (*q, *velocity);
        // What each joint has to go: v, v - a dt, .. for a tick each; and in the next tick alone.
        let (mut travel, mut step) = (JointVector::zeros(q.len()), JointVector::zeros(q.len()));
        let braking = |speed: f64, acceleration: f64| speed * speed / (2.0 * acceleration) + speed * period;
        for (index, joint) in hand.joints.iter().enumerate() {
            travel[index] = braking(v[index].abs(), joint.acceleration);
            step[index] = v[index].abs() * period;
        }
        let mut open = List::<Near, MAX_NEAR>::new();
        let (ways, steps) = (self.ways(hand, &travel), self.ways(hand, &step));
        let mut involved = [false; MAX_FINGERS];
        // Ticks for which nothing can get too near.
        let ticks = |pair: &Pair, room: f64, steps: &[f64; BODIES]| (room.max(0.0) / pair.way(steps)) as usize;
        let mut idle = MAX_BRAKING;
        for item in &near.items[..near.len] {
            let pair = &self.pairs[usize::from(item.pair)];
            // What is too far away for the way to brake needs no look.
            if item.gap < item.least + pair.way(&ways) {
                open.push(*item);
                idle = idle.min(ticks(pair, item.gap - item.least, &steps));
                pair.fingers().for_each(|finger| involved[finger] = true);
            }
        }
        for _ in 0..MAX_BRAKING {
            if open.len == 0 {
                return None;
            }
            for (finger, chain) in hand.fingers.iter().enumerate().filter(|(finger, _)| involved[*finger]) {
                for joint in &chain.joints {
                    let (index, limits) = (joint.joint, &hand.joints[joint.joint]);
                    x[index] = (x[index] + v[index] * period).clamp(limits.lower, limits.upper);
                    let speed = (v[index].abs() - limits.acceleration * period).max(0.0);
                    v[index] = speed.copysign(v[index]);
                    travel[index] = braking(speed, limits.acceleration);
                    step[index] = speed * period;
                }
                if idle == 0 {
                    world.place(hand, finger, &x);
                }
            }
            if idle > 0 {
                idle -= 1;
                continue;
            }
            let (ways, steps) = (self.ways(hand, &travel), self.ways(hand, &step));
            idle = MAX_BRAKING;
            let mut index = 0;
            while index < open.len {
                let Near { pair: number, least, .. } = open.items[index];
                let pair = &self.pairs[usize::from(number)];
                let reach = least + pair.way(&ways);
                if self.clear(hand, world, pair, reach) {
                    open.remove(index);
                    continue;
                }
                let gap = world.gap(hand, pair);
                if gap < least - SAME {
                    return Some(usize::from(number));
                }
                if gap >= reach - SAME {
                    open.remove(index);
                } else {
                    idle = idle.min(ticks(pair, gap - least, &steps));
                    index += 1;
                }
            }
        }
        (open.len > 0).then(|| usize::from(open.items[0].pair))
    }

    /// The most that each body can move if each joint travels as far as `travel` (rad), m.
    fn ways(&self, hand: &HandModel, travel: &JointVector) -> [f64; BODIES] {
        let mut out = [0.0; BODIES];
        for (finger, (chain, bodies)) in hand.fingers.iter().zip(&hand.collision.fingers).enumerate() {
            for index in 0..bodies.len() {
                let body = flat((finger, index));
                let levers = self.levers[body].iter().zip(&chain.joints);
                out[body] = levers.map(|(lever, joint)| lever * travel[joint.joint]).sum();
            }
        }
        out
    }

    /// True if a pair is further apart than `reach` for sure.
    #[inline]
    fn clear(&self, hand: &HandModel, world: &World, pair: &Pair, reach: f64) -> bool {
        // Spheres first, they are cheap.
        let (apart, size) = match pair.other {
            Other::Body(b) => ((world.middles[b] - world.middles[pair.a]).norm_squared(), self.sizes[b]),
            Other::Palm(block) => {
                let block = &hand.collision.palm[block];
                (block.squared(&world.middles[pair.a]), block.radius)
            }
        };
        let size = self.sizes[pair.a] + size + reach;
        apart > size * size || world.bounds_clear(hand, pair, reach)
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
            let parting: f64 = contact.own(true).map(|(joint, slope)| slope * velocity[joint]).sum();
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
