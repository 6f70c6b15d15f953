//! When a session with a robot that is not heard is opened anew, and how.

use std::time::Duration;

use teleop_common::net::RETRY;
use teleop_common::time::MonoTime;

/// How long the robot's joint states, a hundred a second, may be missing before the session is opened anew: almost the
/// lease, because an outage that zenoh outlives costs nothing, and a new session costs a handshake.
const DEAF: Duration = Duration::from_millis(900);
/// How long what comes less often may be missing before it is subscribed to anew; longer from time to time. Never by chance
/// alone: where much gets lost, a new subscription may get lost as well, and with it what was heard before.
const PARTLY_DEAF: Duration = Duration::from_secs(3);
/// Bounds of the timeout of a handshake; the first is the shortest.
pub(super) const SHORTEST: Duration = Duration::from_millis(300);
const LONGEST: Duration = Duration::from_secs(4);
/// Round trips that a handshake may take, with those of QUIC and some jitter.
const ROUND_TRIPS: u32 = 6;
/// How many handshakes in vain, or subscriptions in vain, a session is given.
const TRIES: u32 = 3;
/// After so many sessions in vain the robot may have moved behind another link.
const MOVED: u32 = 20;
/// What is to be done about a robot that is not heard.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Step {
    Wait,
    /// Subscribe anew, on the same session.
    Subscribe,
    /// Open the session anew, with this timeout of a handshake.
    Open(Duration),
}

/// What is known of the robot.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Signs {
    /// The session has a link.
    pub(super) linked: bool,
    /// When its joint states came last.
    pub(super) heard: Option<MonoTime>,
    /// When all that it publishes did.
    pub(super) whole: Option<MonoTime>,
    /// The round trip.
    pub(super) round_trip: Option<Duration>,
}

/// When the session is to be opened anew, and with which timeout.
#[derive(Clone, Debug)]
pub(super) struct Redial {
    opened: MonoTime,
    /// When there was last reason for patience: a link came up, or a subscription was made.
    tried: MonoTime,
    linked: bool,
    subscriptions: u32,
    /// Of a handshake: short finds a link that is back sooner, long gets through where round trips are long.
    timeout: Duration,
    /// The one that suits a robot that was heard.
    proven: Option<Duration>,
    failures: u32,
}

impl Redial {
    pub(super) const fn new(now: MonoTime, timeout: Duration) -> Self {
        Self { opened: now, tried: now, linked: false, subscriptions: 0, timeout, proven: None, failures: 0 }
    }

    /// What to do at `now`; to be asked some times a second.
    pub(super) fn step(&mut self, now: MonoTime, signs: &Signs) -> Step {
        if let Some(heard) = signs.heard.filter(|heard| *heard >= self.opened) {
            let suits = |round_trip: Duration| (round_trip * ROUND_TRIPS).clamp(SHORTEST, LONGEST);
            self.proven = Some(signs.round_trip.map_or(self.timeout, suits));
            self.failures = 0;
            if now.since(heard) > DEAF {
                return self.open(now);
            }
            let whole = signs.whole.map_or(self.tried, |whole| whole.max(self.tried));
            let patience = PARTLY_DEAF * (1 + self.subscriptions).min(10);
            return if now.since(whole) > patience { self.subscribe(now) } else { Step::Wait };
        }
        if signs.linked != self.linked {
            self.linked = signs.linked;
            self.tried = now;
        }
        let patience = if self.linked { self.timeout } else { (self.timeout + RETRY) * TRIES };
        if now.since(self.tried) <= patience {
            Step::Wait
        } else if self.linked && self.subscriptions < TRIES {
            self.subscribe(now)
        } else {
            self.failures += 1;
            self.open(now)
        }
    }

    fn subscribe(&mut self, now: MonoTime) -> Step {
        self.tried = now;
        self.subscriptions += 1;
        Step::Subscribe
    }

