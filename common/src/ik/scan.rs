//! Where the optima of a finger like the Allegro's can be: a scan of its self-motion in closed form.
//!
//! All fingers of the Allegro, its thumb included, end in a *roll* joint followed by flexion joints with parallel axes,
//! across the roll axis, and move the tip in a plane that contains the roll axis. Four joints are one more than a point
//! needs, so with one joint held the rest has a closed form:
//!
//! ```text
//! finger:  roll, SWEEP, alpha, beta       thumb:  SWEEP, roll, alpha, beta
//! ```
//!
//! the roll from the target's direction around the roll axis (in front or behind), alpha and beta as a planar arm of two
//! links (elbow up or down), each in its limits, and where the target is out of reach the nearest point of the arcs
//! that bound the arm's reach. Sweeping the held joint over its range, with a stop wherever one of the
//! others meets a limit, passes every valley.

use std::f64::consts::{FRAC_PI_2, PI, TAU};

use nalgebra::{Complex, Matrix3, Vector3};

use super::{Angles, N};
use crate::hand::FingerChain;

/// Angles of the held joint that are always tried.
const NODES: usize = 37;
/// Every how manieth of them is tried with a start; the last one has to be among them.
const WARM_STRIDE: usize = 3;
/// Most angles that are tried besides.
const EVENTS: usize = 17;
/// Most seeds.
pub(super) const SEEDS: usize = 5;

// Angles in here are good to this, rad.
const TOLERANCE: f64 = 5e-4;

type Plane = Complex<f64>;

/// One joint of the four, in the order roll, sweep, alpha, beta: its slot in the chain, the sense of its angle here
/// (+1 or -1), and its limits in that sense, rad.
#[derive(Clone, Copy, Debug)]
struct Role {
    slot: usize,
    sense: f64,
    lower: f64,
    upper: f64,
}

impl Role {
    fn new(slot: usize, sense: f64, lower: &Angles, upper: &Angles) -> Self {
        let (a, b) = (sense * lower[slot], sense * upper[slot]);
        Self { slot, sense, lower: a.min(b), upper: a.max(b) }
    }

    /// `angle` plus whole turns, as near to the range as they bring it, and clipped into it.
    fn clip(&self, angle: f64) -> (f64, bool) {
        let middle = 0.5 * (self.lower + self.upper);
        let mut away = angle - middle;
        if away > PI {
            away -= TAU;
        } else if away < -PI {
            away += TAU;
        }
        let half = 0.5 * (self.upper - self.lower);
        (middle + away.clamp(-half, half), away.abs() <= half + TOLERANCE)
    }
}

/// Link 1 and 2 of the planar arm held stiff at some beta: the vector from its shoulder to the tip.
#[derive(Clone, Copy, Debug)]
struct Stiff {
    beta: f64,
    length: f64,
    direction: f64,
    /// Tip at the lower and upper limit of alpha.
    ends: [Plane; 2],
}

/// The geometry of a finger whose last joints are roll, alpha and beta.
#[derive(Clone, Debug)]
pub(super) struct Scan {
    roll: Role,
    sweep: Role,
    alpha: Role,
    beta: Role,
    // Roll axis, in-plane direction across it and normal of the finger's plane at zero: the rows, palm frame.
    frame: Matrix3<f64>,
    origin: Vector3<f64>,
    // Axis and a point of the held joint if it comes before the roll.
    prefix: Option<(Vector3<f64>, Vector3<f64>)>,
    // In the plane (along the roll axis + i across it): roll origin to the held joint, held joint to the arm's shoulder.
    shoulder: [Plane; 2],
    links: [Plane; 2],
    lengths: [f64; 2],
    // beta of the stretched arm.
    straight: f64,
    // Range of the cosine of the elbow's bend, forwards and backwards, in which beta can be inside its limits.
    bends: [(f64, f64); 2],
    // Angle of the held joint and its e^i at every node.
    nodes: [(f64, Plane); NODES],
    alpha_ends: [Plane; 2],
    // sin and cos.
    roll_ends: [(f64, f64); 2],
    stiff: Vec<Stiff>,
}

/// The target in the frame of the roll axis, as a function of the held joint.
struct Way {
    fixed: Vector3<f64>,
    turned: Vector3<f64>,
    crossed: Vector3<f64>,
}

