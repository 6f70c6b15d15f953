//! One local optimum of the weighted sum: a primal-dual Newton method with box constraints.

#![allow(clippy::needless_range_loop, reason = "rows and columns are read better by index")]

use nalgebra::Vector3;

use super::{Angles, N};
use crate::hand::{FingerChain, TipFrame};

// Largest step of a joint in one iteration, rad: the tip is then at most 5 mm beside its linear prediction.
const RADIUS: f64 = 0.35;
// A Newton step below sqrt(LAST_STEP mu), rad, is the last: the 0.1 m/rad^2 that the finger is curved make of it a miss
// that weighs like 1e-4 rad of posture. At most MAX_LAST_STEP, for the posture's own sake.
const LAST_STEP: f64 = 1e-3;
const MAX_LAST_STEP: f64 = 1e-4;
// A rise of the weighted sum by this much (m^2) turns a step down: 3 mm off from a point that was exact.
const RISE: f64 = 5e-6;
// After that many iterations less and less of a rise is allowed: two linear predictions may send each other in a circle.
const PATIENCE: u16 = 5;

/// The sum to minimise, `1/2 ||F(q) - target||^2 + 1/2 weight ||q - reference||^2` in the box `lower..upper`.
pub(super) struct Problem<'a> {
    pub(super) chain: &'a FingerChain,
    pub(super) target: Vector3<f64>,
    pub(super) reference: Angles,
    /// mu^2, m²/rad².
    pub(super) weight: f64,
    pub(super) lower: &'a Angles,
    pub(super) upper: &'a Angles,
}

/// Where a descent ended.
#[derive(Clone, Copy)]
pub(super) struct Optimum {
    pub(super) q: Angles,
    /// F(q) - target, m.
    pub(super) residual: f64,
    /// The weighted sum, m².
    pub(super) cost: f64,
    pub(super) iterations: u16,
    pub(super) converged: bool,
}

/// The same for the C joints of a finger.
type Row<const C: usize> = [f64; C];
type Square<const C: usize> = [[f64; C]; C];

struct State<const C: usize> {
    residual: Vector3<f64>,
    jacobian: [Vector3<f64>; C],
    axes: [Vector3<f64>; C],
    cost: f64,
}

