//! The operator's connection to its robot: what is published to it and heard from it, over a session that is opened anew
//! when the robot falls silent.
//!
//! zenoh reconnects by itself, but not always for the better: on a link that does not resend (plain UDP) the messages that
//! declare who publishes and subscribes what may be lost, and then the session stays up and deaf; and a session that was
//! cut off waits longer and longer between its tries. A new session begins from nothing, at once.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::Duration;

use teleop_common::key::Keys;
use teleop_common::net::clock::now;
use teleop_common::net::{LiveToken, NetError, Publisher, Session, SessionConfig, Stream, Subscriber};
use teleop_common::time::MonoTime;
use teleop_common::wire::{ControlMessage, PoseMessage};

use crate::feedback::Feedback;

/// How long the robot's joint states, a hundred a second, may be missing before the session is opened anew.
const DEAF: Duration = Duration::from_millis(600);
/// The same of what comes less often, or may be lost more often.
const PARTLY_DEAF: Duration = Duration::from_secs(3);
/// How many times a handshake's timeout a new session is given.
const HANDSHAKES: u32 = 3;
/// Longest timeout of a handshake that is tried.
const LONGEST: Duration = Duration::from_secs(5);
/// How often it is looked.
const LOOK: Duration = Duration::from_millis(50);

/// What is declared on one session. Dropping it closes the session.
struct Connected {
    session: Session,
    poses: Publisher,
    control: Publisher,
    _token: Option<LiveToken>,
    _subscribers: [Subscriber; 3],
}

impl Connected {
    fn open(config: &SessionConfig, keys: &Keys, own: Option<u64>, feedback: &Arc<Feedback>) -> Result<Self, NetError> {
        let session = Session::open(config)?;
        Ok(Self {
            poses: session.publisher(&keys.pose(), Stream::Command)?,
            control: session.publisher(&keys.control(), Stream::Slow)?,
            _token: own.map(|epoch| session.live_token(&keys.live_operator(epoch))).transpose()?,
            _subscribers: hear(&session, keys, feedback)?,
            session,
        })
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

/// When the session is to be opened anew, and with which timeout. No clock, no thread.
#[derive(Clone, Debug)]
struct Redial {
    opened: MonoTime,
    /// Of a handshake: short finds a link that is back sooner, long gets through where round trips are long.
    timeout: Duration,
    /// The one with which the robot was heard.
    proven: Option<Duration>,
    failures: u32,
}

impl Redial {
    const fn new(now: MonoTime, timeout: Duration) -> Self {
        Self { opened: now, timeout, proven: None, failures: 0 }
    }

    /// The timeout of the session that is to be opened now, if one is; `heard` is when the robot's joint states came
    /// last, `whole` when all that it publishes did.
    fn step(&mut self, now: MonoTime, heard: Option<MonoTime>, whole: Option<MonoTime>) -> Option<Duration> {
        if let Some(heard) = heard.filter(|heard| *heard >= self.opened) {
            (self.proven, self.failures) = (Some(self.timeout), 0);
            let deaf = now.since(heard) > DEAF;
            let partly = now.since(whole.unwrap_or(self.opened).max(self.opened)) > PARTLY_DEAF;
            if !deaf && !partly {
                return None;
            }
        } else {
            if now.since(self.opened) <= self.timeout * HANDSHAKES {
                return None;
            }
            self.failures += 1;
            self.timeout = match self.proven {
                // The robot may have moved behind another link; mostly it is just not back yet.
                Some(proven) if self.failures % 4 != 0 => proven,
                _ => (self.timeout * 2).min(LONGEST),
            };
        }
        self.opened = now;
        Some(self.timeout)
    }
}

impl Shared {
    fn lock(&self) -> MutexGuard<'_, Option<Connected>> {
        self.connected.lock().unwrap_or_else(PoisonError::into_inner)
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
            let mut redial = Redial::new(now(), own.config.open_timeout);
            while !stopped.load(Ordering::Acquire) {
                std::thread::park_timeout(LOOK);
                let (heard, whole) = own.feedback.last_heard();
                if !stopped.load(Ordering::Acquire)
                    && let Some(timeout) = redial.step(now(), heard, whole)
                {
                    own.reopen(timeout);
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

    #[test]
    fn a_session_is_given_as_long_as_its_link_needs() {
        let ms = |ms: u64| MonoTime(ms * 1_000_000);
        let short = Duration::from_millis(600);
        // Nobody answers: longer and longer.
        let mut redial = Redial::new(ms(0), short);
        assert_eq!(redial.step(ms(1800), None, None), None);
        assert_eq!(redial.step(ms(1801), None, None), Some(short * 2));
        assert_eq!(redial.step(ms(5400), None, None), None);
        assert_eq!(redial.step(ms(5402), None, None), Some(short * 4));
        // Then the robot is heard, and all is well as long as everything comes.
        for at in (6000..20_000).step_by(50) {
            assert_eq!(redial.step(ms(at), Some(ms(at)), Some(ms(at - 200))), None);
        }
        assert_eq!(redial.step(ms(20_500), Some(ms(19_950)), Some(ms(19_950))), None);
        // It is cut off: the same again and again, so that it is back soon.
        assert_eq!(redial.step(ms(20_600), Some(ms(19_950)), Some(ms(19_950))), Some(short * 4));
        assert_eq!(redial.step(ms(27_900), Some(ms(19_950)), Some(ms(19_950))), Some(short * 4));
        // Heard again, but not all of it.
        let mut redial = Redial::new(ms(0), short);
        assert_eq!(redial.step(ms(2900), Some(ms(2900)), None), None);
        assert_eq!(redial.step(ms(3001), Some(ms(3000)), None), Some(short));
    }
}
