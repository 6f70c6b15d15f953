//! Endpoints in the notation of Zenoh, and the address behind a name.

use std::fmt;
use std::net::{IpAddr, SocketAddr, ToSocketAddrs as _};
use std::str::FromStr;
use std::sync::{Arc, Mutex, PoisonError, Weak};
use std::time::Duration;

use crate::Invalid;

/// How often a name is looked up, so that a container that comes late or again is found.
const LOOK_UP_EVERY: Duration = Duration::from_secs(2);

/// How an endpoint's traffic is carried.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Transport {
    /// Datagrams.
    Udp,
    /// Byte streams.
    Tcp,
}

/// `udp/host:port` and the like: `quic` is carried by UDP, `tls` by TCP.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Endpoint {
    protocol: String,
    host: String,
    port: u16,
}

impl Endpoint {
    /// That of an address.
    pub(crate) fn of(protocol: &str, address: SocketAddr) -> Self {
        Self { protocol: protocol.to_owned(), host: address.ip().to_string(), port: address.port() }
    }

    /// How it is carried.
    #[must_use]
    pub fn transport(&self) -> Transport {
        if matches!(self.protocol.as_str(), "udp" | "quic") { Transport::Udp } else { Transport::Tcp }
    }

    /// The port.
    #[must_use]
    pub const fn port(&self) -> u16 {
        self.port
    }

    /// The same host and protocol at another port.
    #[must_use]
    pub fn with_port(self, port: u16) -> Self {
        Self { port, ..self }
    }

    /// Looks the host up; a name may have both kinds of addresses, then it is the IPv4 one.
    ///
    /// # Errors
    /// If it is not known (now).
    pub fn address(&self) -> std::io::Result<SocketAddr> {
        let found: Vec<_> = (self.host.as_str(), self.port).to_socket_addrs()?.collect();
        let first = found.iter().find(|address| address.is_ipv4()).or_else(|| found.first());
        first.copied().ok_or_else(|| std::io::Error::other("no address"))
    }
}

impl FromStr for Endpoint {
    type Err = Invalid;

    fn from_str(text: &str) -> Result<Self, Invalid> {
        let wrong = |why: &str| Invalid(format!("endpoint {text:?}: {why}; write for example udp/192.168.0.7:7447"));
        let (protocol, rest) = text.split_once('/').ok_or_else(|| wrong("has no protocol"))?;
        if !matches!(protocol, "udp" | "quic" | "tcp" | "tls") {
            return Err(wrong("the protocol must be udp, quic, tcp or tls"));
        }
        let (host, port) = rest.rsplit_once(':').ok_or_else(|| wrong("has no port"))?;
        let port = port.parse().map_err(|_error| wrong("the port must be 0 to 65535"))?;
        let bare = host.strip_prefix('[').and_then(|host| host.strip_suffix(']'));
        let named =
            |host: &str| !host.is_empty() && host.chars().all(|c| c.is_ascii_alphanumeric() || "-._".contains(c));
        let sound = bare.map_or_else(|| named(host), |bare| bare.parse::<IpAddr>().is_ok());
        if !sound {
            return Err(wrong("the host must be a name, an IPv4 address or an IPv6 address in brackets"));
        }
        Ok(Self { protocol: protocol.to_owned(), host: bare.unwrap_or(host).to_owned(), port })
    }
}

impl fmt::Display for Endpoint {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { protocol, host, port } = self;
        if host.contains(':') { write!(f, "{protocol}/[{host}]:{port}") } else { write!(f, "{protocol}/{host}:{port}") }
    }
}

/// Where a relay sends to. A thread looks names up again and again, as long as there is anybody to ask it.
#[derive(Debug)]
pub(crate) struct Target(Mutex<Option<SocketAddr>>);

impl Target {
    pub(crate) fn new(endpoint: Endpoint) -> Arc<Self> {
        // An address is its own name: no look-up can take long.
        if endpoint.host.parse::<IpAddr>().is_ok() {
            return Arc::new(Self(Mutex::new(endpoint.address().ok())));
        }
        let target = Arc::new(Self(Mutex::new(None)));
        let weak = Arc::downgrade(&target);
        std::thread::spawn(move || Self::look_up(&endpoint, &weak));
        target
    }

    fn look_up(endpoint: &Endpoint, target: &Weak<Self>) {
        while target.strong_count() > 0 {
            // A name that is gone for a moment keeps its address.
            if let (Ok(found), Some(target)) = (endpoint.address(), target.upgrade()) {
                *target.0.lock().unwrap_or_else(PoisonError::into_inner) = Some(found);
            }
            std::thread::sleep(LOOK_UP_EVERY);
        }
    }

    pub(crate) fn address(&self) -> Option<SocketAddr> {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn text_goes_both_ways_and_nonsense_is_refused() {
        for text in ["udp/127.0.0.1:7447", "quic/robot:1", "tcp/[::1]:0", "tls/a-b.example_1.org:65535"] {
            assert_eq!(text.parse::<Endpoint>().unwrap().to_string(), text);
        }
        for (text, why) in [
            ("robot:7447", "has no protocol"),
            ("ws/robot:7447", "udp, quic, tcp or tls"),
            ("udp/robot", "has no port"),
            ("udp/robot:70000", "0 to 65535"),
            ("udp/::1:7447", "in brackets"),
            ("udp/:7447", "must be a name"),
            ("udp/robot:7447#iface=eth0", "0 to 65535"),
        ] {
            let error = text.parse::<Endpoint>().unwrap_err().to_string();
            assert!(error.contains(why) && error.contains(text), "{text}: {error}");
        }
    }
}
