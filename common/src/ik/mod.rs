//! Bounded inverse kinematics of one finger: position first, then posture, globally.
//!
//! A four-joint finger that reaches for a point is redundant, so "reach p" alone does not say which posture. In the
//! joint box B of the finger, with the joint-mapped posture `q_ref`, the solver minimises
//!
//! ```text
//! J(q) = 1/2 ||F(q) - p||^2 + 1/2 mu^2 ||q - q_ref||^2        over q in B.
//! ```
//!
//! For mu to 0 that is the lexicographic problem `argmin { ||q - q_ref|| : q in argmin { ||F(q') - p|| : q' in B } }`:
//! no point is missed by more than `mu ||q - q_ref||` beyond the nearest that the finger can reach. A larger mu bounds
//! the joints' answer to a moving target, `||dq|| <= ||dp|| / (2 mu)` where the curvature of the finger does not matter,
//! which the lexicographic problem does not do at singular postures.
//!
//! - *Descent* (`descent.rs`): a primal-dual Newton method finds the local optimum near a start, in three or four
//!   iterations from the last solution.
//! - *Scan* (`scan.rs`): for a finger like the Allegro's, thumb included, a closed form lists the postures that reach
//!   the target (or come near it) along the whole self-motion, and every valley that could be lower is descended too.
//!   Other fingers descend from the reference and the best of a table of postures.
//!
//! Without a start the result is the global optimum (`tests/ik_global.rs`: 80,000 targets, none missed by more than
//! 2 um). With one, the solver stays in the start's valley while that costs little: with the length
//! `l(q) = sqrt(2 J(q))`, until a posture of length `l*` is found with
//! `l* < max(l / (1 + HYSTERESIS), l - HYSTERESIS_MAX)`. Leaving it is the only way to jump, and is reported.

mod descent;
mod scan;

use nalgebra::Vector3;

use self::descent::Problem;
use self::scan::{SEEDS, Scan, Start};
use crate::hand::{FingerChain, Joint, MAX_FINGER_JOINTS, TipFrame};

const N: usize = MAX_FINGER_JOINTS;
type Angles = [f64; N];

/// Largest mu, m/rad: position and posture weigh alike for a finger of this size.
pub const POSTURE_WEIGHT_MAX: f64 = 3e-3;
/// Smallest mu, m/rad: as good as lexicographic. What is within reach is missed by less than 1 um.
pub const POSTURE_WEIGHT_MIN: f64 = 1e-7;
/// Share of the optimal length by which the valley of the start may be worse before it is left.
pub const HYSTERESIS: f64 = 0.1;
/// Most by which it may be worse, m.
pub const HYSTERESIS_MAX: f64 = 1e-4;

// Postures nearer to each other than this are in one valley, rad: less than the scan's nodes are apart.
const SAME_VALLEY: f64 = 0.1;
// Iterations of one descent.
const BUDGET: u16 = 24;

/// How a solve ended.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum IkStatus {
    /// Not solved: the joint-mapped posture was taken as it is.
    #[default]
    Skipped,
    /// The target is reached, within 1 um or a twentieth of the posture weight times a radian.
    Reached,
    /// The target is out of reach; the nearest point is returned.
    Unreachable,
    /// The iteration budget ran out first; the best point so far is returned.
    Budget,
}

/// What a solve did.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct IkReport {
    /// How it ended.
    pub status: IkStatus,
    /// Iterations used, over all starts.
    pub iterations: u16,
    /// Distance from the reached tip to the target, m.
    pub residual: f64,
    /// The valley of the start was left for a better one: the posture does not continue the last.
    pub jumped: bool,
}

/// The solver of one finger: its joint box, and where its optima can be.
#[derive(Clone, Debug)]
pub struct FingerIk {
    lower: Angles,
    upper: Angles,
    seeds: Seeds,
}

#[derive(Clone, Debug)]
enum Seeds {
    Scan(Box<Scan>),
    // Postures on a grid over the joint box, with their tips.
    Table(Vec<(Angles, Vector3<f64>)>),
}

impl FingerIk {
    /// Most iterations one [`FingerIk::solve`] can take.
    pub const MAX_ITERATIONS: u16 = (1 + SEEDS as u16) * BUDGET;

    /// A solver for `chain`, with the limits of the hand's `joints` (wire order). Allocates; [`FingerIk::solve`] does
    /// not.
    #[must_use]
    pub fn new(chain: &FingerChain, joints: &[Joint]) -> Self {
        let (mut lower, mut upper) = ([0.0; N], [0.0; N]);
        for (slot, joint) in chain.joints.iter().enumerate() {
            lower[slot] = joints[joint.joint].lower;
            upper[slot] = joints[joint.joint].upper;
        }
        let seeds = match Scan::new(chain, &lower, &upper) {
            Some(scan) => Seeds::Scan(Box::new(scan)),
            None => Seeds::Table(table(chain, &lower, &upper)),
        };
        Self { lower, upper, seeds }
    }

