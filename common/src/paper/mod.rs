//! The tables and figures of the paper, as numbers.
//!
//! Everything here follows from the mapping, the scripted gestures and the hand's model; nothing is stored. The printed
//! figures state neither radii nor postures, so the choices made here are named where they are made, and
//! `mapping/ERRATA.md` says why.
//!
//! | module | one line |
//! |---|---|
//! | [`table1`] | Table 1: phalanx lengths of both hands, c_s and the ratios d |
//! | [`fig2`] | Fig. 2: what each plain mapping loses on fingers of other lengths |
//! | [`fig4`] | Fig. 4: the gain over the distance, corrected and as printed |
//! | [`motion`] | a scripted gesture through the mapping, sample by sample |
//! | [`fig6`] | Fig. 6: taps under joint, Cartesian and combined mapping |
//! | [`fig8`] | Fig. 8: what must hold for the signals of the tripod |
//! | [`smoothness`] | speed, velocity jumps and jerk of a sampled joint motion |

pub mod fig2;
pub mod fig4;
pub mod fig6;
pub mod fig8;
pub mod motion;
pub mod smoothness;
pub mod table1;

/// A statement about computed numbers, with the numbers.
#[derive(Clone, Debug, PartialEq)]
pub struct Check {
    /// Short name, such as `P1`.
    pub name: &'static str,
    /// What is stated.
    pub statement: String,
    /// Whether it holds; `None` if it must not be asserted here, for the reason in the note.
    pub holds: Option<bool>,
    /// The numbers behind it, with their units in the names.
    pub values: Vec<(String, f64)>,
    /// What to know about it; may be empty.
    pub note: String,
}