impl Problem<'_> {
    fn cost<const C: usize>(&self, residual: &Vector3<f64>, q: &Row<C>) -> f64 {
        let posture: f64 = q.iter().zip(&self.reference).map(|(a, b)| (a - b).powi(2)).sum();
        0.5 * (residual.norm_squared() + self.weight * posture)
    }

    fn state<const C: usize>(&self, q: &Row<C>) -> State<C> {
        let (tip, jacobian, axes) = self.chain.differential(q, TipFrame::Pole);
        let residual = tip - self.target;
        State { residual, jacobian, axes, cost: self.cost(&residual, q) }
    }

    fn clip<const C: usize>(&self, q: Row<C>) -> Row<C> {
        std::array::from_fn(|slot| q[slot].max(self.lower[slot]).min(self.upper[slot]))
    }

    /// [`Self::descend_by`] the number of the chain's joints: known to the compiler, it unrolls the loops over them.
    pub(super) fn descend(&self, start: &Angles, budget: u16) -> Optimum {
        match self.chain.joints.len() {
            1 => self.descend_by::<1>(start, budget),
            2 => self.descend_by::<2>(start, budget),
            3 => self.descend_by::<3>(start, budget),
            4 => self.descend_by::<4>(start, budget),
            _ => self.descend_by::<N>(start, budget),
        }
    }

    /// Follows the valley down from `start`, for at most `budget` iterations.
    ///
    /// With a small mu the valley of postures that reach the target is narrow and curved, and the residual's share of
    /// the Hessian, `sum residual_i d2F_i`, is garbage off its floor. So the multiplier is kept apart from the
    /// residual, as in an augmented Lagrangian: `rho`, the residual that the last step predicted for its end. The
    /// speed of convergence is then the same for every mu.
    fn descend_by<const C: usize>(&self, start: &Angles, budget: u16) -> Optimum {
        let all = |q: &Row<C>| std::array::from_fn(|slot| if slot < C { q[slot] } else { start[slot] });
        let mut q: Row<C> = self.clip(std::array::from_fn(|slot| start[slot]));
        let mut state = self.state(&q);
        let mut best =
            Optimum { q: all(&q), residual: state.residual.norm(), cost: state.cost, iterations: 0, converged: false };
        let last_step = (LAST_STEP * self.weight.sqrt()).sqrt().min(MAX_LAST_STEP);
        let (mut radius, mut rise) = (RADIUS, RISE);
        let mut rho: Option<Vector3<f64>> = None;
        let mut active = [false; C];
        for iteration in 1..=budget {
            let gradient: Row<C> = std::array::from_fn(|slot| {
                state.jacobian[slot].dot(&state.residual) + self.weight * (q[slot] - self.reference[slot])
            });
            let low: Row<C> = std::array::from_fn(|slot| (self.lower[slot] - q[slot]).max(-radius));
            let high: Row<C> = std::array::from_fn(|slot| (self.upper[slot] - q[slot]).min(radius));
            let mut gauss = [[0.0; C]; C];
            for row in 0..C {
                for column in 0..=row {
                    gauss[row][column] = state.jacobian[row].dot(&state.jacobian[column]);
                }
                gauss[row][row] += self.weight;
            }
            let predicted =
                |step: &Row<C>| (0..C).fold(state.residual, |sum, slot| sum + state.jacobian[slot] * step[slot]);
            let multiplier = rho.unwrap_or_else(|| {
                box_step(&gauss, &gradient, &low, &high, &mut active).map_or(state.residual, |step| predicted(&step))
            });
            let mut newton = gauss;
            for (row, own) in newton.iter_mut().enumerate() {
                // d2F / dq_row dq_column = axis_column x J_row for column <= row.
                let lever = state.jacobian[row].cross(&multiplier);
                for column in 0..=row {
                    own[column] += state.axes[column].dot(&lever);
                }
            }
            let exact = box_step(&newton, &gradient, &low, &high, &mut active);
            let is_newton = exact.is_some();
            // The Gauss-Newton matrix is positive definite whatever comes.
            let Some(step) = exact.or_else(|| box_step(&gauss, &gradient, &low, &high, &mut active)) else {
                break;
            };
            let trial = self.clip(std::array::from_fn(|slot| q[slot] + step[slot]));
            let moved = step.iter().fold(0.0_f64, |largest, step| largest.max(step.abs()));
            let next = predicted(&step);
            // A multiplier that is still on its way bends the valley, and makes short steps.
            let settled = is_newton && (next - multiplier).norm() < 0.01 * multiplier.norm() + self.weight;
            if moved < if settled { last_step.min(0.5 * radius) } else { 1e-9 } {
                let residual = self.chain.tip(&trial, TipFrame::Pole) - self.target;
                let cost = self.cost(&residual, &trial);
                // Below rounding either is as good.
                if cost <= best.cost * (1.0 + 1e-9) {
                    best = Optimum { q: all(&trial), residual: residual.norm(), cost, ..best };
                }
                return Optimum { iterations: iteration, converged: true, ..best };
            }
            let ahead = self.state(&trial);
            if iteration > PATIENCE {
                rise *= 0.25;
            }
            if ahead.cost > state.cost + rise {
                radius = 0.25 * moved;
                continue;
            }
            radius = if ahead.cost > state.cost { 0.5 * moved } else { (2.0 * radius).min(RADIUS) };
            rho = Some(next);
            (q, state) = (trial, ahead);
            if state.cost < best.cost {
                best = Optimum { q: all(&q), residual: state.residual.norm(), cost: state.cost, ..best };
            }
        }
        Optimum { iterations: budget, ..best }
    }
}

