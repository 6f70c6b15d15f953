use std::time::Duration;

use super::{Clutch, Latch};
use crate::mode::Mode;
use crate::time::MonoTime;

/// Longest period of a source that the watchdog makes allowance for.
const MAX_PERIOD: Duration = Duration::from_millis(100);
/// Intervals between poses that are looked at.
const INTERVALS: usize = 8;

/// Times of the machine.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MachineParams {
    /// So long after a pose was due the hand holds still.
    pub hold_after: Duration,
    /// So long after that it relaxes; `None`: never.
    pub relax_after: Option<Duration>,
    /// How long the hand is slower than its limits after the clutch was closed.
    pub engage_ramp: Duration,
}

/// What the machine needs to know of the newest good pose.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Heard {
    /// The operator that sent it.
    pub epoch: u64,
    /// Its number within the epoch.
    pub sequence: u64,
    /// When it was captured, by the operator's clock.
    pub captured: MonoTime,
    /// When it arrived, own clock.
    pub received: MonoTime,
    /// The operator's clutch.
    pub clutch: Clutch,
}

/// The mode and all that changes it; see the module for the table. [`Machine::step`] is called once a tick.
#[derive(Clone, Debug)]
pub struct Machine {
    params: MachineParams,
    mode: Mode,
    // When the mode began.
    since: MonoTime,
    // The operator that the hand follows or may follow, and its clutch: only a later closing engages.
    engaged: Option<(u64, Clutch)>,
    newest: Option<(u64, u64, MonoTime)>,
    intervals: [Duration; INTERVALS],
    holds: u64,
}

impl Machine {
    /// Disarmed.
    #[must_use]
    pub fn new(params: MachineParams) -> Self {
        Self {
            params,
            mode: Mode::Disarmed,
            since: MonoTime(0),
            engaged: None,
            newest: None,
            intervals: [MAX_PERIOD; INTERVALS],
            holds: 0,
        }
    }

    /// The mode since the last step.
    #[must_use]
    pub fn mode(&self) -> Mode {
        self.mode
    }

    /// How often the hand had to hold because poses failed.
    #[must_use]
    pub fn holds(&self) -> u64 {
        self.holds
    }

    /// How long the mode has lasted.
    #[must_use]
    pub fn lasted(&self, now: MonoTime) -> Duration {
        now.since(self.since)
    }

    /// Faulted, for ever.
    pub fn fail(&mut self, now: MonoTime) {
        if self.mode != Mode::Faulted {
            self.enter(Mode::Faulted, now);
        }
    }

    /// How long the newest pose counts: [`MachineParams::hold_after`] and the period of the source, which is the
    /// shortest of the last intervals between captures, so that lost poses do not stretch it.
    #[must_use]
    pub fn patience(&self) -> Duration {
        self.params.hold_after + self.intervals.iter().min().copied().unwrap_or(MAX_PERIOD)
    }

    /// One step: the mode at `now`, with the newest pose that passed the lease (the same again if there is no newer
    /// one) and the stop latch.
    pub fn step(&mut self, now: MonoTime, newest: Option<&Heard>, latch: Latch) -> Mode {
        if self.mode == Mode::Faulted {
            return self.mode;
        }
        if let Some(heard) = newest {
            self.measure(heard);
        }
        let fresh = newest.filter(|heard| now.since(heard.received) <= self.patience());
        let known = fresh.zip(self.engaged).filter(|(heard, (epoch, _))| heard.epoch == *epoch);
        let same = known.is_some();
        let reclosed = known.is_some_and(|(heard, (_, clutch))| heard.clutch.closed_since(clutch));
        let next = if latch.is_stopped() { Mode::Stopped } else { self.next(now, fresh, same, reclosed) };
        let begins = match next {
            Mode::Armed => self.mode != Mode::Armed || !same,
            Mode::Engaging => self.mode != Mode::Engaging || reclosed,
            _ => next != self.mode,
        };
        if begins {
            // From here on only a closing after this moment counts.
            if let (Mode::Armed | Mode::Engaging, Some(heard)) = (next, fresh) {
                self.engaged = Some((heard.epoch, heard.clutch));
            }
            self.holds += u64::from(next == Mode::Holding);
            self.enter(next, now);
        }
        self.mode
    }

    /// The table of the module. `same`: the poses are those of the operator that was armed; `reclosed`: it closed its
    /// clutch since.
    fn next(&self, now: MonoTime, fresh: Option<&Heard>, same: bool, reclosed: bool) -> Mode {
        use Mode::{Armed, Disarmed, Engaged, Engaging, Holding, Relaxed, Stopped};
        let open = !fresh.is_some_and(|heard| heard.clutch.is_closed());
        let lasted = self.lasted(now);
        match (self.mode, fresh.is_some()) {
            (Stopped, _) | (Disarmed | Armed, false) => Disarmed,
            (Disarmed, true) => Armed,
            (Engaging | Engaged, false) => Holding,
            (Armed | Engaging | Engaged | Holding | Relaxed, true) if reclosed => Engaging,
            (Engaging | Engaged | Holding | Relaxed, true) if open || !same => Armed,
            (Engaging, true) if lasted >= self.params.engage_ramp => Engaged,
            (Holding, _) if self.params.relax_after.is_some_and(|after| lasted >= after) => Relaxed,
            (mode, _) => mode,
        }
    }

    fn measure(&mut self, heard: &Heard) {
        match self.newest {
            Some((epoch, sequence, _)) if (epoch, sequence) == (heard.epoch, heard.sequence) => return,
            Some((epoch, _, captured)) if epoch == heard.epoch => {
                self.intervals.rotate_left(1);
                self.intervals[INTERVALS - 1] = heard.captured.since(captured).min(MAX_PERIOD);
            }
            _ => self.intervals = [MAX_PERIOD; INTERVALS],
        }
        self.newest = Some((heard.epoch, heard.sequence, heard.captured));
    }

