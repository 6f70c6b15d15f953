use std::fmt;
use std::net::IpAddr;
use std::path::PathBuf;
use std::str::FromStr;

use rerun::external::re_uri::{Origin, ProxyUri};

use super::hub::{GRPC_PORT, HubOptions};

/// Where the picture goes.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Viewer {
    /// The built-in web viewer: host it, or join the one that already answers on the same address.
    Web(HubOptions),
    /// A running viewer (or a hub), by its gRPC address.
    Connect(ViewerUrl),
    /// An `.rrd` file.
    Save(PathBuf),
    /// Nowhere.
    Off,
}

/// Address of a viewer's gRPC server, `rerun+http://HOST:PORT/proxy`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ViewerUrl(ProxyUri);

/// A `--viewer` that cannot be understood.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum ViewerError {
    /// None of the words.
    #[error(
        "viewer {0:?} is unknown: use web, connect=URL (for example connect=192.168.0.5:9876), save=FILE.rrd or off"
    )]
    Unknown(String),
    /// `web=` with something that is no IP address.
    #[error("viewer web={0:?} needs the IP address to serve on, for example web=127.0.0.1 or web=0.0.0.0")]
    Bind(String),
    /// `connect=` with something that is no address.
    #[error("viewer connect={url:?} is no address ({reason}): use HOST, HOST:PORT or rerun+http://HOST:PORT/proxy")]
    Url {
        /// What was given.
        url: String,
        /// Why it is none.
        reason: String,
    },
    /// `save=` without a usable file name.
    #[error("viewer save={0:?} needs a file name that ends in .rrd, for example save=run.rrd")]
    File(String),
}

impl Default for Viewer {
    fn default() -> Self {
        Self::Web(HubOptions::default())
    }
}

impl FromStr for Viewer {
    type Err = ViewerError;

    fn from_str(text: &str) -> Result<Self, ViewerError> {
        let (word, value) = match text.split_once('=') {
            Some((word, value)) => (word, Some(value)),
            None => (text, None),
        };
        match (word, value) {
            ("web", None) => Ok(Self::default()),
            ("web", Some(bind)) => {
                let bind: IpAddr = bind.parse().map_err(|_| ViewerError::Bind(bind.to_owned()))?;
                Ok(Self::Web(HubOptions { bind, ..HubOptions::default() }))
            }
            ("connect", None) => Ok(Self::Connect(ViewerUrl::local(GRPC_PORT))),
            ("connect", Some(url)) => url.parse().map(Self::Connect),
            ("save", Some(file)) if file.len() > 4 && file.ends_with(".rrd") => Ok(Self::Save(PathBuf::from(file))),
            ("save", file) => Err(ViewerError::File(file.unwrap_or_default().to_owned())),
            ("off", None) => Ok(Self::Off),
            _ => Err(ViewerError::Unknown(text.to_owned())),
        }
    }
}

impl fmt::Display for Viewer {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Web(options) if *options == HubOptions::default() => f.write_str("web"),
            Self::Web(options) => write!(f, "web={}", options.bind),
            Self::Connect(url) => write!(f, "connect={url}"),
            Self::Save(path) => write!(f, "save={}", path.display()),
            Self::Off => f.write_str("off"),
        }
    }
}

impl ViewerUrl {
    /// The viewer of this machine.
    pub(super) fn local(port: u16) -> Self {
        let host = std::net::SocketAddr::new(std::net::Ipv4Addr::LOCALHOST.into(), port);
        Self(ProxyUri::new(Origin::from_scheme_and_socket_addr(rerun::external::re_uri::Scheme::RerunHttp, host)))
    }

    /// The viewer at `address`.
    pub(super) fn at(address: std::net::SocketAddr) -> Self {
        Self(ProxyUri::new(Origin::from_scheme_and_socket_addr(rerun::external::re_uri::Scheme::RerunHttp, address)))
    }

    pub(super) fn uri(&self) -> ProxyUri {
        self.0.clone()
    }

    /// `HOST:PORT`, as name resolution wants it.
    pub(super) fn authority(&self) -> String {
        format!("{}:{}", self.0.origin.format_host(), self.0.origin.port)
    }
}

impl fmt::Display for ViewerUrl {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(f)
    }
}

impl FromStr for ViewerUrl {
    type Err = ViewerError;

    fn from_str(text: &str) -> Result<Self, ViewerError> {
        let fail = |reason: String| ViewerError::Url { url: text.to_owned(), reason };
        let full = if text.contains("://") {
            text.to_owned()
        } else {
            let host = text.trim_end_matches('/');
            if host.is_empty() || host.contains('/') {
                return Err(fail("the host is missing".to_owned()));
            }
            // A colon that belongs to an IPv6 address lies inside the brackets.
            let port = host.rsplit(']').next().is_some_and(|rest| rest.contains(':'));
            let suffix = if port { String::new() } else { format!(":{GRPC_PORT}") };
            format!("rerun+http://{host}{suffix}/proxy")
        };
        full.parse().map(Self).map_err(|error: rerun::external::re_uri::Error| fail(error.to_string()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(text: &str) -> String {
        match text.parse::<Viewer>() {
            Ok(viewer) => viewer.to_string(),
            Err(error) => format!("error: {error}"),
        }
    }

    #[test]
    fn the_four_ways_parse() {
        assert_eq!(parse("web"), "web");
        assert_eq!(parse("web=0.0.0.0"), "web=0.0.0.0");
        assert_eq!(parse("web=::1"), "web=::1");
        assert_eq!(parse("off"), "off");
        assert_eq!(parse("save=a/b.rrd"), "save=a/b.rrd");
        for url in
            ["connect", "connect=127.0.0.1", "connect=127.0.0.1:9876", "connect=rerun+http://127.0.0.1:9876/proxy"]
        {
            assert_eq!(parse(url), "connect=rerun+http://127.0.0.1:9876/proxy", "{url}");
        }
        assert_eq!(parse("connect=robot.lab:80"), "connect=rerun+http://robot.lab:80/proxy");
        assert_eq!(parse("connect=[::1]"), "connect=rerun+http://[::1]:9876/proxy");
    }

    #[test]
    fn errors_teach() {
        for (text, word) in [
            ("", "use web, connect=URL"),
            ("browser", "\"browser\" is unknown"),
            ("off=1", "\"off=1\" is unknown"),
            ("web=lab", "IP address"),
            ("save", "ends in .rrd"),
            ("save=.rrd", "ends in .rrd"),
            ("save=run.mcap", "\"run.mcap\""),
            ("connect=", "host is missing"),
            ("connect=host:port", "use HOST, HOST:PORT"),
            ("connect=http://", "use HOST, HOST:PORT"),
        ] {
            let message = parse(text);
            assert!(message.starts_with("error: ") && message.contains(word), "{text:?} gives {message}");
        }
    }
}
