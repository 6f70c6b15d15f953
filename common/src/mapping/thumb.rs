use nalgebra::{Matrix3, SMatrix, SVector, Vector3};

use crate::hand::{Finger, FingerChain, HandModel, Joint, MAX_FINGER_JOINTS};
use crate::master::MasterPose;

/// Postures to begin at: so many shares of every joint's range.
const SHARES: [f64; 3] = [0.1, 0.5, 0.9];
const MAX_SEEDS: usize = SHARES.len().pow(MAX_FINGER_JOINTS as u32);

type Bones = [Vector3<f64>; 3];

/// Weights of metacarpal, proximal and distal phalanx: the last two are what a person sees and touches with.
const WEIGHTS: [f64; 3] = [0.15, 1.0, 1.0];
/// Weight of a radian away from the rest posture: it decides what the directions leave open.
const REST: f64 = 0.1;
/// Steps that tell which valley is deeper.
const LOOK: usize = 4;
/// Steps of the descent from there.
const ITERATIONS: usize = 20;
/// By how much another valley must be better to be gone to (weighted squares of unit vectors): some 20 degrees of a bone.
const LEAVE: f64 = 0.12;
/// How far apart two postures are to be in two valleys, rad.
const APART: f64 = 0.8;
/// Longest step of a joint, rad.
const MAX_STEP: f64 = 0.4;
/// A step below this (rad) ends the descent.
const SETTLED: f64 = 1e-5;

/// The joint mapping of a thumb whose human joints are not the robot's: the posture whose phalanges point where the
/// human's do.
///
/// A person's thumb turns about axes that are neither the paradigmatic hand's nor the Allegro's, so angles copied from
/// one to the other bring the thumb somewhere else: on a recorded hand its last phalanx pointed 86 deg astray. What the
/// three have in common are three bones, so
///
/// ```text
/// M_Q,T(q) = argmin  sum_b w_b^2 ||u_b(q_S) - d_b(q)||^2 + w_0^2 ||q_S - q_rest||^2     in the joint box
/// ```
///
/// with unit vectors d_b (human, from the fitted posture) and u_b (robot) along metacarpal, proximal and distal
/// phalanx. The robot's are the lines from the first joint to the last but one, from there to the last, and from there
/// to the pole.
#[derive(Clone, Debug)]
pub(super) enum ThumbShape {
    Three(Shape<3>),
    Four(Shape<4>),
    Five(Shape<5>),
}

impl ThumbShape {
    /// For the thumb of `hand`; `None` if it has fewer than three joints, and so no bones to compare.
    pub(super) fn new(hand: &HandModel) -> Option<Self> {
        let chain = hand.fingers.iter().find(|chain| chain.finger == Finger::Thumb)?;
        Some(match chain.joints.len() {
            3 => Self::Three(Shape::new(hand, chain)),
            4 => Self::Four(Shape::new(hand, chain)),
            5 => Self::Five(Shape::new(hand, chain)),
            _ => return None,
        })
    }

    /// The thumb's joint angles (rad, palm outwards) for the human's pose.
    ///
    /// From `last`, what was found before this in a motion, the thumb stays in its valley until another is clearly
    /// deeper: two postures as good as each other must not take turns.
    pub(super) fn solve(
        &self,
        chain: &FingerChain,
        palm_from_anatomical: &Matrix3<f64>,
        pose: &MasterPose,
        last: Option<&ThumbPosture>,
    ) -> ThumbPosture {
        let wanted = wanted(palm_from_anatomical, pose);
        match self {
            Self::Three(shape) => shape.solve(chain, &wanted, last),
            Self::Four(shape) => shape.solve(chain, &wanted, last),
            Self::Five(shape) => shape.solve(chain, &wanted, last),
        }
    }
}

/// A posture of the thumb, and what is known of all others.
#[derive(Clone, Debug)]
pub(super) struct ThumbPosture {
    /// Joint angles, rad, palm outwards.
    pub(super) q: [f64; MAX_FINGER_JOINTS],
    // The human's bones when all valleys were last compared, and the square root of the least cost then. That is a
    // distance from them, so for other bones it is less by no more than those are away.
    seen: Bones,
    least: f64,
}

/// The same for a thumb of C joints.
#[derive(Clone, Debug)]
pub(super) struct Shape<const C: usize> {
    lower: SVector<f64, C>,
    upper: SVector<f64, C>,
    rest: SVector<f64, C>,
    seeds: Vec<Seed<C>>,
}

