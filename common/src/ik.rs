//! Bounded, lexicographic inverse kinematics of one finger.

/// How a solve ended.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum IkStatus {
    /// Not solved: the joint-mapped posture was taken as it is.
    #[default]
    Skipped,
    /// The target is reached.
    Reached,
    /// The target is out of reach; the nearest point found is returned.
    Unreachable,
    /// The iteration budget ran out first; the best point so far is returned.
    Budget,
}

/// What a solve did.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct IkReport {
    /// How it ended.
    pub status: IkStatus,
    /// Iterations used.
    pub iterations: u16,
    /// Distance from the reached tip to the target, m.
    pub residual: f64,
}
