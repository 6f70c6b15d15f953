use std::path::PathBuf;
use std::time::Duration;

use zenoh::Config;
use zenoh::config::EndPoint;

use super::error::words;
use super::scout::set_interface;
use super::{Access, NetError, Tls};

/// Silence after which a link counts as dead. zenoh closes it then, and what an outage kept in buffers is lost with
/// it instead of arriving late.
pub const DEFAULT_LEASE: Duration = Duration::from_millis(1000);

/// Time for the handshake of a link: several round trips within a continent.
pub const DEFAULT_OPEN_TIMEOUT: Duration = Duration::from_millis(600);

/// Time between two tries to connect.
pub const RETRY: Duration = Duration::from_millis(100);

/// The link protocols that are built in.
const PROTOCOLS: [&str; 4] = ["tcp", "udp", "tls", "quic"];

/// Longest message zenoh may put together from fragments, bytes.
const MAX_MESSAGE_SIZE: usize = 65_536;

/// What a process is among others.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Role {
    /// It is reached by others, or reaches them, directly.
    #[default]
    Peer,
    /// The endpoints to connect to are routers, and one that does not answer within 3 s is an error. Between two peers of
    /// one router zenoh passes nothing on, because it expects them to reach each other; so of robot and operator one, the
    /// operator, has to be a client.
    Client,
    /// It passes on what others send.
    Router,
}

/// Where a session listens and connects; everything else is set for a robot, not for a data centre.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SessionConfig {
    /// Endpoints to listen on, such as `tcp/127.0.0.1:7447`; port 0 lets the system choose, see
    /// [`super::Session::locators`]. None: nobody can connect to this process.
    pub listen: Vec<String>,
    /// Endpoints to connect to; tried for ever, [`RETRY`] apart, also after a connection was lost.
    pub connect: Vec<String>,
    /// What this process is among others.
    pub role: Role,
    /// Certificates for `tls/` and `quic/` endpoints; both sides of a link must show one.
    pub tls: Option<Tls>,
    /// Who may do what; `None`: anybody who can connect may do anything. Names are known from certificates only, so it
    /// takes [`Self::tls`] and encrypted endpoints.
    pub access: Option<Access>,
    /// A zenoh configuration (JSON5 or YAML) for link options.
    ///
    /// Its endpoints count where the list above is empty. What keeps old commands and strangers out is set over it:
    /// the role, no connections to whoever is discovered, lease, message size, retry.
    pub zenoh_config_file: Option<PathBuf>,
    /// Answer who asks the local network by multicast who is there, on this interface ([`super::scout()`]). It tells
    /// anybody there where this process listens, and nothing else; `None`: say nothing.
    pub lan: Option<String>,
    /// Silence after which a link counts as dead, [`DEFAULT_LEASE`]. Both ends should agree.
    pub lease: Duration,
    /// How long the handshake of a link may take, [`DEFAULT_OPEN_TIMEOUT`]. While nobody answers, a try over UDP or QUIC
    /// takes that long, so a short one finds a link that is back sooner.
    pub open_timeout: Duration,
}

impl Default for SessionConfig {
    fn default() -> Self {
        Self {
            listen: Vec::new(),
            connect: Vec::new(),
            role: Role::Peer,
            tls: None,
            access: None,
            zenoh_config_file: None,
            lan: None,
            lease: DEFAULT_LEASE,
            open_timeout: DEFAULT_OPEN_TIMEOUT,
        }
    }
}

impl SessionConfig {
    /// A session that listens on `endpoints` and connects nowhere.
    pub fn listening<S: Into<String>>(endpoints: impl IntoIterator<Item = S>) -> Self {
        Self { listen: endpoints.into_iter().map(Into::into).collect(), ..Self::default() }
    }

    /// A session that connects to `endpoints` and listens nowhere.
    pub fn connecting<S: Into<String>>(endpoints: impl IntoIterator<Item = S>) -> Self {
        Self { connect: endpoints.into_iter().map(Into::into).collect(), ..Self::default() }
    }