/// A posture to begin at. What it costs is `constant - sum_b slopes_b d_b`, as all bones are unit vectors.
#[derive(Clone, Debug)]
struct Seed<const C: usize> {
    q: SVector<f64, C>,
    constant: f64,
    slopes: Bones,
}

impl<const C: usize> Shape<C> {
    fn new(hand: &HandModel, chain: &FingerChain) -> Self {
        let own = |value: fn(&Joint) -> f64| {
            SVector::<f64, C>::from_fn(|slot, _| value(&hand.joints[chain.joints[slot].joint]))
        };
        let (lower, upper, rest) = (own(|joint| joint.lower), own(|joint| joint.upper), own(|joint| joint.home));
        let mut shape = Self { lower, upper, rest, seeds: Vec::new() };
        shape.seeds = (0..SHARES.len().pow(C as u32))
            .map(|index| {
                let share = |slot| SHARES[index / SHARES.len().pow(slot as u32) % SHARES.len()];
                let q = SVector::from_fn(|slot, _| lower[slot] + (upper[slot] - lower[slot]) * share(slot));
                let bones = bones(chain, &q).0;
                let slopes = std::array::from_fn(|bone| bones[bone] * (2.0 * WEIGHTS[bone] * WEIGHTS[bone]));
                // It costs nothing but the posture if the human's bones are the very same.
                Seed { q, constant: shape.cost(&bones, &bones, &q) + slope_sum(&slopes, &bones), slopes }
            })
            .collect();
        shape
    }

    fn solve(&self, chain: &FingerChain, wanted: &Bones, last: Option<&ThumbPosture>) -> ThumbPosture {
        let posture = |q: SVector<f64, C>, seen: Bones, least: f64| {
            let mut out = ThumbPosture { q: [0.0; MAX_FINGER_JOINTS], seen, least };
            out.q[..C].copy_from_slice(q.as_slice());
            out
        };
        let kept = last.map(|last| {
            let (own, q) = self.descend(chain, wanted, SVector::from_fn(|slot, _| last.q[slot]), ITERATIONS);
            (own, q, last, (last.least - distance(wanted, &last.seen)).max(0.0))
        });
        if let Some((own, q, last, others)) = kept
            && own < others * others + LEAVE
        {
            return posture(q, last.seen, last.least);
        }
        // The two best valleys; the cost of the first few steps tells which is the deeper one.
        let [first, second] = self.starts(wanted).map(|start| self.descend(chain, wanted, start, LOOK));
        let (_, q) = if second.0 < first.0 { second } else { first };
        let (cost, q) = self.descend(chain, wanted, q, ITERATIONS);
        match kept {
            Some((own, kept, ..)) if own < cost + LEAVE => posture(kept, *wanted, cost.min(own).sqrt()),
            _ => posture(q, *wanted, cost.sqrt()),
        }
    }

    /// The best posture to begin at, and the best away from that.
    fn starts(&self, wanted: &Bones) -> [SVector<f64, C>; 2] {
        let mut costs = [0.0; MAX_SEEDS];
        let mut first = (f64::INFINITY, self.rest);
        for (cost, seed) in costs.iter_mut().zip(&self.seeds) {
            *cost = seed.constant - slope_sum(&seed.slopes, wanted);
            if *cost < first.0 {
                first = (*cost, seed.q);
            }
        }
        let mut second = (f64::INFINITY, self.rest);
        for (&cost, seed) in costs.iter().zip(&self.seeds) {
            if cost < second.0 && (seed.q - first.1).amax() > APART {
                second = (cost, seed.q);
            }
        }
        [first.1, second.1]
    }

