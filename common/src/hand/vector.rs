use std::ops::{Deref, DerefMut};

use super::MAX_JOINTS;

/// One number per joint of a hand, in the hand's wire order; fixed capacity, so copying never allocates.
#[derive(Clone, Copy, PartialEq)]
pub struct JointVector {
    len: usize,
    data: [f64; MAX_JOINTS],
}

impl JointVector {
    /// `len` zeros. Lengths above [`MAX_JOINTS`] are cut to it.
    #[must_use]
    pub fn zeros(len: usize) -> Self {
        Self { len: len.min(MAX_JOINTS), data: [0.0; MAX_JOINTS] }
    }

    /// Copies `values`; values beyond [`MAX_JOINTS`] are left out.
    #[must_use]
    pub fn from_slice(values: &[f64]) -> Self {
        let mut out = Self::zeros(values.len());
        let len = out.len;
        out.data[..len].copy_from_slice(&values[..len]);
        out
    }

    /// True if every value is finite.
    #[must_use]
    pub fn is_finite(&self) -> bool {
        self.iter().all(|value| value.is_finite())
    }
}

impl Deref for JointVector {
    type Target = [f64];

    #[inline]
    fn deref(&self) -> &[f64] {
        &self.data[..self.len]
    }
}

impl DerefMut for JointVector {
    #[inline]
    fn deref_mut(&mut self) -> &mut [f64] {
        &mut self.data[..self.len]
    }
}

impl std::fmt::Debug for JointVector {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_list().entries(self.iter()).finish()
    }
}
