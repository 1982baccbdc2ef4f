//! A handshake before the session's own, because it can say what is wrong: zenoh tries again until it gives up, and says no more
//! than that. It sends nothing but the handshake.

use std::{
    net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr, TcpStream, ToSocketAddrs},
    sync::Arc,
    time::{Duration, Instant},
};

use quinn::{ConnectionError, Endpoint, TransportConfig, crypto::rustls::QuicClientConfig};
use rustls::{AlertDescription, ClientConfig, version::TLS13};
use tokio::time::{sleep, timeout};

use super::{
    credentials::{Credentials, provider},
    sentences::TlsError,
};

/// How long one try may take. Nobody is there who could say that nobody listens: a try gets an answer or none.
const TRY_MAX: Duration = Duration::from_secs(3);
/// How long the other side's verdict on this part's certificate is waited for: it comes with the handshake's last message.
const VERDICT_MAX: Duration = Duration::from_secs(2);
/// How often it is looked for.
const TICK: Duration = Duration::from_millis(5);
/// How long a connection stays before it is closed: the other side, which opens its streams at once, calls it an error if it
/// cannot.
const LINGER: Duration = Duration::from_millis(50);
/// How long the last message may take to go out.
const LAST_WORD_MAX: Duration = Duration::from_millis(200);
/// The time of a message to the other side and back, before it is known: a lost one is sent again after three of them.
const ROUND_TRIP: Duration = Duration::from_millis(50);
/// The names by which zenoh calls what it speaks over QUIC, which the other side wants to hear.
const PROTOCOLS: [&[u8]; 2] = [b"zenoh-ms", b"zenoh"];

/// Checks that whoever listens on `endpoint`, `quic/HOST:PORT`, is a replay server of the same authority and takes this part's
/// certificate. False if nobody listens there within `wait_max`.
///
/// # Errors
/// Which side refuses the other, why, and what to do.
pub(crate) fn check(
    endpoint: &str,
    credentials: &Credentials,
    wait_max: Duration,
) -> Result<bool, TlsError> {
    let handshake = Handshake {
        endpoint,
        credentials,
    };
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .map_err(|e| handshake.server(e.to_string()))?;
    runtime.block_on(handshake.run(wait_max))
}

struct Handshake<'a> {
    endpoint: &'a str,
    credentials: &'a Credentials,
}