    /// Levenberg-Marquardt with the joints at their ends held.
    fn descend(
        &self,
        chain: &FingerChain,
        wanted: &Bones,
        mut q: SVector<f64, C>,
        iterations: usize,
    ) -> (f64, SVector<f64, C>) {
        let (mut now, mut slopes) = bones(chain, &q);
        let mut value = self.cost(wanted, &now, &q);
        let mut damping = 0.0;
        for _ in 0..iterations {
            let mut gradient = (q - self.rest) * (REST * REST);
            let mut hessian = SMatrix::<f64, C, C>::identity() * (REST * REST + damping);
            for bone in 0..3 {
                let weight = WEIGHTS[bone] * WEIGHTS[bone];
                gradient += slopes[bone].tr_mul(&(now[bone] - wanted[bone])) * weight;
                hessian += slopes[bone].tr_mul(&slopes[bone]) * weight;
            }
            for slot in 0..C {
                let held = (q[slot] <= self.lower[slot] && gradient[slot] > 0.0)
                    || (q[slot] >= self.upper[slot] && gradient[slot] < 0.0);
                if held {
                    gradient[slot] = 0.0;
                    hessian.row_mut(slot).fill(0.0);
                    hessian.column_mut(slot).fill(0.0);
                    hessian[(slot, slot)] = 1.0;
                }
            }
            let Some(factor) = hessian.cholesky() else { break };
            let step = factor.solve(&gradient);
            let step = step * (MAX_STEP / step.amax().max(MAX_STEP));
            let next = (q - step).zip_zip_map(&self.lower, &self.upper, |q, lower, upper| q.max(lower).min(upper));
            if (next - q).amax() < SETTLED {
                return (value, next);
            }
            let (next_bones, next_slopes) = bones(chain, &next);
            let next_value = self.cost(wanted, &next_bones, &next);
            if next_value < value {
                (q, now, slopes, value) = (next, next_bones, next_slopes, next_value);
                damping *= 0.2;
            } else {
                damping = (damping * 5.0).max(1e-2);
            }
        }
        (value, q)
    }

    fn cost(&self, wanted: &Bones, bones: &Bones, q: &SVector<f64, C>) -> f64 {
        let shape: f64 = (0..3).map(|bone| (WEIGHTS[bone] * (bones[bone] - wanted[bone])).norm_squared()).sum();
        shape + REST * REST * (q - self.rest).norm_squared()
    }
}

/// Unit vectors along the human's three bones, in the palm frame.
fn wanted(palm_from_anatomical: &Matrix3<f64>, pose: &MasterPose) -> Bones {
    let [base, second, third, tip] = pose.geometry.finger_points(Finger::Thumb, &pose.finger(Finger::Thumb));
    [second - base, third - second, tip - third].map(|bone| palm_from_anatomical * bone.normalize())
}

/// How far apart two triples are, weighted as the cost weighs them.
fn distance(a: &Bones, b: &Bones) -> f64 {
    (0..3).map(|bone| (WEIGHTS[bone] * (a[bone] - b[bone])).norm_squared()).sum::<f64>().sqrt()
}

fn slope_sum(slopes: &Bones, bones: &Bones) -> f64 {
    slopes.iter().zip(bones).map(|(slope, bone)| slope.dot(bone)).sum()
}

