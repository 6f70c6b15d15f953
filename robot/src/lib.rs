//! The `robot` process: takes hand poses from the network and drives a hand with them.
//!
//! | module | one line |
//! |---|---|
//! | [`control`] | the tick: mode, watchdog, mapping, conditioning; pure |
//! | [`driver`] | the joint interface of a hand; the simulated hand |
//! | [`runtime`] | the real-time thread around the tick |
//! | [`receive`] | poses from the network into the slot of the control loop |
//! | [`telemetry`] | state, mapping and health to the network and the viewer |
//! | [`retarget`] | whole recordings offline |
//! | [`paper`] | the paper's tables and figures |
//! | [`config`] | configuration, checked |
//! | [`cli`], [`app`] | command line; wiring and shutdown |
//! | [`usage`] | what is wrong usage, for the exit code |

pub mod app;
pub mod cli;
pub mod config;
pub mod control;
pub mod driver;
pub mod paper;
pub mod receive;
pub mod retarget;
pub mod runtime;
pub mod telemetry;
pub mod usage;
