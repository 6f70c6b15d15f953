use std::path::PathBuf;

use thiserror::Error;

use crate::wire::WireError;

/// Why something on the network did not work. zenoh's own words are at the end of each message.
#[derive(Debug, Error)]
pub enum NetError {
    /// The zenoh configuration file is not one.
    #[error("zenoh configuration {path}: {reason}", path = path.display())]
    ConfigFile {
        /// The file.
        path: PathBuf,
        /// What zenoh says.
        reason: String,
    },
    /// An endpoint is not one.
    #[error("endpoint {endpoint:?} is not valid, write for example tcp/127.0.0.1:7447 or udp/10.0.0.2:7447: {reason}")]
    Endpoint {
        /// The endpoint.
        endpoint: String,
        /// What zenoh says.
        reason: String,
    },
    /// A setting was refused.
    #[error("zenoh does not take the setting {setting}: {reason}")]
    Setting {
        /// Path of the setting.
        setting: &'static str,
        /// What zenoh says.
        reason: String,
    },
    /// A certificate or key cannot be used.
    #[error("certificate file {path}: {reason}", path = path.display())]
    Certificate {
        /// The file.
        path: PathBuf,
        /// Why, and what to do.
        reason: String,
    },
    /// An encrypted endpoint, and no certificates.
    #[error(
        "endpoint {endpoint} is encrypted and needs certificates: give --tls-ca, --tls-cert and --tls-key \
         (deploy/certificates makes some)"
    )]
    NoCertificate {
        /// The endpoint.
        endpoint: String,
    },
    /// Access by names, and nothing to know them by.
    #[error(
        "--allow-operator and --allow-observer go by the names in certificates: give --tls-ca, --tls-cert and \
         --tls-key, and listen on quic/ or tls/"
    )]
    AccessWithoutTls,
    /// Access by names, and an endpoint where nobody shows one.
    #[error(
        "endpoint {endpoint} is not encrypted, so nobody there has a name that --allow-operator or --allow-observer \
         could go by: write quic/ or tls/"
    )]
    AccessUnencrypted {
        /// The endpoint.
        endpoint: String,
    },
    /// The session does not open.
    #[error(
        "cannot open a session listening on {listen:?}, connecting to {connect:?}: is the port taken by another \
         process, or the address not of this machine? Choose another endpoint ({reason})"
    )]
    Open {
        /// Endpoints to listen on.
        listen: Vec<String>,
        /// Endpoints to connect to.
        connect: Vec<String>,
        /// What zenoh says.
        reason: String,
    },
    /// No router is there.
    #[error(
        "no router answers at {connect:?}: is it running, the address right, and the certificate one it takes? ({reason})"
    )]
    NoRouter {
        /// Endpoints to connect to.
        connect: Vec<String>,
        /// What zenoh says.
        reason: String,
    },
    /// A declaration or an exchange on a key failed.
    #[error("cannot {action} {key}: {reason}")]
    Key {
        /// What was tried.
        action: &'static str,
        /// On which key.
        key: String,
        /// What zenoh says.
        reason: String,
    },
    /// The message is not fit to be sent.
    #[error("message for {key} not sent: {error}")]
    Message {
        /// On which key.
        key: String,
        /// Why.
        error: WireError,
    },
    /// Nobody answers a query.
    #[error("nobody answers {key} within {timeout_ms} ms: is the robot running, and are name and endpoint right?")]
    NoAnswer {
        /// The key asked.
        key: String,
        /// For how long, ms.
        timeout_ms: u128,
    },
    /// The answer is longer than anything this side would take.
    #[error("answer to {key} of {found} bytes is longer than {allowed}")]
    LongAnswer {
        /// The key asked.
        key: String,
        /// Length, bytes.
        found: usize,
        /// Longest allowed, bytes.
        allowed: usize,
    },
    /// There is no such network interface.
    #[error("no network interface is called {interface:?}: write auto, an address of this machine, or one of {known}")]
    Interface {
        /// What was given.
        interface: String,
        /// Those that there are.
        known: String,
    },
    /// The local network cannot be asked.
    #[error("cannot look for robots on the local network (interface {interface}): {reason}")]
    Scout {
        /// The interface.
        interface: String,
        /// What zenoh says.
        reason: String,
    },
    /// The session does not close.
    #[error("cannot close the session: {0}")]
    Close(String),
}

impl NetError {
    /// Whether it can be mended on the command line, or in a file named there.
    #[must_use]
    pub const fn is_usage(&self) -> bool {
        matches!(
            self,
            Self::ConfigFile { .. }
                | Self::Endpoint { .. }
                | Self::Setting { .. }
                | Self::Certificate { .. }
                | Self::NoCertificate { .. }
                | Self::AccessWithoutTls
                | Self::Interface { .. }
                | Self::AccessUnencrypted { .. }
        )
    }
}

/// zenoh's words without the places in its source that it appends to them.
pub(super) fn words(error: &impl ToString) -> String {
    let text = error.to_string();
    let mut rest = text.as_str();
    let mut out = String::new();
    while let Some((before, after)) = rest.split_once(" at /") {
        out.push_str(before);
        // The place ends with the line number: `src/tcp.rs:61.`
        rest = after.split_once(".rs:").map_or("", |(_, line)| line.trim_start_matches(|c: char| c.is_ascii_digit()));
        rest = rest.strip_prefix('.').unwrap_or(rest);
    }
    out + rest
}

#[cfg(test)]
mod tests {
    use super::words;

    #[test]
    fn places_are_cut() {
        let text = "Cannot bind: [taken at /a/b-1.0/src/tcp.rs:61.] at /c/unicast.rs:338.";
        assert_eq!(words(&text), "Cannot bind: [taken]");
        assert_eq!(words(&"no place at all"), "no place at all");
        assert_eq!(words(&"cut at /nothing"), "cut");
    }
}
