use std::time::Duration;

use serde::{Deserialize, Serialize};

use crate::time::MonoTime;
use crate::wire::Rejection;

/// When an operator may take the robot away from another.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Takeover {
    /// Never: it has to wait until the other leaves or falls silent.
    #[default]
    Never,
    /// While the hand does not follow the other.
    Idle,
    /// At any time; the hand stops then, and follows the new one when its clutch is closed.
    Always,
}

/// What the lease asks of a message.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LeaseParams {
    /// Oldest pose obeyed, from its capture.
    pub max_age: Duration,
    /// An operator that was silent this long has lost the robot.
    pub release_after: Duration,
    /// Whether another may take it before.
    pub takeover: Takeover,
}

/// What a message says of its sender, and what is known of its age.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Claim {
    /// The process that sent it.
    pub epoch: u64,
    /// Its number within the epoch.
    pub sequence: u64,
    /// Age since its capture and the uncertainty of that, s; `None` if the clocks are unknown.
    pub age: Option<(f64, f64)>,
    /// The sender wants the robot even though another has it.
    pub takeover: bool,
    /// The sender gives the robot back.
    pub leaving: bool,
}

/// Decides whose poses reach the control loop, and which of them.
///
/// One operator (one epoch: one run of one process) has the robot at a time; it is the first that comes, until it
/// leaves, has been silent for [`LeaseParams::release_after`], or another takes over as far as
/// [`LeaseParams::takeover`] permits. Within an epoch poses only go forwards. A pose is judged by its age since
/// capture, because every transport may deliver a backlog of old poses after a stall; one whose age is unknown, or
/// uncertain by more than the limit itself, is not obeyed. So even where one way takes all of the round trip no pose is
/// twice as old as the limit. Only messages that are obeyed prolong the lease.
#[derive(Clone, Debug)]
pub struct Lease {
    params: LeaseParams,
    // Epoch, sequence and time of the last pose let through.
    last: Option<(u64, u64, MonoTime)>,
    // The newest pose of the operator that left: what of its messages is still under way must not bring it back.
    left: Option<(u64, u64)>,
}

impl Lease {
    /// Nobody has the robot.
    #[must_use]
    pub fn new(params: LeaseParams) -> Self {
        Self { params, last: None, left: None }
    }

    /// Who has the robot.
    #[must_use]
    pub fn holder(&self, now: MonoTime) -> Option<u64> {
        self.last.filter(|(_, _, at)| now.since(*at) <= self.params.release_after).map(|(epoch, _, _)| epoch)
    }

    /// Whether the operator `epoch` has the robot or may have it without taking over.
    #[must_use]
    pub fn is_open_to(&self, now: MonoTime, epoch: u64) -> bool {
        self.holder(now).is_none_or(|holder| holder == epoch)
    }

