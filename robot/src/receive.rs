//! From the network to the control loop: decodes poses, judges them, and leaves the newest good one in the slot.

use teleop_common::net::Arrival;
use teleop_common::time::{ClockOffset, Histogram, MonoTime};
use teleop_common::wire::{Checked, Echo, PoseMessage, REJECTIONS, Rejection};

use crate::control::{Gate, GateParams, PoseSample};

/// Operators whose clocks are known at the same time: the one that drives and others that try to.
const CLOCKS: usize = 4;

/// Judges arriving poses. Lives behind a mutex on the network's side; the control thread never touches it.
pub struct Receiver {
    epoch: u64,
    gate: Gate,
    clocks: [ClockOffset; CLOCKS],
    next_clock: usize,
    slot: triple_buffer::Input<Option<PoseSample>>,
    echo: Echo,
    counts: Counts,
}

/// What became of the poses so far.
#[derive(Clone, Debug, Default)]
pub struct Counts {
    /// Poses passed on to the control loop.
    pub accepted: u64,
    /// Poses refused, by reason.
    pub rejected: [u64; REJECTIONS],
    /// Age of the accepted ones on arrival, since capture.
    pub age: Histogram,
}

impl Receiver {
    /// A receiver of the process `epoch` that fills `slot`.
    #[must_use]
    pub fn new(epoch: u64, params: GateParams, slot: triple_buffer::Input<Option<PoseSample>>) -> Self {
        Self {
            epoch,
            gate: Gate::new(params),
            clocks: std::array::from_fn(|_| ClockOffset::default()),
            next_clock: 0,
            slot,
            echo: Echo::NONE,
            counts: Counts::default(),
        }
    }

    /// What became of the poses so far.
    #[must_use]
    pub fn counts(&self) -> &Counts {
        &self.counts
    }

    /// The echo of the newest pose of the operator that drives, or may.
    #[must_use]
    pub fn echo(&self) -> Echo {
        self.echo
    }

    /// Takes what arrived on the pose key.
    pub fn on_pose(&mut self, arrival: Arrival<'_>) {
        let result = match arrival.decode::<PoseMessage>() {
            Ok(message) => self.judge(&message, arrival.at),
            Err(error) => Err(Rejection::from(&error)),
        };
        match result {
            Ok(sample) => {
                self.counts.accepted += 1;
                self.counts.age.record(sample.received.since(sample.captured));
                self.slot.write(Some(sample));
            }
            Err(rejection) => self.counts.rejected[rejection.index()] += 1,
        }
    }

    fn judge(&mut self, message: &Checked<PoseMessage>, now: MonoTime) -> Result<PoseSample, Rejection> {
        let header = &message.header;
        if !self.gate.is_open_to(now, header.epoch) {
            return Err(Rejection::Operator);
        }
        self.echo = Echo::of(header, now);
        let own_epoch = self.epoch;
        let clock = self.clock(header.epoch);
        if let Some(exchange) = message.echo.exchange(own_epoch, header, now) {
            // An exchange that makes no sense leaves the estimate as it was.
            clock.update(header.epoch, exchange).ok();
        }
        let known = clock.peer_epoch() == Some(header.epoch);
        let estimate = if known { clock.estimate(now) } else { None };
        let captured = if known { clock.to_own(now, message.captured) } else { None };
        let age = if known { clock.age(now, message.captured) } else { None };
        let age = age.zip(estimate).map(|(age, known)| (age as f64 * 1e-9, known.uncertainty.as_secs_f64()));
        self.gate.admit(now, header.epoch, header.seq, age)?;
        Ok(PoseSample {
            pose: message.pose(),
            epoch: header.epoch,
            sequence: header.seq,
            captured_remote: message.captured,
            captured: captured.unwrap_or(now),
            received: now,
        })
    }

    /// The clock of an operator; an unknown one gets the place of the one that came longest ago.
    fn clock(&mut self, epoch: u64) -> &mut ClockOffset {
        let known = self.clocks.iter().position(|clock| clock.peer_epoch() == Some(epoch));
        let place = known.unwrap_or_else(|| {
            let place = self.next_clock;
            self.next_clock = (place + 1) % CLOCKS;
            self.clocks[place].reset();
            place
        });
        &mut self.clocks[place]
    }
}
