//! What the control loop makes of a motion: the live robot in virtual time, with a hand that does what it is told.

use teleop_common::authority::{Clutch, Latch};
use teleop_common::hand::{HandModel, JointVector};
use teleop_common::mapping::{MappingParams, ParamError};
use teleop_common::master::Gesture;
use teleop_common::paper::motion::pose;
use teleop_common::time::MonoTime;

use crate::control::{ControlParams, Controller, PoseSample};
use crate::driver::JointState;

/// The hand is engaged with the open posture this long before the motion starts, s.
const LEAD: f64 = 3.0;
/// How long the hand is watched after the motion, s: it comes to rest.
const TRAIL: f64 = 0.5;

/// Commands every 1/`rate` s while a gesture's poses arrive as often: from the gesture's start to [`TRAIL`] after it.
///
/// Between the loop's ticks the command is taken as moving with constant velocity, which is what it means.
pub(super) fn commands(
    hand: &HandModel,
    mapping: &MappingParams,
    control: ControlParams,
    gesture: Gesture,
    rate: f64,
) -> Result<Vec<JointVector>, ParamError> {
    let mut controller = Controller::new(hand.clone(), mapping.clone(), control)?;
    let still = JointVector::zeros(hand.joints.len());
    let mut state = JointState { q: hand.home(), dq: still, tau: still };
    let (period, end) = (1.0 / control.rate, LEAD + gesture.duration() + TRAIL);
    let mut samples = Vec::new();
    let (mut tick, mut due) = (0_u32, 0_u32);
    let mut clutch = Clutch::default();
    loop {
        let now = f64::from(tick) * period;
        if now > end + period {
            return Ok(samples);
        }
        // The newest pose of a source that sends at the rate of the samples.
        let sequence = (now * rate + 1e-9).floor();
        let sent = sequence / rate;
        clutch = clutch.eager(controller.mode());
        let pose = pose(gesture, (sent - LEAD).clamp(0.0, gesture.duration()));
        controller.admit(&PoseSample::instant(MonoTime((sent * 1e9) as u64), sequence as u64, pose, clutch));
        let before = state.q;
        let record = controller.tick(MonoTime((now * 1e9) as u64), Latch::default(), &state);
        (state.q, state.dq) = (record.command.q, record.command.dq);
        tick += 1;
        // The command of a tick is where the hand is at the next one.
        loop {
            let wanted = LEAD + f64::from(due) / rate;
            if wanted > now + period || wanted > end + 1e-9 {
                break;
            }
            let share = ((wanted - now) / period).clamp(0.0, 1.0);
            let mut q = before;
            for (q, next) in q.iter_mut().zip(state.q.iter()) {
                *q += (next - *q) * share;
            }
            samples.push(q);
            due += 1;
        }
    }
}
