//! No command brings the hand into itself, whatever the targets are.
#![allow(clippy::unwrap_used, clippy::print_stdout, missing_docs, reason = "tests")]

use std::io::BufReader;

use nalgebra::{Isometry3, Point3, Vector3};
use proptest::prelude::*;
use teleop_common::conditioner::Conditioner;
use teleop_common::guard::{Intervention, MAX_PENETRATION, MotionGuard, TipGuard};
use teleop_common::hand::{FingerChain, HandModel, HandSide, JointVector, MAX_FINGERS, TipFrame};
use teleop_common::mapping::{MappingParams, Retargeter};
use teleop_common::master::{
    Calibrator, Filter, FilterSettings, Fitter, Gesture, Keypoints, MasterGeometry, MasterPose,
};
use teleop_common::recording::{FrameData, LastLine, RecordingReader};
use teleop_common::testing::shared_data;

const PERIOD: f64 = 1.0 / 333.0;
const ALLOWANCE: f64 = 0.0005;

/// Gaps by another way than the guard's: poses of all links from their transforms, distances by a search.
struct Referee {
    hand: HandModel,
    poses: Vec<Isometry3<f64>>,
    // Axis and radius by finger, body, capsule.
    placed: Vec<Vec<Vec<([Vector3<f64>; 2], f64)>>>,
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
                    let local = block.pose.inverse_transform_point(&Point3::from(point)).coords;
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
    fn new(side: HandSide) -> Self {
        let hand = HandModel::allegro_v4(side);
        let guard = MotionGuard::new(&hand, ALLOWANCE);
        let conditioner = Conditioner::new(&hand, &hand.home(), PERIOD, 0.008);
        Self { hand, guard, conditioner, ticks: 0, slowed: 0, braked: 0 }
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

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]
    #[test]
    fn no_targets_bring_the_hand_into_itself(
        side in prop_oneof![Just(HandSide::Right), Just(HandSide::Left)],
        legs in prop::collection::vec((
            prop::collection::vec(prop_oneof![6 => 0.0..=1.0_f64, 1 => Just(0.0), 1 => Just(1.0), 1 => Just(f64::NAN)], 16),
            any::<[bool; MAX_FINGERS]>(),
            prop_oneof![4 => Just(f64::INFINITY), 1 => 0.0..8.0_f64],
            1usize..120,
            prop::bool::weighted(0.1),
        ), 10..40),
    ) {
        let mut drive = Drive::new(side);
        let mut referee = Referee::new(&drive.hand);
        let mut before = (*drive.conditioner.position(), *drive.conditioner.velocity());
        for (shares, movable, speed, ticks, hold) in legs {
            let mut target = drive.hand.home();
            for ((value, joint), share) in target.iter_mut().zip(&drive.hand.joints).zip(&shares) {
                *value = joint.lower + (joint.upper - joint.lower) * share;
            }
            for _ in 0..ticks {
                if hold { drive.conditioner.hold() } else { drive.follow(&target, speed, &movable) }
                within_limits(&drive.hand, &drive.conditioner, &before)?;
                before = (*drive.conditioner.position(), *drive.conditioner.velocity());
                let (gap, pair) = referee.least(&before.0);
                prop_assert!(gap >= -MAX_PENETRATION - 2e-6, "{pair} by {gap}");
            }
        }
    }
}

