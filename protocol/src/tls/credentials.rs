//! Reads and checks the files of one process in a folder of certificates, before anything is sent.
//! Each process checks its own files at its start.

use std::{
    fs, io,
    net::IpAddr,
    os::unix::fs::PermissionsExt,
    path::{Path, PathBuf},
    time::Duration,
};

use rustls::{
    CertificateError, RootCertStore,
    client::verify_server_cert_signed_by_trust_anchor,
    crypto::ring,
    pki_types::{CertificateDer, PrivateKeyDer, UnixTime, pem::PemObject},
    server::{ParsedCertificate, WebPkiClientVerifier},
    sign::CertifiedKey,
};
use serde_json::json;
use x509_parser::prelude::{FromDer, GeneralName, X509Certificate};

use super::access::{ACTORS_MAX, Role};

/// Why a process cannot use its certificate or its key, and what to do.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub struct TlsError(String);

/// The user is told of a certificate that expires sooner.
const EXPIRES_SOON: Duration = Duration::from_secs(30 * 24 * 3600);

/// The path of the authority's certificate in a folder.
pub fn authority_path(folder: &Path) -> PathBuf {
    folder.join("ca.pem")
}

/// A process's certificate and key, and the authority that it trusts. [`Credentials::read`] has checked them.
#[derive(Debug)]
pub struct Credentials {
    /// The role of this process.
    pub role: Role,
    authority: PathBuf,
    certificate: PathBuf,
    key: PathBuf,
    /// When the certificate expires, seconds since 1970.
    expires_unix_s: i64,
    /// When the certificate expires, as text for the user.
    pub expires_on: String,
    /// The host names and addresses in the certificate. Clients connect to the replay server by one of them.
    pub hosts: Vec<String>,
}

impl Credentials {
    /// Reads `ca.pem`, `ROLE.pem` and `ROLE.key` in `folder`, and checks that they belong to this role and to each other.
    ///
    /// # Errors
    /// A file is missing, unreadable, expired, not valid yet, or of another role, authority or key. The error says what to do.
    pub fn read(folder: &Path, role: Role) -> Result<Self, TlsError> {
        if let Role::Actor(number) = role
            && number >= ACTORS_MAX
        {
            return Err(TlsError(format!(
                "actor {number} has no certificate: with --tls-dir actors have the numbers 0 to {}, see --id",
                ACTORS_MAX - 1
            )));
        }
        let file = |ending| folder.join(format!("{role}.{ending}"));
        let (authority, certificate, key) = (authority_path(folder), file("pem"), file("key"));
        let authorities = read_certificates(&authority, role)?;
        let chain = read_certificates(&certificate, role)?;
        let secret = PrivateKeyDer::from_pem_slice(&read(&key, role)?);
        let secret = secret.map_err(|_| pem_error(&key))?;
        let own = parse(&chain[0], &certificate)?;
        let names = own.subject().iter_common_name();
        let names: Vec<_> = names.map(|it| it.as_str().unwrap_or_default()).collect();
        if names != [role.to_string().as_str()] {
            return Err(TlsError(format!(
                "{} is the certificate of {:?}, not of {:?}: each process has its own; `deploy/certs.sh {}` makes it",
                certificate.display(),
                names.join(", "),
                role.to_string(),
                certs_args(&certificate, role)
            )));
        }
        check_dates(&own, &certificate, role)?;
        let expires_unix_s = own.validity().not_after.timestamp();
        let (expires_on, hosts) = (own.validity().not_after.to_string(), host_names(&own));
        let mut roots = RootCertStore::empty();
        for one in authorities {
            check_dates(&parse(&one, &authority)?, &authority, role)?;
            roots.add(one).map_err(|_| pem_error(&authority))?;
        }
        check_signed(&roots, &chain, role).map_err(|why| {
            TlsError(format!(
                "{} was not signed by the authority of {} ({why}): take both from the same run of `deploy/certs.sh`",
                certificate.display(),
                authority.display()
            ))
        })?;
        let provider = ring::default_provider();
        let signer = provider.key_provider.load_private_key(secret);
        let signer = signer.map_err(|_| pem_error(&key))?;
        let pair = CertifiedKey::new(chain, signer);
        pair.keys_match().map_err(|_| {
            TlsError(format!(
                "{} is not the key of {}: they were made at different times; remove both and `deploy/certs.sh {}` makes them anew",
                key.display(),
                certificate.display(),
                certs_args(&certificate, role)
            ))
        })?;
        Ok(Self {
            role,
            authority,
            certificate,
            key,
            expires_unix_s,
            expires_on,
            hosts,
        })
    }

    /// How long the certificate is still valid.
    pub fn expires_in(&self) -> Duration {
        let now = UnixTime::now().as_secs() as i64;
        let left = self.expires_unix_s.saturating_sub(now);
        Duration::from_secs(u64::try_from(left).unwrap_or(0))
    }

    /// What the user should do about these files, although they can be used; `None` if nothing.
    pub fn advice(&self) -> Option<String> {
        let (certificate, key) = (self.certificate.display(), self.key.display());
        let mode = fs::metadata(&self.key).map(|it| it.permissions().mode());
        if mode.is_ok_and(|mode| mode & 0o077 != 0) {
            Some(format!(
                "{key} can be read by other users of this machine, who could take this role: chmod 600 {key}"
            ))
        } else if self.expires_in() < EXPIRES_SOON {
            Some(format!(
                "{certificate} expires at {}, and its process is disconnected then: remove it and its key, let deploy/certs.sh make new \
                 ones, and restart that process",
                self.expires_on
            ))
        } else if self.role == Role::ReplayServer && self.hosts.is_empty() {
            Some(format!(
                "{certificate} names no host, so no client can connect: remove it and its key, and `deploy/certs.sh {}` makes new ones",
                certs_args(&self.certificate, self.role)
            ))
        } else {
            None
        }
    }

