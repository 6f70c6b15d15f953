//! No command brings the hand into itself, whatever the targets are.
#![allow(clippy::unwrap_used, clippy::print_stdout, missing_docs, reason = "tests")]

mod master_support;

use std::collections::BTreeMap;

use nalgebra::{Isometry3, Point3, Vector3};
use proptest::prelude::*;
use teleop_common::conditioner::Conditioner;
use teleop_common::guard::{Intervention, MAX_PENETRATION, MotionGuard, TipGuard};
use teleop_common::hand::{FingerChain, HandModel, HandSide, JointVector, MAX_FINGERS, TipFrame};
use teleop_common::mapping::{MappingParams, Retargeter};
use teleop_common::master::{Calibrator, Filter, FilterSettings, Fitter, Gesture, MasterGeometry, MasterPose};

const PERIOD: f64 = 1.0 / 333.0;
const ALLOWANCE: f64 = 0.0005;

/// Axis and radius of a capsule, m.
type Placed = ([Vector3<f64>; 2], f64);

/// Gaps by another way than the guard's: poses of all links from their transforms, distances by a search.
struct Referee {
    hand: HandModel,
    poses: Vec<Isometry3<f64>>,
    // By finger, body, capsule.
    placed: Vec<Vec<Vec<Placed>>>,
}

impl Referee {
    fn new(hand: &HandModel) -> Self {
        Self { hand: hand.clone(), poses: Vec::new(), placed: Vec::new() }
    }

    /// The least gap of all watched pairs, m, and which pair it is.
    fn least(&mut self, q: &JointVector) -> (f64, String) {
        self.hand.link_poses(q, &mut self.poses);
        let collision = &self.hand.collision;
        self.placed.clear();
        for (chain, bodies) in self.hand.fingers.iter().zip(&collision.fingers) {
            self.placed.push(
                bodies
                    .iter()
                    .map(|body| {
                        // The moving link that carries it.
                        let wire = chain.joints[body.slot].joint;
                        let link = self.hand.links.iter().position(|link| link.joint == Some(wire)).unwrap();
                        let place = |end| (self.poses[link] * Point3::from(end)).coords;
                        body.capsules.iter().map(|own| (own.ends.map(place), own.radius)).collect()
                    })
                    .collect(),
            );
        }
        let at = |ends: &[Vector3<f64>; 2], t: f64| ends[0] + (ends[1] - ends[0]) * t;
        let project = |ends: &[Vector3<f64>; 2], point: Vector3<f64>| {
            let along = ends[1] - ends[0];
            let length = along.norm_squared();
            at(ends, if length > 0.0 { ((point - ends[0]).dot(&along) / length).clamp(0.0, 1.0) } else { 0.0 })
        };
        let mut least = (f64::INFINITY, [(0, 0); 2]);
        for &[a, b] in &collision.pairs {
            for (one, r) in &self.placed[a.0][a.1] {
                for (other, s) in &self.placed[b.0][b.1] {
                    let (mut p, mut gap) = (at(one, 0.5), f64::INFINITY);
                    let size = ((one[1] - one[0]).norm() + (other[1] - other[0]).norm()) / 2.0;
                    // Nobody looks closely at what is far away.
                    if (p - at(other, 0.5)).norm() - size - r - s < least.0 {
                        // Alternating projections, which converge on convex sets.
                        for _ in 0..60 {
                            let (far, before) = (project(other, p), gap);
                            p = project(one, far);
                            gap = (p - far).norm() - r - s;
                            if before - gap < 1e-9 {
                                break;
                            }
                        }
                    }
                    if gap < least.0 {
                        least = (gap, [a, b]);
                    }
                }
            }
        }
        for &(a, block) in &collision.palm_pairs {
            let block = &collision.palm[block];
            for (ends, radius) in &self.placed[a.0][a.1] {
                for n in 0..=20 {
                    let point = at(ends, f64::from(n) / 20.0);
                    let local = block.edges.transpose() * (point - block.center);
                    let out = local.zip_map(&block.half, |value, half| (value.abs() - half).max(0.0)).norm();
                    if out - radius - block.radius < least.0 {
                        least = (out - radius - block.radius, [a, a]);
                    }
                }
            }
        }
        let name = |(finger, body): (usize, usize)| collision.fingers[finger][body].link.as_str();
        let [a, b] = least.1;
        (least.0, format!("{} {}", name(a), if a == b { "palm" } else { name(b) }))
    }
}

