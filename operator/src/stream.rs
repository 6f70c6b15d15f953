//! The pose stream: a publisher thread behind a latest-value slot, so that a source never waits for the network.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use teleop_common::authority::Intent;
use teleop_common::master::MasterPose;
use teleop_common::net::NetError;
use teleop_common::net::clock::now;
use teleop_common::time::MonoTime;
use teleop_common::wire::{PoseMessage, Stamper};

use crate::feedback::Feedback;
use crate::pilot::Pilot;
use crate::robot_link::RobotSender;

/// How often the publisher looks whether it should end.
const LOOK: Duration = Duration::from_millis(100);
/// Latest that the copy of a pose is sent, where each is sent twice: half the longest period that the robot's watchdog
/// allows for.
const LONGEST_HALF: Duration = Duration::from_millis(50);
/// How often it says that it leaves.
const FAREWELLS: u32 = 3;
const FAREWELL_EVERY: Duration = Duration::from_millis(5);

/// A pose on its way to the network.
#[derive(Clone, Copy, Debug)]
pub struct Outgoing {
    /// When the hand was in this pose.
    pub captured: MonoTime,
    /// The pose.
    pub pose: MasterPose,
}

/// What the publisher has done so far. Shared with those who tell people about it.
#[derive(Debug, Default)]
pub struct StreamCounters {
    /// Poses handed to the network.
    pub sent: AtomicU64,
    /// Poses that could not be sent.
    pub failed: AtomicU64,
    /// Send stamp of the newest pose, ns.
    pub last_sent: AtomicU64,
}

/// The source's end: takes poses, never waits.
pub struct PoseSender {
    slot: triple_buffer::Input<Option<Outgoing>>,
    publisher: std::thread::Thread,
}

/// The running publisher thread; dropping it ends it.
pub struct PoseStream {
    counters: Arc<StreamCounters>,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl PoseStream {
    /// Starts publishing through `sender` as the process `epoch`, with echoes from `feedback` and what `pilot` wants. When
    /// it ends it gives the robot back.
    ///
    /// # Errors
    /// The system refuses a thread.
    pub fn start(
        sender: RobotSender,
        epoch: u64,
        feedback: Arc<Feedback>,
        pilot: Pilot,
    ) -> std::io::Result<(Self, PoseSender)> {
        let (slot, mut poses) = triple_buffer::triple_buffer(&None);
        let (counters, stop) = (Arc::new(StreamCounters::default()), Arc::new(AtomicBool::new(false)));
        let (count, stopped) = (Arc::clone(&counters), Arc::clone(&stop));
        let thread = std::thread::Builder::new().name("publisher".to_owned()).spawn(move || {
            let mut stamper = Stamper::new(epoch);
            let mut last = None;
            let mut copy: Option<(PoseMessage, MonoTime)> = None;
            while !stopped.load(Ordering::Acquire) {
                let news = if poses.update() { *poses.output_buffer() } else { None };
                let Some(outgoing) = news else {
                    let due = copy.as_ref().map(|(_, due)| due.since(now()));
                    if due == Some(Duration::ZERO)
                        && let Some((message, _)) = copy.take()
                    {
                        // That it fails was told when the first of the two did.
                        sender.pose(&message).ok();
                    } else {
                        std::thread::park_timeout(due.unwrap_or(LOOK));
                    }
                    continue;
                };
                last = Some(outgoing);
                pilot.step(now(), feedback.snapshot(now()).authority);
                match send(&sender, &mut stamper, &feedback, &outgoing, pilot.intent()) {
                    Ok(message) => {
                        let sent = message.header.sent;
                        count.sent.fetch_add(1, Ordering::Relaxed);
                        let before = MonoTime(count.last_sent.swap(sent.0, Ordering::AcqRel));
                        let half = (sent.since(before) / 2).min(LONGEST_HALF);
                        copy = feedback.delivery().twice().then(|| (message, sent + half));
                    }
                    Err(error) => {
                        // Told once: a stream that fails does so at every pose.
                        if count.failed.fetch_add(1, Ordering::Relaxed) == 0 {
                            tracing::error!("pose not sent: {error}");
                        }
                    }
                }
            }
            // Any one of them suffices.
            for _ in 0..FAREWELLS {
                let Some(last) = last else { break };
                let outgoing = Outgoing { captured: now(), ..last };
                send(&sender, &mut stamper, &feedback, &outgoing, pilot.farewell(now())).ok();
                std::thread::sleep(FAREWELL_EVERY);
            }
        })?;
        let poses = PoseSender { slot, publisher: thread.thread().clone() };
        Ok((Self { counters, stop, thread: Some(thread) }, poses))
    }

    /// What was sent so far.
    #[must_use]
    pub fn counters(&self) -> &StreamCounters {
        &self.counters
    }
}

impl Drop for PoseStream {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Release);
        if let Some(thread) = self.thread.take() {
            thread.thread().unpark();
            if thread.join().is_err() {
                tracing::error!("the publisher thread panicked");
            }
        }
    }
}

impl PoseSender {
    /// Sends `outgoing` as soon as the network takes it, unless a newer one comes first.
    pub fn send(&mut self, outgoing: Outgoing) {
        self.slot.write(Some(outgoing));
        self.publisher.unpark();
    }
}

fn send(
    sender: &RobotSender,
    stamper: &mut Stamper,
    feedback: &Feedback,
    outgoing: &Outgoing,
    intent: Intent,
) -> Result<PoseMessage, NetError> {
    let sent = now();
    // Before the pose is on its way, or its echo could come back first.
    feedback.on_sent(sent);
    let header = stamper.header::<PoseMessage>(sent);
    let message = PoseMessage::new(header, feedback.echo(sent), outgoing.captured, &outgoing.pose, intent);
    sender.pose(&message)?;
    Ok(message)
}
