//! The `operator` process: streams a human hand to a robot hand.
//!
//! | module | one line |
//! |---|---|
//! | [`source`] | where a hand comes from: gestures, recordings, other programs; pure in time |
//! | [`hand`] | joint angles or keypoints to poses of the master hand |
//! | [`robot_hand`] | the robot hand that a person's hand is tuned for |
//! | [`pipeline`] | the source thread: frames in, poses out |
//! | [`stream`] | the publisher thread behind a latest-value slot |
//! | [`delivery`] | how many poses get lost, and whether each is sent twice |
//! | [`feedback`] | the robot as last heard, round trip, clock offset |
//! | [`robot_link`] | the session with the robot, opened anew when it falls silent |
//! | [`pilot`] | the clutch: when the robot may follow |
//! | [`request`] | stops and resets |
//! | [`lan`] | robots on the local network |
//! | [`terminal`] | the status line |
//! | [`record`] | the recording of what is streamed |
//! | [`run`] | `operator run`: the wiring of the above |
//! | [`calibrate`] | `operator calibrate` |
//! | [`watch`], [`list`] | `operator watch`, `operator list` |
//! | [`shutdown`], [`failure`] | ending in order; ending otherwise, with its exit code |
//! | [`cli`], [`app`] | the command line; logging, signals |

pub mod app;
pub mod calibrate;
pub mod cli;
pub mod delivery;
pub mod failure;
pub mod feedback;
pub mod hand;
pub mod lan;
pub mod list;
pub mod pilot;
pub mod pipeline;
pub mod record;
pub mod request;
pub mod robot_hand;
pub mod robot_link;
pub mod run;
pub mod shutdown;
pub mod source;
pub mod stream;
pub mod terminal;
pub mod watch;
