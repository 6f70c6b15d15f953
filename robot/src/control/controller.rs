use std::time::Duration;

use teleop_common::guard::{MotionGuard, TipGuard};
use teleop_common::hand::{HandModel, JointVector, MAX_FINGERS};
use teleop_common::mapping::{MappingOutput, MappingParams, ParamError, Retargeter};
use teleop_common::master::MasterPose;
use teleop_common::mode::Mode;
use teleop_common::time::MonoTime;

use super::Conditioner;
use crate::driver::{JointCommand, JointState};

/// How the control loop behaves in time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ControlParams {
    /// Ticks per second.
    pub rate: f64,
    /// Without a fresh pose for this long the hand holds still.
    pub hold_after: Duration,
    /// Time constant of each of the two low-pass stages of the command, s; 0 is off.
    pub smoothing: f64,
    /// Speed limit right after the hand starts to follow, rad/s.
    pub engage_speed: f64,
    /// Time over which that limit widens to the joints' own, s.
    pub engage_ramp: f64,
    /// How deep two fingertips may be commanded into each other, m. More squeezes harder what is between them.
    pub tip_overlap: f64,
}

impl Default for ControlParams {
    fn default() -> Self {
        Self {
            rate: 333.0,
            hold_after: Duration::from_millis(200),
            smoothing: 0.008,
            engage_speed: 1.0,
            engage_ramp: 1.0,
            tip_overlap: 0.0005,
        }
    }
}

/// A pose that passed the gate.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PoseSample {
    /// The pose.
    pub pose: MasterPose,
    /// Epoch of the operator that sent it.
    pub epoch: u64,
    /// Its number within the epoch.
    pub sequence: u64,
    /// When it was captured, by the operator's clock.
    pub captured_remote: MonoTime,
    /// The same by this process's clock.
    pub captured: MonoTime,
    /// When it arrived.
    pub received: MonoTime,
}

/// Why the hand was stopped for good.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[repr(u8)]
pub enum Fault {
    /// None.
    #[default]
    None = 0,
    /// The hand reported a state that is no number, or of another number of joints.
    StateInvalid = 1,
    /// The loop computed a command that is no number.
    CommandNotFinite = 2,
    /// The driver failed.
    Driver = 3,
}

/// Everything one tick knew and did; fixed size, for telemetry.
#[derive(Clone, Copy, Debug)]
pub struct TickRecord {
    /// Number of the tick.
    pub tick: u64,
    /// When.
    pub now: MonoTime,
    /// Mode after the tick.
    pub mode: Mode,
    /// Fault, if [`Mode::Faulted`].
    pub fault: Fault,
    /// State of the hand before the tick; the last valid one, if the hand reported one that is not.
    pub state: JointState,
    /// What was commanded.
    pub command: JointCommand,
    /// The newest pose obeyed so far.
    pub sample: Option<PoseSample>,
    /// What the mapping made of it.
    pub mapping: Option<MappingOutput>,
    /// Times the hand had to hold so far.
    pub holds: u64,
}

/// The control loop's state; [`Controller::tick`] is its body.
#[derive(Clone, Debug)]
pub struct Controller {
    params: ControlParams,
    retargeter: Retargeter,
    guard: TipGuard,
    motion: MotionGuard,
    conditioner: Option<Conditioner>,
    mode: Mode,
    fault: Fault,
    engaged_at: MonoTime,
    sample: Option<PoseSample>,
    mapping: Option<MappingOutput>,
    // Its posture with the fingertips apart, and the fingers that may give way for that.
    target: JointVector,
    movable: [bool; MAX_FINGERS],
    // The last valid state of the hand.
    state: JointState,
    tick: u64,
    holds: u64,
}

impl Controller {
    /// A controller for `hand`.
    ///
    /// # Errors
    /// A mapping parameter that cannot be used.
    pub fn new(hand: HandModel, mapping: MappingParams, params: ControlParams) -> Result<Self, ParamError> {
        let still = JointVector::zeros(hand.joints.len());
        let state = JointState { q: hand.home(), dq: still, tau: still };
        Ok(Self {
            params,
            guard: TipGuard::new(&hand, params.tip_overlap),
            motion: MotionGuard::new(&hand, params.tip_overlap),
            retargeter: Retargeter::new(hand, mapping)?,
            conditioner: None,
            mode: Mode::Idle,
            fault: Fault::None,
            engaged_at: MonoTime(0),
            sample: None,
            mapping: None,
            target: state.q,
            movable: [false; MAX_FINGERS],
            state,
            tick: 0,
            holds: 0,
        })
    }

