//! A bad network on demand.
//!
//! [`LinkModel`] is one direction of a link without any I/O: packets and times in, times of arrival or losses out, the
//! same again for the same seed. A [`Relay`] stands between two processes, UDP or TCP, and treats their traffic as two
//! such models say.
//!
//! ```
//! use std::time::Duration;
//! use teleop_link::{Fate, Profile};
//!
//! let poor: Profile = "poor".parse()?;
//! let [mut up, _down] = poor.link().models(1);
//! match up.send(Duration::from_millis(10), 200) {
//!     Fate::Arrives { at, .. } => assert!(at >= Duration::from_millis(70)),
//!     Fate::Lost(cause) => println!("{cause:?}"),
//! }
//! # Ok::<(), teleop_link::Invalid>(())
//! ```
//!
//! | module | one line |
//! |---|---|
//! | [`impairment`] | what one direction of a link does to packets, as figures |
//! | [`blackout`] | when nothing passes |
//! | [`dice`] | seeded chance |
//! | [`model`] | the model: what happens to each packet |
//! | [`profile`] | named links: both directions, with typical figures |
//! | [`endpoint`] | `udp/host:port` and its address |
//! | [`relay`] | the relay between real sockets |
//! | [`cli`] | the command line of the binary `teleop-link` |

pub mod blackout;
pub mod cli;
pub mod dice;
pub mod endpoint;
pub mod impairment;
pub mod model;
pub mod profile;
pub mod relay;

pub use blackout::Blackouts;
pub use dice::Dice;
pub use endpoint::Endpoint;
pub use impairment::{Impairment, Shape};
pub use model::{Cause, Direction, Fate, LinkModel};
pub use profile::{Link, Profile};
pub use relay::{Counts, Relay, Stats};

/// A figure that makes no sense, or text that is not understood.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub struct Invalid(pub String);