/// A hand that is driven.
struct Drive {
    hand: HandModel,
    guard: MotionGuard,
    conditioner: Conditioner,
    ticks: usize,
    slowed: usize,
    braked: usize,
}

impl Drive {
    fn new(hand: &HandModel, start: &JointVector) -> Self {
        let guard = MotionGuard::new(hand, ALLOWANCE);
        let conditioner = Conditioner::new(hand, start, PERIOD, 0.008);
        Self { hand: hand.clone(), guard, conditioner, ticks: 0, slowed: 0, braked: 0 }
    }

    fn follow(&mut self, target: &JointVector, speed: f64, movable: &[bool; MAX_FINGERS]) {
        let mut did = Intervention::None;
        self.conditioner.follow(target, speed, |q, velocity, range| {
            did = self.guard.guard(&self.hand, q, movable, velocity, range, PERIOD);
        });
        self.ticks += 1;
        self.slowed += usize::from(did == Intervention::Slowed);
        self.braked += usize::from(did == Intervention::Braked);
    }
}

/// Fails if the last step was outside the limits of `hand`.
fn within_limits(
    hand: &HandModel,
    now: &Conditioner,
    before: &(JointVector, JointVector),
) -> Result<(), TestCaseError> {
    let (q, v) = (now.position(), now.velocity());
    for (joint, limits) in hand.joints.iter().enumerate() {
        prop_assert!((limits.lower..=limits.upper).contains(&q[joint]));
        prop_assert!(v[joint].abs() <= limits.velocity + 1e-12);
        let acceleration = (v[joint] - before.1[joint]) / PERIOD;
        prop_assert!(acceleration.abs() <= limits.acceleration * (1.0 + 1e-9) + 1e-6);
        prop_assert!((q[joint] - before.0[joint]).abs() <= limits.velocity * PERIOD + 1e-12);
    }
    Ok(())
}

