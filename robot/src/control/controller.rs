use std::time::Duration;

use serde::{Deserialize, Serialize};
use teleop_common::authority::{Clutch, Heard, Intent, Latch, Machine, MachineParams};
use teleop_common::closing;
use teleop_common::guard::{MotionGuard, TipGuard};
use teleop_common::hand::{HandModel, JointVector, MAX_FINGERS};
use teleop_common::mapping::{MappingOutput, MappingParams, ParamError, Retargeter};
use teleop_common::master::MasterPose;
use teleop_common::mode::Mode;
use teleop_common::playout::{Played, Playout, PlayoutParams};
use teleop_common::time::MonoTime;

use super::Conditioner;
use crate::driver::{JointCommand, JointState};

/// What the hand does when a hold lasts.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Relax {
    /// Holds on.
    #[default]
    Hold,
    /// Holds its posture with less torque, so that a person can open it.
    Yield,
    /// Opens: goes to its home posture with the speed of engaging.
    Open,
    /// Lets go: no torque.
    Off,
}

/// What a stop does.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum StopAction {
    /// Brakes and holds the posture (stop category 2 of IEC 60204-1).
    #[default]
    Hold,
    /// Brakes, then takes the torque off (category 1).
    Off,
}

/// Share of the torque limits that is left to a hand that yields.
const YIELD: f64 = 0.2;

/// How the control loop behaves in time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ControlParams {
    /// Ticks per second.
    pub rate: f64,
    /// So long after a pose was due the hand holds still.
    pub hold_after: Duration,
    /// What it does when that lasts, and after how long.
    pub relax: Relax,
    /// See [`ControlParams::relax`].
    pub relax_after: Duration,
    /// What a stop does.
    pub stop: StopAction,
    /// Time constant of each of the two low-pass stages of the command, s; 0 is off.
    pub smoothing: f64,
    /// Speed limit right after the hand starts to follow, rad/s.
    pub engage_speed: f64,
    /// Time over which that limit widens to the joints' own, s.
    pub engage_ramp: f64,
    /// How unevenly arriving poses are played.
    pub playout: PlayoutParams,
    /// How deep two fingertips may be commanded into each other, m. More squeezes harder what is between them.
    pub tip_overlap: f64,
}

impl Default for ControlParams {
    fn default() -> Self {
        Self {
            rate: 333.0,
            hold_after: Duration::from_millis(100),
            relax: Relax::Hold,
            relax_after: Duration::from_secs(10),
            stop: StopAction::Hold,
            smoothing: 0.008,
            engage_speed: 1.0,
            engage_ramp: 1.0,
            playout: PlayoutParams::default(),
            tip_overlap: 0.0005,
        }
    }
}

/// A pose that passed the lease.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PoseSample {
    /// The pose.
    pub pose: MasterPose,
    /// What the operator wants.
    pub intent: Intent,
    /// Epoch of the operator that sent it.
    pub epoch: u64,
    /// Its number within the epoch.
    pub sequence: u64,
    /// When it was captured, by the operator's clock.
    pub captured_remote: MonoTime,
    /// The same by this process's clock.
    pub captured: MonoTime,
    /// When it was sent, by this process's clock.
    pub sent: MonoTime,
    /// When it arrived.
    pub received: MonoTime,
}

impl PoseSample {
    /// A pose that is captured, sent and received at one moment: for virtual time.
    #[must_use]
    pub fn instant(at: MonoTime, sequence: u64, pose: MasterPose, clutch: Clutch) -> Self {
        let intent = Intent { clutch, ..Intent::default() };
        Self { pose, intent, epoch: 1, sequence, captured_remote: at, captured: at, sent: at, received: at }
    }

