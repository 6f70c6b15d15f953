//! Stops and resets: asked for until the robot shows that it is done.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::thread::JoinHandle;
use std::time::Duration;

use teleop_common::mode::Mode;
use teleop_common::net::NetError;
use teleop_common::net::clock::now;
use teleop_common::wire::{ControlMessage, Request, Stamper};

use crate::feedback::Feedback;
use crate::robot_link::RobotSender;

/// How often a request is repeated, ...
const EVERY: Duration = Duration::from_millis(50);
/// ... and for how long.
const FOR: Duration = Duration::from_secs(3);

/// What a person wants.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Wish {
    /// Stop the hand.
    Stop,
    /// Reset the stop in force.
    Reset,
}

/// Sends requests to one robot.
pub struct Requester {
    sender: RobotSender,
    stamper: Stamper,
    feedback: Arc<Feedback>,
}

impl Requester {
    /// Requests by the process `epoch`.
    #[must_use]
    pub fn new(sender: RobotSender, epoch: u64, feedback: &Arc<Feedback>) -> Self {
        Self { sender, stamper: Stamper::new(epoch), feedback: Arc::clone(feedback) }
    }

    /// Asks until it is done; false if the robot does not show that within 3 s, or `stop` is set before.
    ///
    /// # Errors
    /// The session is closed.
    pub fn ask(&mut self, wish: Wish, stop: &AtomicBool) -> Result<bool, NetError> {
        let end = now() + FOR;
        while now() < end && !stop.load(Ordering::Relaxed) {
            let robot = self.feedback.snapshot(now()).joints;
            let stopped = robot.is_some_and(|joints| joints.mode() == Some(Mode::Stopped));
            let request = match wish {
                Wish::Stop if stopped => return Ok(true),
                Wish::Stop => Some((0, Request::Stop)),
                Wish::Reset if robot.is_some() && !stopped => return Ok(true),
                Wish::Reset => robot.map(|joints| (joints.header.epoch, Request::Reset { stop: joints.stop })),
            };
            if let Some((robot, request)) = request {
                let header = self.stamper.header::<ControlMessage>(now());
                self.sender.control(&ControlMessage::new(header, robot, request))?;
            }
            std::thread::sleep(EVERY);
        }
        Ok(false)
    }
}

/// Carries out wishes one after the other, in a thread of its own; dropping it ends it.
pub struct Requests {
    wishes: SyncSender<Wish>,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Requests {
    /// Starts the thread.
    ///
    /// # Errors
    /// The system refuses a thread.
    pub fn start(mut requester: Requester) -> std::io::Result<Self> {
        let (sender, receiver): (_, Receiver<Wish>) = sync_channel(4);
        let stop = Arc::new(AtomicBool::new(false));
        let stopped = Arc::clone(&stop);
        let thread = std::thread::Builder::new().name("requests".to_owned()).spawn(move || {
            while !stopped.load(Ordering::Relaxed) {
                let Ok(wish) = receiver.recv_timeout(EVERY) else { continue };
                match requester.ask(wish, &stopped) {
                    Ok(true) => {}
                    Ok(false) => tracing::error!("the robot did not confirm: {wish:?}"),
                    Err(error) => tracing::error!("{wish:?} not sent: {error}"),
                }
            }
        })?;
        Ok(Self { wishes: sender, stop, thread: Some(thread) })
    }

    /// A way to wish from another thread; never waits.
    pub fn wisher(&self) -> impl Fn(Wish) + Send + 'static {
        let wishes = self.wishes.clone();
        move |wish| {
            // Full: the same is being asked already.
            wishes.try_send(wish).ok();
        }
    }
}

impl Drop for Requests {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            thread.join().ok();
        }
    }
}