    pub(crate) fn zenoh_settings(&self) -> String {
        let [authority, certificate, key] =
            [&self.authority, &self.certificate, &self.key].map(|it| it.to_string_lossy());
        let settings = json!({
            "root_ca_certificate": authority,
            "listen_certificate": certificate, "listen_private_key": key,
            "connect_certificate": certificate, "connect_private_key": key,
            "enable_mtls": true, "verify_name_on_connect": true, "close_link_on_expiration": true,
        });
        settings.to_string()
    }
}

fn read(path: &Path, role: Role) -> Result<Vec<u8>, TlsError> {
    fs::read(path).map_err(|why| {
        TlsError(match why.kind() {
            io::ErrorKind::NotFound => format!(
                "{} is not there: the role {role} needs ca.pem, {role}.pem and {role}.key; `deploy/certs.sh {}` makes them, \
                 beside the authority's key, and you copy them here",
                path.display(),
                certs_args(path, role)
            ),
            _ => format!(
                "{} cannot be read: {why}; it belongs to the user who starts this process",
                path.display()
            ),
        })
    })
}

/// The arguments of `deploy/certs.sh` that make the files of `role` beside `path`.
fn certs_args(path: &Path, role: Role) -> String {
    let folder = path.parent().unwrap_or(path).display();
    format!("{folder} {}", role.certs_args()).trim_end().into()
}

fn pem_error(path: &Path) -> TlsError {
    let what = match path.extension() {
        Some(ending) if ending == "key" => "private key",
        _ => "certificate",
    };
    TlsError(format!(
        "{} holds no {what} in PEM: `deploy/certs.sh` makes such files; copy it again, or remove it and make it anew",
        path.display()
    ))
}

/// Reads the certificates in a file; an error if there are none.
fn read_certificates(path: &Path, role: Role) -> Result<Vec<CertificateDer<'static>>, TlsError> {
    let bytes = read(path, role)?;
    let found: Result<Vec<_>, _> = CertificateDer::pem_slice_iter(&bytes).collect();
    match found {
        Ok(found) if !found.is_empty() => Ok(found),
        _ => Err(pem_error(path)),
    }
}

fn parse<'a>(der: &'a CertificateDer<'_>, path: &Path) -> Result<X509Certificate<'a>, TlsError> {
    let parsed = X509Certificate::from_der(der);
    parsed.map(|(_, it)| it).map_err(|_| pem_error(path))
}

fn check_dates(certificate: &X509Certificate<'_>, path: &Path, role: Role) -> Result<(), TlsError> {
    let (validity, now) = (certificate.validity(), UnixTime::now().as_secs() as i64);
    let shown = path.display();
    if now > validity.not_after.timestamp() {
        return Err(TlsError(format!(
            "{shown} expired at {}: remove it and its key, and `deploy/certs.sh {}` makes new ones; if it did not, this machine's clock is \
             wrong",
            validity.not_after,
            certs_args(path, role)
        )));
    }
    if now < validity.not_before.timestamp() {
        return Err(TlsError(format!(
            "{shown} is valid only from {} on: this machine's clock is wrong, or that of the machine on which it was made",
            validity.not_before
        )));
    }
    Ok(())
}

/// Checks that the authority signed the first certificate of `chain` for the side of the connection that `role` takes: server or client.
fn check_signed(
    roots: &RootCertStore,
    chain: &[CertificateDer<'static>],
    role: Role,
) -> Result<(), String> {
    let describe = |e: rustls::Error| match e {
        rustls::Error::InvalidCertificate(
            CertificateError::InvalidPurpose | CertificateError::InvalidPurposeContext { .. },
        ) => "it is made for the other side of a connection".into(),
        e => e.to_string(),
    };
    let (own, others) = (&chain[0], &chain[1..]);
    // zenoh uses the same provider of cryptographic algorithms.
    let (provider, now) = (ring::default_provider(), UnixTime::now());
    if role == Role::ReplayServer {
        let algorithms = provider.signature_verification_algorithms.all;
        let own = ParsedCertificate::try_from(own).map_err(describe)?;
        return verify_server_cert_signed_by_trust_anchor(&own, roots, others, now, algorithms)
            .map_err(describe);
    }
    let verifier =
        WebPkiClientVerifier::builder_with_provider(roots.clone().into(), provider.into())
            .build()
            .map_err(|e| e.to_string())?;
    let verified = verifier.verify_client_cert(own, others, now);
    verified.map(drop).map_err(describe)
}

fn host_names(certificate: &X509Certificate<'_>) -> Vec<String> {
    let Ok(Some(names)) = certificate.subject_alternative_name() else {
        return Vec::new();
    };
    let names = names.value.general_names.iter();
    names
        .filter_map(|name| match name {
            GeneralName::DNSName(name) => Some((*name).to_owned()),
            GeneralName::IPAddress(bytes) => match bytes.len() {
                4 => Some(IpAddr::from(<[u8; 4]>::try_from(*bytes).ok()?).to_string()),
                _ => Some(IpAddr::from(<[u8; 16]>::try_from(*bytes).ok()?).to_string()),
            },
            _ => None,
        })
        .collect()
}
