//! From targets that may jump to commands that a hand can follow.

use crate::hand::{HandModel, JointVector, MAX_JOINTS};

/// Limits of one joint's command.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct JointLimits {
    /// Lowest position, rad.
    pub lower: f64,
    /// Highest position, rad.
    pub upper: f64,
    /// Largest speed, rad/s.
    pub velocity: f64,
    /// Largest change of velocity, rad/s².
    pub acceleration: f64,
}

/// Turns targets that may jump into commands that a hand can follow: low-pass, then limits of position, velocity and
/// acceleration against the last command (the order of libfranka).
///
/// For any input sequence, NaN and infinities included, every command is inside the joint limits, differs from the
/// one before by at most `velocity * period`, and its velocity by at most `acceleration * period`.
#[derive(Clone, Debug)]
pub struct Conditioner {
    limits: [JointLimits; MAX_JOINTS],
    period: f64,
    // Share of the distance that each of the two cascaded first-order low-passes covers in a tick.
    share: f64,
    position: JointVector,
    velocity: JointVector,
    // The two stages of the low-pass.
    stages: [JointVector; 2],
}

impl Conditioner {
    /// A conditioner at rest at the hand's `start` posture (clipped), for ticks `period` seconds apart, with a
    /// low-pass of time constant `smoothing` seconds per stage (0 is off).
    #[must_use]
    pub fn new(hand: &HandModel, start: &JointVector, period: f64, smoothing: f64) -> Self {
        let unused = JointLimits { lower: 0.0, upper: 0.0, velocity: 0.0, acceleration: 0.0 };
        let mut limits = [unused; MAX_JOINTS];
        for (slot, joint) in limits.iter_mut().zip(&hand.joints) {
            *slot = JointLimits {
                lower: joint.lower,
                upper: joint.upper,
                velocity: joint.velocity,
                acceleration: joint.acceleration,
            };
        }
        let position = hand.clip(start);
        Self {
            limits,
            period,
            share: if smoothing > 0.0 { 1.0 - (-period / smoothing).exp() } else { 1.0 },
            position,
            velocity: JointVector::zeros(position.len()),
            stages: [position; 2],
        }
    }

    /// The last command, rad.
    #[must_use]
    pub fn position(&self) -> &JointVector {
        &self.position
    }

    /// Velocity of the last command, rad/s.
    #[must_use]
    pub fn velocity(&self) -> &JointVector {
        &self.velocity
    }

    /// Restarts the low-pass at the last command, so that a new target is approached from there.
    pub fn reset_filter(&mut self) {
        self.stages = [self.position; 2];
    }

    /// Next command towards `target` (rad), with speeds further limited to `speed` (rad/s; 0 if it is negative or none).
    ///
    /// `adjust` may change the velocities that bring the hand there (rad/s); it gets the last command (rad), the
    /// velocities, and the least and largest that the limits allow. A target that is not finite is ignored: the joint
    /// holds.
    pub fn follow(
        &mut self,
        target: &JointVector,
        speed: f64,
        adjust: impl FnOnce(&JointVector, &mut JointVector, [&JointVector; 2]),
    ) {
        let (mut wanted, mut low, mut high) = (self.position, self.position, self.position);
        for joint in 0..self.position.len() {
            let limits = self.limits[joint];
            let goal = target.get(joint).copied().filter(|value| value.is_finite());
            let goal = goal.unwrap_or(self.position[joint]).clamp(limits.lower, limits.upper);
            self.stages[0][joint] += (goal - self.stages[0][joint]) * self.share;
            self.stages[1][joint] += (self.stages[0][joint] - self.stages[1][joint]) * self.share;
            // As fast as can still be braked at the filtered target. Its own velocity is not added: that would track
            // without the lag of v / 2a, but overshoot a target that stops.
            let gap = self.stages[1][joint] - self.position[joint];
            (low[joint], high[joint]) = self.range(joint, speed);
            wanted[joint] =
                within(brakeable(gap.abs(), limits.acceleration, self.period).copysign(gap), low[joint], high[joint]);
        }
        adjust(&self.position, &mut wanted, [&low, &high]);
        for joint in 0..self.position.len() {
            // Whatever came back, a number or none.
            let next = if wanted[joint].is_finite() { wanted[joint] } else { 0.0 };
            self.advance(joint, within(next, low[joint], high[joint]));
        }
    }

