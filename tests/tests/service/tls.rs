//! The service under TLS, against real clients.

use super::harness::Server;
use rhytid_client::{Link, LinkOptions, LinkState};
use rhytid_server::{SendOptions, SendReport, SendSource, send};
use rhytid_shared::RoomName;
use rhytid_shared::trust::{Fingerprint, Trust};
use std::io::{Read, Write};
use std::net::TcpStream;
use std::path::Path;
use std::time::{Duration, Instant};

/// A certificate of its own authority for `localhost`, and its key, as files. Gives the certificate's fingerprint.
fn write_certificate(folder: &Path) -> Fingerprint {
    let made = rcgen::generate_simple_self_signed(vec!["localhost".into()]).unwrap();
    std::fs::write(folder.join("key.pem"), made.signing_key.serialize_pem()).unwrap();
    std::fs::write(folder.join("cert.pem"), made.cert.pem()).unwrap();
    Fingerprint::of(made.cert.der())
}

fn with_files(folder: &Path) -> Server {
    let (cert, key) = (folder.join("cert.pem"), folder.join("key.pem"));
    Server::with(move |config| (config.tls.cert, config.tls.key) = (Some(cert), Some(key)))
}

/// How a viewer's link stands once it has made up its mind.
fn watch(server: &Server, host: &str, trust: Trust) -> LinkState {
    let options = LinkOptions {
        servers: format!("wss://{host}:{}", server.address.port()).parse().unwrap(),
        room: RoomName::new("demo").unwrap(),
        trust,
        token: None,
        known_sha256: None,
    };
    let link = Link::open(options, || ());
    let start = Instant::now();
    loop {
        match link.state() {
            LinkState::Connecting if start.elapsed() < Duration::from_secs(20) => std::thread::sleep(Duration::from_millis(5)),
            state => return state,
        }
    }
}

#[test]
fn viewers_and_senders_trust_a_fingerprint_or_an_authority_and_nothing_else() {
    let folder = tempfile::tempdir().unwrap();
    let fingerprint = write_certificate(folder.path());
    let server = with_files(folder.path());
    // The character is fetched over the same way before the link is live.
    assert_eq!(watch(&server, "127.0.0.1", Trust::Fingerprint(fingerprint)), LinkState::Live);
    let authority = std::fs::read(folder.path().join("cert.pem")).unwrap();
    assert_eq!(watch(&server, "localhost", Trust::Authorities(authority.clone())), LinkState::Live);
    for (host, trust, said) in [
        ("localhost", Trust::Public, "is not trusted"),
        ("localhost", Trust::Fingerprint(Fingerprint::of(b"another")), "another fingerprint"),
        ("127.0.0.1", Trust::Authorities(authority.clone()), "is not trusted"),
    ] {
        let state = watch(&server, host, trust);
        assert!(matches!(&state, LinkState::Refused { message } if message.contains(said)), "{host}: {state:?}");
    }
    let options = |trust| SendOptions {
        source: SendSource::Text(
            "{\"type\":\"hello\",\"version\":1}\n{\"type\":\"frame\",\"t\":0,\"weights\":{\"jawOpen\":0.5}}\n".into(),
            "test feed".into(),
        ),
        to: format!("wss://localhost:{}", server.address.port()),
        room: "demo".into(),
        speed: f64::INFINITY,
        repeats: false,
        takeover: false,
        slot: None,
        priority: None,
        binary: false,
        profile: None,
        timeout: Duration::from_secs(15),
        trust,
        token: None,
    };
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    let send_now = |trust| {
        runtime.block_on(send(&options(trust), &indicatif::ProgressBar::hidden(), std::future::pending())).map_err(|e| e.to_string())
    };
    assert_eq!(send_now(Trust::Authorities(authority)), Ok(SendReport { frames: 1, errors: 0 }));
    let refused = send_now(Trust::Public).unwrap_err();
    assert!(refused.contains("certificate"), "{refused}");
}

#[test]
fn a_certificate_that_changes_is_read_again_and_nobody_is_cut_off() {
    let folder = tempfile::tempdir().unwrap();
    let first = write_certificate(folder.path());
    let server = with_files(folder.path());
    let options = LinkOptions {
        servers: format!("wss://localhost:{}", server.address.port()).parse().unwrap(),
        room: RoomName::new("demo").unwrap(),
        trust: Trust::Fingerprint(first),
        token: None,
        known_sha256: None,
    };
    let old = Link::open(options, || ());
    while old.state() == LinkState::Connecting {
        std::thread::sleep(Duration::from_millis(5));
    }
    // Rubbish first: the old one stays in use.
    std::fs::write(folder.path().join("cert.pem"), "no certificate").unwrap();
    std::thread::sleep(Duration::from_millis(2500));
    assert_eq!(watch(&server, "localhost", Trust::Fingerprint(first)), LinkState::Live);
    let second = write_certificate(folder.path());
    let start = Instant::now();
    while watch(&server, "localhost", Trust::Fingerprint(second)) != LinkState::Live {
        assert!(start.elapsed() < Duration::from_secs(10), "the new certificate is not in use");
        std::thread::sleep(Duration::from_millis(200));
    }
    assert_eq!((old.state(), old.stats().connects), (LinkState::Live, 1));
}

#[test]
fn whoever_does_not_speak_tls_is_told_and_whoever_says_nothing_is_dropped() {
    let server = Server::with(|config| {
        config.tls.self_signed = true;
        config.timeouts.hello = 0.5;
    });
    let mut stream = TcpStream::connect(server.address).unwrap();
    stream.write_all(b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n").unwrap();
    let mut answer = String::new();
    stream.read_to_string(&mut answer).unwrap();
    assert!(answer.starts_with("HTTP/1.1 400 ") && answer.contains("use https://"), "{answer}");
    // Silent, and one that begins a handshake and stops: both end, neither by us.
    for begin in [&b""[..], &[22, 3, 1, 2, 0, 1]] {
        let mut stream = TcpStream::connect(server.address).unwrap();
        stream.set_read_timeout(Some(Duration::from_secs(20))).unwrap();
        stream.write_all(begin).unwrap();
        assert_eq!(stream.read(&mut [0]).unwrap_or(0), 0);
    }
}
