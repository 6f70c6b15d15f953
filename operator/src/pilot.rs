//! The operator's end of the authority: the clutch, and what the robot is asked besides poses.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use clap::ValueEnum;
use teleop_common::authority::{Clutch, ClutchInput, Intent, OperatorName};
use teleop_common::mode::Mode;
use teleop_common::time::MonoTime;

/// How the clutch is moved.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum ClutchBy {
    /// SPACE on the terminal closes and opens it
    Key,
    /// Closed while SPACE is held (it opens 0.6 s after the last repeat of the key)
    Hold,
    /// Any program closes and opens it: JSON on the Zenoh key allegro/v1/NAME/in/clutch
    Input,
    /// Closed as soon as the robot is ready, once; after a hold it stays open until it is closed on purpose
    Start,
    /// Closed whenever the robot is ready, after a hold too: for demonstrations, not for a hand near people
    Auto,
}

/// A held key repeats at least this often.
const KEY_HELD: Duration = Duration::from_millis(600);
/// A robot that may follow does so within this time, or the closing was in vain.
const IN_VAIN: Duration = Duration::from_millis(1500);
/// How long the robot must have been ready after a hold before [`ClutchBy::Auto`] closes again.
const AGAIN: Duration = Duration::from_secs(1);

/// The clutch and its rules; shared by all who move it. No clocks and no threads in here.
#[derive(Clone, Debug)]
pub struct Pilot(Arc<Mutex<State>>);

#[derive(Clone, Debug)]
struct State {
    by: ClutchBy,
    intent: Intent,
    moved: MonoTime,
    opens: Option<MonoTime>,
    // Since it was closed, the robot followed.
    followed: bool,
    ready: Option<MonoTime>,
    closings: u32,
}

impl Pilot {
    /// The clutch is open.
    #[must_use]
    pub fn new(by: ClutchBy, operator: OperatorName, takeover: bool) -> Self {
        let intent = Intent { clutch: Clutch::default(), takeover, leaving: false, operator };
        Self(Arc::new(Mutex::new(State {
            by,
            intent,
            moved: MonoTime(0),
            opens: None,
            followed: false,
            ready: None,
            closings: 0,
        })))
    }

    /// What goes out with the next pose.
    #[must_use]
    pub fn intent(&self) -> Intent {
        self.lock().intent
    }

    /// SPACE was typed.
    pub fn on_space(&self, now: MonoTime) {
        let mut state = self.lock();
        if state.by == ClutchBy::Hold {
            state.close(now, Some(now + KEY_HELD));
        } else if state.intent.clutch.is_closed() {
            state.open(now);
        } else {
            state.close(now, None);
        }
    }

    /// Another program moves the clutch, in JSON, see [`ClutchInput`].
    ///
    /// # Errors
    /// What is wrong with the message; nothing changes then.
    pub fn on_input(&self, bytes: &[u8], now: MonoTime) -> Result<(), String> {
        let input = ClutchInput::parse(bytes)?;
        let mut state = self.lock();
        if input.closed {
            state.close(now, input.lasts.map(|lasts| now + lasts));
        } else {
            state.open(now);
        }
        Ok(())
    }

    /// Follows what the robot does: `robot` is its mode and whether this operator has it, `None` while it is silent.
    pub fn step(&self, now: MonoTime, robot: Option<(Mode, bool)>) {
        let mut state = self.lock();
        let follows = robot.is_some_and(|(mode, mine)| mine && mode.follows());
        let ready = robot == Some((Mode::Armed, true));
        state.ready = if ready { state.ready.or(Some(now)) } else { None };
        if state.intent.clutch.is_closed() {
            let in_vain = robot.is_some() && now.since(state.moved) > IN_VAIN;
            if follows {
                state.followed = true;
            } else if state.followed && robot.is_some() || in_vain || state.opens.is_some_and(|at| now > at) {
                // What people see is what the robot does: it stopped following, so the clutch is open.
                state.open(now);
            }
            if state.opens.is_some_and(|at| now > at) {
                state.open(now);
            }
            return;
        }
        let waited = state.ready.is_some_and(|since| state.closings == 0 || now.since(since) >= AGAIN);
        match state.by {
            ClutchBy::Start if ready && state.closings == 0 => state.close(now, None),
            ClutchBy::Auto if waited => state.close(now, None),
            _ => {}
        }
    }

