use std::any::Any;
use std::io;
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr, TcpListener, TcpStream};
use std::time::{Duration, Instant};

use rerun::grpc_server::GrpcServerSink;
use rerun::web_viewer::{WebViewerConfig, serve_web_viewer};
use rerun::{MemoryLimit, PlaybackBehavior, ServerOptions};

/// Port of the web page.
pub const PAGE_PORT: u16 = 9090;
/// Port of the gRPC server: the page and the processes connect to it.
pub const GRPC_PORT: u16 = 9876;
/// How many page ports are tried when the first is taken.
const PAGE_PORTS: u16 = 10;
/// History that the hub keeps for browsers that open the page later: about a minute; when it is full, the oldest goes.
const HISTORY: u64 = 16 << 20;
/// How long a server on this machine may take to come up.
const START: Duration = Duration::from_secs(2);
/// How long a viewer may take to accept a connection.
const CONNECT: Duration = Duration::from_millis(500);

/// Where a hub listens.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct HubOptions {
    /// Address to bind; 0.0.0.0 or :: for all interfaces.
    pub bind: IpAddr,
    /// Port of the gRPC server.
    pub grpc_port: u16,
    /// First port to try for the web page.
    pub page_port: u16,
}

impl Default for HubOptions {
    fn default() -> Self {
        Self { bind: Ipv4Addr::LOCALHOST.into(), grpc_port: GRPC_PORT, page_port: PAGE_PORT }
    }
}

impl HubOptions {
    /// The gRPC address as a client on this machine sees it.
    pub(super) fn grpc(&self) -> SocketAddr {
        SocketAddr::new(reachable(self.bind), self.grpc_port)
    }

    /// The address to open in a browser on this machine when the page is on `port`.
    fn page(&self, port: u16) -> String {
        let page = SocketAddr::new(reachable(self.bind), port);
        let grpc = self.grpc().to_string().replace('[', "%5B").replace(']', "%5D").replace(':', "%3A");
        format!("http://{page}/?url=rerun%2Bhttp%3A%2F%2F{grpc}%2Fproxy")
    }
}

/// The address at which a server bound to `bind` answers on its own machine.
fn reachable(bind: IpAddr) -> IpAddr {
    match bind {
        IpAddr::V4(ip) if ip.is_unspecified() => Ipv4Addr::LOCALHOST.into(),
        IpAddr::V6(ip) if ip.is_unspecified() => Ipv6Addr::LOCALHOST.into(),
        ip => ip,
    }
}

/// True if something accepts connections there.
pub(super) fn answers(address: SocketAddr) -> bool {
    TcpStream::connect_timeout(&address, CONNECT).is_ok()
}

/// Failure to open a hub.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum HubError {
    /// Another hub, or another program, has the gRPC port.
    #[error("{0} is taken already: a viewer may be running there; end it, or join it with connect={0}")]
    Taken(SocketAddr),
    /// The address is not one of this machine's, or may not be used.
    #[error("cannot serve on {address}: {reason}")]
    Bind {
        /// The address.
        address: SocketAddr,
        /// The system's words.
        reason: String,
    },
    /// No page port is free.
    #[error("no port from {first} to {last} is free for the web page: end what uses them")]
    NoPage {
        /// First port tried.
        first: u16,
        /// Last port tried.
        last: u16,
    },
    /// The gRPC server did not come up.
    #[error("the gRPC server on {0} does not answer")]
    Silent(SocketAddr),
}

/// The built-in web viewer: a page, and a server that gathers what the processes log and hands it to the browsers.
///
/// Stops when dropped.
pub struct Hub {
    page: String,
    grpc: SocketAddr,
    // Only kept alive; the type of the page's server has no public name.
    _web: Box<dyn Any + Send>,
    _grpc: GrpcServerSink,
}

impl Hub {
    /// Serves the page and the gRPC server. Takes up to a few seconds.
    ///
    /// # Errors
    /// Addresses that are taken or not this machine's.
    pub fn open(options: &HubOptions) -> Result<Self, HubError> {
        let grpc = options.grpc();
        if answers(grpc) {
            return Err(HubError::Taken(grpc));
        }
        // The page first: its port can be had only once, so of two processes that start together one goes on and the
        // other waits for it. The gRPC server would not tell us that its port is gone.
        let (web, page) = serve_page(options)?;
        let listen = SocketAddr::new(options.bind, options.grpc_port);
        drop(TcpListener::bind(listen).map_err(|error| bind_error(listen, &error))?);
        let server = GrpcServerSink::new(&host(options.bind), options.grpc_port, server_options(options))
            .map_err(|error| HubError::Bind { address: listen, reason: error.to_string() })?;
        if !answers_within(grpc, START) {
            return Err(HubError::Silent(grpc));
        }
        Ok(Self { page, grpc, _web: web, _grpc: server })
    }

