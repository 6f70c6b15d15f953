//! Who moves the robot, and when: leases, clutch, watchdog, stop. Pure state machines; times are arguments.
//!
//! Two halves, because they live in two threads that must not wait for each other:
//!
//! - [`Lease`], on the network's side, decides *whose* messages count and which of them are fresh;
//! - [`Machine`], in the control tick, decides *whether the hand follows*. It is the only place where the mode changes.
//!
//! ```text
//!                    good poses                 clutch closes              ramp over
//!      ┌──────────┐ ───────────► ┌───────┐ ───────────────────► ┌──────────┐ ─────► ┌─────────┐
//!      │ Disarmed │              │ Armed │                      │ Engaging │        │ Engaged │
//!      └──────────┘ ◄─────────── └───────┘ ◄─────────────────── └──────────┘        └─────────┘
//!            ▲       no good pose    ▲   clutch opens, another operator │ ◄───────────────┤
//!            │ reset                 │                                  │   clutch closed anew
//!      ┌─────────┐                   │ clutch open   ┌─────────┐        │                 │
//!      │ Stopped │                   └────────────── │ Holding │ ◄──────┴── no good pose ─┘
//!      └─────────┘                   ▲               └─────────┘ ── clutch closed anew ──► Engaging
//!            ▲ stop, from anywhere   │ clutch open        │ relax_after
//!                                    │               ┌─────────┐
//!      ┌─────────┐                   └────────────── │ Relaxed │ ── clutch closed anew ──► Engaging
//!      │ Faulted │ ◄─ fault, from anywhere, for ever └─────────┘
//!      └─────────┘
//! ```
//!
//! | from | when | to |
//! |---|---|---|
//! | any | the hand, its driver or the arithmetic failed | Faulted |
//! | any but Faulted | a stop is latched | Stopped |
//! | Stopped | the stop is reset | Disarmed |
//! | Disarmed | a good pose | Armed |
//! | Armed | no good pose for [`MachineParams::hold_after`] and a period | Disarmed |
//! | Armed | the clutch is closed, and was not yet when the hand was armed | Engaging |
//! | Engaging | [`MachineParams::engage_ramp`] is over | Engaged |
//! | Engaging, Engaged | no good pose for `hold_after` and a period | Holding |
//! | Engaging, Engaged | the clutch is open, or the poses are another operator's | Armed |
//! | Engaging, Engaged | the clutch was opened and closed between two poses | Engaging, anew |
//! | Holding, Relaxed | good poses, clutch closed anew since | Engaging |
//! | Holding, Relaxed | good poses, clutch open, or another operator's | Armed |
//! | Holding | it lasted for [`MachineParams::relax_after`] | Relaxed |
//!
//! One tick takes at most one of these steps, the first that applies. A *good pose* passed the lease. The hand moves in
//! Engaging and Engaged only (and in Relaxed, if it was told to open then).
//!
//! The clutch is a number in every pose, [`Clutch`]: how often it was moved, odd while it is closed. Messages may be
//! lost, doubled or late: a number says what to do all the same, and an old closing never counts as a new one.

mod clutch;
mod intent;
mod lease;
mod machine;
mod stop;

pub use clutch::{Clutch, ClutchInput};
pub use intent::{Intent, OperatorName, OperatorNameError};
pub use lease::{Claim, Lease, LeaseParams, Takeover};
pub use machine::{Heard, Machine, MachineParams};
pub use stop::{Latch, StopLatch};
