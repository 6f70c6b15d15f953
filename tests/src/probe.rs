//! Watches a robot over a session of its own: everything it publishes, with the time of arrival.

#![allow(clippy::unwrap_used, reason = "helpers of tests")]

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use teleop_common::key::Keys;
use teleop_common::mode::Mode;
use teleop_common::net::{Arrival, Session, SessionConfig, Subscriber};
use teleop_common::time::MonoTime;
use teleop_common::wire::{Checked, HealthMessage, JointStateMessage, MappingMessage, Message, Rejection};

use crate::eventually;

/// A joint state and when it came.
#[derive(Clone, Copy, Debug)]
pub struct State {
    /// When it arrived, `CLOCK_MONOTONIC` of this machine.
    pub at: MonoTime,
    /// The message.
    pub message: Checked<JointStateMessage>,
}

impl State {
    /// Whether the hand goes where the operator's is.
    #[must_use]
    pub fn follows(&self) -> bool {
        self.mode().is_some_and(Mode::follows)
    }
}

impl std::ops::Deref for State {
    type Target = JointStateMessage;

    fn deref(&self) -> &JointStateMessage {
        &self.message
    }
}

#[derive(Debug, Default)]
struct Seen {
    states: Vec<State>,
    mapping: Option<Checked<MappingMessage>>,
    health: Option<Checked<HealthMessage>>,
    invalid: Vec<String>,
}

impl Seen {
    fn take<M: Message>(&mut self, arrival: &Arrival<'_>) -> Option<Checked<M>> {
        arrival.decode().map_err(|error| self.invalid.push(error.to_string())).ok()
    }
}

/// A watcher of one robot.
#[derive(Debug)]
pub struct Probe {
    /// Its session, for tests that do more than watch.
    pub session: Session,
    /// The robot's keys.
    pub keys: Keys,
    seen: Arc<Mutex<Seen>>,
    _subscribers: [Subscriber; 3],
}

impl Probe {
    /// Watches the robot `allegro` at `endpoint`, also after it restarts there.
    ///
    /// # Panics
    /// If no session can be opened.
    #[must_use]
    pub fn connect(endpoint: &str) -> Self {
        Self::open(&SessionConfig::connecting([endpoint]))
    }

    /// The same over a session of its own kind.
    ///
    /// # Panics
    /// If no session can be opened.
    #[must_use]
    pub fn open(config: &SessionConfig) -> Self {
        let session = Session::open(config).unwrap();
        let keys = Keys::new("allegro").unwrap();
        let seen = Arc::<Mutex<Seen>>::default();
        let inbox = || Arc::clone(&seen);
        let (joints, mapping, health) = (inbox(), inbox(), inbox());
        let subscribers = [
            session.subscribe(&keys.joints(), move |arrival| {
                let mut seen = lock(&joints);
                if let Some(message) = seen.take(&arrival) {
                    seen.states.push(State { at: arrival.at, message });
                }
            }),
            session.subscribe(&keys.mapping(), move |arrival| {
                let mut seen = lock(&mapping);
                seen.mapping = seen.take(&arrival).or(seen.mapping);
            }),
            session.subscribe(&keys.health(), move |arrival| {
                let mut seen = lock(&health);
                seen.health = seen.take(&arrival).or(seen.health);
            }),
        ];
        Self { session, keys, seen, _subscribers: subscribers.map(Result::unwrap) }
    }

    /// All joint states so far.
    #[must_use]
    pub fn states(&self) -> Vec<State> {
        self.since(0)
    }

    /// The joint states from number `mark` on.
    #[must_use]
    pub fn since(&self, mark: usize) -> Vec<State> {
        lock(&self.seen).states.get(mark..).unwrap_or_default().to_vec()
    }

    /// How many joint states have come.
    #[must_use]
    pub fn mark(&self) -> usize {
        lock(&self.seen).states.len()
    }

    /// The newest joint state.
    #[must_use]
    pub fn last(&self) -> Option<State> {
        lock(&self.seen).states.last().copied()
    }

    /// The newest mapping signals.
    #[must_use]
    pub fn mapping(&self) -> Option<Checked<MappingMessage>> {
        lock(&self.seen).mapping
    }

    /// The newest health.
    #[must_use]
    pub fn health(&self) -> Option<Checked<HealthMessage>> {
        lock(&self.seen).health
    }

    /// How many poses the robot refused for `reason`, as far as known.
    #[must_use]
    pub fn rejected(&self, reason: Rejection) -> u64 {
        self.health().map_or(0, |health| health.rejected[reason.index()])
    }

    /// Waits until the robot is in `mode`, and gives the number of the first state seen in it from now on.
    ///
    /// # Panics
    /// If that takes too long.
    #[track_caller]
    pub fn wait_for(&self, mode: Mode) -> usize {
        let mark = self.mark();
        let mut first = None;
        eventually(&format!("the robot is {mode}"), || {
            first = self.since(mark).iter().position(|state| state.mode() == Some(mode));
            first.is_some()
        });
        mark + first.unwrap()
    }

    /// Waits until `count` more states have come.
    ///
    /// # Panics
    /// If that takes too long.
    #[track_caller]
    pub fn wait_for_more(&self, count: usize) {
        let mark = self.mark();
        eventually("more states come", || self.mark() >= mark + count);
    }

    /// Waits until the hand, following an operator, has moved at least three joints by more than `angle` (rad).
    ///
    /// # Panics
    /// If that takes too long.
    #[track_caller]
    pub fn wait_for_motion(&self, angle: f64) {
        let mark = self.mark();
        eventually("the hand moves", || moved(&self.since(mark), angle) >= 3);
    }

    /// The robots' liveliness tokens.
    ///
    /// # Panics
    /// If they cannot be asked for.
    #[must_use]
    pub fn robots(&self) -> Vec<String> {
        self.session.live_now(&self.keys.live_robots(), Duration::from_secs(5)).unwrap()
    }

    /// Expects that nothing arrived that was no valid message.
    ///
    /// # Panics
    /// If something did.
    #[track_caller]
    pub fn assert_all_valid(&self) {
        let seen = lock(&self.seen);
        assert!(seen.invalid.is_empty(), "{} invalid messages, first: {}", seen.invalid.len(), seen.invalid[0]);
    }
}

/// How many measured joints covered more than `angle` (rad) while the robot followed.
#[must_use]
pub fn moved(states: &[State], angle: f64) -> usize {
    let engaged = || states.iter().filter(|state| state.follows()).map(|state| state.q());
    let Some(first) = engaged().next() else { return 0 };
    let covered = |joint: usize| {
        let (low, high) = engaged()
            .fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), q| (q[joint].min(low), q[joint].max(high)));
        high - low
    };
    (0..first.len()).filter(|joint| covered(*joint) > angle).count()
}

fn lock(seen: &Mutex<Seen>) -> MutexGuard<'_, Seen> {
    seen.lock().unwrap_or_else(PoisonError::into_inner)
}
