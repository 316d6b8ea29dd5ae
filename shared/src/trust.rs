//! Whom the client end of an encrypted connection trusts: the public authorities, authorities of the user's own, or one
//! certificate by its fingerprint (what `serve --tls-self-signed` prints).

use rustls::client::WebPkiServerVerifier;
use rustls::client::danger::{HandshakeSignatureValid, ServerCertVerified, ServerCertVerifier};
use rustls::crypto::{CryptoProvider, ring, verify_tls12_signature, verify_tls13_signature};
use rustls::pki_types::pem::PemObject;
use rustls::pki_types::{CertificateDer, ServerName, UnixTime};
use rustls::{CertificateError, ClientConfig, DigitallySignedStruct, Error, RootCertStore, SignatureScheme};
use sha2::{Digest, Sha256};
use std::fmt;
use std::str::FromStr;
use std::sync::Arc;

/// Whom to trust.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub enum Trust {
    /// The authorities that Mozilla trusts.
    #[default]
    Public,
    /// The authorities in these PEM certificates, and no others.
    Authorities(Vec<u8>),
    /// The one certificate with this fingerprint, whatever names it bears.
    Fingerprint(Fingerprint),
}

/// SHA-256 of a certificate's DER bytes.
#[derive(Clone, Copy, PartialEq, Eq, Hash)]
pub struct Fingerprint([u8; 32]);

/// Why a trust cannot be had.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum TrustError {
    /// Not a fingerprint.
    #[error("fingerprint {got:?} is not 32 bytes in hexadecimal, with or without colons")]
    Fingerprint {
        /// What was given.
        got: String,
    },
    /// No certificate that can be read.
    #[error("the authorities' file holds no PEM certificate that can be used: {problem}")]
    Authorities {
        /// What is wrong with it.
        problem: String,
    },
}

impl Fingerprint {
    /// Of a certificate's DER bytes.
    pub fn of(certificate: &[u8]) -> Self {
        Self(Sha256::digest(certificate).into())
    }
}

impl fmt::Display for Fingerprint {
    /// As browsers show it: upper case, a colon between bytes.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (i, byte) in self.0.iter().enumerate() {
            write!(f, "{}{byte:02X}", if i == 0 { "" } else { ":" })?;
        }
        Ok(())
    }
}

impl fmt::Debug for Fingerprint {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Fingerprint({self})")
    }
}

impl FromStr for Fingerprint {
    type Err = TrustError;

    fn from_str(text: &str) -> Result<Self, TrustError> {
        let refuse = || TrustError::Fingerprint { got: text.chars().take(120).collect() };
        let digits: Vec<u8> = text.bytes().filter(|byte| *byte != b':').collect();
        let mut bytes = [0; 32];
        if digits.len() != 64 || !digits.iter().all(u8::is_ascii_hexdigit) {
            return Err(refuse());
        }
        for (byte, pair) in bytes.iter_mut().zip(digits.chunks_exact(2)) {
            let pair = std::str::from_utf8(pair).map_err(|_| refuse())?;
            *byte = u8::from_str_radix(pair, 16).map_err(|_| refuse())?;
        }
        Ok(Self(bytes))
    }
}

impl Trust {
    /// As people write it: nothing for the public authorities, a fingerprint, or else the name of a PEM file of authorities, which
    /// `read` reads. The error is a sentence.
    pub fn from_argument(text: &str, read: impl FnOnce(&str) -> std::io::Result<Vec<u8>>) -> Result<Self, String> {
        if text.is_empty() {
            return Ok(Self::Public);
        }
        if let Ok(fingerprint) = text.parse() {
            return Ok(Self::Fingerprint(fingerprint));
        }
        let pem = read(text).map_err(|error| format!("expected a SHA-256 fingerprint or a readable PEM file: {error}"))?;
        let trust = Self::Authorities(pem);
        trust.client_config().map_err(|error| error.to_string())?;
        Ok(trust)
    }

