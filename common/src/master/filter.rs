//! Takes the tracker's noise out of a fitted hand, without taking its pinches or its quickness.
//!
//! The filter works on the joint angles of the fit, so it cannot stretch a bone and whole-hand motion means nothing to
//! it. How strong it is follows from the noise, which shows in the lengths of the bones: they are constant, so whatever
//! they change by from frame to frame is the tracker's doing. Exact keypoints therefore pass as they are; so do those of
//! a tracker that imposes constant bones and trembles in its angles, because that noise is not seen.
//!
//! A fingertip whose acceleration is white with density A, measured with noise sigma every dt, is best followed by a
//! system of second order with the natural frequency (steady-state Kalman filter of constant velocity)
//!
//! ```text
//! omega = sqrt(A / (sigma sqrt(dt)))
//! ```
//!
//! It is used here with critical damping, because a hand must not overshoot, and solved exactly for each interval, so
//! that any frame rate and any jitter of it will do. A grows with the speed of the tip: a hand at rest is smoothed
//! long, a moving one briefly. Only speed that goes on counts: a jump of one frame and back has none, so a spike is
//! smoothed away and the second frame of a real motion is followed.
//!
//! Where the thumb nears a finger, smoothing must not lose the touch. There the angles of both are moved towards the
//! measured ones, just so far that the tips are not farther apart than measured. A tap of a single frame is kept; in
//! the other direction, opening, the filter's lag remains.

use nalgebra::Vector3;

use super::keypoints::Keypoints;
use super::model::MasterGeometry;
use crate::hand::{Finger, MAX_FINGERS};

/// A longer gap in the stream starts the filter anew, s.
const GAP: f64 = 0.3;
/// Time constant of the noise estimate, s.
const NOISE_MEMORY: f64 = 1.0;
/// Standard deviation of a point's coordinate per mean absolute change of a bone between frames, for independent normal
/// noise: a change is a difference of two lengths, and a length that of two points.
const NOISE_PER_CHANGE: f64 = 0.6267;
/// Time constant of the speed of a fingertip, s.
const SPEED_MEMORY: f64 = 0.02;
/// Longest delay of a steady motion, 2 / omega, however noisy the tracker is, s.
const MAX_DELAY: f64 = 0.15;
/// omega dt above which nothing is left to smooth.
const INSTANT: f64 = 100.0;
/// Rounds over the fingers to keep pinches, each of which moves the thumb they share.
const ROUNDS: usize = 3;
/// Halvings in the search for the least correction of one.
const HALVINGS: usize = 10;

/// What the filter may trade.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FilterSettings {
    /// Square root of the density of a resting fingertip's acceleration, m^(1/2) s^(-3/4).
    pub rest: f64,
    /// What a metre per second of its speed adds to that.
    pub motion: f64,
    /// Distance of thumb and finger within which they are never farther apart than measured, m. Beyond it they may be by
    /// as much as the distance exceeds it.
    pub near: f64,
    /// What the filtered distance may exceed the measured one by, in standard deviations of the noise.
    pub tolerance: f64,
}

impl Default for FilterSettings {
    fn default() -> Self {
        Self { rest: 0.1, motion: 0.5, near: 0.035, tolerance: 2.0 }
    }
}

/// Filters frame after frame of one person's hand. No allocation, bounded work.
#[derive(Clone, Copy, Debug)]
pub struct Filter {
    geometry: MasterGeometry,
    settings: FilterSettings,
    state: Option<State>,
    /// Mean absolute change of the bones from frame to frame, m, and the time it was gathered over, s.
    change: f64,
    gathered: f64,
}

#[derive(Clone, Copy, Debug)]
struct State {
    /// Filtered angles, rad, and their velocities, rad/s.
    q: [f64; 20],
    dq: [f64; 20],
    /// Bones of the last keypoints, m.
    bones: [[f64; 3]; MAX_FINGERS],
    tips: [Tip; MAX_FINGERS],
}

#[derive(Clone, Copy, Debug)]
struct Tip {
    /// Last measured place in O_W, m.
    at: Vector3<f64>,
    /// Low-passed velocity, m/s.
    velocity: Vector3<f64>,
    /// Low-passed speed of motion that goes on, m/s.
    speed: f64,
}

impl Filter {
    /// For the geometry that the angles belong to.
    #[must_use]
    pub const fn new(geometry: MasterGeometry, settings: FilterSettings) -> Self {
        Self { geometry, settings, state: None, change: 0.0, gathered: 0.0 }
    }

    /// Forgets the posture; to be called where the stream jumps. The tracker's noise is remembered.
    pub fn reset(&mut self) {
        self.state = None;
    }

    /// Standard deviation of the tracker's noise per coordinate, as far as known, m.
    #[must_use]
    pub fn noise(&self) -> f64 {
        self.change * NOISE_PER_CHANGE
    }