impl Way {
    fn new(scan: &Scan, target: &Vector3<f64>) -> Self {
        let Some((axis, point)) = &scan.prefix else {
            let fixed = scan.frame * (target - scan.origin);
            return Self { fixed, turned: Vector3::zeros(), crossed: Vector3::zeros() };
        };
        let way = target - point;
        let along = axis * axis.dot(&way);
        Self {
            fixed: scan.frame * (along + point - scan.origin),
            turned: scan.frame * (way - along),
            // The target turns back where the joint turns forth.
            crossed: scan.frame * way.cross(axis),
        }
    }

    fn at(&self, turn: Plane) -> Vector3<f64> {
        self.fixed + self.turned * turn.re + self.crossed * turn.im
    }
}

/// Angles of the held joint to try, rising, with their e^i.
struct Nodes<'a> {
    sweep: &'a Role,
    list: [(f64, Plane); NODES + EVENTS],
    count: usize,
}

impl Nodes<'_> {
    /// Adds the roots of `a + b cos + c sin` in the range.
    fn add_roots(&mut self, a: f64, b: f64, c: f64) {
        let size = (b * b + c * c).sqrt();
        if a.abs() > size {
            return;
        }
        let towards = Plane::new(b, c) / size;
        let cos = -a / size;
        let sin = (1.0 - cos * cos).sqrt();
        for turn in [Plane::new(cos, sin), Plane::new(cos, -sin)] {
            let turn = towards * turn;
            let (angle, inside) = self.sweep.clip(atan2_of(turn));
            if inside {
                self.add(angle, turn);
            }
        }
    }

    fn add(&mut self, angle: f64, turn: Plane) {
        if self.count < self.list.len() {
            let mut slot = self.count;
            while slot > 0 && self.list[slot - 1].0 > angle {
                self.list[slot] = self.list[slot - 1];
                slot -= 1;
            }
            self.list[slot] = (angle, turn);
            self.count += 1;
        }
    }
}

/// One sweep.
struct Pass<'a> {
    scan: &'a Scan,
    way: Way,
    // For a held joint behind the roll.
    rolls: [(f64, f64, f64); 2],
    wish: [f64; 4],
    weight: f64,
    cap: f64,
    // Squared length at and beyond which even the floor of a valley out of reach costs more than the cap.
    dear: f64,
    // Whether to look for the ends of valleys.
    ends: bool,
    // Whether postures count that do not reach the target.
    near: bool,
}

