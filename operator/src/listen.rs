//! Hears the robot, and asks again where it is not heard.
//!
//! On a link that does not resend (plain UDP) the message that says "I subscribe to this" can get lost, and then nothing
//! ever comes. So a subscription that brings nothing is declared anew.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use teleop_common::key::Keys;
use teleop_common::net::clock::now;
use teleop_common::net::{NetError, Session, Subscriber};

use crate::feedback::Feedback;

/// How long nothing may come before the subscriptions are declared anew.
const RENEW_EVERY: Duration = Duration::from_secs(1);

/// Keeps `Feedback` hearing the robot, until dropped.
pub struct Listener {
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Listener {
    /// Lets `feedback` hear the robot whose keys these are.
    ///
    /// # Errors
    /// The session is closed.
    pub fn start(session: &Session, keys: &Keys, feedback: &Arc<Feedback>) -> Result<Self, NetError> {
        let mut subscribers = Some(subscribe(session, keys, feedback)?);
        let (session, keys, feedback) = (session.clone(), keys.clone(), Arc::clone(feedback));
        let stop = Arc::new(AtomicBool::new(false));
        let stopped = Arc::clone(&stop);
        let thread = std::thread::Builder::new().name("listener".to_owned()).spawn(move || {
            loop {
                std::thread::park_timeout(RENEW_EVERY);
                if stopped.load(Ordering::Acquire) {
                    break;
                }
                if feedback.is_deaf(now()) {
                    // The old ones go first, so that the robot is told of new ones.
                    drop(subscribers.take());
                    subscribers = subscribe(&session, &keys, &feedback).ok();
                }
            }
        });
        // Without the thread there is no second try; the first may do.
        Ok(Self { stop, thread: thread.inspect_err(|error| tracing::warn!("cannot start a thread: {error}")).ok() })
    }
}

impl Drop for Listener {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Release);
        if let Some(thread) = self.thread.take() {
            thread.thread().unpark();
            thread.join().ok();
        }
    }
}

fn subscribe(session: &Session, keys: &Keys, feedback: &Arc<Feedback>) -> Result<[Subscriber; 3], NetError> {
    let joints = Arc::clone(feedback);
    let mapping = Arc::clone(feedback);
    let health = Arc::clone(feedback);
    Ok([
        session.subscribe(&keys.joints(), move |arrival| joints.on_joints(arrival))?,
        session.subscribe(&keys.mapping(), move |arrival| mapping.on_mapping(arrival))?,
        session.subscribe(&keys.health(), move |arrival| health.on_health(arrival))?,
    ])
}