/// Drives the hand through mapped poses and says what the guard did.
fn follow(name: &str, drive: &mut Drive, poses: &[MasterPose], rate: f64) {
    let hand = drive.hand.clone();
    let mut retargeter = Retargeter::new(hand.clone(), MappingParams::default()).unwrap();
    let (tips, mut referee) = (TipGuard::new(&hand, ALLOWANCE), Referee::new(&hand));
    let mut free = Conditioner::new(&hand, &hand.home(), PERIOD, 0.008);
    let (mut least, mut off, mut away, mut jerk, mut free_jerk) =
        ((f64::INFINITY, String::new()), 0.0_f64, 0, 0.0, 0.0);
    let (mut colliding, mut names) = (0, std::collections::BTreeMap::<String, usize>::new());
    let mut last = [(*drive.conditioner.velocity(), *drive.conditioner.velocity()); 2];
    let ticks = (poses.len() as f64 / rate / PERIOD) as usize;
    let mut known = usize::MAX;
    let (mut touches, mut touch, mut free_touch, mut copied) = (0_usize, 0.0, 0.0, 0.0_f64);
    let mut near = [false; MAX_FINGERS];
    let (mut target, mut movable) = (hand.home(), [false; MAX_FINGERS]);
    for tick in 0..ticks {
        let index = ((tick as f64 * PERIOD * rate) as usize).min(poses.len() - 1);
        if index != known {
            known = index;
            let mapping = retargeter.map(&poses[index]);
            movable = [false; MAX_FINGERS];
            movable.iter_mut().zip(mapping.fingers()).for_each(|(own, signals)| *own = signals.k > 0.0);
            near = [false; MAX_FINGERS];
            let signals = mapping.fingers().iter().enumerate().skip(1);
            signals.for_each(|(finger, signals)| near[finger] = signals.delta < 0.001);
            target = tips.apart(&hand, &mapping.q, &movable);
        }
        drive.follow(&target, f64::INFINITY, &movable);
        free.follow(&target, f64::INFINITY, |_, _, _| {});
        for (finger, chain) in hand.fingers.iter().enumerate() {
            let gap = |q: &JointVector| {
                let pole = |chain: &FingerChain| chain.tip(&chain.select(q), TipFrame::Pole);
                (pole(chain) - pole(&hand.fingers[0])).norm()
            };
            if near[finger] {
                touches += 1;
                touch += gap(drive.conditioner.position());
                free_touch += gap(free.position());
            }
            if !movable[finger] {
                let shape = |conditioner: &Conditioner| chain.select(conditioner.position());
                let off =
                    shape(&drive.conditioner).iter().zip(shape(&free)).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
                copied = copied.max(off);
            }
        }
        let found = referee.least(drive.conditioner.position());
        if found.0 < least.0 {
            least = found;
        }
        let unguarded = referee.least(free.position());
        if unguarded.0 < -MAX_PENETRATION {
            colliding += 1;
            *names.entry(unguarded.1).or_default() += 1;
        }
        let apart = drive.conditioner.position().iter().zip(free.position().iter());
        let apart = apart.map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
        off = off.max(apart);
        away += usize::from(apart > 0.01);
        for (which, (sum, conditioner)) in
            [(&mut jerk, &drive.conditioner), (&mut free_jerk, &free)].into_iter().enumerate()
        {
            let v = conditioner.velocity();
            let (one, two) = &mut last[which];
            *sum += v.iter().zip(one.iter().zip(two.iter())).map(|(v, (a, b))| (v - 2.0 * a + b).abs()).sum::<f64>();
            (*two, *one) = (*one, *v);
        }
    }
    println!(
        "{name}: {ticks} ticks, slowed {}, braked {}, least gap {:.3} mm ({}), {away} ticks more than 0.01 rad from the \
         unguarded (at most {off:.3}), which is > 1 mm inside itself in {colliding}; jerk {jerk:.1} ({free_jerk:.1})",
        drive.slowed,
        drive.braked,
        least.0 * 1e3,
        least.1
    );
    println!(
        "    {touches} touches with a gap of {:.2} mm on average ({:.2}); fingers that copy off by {copied:.3} rad at most",
        touch / touches.max(1) as f64 * 1e3,
        free_touch / touches.max(1) as f64 * 1e3
    );
    names.iter().for_each(|(pair, count)| println!("    {pair}: {count}"));
    assert!(least.0 >= -MAX_PENETRATION - 2e-6, "{name}: {} by {} m", least.1, least.0);
}

#[test]
fn gestures_and_a_recording_are_followed_without_a_collision() {
    for side in [HandSide::Right, HandSide::Left] {
        for gesture in Gesture::ALL {
            let poses: Vec<MasterPose> = (0..(gesture.duration() * 100.0) as usize)
                .map(|n| MasterPose {
                    q: gesture.sample(n as f64 * 0.01),
                    geometry: MasterGeometry::PARADIGMATIC,
                    tuning: None,
                })
                .collect();
            let mut drive = Drive::new(side);
            follow(&format!("{} {}", side.name(), gesture.name()), &mut drive, &poses, 100.0);
        }
        let Some(path) = shared_data("human_hand_right.csv") else { continue };
        let reader = RecordingReader::new(BufReader::new(std::fs::File::open(path).unwrap()), LastLine::Whole).unwrap();
        let keypoints: Vec<Keypoints> = reader
            .filter_map(|frame| match frame.unwrap().data {
                FrameData::Keypoints(keypoints) => Some(keypoints),
                FrameData::Joints(_) => None,
            })
            .collect();
        let mut calibrator = Calibrator::default();
        keypoints.iter().for_each(|frame| calibrator.push(frame));
        let mut calibration = calibrator.finish().unwrap();
        let mut drive = Drive::new(side);
        calibration.tune(&drive.hand, &MappingParams::default()).unwrap();
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
        follow(&format!("{} recording", side.name()), &mut drive, &poses, 30.0);
    }
}

#[test]
fn the_pairs_that_are_not_watched_are_known() {
    for side in [HandSide::Right, HandSide::Left] {
        let hand = HandModel::allegro_v4(side);
        for [a, b] in &hand.collision.ignored {
            println!("{} {a} {b}", side.name());
        }
        println!("{} pairs, {} with the palm", hand.collision.pairs.len(), hand.collision.palm_pairs.len());
    }
}
