use std::time::Duration;

use teleop_common::time::MonoTime;
use teleop_common::wire::Rejection;

/// What the gate asks of a pose.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GateParams {
    /// Oldest pose obeyed, from its capture.
    pub max_age: Duration,
    /// An operator that was silent this long has lost its hold on the robot.
    pub release_after: Duration,
}

/// Decides whose poses reach the control loop, and which of them.
///
/// One operator (one epoch: one run of one process) drives at a time; it is the first that comes, until it has been
/// silent for [`GateParams::release_after`]. Within an epoch poses only go forwards. A pose is judged by its age since
/// capture, because every transport may deliver a backlog of old poses after a stall.
#[derive(Clone, Debug)]
pub struct Gate {
    params: GateParams,
    // Epoch, sequence and time of the last pose let through.
    last: Option<(u64, u64, MonoTime)>,
}

impl Gate {
    /// A gate that no operator has passed yet.
    #[must_use]
    pub fn new(params: GateParams) -> Self {
        Self { params, last: None }
    }

    /// Whether the operator `epoch` drives the robot or may begin to.
    #[must_use]
    pub fn is_open_to(&self, now: MonoTime, epoch: u64) -> bool {
        self.last.is_none_or(|(holder, _, at)| holder == epoch || now.since(at) > self.params.release_after)
    }

    /// Judges a pose at `now`; `age` (s) since its capture with its `uncertainty` (s), `None` if the clocks are unknown.
    ///
    /// # Errors
    /// Why the pose must not be obeyed.
    pub fn admit(
        &mut self,
        now: MonoTime,
        epoch: u64,
        sequence: u64,
        age: Option<(f64, f64)>,
    ) -> Result<(), Rejection> {
        if !self.is_open_to(now, epoch) {
            return Err(Rejection::Operator);
        }
        if self.last.is_some_and(|(holder, newest, _)| holder == epoch && sequence <= newest) {
            return Err(Rejection::Sequence);
        }
        let (age, uncertainty) = age.ok_or(Rejection::Clock)?;
        // Written so that an age that is no number does not pass.
        let young = age <= self.params.max_age.as_secs_f64();
        if !young {
            return Err(Rejection::Stale);
        }
        // Captured in the future, beyond what the uncertainty of the clocks explains.
        if age < -(uncertainty + 0.005) {
            return Err(Rejection::Other);
        }
        self.last = Some((epoch, sequence, now));
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: u64 = 1_000_000;

    fn gate() -> Gate {
        Gate::new(GateParams { max_age: Duration::from_millis(250), release_after: Duration::from_millis(200) })
    }

    fn fresh() -> Option<(f64, f64)> {
        Some((0.02, 0.001))
    }

    #[test]
    fn the_first_operator_keeps_the_robot_until_it_falls_silent() {
        let mut gate = gate();
        assert_eq!(gate.admit(MonoTime(0), 1, 1, fresh()), Ok(()));
        assert_eq!(gate.admit(MonoTime(MS), 2, 1, fresh()), Err(Rejection::Operator));
        assert_eq!(gate.admit(MonoTime(2 * MS), 1, 2, fresh()), Ok(()));
        assert_eq!(gate.admit(MonoTime(202 * MS), 2, 2, fresh()), Err(Rejection::Operator));
        assert_eq!(gate.admit(MonoTime(203 * MS), 2, 3, fresh()), Ok(()));
        assert_eq!(gate.admit(MonoTime(204 * MS), 1, 3, fresh()), Err(Rejection::Operator));
    }

    #[test]
    fn a_pose_that_is_refused_keeps_nobody_out_and_nothing_alive() {
        let mut gate = gate();
        assert_eq!(gate.admit(MonoTime(0), 7, 9, None), Err(Rejection::Clock));
        assert_eq!(gate.admit(MonoTime(1), 1, 1, fresh()), Ok(()));
        // Stale poses of the holder do not prolong its hold.
        assert_eq!(gate.admit(MonoTime(150 * MS), 1, 2, Some((0.4, 0.001))), Err(Rejection::Stale));
        assert_eq!(gate.admit(MonoTime(202 * MS), 2, 1, fresh()), Ok(()));
    }

    #[test]
    fn only_newer_poses_of_a_plausible_age_pass() {
        let mut gate = gate();
        assert_eq!(gate.admit(MonoTime(0), 1, 5, fresh()), Ok(()));
        assert_eq!(gate.admit(MonoTime(0), 1, 5, fresh()), Err(Rejection::Sequence));
        assert_eq!(gate.admit(MonoTime(0), 1, 4, fresh()), Err(Rejection::Sequence));
        assert_eq!(gate.admit(MonoTime(0), 1, 6, Some((0.26, 0.1))), Err(Rejection::Stale));
        assert_eq!(gate.admit(MonoTime(0), 1, 6, Some((f64::NAN, 0.0))), Err(Rejection::Stale));
        assert_eq!(gate.admit(MonoTime(0), 1, 6, Some((-0.02, 0.001))), Err(Rejection::Other));
        assert_eq!(gate.admit(MonoTime(0), 1, 6, Some((-0.02, 0.02))), Ok(()));
    }
}
