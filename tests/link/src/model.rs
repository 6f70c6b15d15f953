//! What happens to each packet: one direction of a link, without I/O.

use std::time::Duration;

use crate::{Blackouts, Dice, Impairment};

/// What Linux adds to the round trip before it sends a lost segment again.
const MIN_RTO: Duration = Duration::from_millis(200);
/// A segment lost so often in a row comes through all the same.
const MAX_LOSSES: u32 = 6;

/// A direction of a link.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Direction {
    /// To the target: from the operator to the robot.
    Up,
    /// Back from it.
    Down,
}

/// Why a packet never arrives.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Cause {
    /// Lost by chance.
    Chance,
    /// The queue in front of the bottleneck was full.
    Queue,
    /// Sent in a blackout.
    Blackout,
}

/// What happens to a packet.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Fate {
    /// It never arrives.
    Lost(Cause),
    /// It arrives.
    Arrives {
        /// When.
        at: Duration,
        /// When a copy of it arrives too, if there is one.
        copy: Option<Duration>,
    },
}

/// What happens to a segment of a byte stream.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Segment {
    /// When it arrives.
    pub at: Duration,
    /// How often it was lost and sent again.
    pub losses: u32,
}

/// One direction of a link. Times are counted from the link's start, and never go back.
///
/// The dice are rolled equally often for every packet, so by chance the n-th packet of a seed always meets the same
/// fate, whenever it is sent and whatever happened to those before: it is lost, held back or doubled, and its jitter is
/// drawn. Only what depends on time differs with time: the queue, blackouts, and waiting behind the packet in front.
#[derive(Clone, Debug)]
pub struct LinkModel {
    impairment: Impairment,
    blackouts: Blackouts,
    /// A blackout by command.
    dark: bool,
    dice: Dice,
    /// For segments lost more than once.
    again: Dice,
    in_burst: bool,
    /// Correlated, standard normal.
    wave: f64,
    /// When the last packet that was sent leaves the bottleneck.
    line_free: Duration,
    last_arrival: Duration,
}

/// What the dice say about a packet.
struct Chance {
    lost: bool,
    held_back: bool,
    jitter: f64,
    copy: Option<f64>,
}

impl LinkModel {
    /// A link that was never used.
    #[must_use]
    pub fn new(impairment: Impairment, blackouts: Blackouts, seed: u64, direction: Direction) -> Self {
        let stream = direction as u64;
        let mut dice = Dice::new(seed, 1 + stream);
        let wave = dice.normal();
        Self {
            impairment: impairment.bounded(),
            blackouts,
            dark: false,
            dice,
            again: Dice::new(seed, 3 + stream),
            in_burst: false,
            wave,
            line_free: Duration::ZERO,
            last_arrival: Duration::ZERO,
        }
    }

    /// Changes the link from the next packet on.
    pub fn set(&mut self, impairment: Impairment, blackouts: Blackouts) {
        self.impairment = impairment.bounded();
        self.blackouts = blackouts;
    }

    /// Begins or ends a blackout by command, on top of those of the schedule.
    pub const fn blackout(&mut self, on: bool) {
        self.dark = on;
    }

    /// Whether nothing passes at `now`.
    #[must_use]
    pub fn dark(&self, now: Duration) -> bool {
        self.dark || self.blackouts.dark(now)
    }

    /// Sends a packet of so many bytes.
    ///
    /// In a blackout it is lost; what was sent before a blackout still arrives. What is lost by chance has taken its
    /// time at the bottleneck, as on a radio link behind a router.
    pub fn send(&mut self, now: Duration, bytes: usize) -> Fate {
        let chance = self.roll();
        if self.dark(now) {
            return Fate::Lost(Cause::Blackout);
        }
        // A packet may be larger than the queue, if nothing waits in front of it.
        if self.line_free > now && !self.room(now, bytes).is_zero() {
            return Fate::Lost(Cause::Queue);
        }
        let sent = self.transmit(now, bytes);
        if chance.lost {
            return Fate::Lost(Cause::Chance);
        }
        let at = self.arrival(sent, &chance);
        Fate::Arrives { at, copy: chance.copy.map(|jitter| at.max(sent + self.impairment.delay_at(jitter))) }
    }

    /// Sends a segment of a byte stream, as TCP would: late instead of never.
    ///
    /// A lost one arrives a round trip (twice this direction's delay) and 200 ms later, the wait of Linux before it
    /// sends again; after each further loss it waits twice as long. All behind it have to wait, which is the caller's
    /// to do: the model knows no connections. In a blackout, of the schedule, nothing starts and nothing arrives; one
    /// by command is the caller's to keep. Windows, fast retransmission and congestion control are not modelled, and
    /// the queue drops nothing: wait for [`Self::room`] first.
    pub fn send_segment(&mut self, now: Duration, bytes: usize) -> Segment {
        let chance = self.roll();
        let sent = self.transmit(self.blackouts.lit_after(now), bytes);
        let mut at = self.arrival(sent, &chance);
        let mut wait = 2 * self.impairment.delay + MIN_RTO;
        let (mut lost, mut losses) = (chance.lost, 0);
        while lost && losses < MAX_LOSSES {
            at += wait;
            wait *= 2;
            losses += 1;
            lost = self.again.roll() < self.impairment.loss;
        }
        Segment { at: self.blackouts.lit_after(at), losses }
    }

    /// How long it takes until the queue has room for so many bytes.
    #[must_use]
    pub fn room(&self, now: Duration, bytes: usize) -> Duration {
        let space = self.impairment.queue.saturating_sub(bytes);
        self.line_free.saturating_sub(now).saturating_sub(self.impairment.passing(space as f64))
    }

    /// Always as many rolls, so that changing one probability leaves the others' be.
    fn roll(&mut self) -> Chance {
        let [loss, reorder, duplicate] = std::array::from_fn(|_| self.dice.roll());
        let (fresh, copy) = (self.dice.normal(), self.dice.normal());
        let Impairment { burst, jitter_correlation, .. } = self.impairment;
        self.wave = jitter_correlation * self.wave + (1.0 - jitter_correlation * jitter_correlation).sqrt() * fresh;
        self.in_burst = loss < self.loss_after(burst);
        Chance {
            lost: self.in_burst,
            held_back: reorder < self.impairment.reorder,
            jitter: self.wave,
            copy: (duplicate < self.impairment.duplicate).then_some(copy),
        }
    }

    /// How probable it is that the next packet is lost.
    ///
    /// Gilbert's model, two states: one loses all, the other nothing. Its stay in the first is `burst` packets in the
    /// mean, and its share of the time is `loss`.
    fn loss_after(&self, burst: Option<f64>) -> f64 {
        let loss = self.impairment.loss;
        let Some(burst) = burst.filter(|_| loss < 1.0) else { return loss };
        let burst = burst.max(1.0);
        if self.in_burst { 1.0 - 1.0 / burst } else { loss / (burst * (1.0 - loss)) }
    }

    /// Takes the bottleneck; when it is left.
    fn transmit(&mut self, now: Duration, bytes: usize) -> Duration {
        self.line_free = self.line_free.max(now) + self.impairment.passing(bytes as f64);
        self.line_free
    }

    /// When a packet arrives that has left the bottleneck.
    fn arrival(&mut self, sent: Duration, chance: &Chance) -> Duration {
        let at = self.last_arrival.max(sent + self.impairment.delay_at(chance.jitter));
        if chance.held_back {
            return at + self.impairment.reorder_by;
        }
        self.last_arrival = at;
        at
    }
}
