//! Who may connect, and what they may do: certificates, and access by the names in them.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use rustls::RootCertStore;
use rustls::client::verify_server_cert_signed_by_trust_anchor;
use rustls::crypto::{CryptoProvider, ring};
use rustls::pki_types::pem::PemObject;
use rustls::pki_types::{CertificateDer, PrivateKeyDer, UnixTime};
use rustls::server::{ParsedCertificate, WebPkiClientVerifier};
use rustls::sign::CertifiedKey;
use serde_json::json;

use super::NetError;
use crate::key::ROOT;

/// The files, PEM, by which this process and its peers prove to each other who they are. Links without encryption do
/// not use them.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Tls {
    /// The certificate authority; only what it signed may connect, or be connected to.
    pub ca: PathBuf,
    /// This process's certificate, signed by the authority, then the authorities in between, if any. Its common name is
    /// what [`Access`] goes by; its alternative names are the hosts that peers may reach it at.
    pub certificate: PathBuf,
    /// The private key of the certificate.
    pub key: PathBuf,
}

/// Who may do what with a robot, or through a router, by the common names of their certificates. Whoever is not named may
/// nothing.
///
/// An observer may watch and stop. A stop is reset by the operator that has the robot alone, on a key where observers may
/// not write.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Access {
    /// May drive, stop and watch.
    pub operators: Vec<String>,
    /// May stop and watch.
    pub observers: Vec<String>,
    /// Of a router: are robots.
    pub robots: Vec<String>,
    /// Of a router: are routers, and may pass on what anybody may.
    pub routers: Vec<String>,
}

impl Tls {
    /// Whether the files are there, belong together, and are valid today.
    ///
    /// zenoh would find out in the handshake, again and again, and say so in its log alone.
    pub(super) fn check(&self, listens: bool, connects: bool) -> Result<(), NetError> {
        let authorities = certificates(&self.ca)?;
        let chain = certificates(&self.certificate)?;
        let key = PrivateKeyDer::from_pem_slice(&read(&self.key)?)
            .map_err(|error| refused(&self.key, format!("it holds no private key that can be read ({error})")))?;
        let provider = ring::default_provider();
        CertifiedKey::from_der(chain.clone(), key, &provider).map_err(|error| match error {
            rustls::Error::InconsistentKeys(_) => {
                refused(&self.key, format!("it is not the key of {}", self.certificate.display()))
            }
            rustls::Error::InvalidCertificate(_) => refused(&self.certificate, why(&error, &self.ca)),
            error => refused(&self.key, error.to_string()),
        })?;
        let mut roots = RootCertStore::empty();
        for authority in authorities {
            roots.add(authority).map_err(|error| refused(&self.ca, why(&error, &self.ca)))?;
        }
        verify(&chain, roots, provider, listens, connects)
            .map_err(|error| refused(&self.certificate, why(&error, &self.ca)))
    }

    /// The settings of zenoh, at `transport/link/tls`.
    pub(super) fn settings(&self) -> String {
        json!({
            "root_ca_certificate": self.ca,
            "listen_certificate": self.certificate,
            "listen_private_key": self.key,
            "connect_certificate": self.certificate,
            "connect_private_key": self.key,
            "enable_mtls": true,
            "verify_name_on_connect": true,
        })
        .to_string()
    }
}

const IN: &str = "ingress";
const OUT: &str = "egress";

impl Access {
    /// The settings of zenoh, at `access_control`.
    pub(super) fn settings(&self) -> String {
        // As a robot sees the others; a router sees them from both sides.
        let rules = [
            ("drive", IN, &["put"][..], &["cmd/pose"][..]),
            ("reset", IN, &["put"], &["cmd/reset"]),
            ("show", IN, &["liveliness_token"], &["live/operator/*"]),
            ("stop", IN, &["put"], &["cmd/stop"]),
            ("watch", IN, &["declare_subscriber"], &["state/*"]),
            ("ask", IN, &["query"], &["srv/*"]),
            ("look", IN, &["liveliness_query", "declare_liveliness_subscriber"], &["live/**"]),
            ("tell", OUT, &["put", "reply"], &["state/*", "srv/*"]),
            ("offer", OUT, &["declare_subscriber", "declare_queryable"], &["cmd/*", "srv/*"]),
            ("live", OUT, &["liveliness_token"], &["live/robot/*"]),
        ];
        let id = |name: &str, flow: &str| format!("{name}-{flow}");
        let rule = |(name, flow, messages, keys): (&str, &str, &[&str], &[&str])| {
            let keys: Vec<_> = keys.iter().map(|key| format!("{ROOT}/*/{key}")).collect();
            json!({
                "id": id(name, flow), "permission": "allow", "flows": [flow], "messages": messages, "key_exprs": keys,
            })
        };
        let mirrored = |flow| if flow == IN { OUT } else { IN };
        let own: Vec<_> = rules.iter().map(|(name, flow, ..)| id(name, flow)).collect();
        let other: Vec<_> = rules.iter().map(|(name, flow, ..)| id(name, mirrored(*flow))).collect();
        let both = [own.as_slice(), &other].concat();
        let people = [
            ("operators", &self.operators, own.clone()),
            ("observers", &self.observers, own[3..].to_vec()),
            ("robots", &self.robots, other.clone()),
            ("routers", &self.routers, both),
        ];
        // zenoh takes an empty list of names for "anybody".
        let named = || people.iter().filter(|(_, names, _)| !names.is_empty());
        let subjects: Vec<_> = named().map(|(id, names, _)| json!({ "id": id, "cert_common_names": names })).collect();
        let policies: Vec<_> = named().map(|(id, _, rules)| json!({ "rules": rules, "subjects": [id] })).collect();
        let all = rules.into_iter().flat_map(|(name, flow, messages, keys)| {
            [(name, flow, messages, keys), (name, mirrored(flow), messages, keys)]
        });
        json!({
            "enabled": true, "default_permission": "deny",
            "rules": all.map(rule).collect::<Vec<_>>(), "subjects": subjects, "policies": policies,
        })
        .to_string()
    }
}