    /// Next command of a stop: brakes as fast as allowed, then stands still.
    pub fn hold(&mut self) {
        for joint in 0..self.position.len() {
            let (low, high) = self.range(joint, f64::INFINITY);
            self.advance(joint, within(0.0, low, high));
        }
        self.reset_filter();
    }

    /// True once a hold has come to rest.
    #[must_use]
    pub fn at_rest(&self) -> bool {
        self.velocity.iter().all(|velocity| *velocity == 0.0)
    }

    /// Least and largest velocity of the next tick.
    fn range(&self, joint: usize, speed: f64) -> (f64, f64) {
        let limits = self.limits[joint];
        let (position, velocity) = (self.position[joint], self.velocity[joint]);
        let change = limits.acceleration * self.period;
        // A lower speed limit is reached by braking, never by a jump. One that is no number is 0.
        let speed = speed.max(0.0).max(velocity.abs() - change).min(limits.velocity);
        let (low, high) = ((velocity - change).max(-speed), (velocity + change).min(speed));
        // Last, because it is never in conflict with the acceleration: every earlier step kept the way to brake.
        let to_lower = -brakeable(position - limits.lower, limits.acceleration, self.period);
        let to_upper = brakeable(limits.upper - position, limits.acceleration, self.period);
        (within(low, to_lower, to_upper), within(high, to_lower, to_upper))
    }

    fn advance(&mut self, joint: usize, velocity: f64) {
        let limits = self.limits[joint];
        self.velocity[joint] = velocity;
        self.position[joint] = (self.position[joint] + velocity * self.period).clamp(limits.lower, limits.upper);
    }
}

/// `value` between `low` and `high`; the last wins, should rounding have crossed them.
fn within(value: f64, low: f64, high: f64) -> f64 {
    value.max(low).min(high)
}