    fn heard(&self) -> Heard {
        Heard {
            epoch: self.epoch,
            sequence: self.sequence,
            captured: self.captured_remote,
            received: self.received,
            clutch: self.intent.clutch,
        }
    }
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
    /// The newest pose admitted so far.
    pub sample: Option<PoseSample>,
    /// When the hand was in the pose that the hand follows now, own clock.
    pub played: Option<MonoTime>,
    /// Delay of the playout behind the capture; zero: the newest pose is played.
    pub playout: Duration,
    /// What the mapping made of the pose played.
    pub mapping: Option<MappingOutput>,
    /// Times the hand had to hold so far.
    pub holds: u64,
    /// The stop latch that the tick saw.
    pub latch: Latch,
}

/// The control loop's state; [`Controller::tick`] is its body.
#[derive(Clone, Debug)]
pub struct Controller {
    params: ControlParams,
    retargeter: Retargeter,
    guard: TipGuard,
    motion: MotionGuard,
    conditioner: Option<Conditioner>,
    machine: Machine,
    playout: Playout,
    fault: Fault,
    sample: Option<PoseSample>,
    played: Option<Played>,
    mapping: Option<MappingOutput>,
    // Its posture with the fingertips apart, and the gains of the hand's fingers.
    target: JointVector,
    gains: [f64; MAX_FINGERS],
    // The last valid state of the hand.
    state: JointState,
    tick: u64,
    now: MonoTime,
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
            machine: Machine::new(MachineParams {
                hold_after: params.hold_after,
                relax_after: (params.relax != Relax::Hold).then_some(params.relax_after),
                engage_ramp: Duration::from_secs_f64(params.engage_ramp.max(0.0)),
            }),
            playout: Playout::new(params.playout),
            fault: Fault::None,
            sample: None,
            played: None,
            mapping: None,
            target: state.q,
            gains: [0.0; MAX_FINGERS],
            state,
            tick: 0,
            now: MonoTime(0),
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
        self.machine.mode()
    }

    /// Stops the hand for good: from now on commands are zero torque.
    pub fn fail(&mut self, fault: Fault) {
        self.machine.fail(self.now);
        if self.fault == Fault::None {
            self.fault = fault;
        }
    }

    /// Takes a pose that passed the lease, to be used from the next tick on. One that is not newer is left out.
    pub fn admit(&mut self, sample: &PoseSample) {
        match &self.sample {
            Some(last) if last.epoch == sample.epoch && last.sequence >= sample.sequence => return,
            Some(last) if last.epoch == sample.epoch => {}
            _ => self.playout.reset(),
        }
        self.playout.push(sample.captured, sample.received, &sample.pose);
        self.sample = Some(*sample);
    }

    /// One tick: from the poses admitted, the stop latch and the hand's state to the command.
    ///
    /// What the mode becomes, and when, is the table of [`teleop_common::authority`]; in a mode that does not follow, the hand brakes within its limits and holds its
    /// posture, and when it follows again it starts from there, slowly at first.
    pub fn tick(&mut self, now: MonoTime, latch: Latch, state: &JointState) -> TickRecord {
        self.tick += 1;
        self.now = now;
        let joints = self.hand().joints.len();
        let valid = |values: &JointVector| values.len() == joints && values.is_finite();
        if valid(&state.q) && valid(&state.dq) && valid(&state.tau) {
            self.state = *state;
        } else {
            // What is no number must reach neither the hand nor the network.
            self.fail(Fault::StateInvalid);
        }
        let state = self.state;
        let command = if self.mode() == Mode::Faulted { None } else { self.command(now, latch, &state) };
        let command = command.unwrap_or_else(|| {
            self.fail(Fault::CommandNotFinite);
            JointCommand::limp(&state)
        });
        TickRecord {
            tick: self.tick,
            now,
            mode: self.mode(),
            fault: self.fault,
            state,
            command,
            sample: self.sample,
            played: self.played.map(|played| played.captured),
            playout: self.playout.delay(),
            mapping: self.mapping,
            holds: self.machine.holds(),
            latch,
        }
    }

    /// The next command, or `None` if it would not be finite.
    fn command(&mut self, now: MonoTime, latch: Latch, state: &JointState) -> Option<JointCommand> {
        let params = self.params;
        let mode = self.machine.step(now, self.sample.as_ref().map(PoseSample::heard).as_ref(), latch);
        if self.sample.is_some_and(|sample| now.since(sample.received) <= self.machine.patience()) {
            self.map(now);
        }
        let (retargeter, lasted) = (&self.retargeter, self.machine.lasted(now).as_secs_f64());
        let hand = retargeter.hand();
        let conditioner = self
            .conditioner
            .get_or_insert_with(|| Conditioner::new(hand, &state.q, 1.0 / params.rate, params.smoothing));
        let (mut torque, mut limp) = (1.0, false);
        // A pose is followed contacts first.
        let follow = |conditioner: &mut Conditioner, speed: f64| {
            conditioner.follow(&self.target, speed, |q, velocity, range| {
                closing::close(hand, &self.gains, q, &self.target, velocity, range);
                self.motion.guard(hand, q, &movable(&self.gains), velocity, range, 1.0 / params.rate);
            });
        };
        match mode {
            // The limit widens tenfold over the ramp, then only the joints' own limits count. A ramp of no length (0 / 0)
            // is over when it begins.
            Mode::Engaging => {
                let widened = params.engage_speed * (1.0 + 9.0 * (lasted / params.engage_ramp).min(1.0));
                follow(conditioner, widened);
            }
            Mode::Engaged => follow(conditioner, f64::INFINITY),
            Mode::Relaxed if params.relax == Relax::Open => {
                conditioner.follow(&hand.home(), params.engage_speed, |q, velocity, range| {
                    self.motion.guard(hand, q, &[true; MAX_FINGERS], velocity, range, 1.0 / params.rate);
                });
            }
            _ => {
                conditioner.hold();
                torque = if mode == Mode::Relaxed && params.relax == Relax::Yield { YIELD } else { 1.0 };
                limp = mode == Mode::Relaxed && params.relax == Relax::Off
                    || mode == Mode::Stopped && params.stop == StopAction::Off && conditioner.at_rest();
            }
        }
        if limp {
            // It may be moved by hand now, and whatever follows starts from where it is.
            *conditioner = Conditioner::new(hand, &state.q, 1.0 / params.rate, params.smoothing);
            return Some(JointCommand::limp(state));
        }
        let command = servo(hand, state, conditioner.position(), conditioner.velocity(), torque);
        (command.q.is_finite() && command.dq.is_finite() && command.tau.is_finite()).then_some(command)
    }

    /// Maps the pose that is due, if it is another than the last one mapped.
    fn map(&mut self, now: MonoTime) {
        let Some(played) = self.playout.play(now) else { return };
        if self.played == Some(played) {
            return;
        }
        let mapping = self.retargeter.map(&played.pose);
        self.gains = [0.0; MAX_FINGERS];
        self.gains.iter_mut().zip(mapping.fingers()).for_each(|(own, signals)| *own = signals.k);
        self.target = self.guard.apart(self.retargeter.hand(), &mapping.q, &movable(&self.gains));
        self.mapping = Some(mapping);
        self.played = Some(played);
    }
}

/// Who gives way: a finger that only copies the human's shape keeps it, the others go round it.
fn movable(gains: &[f64; MAX_FINGERS]) -> [bool; MAX_FINGERS] {
    gains.map(|gain| gain > 0.0)
}

/// Torques of the position controller (PD with velocity feed-forward), limited to a `share` of each joint's limit.
fn servo(hand: &HandModel, state: &JointState, q: &JointVector, dq: &JointVector, share: f64) -> JointCommand {
    let mut tau = JointVector::zeros(q.len());
    for (slot, joint) in hand.joints.iter().enumerate() {
        let torque = joint.kp * (q[slot] - state.q[slot]) + joint.kd * (dq[slot] - state.dq[slot]);
        tau[slot] = torque.clamp(-share * joint.torque, share * joint.torque);
    }
    JointCommand { q: *q, dq: *dq, tau }
}