impl Pass<'_> {
    fn valleys(&mut self, nodes: &Nodes<'_>) -> [Seed; SEEDS] {
        let mut valleys = Valleys { found: [Seed::NONE; SEEDS], last: [Seed::NONE; 2], falling: [true; 2] };
        // Where the sweep was before, unless nothing there was worth a look.
        let mut before: Option<Plane> = None;
        for &(angle, turn) in &nodes.list[..nodes.count] {
            // No posture there can be nearer to the reference than this joint alone.
            if 0.5 * self.weight * (angle - self.wish[1]).powi(2) >= self.cap {
                if before.take().is_some() {
                    valleys.push(&[Seed::NONE; 2]);
                }
                continue;
            }
            let seeds = self.at(angle, turn);
            if let Some(before) = before.filter(|_| self.ends) {
                for (side, seed) in seeds.iter().enumerate() {
                    let last = &valleys.last[side];
                    if seed.reached != last.reached {
                        let end = if seed.reached { (*seed, turn, before) } else { (*last, before, turn) };
                        valleys.insert(self.end(side, end));
                    }
                }
            }
            valleys.push(&seeds);
            before = Some(turn);
            // What costs more than the best of all, and could not be less between two nodes, is of no use.
            if valleys.found[0].reached {
                self.cap = self.cap.min(valleys.found[0].cost + 2.0 * FLOOR_MARGIN * self.weight);
            }
        }
        valleys.push(&[Seed::NONE; 2]);
        valleys.found
    }

    /// The end of a valley between a posture that reaches, with the held joint at `inside`, and one that does not: it may
    /// be lowest there.
    fn end(&self, side: usize, (mut seed, mut inside, mut outside): (Seed, Plane, Plane)) -> Seed {
        let reach = (2.0 * seed.cost).sqrt() - NODE_MARGIN * self.weight.sqrt();
        if reach > 0.0 && 0.5 * reach * reach >= self.cap {
            return Seed::NONE;
        }
        // A stop of the sweep at an event is such an end already: look close by first.
        for share in [0.1, 0.5, 0.5, 0.5, 0.5] {
            let middle = inside * (1.0 - share) + outside * share;
            let middle = middle / middle.norm_sqr().sqrt();
            let found = self.at(self.scan.sweep.clip(atan2_of(middle)).0, middle)[side];
            if found.reached {
                (seed, inside) = (found, middle);
            } else if share < 0.5 {
                break;
            } else {
                outside = middle;
            }
        }
        seed
    }

    /// The best posture with the held joint at `angle`, with the elbow bent forwards and backwards; `q` has the order
    /// roll, sweep, alpha, beta.
    fn at(&self, angle: f64, turn: Plane) -> [Seed; 2] {
        let scan = self.scan;
        let (at, rolls, shoulder, back) = if scan.prefix.is_some() {
            let at = self.way.at(turn);
            (at, scan.rolls(&at), scan.shoulder[0], Plane::new(1.0, 0.0))
        } else {
            (self.way.fixed, self.rolls, scan.shoulder[0] + turn * scan.shoulder[1], turn.conj())
        };
        let mut best = [Seed::NONE; 2];
        for (roll, radius, beside) in rolls {
            if beside > 0.0 && !self.near {
                continue;
            }
            let offset = beside + self.weight * ((roll - self.wish[0]).powi(2) + (angle - self.wish[1]).powi(2));
            if 0.5 * offset >= self.cap {
                // Too dear is not out of reach.
                best.iter_mut().for_each(|seed| seed.reached = true);
                continue;
            }
            let room = if self.near { self.dear - offset } else { 0.0 };
            scan.arm((Plane::new(at.x, radius) - shoulder) * back, room, |side, alpha, beta, miss| {
                let posture = (alpha - self.wish[2]).powi(2) + (beta - self.wish[3]).powi(2);
                let cost = 0.5 * (offset + miss + self.weight * posture);
                if cost < best[side].cost {
                    best[side] = Seed { q: [roll, angle, alpha, beta, 0.0], cost, reached: beside + miss == 0.0 };
                }
            });
        }
        best
    }
}

/// Finds the local minima of two series as they pass.
struct Valleys {
    found: [Seed; SEEDS],
    last: [Seed; 2],
    falling: [bool; 2],
}

impl Valleys {
    fn push(&mut self, seeds: &[Seed; 2]) {
        for side in [0, 1] {
            let falls = seeds[side].cost < self.last[side].cost;
            if self.falling[side] && !falls {
                self.insert(self.last[side]);
            }
            self.falling[side] = falls;
        }
        self.last = *seeds;
    }

    fn insert(&mut self, mut entry: Seed) {
        for found in &mut self.found {
            if entry.cost < found.cost {
                std::mem::swap(found, &mut entry);
            }
        }
    }
}

/// How far the posture can move between two nodes, rad, roughly.
const NODE_MARGIN: f64 = 0.2;
/// How much less the square of that distance can be between two nodes than at a node that has less than its neighbours,
/// rad², roughly.
const FLOOR_MARGIN: f64 = 0.03;
/// How much less the length `sqrt(2 J)` can be between two nodes where the target is out of reach, m, roughly.
const NEAR_MARGIN: f64 = 1e-3;

/// What is known from a descent before.
#[derive(Clone, Copy)]
pub(super) struct Start {
    /// Only what costs less than this is of interest, m².
    pub(super) cap: f64,
    /// The target has been reached.
    pub(super) reached: bool,
}

/// A posture to descend from.
#[derive(Clone, Copy)]
pub(super) struct Seed {
    pub(super) q: Angles,
    /// The weighted sum there, m².
    pub(super) cost: f64,
    /// The target is reached there, within what the tolerance of the angles does.
    pub(super) reached: bool,
}

impl Seed {
    const NONE: Self = Self { q: [0.0; N], cost: f64::INFINITY, reached: false };