    /// Joint angles (rad, palm outwards) that minimise J for the pole of `chain`, `target` (m, palm frame) and
    /// `reference` (rad); see the module. `start` is the last solution of a motion, for speed and to stay in its valley.
    ///
    /// `posture_weight` is mu (m/rad), between [`POSTURE_WEIGHT_MIN`] and [`POSTURE_WEIGHT_MAX`].
    ///
    /// Does not allocate; at most [`FingerIk::MAX_ITERATIONS`] iterations.
    #[must_use]
    pub fn solve(
        &self,
        chain: &FingerChain,
        target: &Vector3<f64>,
        reference: &[f64; N],
        start: Option<&[f64; N]>,
        posture_weight: f64,
    ) -> ([f64; N], IkReport) {
        let mu = posture_weight.clamp(POSTURE_WEIGHT_MIN, POSTURE_WEIGHT_MAX);
        let problem = self.problem(chain, target, reference, mu);
        let kept = start.map(|start| problem.descend(start, BUDGET));
        let mut iterations = kept.map_or(0, |kept| kept.iterations);
        let mut best = kept;
        let tolerance = (0.05 * mu).max(1e-6);
        // What another valley must beat.
        let known = kept.map(|kept| {
            let length = (2.0 * kept.cost).sqrt();
            let other = (length / (1.0 + HYSTERESIS)).max(length - HYSTERESIS_MAX);
            Start { cap: 0.5 * other * other, reached: kept.residual <= tolerance }
        });
        let cap = known.map_or(f64::INFINITY, |known| known.cap);
        self.for_each_seed(&problem, known, |seed, cost, floor| {
            if floor >= best.map_or(f64::INFINITY, |best| best.cost.min(cap)) {
                return;
            }
            // The scan finds the start's own valley too, and there the floor is known: nothing in it costs less.
            if cost >= cap && kept.is_some_and(|kept| kept.converged && apart(seed, &kept.q) < SAME_VALLEY) {
                return;
            }
            let other = problem.descend(seed, BUDGET);
            iterations += other.iterations;
            if best.is_none_or(|best| other.cost < best.cost) {
                best = Some(other);
            }
        });
        // There is a seed for every finger with joints.
        let best = best.unwrap_or_else(|| problem.descend(reference, BUDGET));
        let (taken, jumped) = match kept {
            Some(kept) if best.cost >= cap => (kept, false),
            kept => (best, kept.is_some_and(|kept| apart(&kept.q, &best.q) > 1e-2)),
        };
        let status = if taken.residual <= tolerance {
            IkStatus::Reached
        } else if taken.converged {
            IkStatus::Unreachable
        } else {
            IkStatus::Budget
        };
        (taken.q, IkReport { status, iterations, residual: taken.residual, jumped })
    }

    /// [`FingerIk::solve`] that stays in the valley of `start` whatever other valleys cost: for a third of the time.
    #[must_use]
    pub fn follow(
        &self,
        chain: &FingerChain,
        target: &Vector3<f64>,
        reference: &[f64; N],
        start: &[f64; N],
        posture_weight: f64,
    ) -> [f64; N] {
        let mu = posture_weight.clamp(POSTURE_WEIGHT_MIN, POSTURE_WEIGHT_MAX);
        self.problem(chain, target, reference, mu).descend(start, BUDGET).q
    }

    fn problem<'a>(
        &'a self,
        chain: &'a FingerChain,
        target: &Vector3<f64>,
        reference: &Angles,
        mu: f64,
    ) -> Problem<'a> {
        let (lower, upper) = (&self.lower, &self.upper);
        Problem { chain, target: *target, reference: *reference, weight: mu * mu, lower, upper }
    }

    /// Calls `take(posture, its cost, lower bound of the cost in its valley)` for the starts worth a descent, the best
    /// first.
    fn for_each_seed(&self, problem: &Problem<'_>, known: Option<Start>, mut take: impl FnMut(&Angles, f64, f64)) {
        match &self.seeds {
            Seeds::Scan(scan) => {
                for seed in scan.run(&problem.target, &problem.reference, problem.weight, known) {
                    if seed.cost.is_finite() {
                        take(&seed.q, seed.cost, seed.floor(problem.weight));
                    }
                }
            }
            Seeds::Table(table) => {
                take(&problem.reference, f64::INFINITY, 0.0);
                for mu in [0.0, POSTURE_WEIGHT_MAX] {
                    let cost = |(q, tip): &(Angles, Vector3<f64>)| {
                        let posture: f64 = q.iter().zip(&problem.reference).map(|(a, b)| (a - b).powi(2)).sum();
                        (tip - problem.target).norm_squared() + mu * mu * posture
                    };
                    let mut best = (f64::INFINITY, 0);
                    for (index, entry) in table.iter().enumerate() {
                        let cost = cost(entry);
                        if cost < best.0 {
                            best = (cost, index);
                        }
                    }
                    if let Some((q, _)) = table.get(best.1) {
                        take(q, f64::INFINITY, 0.0);
                    }
                }
            }
        }
    }
}

/// Largest difference of a joint, rad.
fn apart(a: &Angles, b: &Angles) -> f64 {
    a.iter().zip(b).fold(0.0, |largest, (a, b)| largest.max((a - b).abs()))
}

/// The finest grid of at most a thousand or so postures.
fn table(chain: &FingerChain, lower: &Angles, upper: &Angles) -> Vec<(Angles, Vector3<f64>)> {
    let count = chain.joints.len();
    let per_joint = [1, 1000, 33, 10, 6, 4][count.min(N)];
    let total = (0..count).fold(1_usize, |total, _| total * per_joint);
    let posture = |index: usize| {
        let mut rest = index;
        let mut q = [0.0; N];
        for slot in 0..count {
            let share = (rest % per_joint) as f64 / (per_joint - 1) as f64;
            q[slot] = lower[slot] + (upper[slot] - lower[slot]) * share;
            rest /= per_joint;
        }
        (q, chain.tip(&q[..count], TipFrame::Pole))
    };
    (0..total).map(posture).collect()
}