    /// Judges a pose at `now`; `follows`: the hand follows the holder at this time.
    ///
    /// # Errors
    /// Why the pose must not be obeyed.
    pub fn admit(&mut self, now: MonoTime, claim: &Claim, follows: bool) -> Result<(), Rejection> {
        let taken = !self.is_open_to(now, claim.epoch);
        if taken {
            let permitted = match self.params.takeover {
                Takeover::Never => false,
                Takeover::Idle => !follows,
                Takeover::Always => true,
            };
            if !claim.takeover {
                return Err(Rejection::Operator);
            }
            if !permitted {
                return Err(Rejection::Takeover);
            }
        }
        let newest = |known: Option<(u64, u64)>| known.filter(|(epoch, _)| *epoch == claim.epoch).map(|(_, seq)| seq);
        let seen = newest(self.last.map(|(epoch, seq, _)| (epoch, seq))).max(newest(self.left));
        if seen.is_some_and(|seen| claim.sequence <= seen) {
            return Err(Rejection::Sequence);
        }
        let (age, uncertainty) = claim.age.ok_or(Rejection::Clock)?;
        // Written so that an age that is no number does not pass.
        let young = age <= self.params.max_age.as_secs_f64();
        if !young {
            return Err(Rejection::Stale);
        }
        // On a stream that is held up round trips may take seconds, and only one of the ways.
        let known = uncertainty <= self.params.max_age.as_secs_f64();
        if !known {
            return Err(Rejection::Clock);
        }
        // Captured in the future, beyond what the uncertainty of the clocks explains.
        if age < -(uncertainty + 0.005) {
            return Err(Rejection::Other);
        }
        if claim.leaving {
            self.left = Some((claim.epoch, claim.sequence));
            self.last = None;
        } else {
            self.last = Some((claim.epoch, claim.sequence, now));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: u64 = 1_000_000;

    fn lease(takeover: Takeover) -> Lease {
        Lease::new(LeaseParams {
            max_age: Duration::from_millis(250),
            release_after: Duration::from_millis(2000),
            takeover,
        })
    }

    fn claim(epoch: u64, sequence: u64) -> Claim {
        Claim { epoch, sequence, age: Some((0.02, 0.001)), takeover: false, leaving: false }
    }

    #[test]
    fn the_first_operator_keeps_the_robot_until_it_falls_silent() {
        let mut lease = lease(Takeover::Always);
        assert_eq!(lease.admit(MonoTime(0), &claim(1, 1), false), Ok(()));
        assert_eq!(lease.admit(MonoTime(MS), &claim(2, 1), false), Err(Rejection::Operator));
        assert_eq!(lease.admit(MonoTime(2 * MS), &claim(1, 2), false), Ok(()));
        assert_eq!(lease.admit(MonoTime(2002 * MS), &claim(2, 2), false), Err(Rejection::Operator));
        assert_eq!(lease.admit(MonoTime(2003 * MS), &claim(2, 3), false), Ok(()));
        assert_eq!(lease.holder(MonoTime(2003 * MS)), Some(2));
        assert_eq!(lease.admit(MonoTime(2004 * MS), &claim(1, 3), false), Err(Rejection::Operator));
    }

    #[test]
    fn an_operator_that_leaves_makes_room_at_once_and_for_good() {
        let mut lease = lease(Takeover::Never);
        assert_eq!(lease.admit(MonoTime(0), &claim(1, 1), false), Ok(()));
        assert_eq!(lease.admit(MonoTime(MS), &Claim { leaving: true, ..claim(1, 5) }, false), Ok(()));
        assert_eq!(lease.holder(MonoTime(MS)), None);
        assert_eq!(lease.admit(MonoTime(2 * MS), &claim(1, 4), false), Err(Rejection::Sequence), "was under way");
        assert_eq!(lease.admit(MonoTime(2 * MS), &claim(2, 1), false), Ok(()));
    }

    #[test]
    fn a_takeover_is_asked_for_and_permitted() {
        let wants = |epoch| Claim { takeover: true, ..claim(epoch, 1) };
        for (permitted, follows, result) in [
            (Takeover::Never, false, Err(Rejection::Takeover)),
            (Takeover::Idle, true, Err(Rejection::Takeover)),
            (Takeover::Idle, false, Ok(())),
            (Takeover::Always, true, Ok(())),
        ] {
            let mut lease = lease(permitted);
            assert_eq!(lease.admit(MonoTime(0), &claim(1, 1), follows), Ok(()));
            assert_eq!(lease.admit(MonoTime(MS), &claim(2, 1), follows), Err(Rejection::Operator));
            assert_eq!(lease.admit(MonoTime(2 * MS), &wants(2), follows), result, "{permitted:?}");
            let other = if result.is_ok() { Err(Rejection::Operator) } else { Ok(()) };
            assert_eq!(lease.admit(MonoTime(3 * MS), &claim(1, 2), follows), other);
        }
        // Nothing stale takes the robot away.
        let mut lease = lease(Takeover::Always);
        assert_eq!(lease.admit(MonoTime(0), &claim(1, 1), true), Ok(()));
        let stale = Claim { age: Some((3.0, 0.001)), ..wants(2) };
        assert_eq!(lease.admit(MonoTime(MS), &stale, true), Err(Rejection::Stale));
        assert_eq!(lease.holder(MonoTime(MS)), Some(1));
    }

    #[test]
    fn a_pose_that_is_refused_keeps_nobody_out_and_nothing_alive() {
        let mut lease = lease(Takeover::Never);
        assert_eq!(lease.admit(MonoTime(0), &Claim { age: None, ..claim(7, 9) }, false), Err(Rejection::Clock));
        assert_eq!(lease.admit(MonoTime(1), &claim(1, 1), false), Ok(()));
        // Stale poses of the holder do not prolong its hold.
        let stale = Claim { age: Some((0.4, 0.001)), ..claim(1, 2) };
        assert_eq!(lease.admit(MonoTime(1500 * MS), &stale, false), Err(Rejection::Stale));
        assert_eq!(lease.admit(MonoTime(2002 * MS), &claim(2, 1), false), Ok(()));
    }

    #[test]
    fn only_newer_poses_of_a_plausible_age_pass() {
        let mut lease = lease(Takeover::Never);
        let mut admit =
            |sequence, age| lease.admit(MonoTime(0), &Claim { age: Some(age), ..claim(1, sequence) }, false);
        assert_eq!(admit(5, (0.02, 0.001)), Ok(()));
        assert_eq!(admit(5, (0.02, 0.001)), Err(Rejection::Sequence));
        assert_eq!(admit(4, (0.02, 0.001)), Err(Rejection::Sequence));
        assert_eq!(admit(6, (0.26, 0.1)), Err(Rejection::Stale));
        assert_eq!(admit(6, (f64::NAN, 0.0)), Err(Rejection::Stale));
        assert_eq!(admit(6, (-0.02, 0.001)), Err(Rejection::Other));
        assert_eq!(admit(6, (-0.02, 0.02)), Ok(()));
        // Round trips of 9 s: it may be seconds old as well.
        assert_eq!(admit(7, (0.1, 4.5)), Err(Rejection::Clock));
        assert_eq!(admit(7, (0.1, f64::NAN)), Err(Rejection::Clock));
        assert_eq!(admit(7, (0.2, 0.25)), Ok(()));
    }
}