    /// The least that a posture of its valley can cost, m²: the floor can lie lower than the node.
    pub(super) fn floor(&self, weight: f64) -> f64 {
        let near = if self.reached { 0.0 } else { NEAR_MARGIN * (2.0 * self.cost).sqrt() };
        self.cost - weight * FLOOR_MARGIN - near
    }
}

impl Scan {
    /// `None` if the finger is not of this kind.
    pub(super) fn new(chain: &FingerChain, lower: &Angles, upper: &Angles) -> Option<Self> {
        let [_, _, _, _] = chain.joints.as_slice() else { return None };
        // All at zero, in the palm frame.
        let (mut position, mut rotation) = (Vector3::zeros(), Matrix3::identity());
        let (mut points, mut axes) = ([Vector3::zeros(); 4], [Vector3::zeros(); 4]);
        for (slot, joint) in chain.joints.iter().enumerate() {
            position += rotation * joint.translation;
            rotation *= joint.rotation;
            (points[slot], axes[slot]) = (position, rotation * joint.axis);
        }
        let tip = position + rotation * chain.pole;
        let normal = axes[3];
        let parallel = |axis: &Vector3<f64>| axis.cross(&normal).norm() < 1e-9;
        let across = |axis: &Vector3<f64>| axis.dot(&normal).abs() < 1e-9;
        let (roll, sweep) = if parallel(&axes[1]) { (0, 1) } else { (1, 0) };
        let along = axes[roll];
        let origin = points[roll];
        if !parallel(&axes[2]) || !across(&along) || (tip - origin).dot(&normal).abs() > 1e-9 {
            return None;
        }
        let frame = Matrix3::from_rows(&[along.transpose(), normal.cross(&along).transpose(), normal.transpose()]);
        let plane = |from: &Vector3<f64>, to: &Vector3<f64>| {
            let way = frame * (to - from);
            Plane::new(way.x, way.y)
        };
        let sense = |slot: usize| if slot == roll { 1.0 } else { axes[slot].dot(&normal).signum() };
        let role = |slot: usize, sense: f64| Role::new(slot, sense, lower, upper);
        let (alpha, beta) = (role(2, sense(2)), role(3, 1.0));
        let sweep = role(sweep, if sweep == 0 { 1.0 } else { sense(1) });
        let (prefix, shoulder) = if roll == 0 {
            (None, [plane(&origin, &points[1]), plane(&points[1], &points[2])])
        } else {
            (Some((axes[0], points[0])), [plane(&origin, &points[2]), Plane::new(0.0, 0.0)])
        };
        let links = [plane(&points[2], &points[3]), plane(&points[3], &tip)];
        if links.iter().any(|link| link.norm() < 1e-6) {
            return None;
        }
        let nodes = std::array::from_fn(|node| {
            let angle = sweep.lower + (sweep.upper - sweep.lower) * node as f64 / (NODES - 1) as f64;
            (angle, Plane::from_polar(1.0, angle))
        });
        let alpha_ends = [alpha.lower, alpha.upper].map(|angle| Plane::from_polar(1.0, angle));
        // The ends of beta's range, and where the arm is straight or folded.
        let straight = (links[0] * links[1].conj()).arg();
        let stiff = [(beta.lower, true), (beta.upper, true), beta.clip(straight), beta.clip(straight + PI)]
            .into_iter()
            .filter(|(_, inside)| *inside)
            .map(|(beta, _)| {
                let arm = links[0] + Plane::from_polar(1.0, beta) * links[1];
                Stiff { beta, length: arm.norm(), direction: arm.arg(), ends: alpha_ends.map(|end| end * arm) }
            })
            .collect();
        let roll = role(roll, 1.0);
        Some(Self {
            roll,
            sweep,
            alpha,
            beta,
            frame,
            origin,
            prefix,
            shoulder,
            links,
            lengths: links.map(|link| link.norm()),
            straight,
            bends: [1.0, -1.0].map(|side| {
                // Whole turns aside, as the ranges of joints are.
                let ends = [beta.lower, beta.upper].map(|end| (side * (end - straight)).clamp(0.0, PI).cos());
                (ends[0].min(ends[1]) - TOLERANCE, ends[0].max(ends[1]) + TOLERANCE)
            }),
            nodes,
            alpha_ends,
            roll_ends: [roll.lower, roll.upper].map(f64::sin_cos),
            stiff,
        })
    }

