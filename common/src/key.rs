//! Key expressions: where on the network each stream of a robot lives.
//!
//! All of a robot's keys begin with `allegro/v1/<name>/`. The major protocol version is part of the key, so peers of
//! two majors on one network never meet.

use thiserror::Error;

/// Longest robot name, characters.
pub const MAX_NAME: usize = 32;
/// What all keys begin with.
pub(crate) const ROOT: &str = "allegro/v1";

/// A robot name that is not one.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
#[error("robot name {0:?} is not valid: use 1 to 32 of a-z, 0-9, '_' and '-', beginning with a letter or digit")]
pub struct NameError(String);

/// The keys of one robot.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Keys {
    name: String,
}

impl Keys {
    /// Keys of the robot `name` (`[a-z0-9][a-z0-9_-]{0,31}`: one plain chunk, no wildcard can get in).
    ///
    /// # Errors
    /// [`NameError`] with the name.
    pub fn new(name: &str) -> Result<Self, NameError> {
        let plain = |byte: u8| byte.is_ascii_lowercase() || byte.is_ascii_digit();
        let valid = name.len() <= MAX_NAME
            && name.bytes().next().is_some_and(plain)
            && name.bytes().all(|byte| plain(byte) || byte == b'_' || byte == b'-');
        if valid {
            Ok(Self { name: name.to_owned() })
        } else {
            Err(NameError(name.chars().take(2 * MAX_NAME).collect()))
        }
    }

    /// The robot's name.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Master poses, operator to robot: [`crate::wire::PoseMessage`].
    #[must_use]
    pub fn pose(&self) -> String {
        self.key("cmd/pose")
    }

    /// Stops, from anybody who may watch to the robot: [`crate::wire::ControlMessage`].
    #[must_use]
    pub fn stop(&self) -> String {
        self.key("cmd/stop")
    }

    /// Resets of a stop, from who may drive to the robot: [`crate::wire::ControlMessage`]. A key of its own, so that
    /// access to it can be.
    #[must_use]
    pub fn reset(&self) -> String {
        self.key("cmd/reset")
    }

    /// Joint state, robot to all: [`crate::wire::JointStateMessage`].
    #[must_use]
    pub fn joints(&self) -> String {
        self.key("state/joints")
    }

    /// Signals of the mapping, robot to all: [`crate::wire::MappingMessage`].
    #[must_use]
    pub fn mapping(&self) -> String {
        self.key("state/mapping")
    }

    /// Health, robot to all: [`crate::wire::HealthMessage`].
    #[must_use]
    pub fn health(&self) -> String {
        self.key("state/health")
    }

    /// Query that the robot answers with its description, JSON.
    #[must_use]
    pub fn describe(&self) -> String {
        self.key("srv/describe")
    }

    /// Hand data in JSON from any other program, for the operator.
    #[must_use]
    pub fn hand_input(&self) -> String {
        self.key("in/hand")
    }

    /// The operator's clutch in JSON from any other program (a pedal, a button), for the operator.
    #[must_use]
    pub fn clutch_input(&self) -> String {
        self.key("in/clutch")
    }

    /// Liveliness token of a robot process.
    #[must_use]
    pub fn live_robot(&self, epoch: u64) -> String {
        self.key(&format!("live/robot/{epoch:016x}"))
    }

    /// Liveliness token of an operator process.
    #[must_use]
    pub fn live_operator(&self, epoch: u64) -> String {
        self.key(&format!("live/operator/{epoch:016x}"))
    }

    /// All robot processes of any name that are alive.
    #[must_use]
    pub fn all_live_robots() -> String {
        format!("{ROOT}/*/live/robot/*")
    }

    /// The keys of the robot whose liveliness key this is.
    #[must_use]
    pub fn of_live_robot(key: &str) -> Option<Self> {
        let name = key.strip_prefix(ROOT)?.strip_prefix('/')?.split('/').next()?;
        let keys = Self::new(name).ok()?;
        (keys.live_epoch(key).is_some() && key.contains("/live/robot/")).then_some(keys)
    }

    /// All robot processes of this name that are alive.
    #[must_use]
    pub fn live_robots(&self) -> String {
        self.key("live/robot/*")
    }

    /// All operator processes of this robot that are alive.
    #[must_use]
    pub fn live_operators(&self) -> String {
        self.key("live/operator/*")
    }

    /// The epoch in a liveliness key of this robot, whichever the role.
    #[must_use]
    pub fn live_epoch(&self, key: &str) -> Option<u64> {
        let rest = key.strip_prefix(ROOT)?.strip_prefix('/')?.strip_prefix(&self.name)?;
        let epoch = rest.strip_prefix("/live/robot/").or_else(|| rest.strip_prefix("/live/operator/"))?;
        let valid = epoch.len() == 16 && epoch.bytes().all(|byte| matches!(byte, b'0'..=b'9' | b'a'..=b'f'));
        valid.then(|| u64::from_str_radix(epoch, 16).ok()).flatten()
    }

    fn key(&self, rest: &str) -> String {
        format!("{ROOT}/{}/{rest}", self.name)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names() {
        for name in ["allegro", "a", "0", "left-hand_2", &"a".repeat(32)] {
            assert_eq!(Keys::new(name).unwrap().name(), name);
        }
        for name in ["", "-a", "_a", "A", "a/b", "a*", "**", "$*", "a b", "ä", "a#", "a?", &"a".repeat(33)] {
            let error = Keys::new(name).unwrap_err().to_string();
            assert!(error.contains(&format!("{name:?}")), "{error}");
        }
    }

    #[test]
    fn layout() {
        let keys = Keys::new("allegro").unwrap();
        assert_eq!(keys.pose(), "allegro/v1/allegro/cmd/pose");
        assert_eq!(keys.stop(), "allegro/v1/allegro/cmd/stop");
        assert_eq!(keys.reset(), "allegro/v1/allegro/cmd/reset");
        assert_eq!(keys.joints(), "allegro/v1/allegro/state/joints");
        assert_eq!(keys.mapping(), "allegro/v1/allegro/state/mapping");
        assert_eq!(keys.health(), "allegro/v1/allegro/state/health");
        assert_eq!(keys.describe(), "allegro/v1/allegro/srv/describe");
        assert_eq!(keys.hand_input(), "allegro/v1/allegro/in/hand");
        assert_eq!(keys.live_robot(0xab), "allegro/v1/allegro/live/robot/00000000000000ab");
        assert_eq!(keys.live_epoch(&keys.live_robot(0xab)), Some(0xab));
        assert_eq!(keys.live_epoch(&keys.live_operator(u64::MAX)), Some(u64::MAX));
        assert_eq!(Keys::of_live_robot(&keys.live_robot(0xab)), Some(keys.clone()));
        assert_eq!(Keys::of_live_robot(&keys.live_operator(0xab)), None);
        assert_eq!(Keys::of_live_robot("allegro/v1/A*/live/robot/00000000000000ab"), None);
        assert_eq!(keys.live_epoch("allegro/v1/other/live/robot/00000000000000ab"), None);
        assert_eq!(keys.live_epoch("allegro/v1/allegro/live/robot/+0000000000000ab"), None);
    }
}
