//! Fig. 2: what the plain mappings lose when an index finger of other phalanx lengths follows the paradigmatic one.
//!
//! The index flexes in its plane. The slave's lengths go through a grid; wherever it is at least as long as the
//! master,
//!
//! - (a) Cartesian mapping puts the tip where the master's is, and the *shape* differs,
//! - (b) joint mapping copies the angles, and the tip's *position* differs.
//!
//! In (a) the finger is redundant. Of all postures that reach the point, the one nearest to the master's is taken,
//! without joint limits: the error is then the least that any inverse kinematics can have. The paper names neither
//! posture nor redundancy nor step, so these are the numbers of the stated postures.

use std::f64::consts::{PI, TAU};

use nalgebra::{SMatrix, SVector, Vector2};

use crate::hand::Finger;
use crate::master::MasterGeometry;

/// Phalanx lengths of the master's index, m.
pub const MASTER: [f64; 3] = MasterGeometry::PARADIGMATIC.phalanges[Finger::Index.index()];

/// The postures evaluated, MCP, PIP and DIP flexion, degrees.
pub const POSTURES_DEG: [[f64; 3]; 3] = [[30.0, 45.0, 30.0], [20.0, 39.0, 34.0], [40.0, 78.0, 68.0]];

/// Steps of the scan along the self-motion.
const SCAN: usize = 720;

/// What one combination of lengths loses in one posture.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Loss {
    /// Phalanx lengths of the slave, m.
    pub lengths: [f64; 3],
    /// (a): q_S - q of the Cartesian mapping, rad.
    pub shape: [f64; 3],
    /// (b): p_S - p of the joint mapping, m; distal (the paper's y) and palmar.
    pub position: [f64; 2],
}

/// Largest, smallest and mean magnitude of a quantity over the combinations, and where they occur.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Extremes {
    /// The value of largest magnitude, with its sign.
    pub max: f64,
    /// Phalanx lengths there, m.
    pub max_at: [f64; 3],
    /// The value of smallest magnitude, with its sign.
    pub min: f64,
    /// Phalanx lengths there, m.
    pub min_at: [f64; 3],
    /// Mean magnitude.
    pub mean: f64,
}

/// The slave's phalanx lengths: 10 to 50 mm in steps of 5 mm each, as long as the master together or longer, m.
#[must_use]
pub fn combinations() -> Vec<[f64; 3]> {
    // In whole mm, so that the comparison of sums is exact.
    let grid = || (10..=50).step_by(5);
    let least = (MASTER.iter().sum::<f64>() * 1e3).round() as i32;
    let mut out = Vec::new();
    for a1 in grid() {
        for a2 in grid() {
            out.extend(grid().filter(|a3| a1 + a2 + a3 >= least).map(|a3| [a1, a2, a3].map(|a| f64::from(a) * 1e-3)));
        }
    }
    out
}

/// The losses of all combinations in the posture `q` (rad). A combination that cannot reach the master's tip is left
/// out; in the [`POSTURES_DEG`] there is none.
#[must_use]
pub fn losses(q: &[f64; 3]) -> Vec<Loss> {
    let target = tip(&MASTER, q);
    let loss = |lengths: [f64; 3]| {
        let nearest = nearest_posture(&lengths, &target, q)?;
        Some(Loss {
            lengths,
            shape: std::array::from_fn(|joint| nearest[joint] - q[joint]),
            position: (tip(&lengths, q) - target).into(),
        })
    };
    combinations().into_iter().filter_map(loss).collect()
}

/// The extremes of `value` over the losses; `None` without any.
#[must_use]
pub fn extremes(losses: &[Loss], value: impl Fn(&Loss) -> f64) -> Option<Extremes> {
    let first = losses.first()?;
    let start = value(first);
    let mut out = Extremes { max: start, max_at: first.lengths, min: start, min_at: first.lengths, mean: 0.0 };
    for loss in losses {
        let value = value(loss);
        if value.abs() > out.max.abs() {
            (out.max, out.max_at) = (value, loss.lengths);
        }
        if value.abs() < out.min.abs() {
            (out.min, out.min_at) = (value, loss.lengths);
        }
        out.mean += value.abs() / losses.len() as f64;
    }
    Some(out)
}

/// Tip of a planar finger, m: distal and palmar.
#[must_use]
pub fn tip(lengths: &[f64; 3], q: &[f64; 3]) -> Vector2<f64> {
    directions(q).iter().zip(lengths).map(|(direction, length)| direction * *length).sum()
}