    /// Filtered joint angles (rad), given those fitted to `keypoints` and the time since the frame before, s.
    ///
    /// After more than 0.3 s the filter starts anew from the fitted angles; where no time has passed (`dt` is not above
    /// 0) the last angles stand.
    pub fn apply(&mut self, dt: f64, keypoints: &Keypoints, fitted: &[f64; 20]) -> [f64; 20] {
        let bones = bones(keypoints);
        let tips = Finger::ALL.map(|finger| self.tip(finger, fitted));
        let state = match self.state {
            Some(state) if dt.is_nan() || dt <= 0.0 => state,
            Some(state) if dt <= GAP => self.step(state, dt, &bones, &tips, fitted),
            _ => State {
                q: *fitted,
                dq: [0.0; 20],
                bones,
                tips: tips.map(|at| Tip { at, velocity: Vector3::zeros(), speed: 0.0 }),
            },
        };
        self.state = Some(state);
        state.q
    }

    fn step(
        &mut self,
        mut state: State,
        dt: f64,
        bones: &[[f64; 3]; MAX_FINGERS],
        tips: &[Vector3<f64>; MAX_FINGERS],
        fitted: &[f64; 20],
    ) -> State {
        let changes = bones.iter().flatten().zip(state.bones.iter().flatten()).map(|(now, then)| (now - then).abs());
        let change = changes.sum::<f64>() / (3 * MAX_FINGERS) as f64;
        // A plain mean until it spans the memory.
        self.gathered = (self.gathered + dt).min(NOISE_MEMORY);
        self.change += (change - self.change) * (dt / self.gathered);
        state.bones = *bones;

        let noise = (self.noise() * dt.sqrt()).sqrt();
        for (f, (tip, at)) in state.tips.iter_mut().zip(tips).enumerate() {
            tip.advance(dt, at);
            // Infinite without noise.
            let omega = (self.settings.rest + self.settings.motion * tip.speed) / noise;
            let omega = omega.max(2.0 / MAX_DELAY).min(INSTANT / dt);
            let decay = (-omega * dt).exp();
            let own = 4 * f..4 * f + 4;
            let joints = state.q[own.clone()].iter_mut().zip(&mut state.dq[own.clone()]).zip(&fitted[own]);
            for ((q, dq), target) in joints {
                // Critically damped, towards a target that stays where it is for dt.
                let away = *q - target;
                let rate = *dq + omega * away;
                *q = target + (away + rate * dt) * decay;
                *dq = (*dq - omega * rate * dt) * decay;
            }
        }
        self.keep_pinches(&mut state.q, tips, fitted);
        state
    }

    /// Moves thumb and fingers towards the fitted angles until no finger is farther from the thumb than it may be.
    fn keep_pinches(&self, q: &mut [f64; 20], tips: &[Vector3<f64>; MAX_FINGERS], fitted: &[f64; 20]) {
        let thumb = &tips[Finger::Thumb.index()];
        let mut order = [Finger::Index, Finger::Middle, Finger::Ring, Finger::Little]
            .map(|finger| (finger, (tips[finger.index()] - thumb).norm()));
        // The nearest last: it has the final say about the thumb.
        order.sort_unstable_by(|a, b| b.1.total_cmp(&a.1));
        for (finger, measured) in [order; ROUNDS].into_iter().flatten() {
            let slack = (measured - self.settings.near).max(0.0) + self.settings.tolerance * self.noise();
            let start = *q;
            // Goes the given share of the way to the fitted angles; true if that is enough.
            let mut go = |share: f64| {
                for first in [0, 4 * finger.index()] {
                    for joint in first..first + 4 {
                        q[joint] = start[joint] + share * (fitted[joint] - start[joint]);
                    }
                }
                (self.tip(finger, q) - self.tip(Finger::Thumb, q)).norm() <= measured + slack
            };
            if go(0.0) {
                continue;
            }
            let (mut short, mut enough) = (0.0, 1.0);
            for _ in 0..HALVINGS {
                let middle = 0.5 * (short + enough);
                if go(middle) { enough = middle } else { short = middle }
            }
            go(enough);
        }
    }

    fn tip(&self, finger: Finger, q: &[f64; 20]) -> Vector3<f64> {
        let start = 4 * finger.index();
        self.geometry.finger_points(finger, &[q[start], q[start + 1], q[start + 2], q[start + 3]])[3]
    }
}

impl Tip {
    fn advance(&mut self, dt: f64, at: &Vector3<f64>) {
        let share = 1.0 - (-dt / SPEED_MEMORY).exp();
        let before = self.velocity;
        self.velocity += ((at - self.at) / dt - before) * share;
        // The part of the smaller velocity that points along the larger one.
        let larger = before.norm().max(self.velocity.norm());
        let lasting = if larger > 0.0 { before.dot(&self.velocity).max(0.0) / larger } else { 0.0 };
        self.speed += (lasting - self.speed) * share;
        self.at = *at;
    }
}

/// Lengths of the phalanges, m.
fn bones(keypoints: &Keypoints) -> [[f64; 3]; MAX_FINGERS] {
    Finger::ALL.map(|finger| {
        let points = keypoints.finger(finger);
        [0, 1, 2].map(|k| (points[k + 1] - points[k]).norm())
    })
}
