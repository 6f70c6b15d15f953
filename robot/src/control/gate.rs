use std::time::Duration;

use teleop_common::time::MonoTime;

/// What the gate asks of a pose.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GateParams {
    /// Oldest pose obeyed, from its capture.
    pub max_age: Duration,
    /// An operator that was silent this long has lost its hold on the robot.
    pub release_after: Duration,
}

/// Why a pose was not obeyed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum Reject {
    /// It does not decode or its content is out of range.
    Malformed = 0,
    /// Another operator drives the robot.
    OtherOperator = 1,
    /// Not newer than the newest pose obeyed.
    Reordered = 2,
    /// The operator's clock is not known yet.
    ClockUnknown = 3,
    /// Captured too long ago.
    TooOld = 4,
    /// Captured in the future, beyond what the uncertainty of the clocks explains.
    FromTheFuture = 5,
}

impl Reject {
    /// How many reasons there are.
    pub const COUNT: usize = 6;

    /// All reasons, in the order of their numbers.
    pub const ALL: [Self; Self::COUNT] = [
        Self::Malformed,
        Self::OtherOperator,
        Self::Reordered,
        Self::ClockUnknown,
        Self::TooOld,
        Self::FromTheFuture,
    ];

    /// A few words for people.
    #[must_use]
    pub const fn text(self) -> &'static str {
        match self {
            Self::Malformed => "malformed",
            Self::OtherOperator => "other operator",
            Self::Reordered => "reordered",
            Self::ClockUnknown => "clock unknown",
            Self::TooOld => "too old",
            Self::FromTheFuture => "from the future",
        }
    }
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
    ) -> Result<(), Reject> {
        if let Some((holder, newest, at)) = self.last {
            if holder == epoch {
                if sequence <= newest {
                    return Err(Reject::Reordered);
                }
            } else if now.since(at) <= self.params.release_after {
                return Err(Reject::OtherOperator);
            }
        }
        let (age, uncertainty) = age.ok_or(Reject::ClockUnknown)?;
        // Written so that an age that is no number does not pass.
        let young = age <= self.params.max_age.as_secs_f64();
        if !young {
            return Err(Reject::TooOld);
        }
        if age < -(uncertainty + 0.005) {
            return Err(Reject::FromTheFuture);
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
        assert_eq!(gate.admit(MonoTime(MS), 2, 1, fresh()), Err(Reject::OtherOperator));
        assert_eq!(gate.admit(MonoTime(2 * MS), 1, 2, fresh()), Ok(()));
        assert_eq!(gate.admit(MonoTime(202 * MS), 2, 2, fresh()), Err(Reject::OtherOperator));
        assert_eq!(gate.admit(MonoTime(203 * MS), 2, 3, fresh()), Ok(()));
        assert_eq!(gate.admit(MonoTime(204 * MS), 1, 3, fresh()), Err(Reject::OtherOperator));
    }

    #[test]
    fn a_pose_that_is_refused_keeps_nobody_out_and_nothing_alive() {
        let mut gate = gate();
        assert_eq!(gate.admit(MonoTime(0), 7, 9, None), Err(Reject::ClockUnknown));
        assert_eq!(gate.admit(MonoTime(1), 1, 1, fresh()), Ok(()));
        // Stale poses of the holder do not prolong its hold.
        assert_eq!(gate.admit(MonoTime(150 * MS), 1, 2, Some((0.4, 0.001))), Err(Reject::TooOld));
        assert_eq!(gate.admit(MonoTime(202 * MS), 2, 1, fresh()), Ok(()));
    }

    #[test]
    fn only_newer_poses_of_a_plausible_age_pass() {
        let mut gate = gate();
        assert_eq!(gate.admit(MonoTime(0), 1, 5, fresh()), Ok(()));
        assert_eq!(gate.admit(MonoTime(0), 1, 5, fresh()), Err(Reject::Reordered));
        assert_eq!(gate.admit(MonoTime(0), 1, 4, fresh()), Err(Reject::Reordered));
        assert_eq!(gate.admit(MonoTime(0), 1, 6, Some((0.26, 0.1))), Err(Reject::TooOld));
        assert_eq!(gate.admit(MonoTime(0), 1, 6, Some((f64::NAN, 0.0))), Err(Reject::TooOld));
        assert_eq!(gate.admit(MonoTime(0), 1, 6, Some((-0.02, 0.001))), Err(Reject::FromTheFuture));
        assert_eq!(gate.admit(MonoTime(0), 1, 6, Some((-0.02, 0.02))), Ok(()));
    }
}
