//! The operator's connection to its robot: what is published to it and heard from it, over a session that is opened anew
//! when the robot falls silent.
//!
//! zenoh reconnects by itself, but not always for the better: on a link that does not resend (plain UDP) the messages that
//! declare who publishes and subscribes what may be lost, and then the session stays up and deaf; and after an outage it
//! may take ten seconds over UDP. So what the robot may have missed is subscribed to again, and a session that was cut
//! off is replaced: a new one begins from nothing, with handshakes as short as the robot's round trip allows.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::Duration;

use teleop_common::key::Keys;
use teleop_common::net::clock::now;
use teleop_common::net::{LiveToken, NetError, Publisher, RETRY, Session, SessionConfig, Stream, Subscriber};
use teleop_common::time::MonoTime;
use teleop_common::wire::{ControlMessage, PoseMessage};

use crate::feedback::Feedback;

/// How long the robot's joint states, a hundred a second, may be missing before the session is opened anew: almost the
/// lease, because an outage that zenoh outlives costs nothing, and a new session costs a handshake.
const DEAF: Duration = Duration::from_millis(900);
/// How long what comes less often may be missing before it is subscribed to anew; longer from time to time. Never by chance
/// alone: where much gets lost, a new subscription may get lost as well, and with it what was heard before.
const PARTLY_DEAF: Duration = Duration::from_secs(3);
/// Bounds of the timeout of a handshake; the first is the shortest.
const SHORTEST: Duration = Duration::from_millis(300);
const LONGEST: Duration = Duration::from_secs(4);
/// Round trips that a handshake may take, with those of QUIC and some jitter.
const ROUND_TRIPS: u32 = 6;
/// How many handshakes in vain, or subscriptions in vain, a session is given.
const TRIES: u32 = 3;
/// After so many sessions in vain the robot may have moved behind another link.
const MOVED: u32 = 20;
/// How often it is looked.
const LOOK: Duration = Duration::from_millis(50);

/// What is declared on one session. Dropping it closes the session.
struct Connected {
    session: Session,
    poses: Publisher,
    control: Publisher,
    _token: Option<LiveToken>,
    subscribers: Option<[Subscriber; 3]>,
}

impl Connected {
    fn open(config: &SessionConfig, keys: &Keys, own: Option<u64>, feedback: &Arc<Feedback>) -> Result<Self, NetError> {
        let session = Session::open(config)?;
        Ok(Self {
            poses: session.publisher(&keys.pose(), Stream::Command)?,
            control: session.publisher(&keys.control(), Stream::Slow)?,
            _token: own.map(|epoch| session.live_token(&keys.live_operator(epoch))).transpose()?,
            subscribers: Some(hear(&session, keys, feedback)?),
            session,
        })
    }

    /// Subscribes anew: the robot may have missed it.
    fn hear_again(&mut self, keys: &Keys, feedback: &Arc<Feedback>) -> Result<(), NetError> {
        // The old ones go first, so that the robot is told of new ones.
        drop(self.subscribers.take());
        self.subscribers = Some(hear(&self.session, keys, feedback)?);
        Ok(())
    }
}

/// Lets `feedback` hear the robot whose keys these are.
pub(crate) fn hear(session: &Session, keys: &Keys, feedback: &Arc<Feedback>) -> Result<[Subscriber; 3], NetError> {
    let [joints, mapping, health] = std::array::from_fn(|_| Arc::clone(feedback));
    Ok([
        session.subscribe(&keys.joints(), move |arrival| joints.on_joints(arrival))?,
        session.subscribe(&keys.mapping(), move |arrival| mapping.on_mapping(arrival))?,
        session.subscribe(&keys.health(), move |arrival| health.on_health(arrival))?,
    ])
}

/// The connection. Clones share it; the one that [`RobotLink::open`] returned ends it when dropped.
pub struct RobotLink {
    shared: Arc<Shared>,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

struct Shared {
    config: SessionConfig,
    keys: Keys,
    own: Option<u64>,
    feedback: Arc<Feedback>,
    connected: Mutex<Option<Connected>>,
    opened: AtomicU64,
}

/// What is to be done about a robot that is not heard.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Step {
    Wait,
    /// Subscribe anew, on the same session.
    Subscribe,
    /// Open the session anew, with this timeout of a handshake.
    Open(Duration),
}

/// What is known of the robot.
#[derive(Clone, Copy, Debug, Default)]
struct Signs {
    /// The session has a link.
    linked: bool,
    /// When its joint states came last.
    heard: Option<MonoTime>,
    /// When all that it publishes did.
    whole: Option<MonoTime>,
    /// The round trip.
    round_trip: Option<Duration>,
}

/// When the session is to be opened anew, and with which timeout. No clock, no thread.
#[derive(Clone, Debug)]
struct Redial {
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
    const fn new(now: MonoTime, timeout: Duration) -> Self {
        Self { opened: now, tried: now, linked: false, subscriptions: 0, timeout, proven: None, failures: 0 }
    }

