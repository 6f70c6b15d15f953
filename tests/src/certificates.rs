//! Certificates made by `deploy/certificates`.

#![allow(clippy::unwrap_used, reason = "helpers of tests")]

use std::path::{Path, PathBuf};
use std::process::Command;

use teleop_common::net::{SessionConfig, Tls};

/// An authority of its own and certificates of it; dropping it removes them.
#[derive(Debug)]
pub struct Certificates {
    folder: tempfile::TempDir,
}

impl Certificates {
    /// An authority that has signed a certificate for each of `names`.
    ///
    /// # Panics
    /// If the script fails.
    #[must_use]
    pub fn of(names: &[&str]) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("../deploy/certificates");
        let output = Command::new(script).arg("--out").arg(folder.path()).args(names).output().unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        Self { folder }
    }

    /// A file of the folder.
    #[must_use]
    pub fn file(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    /// The files by which `name` shows who it is.
    #[must_use]
    pub fn tls(&self, name: &str) -> Tls {
        Tls {
            ca: self.file("ca.pem"),
            certificate: self.file(&format!("{name}.pem")),
            key: self.file(&format!("{name}.key")),
        }
    }

    /// The same as options of the binaries.
    #[must_use]
    pub fn flags(&self, name: &str) -> Vec<String> {
        let Tls { ca, certificate, key } = self.tls(name);
        let flag = |flag: &str, path: PathBuf| [flag.to_owned(), path.to_str().unwrap().to_owned()];
        [flag("--tls-ca", ca), flag("--tls-cert", certificate), flag("--tls-key", key)].concat()
    }

    /// A session of `name` that connects to `endpoint`.
    #[must_use]
    pub fn session(&self, name: &str, endpoint: &str) -> SessionConfig {
        SessionConfig { tls: Some(self.tls(name)), ..SessionConfig::connecting([endpoint]) }
    }
}