/// Largest velocity for one tick from which a joint can still stop within `distance` (m or rad), braking by
/// `acceleration` once a tick.
///
/// From velocity `n a dt` the joint travels `a dt^2 (1 + 2 + .. + n)` including this tick; in between the distance is
/// linear in the velocity. Being exact in discrete time, it neither overshoots nor creeps.
fn brakeable(distance: f64, acceleration: f64, period: f64) -> f64 {
    let unit = acceleration * period * period;
    if distance.is_nan() || distance <= 0.0 || unit <= 0.0 {
        return 0.0;
    }
    let steps = (0.5 * ((1.0 + 8.0 * distance / unit).sqrt() - 1.0)).floor();
    let covered = 0.5 * unit * steps * (steps + 1.0);
    steps * acceleration * period + (distance - covered) / ((steps + 1.0) * period)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::hand::HandSide;

    const PERIOD: f64 = 0.003;

    fn hand() -> HandModel {
        HandModel::allegro_v4(HandSide::Right)
    }

    fn adversarial() -> impl Strategy<Value = f64> {
        prop_oneof![
            8 => -4.0..4.0_f64,
            1 => Just(f64::NAN),
            1 => Just(f64::INFINITY),
            1 => Just(f64::NEG_INFINITY),
            1 => Just(1e300),
        ]
    }

    fn limit() -> impl Strategy<Value = f64> {
        prop_oneof![8 => 0.0..9.0_f64, 1 => Just(f64::NAN), 1 => Just(f64::INFINITY), 1 => Just(-3.0)]
    }

    proptest! {
        #[test]
        fn limits_are_never_exceeded(
            targets in prop::collection::vec((prop::collection::vec(adversarial(), 16), 1usize..40, limit(), any::<bool>()), 1..30),
            smoothing in prop_oneof![Just(0.0), 0.001..0.05_f64],
            start in prop::collection::vec(-3.0..3.0_f64, 16),
        ) {
            let hand = hand();
            let mut conditioner = Conditioner::new(&hand, &JointVector::from_slice(&start), PERIOD, smoothing);
            let (mut q, mut v) = (*conditioner.position(), *conditioner.velocity());
            for (target, ticks, speed, hold) in targets {
                let target = JointVector::from_slice(&target);
                for _ in 0..ticks {
                    if hold { conditioner.hold() } else { conditioner.follow(&target, speed, |_, _, _| {}) }
                    let (next, velocity) = (*conditioner.position(), *conditioner.velocity());
                    for (joint, limits) in hand.joints.iter().enumerate() {
                        prop_assert!(next[joint] >= limits.lower && next[joint] <= limits.upper);
                        prop_assert!(velocity[joint].abs() <= limits.velocity + 1e-12);
                        prop_assert!((next[joint] - q[joint]).abs() <= limits.velocity * PERIOD + 1e-12);
                        let acceleration = (velocity[joint] - v[joint]) / PERIOD;
                        prop_assert!(acceleration.abs() <= limits.acceleration * (1.0 + 1e-9) + 1e-6,
                            "joint {} from {} to {}", joint, v[joint], velocity[joint]);
                    }
                    (q, v) = (next, velocity);
                }
            }
        }

        #[test]
        fn arrives_and_never_overshoots_a_still_target(target in prop::collection::vec(-0.4..1.6_f64, 16)) {
            let hand = hand();
            let target = hand.clip(&JointVector::from_slice(&target));
            let mut conditioner = Conditioner::new(&hand, &hand.home(), PERIOD, 0.01);
            let start = *conditioner.position();
            for _ in 0..1000 {
                conditioner.follow(&target, f64::INFINITY, |_, _, _| {});
                for joint in 0..16 {
                    let way = (target[joint] - start[joint]).signum();
                    prop_assert!((target[joint] - conditioner.position()[joint]) * way >= -1e-9);
                }
            }
            for joint in 0..16 {
                prop_assert!((target[joint] - conditioner.position()[joint]).abs() < 1e-6);
            }
        }
    }

    #[test]
    fn a_moving_target_is_followed_with_the_lag_of_braking_and_no_more() {
        let hand = hand();
        let mut conditioner = Conditioner::new(&hand, &hand.home(), PERIOD, 0.0);
        let mut target = hand.home();
        let acceleration = hand.joints[1].acceleration;
        for tick in 0..1000 {
            let phase = f64::from(tick) * PERIOD * 4.0;
            target[1] = hand.home()[1] + 0.5 * (1.0 - phase.cos());
            conditioner.follow(&target, f64::INFINITY, |_, _, _| {});
            let speed = 2.0;
            let lag = speed * speed / (2.0 * acceleration) + 2.0 * speed * PERIOD;
            assert!((conditioner.position()[1] - target[1]).abs() < lag, "at {phase}");
        }
    }

    /// Found by fuzzing: the joint moved, away from its target.
    #[test]
    fn a_speed_limit_that_is_none_moves_nothing() {
        let hand = hand();
        let mut conditioner = Conditioner::new(&hand, &hand.home(), PERIOD, 0.0);
        let mut target = hand.home();
        target[2] = 1.6;
        for speed in [f64::NAN, -1.0, f64::NEG_INFINITY, 0.0] {
            conditioner.follow(&target, speed, |_, velocity, [low, high]| {
                assert!(low.iter().zip(high.iter()).all(|(low, high)| low <= high), "{low:?} {high:?}");
                assert!(velocity.iter().all(|velocity| *velocity == 0.0), "{velocity:?}");
            });
            assert!(conditioner.at_rest() && *conditioner.position() == hand.home());
        }
    }

    #[test]
    fn hold_stops_within_the_braking_distance() {
        let hand = hand();
        let mut conditioner = Conditioner::new(&hand, &hand.home(), PERIOD, 0.0);
        let mut target = hand.home();
        target[2] = 1.6;
        for _ in 0..30 {
            conditioner.follow(&target, f64::INFINITY, |_, _, _| {});
        }
        let (from, velocity) = (conditioner.position()[2], conditioner.velocity()[2]);
        assert!(velocity > 1.0);
        let mut ticks = 0;
        while !conditioner.at_rest() {
            conditioner.hold();
            ticks += 1;
            assert!(ticks < 1000, "never came to rest");
        }
        let acceleration = hand.joints[2].acceleration;
        assert!(conditioner.position()[2] - from <= velocity * velocity / (2.0 * acceleration) + velocity * PERIOD);
    }
}
