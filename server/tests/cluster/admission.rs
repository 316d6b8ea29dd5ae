//! Nodes that NATS lets in, and those that it does not.

use super::nats::Nats;
use super::nodes::{HELLO, Node};
use super::process::wait_for;
use super::watch::Watch;
use serde_json::{Value, json};
use std::time::Duration;

/// An authority, and a certificate of this machine that it has signed.
struct Certificates {
    _folder: tempfile::TempDir,
    ca: String,
    cert: String,
    key: String,
}

fn certificates() -> Certificates {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).display().to_string();
    let (authority_key, key) = (rcgen::KeyPair::generate().unwrap(), rcgen::KeyPair::generate().unwrap());
    let mut authority = rcgen::CertificateParams::new([]).unwrap();
    authority.is_ca = rcgen::IsCa::Ca(rcgen::BasicConstraints::Unconstrained);
    std::fs::write(path("ca.pem"), authority.self_signed(&authority_key).unwrap().pem()).unwrap();
    let issuer = rcgen::Issuer::new(authority, authority_key);
    let mut params = rcgen::CertificateParams::new(["127.0.0.1".to_owned()]).unwrap();
    params.distinguished_name = rcgen::DistinguishedName::new();
    let cert = params.signed_by(&key, &issuer).unwrap();
    std::fs::write(path("cert.pem"), cert.pem()).unwrap();
    std::fs::write(path("key.pem"), key.serialize_pem()).unwrap();
    let (ca, cert, key) = (path("ca.pem"), path("cert.pem"), path("key.pem"));
    Certificates { _folder: folder, ca, cert, key }
}

pub fn own_certificate() {
    let Certificates { _folder, ca, cert, key } = certificates();
    let nats = Nats::with(&["--tlsverify", "--tlscacert", &ca, "--tlscert", &cert, "--tlskey", &key]);
    let url = format!("tls://127.0.0.1:{}", nats.port);
    let with_ca = ["--cluster-ca", &ca];
    let a = Node::with(&url, &[&with_ca[..], &["--cluster-cert", &cert, "--cluster-key", &key]].concat()).ready();
    a.publisher("demo", HELLO).ready();
    // Shown one that its authority has not signed.
    let other = certificates();
    for more in [&[][..], &["--cluster-cert", &other.cert, "--cluster-key", &other.key]] {
        let outside = Node::with(&url, &[&with_ca[..], more].concat());
        std::thread::sleep(Duration::from_millis(500));
        assert!(outside.get("/healthz").unwrap().starts_with("degraded"), "{more:?}");
    }
}

pub fn password_and_certificates() {
    let Certificates { _folder, ca, cert, key } = certificates();
    let nats = Nats::with(&["--tls", "--tlscert", &cert, "--tlskey", &key, "--user", "node", "--pass", "s3cret"]);
    let url = |word: &str| format!("tls://node:{word}@127.0.0.1:{}", nats.port);
    let a = Node::with(&url("s3cret"), &["--cluster-ca", &ca]).ready();
    let mut publisher = a.publisher("demo", HELLO).ready();
    let watch = Watch::start(&[&a.address], "demo");
    publisher.frame(0.3);
    watch.wait_for_more("a face");
    for (word, more) in [("wrong", &["--cluster-ca", &ca][..]), ("s3cret", &[])] {
        let outside = Node::with(&url(word), more);
        std::thread::sleep(Duration::from_millis(500));
        assert!(outside.get("/healthz").unwrap().starts_with("degraded"), "{word} {more:?}");
        assert!(!outside.log().contains("s3cret"), "passwords are not logged");
    }
    watch.finish();
}

