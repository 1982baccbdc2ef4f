//! The endpoints at which the processes of a run meet, checked for what zenoh can open, and the prefix of the run's keys.
//! This module keeps no connection open.

use std::{
    fs,
    io::ErrorKind,
    net::{TcpListener, ToSocketAddrs, UdpSocket},
    os::unix::fs::FileTypeExt,
    path::Path,
    time::{Duration, Instant},
};

use anyhow::Context;
use driml_machine::error::{Usage, usage};
use driml_protocol::{Shutdown, reach};

/// The default prefix of a run's keys.
pub const DEFAULT_NAMESPACE: &str = "driml";

/// The longest path of a unix socket, bytes: `sun_path` of `unix(7)`, whose last byte is 0.
pub(crate) const SOCKET_PATH_MAX: usize = 107;
/// After these characters zenoh reads further settings, which could override ours and cut off a path.
pub(crate) const ADDRESS_ENDS: [char; 2] = ['#', '?'];

/// How long the replay server may take until it listens.
const LISTEN_MAX: Duration = Duration::from_secs(60);
const LISTEN_POLL: Duration = Duration::from_millis(20);

/// Rejects endpoints to connect to that zenoh cannot open, or that do not fit `--tls-dir`.
pub fn check_connect_endpoints(endpoints: &[String], tls: bool) -> Result<(), Usage> {
    endpoints.iter().try_for_each(|it| {
        check_endpoint(it, tls)?;
        if it.starts_with("quic/[") {
            return Err(usage!(
                "{it}: zenoh cannot match an IPv6 address with a certificate: connect by a name"
            ));
        }
        Ok(())
    })
}

/// Rejects endpoints to listen on that zenoh cannot open or that do not fit `--tls-dir`. Without `--allow-insecure`, also rejects
/// endpoints that other machines can reach without a certificate.
pub fn check_listen_endpoints(
    endpoints: &[String],
    tls: bool,
    allow_insecure: bool,
) -> Result<(), Usage> {
    for endpoint in endpoints {
        check_endpoint(endpoint, tls)?;
        if !is_exposed(endpoint) {
            continue;
        }
        if !allow_insecure {
            return Err(usage!(
                "{endpoint} can be reached from other machines, and anyone who reaches it can read, change and stop the run. \
                 Listen on quic/HOST:PORT with --tls-dir DIR (deploy/certs.sh makes the certificates); or, if you trust every machine \
                 that can connect, add --allow-insecure"
            ));
        }
        tracing::warn!(
            "--allow-insecure: anyone who reaches {endpoint} can read, change and stop the run"
        );
    }
    Ok(())
}

/// Rejects endpoints to listen on that another process uses, before anything is created, with a clearer error than zenoh's. Also
/// rejects a socket path at which another file lies, because zenoh would delete that file.
pub fn check_unused(endpoints: &[String]) -> Result<(), Usage> {
    for endpoint in endpoints {
        let path = endpoint.strip_prefix("unixsock-stream/");
        let existing = path.and_then(|path| fs::symlink_metadata(path).ok());
        if existing.is_some_and(|it| !it.file_type().is_socket()) {
            return Err(usage!(
                "cannot listen on {endpoint}: that path is not a socket. Choose another path, with --listen for this command and \
                 --connect for all others"
            ));
        }
        let folder = path.and_then(|path| Path::new(path).parent());
        let folder = folder.filter(|it| !it.as_os_str().is_empty());
        let bound = match endpoint.split_once('/') {
            Some(("tcp", address)) => TcpListener::bind(address).map(drop),
            Some(("quic", address)) => UdpSocket::bind(address).map(drop),
            _ if folder.is_some_and(|it| !it.is_dir()) => Err(ErrorKind::NotFound.into()),
            _ => match reach::check_listening(endpoint) {
                Ok(()) => Err(ErrorKind::AddrInUse.into()),
                Err(_) => Ok(()),
            },
        };
        bound.map_err(|e| match e.kind() {
            ErrorKind::AddrInUse => usage!(
                "cannot listen on {endpoint}: another process listens there. Stop it, or choose another port or path, with --listen for this \
                 command and --connect for all others"
            ),
            ErrorKind::PermissionDenied => {
                usage!("cannot listen on {endpoint}: {e}; choose a port from 1024 on")
            }
            ErrorKind::NotFound => usage!(
                "cannot listen on {endpoint}: its folder does not exist: make it, or choose another path"
            ),
            _ => usage!(
                "cannot listen on {endpoint}: {e}; choose an address of this machine, such as 127.0.0.1 or 0.0.0.0"
            ),
        })?;
    }
    Ok(())
}

