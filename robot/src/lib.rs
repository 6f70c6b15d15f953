//! The `robot` process: takes hand poses from the network and drives a hand with them.
//!
//! | module | one line |
//! |---|---|
//! | [`control`] | the tick: gate, watchdog, mapping, conditioning; pure |
//! | [`driver`] | the joint interface of a hand; the simulated hand |
//! | [`runtime`] | the real-time thread around the tick |
//! | [`config`] | configuration, checked |

pub mod config;
pub mod control;
pub mod driver;
pub mod runtime;
