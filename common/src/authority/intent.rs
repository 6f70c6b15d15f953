use serde::{Deserialize, Serialize};
use thiserror::Error;

use super::Clutch;

/// What an operator wants of the robot, told with every pose.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Intent {
    /// Whether the robot may follow.
    pub clutch: Clutch,
    /// Take the robot even though another operator has it.
    pub takeover: bool,
    /// Give the robot back: this is the last pose.
    pub leaving: bool,
    /// Who it is, for people.
    pub operator: OperatorName,
}

/// A name for people: at most 16 printable ASCII characters. Anybody can call itself anything; who may command is
/// decided by certificates and access control.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct OperatorName([u8; Self::MAX]);

/// A name that is not one.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
#[error("operator name {0:?} is not valid: use 1 to 16 printable ASCII characters")]
pub struct OperatorNameError(String);

impl OperatorName {
    /// Longest name, characters.
    pub const MAX: usize = 16;

    /// The name `text`.
    ///
    /// # Errors
    /// It is empty, too long, or not printable ASCII.
    pub fn new(text: &str) -> Result<Self, OperatorNameError> {
        let mut bytes = [0; Self::MAX];
        let valid = (1..=Self::MAX).contains(&text.len()) && text.bytes().all(is_printable);
        if !valid {
            return Err(OperatorNameError(text.chars().take(2 * Self::MAX).collect()));
        }
        bytes[..text.len()].copy_from_slice(text.as_bytes());
        Ok(Self(bytes))
    }

    /// As much of `text` as makes a name: a host's or a user's.
    #[must_use]
    pub fn lossy(text: &str) -> Self {
        let mut bytes = [0; Self::MAX];
        for (slot, byte) in bytes.iter_mut().zip(text.bytes().filter(|byte| is_printable(*byte))) {
            *slot = byte;
        }
        Self(bytes)
    }

    /// Whether all bytes are printable, and zeros after them.
    #[must_use]
    pub fn is_valid(&self) -> bool {
        let length = self.0.iter().take_while(|byte| is_printable(**byte)).count();
        self.0[length..].iter().all(|byte| *byte == 0)
    }

    /// The name; empty for nobody.
    #[must_use]
    pub fn as_str(&self) -> &str {
        let length = self.0.iter().take_while(|byte| is_printable(**byte)).count();
        std::str::from_utf8(&self.0[..length]).unwrap_or("")
    }
}

fn is_printable(byte: u8) -> bool {
    (b' '..=b'~').contains(&byte)
}

impl std::fmt::Display for OperatorName {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.as_str())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names() {
        assert_eq!(OperatorName::new("ada@lab").unwrap().as_str(), "ada@lab");
        assert_eq!(OperatorName::lossy("a-very-long-host-name").as_str(), "a-very-long-host");
        for text in ["", "a-very-long-host-name", "tab\t", "ä"] {
            let error = OperatorName::new(text).unwrap_err().to_string();
            assert!(error.contains(&format!("{text:?}")), "{error}");
        }
        assert!(OperatorName::default().is_valid() && OperatorName::default().as_str().is_empty());
        assert!(!OperatorName([1; 16]).is_valid());
        let mut hole = *b"ada\0x\0\0\0\0\0\0\0\0\0\0\0";
        assert!(!OperatorName(hole).is_valid());
        hole[4] = 0;
        assert!(OperatorName(hole).is_valid());
    }
}