    /// Where a descent can find an optimum, the best first, with infinite cost where
    /// there are fewer: the postures that cost less than their neighbours along the sweep, and the ends of valleys, with
    /// the elbow bent forwards and backwards. If none of them reaches the target, postures that come
    /// near. With a start the sweep is coarser and leaves the exact ends of valleys out: it comes again with the next
    /// target.
    pub(super) fn run(
        &self,
        target: &Vector3<f64>,
        reference: &Angles,
        weight: f64,
        start: Option<Start>,
    ) -> [Seed; SEEDS] {
        let wish = [&self.roll, &self.sweep, &self.alpha, &self.beta].map(|role| role.sense * reference[role.slot]);
        let way = Way::new(self, target);
        let mut nodes = Nodes { sweep: &self.sweep, list: [(0.0, Plane::new(0.0, 0.0)); NODES + EVENTS], count: 0 };
        for node in self.nodes.iter().step_by(if start.is_some() { WARM_STRIDE } else { 1 }) {
            nodes.list[nodes.count] = *node;
            nodes.count += 1;
        }
        let (angle, _) = self.sweep.clip(wish[1]);
        nodes.add(angle, Plane::from_polar(1.0, angle));
        self.events(&way, &mut nodes);
        let cap = start.map_or(f64::INFINITY, |start| start.cap);
        // The length whose floor is the cap, see [`Seed::floor`].
        let dear = (NEAR_MARGIN + (NEAR_MARGIN.powi(2) + 2.0 * (cap + weight * FLOOR_MARGIN)).sqrt()).powi(2);
        let (ends, near) = (start.is_none(), start.is_some_and(|start| !start.reached));
        let mut pass = Pass { scan: self, rolls: self.rolls(&way.fixed), way, wish, weight, cap, dear, ends, near };
        let mut found = pass.valleys(&nodes);
        if start.is_none() && found[0].cost == f64::INFINITY {
            pass.near = true;
            found = pass.valleys(&nodes);
        }
        found.map(|seed| {
            let mut q = [0.0; N];
            for (role, angle) in [&self.roll, &self.sweep, &self.alpha, &self.beta].into_iter().zip(seed.q) {
                q[role.slot] = role.sense * angle;
            }
            Seed { q, ..seed }
        })
    }

    /// Adds the angles of the held joint at which the target comes into or goes out of reach: where beta meets a limit
    /// or the arm is stretched or folded, and where the roll meets a limit. Each is a root of `a + b cos + c sin`.
    fn events(&self, way: &Way, nodes: &mut Nodes<'_>) {
        if self.prefix.is_some() {
            let from = way.fixed - Vector3::new(self.shoulder[0].re, 0.0, 0.0);
            // The distance from the shoulder, if that is on the roll axis as the thumb's is.
            let square = from.norm_squared() + way.turned.norm_squared();
            for stiff in &self.stiff {
                let constant = square - stiff.length * stiff.length;
                nodes.add_roots(constant, 2.0 * from.dot(&way.turned), 2.0 * from.dot(&way.crossed));
            }
            for (sin, cos) in self.roll_ends {
                let beside = |at: &Vector3<f64>| at.z * cos - at.y * sin;
                nodes.add_roots(beside(&way.fixed), beside(&way.turned), beside(&way.crossed));
            }
        } else {
            for (_, radius, _) in self.rolls(&way.fixed) {
                let from = Plane::new(way.fixed.x, radius) - self.shoulder[0];
                let along = -2.0 * from.conj() * self.shoulder[1];
                let square = from.norm_sqr() + self.shoulder[1].norm_sqr();
                for stiff in &self.stiff {
                    nodes.add_roots(square - stiff.length * stiff.length, along.re, -along.im);
                }
            }
        }
    }

