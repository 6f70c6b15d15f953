//! The shell around zenoh: sessions with safe settings, and the few things the two processes do with them.
//!
//! Everything of zenoh's that is unstable is used here and nowhere else. The calls block, and are meant for plain
//! threads; they also work on a multi-threaded tokio runtime (`#[tokio::main(flavor = "multi_thread")]`).
//!
//! Do not call them, nor drop a [`Session`], on a *current-thread* tokio runtime: zenoh panics there. Do not call
//! them from a control or sensor thread: a `put` may wait 1 ms. Do not call them from within a callback: callbacks
//! run on zenoh's receive threads, where network calls can deadlock and slow code delays every other key.
//!
//! There is no queue between the network and a callback. A queue would keep old commands, and zenoh's default one
//! stalls the whole session when it is full.

pub mod clock;
mod config;
mod error;
pub mod keyboard;
mod live;
mod publisher;
mod query;
pub mod runtime;
mod scout;
mod security;
mod session;
mod subscriber;

pub use config::{DEFAULT_LEASE, DEFAULT_OPEN_TIMEOUT, RETRY, Role, SessionConfig};
pub use error::NetError;
pub use live::{LiveToken, LiveWatch};
pub use publisher::{Publisher, Stream};
pub use query::{MAX_ANSWER, Server};
pub use scout::{AUTO_INTERFACE, scout};
pub use security::{Access, Tls};
pub use session::Session;
pub use subscriber::{Arrival, MAX_PAYLOAD, Oversize, Subscriber};
