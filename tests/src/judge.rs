//! Whether a robot's commands kept their limits, judged from the outside: by commands and tick numbers alone.

use teleop_common::guard::{MAX_PENETRATION, MotionGuard};
use teleop_common::hand::{HandModel, JointVector};

use crate::probe::State;

/// A command at a tick.
#[derive(Clone, Copy, Debug)]
pub struct Command {
    /// Which run of the robot.
    pub epoch: u64,
    /// Number of the control tick.
    pub tick: u64,
    /// Commanded angles, rad.
    pub q: JointVector,
}

/// The largest values seen.
#[derive(Clone, Copy, Debug, Default)]
pub struct Extremes {
    /// Commands judged.
    pub commands: usize,
    /// Mean speed between two commands, rad/s.
    pub speed: f64,
    /// Change of the mean speed over the time between the middles of two intervals, rad/s².
    pub acceleration: f64,
}

/// The commands in joint states.
#[must_use]
pub fn commands(states: &[State]) -> Vec<Command> {
    let command = |state: &State| Command { epoch: state.header.epoch, tick: state.tick, q: state.q_command() };
    states.iter().map(command).collect()
}

/// Expects positions, velocities and accelerations within the limits of `hand`, and the hand out of itself; `resolution`
/// (rad) is how exact the angles are, `rate` in ticks per second.
///
/// Commands may be any number of ticks apart. If each tick keeps the limits, so do the means: the speed over n ticks,
/// and the change of speed from n ticks to the next m, whose middles are (n + m) / 2 ticks apart.
///
/// # Panics
/// If a command is beyond a limit, not finite, or not after the one before.
#[track_caller]
pub fn assert_limits(commands: &[Command], hand: &HandModel, rate: f64, resolution: f64) -> Extremes {
    let mut extremes = Extremes { commands: commands.len(), ..Extremes::default() };
    let guard = MotionGuard::new(hand, 0.0);
    for command in commands {
        assert_eq!(command.q.len(), hand.joints.len());
        let gap = guard.least_gap(hand, &command.q);
        assert!(gap >= -MAX_PENETRATION - resolution, "tick {}: {} m inside itself", command.tick, -gap);
        for (q, joint) in command.q.iter().zip(&hand.joints) {
            let inside = (joint.lower - resolution..=joint.upper + resolution).contains(q);
            assert!(inside, "tick {}: {} at {q}, limits {} to {}", command.tick, joint.name, joint.lower, joint.upper);
        }
    }
    // Ticks and speeds of the interval before.
    let mut before: Option<(f64, JointVector)> = None;
    for pair in commands.windows(2) {
        let [from, to] = pair else { continue };
        if from.epoch != to.epoch {
            before = None;
            continue;
        }
        assert!(to.tick > from.tick, "tick {} after {}", to.tick, from.tick);
        let ticks = (to.tick - from.tick) as f64;
        let time = ticks / rate;
        let mut speeds = to.q;
        for (slot, joint) in hand.joints.iter().enumerate() {
            let speed = (to.q[slot] - from.q[slot]) / time;
            speeds[slot] = speed;
            let allowed = joint.velocity + 2.0 * resolution / time;
            assert!(speed.abs() <= allowed, "tick {}: {} at {speed} rad/s, limit {allowed}", to.tick, joint.name);
            extremes.speed = extremes.speed.max(speed.abs());
            if let Some((ticks_before, speeds_before)) = before {
                let apart = 0.5 * (ticks + ticks_before) / rate;
                let acceleration = (speed - speeds_before[slot]).abs() / apart;
                let rounding = 4.0 * resolution / (ticks.min(ticks_before) / rate) / apart;
                let allowed = joint.acceleration * (1.0 + 1e-9) + rounding;
                let (tick, name) = (to.tick, &joint.name);
                assert!(acceleration <= allowed, "tick {tick}: {name} at {acceleration} rad/s², limit {allowed}");
                extremes.acceleration = extremes.acceleration.max(acceleration);
            }
        }
        before = Some((ticks, speeds));
    }
    extremes
}

/// The farthest that any angle is from its first value, rad.
#[must_use]
pub fn spread<'a>(mut angles: impl Iterator<Item = &'a JointVector>) -> f64 {
    let Some(first) = angles.next() else { return 0.0 };
    angles.flat_map(|q| q.iter().zip(first.iter())).fold(0.0, |most: f64, (a, b)| most.max((a - b).abs()))
}