fn refused(path: &Path, reason: String) -> NetError {
    NetError::Certificate { path: path.to_owned(), reason }
}

fn read(path: &Path) -> Result<Vec<u8>, NetError> {
    std::fs::read(path).map_err(|error| refused(path, format!("it cannot be read: {error}")))
}

fn certificates(path: &Path) -> Result<Vec<CertificateDer<'static>>, NetError> {
    let bytes = read(path)?;
    let list: Result<Vec<_>, _> = CertificateDer::pem_slice_iter(&bytes).collect();
    match list {
        Ok(list) if !list.is_empty() => Ok(list),
        Ok(_) => Err(refused(path, "it holds no certificate (PEM)".to_owned())),
        Err(error) => Err(refused(path, format!("it holds no certificate that can be read ({error})"))),
    }
}

/// As the peers will: a listener is verified as a server, a connector as a client.
fn verify(
    chain: &[CertificateDer<'static>],
    roots: RootCertStore,
    provider: CryptoProvider,
    listens: bool,
    connects: bool,
) -> Result<(), rustls::Error> {
    let Some((own, between)) = chain.split_first() else { return Ok(()) };
    let now = UnixTime::now();
    if listens {
        let algorithms = provider.signature_verification_algorithms.all;
        verify_server_cert_signed_by_trust_anchor(
            &ParsedCertificate::try_from(own)?,
            &roots,
            between,
            now,
            algorithms,
        )?;
    }
    if connects {
        let verifier = WebPkiClientVerifier::builder_with_provider(Arc::new(roots), Arc::new(provider));
        let verifier = verifier.build().map_err(|error| rustls::Error::General(error.to_string()))?;
        verifier.verify_client_cert(own, between, now)?;
    }
    Ok(())
}

/// What is wrong with a certificate, and what to do.
fn why(error: &rustls::Error, ca: &Path) -> String {
    use rustls::CertificateError::{
        BadSignature, Expired, ExpiredContext, InvalidPurpose, InvalidPurposeContext, NotValidYet, NotValidYetContext,
        UnknownIssuer,
    };
    let rustls::Error::InvalidCertificate(error) = error else { return error.to_string() };
    match error {
        UnknownIssuer | BadSignature => {
            format!("it is not signed by {}: take the authority that signed it", ca.display())
        }
        Expired | ExpiredContext { .. } => "it has expired: make a new one".to_owned(),
        NotValidYet | NotValidYetContext { .. } => "it is not valid yet: is this machine's date right?".to_owned(),
        InvalidPurpose | InvalidPurposeContext { .. } => {
            "its extended key usage forbids it: a listener needs serverAuth, who connects needs clientAuth".to_owned()
        }
        error => error.to_string(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nobody_is_a_subject_without_a_name() {
        let access = Access { operators: vec!["ada".to_owned()], ..Access::default() };
        let settings: serde_json::Value = serde_json::from_str(&access.settings()).unwrap();
        assert_eq!(settings["default_permission"], "deny");
        assert_eq!(settings["subjects"], json!([{ "id": "operators", "cert_common_names": ["ada"] }]));
        assert_eq!(settings["policies"].as_array().unwrap().len(), 1);
        let observers = Access { observers: vec!["eve".to_owned()], ..Access::default() }.settings();
        let observers: serde_json::Value = serde_json::from_str(&observers).unwrap();
        let rules = observers["policies"][0]["rules"].as_array().unwrap();
        assert!(rules.contains(&"stop-ingress".into()), "{rules:?}");
        let may_not = ["drive-ingress", "reset-ingress", "show-ingress"];
        assert!(!rules.iter().any(|rule| may_not.contains(&rule.as_str().unwrap())), "{rules:?}");
        // A robot at a router does what the others do at a robot the other way round.
        let robots = Access { robots: vec!["left".to_owned()], ..Access::default() }.settings();
        let robots: serde_json::Value = serde_json::from_str(&robots).unwrap();
        let rules = robots["policies"][0]["rules"].as_array().unwrap();
        assert!(rules.contains(&"tell-ingress".into()) && !rules.contains(&"drive-ingress".into()), "{rules:?}");
    }

    #[test]
    fn files_that_are_none_are_named() {
        let tls = Tls { ca: "/nowhere/ca.pem".into(), certificate: "c.pem".into(), key: "k.pem".into() };
        let error = tls.check(true, true).unwrap_err().to_string();
        assert!(error.contains("/nowhere/ca.pem") && error.contains("No such file"), "{error}");
        let tls = Tls { ca: concat!(env!("CARGO_MANIFEST_DIR"), "/Cargo.toml").into(), ..tls };
        let error = tls.check(true, true).unwrap_err().to_string();
        assert!(error.contains("no certificate"), "{error}");
    }
}
