//! The control thread: the shell around [`Controller::tick`].
//!
//! | thread | what it may wait for |
//! |---|---|
//! | control | its next deadline, or the hand's next frame; nothing else |
//!
//! Poses come in through a ring that drops the newest when nobody takes them, stops through an atomic number, records go out through a ring
//! that drops when nobody reads. None blocks, so no network, viewer or logger can delay a tick.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU8, AtomicU64, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use rustix::thread::clock_nanosleep_absolute;
use rustix::time::{ClockId, Timespec};
use teleop_common::authority::StopLatch;
use teleop_common::hand::JointVector;
use teleop_common::mode::Mode;
use teleop_common::net::clock::now;
use teleop_common::time::MonoTime;
use thread_priority::{
    RealtimeThreadSchedulePolicy, ThreadPriority, ThreadPriorityValue, ThreadSchedulePolicy,
    set_thread_priority_and_policy, thread_native_id,
};

use crate::control::{Controller, Fault, PoseSample, TickRecord};
use crate::driver::{DriverError, HandDriver, JointState, Pace};

/// Longest wait for a frame of a hand that paces the loop.
const HAND_TIMEOUT: Duration = Duration::from_millis(50);
/// Places in the ring of records: 1.5 s at 333 Hz.
const RECORDS: usize = 512;
/// Places for poses: a third of a second at 200 Hz, far more than come between two ticks.
const POSES: usize = 64;

/// Whether the control thread must get real-time priority.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum Realtime {
    /// Take it where the system allows.
    #[default]
    Auto,
    /// Refuse to run without it.
    Require,
    /// Do not ask for it.
    Off,
}

/// What the control thread and all others may read and write at any time.
#[derive(Debug, Default)]
pub struct Shared {
    /// Stops and their resets.
    pub latch: StopLatch,
    mode: AtomicU8,
}

impl Shared {
    /// The mode after the last tick.
    #[must_use]
    pub fn mode(&self) -> Mode {
        Mode::from_wire(self.mode.load(Ordering::Relaxed)).unwrap_or_default()
    }
}

/// A tick and how it went in time.
#[derive(Clone, Copy, Debug)]
pub struct LoopRecord {
    /// The tick.
    pub record: TickRecord,
    /// How late it began.
    pub late: Duration,
    /// When the command was written.
    pub written: MonoTime,
    /// How long it took, from the state to the command written.
    pub busy: Duration,
    /// Deadlines missed so far.
    pub overruns: u64,
    /// What the driver last complained of.
    pub driver_error: Option<DriverError>,
}

/// The network's end of the control thread.
pub struct Link {
    /// Where admitted poses go.
    pub poses: rtrb::Producer<PoseSample>,
    /// Where records come from.
    pub records: rtrb::Consumer<LoopRecord>,
    /// The stop latch and the mode.
    pub shared: Arc<Shared>,
}

/// The running control thread.
pub struct ControlThread {
    stop: Arc<AtomicBool>,
    dropped: Arc<AtomicU64>,
    thread: Option<JoinHandle<()>>,
    realtime: bool,
}

/// The control thread could not start.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum StartError {
    /// The operating system refused a thread or its priority.
    #[error("real-time priority was refused ({0}): give the process CAP_SYS_NICE, or use --realtime auto")]
    Priority(String),
    /// No thread could be made.
    #[error("cannot start the control thread")]
    Thread(#[from] std::io::Error),
    /// The hand did not start.
    #[error("cannot start the {name}")]
    Driver {
        /// Which driver.
        name: &'static str,
        /// Why.
        source: DriverError,
    },
}

impl ControlThread {
    /// Starts the hand and the loop around it, `rate` ticks per second.
    ///
    /// # Errors
    /// The hand does not start, or the system refuses the thread.
    pub fn start(
        controller: Controller,
        mut driver: Box<dyn HandDriver>,
        rate: f64,
        realtime: Realtime,
    ) -> Result<(Self, Link), StartError> {
        let name = driver.name();
        driver.start().map_err(|source| StartError::Driver { name, source })?;
        let (input, output) = rtrb::RingBuffer::new(POSES);
        let (producer, consumer) = rtrb::RingBuffer::new(RECORDS);
        let (stop, dropped) = (Arc::new(AtomicBool::new(false)), Arc::new(AtomicU64::new(0)));
        let shared = Arc::new(Shared::default());
        let (ready, started) = std::sync::mpsc::sync_channel(1);
        let mut body = Loop {
            controller,
            driver,
            poses: output,
            records: producer,
            stop: Arc::clone(&stop),
            shared: Arc::clone(&shared),
            dropped: Arc::clone(&dropped),
            period: Duration::from_secs_f64(1.0 / rate),
            overruns: 0,
            driver_error: None,
        };
        let thread = std::thread::Builder::new().name("control".to_owned()).spawn(move || {
            let priority = if realtime == Realtime::Off { Err("off".to_owned()) } else { raise_priority() };
            let go = realtime != Realtime::Require || priority.is_ok();
            ready.send(priority).ok();
            if go {
                body.run_guarded();
            }
            body.driver.stop();
        })?;
        let priority = started.recv().unwrap_or_else(|_| Err("the thread ended at once".to_owned()));
        if let (Realtime::Require, Err(reason)) = (realtime, &priority) {
            return Err(StartError::Priority(reason.clone()));
        }
        let this = Self { stop, dropped, thread: Some(thread), realtime: priority.is_ok() };
        Ok((this, Link { poses: input, records: consumer, shared }))
    }