/// A share of each joint's range.
fn posture(hand: &HandModel, shares: &[f64]) -> JointVector {
    let mut out = hand.home();
    for ((value, joint), share) in out.iter_mut().zip(&hand.joints).zip(shares) {
        *value = joint.lower + (joint.upper - joint.lower) * share;
    }
    out
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 64, failure_persistence: None, ..ProptestConfig::default() })]
    #[test]
    fn gaps_are_those_of_the_urdf(shares in prop::collection::vec(prop::collection::vec(0.0..=1.0_f64, 16), 50)) {
        let hand = HandModel::allegro_v4(HandSide::Left);
        let (guard, mut referee) = (MotionGuard::new(&hand, ALLOWANCE), Referee::new(&hand));
        for shares in shares {
            let q = posture(&hand, &shares);
            let (gap, (expected, pair)) = (guard.least_gap(&hand, &q), referee.least(&q));
            // The referee's searches end early, and of a segment and a box it looks at some points only.
            let early = if pair.ends_with("palm") { 5e-4 } else { 2e-5 };
            prop_assert!((-early..1e-6).contains(&(gap - expected)), "{pair}: {gap} for {expected}");
        }
    }

    #[test]
    fn no_targets_bring_the_hand_into_itself(
        side in prop_oneof![Just(HandSide::Right), Just(HandSide::Left)],
        // What it can accelerate: the braking of the slowest takes longer than the guard looks ahead.
        factor in prop_oneof![4 => Just(1.0), 1 => Just(0.1), 1 => Just(0.02)],
        // It starts at home, or anywhere: maybe inside itself.
        start in prop::option::weighted(0.3, prop::collection::vec(0.0..=1.0_f64, 16)),
        legs in prop::collection::vec((
            prop::collection::vec(prop_oneof![6 => 0.0..=1.0_f64, 1 => Just(0.0), 1 => Just(1.0), 1 => Just(f64::NAN)], 16),
            any::<[bool; MAX_FINGERS]>(),
            prop_oneof![4 => Just(f64::INFINITY), 1 => 0.0..8.0_f64],
            prop_oneof![3 => 1..120_usize, 1 => 1..4_usize],
            prop::bool::weighted(0.1),
        ), 30..60),
    ) {
        let mut hand = HandModel::allegro_v4(side);
        hand.joints.iter_mut().for_each(|joint| joint.acceleration *= factor);
        let start = start.map_or_else(|| hand.home(), |shares| posture(&hand, &shares));
        let (mut drive, mut referee) = (Drive::new(&hand, &start), Referee::new(&hand));
        let mut before = (*drive.conditioner.position(), *drive.conditioner.velocity());
        let start = referee.least(&before.0).0;
        let mut deepest = if start < -0.006 { f64::NEG_INFINITY } else { start.min(-MAX_PENETRATION) };
        for (shares, movable, speed, ticks, hold) in legs {
            let target = posture(&hand, &shares);
            for _ in 0..ticks {
                if hold { drive.conditioner.hold() } else { drive.follow(&target, speed, &movable) }
                within_limits(&hand, &drive.conditioner, &before)?;
                before = (*drive.conditioner.position(), *drive.conditioner.velocity());
                let (gap, pair) = referee.least(&before.0);
                prop_assert!(gap >= deepest - 1e-6, "{pair} by {gap}");
                // Once out, it stays out.
                if gap >= -MAX_PENETRATION {
                    deepest = -MAX_PENETRATION;
                }
            }
        }
    }
}

#[test]
fn a_hand_that_starts_inside_itself_comes_out() {
    let hand = HandModel::allegro_v4(HandSide::Right);
    let mut referee = Referee::new(&hand);
    // Index and middle finger, bent and turned towards each other: a little inside, and crossed.
    for depth in [-0.004..-0.001, -0.025..-0.015] {
        let deep = depth.end < -0.01;
        let turned = |n: u32| {
            let (mut q, turn) = (hand.home(), f64::from(n) * 0.002);
            (q[0], q[1], q[4], q[5]) = (-turn, 0.8, turn, 0.8);
            q
        };
        let start = (0..200).map(turned).find(|q| depth.contains(&referee.least(q).0)).unwrap();
        let mut drive = Drive::new(&hand, &start);
        if !deep {
            (0..600).for_each(|_| drive.follow(&start, f64::INFINITY, &[true; MAX_FINGERS]));
            let least = referee.least(drive.conditioner.position()).0;
            assert!(least > -1e-4, "told to stay, the fingers are {least} m apart");
        }
        (0..600).for_each(|_| drive.follow(&hand.home(), f64::INFINITY, &[true; MAX_FINGERS]));
        let home = hand.home();
        let left = drive.conditioner.position().iter().zip(home.iter()).map(|(a, b)| (a - b).abs());
        assert!(left.fold(0.0, f64::max) < 1e-3, "told to open, they do");
    }
}

/// What the guard did to a motion.
struct Effect {
    ticks: usize,
    slowed: usize,
    braked: usize,
    /// Ticks with a command more than 0.01 rad from what it would be without the guard, and the furthest, rad.
    changed: usize,
    furthest: f64,
    /// The longest time, in ticks, that it was more than 0.02 rad off while without it all gaps were above 2 mm.
    stuck: usize,
    /// The same of fingers that only copy the human's shape, rad.
    copied: f64,
    /// Where the human touches: the mean distance of the poles, with and without, m.
    touch: [f64; 2],
    touches: usize,
    /// Sum of the second differences of the velocities, with and without, rad/s.
    roughness: [f64; 2],
}