    /// The settings of a connection's client end, TLS 1.2 or 1.3, HTTP/1.1.
    pub fn client_config(&self) -> Result<Arc<ClientConfig>, TrustError> {
        let provider = Arc::new(ring::default_provider());
        let builder = ClientConfig::builder_with_provider(Arc::clone(&provider))
            .with_safe_default_protocol_versions()
            .expect("ring speaks TLS 1.2 and 1.3");
        let config = match self {
            Self::Public => {
                builder.with_root_certificates(RootCertStore { roots: webpki_roots::TLS_SERVER_ROOTS.to_vec() }).with_no_client_auth()
            }
            Self::Authorities(pem) => {
                let refuse = |problem: String| TrustError::Authorities { problem };
                let mut roots = RootCertStore::empty();
                for certificate in CertificateDer::pem_slice_iter(pem) {
                    let certificate = certificate.map_err(|error| refuse(error.to_string()))?;
                    roots.add(certificate).map_err(|error| refuse(error.to_string()))?;
                }
                let verifier = WebPkiServerVerifier::builder_with_provider(Arc::new(roots), provider);
                builder.with_webpki_verifier(verifier.build().map_err(|error| refuse(error.to_string()))?).with_no_client_auth()
            }
            Self::Fingerprint(expected) => builder
                .dangerous()
                .with_custom_certificate_verifier(Arc::new(Pinned { expected: *expected, provider }))
                .with_no_client_auth(),
        };
        Ok(Arc::new(config))
    }
}

/// Takes the one certificate that is expected; that its owner holds its key is checked as ever.
#[derive(Debug)]
struct Pinned {
    expected: Fingerprint,
    provider: Arc<CryptoProvider>,
}

impl ServerCertVerifier for Pinned {
    fn verify_server_cert(
        &self,
        certificate: &CertificateDer<'_>,
        _intermediates: &[CertificateDer<'_>],
        _name: &ServerName<'_>,
        _ocsp_response: &[u8],
        _now: UnixTime,
    ) -> Result<ServerCertVerified, Error> {
        if Fingerprint::of(certificate) == self.expected {
            Ok(ServerCertVerified::assertion())
        } else {
            Err(Error::InvalidCertificate(CertificateError::ApplicationVerificationFailure))
        }
    }

    fn verify_tls12_signature(
        &self,
        message: &[u8],
        certificate: &CertificateDer<'_>,
        signature: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, Error> {
        verify_tls12_signature(message, certificate, signature, &self.provider.signature_verification_algorithms)
    }

    fn verify_tls13_signature(
        &self,
        message: &[u8],
        certificate: &CertificateDer<'_>,
        signature: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, Error> {
        verify_tls13_signature(message, certificate, signature, &self.provider.signature_verification_algorithms)
    }

    fn supported_verify_schemes(&self) -> Vec<SignatureScheme> {
        self.provider.signature_verification_algorithms.supported_schemes()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_fingerprint_reads_as_it_prints() {
        let fingerprint = Fingerprint::of(b"certificate");
        assert_eq!(fingerprint.to_string().parse(), Ok(fingerprint));
        assert_eq!(fingerprint.to_string().to_lowercase().replace(':', "").parse(), Ok(fingerprint));
        for wrong in ["", "AB", &"é".repeat(32), &"0".repeat(65), &"+1".repeat(32)] {
            assert!(wrong.parse::<Fingerprint>().is_err(), "{wrong}");
        }
    }

    #[test]
    fn argument_is_nothing_a_fingerprint_or_a_file() {
        let unread = |_: &str| -> std::io::Result<Vec<u8>> { panic!("no file was named") };
        assert_eq!(Trust::from_argument("", unread), Ok(Trust::Public));
        let fingerprint = Fingerprint::of(b"certificate");
        assert_eq!(Trust::from_argument(&fingerprint.to_string(), unread), Ok(Trust::Fingerprint(fingerprint)));
        let missing = |_: &str| Err(std::io::ErrorKind::NotFound.into());
        assert!(Trust::from_argument("ca.pem", missing).unwrap_err().contains("PEM file"));
        assert!(Trust::from_argument("ca.pem", |_| Ok(b"no PEM".to_vec())).is_err());
    }

    #[test]
    fn authorities_that_are_none_are_refused() {
        for wrong in [&b""[..], b"no PEM", b"-----BEGIN CERTIFICATE-----\nAAAA\n-----END CERTIFICATE-----\n"] {
            assert!(Trust::Authorities(wrong.to_vec()).client_config().is_err());
        }
        Trust::Public.client_config().unwrap();
    }
}