    fn enter(&mut self, mode: Mode, now: MonoTime) {
        self.mode = mode;
        self.since = now;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: u64 = 1_000_000;
    const RUNNING: Latch = Latch { asked: 0, reset: 0 };

    /// A machine in virtual time; poses arrive every 10 ms unless the operator is silent.
    struct Bench {
        machine: Machine,
        now: u64,
        heard: Option<Heard>,
        latch: Latch,
    }

    impl Bench {
        fn new() -> Self {
            let params = MachineParams {
                hold_after: Duration::from_millis(100),
                relax_after: Some(Duration::from_secs(5)),
                engage_ramp: Duration::from_secs(1),
            };
            Self { machine: Machine::new(params), now: 1000, heard: None, latch: RUNNING }
        }

        /// Ticks every 2 ms for `time` ms while `operator` sends with this clutch (or nobody sends).
        fn run(&mut self, time: u64, operator: Option<(u64, u32)>) -> Mode {
            let end = self.now + time;
            while self.now < end {
                self.now += 2;
                if let Some((epoch, clutch)) = operator
                    && self.now.is_multiple_of(10)
                {
                    let at = MonoTime(self.now * MS);
                    let sequence = self.heard.map_or(1, |heard| heard.sequence + 1);
                    self.heard = Some(Heard { epoch, sequence, captured: at, received: at, clutch: Clutch(clutch) });
                }
                self.machine.step(MonoTime(self.now * MS), self.heard.as_ref(), self.latch);
            }
            self.machine.mode()
        }
    }

    #[test]
    fn the_usual_course() {
        let mut bench = Bench::new();
        assert_eq!(bench.run(50, None), Mode::Disarmed);
        assert_eq!(bench.run(50, Some((7, 0))), Mode::Armed);
        assert_eq!(bench.run(500, Some((7, 1))), Mode::Engaging);
        assert_eq!(bench.run(600, Some((7, 1))), Mode::Engaged);
        assert_eq!(bench.run(20, Some((7, 2))), Mode::Armed);
        assert_eq!(bench.run(20, Some((7, 3))), Mode::Engaging);
        assert_eq!((bench.machine.holds(), bench.run(300, None)), (0, Mode::Holding));
        assert_eq!(bench.machine.holds(), 1);
    }

    #[test]
    fn a_clutch_that_is_closed_all_the_time_engages_nothing() {
        let mut bench = Bench::new();
        assert_eq!(bench.run(2000, Some((7, 1))), Mode::Armed, "closed before the robot was there");
        assert_eq!(bench.run(20, Some((7, 2))), Mode::Armed);
        assert_eq!(bench.run(2000, Some((7, 3))), Mode::Engaged);
        assert_eq!(bench.run(500, None), Mode::Holding);
        assert_eq!(bench.run(2000, Some((7, 3))), Mode::Holding, "poses are back, the clutch was not moved");
        assert_eq!(bench.run(20, Some((7, 5))), Mode::Engaging, "opened and closed; the message in between was lost");
        bench.latch = bench.latch.stop();
        assert_eq!(bench.run(20, Some((7, 5))), Mode::Stopped);
        assert_eq!(bench.run(20, Some((7, 7))), Mode::Stopped);
        bench.latch = bench.latch.reset(1);
        assert_eq!(bench.run(2000, Some((7, 7))), Mode::Armed, "closed during the stop");
        assert_eq!(bench.run(20, Some((7, 9))), Mode::Engaging);
        // Another operator, whose clutch was closed elsewhere.
        assert_eq!(bench.run(2000, Some((8, 1))), Mode::Armed);
    }

    #[test]
    fn the_watchdog_waits_for_a_period_and_its_time_and_not_longer() {
        let mut bench = Bench::new();
        bench.run(200, Some((7, 0)));
        bench.run(2000, Some((7, 1)));
        assert_eq!(bench.machine.patience(), Duration::from_millis(110));
        let last = bench.heard.unwrap().received.0 / MS;
        assert_eq!(bench.run(last + 110 - bench.now, None), Mode::Engaged);
        assert_eq!(bench.run(2, None), Mode::Holding);
        // Lost poses do not make it wait longer.
        let mut bench = Bench::new();
        bench.run(200, Some((7, 0)));
        for _ in 0..20 {
            bench.run(10, Some((7, 1)));
            bench.run(50, None);
        }
        bench.run(20, Some((7, 1)));
        assert_eq!(bench.machine.patience(), Duration::from_millis(110));
    }

    #[test]
    fn a_long_hold_relaxes_and_ends_like_any_other() {
        let mut bench = Bench::new();
        bench.run(50, Some((7, 0)));
        bench.run(2000, Some((7, 1)));
        assert_eq!(bench.run(5000, None), Mode::Holding);
        assert_eq!(bench.run(200, None), Mode::Relaxed);
        assert_eq!(bench.run(50, Some((7, 1))), Mode::Relaxed);
        assert_eq!(bench.run(50, Some((7, 3))), Mode::Engaging);
        assert_eq!(bench.run(300, None), Mode::Holding);
        assert_eq!(bench.run(50, Some((7, 4))), Mode::Armed);
    }

    #[test]
    fn a_fault_is_for_ever() {
        let mut bench = Bench::new();
        bench.run(2000, Some((7, 0)));
        bench.machine.fail(MonoTime(bench.now * MS));
        assert_eq!(bench.run(2000, Some((7, 1))), Mode::Faulted);
        bench.latch = bench.latch.stop();
        assert_eq!(bench.run(20, Some((7, 3))), Mode::Faulted);
    }
}
