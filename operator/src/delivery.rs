//! How many of the poses get lost on the way, and whether each is therefore sent twice.
//!
//! A hold takes a tenth of a second without any pose: ten losses in a row at 100 Hz, which happens by chance alone where
//! many get lost. With a copy of each, half a period later, it takes twenty. The copy is the same message, so a robot that
//! has it already refuses it as any network's duplicate.

/// Poses that are judged at a time.
const WINDOW: u64 = 100;
/// Share of lost ones from which on copies are sent ...
const BAD: f64 = 0.02;
/// ... until for so many windows in a row it is below half of that.
const CALM: u32 = 10;

/// Judges the link by the robot's own counters. No clock.
#[derive(Clone, Copy, Debug, Default)]
pub struct Delivery {
    // Newest pose and messages arrived when the window began.
    began: Option<(u64, u64)>,
    twice: bool,
    calm: u32,
    lost: f64,
}

impl Delivery {
    /// Takes in what the robot tells: the number of the newest pose that it has accepted, and how many messages with poses
    /// have arrived, accepted or repeated.
    pub fn on_counters(&mut self, newest: u64, arrived: u64) {
        let Some((from, before)) = self.began.filter(|(from, before)| *from <= newest && *before <= arrived) else {
            self.began = Some((newest, arrived));
            return;
        };
        if newest - from < WINDOW {
            return;
        }
        let sent = (newest - from) * if self.twice { 2 } else { 1 };
        self.lost = 1.0 - ((arrived - before) as f64 / sent as f64).min(1.0);
        self.began = Some((newest, arrived));
        self.calm = if self.lost < 0.5 * BAD { self.calm + 1 } else { 0 };
        let twice = if self.twice { self.calm < CALM } else { self.lost >= BAD };
        if twice != self.twice {
            self.twice = twice;
            self.calm = 0;
            // What is under way now was sent both ways.
            self.began = None;
        }
    }

    /// Share of messages lost of late.
    #[must_use]
    pub fn lost(&self) -> f64 {
        self.lost
    }

    /// Whether each pose is to be sent twice.
    #[must_use]
    pub fn twice(&self) -> bool {
        self.twice
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Poses 20 at a time over a link that loses `lost` of 100 messages, for `reports` reports.
    fn run(delivery: &mut Delivery, count: &mut (u64, u64), reports: u32, lost: u64) {
        for _ in 0..reports {
            count.0 += 20;
            let copies = if delivery.twice() { 2 } else { 1 };
            count.1 += 20 * copies * (100 - lost) / 100;
            delivery.on_counters(count.0, count.1);
        }
    }

    #[test]
    fn a_link_that_loses_gets_copies_until_it_is_good_for_long() {
        let (mut delivery, mut count) = (Delivery::default(), (0, 0));
        run(&mut delivery, &mut count, 50, 0);
        assert!(!delivery.twice() && delivery.lost() == 0.0);
        run(&mut delivery, &mut count, 12, 30);
        assert!(delivery.twice(), "{delivery:?}");
        run(&mut delivery, &mut count, 12, 30);
        assert!((delivery.lost() - 0.3).abs() < 0.01 && delivery.twice(), "copies do not hide the loss: {delivery:?}");
        run(&mut delivery, &mut count, 40, 0);
        assert!(delivery.twice(), "not yet");
        run(&mut delivery, &mut count, 30, 0);
        assert!(!delivery.twice(), "{delivery:?}");
    }

    #[test]
    fn a_robot_that_starts_anew_or_an_operator_that_comes_late_is_no_loss() {
        let mut delivery = Delivery::default();
        // The robot had refused everything until then, and had another operator before.
        delivery.on_counters(900, 5000);
        delivery.on_counters(1000, 5100);
        assert!(delivery.lost() == 0.0, "{delivery:?}");
        // Another process, whose counters begin at zero.
        delivery.on_counters(1100, 10);
        delivery.on_counters(1200, 110);
        assert!(!delivery.twice() && delivery.lost() == 0.0, "{delivery:?}");
    }
}
