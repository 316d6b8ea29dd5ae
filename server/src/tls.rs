//! TLS: the server's certificate, from files that are read again when they change or made at the start, and the handshake.

use crate::config::{ServerConfigError, Tls, seconds};
use crate::service::Hub;
use crate::socket::{ErrorMessage, say_and_close};
use crate::stream::Wire;
use rhytid_shared::trust::Fingerprint;
use rustls::crypto::ring;
use rustls::pki_types::pem::PemObject;
use rustls::pki_types::{CertificateDer, PrivateKeyDer};
use rustls::server::{ClientHello, ResolvesServerCert};
use rustls::sign::CertifiedKey;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::sync::{Arc, PoisonError, RwLock};
use std::time::{Duration, SystemTime};
use tokio::net::TcpStream;
use tokio_rustls::TlsAcceptor;

/// How often the files are looked at for a change.
pub(crate) const RELOAD_INTERVAL: Duration = Duration::from_secs(2);
/// Largest file of certificates or of a key; a chain takes about 10 KB.
const MOST_PEM_BYTES: u64 = 1 << 20;
/// First byte of a TLS record that begins a handshake (RFC 8446, 5.1).
const HANDSHAKE_RECORD: u8 = 22;

/// Why there is no certificate.
#[derive(Debug, thiserror::Error)]
pub enum TlsError {
    /// A file could not be read.
    #[error("cannot read {what} {path}: {problem}")]
    File {
        /// Certificate or key.
        what: &'static str,
        /// The file as it was named.
        path: String,
        /// What is wrong with it.
        problem: String,
    },
    /// The key is not the certificate's, or of a kind that is not known.
    #[error("certificate {certificate} and key {key} do not work together: {problem}")]
    Pair {
        /// The certificate's file.
        certificate: String,
        /// The key's file.
        key: String,
        /// What is wrong.
        problem: String,
    },
    /// A certificate could not be made.
    #[error("cannot make a certificate: {0}")]
    Make(#[from] rcgen::Error),
}

/// What the server proves itself with.
pub struct Identity {
    acceptor: TlsAcceptor,
    certificate: Arc<Current>,
    files: Option<Files>,
}

/// The certificate in use; new connections take it, old ones keep theirs.
#[derive(Debug)]
struct Current(RwLock<Arc<CertifiedKey>>);

impl ResolvesServerCert for Current {
    fn resolve(&self, _hello: ClientHello<'_>) -> Option<Arc<CertifiedKey>> {
        Some(self.get())
    }
}

impl Current {
    fn get(&self) -> Arc<CertifiedKey> {
        // Replaced in one step, so a panicking holder leaves it whole.
        self.0.read().unwrap_or_else(PoisonError::into_inner).clone()
    }

    fn set(&self, certificate: CertifiedKey) {
        *self.0.write().unwrap_or_else(PoisonError::into_inner) = Arc::new(certificate);
    }
}

/// The files of a certificate, and what they were when they were last looked at.
struct Files {
    certificate: PathBuf,
    key: PathBuf,
    seen: [Option<(SystemTime, u64)>; 2],
}

impl Files {
    fn look(&self) -> [Option<(SystemTime, u64)>; 2] {
        [&self.certificate, &self.key].map(|path| {
            let about = std::fs::metadata(path).ok()?;
            Some((about.modified().ok()?, about.len()))
        })
    }

    fn load(&self) -> Result<CertifiedKey, TlsError> {
        let certificate = read("certificate", &self.certificate)?;
        let key = read("key", &self.key)?;
        let refuse = |what, path: &Path, problem: String| TlsError::File { what, path: path.display().to_string(), problem };
        let chain = CertificateDer::pem_slice_iter(&certificate)
            .collect::<Result<Vec<_>, _>>()
            .map_err(|error| refuse("certificate", &self.certificate, error.to_string()))?;
        if chain.is_empty() {
            return Err(refuse("certificate", &self.certificate, "it holds no PEM certificate".into()));
        }
        let key = PrivateKeyDer::from_pem_slice(&key)
            .map_err(|error| refuse("key", &self.key, format!("it holds no PEM private key ({error})")))?;
        CertifiedKey::from_der(chain, key, &ring::default_provider()).map_err(|error| TlsError::Pair {
            certificate: self.certificate.display().to_string(),
            key: self.key.display().to_string(),
            problem: error.to_string(),
        })
    }
}

fn read(what: &'static str, path: &Path) -> Result<Vec<u8>, TlsError> {
    let refuse = |problem: String| TlsError::File { what, path: path.display().to_string(), problem };
    let len = std::fs::metadata(path).map_err(|error| refuse(error.to_string()))?.len();
    if len > MOST_PEM_BYTES {
        return Err(refuse(format!("it has {len} bytes, expected a PEM file of at most {MOST_PEM_BYTES}")));
    }
    std::fs::read(path).map_err(|error| refuse(error.to_string()))
}

impl Identity {
    /// The certificate that `tls` names or asks for, `None` where it asks for none. One made here bears the names localhost,
    /// `address` and `names`, and lives as long as the process.
    pub fn load(tls: &Tls, address: SocketAddr, names: &[String]) -> Result<Option<Self>, TlsError> {
        let (certificate, files) = match (&tls.cert, &tls.key) {
            (Some(certificate), Some(key)) => {
                let mut files = Files { certificate: certificate.clone(), key: key.clone(), seen: [None; 2] };
                files.seen = files.look();
                (files.load()?, Some(files))
            }
            _ if tls.self_signed => (self_signed(address, names)?, None),
            _ => return Ok(None),
        };
        let certificate = Arc::new(Current(RwLock::new(Arc::new(certificate))));
        let mut config = rustls::ServerConfig::builder_with_provider(Arc::new(ring::default_provider()))
            .with_safe_default_protocol_versions()
            .expect("ring speaks TLS 1.2 and 1.3")
            .with_no_client_auth()
            .with_cert_resolver(certificate.clone());
        // WebSockets want HTTP/1.1 (RFC 6455, 4.1).
        config.alpn_protocols = vec![b"http/1.1".to_vec()];
        // Viewers stay for long: what a resumed handshake saves is not worth the memory of a session store.
        config.session_storage = Arc::new(rustls::server::NoServerSessionStorage {});
        config.send_tls13_tickets = 0;
        Ok(Some(Self { acceptor: TlsAcceptor::from(Arc::new(config)), certificate, files }))
    }

