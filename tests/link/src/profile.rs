//! Named links.

use std::fmt;
use std::str::FromStr;
use std::time::Duration;

use serde_json::{Value, json};

use crate::{Blackouts, Direction, Impairment, Invalid, LinkModel, Shape};

/// Both directions of a link. The default does nothing.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Link {
    /// To the target: from the operator to the robot.
    pub up: Impairment,
    /// Back.
    pub down: Impairment,
    /// When nothing passes in either direction.
    pub blackouts: Blackouts,
}

impl Link {
    /// The models of both directions, up and down.
    #[must_use]
    pub fn models(&self, seed: u64) -> [LinkModel; 2] {
        [Direction::Up, Direction::Down]
            .map(|direction| LinkModel::new(*self.way(direction), self.blackouts.clone(), seed, direction))
    }

    /// One direction.
    #[must_use]
    pub const fn way(&self, direction: Direction) -> &Impairment {
        match direction {
            Direction::Up => &self.up,
            Direction::Down => &self.down,
        }
    }

    /// Checks every figure.
    ///
    /// # Errors
    /// What is wrong, with its value and its range.
    pub fn check(&self) -> Result<(), Invalid> {
        self.up.check()?;
        self.down.check()
    }

    /// The figures, for machines.
    #[must_use]
    pub fn json(&self) -> Value {
        json!({ "up": self.up.json(), "down": self.down.json(), "blackouts": self.blackouts.to_string() })
    }
}

/// The same in both directions.
impl From<Impairment> for Link {
    fn from(impairment: Impairment) -> Self {
        Self { up: impairment, down: impairment, blackouts: Blackouts::default() }
    }
}

/// In words.
impl fmt::Display for Link {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (up, down) = (&self.up, &self.down);
        match (up.rate, down.rate) {
            _ if up == down => write!(f, "each way {up}")?,
            (Some(rate_up), Some(rate_down)) if *up == (Impairment { rate: up.rate, ..*down }) => {
                let rest = Impairment { rate: None, ..*up };
                write!(f, "each way {rest}, {} Mbit/s up, {} down", rate_up / 1e6, rate_down / 1e6)?;
            }
            _ => write!(f, "up {up}; down {down}")?,
        }
        if !self.blackouts.is_empty() {
            write!(f, "; dark {} s", self.blackouts)?;
        }
        Ok(())
    }
}

/// A named link.
///
/// The figures are typical ones, chosen by us to span what such a connection does on an ordinary day; none is a
/// measurement of a certain network. What a geostationary link cannot beat is physics: 35,786 km up and down again,
/// 240 ms at the speed of light.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Profile {
    /// What `--wan` takes.
    pub name: &'static str,
    /// What it stands for.
    pub about: &'static str,
}

impl Profile {
    /// All of them, from good to bad.
    pub const ALL: [Self; 8] = [
        Self { name: "perfect", about: "nothing is done to any packet" },
        Self { name: "lan", about: "one room: gigabit Ethernet behind a switch" },
        Self { name: "wifi", about: "one room: a shared radio channel, a heavy tail of delays, short bursts of loss" },
        Self { name: "good", about: "fibre at both ends, within a country" },
        Self { name: "fair", about: "DSL or LTE at one end, between cities" },
        Self { name: "poor", about: "a busy mobile network: slow, losing bursts, a heavy tail of delays" },
        Self { name: "satellite", about: "a geostationary satellite" },
        Self { name: "lossy30", about: "a stress test: 30 % loss, 50 +- 20 ms; no network in use is like that" },
    ];

    /// Its figures.
    #[must_use]
    pub fn link(&self) -> Link {
        let base = Impairment::default();
        let mbit = |rate: f64| Some(rate * 1e6);
        match self.name {
            "lan" => Impairment { delay: ms(0.2), jitter: ms(0.05), rate: mbit(1000.0), queue: 512_000, ..base }.into(),
            "wifi" => Impairment {
                delay: ms(2.0),
                jitter: ms(2.0),
                shape: Shape::Pareto,
                jitter_correlation: 0.5,
                loss: 0.002,
                burst: Some(2.0),
                rate: mbit(100.0),
                queue: 256_000,
                ..base
            }
            .into(),
            "good" => {
                let up = Impairment {
                    delay: ms(10.0),
                    jitter: ms(1.0),
                    shape: Shape::Normal,
                    jitter_correlation: 0.5,
                    loss: 0.0001,
                    rate: mbit(50.0),
                    queue: 128_000,
                    ..base
                };
                Link { up, down: Impairment { rate: mbit(100.0), ..up }, ..Link::default() }
            }
            "fair" => {
                let up = Impairment {
                    delay: ms(25.0),
                    jitter: ms(4.0),
                    shape: Shape::Normal,
                    jitter_correlation: 0.7,
                    loss: 0.005,
                    burst: Some(2.0),
                    reorder: 0.001,
                    rate: mbit(10.0),
                    queue: 128_000,
                    ..base
                };
                Link { up, down: Impairment { rate: mbit(20.0), ..up }, ..Link::default() }
            }
            "poor" => {
                let up = Impairment {
                    delay: ms(60.0),
                    jitter: ms(15.0),
                    shape: Shape::Pareto,
                    jitter_correlation: 0.8,
                    loss: 0.03,
                    burst: Some(4.0),
                    reorder: 0.005,
                    duplicate: 0.001,
                    rate: mbit(2.0),
                    queue: 64_000,
                    ..base
                };
                Link { up, down: Impairment { rate: mbit(4.0), ..up }, ..Link::default() }
            }
            "satellite" => {
                let up = Impairment {
                    delay: ms(300.0),
                    jitter: ms(8.0),
                    shape: Shape::Normal,
                    jitter_correlation: 0.8,
                    loss: 0.005,
                    burst: Some(5.0),
                    rate: mbit(2.0),
                    queue: 128_000,
                    ..base
                };
                Link { up, down: Impairment { rate: mbit(10.0), ..up }, ..Link::default() }
            }
            "lossy30" => Impairment { delay: ms(50.0), jitter: ms(20.0), loss: 0.3, ..base }.into(),
            _ => Link::default(),
        }
    }
}

impl FromStr for Profile {
    type Err = Invalid;

    fn from_str(name: &str) -> Result<Self, Invalid> {
        let names = Self::ALL.map(|profile| profile.name).join(", ");
        let found = Self::ALL.into_iter().find(|profile| profile.name == name);
        found.ok_or_else(|| Invalid(format!("{name:?} is none of {names}")))
    }
}

fn ms(time: f64) -> Duration {
    Duration::from_secs_f64(time / 1e3)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_profile_is_sound_and_found_by_name() {
        for (index, profile) in Profile::ALL.into_iter().enumerate() {
            profile.link().check().unwrap();
            assert_eq!(profile.name.parse::<Profile>().unwrap(), profile);
            assert_eq!(profile.link() == Link::default(), index == 0, "{} does nothing", profile.name);
        }
        assert!("bad".parse::<Profile>().unwrap_err().to_string().contains("lossy30"));
    }
}