/// Unit vectors along the three bones in the palm frame, and their derivatives by the joints.
fn bones<const C: usize>(chain: &FingerChain, q: &SVector<f64, C>) -> (Bones, [SMatrix<f64, 3, C>; 3]) {
    let (mut position, mut rotation) = (Vector3::zeros(), Matrix3::identity());
    let (mut origins, mut axes) = ([Vector3::<f64>::zeros(); C], [Vector3::zeros(); C]);
    for (slot, joint) in chain.joints.iter().enumerate() {
        position += rotation * joint.translation;
        rotation *= joint.rotation_at(q[slot]);
        origins[slot] = position;
        axes[slot] = rotation * joint.axis;
    }
    let pole = position + rotation * chain.pole;
    let (knuckle, last) = (origins[C - 2], origins[C - 1]);
    // A bone's ends, and how many joints move it as a whole.
    let ends = [(origins[0], knuckle, 0), (knuckle, last, C - 1), (last, pole, C)];
    let mut out = ([Vector3::zeros(); 3], [SMatrix::<f64, 3, C>::zeros(); 3]);
    for (bone, (from, to, rigid)) in ends.into_iter().enumerate() {
        let vector = to - from;
        let length = vector.norm().max(1e-9);
        let unit = vector / length;
        out.0[bone] = unit;
        for slot in 0..C {
            let slope = if slot < rigid {
                axes[slot].cross(&unit)
            } else if bone == 0 && slot < C - 2 {
                // The metacarpal has joints inside.
                let slope = axes[slot].cross(&(to - origins[slot])) / length;
                slope - unit * unit.dot(&slope)
            } else {
                continue;
            };
            out.1[bone].set_column(slot, &slope);
        }
    }
    out
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use super::*;
    use crate::hand::HandSide;
    use crate::master::{JOINT_LIMITS, MasterGeometry};

    /// Uniform in 0..1, the same on every run.
    fn random(state: &mut u64) -> f64 {
        *state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (*state >> 11) as f64 / (1_u64 << 53) as f64
    }

    fn random_pose(state: &mut u64) -> MasterPose {
        let mut q = [0.0; 20];
        // What thumbs do, and some more.
        for (angle, range) in q.iter_mut().zip(&JOINT_LIMITS[0]) {
            *angle = range.min - 0.3 + (range.max - range.min + 0.6) * random(state);
        }
        MasterPose { q, geometry: MasterGeometry::PARADIGMATIC, tuning: None }
    }

    #[test]
    fn no_posture_found_at_random_is_better() {
        let mut state = 7;
        for side in [HandSide::Right, HandSide::Left] {
            let hand = HandModel::allegro_v4(side);
            let chain = &hand.fingers[0];
            let Some(ThumbShape::Four(shape)) = ThumbShape::new(&hand) else { panic!("four joints") };
            let palm = hand.anatomical_from_palm.transpose();
            let (mut worse, mut worst) = (0, 0.0_f64);
            for _ in 0..300 {
                let pose = random_pose(&mut state);
                let wanted = wanted(&palm, &pose);
                let q = SVector::from_fn(|slot, _| shape.solve(chain, &wanted, None).q[slot]);
                let cost = |q: &SVector<f64, 4>| shape.cost(&wanted, &bones(chain, q).0, q);
                let found = cost(&q);
                // A random search that narrows down.
                let (mut best, mut best_q) = (f64::INFINITY, q);
                for round in 0..3000 {
                    let width = if round < 1000 { 1.0 } else { 0.2 * 0.997_f64.powi(round - 1000) };
                    let mut other = SVector::<f64, 4>::zeros();
                    for slot in 0..4 {
                        let (lower, upper) = (shape.lower[slot], shape.upper[slot]);
                        let around = if round < 1000 { 0.5 * (lower + upper) } else { best_q[slot] };
                        let drawn = around + (random(&mut state) - 0.5) * (upper - lower) * width;
                        other[slot] = drawn.clamp(lower, upper);
                    }
                    let value = cost(&other);
                    if value < best {
                        (best, best_q) = (value, other);
                    }
                }
                worse += usize::from(found > best + 1e-4);
                worst = worst.max(found - best);
            }
            assert!(worse <= 12 && worst < 0.1, "{worse} of 300 worse than a random search, by up to {worst}");
        }
    }

    #[test]
    fn along_a_motion_the_thumb_does_not_leap_to_and_fro() {
        let hand = HandModel::allegro_v4(HandSide::Right);
        let (chain, shape) = (&hand.fingers[0], ThumbShape::new(&hand).unwrap());
        let palm = hand.anatomical_from_palm.transpose();
        let leaps = |history: bool| {
            let (mut state, mut leaps, mut last) = (3, 0, None::<ThumbPosture>);
            for _ in 0..50 {
                let [from, to] = [random_pose(&mut state), random_pose(&mut state)];
                for step in 0..200 {
                    let mut pose = from;
                    for (angle, end) in pose.q.iter_mut().zip(&to.q) {
                        *angle += (end - *angle) * f64::from(step) / 200.0;
                    }
                    let now = shape.solve(chain, &palm, &pose, last.as_ref().filter(|_| history && step > 0));
                    let q = SVector::from(now.q);
                    if let (Some(last), true) = (last.replace(now), step > 0) {
                        leaps += usize::from((q - SVector::from(last.q)).amax() > 0.2);
                    }
                }
            }
            leaps
        };
        // A way across the whole range may need one; with no history there are more.
        let (with, without) = (leaps(true), leaps(false));
        assert!(4 * with < 3 * without, "{with} leaps on 50 ways, {without} without history");
    }

    #[test]
    fn small_moves_of_the_human_are_small_moves_of_the_robot() {
        let hand = HandModel::allegro_v4(HandSide::Right);
        let shape = ThumbShape::new(&hand).unwrap();
        let palm = hand.anatomical_from_palm.transpose();
        let mut state = 11;
        let mut steps: Vec<f64> = (0..2000)
            .map(|_| {
                let pose = random_pose(&mut state);
                let mut near = pose;
                near.q[..4].iter_mut().for_each(|angle| *angle += 1e-3 * (random(&mut state) - 0.5));
                let solve = |pose| SVector::from(shape.solve(&hand.fingers[0], &palm, pose, None).q);
                (solve(&near) - solve(&pose)).amax()
            })
            .collect();
        steps.sort_by(f64::total_cmp);
        // Half a milliradian in. The few leaps are where two postures are equally good.
        assert!(steps[1980] < 5e-3, "{} rad", steps[1980]);
    }
}
