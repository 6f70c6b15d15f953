//! The network between two cores in virtual time: messages in, messages out when the link model says so.

use std::cmp::Reverse;
use std::collections::BinaryHeap;
use std::time::Duration;

use teleop_common::wire::{MAX_MESSAGE, Message, encode_into};
use teleop_link::{Fate, Link, LinkModel};

/// What zenoh and UDP add to a message, bytes.
const OVERHEAD: usize = 60;

/// A message that arrives.
#[derive(Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Packet {
    /// When, by the world's clock.
    pub at: Duration,
    /// Its place among those that arrive at the same time.
    number: u64,
    /// From the operator to the robot.
    pub up: bool,
    /// The message.
    pub bytes: Vec<u8>,
}

/// A link and what is under way on it.
#[derive(Debug)]
pub struct Network {
    models: [LinkModel; 2],
    packets: BinaryHeap<Reverse<Packet>>,
    number: u64,
    // When the last message of each direction arrives, on a stream.
    last: Option<[Duration; 2]>,
}

impl Network {
    /// Nothing is under way; the same seed gives the same fates.
    #[must_use]
    pub fn new(link: &Link, seed: u64) -> Self {
        Self { models: link.models(seed), packets: BinaryHeap::new(), number: 0, last: None }
    }

    /// The same on a byte stream, as TCP: late instead of never, and all behind it too.
    #[must_use]
    pub fn stream(link: &Link, seed: u64) -> Self {
        Self { last: Some([Duration::ZERO; 2]), ..Self::new(link, seed) }
    }

    /// Sends a message, `up` from operator to robot.
    ///
    /// # Panics
    /// If it is none that can be sent.
    pub fn send<M: Message>(&mut self, now: Duration, up: bool, message: &M) {
        let mut buffer = [0; MAX_MESSAGE];
        let length = encode_into(message, &mut buffer).expect("a message that can be sent");
        let (way, size) = (usize::from(!up), length + OVERHEAD);
        let model = &mut self.models[way];
        let fate = match &mut self.last {
            Some(last) => {
                last[way] = last[way].max(model.send_segment(now, size).at);
                Fate::Arrives { at: last[way], copy: None }
            }
            None => model.send(now, size),
        };
        if let Fate::Arrives { at, copy } = fate {
            for at in [Some(at), copy].into_iter().flatten() {
                self.number += 1;
                let bytes = buffer[..length].to_vec();
                self.packets.push(Reverse(Packet { at, number: self.number, up, bytes }));
            }
        }
    }

    /// When the next message arrives.
    #[must_use]
    pub fn next(&self) -> Option<Duration> {
        self.packets.peek().map(|Reverse(packet)| packet.at)
    }

    /// The next message.
    pub fn take(&mut self) -> Option<Packet> {
        self.packets.pop().map(|Reverse(packet)| packet)
    }
}