impl Handshake<'_> {
    async fn run(&self, wait_max: Duration) -> Result<bool, TlsError> {
        let (config, started) = (self.config()?, Instant::now());
        loop {
            let tried = match self.address() {
                Some(address) => self.try_once(address, config.clone()).await?,
                None => false,
            };
            if tried {
                return Ok(true);
            }
            if started.elapsed() > wait_max {
                break;
            }
            sleep(TICK).await;
        }
        let plain = self
            .address()
            .map(|it| TcpStream::connect_timeout(&it, TRY_MAX));
        match plain {
            Some(Ok(_)) => Err(self.server(no_quic())),
            _ => Ok(false),
        }
    }

    /// The host and the port.
    fn host_and_port(&self) -> Option<(&str, &str)> {
        self.endpoint.split_once('/')?.1.rsplit_once(':')
    }

    /// The address that zenoh takes too.
    fn address(&self) -> Option<SocketAddr> {
        let (_, address) = self.endpoint.split_once('/')?;
        address.to_socket_addrs().ok()?.next()
    }

    fn server(&self, why: String) -> TlsError {
        TlsError::Server {
            endpoint: self.endpoint.into(),
            why,
        }
    }

    fn config(&self) -> Result<quinn::ClientConfig, TlsError> {
        let Credentials {
            roots,
            chain,
            secret,
            ..
        } = self.credentials;
        let mut tls = ClientConfig::builder_with_provider(provider().into())
            .with_protocol_versions(&[&TLS13])
            .and_then(|builder| {
                let builder = builder.with_root_certificates(roots.clone());
                builder.with_client_auth_cert(chain.clone(), secret.clone_key())
            })
            .map_err(|e| self.server(e.to_string()))?;
        tls.alpn_protocols = PROTOCOLS.map(Vec::from).into();
        let crypto = QuicClientConfig::try_from(tls).map_err(|e| self.server(e.to_string()))?;
        let mut transport = TransportConfig::default();
        transport.initial_rtt(ROUND_TRIP);
        let mut config = quinn::ClientConfig::new(Arc::new(crypto));
        config.transport_config(transport.into());
        Ok(config)
    }

    /// True once the other side has taken this part's certificate; false if nobody answers.
    async fn try_once(
        &self,
        address: SocketAddr,
        config: quinn::ClientConfig,
    ) -> Result<bool, TlsError> {
        let any: IpAddr = match address {
            SocketAddr::V4(_) => Ipv4Addr::UNSPECIFIED.into(),
            SocketAddr::V6(_) => Ipv6Addr::UNSPECIFIED.into(),
        };
        let local = Endpoint::client((any, 0).into()).map_err(|e| self.server(e.to_string()))?;
        let tried = self.shake_hands(&local, address, config).await;
        // It has said all that is asked here.
        local.close(0u8.into(), b"");
        let _ = timeout(LAST_WORD_MAX, local.wait_idle()).await;
        tried
    }

    async fn shake_hands(
        &self,
        local: &Endpoint,
        address: SocketAddr,
        config: quinn::ClientConfig,
    ) -> Result<bool, TlsError> {
        let host = self.host_and_port().map_or("", |(host, _)| host);
        let connecting = local
            .connect_with(config, address, host)
            .map_err(|e| self.server(e.to_string()))?;
        let connection = match timeout(TRY_MAX, connecting).await {
            Err(_) | Ok(Err(ConnectionError::TimedOut)) => return Ok(false),
            Ok(Err(e)) => return Err(self.their_fault(&e)),
            Ok(Ok(connection)) => connection,
        };
        // The other side judges this part's certificate after the handshake has ended here.
        let started = Instant::now();
        while connection.stats().frame_rx.handshake_done == 0 && started.elapsed() < VERDICT_MAX {
            if let Ok(e) = timeout(TICK, connection.closed()).await {
                return Err(self.refused(&e));
            }
        }
        sleep(LINGER).await;
        Ok(true)
    }

    /// What is wrong with the other side, by an error before the handshake's end here.
    fn their_fault(&self, e: &ConnectionError) -> TlsError {
        match e {
            ConnectionError::TransportError(e) if e.reason.contains(BAD_CERTIFICATE) => {
                self.server(self.their_certificate(&e.reason))
            }
            ConnectionError::ConnectionClosed(_) | ConnectionError::ApplicationClosed(_) => {
                self.refused(e)
            }
            e => self.server(format!("{e}: {}", no_quic())),
        }
    }

    /// What is wrong with its certificate, by what rustls says of it.
    fn their_certificate(&self, said: &str) -> String {
        let authority = self.credentials.authority_path().display();
        if said.contains("UnknownIssuer") || said.contains("BadSignature") {
            format!(
                "its certificate is not from the authority of {authority}; if it is the right machine, copy ca.pem from where \
                 deploy/certs.sh made its certificate"
            )
        } else if said.contains("not valid yet") {
            "its certificate is not valid yet: the clock of this machine is wrong, or of the one on which it was made".into()
        } else if said.contains("expired") {
            "its certificate has expired: remove replay-server.pem and replay-server.key, let deploy/certs.sh make new ones, and start \
             it again; if it did not, this machine's clock is wrong"
                .into()
        } else if said.contains("not valid for name") {
            format!(
                "its certificate is not for {host}: connect by a name that it is for, or remove replay-server.pem and \
                 replay-server.key there and make them anew with `deploy/certs.sh DIR --host {host}`",
                host = self.host_and_port().map_or("", |(host, _)| host)
            )
        } else if said.contains("extended key usage") {
            "its certificate is that of an actor, a learner or an observer, not of a replay server"
                .into()
        } else {
            said.to_owned()
        }
    }

    /// That the other side refuses this part, by what it said.
    fn refused(&self, e: &ConnectionError) -> TlsError {
        let why = match alert(e) {
            Some(AlertDescription::UnknownCA | AlertDescription::DecryptError) => {
                "its ca.pem is of another authority; copy there the one with which this certificate was made, or make a \
                 certificate with the authority that it has"
                    .into()
            }
            Some(AlertDescription::CertificateExpired) => {
                "it holds it for expired or not valid yet, which it is not by the clock here: set both clocks".into()
            }
            Some(AlertDescription::NoApplicationProtocol) => {
                "it speaks QUIC and is no replay server of this program".into()
            }
            Some(other) => format!("{other:?}; its own log says more"),
            None => format!("it closed the connection ({e}); its own log says more"),
        };
        TlsError::Refused {
            endpoint: self.endpoint.into(),
            path: self.credentials.certificate_path().into(),
            why,
        }
    }
}

/// How rustls begins what it says of a certificate.
const BAD_CERTIFICATE: &str = "invalid peer certificate";

/// The codes with which QUIC closes a connection for an alert of TLS, which is the low byte.
const ALERTS: std::ops::Range<u64> = 0x100..0x200;

/// What the other side's TLS says.
fn alert(e: &ConnectionError) -> Option<AlertDescription> {
    let ConnectionError::ConnectionClosed(close) = e else {
        return None;
    };
    let code = u64::from(close.error_code);
    ALERTS
        .contains(&code)
        .then(|| AlertDescription::from((code - ALERTS.start) as u8))
}

fn no_quic() -> String {
    "it does not speak QUIC: start the replay server with --tls-dir and --listen quic/HOST:PORT, or connect with tcp/HOST:PORT and \
     without --tls-dir to one that does not have it"
        .into()
}