/// Drives a hand through mapped poses, with the guard and without.
fn follow(name: &str, hand: &HandModel, poses: &[MasterPose], rate: f64) -> Effect {
    let mut retargeter = Retargeter::new(hand.clone(), MappingParams::default()).unwrap();
    let (tips, mut referee) = (TipGuard::new(hand, ALLOWANCE), Referee::new(hand));
    let mut drive = Drive::new(hand, &hand.home());
    let mut free = drive.conditioner.clone();
    let mut last = [(*free.velocity(), *free.velocity()); 2];
    let (mut least, mut colliding) = ((f64::INFINITY, String::new()), BTreeMap::<String, usize>::new());
    let (mut target, mut movable, mut near) = (hand.home(), [false; MAX_FINGERS], [false; MAX_FINGERS]);
    let (mut index, mut run) = (usize::MAX, 0);
    let mut out = Effect {
        ticks: (poses.len() as f64 / rate / PERIOD) as usize,
        slowed: 0,
        braked: 0,
        changed: 0,
        furthest: 0.0,
        stuck: 0,
        copied: 0.0,
        touch: [0.0; 2],
        touches: 0,
        roughness: [0.0; 2],
    };
    for tick in 0..out.ticks {
        let newest = ((tick as f64 * PERIOD * rate) as usize).min(poses.len() - 1);
        if newest != index {
            index = newest;
            let mapping = retargeter.map(&poses[index]);
            for (finger, signals) in mapping.fingers().iter().enumerate() {
                movable[finger] = signals.k > 0.0;
                near[finger] = finger > 0 && signals.delta < 0.001;
            }
            target = tips.apart(hand, &mapping.q, &movable);
        }
        drive.follow(&target, f64::INFINITY, &movable);
        free.follow(&target, f64::INFINITY, |_, _, _| {});
        let both = [drive.conditioner.position(), free.position()];
        let off = |chain: &FingerChain| {
            let [a, b] = both.map(|q| chain.select(q));
            a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
        };
        let furthest = hand.fingers.iter().map(off).fold(0.0, f64::max);
        out.furthest = out.furthest.max(furthest);
        out.changed += usize::from(furthest > 0.01);
        for (finger, chain) in hand.fingers.iter().enumerate() {
            if near[finger] {
                let pole = |chain: &FingerChain, q| chain.tip(&chain.select(q), TipFrame::Pole);
                out.touches += 1;
                for (sum, q) in out.touch.iter_mut().zip(both) {
                    *sum += (pole(chain, q) - pole(&hand.fingers[0], q)).norm();
                }
            }
            if !movable[finger] {
                out.copied = out.copied.max(off(chain));
            }
        }
        let found = referee.least(both[0]);
        if found.0 < least.0 {
            least = found;
        }
        let unguarded = referee.least(both[1]);
        run = if unguarded.0 > 0.002 && furthest > 0.02 { run + 1 } else { 0 };
        out.stuck = out.stuck.max(run);
        if unguarded.0 < -MAX_PENETRATION {
            *colliding.entry(unguarded.1).or_default() += 1;
        }
        for (which, conditioner) in [&drive.conditioner, &free].into_iter().enumerate() {
            let (v, (one, two)) = (conditioner.velocity(), &mut last[which]);
            let bends = v.iter().zip(one.iter().zip(two.iter())).map(|(v, (a, b))| (v - 2.0 * a + b).abs());
            out.roughness[which] += bends.sum::<f64>();
            (*two, *one) = (*one, *v);
        }
    }
    out.touch = out.touch.map(|sum| sum / out.touches.max(1) as f64);
    (out.slowed, out.braked) = (drive.slowed, drive.braked);
    println!(
        "{name}: {} ticks, {} slowed, {} braked, {} off by more than 0.01 rad (at most {:.3}; longest without need {} \
         ticks; fingers that copy {:.3}), least gap {:.3} mm ({}), gap of {} touches {:.3} mm (without {:.3}), roughness \
         {:.0} ({:.0}); without the guard more than 1 mm inside itself in {} ticks {colliding:?}",
        out.ticks,
        out.slowed,
        out.braked,
        out.changed,
        out.furthest,
        out.stuck,
        out.copied,
        least.0 * 1e3,
        least.1,
        out.touches,
        out.touch[0] * 1e3,
        out.touch[1] * 1e3,
        out.roughness[0],
        out.roughness[1],
        colliding.values().sum::<usize>(),
    );
    assert!(least.0 >= -MAX_PENETRATION - 1e-6, "{name}: {} by {} m", least.1, least.0);
    out
}

