//! A handshake before the session's own, because it can say what is wrong: zenoh tries again until it gives up, and says no more
//! than that. It sends nothing but the handshake.

use std::{
    io::{self, ErrorKind, Read, Write},
    net::{TcpStream, ToSocketAddrs},
    sync::Arc,
    time::{Duration, Instant},
};

use rustls::{
    AlertDescription, CertificateError, ClientConfig, ClientConnection, Error,
    pki_types::ServerName, version::TLS13,
};

use super::{
    TlsError,
    credentials::{Credentials, provider},
};

/// How long the other side may take for one step of the handshake.
const STEP_MAX: Duration = Duration::from_secs(3);
/// How long its verdict on this part's certificate is waited for: it comes with the handshake's last message, or not at all.
const VERDICT_MAX: Duration = Duration::from_millis(1500);
/// Pause before somebody who does not listen yet is tried again.
const PAUSE: Duration = Duration::from_millis(100);

/// Checks that whoever listens on `endpoint`, `tls/HOST:PORT`, is a replay server of the same authority and takes this part's
/// certificate. False if nobody listens there within `wait_max`.
///
/// # Errors
/// Which side refuses the other, why, and what to do.
pub(crate) fn check(
    endpoint: &str,
    credentials: &Credentials,
    wait_max: Duration,
) -> Result<bool, TlsError> {
    let started = Instant::now();
    let Some(tcp) = std::iter::repeat_with(|| connect(endpoint))
        .inspect(|tried| {
            if tried.is_none() {
                std::thread::sleep(PAUSE);
            }
        })
        .take_while(|tried| tried.is_some() || started.elapsed() < wait_max)
        .flatten()
        .next()
    else {
        return Ok(false);
    };
    let handshake = Handshake {
        endpoint,
        credentials,
    };
    handshake.run(tcp).map(|()| true)
}

/// The host and the port of an endpoint.
fn address(endpoint: &str) -> Option<(&str, &str)> {
    endpoint.split_once('/')?.1.rsplit_once(':')
}

fn connect(endpoint: &str) -> Option<TcpStream> {
    let (_, address) = endpoint.split_once('/')?;
    let addresses = address.to_socket_addrs().ok()?;
    let mut streams = addresses.filter_map(|it| TcpStream::connect_timeout(&it, STEP_MAX).ok());
    streams.next()
}

struct Handshake<'a> {
    endpoint: &'a str,
    credentials: &'a Credentials,
}

