//! Certificates for tests: made by `deploy/certs.sh`, and made invalid with openssl in several ways.
//! This module starts no process of the program under test.

use std::{
    fs,
    path::{Path, PathBuf},
    process::Command,
};

use crate::process::run;

/// A complete folder for `--tls-dir`.
#[derive(Debug)]
pub struct Certificates {
    folder: PathBuf,
}

/// The validity period of an expired certificate: start and end, in openssl's format.
pub const EXPIRED: [&str; 2] = ["20200101000000Z", "20200201000000Z"];
/// The validity period of a certificate that is not valid before the year 2090.
pub const FUTURE: [&str; 2] = ["20900101000000Z", "20910101000000Z"];

impl Certificates {
    /// Runs `deploy/certs.sh` for a folder, which may already exist; `args` are split at blanks.
    pub fn make(folder: PathBuf, args: &str) -> Self {
        let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("../deploy/certs.sh");
        let (parent, name) = (folder.parent().unwrap(), folder.file_name().unwrap());
        let mut command = Command::new(script);
        // A shell that follows CDPATH prints where it went.
        command.current_dir(parent).env("CDPATH", parent).arg(name);
        let said = run(command.args(args.split_whitespace()));
        assert!(!said.starts_with('/'), "{said}");
        Self::in_folder(folder)
    }

    pub(crate) const fn in_folder(folder: PathBuf) -> Self {
        Self { folder }
    }

    /// Returns the path of a file in the folder.
    pub fn path(&self, name: &str) -> PathBuf {
        self.folder.join(name)
    }

    /// Copies the files to a new folder, where a test can make them invalid.
    pub fn copy_to(&self, to: PathBuf) -> Self {
        fs::create_dir(&to).unwrap();
        for entry in fs::read_dir(&self.folder).unwrap() {
            let entry = entry.unwrap();
            fs::copy(entry.path(), to.join(entry.file_name())).unwrap();
        }
        Self { folder: to }
    }

    /// Replaces the certificate and key of `as_role` by those of `role`.
    pub fn replace_role(&self, role: &str, as_role: &str) {
        for ending in ["pem", "key"] {
            let file = |role| self.path(&format!("{role}.{ending}"));
            fs::copy(file(role), file(as_role)).unwrap();
        }
    }

    /// Signs the certificate of `role` again, with another validity period.
    pub fn sign_again(self, role: &str, [start, end]: [&str; 2]) -> Self {
        let openssl = |args: String| {
            let mut command = Command::new("openssl");
            run(command
                .current_dir(&self.folder)
                .args(args.split_whitespace()))
        };
        let old = openssl(format!(
            "x509 -noout -ext extendedKeyUsage,subjectAltName -in {role}.pem"
        ));
        let usage = match old.contains("Server") {
            true => "extendedKeyUsage=serverAuth\nsubjectAltName=IP:127.0.0.1",
            false => "extendedKeyUsage=clientAuth",
        };
        let config = format!(
            "[ca]\ndefault_ca=a\n[a]\nnew_certs_dir=.\ndatabase=index\nrand_serial=yes\ndefault_md=sha256\npolicy=p\nunique_subject=no\n\
             x509_extensions=e\n[p]\ncommonName=supplied\n[e]\nbasicConstraints=critical,CA:FALSE\n{usage}\n"
        );
        fs::write(self.path("config"), config).unwrap();
        fs::write(self.path("index"), "").unwrap();
        openssl(format!(
            "req -new -key {role}.key -subj /CN={role} -out request"
        ));
        openssl(format!(
            "ca -batch -notext -config config -cert ca.pem -keyfile ca.key -in request -out {role}.pem -startdate {start} -enddate {end}"
        ));
        self
    }
}