    /// The address to open in a browser on this machine.
    #[must_use]
    pub fn page(&self) -> &str {
        &self.page
    }

    /// The gRPC address that other processes connect to, as seen from this machine.
    #[must_use]
    pub const fn grpc(&self) -> SocketAddr {
        self.grpc
    }
}

impl std::fmt::Debug for Hub {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Hub").field("page", &self.page).field("grpc", &self.grpc).finish_non_exhaustive()
    }
}

/// Serves the page on the first free port.
fn serve_page(options: &HubOptions) -> Result<(Box<dyn Any + Send>, String), HubError> {
    let last = options.page_port.saturating_add(PAGE_PORTS - 1);
    for port in options.page_port..=last {
        let address = SocketAddr::new(options.bind, port);
        match TcpListener::bind(address) {
            Ok(probe) => drop(probe),
            Err(error) if error.kind() == io::ErrorKind::AddrInUse => {
                // Perhaps another process of ours that is about to bring up its gRPC server.
                if port == options.page_port && answers_within(options.grpc(), START) {
                    return Err(HubError::Taken(options.grpc()));
                }
                continue;
            }
            Err(error) => return Err(bind_error(address, &error)),
        }
        let config = WebViewerConfig {
            bind_ip: options.bind.to_string(),
            web_port: port.into(),
            open_browser: false,
            ..WebViewerConfig::default()
        };
        if let Ok(server) = serve_web_viewer(config) {
            return Ok((Box::new(server), options.page(port)));
        }
    }
    Err(HubError::NoPage { first: options.page_port, last })
}

fn server_options(options: &HubOptions) -> ServerOptions {
    // Rerun knows localhost and 127.0.0.1 of the pages that may ask. Bound to more than this machine, the page is opened
    // under names we do not know.
    let cors =
        if options.bind.is_loopback() { format!("http://{}:*", host(options.bind)) } else { "http://*".to_owned() };
    ServerOptions {
        memory_limit: MemoryLimit::from_bytes(HISTORY),
        // Newest first would let live data overtake the layout and all that is static, for as long as a slow browser
        // cannot keep up with it.
        playback_behavior: PlaybackBehavior::OldestFirst,
        cors_allowed_origins: vec![cors],
    }
}

fn bind_error(address: SocketAddr, error: &io::Error) -> HubError {
    match error.kind() {
        io::ErrorKind::AddrInUse => HubError::Taken(address),
        _ => HubError::Bind { address, reason: error.to_string() },
    }
}

/// `ip` as a host in an address with a port.
fn host(ip: IpAddr) -> String {
    match ip {
        IpAddr::V4(ip) => ip.to_string(),
        IpAddr::V6(ip) => format!("[{ip}]"),
    }
}

fn answers_within(address: SocketAddr, limit: Duration) -> bool {
    let start = Instant::now();
    while !answers(address) {
        if start.elapsed() > limit {
            return false;
        }
        std::thread::sleep(Duration::from_millis(20));
    }
    true
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_page_opens_the_stream_from_the_browsers_side() {
        let url = |bind: &str| HubOptions { bind: bind.parse().unwrap(), ..HubOptions::default() }.page(9090);
        let local = "http://127.0.0.1:9090/?url=rerun%2Bhttp%3A%2F%2F127.0.0.1%3A9876%2Fproxy";
        assert_eq!(url("127.0.0.1"), local);
        assert_eq!(url("0.0.0.0"), local);
        assert_eq!(url("192.168.0.5"), "http://192.168.0.5:9090/?url=rerun%2Bhttp%3A%2F%2F192.168.0.5%3A9876%2Fproxy");
        assert_eq!(url("::1"), "http://[::1]:9090/?url=rerun%2Bhttp%3A%2F%2F%5B%3A%3A1%5D%3A9876%2Fproxy");
    }
}