    /// Of the certificate in use.
    pub fn fingerprint(&self) -> Fingerprint {
        let current = self.certificate.get();
        Fingerprint::of(current.end_entity_cert().expect("both kinds are made with a certificate"))
    }

    /// Reads the files again where they have changed. A pair that does not work leaves the old one in use; it is looked at
    /// again when it changes again, as when the second of the two files has been written too.
    pub(crate) fn reload(&mut self) {
        let Some(files) = &mut self.files else { return };
        let now = files.look();
        if now == files.seen {
            return;
        }
        files.seen = now;
        match files.load() {
            Ok(certificate) => {
                self.certificate.set(certificate);
                tracing::info!(fingerprint = %self.fingerprint(), "certificate loaded again");
            }
            Err(error) => tracing::warn!(%error, "the certificate has changed and cannot be used; the old one stays"),
        }
    }

    pub(crate) fn acceptor(&self) -> TlsAcceptor {
        self.acceptor.clone()
    }
}

/// Shakes hands on a new connection; `None` where that came to nothing, which the peer has been told as far as it can be.
pub(crate) async fn shake_hands(hub: &Hub, acceptor: &TlsAcceptor, stream: TcpStream, peer: SocketAddr) -> Option<Wire> {
    let timeout = seconds(hub.config.timeouts.hello);
    let shaking = async {
        let mut first = [0];
        if stream.peek(&mut first).await? == 1 && first[0] != HANDSHAKE_RECORD {
            return Ok(Err(stream));
        }
        acceptor.accept(stream).await.map(Ok)
    };
    match tokio::time::timeout(timeout, shaking).await {
        Ok(Ok(Ok(stream))) => return Some(Wire::Encrypted(Box::new(stream))),
        // Whoever forgot the s of https deserves a word that can be read.
        Ok(Ok(Err(stream))) => {
            hub.metrics.end("not_tls");
            let error = ErrorMessage::new("not_tls", "this server speaks TLS only: use https:// or wss://");
            let body = serde_json::to_string(&error).expect("plain data can be written");
            let answer = format!(
                "HTTP/1.1 400 Bad Request\r\nContent-Type: application/json\r\nContent-Length: {}\r\nConnection: close\r\n\r\n{body}",
                body.len()
            );
            say_and_close(Wire::Plain(stream), answer.as_bytes()).await;
        }
        Ok(Err(error)) => {
            hub.metrics.end("tls_handshake");
            tracing::debug!(%peer, %error, "TLS handshake failed");
        }
        Err(_) => {
            hub.metrics.end("tls_timeout");
            tracing::debug!(%peer, "no TLS handshake in time");
        }
    }
    None
}

fn self_signed(address: SocketAddr, names: &[String]) -> Result<CertifiedKey, TlsError> {
    let mut all = vec!["localhost".to_owned(), "127.0.0.1".to_owned(), "::1".to_owned()];
    let own = (!address.ip().is_unspecified()).then(|| address.ip().to_string());
    for name in own.iter().chain(names) {
        if !all.contains(name) {
            all.push(name.clone());
        }
    }
    let key = rcgen::KeyPair::generate()?;
    let mut about = rcgen::CertificateParams::new(all)?;
    about.distinguished_name.push(rcgen::DnType::CommonName, "Rhytid, self-signed");
    let certificate = about.self_signed(&key)?;
    let key = PrivateKeyDer::Pkcs8(key.serialize_der().into());
    let key = ring::sign::any_supported_type(&key).expect("the key was made by the same library");
    Ok(CertifiedKey::new(vec![certificate.der().clone()], key))
}

/// Certificate and key come together or not at all, and not beside a self-signed one.
pub(crate) fn validate(tls: &Tls) -> Result<(), ServerConfigError> {
    let refuse = |field, got: &str, expected| Err(ServerConfigError::Range { field, got: got.into(), expected });
    match (&tls.cert, &tls.key, tls.self_signed) {
        (Some(_), None, _) => refuse("tls.key", "not given", "the key of tls.cert"),
        (None, Some(_), _) => refuse("tls.cert", "not given", "the certificate of tls.key"),
        (Some(_), Some(_), true) => refuse("tls.self_signed", "true", "false where tls.cert is given"),
        _ => Ok(()),
    }
}
