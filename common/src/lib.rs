//! Pure core of the hand teleoperation service.
//!
//! Nothing here touches a socket, a file, a clock or a thread: time and bytes are arguments, so the same code runs
//! in the live processes and in tests with virtual time. The two shells that do touch the outside are opt-in:
//! `net` (zenoh) and `viz` (Rerun).
//!
//! | module | one line |
//! |---|---|
//! | [`authority`] | who moves the robot, and when: lease, clutch, watchdog, stop |
//! | [`hand`] | the robot hand: URDF + description to a flat [`hand::HandModel`], forward kinematics, Jacobians |
//! | [`master`] | the human hand: the paradigmatic 20-joint model, keypoint fit, calibration, gestures |
//! | [`mapping`] | the combined joint-Cartesian mapping, Eq. 1-14 |
//! | [`conditioner`] | from targets that may jump to commands within the limits |
//! | [`closing`] | contacts first: tips that cannot keep up meet before they take up their postures |
//! | [`guard`] | keeps fingertips, links and palm out of each other |
//! | [`ik`] | bounded lexicographic inverse kinematics of one finger |
//! | [`paper`] | the paper's tables and figures as numbers |
//! | [`mode`] | what the robot is doing |
//! | [`key`] | key expressions of a robot |
//! | [`wire`] | the binary messages and their one codec door |
//! | [`playout`] | poses that arrive unevenly, played evenly |
//! | [`quality`] | how well the robot followed a recorded hand, in figures |
//! | [`recording`] | recordings of a human hand, line by line: CSV of keypoints, JSON lines |
//! | [`time`] | monotonic time as a number, clock offset, latency histogram |
//! | [`testing`] | where tests find recordings |

pub mod authority;
pub mod closing;
pub mod conditioner;
pub mod guard;
pub mod hand;
pub mod ik;
pub mod key;
pub mod mapping;
pub mod master;
pub mod mode;
#[cfg(feature = "net")]
pub mod net;
pub mod paper;
pub mod playout;
pub mod quality;
pub mod recording;
pub mod testing;
pub mod time;
#[cfg(feature = "viz")]
pub mod viz;
pub mod wire;