impl Handshake<'_> {
    fn run(&self, mut tcp: TcpStream) -> Result<(), TlsError> {
        let mut tls = self.begin()?;
        let began = set_timeout(&tcp, STEP_MAX).and_then(|()| {
            while tls.is_handshaking() {
                tls.complete_io(&mut tcp)?;
            }
            tls.complete_io(&mut tcp).map(drop)
        });
        began.map_err(|e| self.their_fault(&e))?;
        // The other side judges this part's certificate after the handshake has ended here: it sends tickets, or a refusal.
        let judged = set_timeout(&tcp, VERDICT_MAX).and_then(|()| {
            tls.read_tls(&mut tcp)?;
            tls.process_new_packets().map_err(io::Error::other)?;
            match tls.reader().read(&mut [0]) {
                Ok(0) => Err(ErrorKind::UnexpectedEof.into()),
                Err(e) if e.kind() != ErrorKind::WouldBlock => Err(e),
                _ => Ok(()),
            }
        });
        match judged {
            Err(e) if !is_timeout(&e) => Err(self.refused(&e)),
            _ => {
                tls.send_close_notify();
                // It has said all that is asked here.
                let _ = tls.write_tls(&mut tcp).and_then(|_| tcp.flush());
                Ok(())
            }
        }
    }

    fn begin(&self) -> Result<ClientConnection, TlsError> {
        let Credentials {
            roots,
            chain,
            secret,
            ..
        } = self.credentials;
        let server = |why: String| TlsError::Server {
            endpoint: self.endpoint.into(),
            why,
        };
        let config = ClientConfig::builder_with_provider(provider().into())
            .with_protocol_versions(&[&TLS13])
            .and_then(|builder| {
                let builder = builder.with_root_certificates(roots.clone());
                builder.with_client_auth_cert(chain.clone(), secret.clone_key())
            })
            .map_err(|e| server(e.to_string()))?;
        let host = address(self.endpoint).map_or("", |(host, _)| host);
        let host = host
            .trim_start_matches('[')
            .trim_end_matches(']')
            .to_owned();
        let name = ServerName::try_from(host).map_err(|e| server(e.to_string()))?;
        ClientConnection::new(Arc::new(config), name).map_err(|e| server(e.to_string()))
    }

    /// What is wrong with the other side, by an error before the handshake's end here.
    fn their_fault(&self, e: &io::Error) -> TlsError {
        let why = match tls_error(e) {
            Some(Error::InvalidCertificate(fault)) => self.their_certificate(fault),
            Some(Error::AlertReceived(_)) => return self.refused(e),
            Some(Error::InvalidMessage(_)) => no_tls(),
            Some(e) => format!("{e}: only TLS 1.3 is spoken here"),
            None => no_tls(),
        };
        TlsError::Server {
            endpoint: self.endpoint.into(),
            why,
        }
    }

    fn their_certificate(&self, fault: &CertificateError) -> String {
        use CertificateError as Fault;
        let authority = self.credentials.authority_path().display();
        match fault {
            Fault::UnknownIssuer | Fault::BadSignature => format!(
                "its certificate is not from the authority of {authority}; if it is the right machine, copy ca.pem from where \
                 deploy/certs.sh made its certificate"
            ),
            Fault::Expired | Fault::ExpiredContext { .. } => "its certificate has expired: remove replay-server.pem and \
                 replay-server.key, let deploy/certs.sh make new ones, and start it again; if it did not, this machine's clock is wrong"
                .into(),
            Fault::NotValidYet | Fault::NotValidYetContext { .. } => {
                "its certificate is not valid yet: the clock of this machine is wrong, or of the one on which it was made".into()
            }
            Fault::NotValidForName | Fault::NotValidForNameContext { .. } => format!(
                "its certificate is not for {host}: connect by a name that it is for, or remove replay-server.pem and \
                 replay-server.key there and make them anew with `deploy/certs.sh DIR --host {host}`",
                host = address(self.endpoint).map_or("", |(host, _)| host)
            ),
            Fault::InvalidPurpose | Fault::InvalidPurposeContext { .. } => {
                "its certificate is that of an actor, a learner or an observer, not of a replay server".into()
            }
            other => other.to_string(),
        }
    }

    /// That the other side refuses this part, by what it said.
    fn refused(&self, e: &io::Error) -> TlsError {
        let why = match tls_error(e) {
            Some(Error::AlertReceived(alert)) => match alert {
                AlertDescription::UnknownCA | AlertDescription::DecryptError => {
                    "its ca.pem is of another authority; copy there the one with which this certificate was made, or make a \
                     certificate with the authority that it has"
                        .into()
                }
                AlertDescription::CertificateExpired => {
                    "it holds it for expired or not valid yet, which it is not by the clock here: set both clocks".into()
                }
                AlertDescription::ProtocolVersion => "it does not speak TLS 1.3".into(),
                other => format!("{other:?}; its own log says more"),
            },
            _ => format!("it closed the connection ({e}); its own log says more"),
        };
        TlsError::Refused {
            endpoint: self.endpoint.into(),
            path: self.credentials.certificate_path().into(),
            why,
        }
    }
}

fn no_tls() -> String {
    "it does not speak TLS: start the replay server with --tls-dir and --listen tls/HOST:PORT, or connect with tcp/HOST:PORT and \
     without --tls-dir to one that does not have it"
        .into()
}

fn tls_error(e: &io::Error) -> Option<&Error> {
    e.get_ref()?.downcast_ref()
}

fn is_timeout(e: &io::Error) -> bool {
    matches!(e.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut)
}

fn set_timeout(tcp: &TcpStream, timeout: Duration) -> io::Result<()> {
    tcp.set_read_timeout(Some(timeout))?;
    tcp.set_write_timeout(Some(timeout))
}