/// Waits until something listens at `endpoint`; false once `interrupted`. `check_alive` fails if the process that should listen ended.
pub fn wait_until_listening(
    endpoint: &str,
    interrupted: &Shutdown,
    mut check_alive: impl FnMut() -> anyhow::Result<()>,
) -> anyhow::Result<bool> {
    let deadline = Instant::now() + LISTEN_MAX;
    while let Err(e) = reach::check_listening(endpoint) {
        check_alive()?;
        if Instant::now() > deadline {
            return Err(e).context("waiting for the replay server");
        }
        if interrupted.wait_timeout(LISTEN_POLL) {
            return Ok(false);
        }
    }
    Ok(true)
}

fn check_endpoint(endpoint: &str, tls: bool) -> Result<(), Usage> {
    let has_host_and_port = |address: &str| {
        let parts = address.rsplit_once(':');
        let is_port = |port: &str| port.parse::<u16>().is_ok_and(|port| port > 0);
        parts.is_some_and(|(host, port)| !host.is_empty() && is_port(port))
    };
    match endpoint.split_once('/') {
        Some(("tcp", address)) if tls && has_host_and_port(address) => Err(usage!(
            "{endpoint} is not encrypted: with --tls-dir it is quic/{address}"
        )),
        Some(("tls", address)) if has_host_and_port(address) => Err(usage!(
            "{endpoint}: TLS over TCP is not supported, because zenoh's may break a connection or crash the process \
             (https://github.com/eclipse-zenoh/zenoh/issues/2557): with --tls-dir it is quic/{address}, the TLS of QUIC over UDP"
        )),
        Some(("quic", address)) if !tls && has_host_and_port(address) => Err(usage!(
            "{endpoint} needs certificates: add --tls-dir DIR, which deploy/certs.sh makes"
        )),
        Some(("tcp" | "quic", address)) if has_host_and_port(address) => Ok(()),
        Some(("unixsock-stream", path)) if path.len() > SOCKET_PATH_MAX => Err(usage!(
            "{endpoint}: the path of a unix socket has at most {SOCKET_PATH_MAX} bytes, and this one has {}: choose a shorter one, such \
             as /tmp/driml.sock",
            path.len()
        )),
        Some(("unixsock-stream", path)) if !path.is_empty() && !path.contains(ADDRESS_ENDS) => {
            Ok(())
        }
        _ => Err(usage!(
            "{endpoint:?} is not an endpoint: use tcp/HOST:PORT, quic/HOST:PORT or unixsock-stream/PATH, with a PORT from 1 to 65535, and neither # nor ?"
        )),
    }
}

/// Whether other machines may reach an endpoint without a certificate.
fn is_exposed(endpoint: &str) -> bool {
    let Some(("tcp", address)) = endpoint.split_once('/') else {
        return false;
    };
    // An unknown name is not an address of this machine; zenoh's error says what is wrong with it.
    let Ok(mut addresses) = address.to_socket_addrs() else {
        return false;
    };
    !addresses.all(|it| it.ip().to_canonical().is_loopback())
}

#[cfg(test)]
mod tests {
    use std::os::unix::net::UnixListener;

    use super::*;

    /// Each case is an endpoint to listen on, whether certificates are used, and whether insecure endpoints are allowed. The program's
    /// tests have the endpoints that are rejected.
    #[test]
    fn endpoints_that_zenoh_can_open_and_that_are_guarded_are_taken() {
        let longest = format!("unixsock-stream//{}", "x".repeat(106));
        for (endpoint, tls, allow_insecure) in [
            (&*longest, false, false),
            ("unixsock-stream//tmp/driml.sock", true, false),
            ("tcp/127.0.0.1:7447", false, false),
            ("tcp/127.9.9.9:1", false, false),
            ("tcp/[::1]:7447", false, false),
            ("tcp/localhost:1", false, false),
            ("tcp/0.0.0.0:7447", false, true),
            ("quic/[::]:1", true, false),
            ("quic/192.0.2.1:1", true, false),
        ] {
            let checked = check_listen_endpoints(&[endpoint.into()], tls, allow_insecure);
            assert!(checked.is_ok(), "{endpoint}: {checked:?}");
        }
        assert!(check_connect_endpoints(&["quic/host:1".into()], true).is_ok());
    }

    #[test]
    fn an_endpoint_that_another_process_has_is_refused() {
        let tcp = TcpListener::bind("127.0.0.1:0").unwrap();
        let udp = UdpSocket::bind("127.0.0.1:0").unwrap();
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("s");
        let socket = UnixListener::bind(&path).unwrap();
        let endpoints = [
            format!("tcp/{}", tcp.local_addr().unwrap()),
            format!("quic/{}", udp.local_addr().unwrap()),
            format!("unixsock-stream/{}", path.display()),
        ];
        for endpoint in &endpoints {
            let said = check_unused(std::slice::from_ref(endpoint)).unwrap_err().0;
            let begins = format!("cannot listen on {endpoint}: another process listens there");
            let is_told = said.starts_with(&begins) && said.contains("--listen");
            assert!(is_told, "{said}");
        }
        drop((tcp, udp, socket));
        assert!(check_unused(&endpoints).is_ok());
    }
}