/// Of all postures of a planar finger that bring its tip to `target` (m), the one nearest to `q` (rad), as angles
/// within half a turn of `q`; `None` if the target is out of reach.
///
/// The self-motion is scanned by the direction of the last phalanx, on both sides of the straight elbow, and its best
/// places are refined by Newton's method on the Karush-Kuhn-Tucker conditions, so the optimum is the global one.
#[must_use]
pub fn nearest_posture(lengths: &[f64; 3], target: &Vector2<f64>, q: &[f64; 3]) -> Option<[f64; 3]> {
    let cost = |candidate: &[f64; 3]| candidate.iter().zip(q).map(|(a, b)| (a - b).powi(2)).sum::<f64>();
    let mut best: Option<([f64; 3], f64)> = None;
    for side in [1.0, -1.0] {
        let at = |step: usize| {
            let candidate = with_last_direction(lengths, target, q, TAU * step as f64 / SCAN as f64, side)?;
            Some((candidate, cost(&candidate)))
        };
        let scan: Vec<_> = (0..SCAN).map(at).collect();
        for step in 0..SCAN {
            let Some((candidate, value)) = scan[step] else { continue };
            let lower = |other: usize| scan[other % SCAN].is_some_and(|(_, other)| other < value);
            if lower(step + SCAN - 1) || lower(step + 1) {
                continue;
            }
            let refined = refine(lengths, target, q, candidate).filter(|refined| cost(refined) <= value);
            let end = refined.unwrap_or(candidate);
            if best.is_none_or(|(_, least)| cost(&end) < least) {
                best = Some((end, cost(&end)));
            }
        }
    }
    best.map(|(posture, _)| posture)
}

/// The posture whose last phalanx points along `direction` (rad) and whose elbow bends to `side`.
fn with_last_direction(
    [a1, a2, a3]: &[f64; 3],
    target: &Vector2<f64>,
    q: &[f64; 3],
    direction: f64,
    side: f64,
) -> Option<[f64; 3]> {
    let wrist = target - Vector2::new(direction.cos(), direction.sin()) * *a3;
    let cosine = (wrist.norm_squared() - a1 * a1 - a2 * a2) / (2.0 * a1 * a2);
    if !(-1.0..=1.0).contains(&cosine) {
        return None;
    }
    let second = side * cosine.acos();
    let first = wrist.y.atan2(wrist.x) - (a2 * second.sin()).atan2(a1 + a2 * cosine);
    let own = [first, second, direction - first - second];
    // The turn nearest to the master's angle.
    Some(std::array::from_fn(|joint| q[joint] + (own[joint] - q[joint] + PI).rem_euclid(TAU) - PI))
}

/// Newton's method on the conditions of the nearest posture that reaches the target; `None` if it does not converge.
fn refine(lengths: &[f64; 3], target: &Vector2<f64>, q: &[f64; 3], start: [f64; 3]) -> Option<[f64; 3]> {
    let mut posture = start;
    let mut multipliers = Vector2::zeros();
    for _ in 0..30 {
        // Joint j moves everything beyond it: sums over the phalanges from j on.
        let directions = directions(&posture);
        let beyond: [Vector2<f64>; 3] = std::array::from_fn(|joint| {
            (joint..3).map(|phalanx| directions[phalanx] * lengths[phalanx]).sum::<Vector2<f64>>()
        });
        let mut matrix = SMatrix::<f64, 5, 5>::zeros();
        let mut right = SVector::<f64, 5>::zeros();
        for row in 0..3 {
            let tangent = Vector2::new(-beyond[row].y, beyond[row].x);
            right[row] = q[row] - posture[row] - multipliers.dot(&tangent);
            for column in 0..3 {
                let curvature = multipliers.dot(&beyond[row.max(column)]);
                matrix[(row, column)] = f64::from(u8::from(row == column)) - curvature;
            }
            for axis in 0..2 {
                matrix[(row, 3 + axis)] = tangent[axis];
                matrix[(3 + axis, row)] = tangent[axis];
            }
        }
        let miss = target - beyond[0];
        (right[3], right[4]) = (miss.x, miss.y);
        let step = matrix.lu().solve(&right)?;
        for joint in 0..3 {
            posture[joint] += step[joint];
        }
        multipliers += Vector2::new(step[3], step[4]);
        if step.fixed_rows::<3>(0).amax() < 1e-13 && miss.norm() < 1e-14 {
            return Some(posture);
        }
    }
    None
}

/// Unit directions of the phalanges.
fn directions(q: &[f64; 3]) -> [Vector2<f64>; 3] {
    let mut angle = 0.0;
    q.map(|joint| {
        angle += joint;
        Vector2::new(angle.cos(), angle.sin())
    })
}