    fn step(&mut self, now: MonoTime, signs: &Signs) -> Step {
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

impl Shared {
    fn lock(&self) -> MutexGuard<'_, Option<Connected>> {
        self.connected.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn signs(&self) -> Signs {
        let session = self.lock().as_ref().map(|connected| connected.session.clone());
        let (heard, whole) = self.feedback.last_heard();
        let trips = self.feedback.round_trips();
        Signs {
            linked: session.is_some_and(|session| session.peers() > 0),
            heard,
            whole,
            round_trip: (trips.count() > 0).then(|| trips.p50()),
        }
    }

    fn take(&self, step: Step) {
        match step {
            Step::Wait => {}
            Step::Open(timeout) => self.reopen(timeout),
            Step::Subscribe => {
                // Not under the lock, where the next pose would wait for it.
                let Some(mut connected) = self.lock().take() else { return };
                if let Err(error) = connected.hear_again(&self.keys, &self.feedback) {
                    tracing::warn!("cannot subscribe anew: {error}");
                }
                *self.lock() = Some(connected);
            }
        }
    }

    /// A session in place of the one that is.
    fn reopen(&self, open_timeout: Duration) {
        // The old one first: two sessions at once would be two operators.
        let old = self.lock().take();
        close(old);
        let config = SessionConfig { open_timeout, ..self.config.clone() };
        match Connected::open(&config, &self.keys, self.own, &self.feedback) {
            Ok(new) => {
                self.opened.fetch_add(1, Ordering::Relaxed);
                *self.lock() = Some(new);
            }
            Err(error) => tracing::warn!("cannot open the session anew: {error}"),
        }
    }
}

/// Closes a session in a thread of its own: one whose link is dead may take seconds for it.
fn close(connected: Option<Connected>) {
    let Some(connected) = connected else { return };
    let body = move || {
        let session = connected.session.clone();
        drop(connected);
        session.close().ok();
    };
    if std::thread::Builder::new().name("closing".to_owned()).spawn(body).is_err() {
        tracing::warn!("cannot start a thread");
    }
}

/// What other threads send through.
#[derive(Clone)]
pub struct RobotSender(Arc<Shared>);

impl RobotSender {
    /// Sends a pose. While there is no session nothing is sent, and that is no error: the next pose replaces it.
    ///
    /// # Errors
    /// [`NetError::Message`] if a peer would reject it, or the session is closed.
    pub fn pose(&self, message: &PoseMessage) -> Result<(), NetError> {
        self.0.lock().as_ref().map_or(Ok(()), |connected| connected.poses.send(message))
    }

    /// Sends a request.
    ///
    /// # Errors
    /// As for a pose.
    pub fn control(&self, message: &ControlMessage) -> Result<(), NetError> {
        self.0.lock().as_ref().map_or(Ok(()), |connected| connected.control.send(message))
    }
}

impl RobotLink {
    /// Connects to the robot whose keys these are; `feedback` hears it. `own` is the epoch of a process that drives, and
    /// shows to others that it is alive.
    ///
    /// # Errors
    /// The session cannot be opened: a bad endpoint, certificate or setting. That nobody is there is no error.
    pub fn open(
        config: SessionConfig,
        keys: &Keys,
        own: Option<u64>,
        feedback: &Arc<Feedback>,
    ) -> Result<Self, NetError> {
        let config = SessionConfig { open_timeout: SHORTEST, ..config };
        let first = Connected::open(&config, keys, own, feedback)?;
        let shared = Arc::new(Shared {
            config,
            keys: keys.clone(),
            own,
            feedback: Arc::clone(feedback),
            connected: Mutex::new(Some(first)),
            opened: AtomicU64::new(1),
        });
        let stop = Arc::new(AtomicBool::new(false));
        let (own, stopped) = (Arc::clone(&shared), Arc::clone(&stop));
        let watch = move || {
            let mut redial = Redial::new(now(), SHORTEST);
            while !stopped.load(Ordering::Acquire) {
                std::thread::park_timeout(LOOK);
                let step = redial.step(now(), &own.signs());
                if !stopped.load(Ordering::Acquire) {
                    own.take(step);
                }
            }
        };
        let thread = std::thread::Builder::new().name("link".to_owned()).spawn(watch);
        // Without the thread the first session has to do.
        let thread = thread.inspect_err(|error| tracing::warn!("cannot start a thread: {error}")).ok();
        Ok(Self { shared, stop, thread })
    }

    /// For other threads to send through.
    #[must_use]
    pub fn sender(&self) -> RobotSender {
        RobotSender(Arc::clone(&self.shared))
    }

    /// How many sessions were opened.
    #[must_use]
    pub fn opened(&self) -> u64 {
        self.shared.opened.load(Ordering::Relaxed)
    }

    /// Asks `key` and gives the first answer.
    ///
    /// # Errors
    /// See [`Session::get`].
    pub fn get(&self, key: &str, timeout: Duration) -> Result<Vec<u8>, NetError> {
        let session = self.shared.lock().as_ref().map(|connected| connected.session.clone());
        session.map_or_else(
            || Err(NetError::NoAnswer { key: key.to_owned(), timeout_ms: timeout.as_millis() }),
            |session| session.get(key, timeout),
        )
    }
}

impl Drop for RobotLink {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Release);
        if let Some(thread) = self.thread.take() {
            thread.thread().unpark();
            thread.join().ok();
        }
        if let Some(connected) = self.shared.lock().take() {
            let session = connected.session.clone();
            drop(connected);
            session.close().ok();
        }
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
