//! Checks whether anything listens at an endpoint, and what: zenoh itself reports only that it gave up.
//! The check connects and disconnects, so it ignores certificates, namespaces and runs.

use std::{
    io::{ErrorKind, Read, Write},
    net::{SocketAddr, TcpStream, ToSocketAddrs},
    os::unix::net::UnixStream,
    path::PathBuf,
    time::Duration,
};

use crate::process::silence::Silence;

/// How long one address may take to answer.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(2);
/// Pauses between attempts: the first pause, which doubles each time, and the longest.
const PAUSES: [Duration; 2] = [Duration::from_millis(50), Duration::from_secs(1)];
/// How long a foreign server may take to send its first bytes.
const GREETING_TIMEOUT: Duration = Duration::from_secs(1);

/// Why an endpoint cannot be reached, and what to do.
#[derive(Debug, thiserror::Error)]
#[error("{text}")]
pub struct Unreachable {
    text: String,
    /// Whether a retry may succeed, as the replay server may still be starting.
    is_retryable: bool,
    /// Whether its machine reports that nothing listens there: a server that did has exited.
    pub is_closed: bool,
}

/// Checks once whether something accepts connections at `endpoint`. For `quic/` only the host is resolved, because UDP does not
/// report a closed port.
pub fn check_listening(endpoint: &str) -> Result<(), Unreachable> {
    match endpoint.split_once('/') {
        Some(("unixsock-stream", path)) => check_unix_socket(endpoint, path.into()),
        Some((protocol, address)) => {
            let addresses = address.to_socket_addrs().map_err(|e| {
                let why = e.to_string();
                let why = why.rsplit(": ").next().unwrap_or(&why);
                let text = format!(
                    "the host of {endpoint} is unknown: {why}. Correct the name, or take the machine's address"
                );
                Unreachable {
                    text,
                    is_retryable: why.contains("emporary"),
                    is_closed: false,
                }
            })?;
            if protocol != "tcp" {
                return Ok(());
            }
            let mut failed = Vec::new();
            for address in addresses {
                match TcpStream::connect_timeout(&address, CONNECT_TIMEOUT) {
                    Ok(_) => return Ok(()),
                    Err(e) => failed.push(e),
                }
            }
            let failed = most_telling(failed);
            let failed = failed.unwrap_or_else(|| ErrorKind::AddrNotAvailable.into());
            Err(connect_error(endpoint, failed))
        }
        // zenoh reports what is wrong with such an endpoint.
        None => Ok(()),
    }
}

/// Returns the error that tells most about a host with several addresses. A server may still run at an address that does not answer.
/// Errors of rank 0 say only that this machine has no route to the address, as where it lacks IPv6.
fn most_telling(errors: Vec<std::io::Error>) -> Option<std::io::Error> {
    let rank = |e: &std::io::Error| match e.kind() {
        ErrorKind::TimedOut | ErrorKind::HostUnreachable => 2,
        ErrorKind::ConnectionRefused => 1,
        _ => 0,
    };
    errors.into_iter().max_by_key(rank)
}

fn connect_error(endpoint: &str, e: std::io::Error) -> Unreachable {
    let is_closed = e.kind() == ErrorKind::ConnectionRefused;
    let text = match is_closed {
        true => format!(
            "nothing listens on {endpoint}: start the replay server first, with this --listen, or correct the port. One with --tls-dir is \
             reached with quic/HOST:PORT, which is UDP, and --tls-dir"
        ),
        false => format!(
            "{endpoint} does not answer ({e}): is its machine up, is the address right, and does a firewall let this port through?"
        ),
    };
    Unreachable {
        text,
        is_retryable: true,
        is_closed,
    }
}