    pub(super) fn zenoh(&self) -> Result<Config, NetError> {
        let mut config = match &self.zenoh_config_file {
            None => Config::default(),
            Some(path) => Config::from_file(path)
                .map_err(|error| NetError::ConfigFile { path: path.clone(), reason: words(&error) })?,
        };
        self.check_security()?;
        // An absent file means "listen nowhere", not zenoh's default of all interfaces.
        if !self.listen.is_empty() || self.zenoh_config_file.is_none() {
            set(&mut config, "listen/endpoints", &endpoints(&self.listen)?)?;
        }
        if !self.connect.is_empty() {
            set(&mut config, "connect/endpoints", &endpoints(&self.connect)?)?;
        }
        let (mode, patience, sessions) = match self.role {
            Role::Peer => ("\"peer\"", "-1", "16"),
            Role::Client => ("\"client\"", "3000", "16"),
            Role::Router => ("\"router\"", "-1", "256"),
        };
        set(&mut config, "mode", mode)?;
        set(&mut config, "scouting/multicast/enabled", if self.lan.is_some() { "true" } else { "false" })?;
        if let Some(interface) = &self.lan {
            set_interface(&mut config, interface)?;
            // Answers alone: nobody is connected to because it was heard.
            set(&mut config, "scouting/multicast/autoconnect", "[]")?;
            set(&mut config, "scouting/multicast/listen", "true")?;
        }
        set(&mut config, "scouting/gossip/enabled", "false")?;
        set(&mut config, "listen/timeout_ms", "0")?;
        set(&mut config, "listen/exit_on_failure", "true")?;
        set(&mut config, "connect/timeout_ms", patience)?;
        set(&mut config, "connect/exit_on_failure", if self.role == Role::Client { "true" } else { "false" })?;
        let every = RETRY.as_millis();
        let retry = format!(r#"{{"period_init_ms": {every}, "period_max_ms": {every}, "period_increase_factor": 1}}"#);
        set(&mut config, "connect/retry", &retry)?;
        set(&mut config, "transport/link/tx/lease", &self.lease.as_millis().to_string())?;
        set(&mut config, "transport/link/rx/max_message_size", &MAX_MESSAGE_SIZE.to_string())?;
        set(&mut config, "transport/unicast/max_sessions", sessions)?;
        set(&mut config, "transport/unicast/open_timeout", &self.open_timeout.as_millis().to_string())?;
        set(&mut config, "transport/unicast/accept_timeout", "3000")?;
        if let Some(tls) = &self.tls {
            set(&mut config, "transport/link/tls", &tls.settings())?;
        }
        if let Some(access) = &self.access {
            set(&mut config, "access_control", &access.settings())?;
        }
        Ok(config)
    }

    /// Whether certificates, access and endpoints go together.
    fn check_security(&self) -> Result<(), NetError> {
        let endpoints = || self.listen.iter().chain(&self.connect);
        match &self.tls {
            Some(tls) => tls.check(!self.listen.is_empty(), !self.connect.is_empty())?,
            // A zenoh configuration may bring its own.
            None if self.zenoh_config_file.is_some() => {}
            None => {
                if let Some(endpoint) = endpoints().find(|endpoint| is_encrypted(endpoint)) {
                    return Err(NetError::NoCertificate { endpoint: endpoint.clone() });
                }
            }
        }
        match (&self.access, &self.tls) {
            (Some(_), None) => Err(NetError::AccessWithoutTls),
            (Some(_), Some(_)) => endpoints()
                .find(|endpoint| !is_encrypted(endpoint))
                .map_or(Ok(()), |endpoint| Err(NetError::AccessUnencrypted { endpoint: endpoint.clone() })),
            (None, _) => Ok(()),
        }
    }
}

fn is_encrypted(endpoint: &str) -> bool {
    endpoint.starts_with("tls/") || endpoint.starts_with("quic/")
}

/// Endpoints as the JSON list that zenoh's settings take.
fn endpoints(list: &[String]) -> Result<String, NetError> {
    let mut out = Vec::new();
    for endpoint in list {
        let refused = |reason| NetError::Endpoint { endpoint: endpoint.clone(), reason };
        let mut parsed = endpoint.parse::<EndPoint>().map_err(|error| refused(words(&error)))?;
        let protocol = parsed.protocol();
        if !PROTOCOLS.contains(&protocol.as_str()) {
            return Err(refused(format!("{protocol} is none of {}", PROTOCOLS.join(", "))));
        }
        // Poses and states as datagrams, the rest as streams, unless the user or the peer wants it otherwise.
        let metadata = parsed.metadata();
        if protocol.as_str() == "quic" && metadata.get("mixed_rel").is_none() && metadata.get("rel").is_none() {
            parsed.metadata_mut().insert("mixed_rel", "auto").map_err(|error| refused(words(&error)))?;
        }
        out.push(parsed.to_string());
    }
    Ok(serde_json::Value::from(out).to_string())
}

pub(super) fn set(config: &mut Config, setting: &'static str, value: &str) -> Result<(), NetError> {
    config.insert_json5(setting, value).map_err(|error| NetError::Setting { setting, reason: words(&error) })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn settings_are_taken() {
        let config = SessionConfig::connecting(["tcp/127.0.0.1:7447"]).zenoh().unwrap();
        let get = |key: &str| config.get_json(key).unwrap();
        assert_eq!(get("mode"), "\"peer\"");
        assert_eq!(get("listen/endpoints"), "[]");
        assert_eq!(get("connect/endpoints"), "[\"tcp/127.0.0.1:7447\"]");
        assert_eq!(get("transport/link/tx/lease"), "1000");
        assert_eq!(get("scouting/multicast/enabled"), "false");
        let config = SessionConfig { lan: Some("lo".to_owned()), ..SessionConfig::default() }.zenoh().unwrap();
        let get = |key: &str| config.get_json(key).unwrap();
        assert_eq!(get("scouting/multicast/enabled"), "true");
        assert_eq!(
            (get("scouting/multicast/autoconnect"), get("scouting/gossip/enabled")),
            ("[]".into(), "false".into())
        );
    }

    #[test]
    fn bad_endpoint_is_named() {
        let error = SessionConfig::listening(["127.0.0.1:7447"]).zenoh().unwrap_err().to_string();
        assert!(error.contains("\"127.0.0.1:7447\"") && error.contains("tcp/"), "{error}");
        let error = SessionConfig::connecting(["http/127.0.0.1:7447"]).zenoh().unwrap_err().to_string();
        assert!(error.contains("http is none of tcp, udp, tls, quic"), "{error}");
    }

    #[test]
    fn quic_is_mixed_unless_said_otherwise() {
        for (given, taken) in [
            ("quic/127.0.0.1:7447", "quic/127.0.0.1:7447?mixed_rel=auto"),
            ("quic/127.0.0.1:7447?rel=0", "quic/127.0.0.1:7447?rel=0"),
            ("quic/127.0.0.1:7447?mixed_rel=0", "quic/127.0.0.1:7447?mixed_rel=0"),
            ("tls/127.0.0.1:7447", "tls/127.0.0.1:7447"),
        ] {
            assert_eq!(endpoints(&[given.to_owned()]).unwrap(), format!("[\"{taken}\"]"));
        }
    }

    #[test]
    fn security_needs_certificates() {
        let config = |listen: &str| SessionConfig::listening([listen]);
        let error = config("quic/127.0.0.1:0").zenoh().unwrap_err().to_string();
        assert!(error.contains("quic/127.0.0.1:0") && error.contains("--tls-cert"), "{error}");
        let open = SessionConfig { access: Some(Access::default()), ..config("tcp/127.0.0.1:0") };
        let error = open.zenoh().unwrap_err().to_string();
        assert!(error.contains("--allow-operator") && error.contains("--tls-ca"), "{error}");
    }

    #[test]
    fn bad_file_is_named() {
        let config = SessionConfig { zenoh_config_file: Some("/nowhere/zenoh.json5".into()), ..Default::default() };
        let error = config.zenoh().unwrap_err().to_string();
        assert!(error.contains("/nowhere/zenoh.json5"), "{error}");
    }
}