    /// True if the thread has real-time priority.
    #[must_use]
    pub fn is_realtime(&self) -> bool {
        self.realtime
    }

    /// Records dropped because nobody read them.
    #[must_use]
    pub fn dropped(&self) -> u64 {
        self.dropped.load(Ordering::Relaxed)
    }

    /// True as long as the loop runs.
    #[must_use]
    pub fn is_running(&self) -> bool {
        self.thread.as_ref().is_some_and(|thread| !thread.is_finished())
    }
}

impl Drop for ControlThread {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            thread.join().ok();
        }
    }
}

fn raise_priority() -> Result<(), String> {
    // Any real-time priority passes all ordinary threads; 80 leaves room above for the kernel's own.
    let value = ThreadPriorityValue::try_from(80).map_err(|error| format!("{error:?}"))?;
    set_thread_priority_and_policy(
        thread_native_id(),
        ThreadPriority::Crossplatform(value),
        ThreadSchedulePolicy::Realtime(RealtimeThreadSchedulePolicy::Fifo),
    )
    .map_err(|error| format!("{error:?}"))
}

struct Loop {
    controller: Controller,
    driver: Box<dyn HandDriver>,
    poses: rtrb::Consumer<PoseSample>,
    records: rtrb::Producer<LoopRecord>,
    stop: Arc<AtomicBool>,
    shared: Arc<Shared>,
    dropped: Arc<AtomicU64>,
    period: Duration,
    overruns: u64,
    driver_error: Option<DriverError>,
}

impl Loop {
    /// Runs until told to stop; a panic stops the hand and ends the loop.
    fn run_guarded(&mut self) {
        if catch_unwind(AssertUnwindSafe(|| self.run())).is_err() {
            self.driver.stop();
            tracing::error!("the control loop panicked: the hand is off");
        }
    }

    fn run(&mut self) {
        let still = JointVector::zeros(self.controller.hand().joints.len());
        let mut state = JointState { q: self.controller.hand().home(), dq: still, tau: still };
        let mut deadline = now();
        while !self.stop.load(Ordering::Relaxed) {
            let hand_paces = self.driver.pace() == Pace::Hand && self.driver_error.is_none();
            if !hand_paces {
                deadline = self.wait(deadline + self.period);
            }
            let begun = if hand_paces { None } else { Some(now()) };
            if self.driver_error.is_none() {
                match self.driver.read(HAND_TIMEOUT) {
                    Ok(read) => state = read,
                    Err(error) => self.fail(error),
                }
            }
            let start = now();
            for _ in 0..POSES {
                let Ok(sample) = self.poses.pop() else { break };
                self.controller.admit(&sample);
            }
            let record = self.controller.tick(start, self.shared.latch.get(), &state);
            self.shared.mode.store(record.mode.to_wire(), Ordering::Relaxed);
            if self.driver_error.is_none()
                && let Err(error) = self.driver.write(&record.command)
            {
                self.fail(error);
            }
            let written = now();
            let record = LoopRecord {
                record,
                written,
                late: begun.map_or(Duration::ZERO, |begun| begun.since(deadline)),
                busy: written.since(begun.unwrap_or(start)),
                overruns: self.overruns,
                driver_error: self.driver_error,
            };
            if self.records.push(record).is_err() {
                self.dropped.fetch_add(1, Ordering::Relaxed);
            }
        }
    }

    /// A driver that failed stays off: what it would do next is not known.
    fn fail(&mut self, error: DriverError) {
        self.driver.stop();
        self.driver_error = Some(error);
        self.controller.fail(Fault::Driver);
    }

    /// Sleeps until `deadline` and returns it; if it is long gone, counts the miss and starts anew from now.
    fn wait(&mut self, deadline: MonoTime) -> MonoTime {
        let before = now();
        if before.since(deadline) > self.period {
            self.overruns += 1;
            return before;
        }
        let request = Timespec {
            tv_sec: i64::try_from(deadline.0 / 1_000_000_000).unwrap_or(i64::MAX),
            tv_nsec: i64::try_from(deadline.0 % 1_000_000_000).unwrap_or(0),
        };
        // A signal may end the sleep early; sleep on then.
        while clock_nanosleep_absolute(ClockId::Monotonic, &request) == Err(rustix::io::Errno::INTR) {}
        deadline
    }
}