    /// The last message of this operator: the clutch is open and the robot is free.
    #[must_use]
    pub fn farewell(&self, now: MonoTime) -> Intent {
        let mut state = self.lock();
        state.open(now);
        state.by = ClutchBy::Key;
        state.intent.leaving = true;
        state.intent
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl State {
    fn close(&mut self, now: MonoTime, opens: Option<MonoTime>) {
        self.opens = opens;
        if !self.intent.clutch.is_closed() {
            self.intent.clutch = self.intent.clutch.close();
            self.moved = now;
            self.followed = false;
            self.closings += 1;
        }
    }

    fn open(&mut self, now: MonoTime) {
        self.opens = None;
        if self.intent.clutch.is_closed() {
            self.intent.clutch = self.intent.clutch.open();
            self.moved = now;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ms(ms: u64) -> MonoTime {
        MonoTime(ms * 1_000_000)
    }

    fn pilot(by: ClutchBy) -> Pilot {
        Pilot::new(by, OperatorName::default(), false)
    }

    fn closed(pilot: &Pilot) -> bool {
        pilot.intent().clutch.is_closed()
    }

    const READY: Option<(Mode, bool)> = Some((Mode::Armed, true));
    const FOLLOWS: Option<(Mode, bool)> = Some((Mode::Engaged, true));
    const HOLDS: Option<(Mode, bool)> = Some((Mode::Holding, true));

    #[test]
    fn space_toggles_and_a_hold_opens() {
        let pilot = pilot(ClutchBy::Key);
        pilot.step(ms(0), READY);
        assert!(!closed(&pilot));
        pilot.on_space(ms(10));
        pilot.step(ms(20), READY);
        assert!(closed(&pilot), "the robot has not answered yet");
        pilot.step(ms(30), FOLLOWS);
        pilot.step(ms(40), HOLDS);
        assert!(!closed(&pilot));
        pilot.on_space(ms(50));
        assert_eq!(pilot.intent().clutch, Clutch(3));
        pilot.on_space(ms(60));
        assert!(!closed(&pilot));
    }

    #[test]
    fn closing_in_vain_opens_again() {
        let pilot = pilot(ClutchBy::Key);
        pilot.on_space(ms(0));
        pilot.step(ms(1400), Some((Mode::Armed, false)));
        assert!(closed(&pilot));
        pilot.step(ms(1600), Some((Mode::Armed, false)));
        assert!(!closed(&pilot));
    }

    #[test]
    fn a_held_key_and_a_pedal_open_by_themselves() {
        let pilot = pilot(ClutchBy::Hold);
        for at in [0, 500, 540, 580] {
            pilot.on_space(ms(at));
            pilot.step(ms(at + 10), FOLLOWS);
            assert!(closed(&pilot));
        }
        pilot.step(ms(1170), FOLLOWS);
        assert!(closed(&pilot));
        pilot.step(ms(1190), FOLLOWS);
        assert!(!closed(&pilot));
        assert_eq!(pilot.on_input(b"{\"closed\": true, \"for\": 0.2}", ms(2000)), Ok(()));
        pilot.step(ms(2190), FOLLOWS);
        assert!(closed(&pilot));
        pilot.step(ms(2210), FOLLOWS);
        assert!(!closed(&pilot));
        for bad in [&b"{}"[..], b"{\"closed\": 1}", b"{\"closed\": true, \"for\": -1}", b"\xff"] {
            assert!(pilot.on_input(bad, ms(3000)).is_err());
            assert!(!closed(&pilot));
        }
    }

    #[test]
    fn start_closes_once_and_auto_again_and_again() {
        let start = pilot(ClutchBy::Start);
        let auto = pilot(ClutchBy::Auto);
        for pilot in [&start, &auto] {
            pilot.step(ms(0), Some((Mode::Disarmed, false)));
            assert!(!closed(pilot));
            pilot.step(ms(10), READY);
            assert!(closed(pilot));
            pilot.step(ms(20), FOLLOWS);
            pilot.step(ms(30), HOLDS);
            assert!(!closed(pilot));
            pilot.step(ms(40), READY);
            assert!(!closed(pilot));
            pilot.step(ms(1050), READY);
        }
        assert!(!closed(&start) && closed(&auto));
        assert!(auto.farewell(ms(1060)).leaving && !closed(&auto));
        auto.step(ms(9000), READY);
        assert!(!closed(&auto));
    }
}