#[test]
fn gestures_are_followed_as_they_were_but_without_collisions() {
    for side in [HandSide::Right, HandSide::Left] {
        let hand = HandModel::allegro_v4(side);
        let short = Gesture::ALL.into_iter().filter(|gesture| gesture.duration() < 70.0);
        for gesture in short {
            let poses: Vec<MasterPose> = (0..(gesture.duration() * 100.0) as usize)
                .map(|n| MasterPose {
                    q: gesture.sample(n as f64 * 0.01),
                    geometry: MasterGeometry::PARADIGMATIC,
                    tuning: None,
                })
                .collect();
            let name = format!("{} {}", side.name(), gesture.name());
            let effect = follow(&name, &hand, &poses, 100.0);
            // In a fist the distal links of index and middle finger would be 2 mm inside each other.
            assert!(effect.furthest < 0.04, "{name}: {} rad off", effect.furthest);
            assert!(effect.copied < 1e-9, "{name}: a finger that copies is {} rad off", effect.copied);
            assert!(effect.touch[0] < effect.touch[1] + 1e-5, "{name}: touches open to {} m", effect.touch[0]);
            assert!(effect.roughness[0] < 1.02 * effect.roughness[1], "{name}: {:?}", effect.roughness);
            assert_eq!((effect.braked, effect.stuck), (0, 0), "{name}");
        }
    }
}

#[test]
fn a_recorded_hand_is_followed_where_it_does_not_collide() {
    let Some(keypoints) = master_support::recorded() else { return };
    let mut calibrator = Calibrator::default();
    keypoints.iter().for_each(|frame| calibrator.push(frame));
    let mut calibration = calibrator.finish().unwrap();
    for side in [HandSide::Right, HandSide::Left] {
        let hand = HandModel::allegro_v4(side);
        calibration.tune(&hand, &MappingParams::default()).unwrap();
        let tuning = calibration.tuning.as_ref().map(|tuning| tuning.values);
        let mut fitter = Fitter::new(calibration.geometry, calibration.side);
        let mut filter = Filter::new(calibration.geometry, FilterSettings::default());
        let poses: Vec<MasterPose> = keypoints
            .iter()
            .map(|frame| {
                let fitted = fitter.fit(frame).q;
                MasterPose { q: filter.apply(1.0 / 30.0, frame, &fitted), geometry: calibration.geometry, tuning }
            })
            .collect();
        let effect = follow(&format!("{} recording", side.name()), &hand, &poses, 30.0);
        assert!(effect.slowed * 4 < effect.ticks, "slowed in {} of {} ticks", effect.slowed, effect.ticks);
        assert!(effect.braked * 50 < effect.ticks, "braked in {} of {} ticks", effect.braked, effect.ticks);
        assert!(effect.stuck < 100, "stuck for {} ticks", effect.stuck);
        assert!(effect.roughness[0] < 1.1 * effect.roughness[1], "{:?}", effect.roughness);
    }
}