fn check_unix_socket(endpoint: &str, path: PathBuf) -> Result<(), Unreachable> {
    let what = match UnixStream::connect(path) {
        Ok(_) => return Ok(()),
        Err(e) if e.kind() == ErrorKind::PermissionDenied => {
            let text = format!(
                "{endpoint} belongs to another user: run as that user, or connect to a tcp/ endpoint"
            );
            return Err(Unreachable {
                text,
                is_retryable: false,
                is_closed: false,
            });
        }
        Err(e) if e.kind() == ErrorKind::NotFound => "there is no such socket",
        Err(e) if e.kind() == ErrorKind::ConnectionRefused => {
            "its socket was left by a process that has ended"
        }
        Err(e) => return Err(connect_error(endpoint, e)),
    };
    let text = format!(
        "nothing listens on {endpoint}: {what}. Start the replay server first, on this machine and with this --listen, or correct the path"
    );
    Err(Unreachable {
        text,
        is_retryable: true,
        is_closed: true,
    })
}

/// Waits until something accepts connections at one of `endpoints`.
pub(crate) fn wait_for_any(endpoints: &[String], wait_max: Duration) -> Result<(), Unreachable> {
    let (mut silence, [mut pause, pause_max]) = (Silence::default(), PAUSES);
    let mut is_logged = false;
    loop {
        let mut failed = None;
        for endpoint in endpoints {
            match check_listening(endpoint) {
                Ok(()) => return Ok(()),
                Err(e) => failed = Some(e),
            }
        }
        let Some(e) = failed else {
            return Ok(());
        };
        let waited = silence.record_failure();
        if !e.is_retryable || waited + pause > wait_max {
            return Err(e);
        }
        if waited > CONNECT_TIMEOUT && !std::mem::replace(&mut is_logged, true) {
            tracing::info!("waiting up to {} s: {e}", wait_max.as_secs());
        }
        std::thread::sleep(pause);
        pause = (pause * 2).min(pause_max);
    }
}

/// Returns what to check if the name in `endpoint` resolves to an IPv6 address first: over QUIC, zenoh tries no other.
pub(crate) fn ipv6_hint(endpoint: &str) -> Option<&'static str> {
    let first = endpoint
        .strip_prefix("quic/")?
        .to_socket_addrs()
        .ok()?
        .next();
    let hint = ". The name has an IPv6 address, which is tried alone: the server must listen on quic/[::]:PORT, not 0.0.0.0";
    first.filter(SocketAddr::is_ipv6).map(|_| hint)
}

/// Returns the first line that a foreign server at `endpoint` sends in answer to an HTTP request, if it is printable text.
pub(crate) fn read_greeting(endpoint: &str) -> Option<String> {
    let ("tcp", address) = endpoint.split_once('/')? else {
        return None;
    };
    let address = address.to_socket_addrs().ok()?.next()?;
    let mut stream = TcpStream::connect_timeout(&address, CONNECT_TIMEOUT).ok()?;
    stream.set_read_timeout(Some(GREETING_TIMEOUT)).ok()?;
    stream.write_all(b"GET / HTTP/1.0\r\n\r\n").ok()?;
    let mut greeting = [0; 40];
    let count = stream.read(&mut greeting).ok()?;
    let line = greeting[..count].split(|&byte| byte == b'\r' || byte == b'\n');
    let line = std::str::from_utf8(line.into_iter().next()?).ok()?;
    let is_text = line.len() >= 4 && line.chars().all(|it| !it.is_control());
    is_text.then(|| line.to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_server_has_exited_only_if_no_address_of_its_host_may_be_silent() {
        use ErrorKind::{ConnectionRefused, HostUnreachable, NetworkUnreachable, TimedOut};
        for (errors, is_closed) in [
            ([ConnectionRefused, ConnectionRefused], true),
            ([ConnectionRefused, NetworkUnreachable], true),
            ([HostUnreachable, ConnectionRefused], false),
            ([TimedOut, ConnectionRefused], false),
            ([ConnectionRefused, TimedOut], false),
        ] {
            let failed = most_telling(errors.map(std::io::Error::from).into());
            let error = connect_error("tcp/host:1", failed.unwrap());
            assert_eq!(error.is_closed, is_closed, "{errors:?}");
        }
    }
}