    /// The two rolls that bring the finger's plane as near to the target as the limits allow, with the target in front
    /// of and behind the axis; and for each the target's coordinate across the axis in that plane (m) and its squared
    /// distance from the plane (m²).
    fn rolls(&self, at: &Vector3<f64>) -> [(f64, f64, f64); 2] {
        let around = atan2(at.z, at.y);
        let opposite = around + if around > 0.0 { -PI } else { PI };
        [(around, 1.0), (opposite, -1.0)].map(|(roll, side)| {
            let (roll, exact) = self.roll.clip(roll);
            if exact {
                (roll, side * (at.y * at.y + at.z * at.z).sqrt(), 0.0)
            } else {
                let (sin, cos) = self.roll_ends[usize::from(roll > 0.5 * (self.roll.lower + self.roll.upper))];
                (roll, at.y * cos + at.z * sin, (at.z * cos - at.y * sin).powi(2))
            }
        })
    }

    /// Calls `take(side, alpha, beta, squared miss)` for every posture of the planar arm that reaches `way`, or else for
    /// the nearest on every arc of its boundary with a squared miss below `room`, m²; `side` is how the elbow is bent.
    fn arm(&self, way: Plane, room: f64, mut take: impl FnMut(usize, f64, f64, f64)) {
        let [first, second] = self.links;
        let [a, b] = self.lengths;
        let square = way.norm_sqr();
        let cos = (square - a * a - b * b) / (2.0 * a * b);
        let mut reached = false;
        let possible = self.bends.map(|(low, high)| cos >= low && cos <= high);
        if cos.abs() <= 1.0 + 1e-9 && (possible[0] || possible[1]) {
            let sin = (1.0 - cos * cos).max(0.0).sqrt();
            let bend = atan2(sin, cos);
            for (index, side) in [1.0, -1.0].into_iter().enumerate() {
                let (beta, inside) = self.beta.clip(self.straight + side * bend);
                if inside && possible[index] {
                    // e^i(beta) second = first / |first| * |second| * e^i(side bend)
                    let arm = first * Plane::new(a + b * cos, side * b * sin);
                    let (alpha, inside) = self.alpha.clip(atan2_of(way * arm.conj()));
                    if inside {
                        reached = true;
                        take(index, alpha, beta, 0.0);
                    }
                }
            }
        }
        if reached || room <= 0.0 {
            return;
        }
        let distance = square.sqrt();
        for stiff in &self.stiff {
            // The nearest of the whole circle.
            let beside = (distance - stiff.length).powi(2);
            if beside < room {
                let (alpha, inside) = self.alpha.clip(atan2_of(way) - stiff.direction);
                let miss = if inside {
                    beside
                } else {
                    let end = usize::from((alpha - self.alpha.upper).abs() < (alpha - self.alpha.lower).abs());
                    (way - stiff.ends[end]).norm_sqr()
                };
                take(self.side(stiff.beta), alpha, stiff.beta, miss);
            }
        }
        for (alpha, end) in [self.alpha.lower, self.alpha.upper].into_iter().zip(self.alpha_ends) {
            let rest = way * end.conj() - first;
            let miss = (rest.norm_sqr().sqrt() - b).powi(2);
            if miss < room {
                let (beta, inside) = self.beta.clip(atan2_of(rest * second.conj()));
                if inside {
                    take(self.side(beta), alpha, beta, miss);
                }
            }
        }
    }

    fn side(&self, beta: f64) -> usize {
        usize::from(beta < self.straight)
    }
}

fn atan2_of(value: Plane) -> f64 {
    atan2(value.im, value.re)
}

/// atan2, good to 2e-4 rad: a seed needs no more, and the exact one takes most of the scan's time.
fn atan2(y: f64, x: f64) -> f64 {
    let (small, large) = (x.abs().min(y.abs()), x.abs().max(y.abs()));
    let ratio = small / large.max(f64::MIN_POSITIVE);
    let square = ratio * ratio;
    let angle = ((-0.046_496_474_9 * square + 0.159_314_22) * square - 0.327_622_764) * square * ratio + ratio;
    // Without branches: the octants of a sweep are hard to predict.
    let steep = f64::from(u8::from(y.abs() > x.abs()));
    let angle = steep * FRAC_PI_2 + (1.0 - 2.0 * steep) * angle;
    let behind = f64::from(u8::from(x < 0.0));
    (behind * PI + (1.0 - 2.0 * behind) * angle).copysign(y)
}
