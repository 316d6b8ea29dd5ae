//! Gets a character from the server that animates it.

use rhytid_shared::limits::MAX_CHARACTER_BYTES;
use rhytid_shared::trust::Trust;
use sha2::{Digest, Sha256};
use std::time::Duration;
use ureq::tls::{PemItem, TlsConfig};

/// Why a character could not be had.
#[derive(Debug, thiserror::Error)]
pub(super) enum FetchError {
    #[error("the hello names the character {got:?}, expected a path that begins with one slash")]
    Path { got: String },
    #[error("the character cannot be fetched from {url}: {source}")]
    Http { url: String, source: Box<ureq::Error> },
    #[error("the character at {url} has SHA-256 {got}, expected {expected}")]
    Hash { url: String, got: String, expected: String },
}

/// Longest time for the whole file: 64 MB over 10 Mbit/s take 54 s.
const TIMEOUT: Duration = Duration::from_secs(60);

/// Whom `trust` trusts. A certificate known by its fingerprint is not checked here: nothing secret is asked for, and the file
/// is checked against the hash that came over the socket, where the certificate was.
fn tls(trust: &Trust) -> TlsConfig {
    match trust {
        Trust::Public => TlsConfig::default(),
        Trust::Authorities(pem) => {
            let certificates = ureq::tls::parse_pem(pem).filter_map(|item| match item {
                Ok(PemItem::Certificate(certificate)) => Some(certificate),
                _ => None,
            });
            TlsConfig::builder().root_certs(certificates.into()).build()
        }
        Trust::Fingerprint(_) => TlsConfig::builder().disable_verification(true).build(),
    }
}

/// The `.glb` at `path` of `server`. It is what `sha256` says, or an error.
pub(super) fn character(server: &super::ServerAddress, trust: &Trust, path: &str, sha256: &str) -> Result<Vec<u8>, FetchError> {
    // "//host" would be somewhere else.
    if !path.starts_with('/') || path.starts_with("//") || path.len() > 512 {
        return Err(FetchError::Path { got: path.chars().take(80).collect() });
    }
    let url = server.http_url(path);
    // Straight to the server as the socket goes: no proxy from the environment, no redirect to elsewhere.
    let agent = ureq::Agent::new_with_config(
        ureq::Agent::config_builder().timeout_global(Some(TIMEOUT)).proxy(None).max_redirects(0).tls_config(tls(trust)).build(),
    );
    let bytes = agent
        .get(&url)
        .call()
        .and_then(|mut response| response.body_mut().with_config().limit(MAX_CHARACTER_BYTES as u64).read_to_vec())
        .map_err(|source| FetchError::Http { url: url.clone(), source: Box::new(source) })?;
    let got: String = Sha256::digest(&bytes).iter().map(|byte| format!("{byte:02x}")).collect();
    if got != sha256 {
        return Err(FetchError::Hash { url, got, expected: sha256.chars().take(64).collect() });
    }
    Ok(bytes)
}