/// `argmin g'd + 1/2 d'Hd` for `low <= d <= high` by an active-set method; `active` is the guess of the joints that end
/// on a bound, and becomes the set found. `None` if `hessian` (its lower triangle is read) is not positive definite on
/// the free joints.
fn box_step<const C: usize>(
    hessian: &Square<C>,
    gradient: &Row<C>,
    low: &Row<C>,
    high: &Row<C>,
    active: &mut [bool; C],
) -> Option<Row<C>> {
    let entry = |row: usize, column: usize| if row >= column { hessian[row][column] } else { hessian[column][row] };
    let mut step = [0.0; C];
    for slot in 0..C {
        if active[slot] {
            step[slot] = if gradient[slot] > 0.0 { low[slot] } else { high[slot] };
        }
    }
    // Every pass fixes a joint or frees one; a cycle, which rounding can make, ends with the last feasible step.
    for _ in 0..4 * C {
        let free = solve_free(hessian, gradient, &step, active)?;
        // As far towards it as the bounds allow: the first joint to hit one stays there.
        let mut hit = None;
        let mut share = 1.0;
        for slot in 0..C {
            if active[slot] {
                continue;
            }
            let way = free[slot] - step[slot];
            let bound = if free[slot] < low[slot] {
                low[slot]
            } else if free[slot] > high[slot] {
                high[slot]
            } else {
                continue;
            };
            let part = if way == 0.0 { 0.0 } else { ((bound - step[slot]) / way).clamp(0.0, 1.0) };
            if hit.is_none() || part < share {
                (hit, share) = (Some((slot, bound)), part);
            }
        }
        for slot in 0..C {
            if !active[slot] {
                step[slot] += share * (free[slot] - step[slot]);
            }
        }
        if let Some((slot, bound)) = hit {
            active[slot] = true;
            step[slot] = bound;
            continue;
        }
        // Free the joint that its bound holds back against the slope the most.
        let mut release = None;
        let mut steepest = 0.0;
        for slot in 0..C {
            if active[slot] && low[slot] < high[slot] {
                let slope = (0..C).fold(gradient[slot], |sum, other| sum + entry(slot, other) * step[other]);
                let inward = if step[slot] <= low[slot] { -slope } else { slope };
                if inward > steepest {
                    (release, steepest) = (Some(slot), inward);
                }
            }
        }
        match release {
            Some(slot) => active[slot] = false,
            None => break,
        }
    }
    Some(step)
}

/// Minimiser over the joints that are not active, the others being as in `step`: L D L^T, row by row. Active joints get
/// rows of the identity instead of branches, which leaves loops of known length.
fn solve_free<const C: usize>(
    hessian: &Square<C>,
    gradient: &Row<C>,
    step: &Row<C>,
    active: &[bool; C],
) -> Option<Row<C>> {
    // The factor L, and L D.
    let (mut factor, mut scaled) = ([[0.0; C]; C], [[0.0; C]; C]);
    let (mut inverse, mut out) = ([0.0; C], *step);
    for row in 0..C {
        if !active[row] {
            out[row] = -gradient[row];
            for other in 0..C {
                let value = if row >= other { hessian[row][other] } else { hessian[other][row] };
                out[row] -= if active[other] { value * step[other] } else { 0.0 };
            }
        }
        let mut pivot = if active[row] { 1.0 } else { hessian[row][row] };
        let least = 1e-13 * pivot.abs();
        for column in 0..row {
            let mut sum = if active[row] || active[column] { 0.0 } else { hessian[row][column] };
            for inner in 0..column {
                sum -= scaled[row][inner] * factor[column][inner];
            }
            (scaled[row][column], factor[row][column]) = (sum, sum * inverse[column]);
            pivot -= sum * factor[row][column];
            out[row] -= factor[row][column] * out[column];
        }
        if pivot <= least {
            return None;
        }
        inverse[row] = 1.0 / pivot;
    }
    for row in (0..C).rev() {
        out[row] *= inverse[row];
        for below in row + 1..C {
            out[row] -= factor[below][row] * out[below];
        }
    }
    Some(out)
}
