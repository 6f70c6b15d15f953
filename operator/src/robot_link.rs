//! The operator's connection to its robot: what is published to it and heard from it, over a session that is opened anew
//! when the robot falls silent.
//!
//! zenoh reconnects by itself, but not always for the better: on a link that does not resend (plain UDP) the messages that
//! declare who publishes and subscribes what may be lost, and then the session stays up and deaf. So what the robot may
//! have missed is subscribed to again, and a session that was cut off is replaced: a new one begins from nothing, with
//! handshakes as short as the robot's round trip allows. When to do what: `redial.rs`, without clock and session.

mod redial;

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::Duration;

use teleop_common::key::Keys;
use teleop_common::net::clock::now;
use teleop_common::net::{LiveToken, NetError, Publisher, Session, SessionConfig, Stream, Subscriber};
use teleop_common::wire::{ControlMessage, PoseMessage, Request};

use self::redial::{Redial, SHORTEST, Signs, Step};
use crate::feedback::Feedback;

/// How often it is looked.
const LOOK: Duration = Duration::from_millis(50);

/// What is declared on one session. Dropping it closes the session.
struct Connected {
    session: Session,
    poses: Publisher,
    stops: Publisher,
    resets: Publisher,
    _token: Option<LiveToken>,
    subscribers: Option<[Subscriber; 3]>,
}

impl Connected {
    fn open(config: &SessionConfig, keys: &Keys, own: Option<u64>, feedback: &Arc<Feedback>) -> Result<Self, NetError> {
        let session = Session::open(config)?;
        Ok(Self {
            poses: session.publisher(&keys.pose(), Stream::Command)?,
            stops: session.publisher(&keys.stop(), Stream::Slow)?,
            resets: session.publisher(&keys.reset(), Stream::Slow)?,
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

/// The connection; dropping it ends it.
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
            Ok(new) => *self.lock() = Some(new),
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

    /// Sends a request, on the key that it belongs to.
    ///
    /// # Errors
    /// As for a pose.
    pub fn control(&self, message: &ControlMessage) -> Result<(), NetError> {
        self.0.lock().as_ref().map_or(Ok(()), |connected| match message.request() {
            Some(Request::Reset { .. }) => connected.resets.send(message),
            _ => connected.stops.send(message),
        })
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