    /// The hand driven.
    #[must_use]
    pub fn hand(&self) -> &HandModel {
        self.retargeter.hand()
    }

    /// The last tick's mode.
    #[must_use]
    pub fn mode(&self) -> Mode {
        self.mode
    }

    /// Stops the hand for good: from now on commands are zero torque.
    pub fn fail(&mut self, fault: Fault) {
        self.mode = Mode::Faulted;
        if self.fault == Fault::None {
            self.fault = fault;
        }
    }

    /// One tick: from the newest admitted pose and the hand's state to the command.
    ///
    /// `newest` may be the same pose as before; it counts as fresh for [`ControlParams::hold_after`] from its
    /// arrival. Without a fresh pose the hand brakes within its limits and then holds its posture; when poses come
    /// again it starts from there, slowly at first.
    pub fn tick(&mut self, now: MonoTime, newest: Option<&PoseSample>, state: &JointState) -> TickRecord {
        self.tick += 1;
        let joints = self.hand().joints.len();
        let valid = |values: &JointVector| values.len() == joints && values.is_finite();
        if valid(&state.q) && valid(&state.dq) && valid(&state.tau) {
            self.state = *state;
        } else {
            // What is no number must reach neither the hand nor the network.
            self.fail(Fault::StateInvalid);
        }
        let state = self.state;
        let command = if self.mode == Mode::Faulted { None } else { self.command(now, newest, &state) };
        let command = command.unwrap_or_else(|| {
            self.fail(Fault::CommandNotFinite);
            JointCommand::limp(&state)
        });
        TickRecord {
            tick: self.tick,
            now,
            mode: self.mode,
            fault: self.fault,
            state,
            command,
            sample: self.sample,
            mapping: self.mapping,
            holds: self.holds,
        }
    }

    /// The next command, or `None` if it would not be finite.
    fn command(&mut self, now: MonoTime, newest: Option<&PoseSample>, state: &JointState) -> Option<JointCommand> {
        let (params, retargeter) = (self.params, &mut self.retargeter);
        let conditioner = self
            .conditioner
            .get_or_insert_with(|| Conditioner::new(retargeter.hand(), &state.q, 1.0 / params.rate, params.smoothing));
        let fresh = newest.filter(|sample| now.since(sample.received) <= params.hold_after);
        if let Some(sample) = fresh {
            let known = self.sample.as_ref().map(|last| (last.epoch, last.sequence));
            if known != Some((sample.epoch, sample.sequence)) {
                let mapping = retargeter.map(&sample.pose);
                // A finger that only copies the human's shape keeps it: the others go round it.
                self.movable = [false; MAX_FINGERS];
                self.movable.iter_mut().zip(mapping.fingers()).for_each(|(own, signals)| *own = signals.k > 0.0);
                self.target = self.guard.apart(retargeter.hand(), &mapping.q, &self.movable);
                self.mapping = Some(mapping);
                self.sample = Some(*sample);
            }
            if self.mode != Mode::Engaged {
                self.mode = Mode::Engaged;
                self.engaged_at = now;
            }
        } else if self.mode == Mode::Engaged {
            self.mode = Mode::Holding;
            self.holds += 1;
        }
        match self.mode {
            Mode::Engaged => {
                let since = now.since(self.engaged_at).as_secs_f64();
                // The limit widens tenfold over the ramp, then only the joints' own limits count.
                let ramp = since < params.engage_ramp;
                let widened = params.engage_speed * (1.0 + 9.0 * since / params.engage_ramp);
                let (guard, hand, movable) = (&self.motion, retargeter.hand(), &self.movable);
                conditioner.follow(&self.target, if ramp { widened } else { f64::INFINITY }, |q, velocity, range| {
                    guard.guard(hand, q, movable, velocity, range, 1.0 / params.rate);
                });
            }
            _ => conditioner.hold(),
        }
        let command = servo(retargeter.hand(), state, conditioner.position(), conditioner.velocity());
        (command.q.is_finite() && command.dq.is_finite() && command.tau.is_finite()).then_some(command)
    }
}

/// Torques of the position controller (PD with velocity feed-forward), limited per joint.
fn servo(hand: &HandModel, state: &JointState, q: &JointVector, dq: &JointVector) -> JointCommand {
    let mut tau = JointVector::zeros(q.len());
    for (slot, joint) in hand.joints.iter().enumerate() {
        let torque = joint.kp * (q[slot] - state.q[slot]) + joint.kd * (dq[slot] - state.dq[slot]);
        tau[slot] = torque.clamp(-joint.torque, joint.torque);
    }
    JointCommand { q: *q, dq: *dq, tau }
}