pub fn advertised_address() {
    let nats = Nats::start();
    let everywhere = ["--listen", "0.0.0.0:0", "--insecure"];
    let warning = "--cluster-advertise";
    let silent = Node::with(&nats.url(), &everywhere).ready();
    assert!(silent.log().contains(warning), "{}", silent.log());
    let named = "wss://face.example:7879";
    let telling = Node::with(&nats.url(), &[&everywhere[..], &["--cluster-advertise", named]].concat()).ready();
    assert!(!telling.log().contains(warning), "{}", telling.log());
    wait_for("its address", || silent.rooms()["nodes"].as_object().unwrap().values().any(|address| address == named).then_some(()));
}

/// Text of a JSON Web Token as NATS signs it.
fn signed(by: &nkeys::KeyPair, subject: &str, claims: &Value) -> String {
    let claims = json!({ "jti": subject, "iat": 1_700_000_000, "iss": by.public_key(), "sub": subject, "name": "test", "nats": claims });
    let text = format!("{}.{}", base64url(br#"{"typ":"JWT","alg":"ed25519-nkey"}"#), base64url(claims.to_string().as_bytes()));
    format!("{text}.{}", base64url(&by.sign(text.as_bytes()).unwrap()))
}

/// RFC 4648, 5, without padding.
fn base64url(bytes: &[u8]) -> String {
    const LETTERS: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789-_";
    let mut text = String::new();
    for three in bytes.chunks(3) {
        let bits = (0..3).fold(0_u32, |bits, k| bits << 8 | u32::from(three.get(k).copied().unwrap_or(0)));
        text.extend((0..=three.len()).map(|k| char::from(LETTERS[(bits >> (18 - 6 * k)) as usize & 63])));
    }
    text
}

pub fn credentials() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).display().to_string();
    let (operator, account, system) = (nkeys::KeyPair::new_operator(), nkeys::KeyPair::new_account(), nkeys::KeyPair::new_account());
    let user = nkeys::KeyPair::new_user();
    let limits = json!({
        "subs": -1, "data": -1, "payload": -1, "imports": -1, "exports": -1, "wildcards": true, "conn": -1, "leaf": -1,
        "mem_storage": -1, "disk_storage": -1, "streams": -1, "consumer": -1,
    });
    let of_account = json!({ "type": "account", "version": 2, "limits": limits });
    let plain = json!({ "type": "account", "version": 2, "limits": { "subs": -1, "data": -1, "payload": -1, "conn": -1, "leaf": -1 } });
    let of_operator = json!({ "type": "operator", "version": 2, "system_account": system.public_key() });
    let config = format!(
        "operator: {}\nsystem_account: {}\nresolver: MEMORY\nresolver_preload: {{\n  {}: {}\n  {}: {}\n}}\n",
        signed(&operator, &operator.public_key(), &of_operator),
        system.public_key(),
        account.public_key(),
        signed(&operator, &account.public_key(), &of_account),
        system.public_key(),
        signed(&operator, &system.public_key(), &plain),
    );
    std::fs::write(path("nats.conf"), config).unwrap();
    let of_user = json!({ "type": "user", "version": 2, "subs": -1, "data": -1, "payload": -1 });
    let jwt = signed(&account, &user.public_key(), &of_user);
    let dashes = "-----";
    let creds = format!(
        "{dashes}BEGIN NATS USER JWT{dashes}\n{jwt}\n{dashes}-END NATS USER JWT-{dashes}\n\n\
         {dashes}BEGIN USER NKEY SEED{dashes}\n{}\n{dashes}-END USER NKEY SEED-{dashes}\n",
        user.seed().unwrap()
    );
    std::fs::write(path("node.creds"), creds).unwrap();
    let nats = Nats::with(&["-c", &path("nats.conf")]);
    let a = Node::with(&nats.url(), &["--cluster-creds", &path("node.creds")]).ready();
    a.publisher("demo", HELLO).ready();
    let outside = Node::start(&nats.url());
    std::thread::sleep(Duration::from_millis(500));
    assert!(outside.get("/healthz").unwrap().starts_with("degraded"), "without them nobody comes in");
}