    fn open(&mut self, now: MonoTime) -> Step {
        if self.failures >= MOVED {
            self.proven = None;
        }
        let timeout = match self.proven {
            // Mostly it is just not back yet; every other time twice as long, for a machine that is busy.
            Some(proven) => (proven * (1 + self.failures % 2)).min(LONGEST),
            // On a link that loses much the short one was bad luck, so that it gets its turn again.
            None if self.timeout < LONGEST => (self.timeout * 2).min(LONGEST),
            None => SHORTEST,
        };
        *self = Self { timeout, proven: self.proven, failures: self.failures, ..Self::new(now, timeout) };
        Step::Open(timeout)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const fn ms(ms: u64) -> MonoTime {
        MonoTime(ms * 1_000_000)
    }

    /// All steps but waiting, with their times, ms.
    fn steps(redial: &mut Redial, times: impl Iterator<Item = u64>, signs: impl Fn(u64) -> Signs) -> Vec<(u64, Step)> {
        times.map(|at| (at, redial.step(ms(at), &signs(at)))).filter(|(_, step)| *step != Step::Wait).collect()
    }

    fn timeouts(steps: &[(u64, Step)]) -> Vec<u128> {
        let timeout = |step: &Step| if let Step::Open(timeout) = step { timeout.as_millis() } else { 0 };
        steps.iter().map(|(_, step)| timeout(step)).collect()
    }

    #[test]
    fn where_nobody_answers_all_timeouts_get_their_turn() {
        let mut redial = Redial::new(ms(0), SHORTEST);
        let found = steps(&mut redial, (50..60_000).step_by(50), |_| Signs::default());
        assert_eq!(timeouts(&found)[..6], [600, 1200, 2400, 4000, 300, 600]);
        assert!((1200..=1300).contains(&found[0].0), "{found:?}");
    }

    #[test]
    fn a_robot_that_does_not_know_of_the_subscription_is_told_again() {
        let mut redial = Redial::new(ms(0), SHORTEST);
        let linked = Signs { linked: true, ..Signs::default() };
        let found = steps(&mut redial, (50..2000).step_by(50), |_| linked);
        let opened = [Step::Subscribe, Step::Subscribe, Step::Subscribe, Step::Open(SHORTEST * 2)];
        assert_eq!(found.iter().map(|(_, step)| *step).collect::<Vec<_>>(), opened);
        // Heard, but not all of it.
        let mut redial = Redial::new(ms(0), SHORTEST);
        let found =
            steps(&mut redial, (50..9500).step_by(50), |at| Signs { heard: Some(ms(at)), linked: true, ..linked });
        assert_eq!(timeouts(&found), [0, 0]);
    }

    #[test]
    fn a_robot_that_was_heard_gets_the_timeout_that_suits_it() {
        let mut redial = Redial::new(ms(0), SHORTEST);
        let signs = |at: u64, round_trip: u64| Signs {
            linked: true,
            heard: Some(ms(at)),
            whole: Some(ms(at)),
            round_trip: Some(Duration::from_millis(round_trip)),
        };
        assert_eq!(steps(&mut redial, (50..5000).step_by(50), |at| signs(at, 10)), []);
        // It is cut off: the shortest and twice that, for half a minute.
        let cut = Signs { linked: false, ..signs(4950, 10) };
        let found = steps(&mut redial, (5000..90_000).step_by(50), |_| cut);
        assert!((5850..=5950).contains(&found[0].0), "{found:?}");
        assert_eq!(timeouts(&found)[..4], [300, 600, 300, 600]);
        assert_eq!(timeouts(&found)[19..23], [600, 1200, 2400, 4000]);
        // A satellite.
        let mut redial = Redial::new(ms(0), LONGEST);
        assert_eq!(redial.step(ms(50), &signs(50, 560)), Step::Wait);
        assert_eq!(redial.step(ms(1000), &signs(50, 560)), Step::Open(Duration::from_millis(3360)));
    }
}
