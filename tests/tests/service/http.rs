//! Pages, listings, and who may come in.

use super::harness::Server;
use rhytid_shared::DEFAULT_CHARACTER_GLB;
use std::collections::BTreeMap;
use std::io::{Read, Write};
use std::net::TcpStream;

fn body_of(refusal: tungstenite::http::Response<Option<Vec<u8>>>) -> (u16, String) {
    (refusal.status().as_u16(), String::from_utf8(refusal.into_body().unwrap_or_default()).unwrap())
}

#[test]
fn everything_is_served_at_its_address() {
    let server = Server::start();
    let viewer = server.viewer("demo");
    let mut publisher = server.ready_publisher("demo");
    publisher.frame(0.5, 0.5);
    server.wait_for_room("demo", |room| room.is_some_and(|room| room["frame"]["t"] == 0.5));

    let (head, body) = server.get("/healthz", "");
    assert!(head.starts_with("HTTP/1.1 200") && body == b"ok\n", "{head}");
    let (head, body) = server.get("/", "");
    // With or without the page in the browser, by what the server was built with.
    assert!(head.contains("text/html") && String::from_utf8(body).unwrap().contains("<title>Rhytid</title>"), "{head}");
    let head = head.to_lowercase();
    assert!(head.contains("content-security-policy: default-src 'none'; ") && !head.contains("'unsafe-eval'"), "{head}");
    assert!(head.contains("x-content-type-options: nosniff") && head.contains("frame-ancestors 'self'"), "{head}");
    for outside in ["/../Cargo.toml", "/%2e%2e/Cargo.toml", "/bundle.txt", "//etc/passwd", "/face_mesh", "/index.html/"] {
        let (head, _) = server.get(outside, "");
        assert!(head.starts_with("HTTP/1.1 404"), "{outside}: {head}");
    }
    let (head, body) = server.get(&viewer.hello.character.url, "");
    assert!(head.contains("model/gltf-binary") && body == DEFAULT_CHARACTER_GLB, "{head}");
    let tag = format!("If-None-Match: \"{}\"\r\n", viewer.hello.character.sha256);
    assert!(server.get(&viewer.hello.character.url, &tag).0.starts_with("HTTP/1.1 304"));
    let (head, body) = server.get("/characters/../Cargo.toml", "");
    assert!(head.starts_with("HTTP/1.1 404"), "{head} {body:?}");
    let (head, body) = server.get("/characters/nobody.glb", "");
    assert!(head.starts_with("HTTP/1.1 404") && String::from_utf8(body).unwrap().contains(&viewer.hello.character.url));

    let (head, body) = server.get("/metrics", "");
    assert!(head.contains("text/plain; version=0.0.4"), "{head}");
    let text = String::from_utf8(body).unwrap();
    for line in [
        "rhytid_rooms 1",
        "rhytid_publishers 1",
        "rhytid_viewers 1",
        "rhytid_frames_in_total 1",
        "rhytid_solve_seconds_count 1",
        "rhytid_in_bytes_total ",
        "rhytid_out_bytes_total ",
        "# TYPE rhytid_frames_dropped_total counter",
    ] {
        assert!(text.lines().any(|given| given.starts_with(line)), "no {line:?} in\n{text}");
    }
    let room = server.room("demo").unwrap();
    assert_eq!(
        (room["viewers"].as_u64(), room["publisher"]["source"].as_str(), room["session"].as_u64()),
        (Some(1), Some("test"), Some(1))
    );
}

#[test]
fn a_json_viewer_can_recompute_every_influence() {
    let server = Server::start();
    let mut viewer = server.json_viewer("demo");
    let mut publisher = server.ready_publisher("demo");
    let character = viewer.hello.character.clone();
    let index_of = |name: &String| character.bones.iter().position(|bone| bone.name == *name).unwrap();
    for i in 0..40u32 {
        let wave = |speed: f64| 0.5 - 0.5 * (f64::from(i) * speed).cos();
        publisher.send(&format!(
            r#"{{"type":"frame","t":{},"weights":{{"browInnerUp":{},"browDownLeft":{},"mouthSmileLeft":{},"mouthPucker":{},"jawOpen":{},"eyeBlinkLeft":{}}}}}"#,
            f64::from(i) * 0.04, wave(0.3), wave(0.2), wave(0.25), wave(0.15), wave(0.1), wave(0.4),
        ));
        let frame = viewer.next_json();
        for (pose, row) in character.poses.iter().zip(&frame.influence) {
            let travel = |bone: usize, to: &[f32; 3]| -> [f64; 3] {
                std::array::from_fn(|axis| f64::from(to[axis]) - f64::from(character.bones[bone].rest[axis]))
            };
            // Projection on the way from rest to the pose, clamped ([D09] 5.1, with the square in the denominator).
            let mut wanted = vec![0.0; character.bones.len()];
            let mut lengths = vec![0.0; character.bones.len()];
            for (name, point) in &pose.bones {
                let bone = index_of(name);
                let (u, d) = (travel(bone, point), travel(bone, &frame.bones[bone]));
                let square: f64 = u.iter().map(|x| x * x).sum();
                lengths[bone] = square.sqrt();
                wanted[bone] = (u.iter().zip(d).map(|(u, d)| u * d).sum::<f64>() / square).clamp(0.0, 1.0);
            }
            // Then the mean over each group's members that the pose moves ([D09] 5.2).
            for group in &character.groups {
                let members: Vec<usize> = group.iter().map(index_of).collect();
                let moved: Vec<usize> = members.iter().copied().filter(|bone| lengths[*bone] > 0.0).collect();
                let mean = moved.iter().map(|bone| wanted[*bone]).sum::<f64>() / moved.len().max(1) as f64;
                members.iter().for_each(|bone| wanted[*bone] = mean);
            }
            for (bone, (got, wanted)) in row.iter().zip(&wanted).enumerate() {
                // Half a code, half a step of position, and for bones that turn half a step of rotation at their arm.
                let step = if character.bones[bone].pivot.is_some() { 60e-6 } else { 22e-6 };
                let tolerance = 0.5 / 255.0 + if lengths[bone] > 0.0 { step / lengths[bone] } else { 0.02 };
                assert!(
                    (f64::from(*got) - wanted).abs() <= tolerance,
                    "{} {} is {got}, recomputed {wanted} at frame {i}",
                    pose.name,
                    character.bones[bone].name
                );
            }
        }
    }
}

#[test]
fn subprotocols_are_chosen_or_refused() {
    let server = Server::start();
    let view = "/v1/rooms/demo/view";
    assert_eq!(server.connect(view, &[]).unwrap().protocol, None);
    for offer in ["rhytid.v1", "chat, rhytid.v1", "rhytid.v2,rhytid.v1"] {
        assert_eq!(server.connect(view, &[("Sec-WebSocket-Protocol", offer)]).unwrap().protocol.as_deref(), Some("rhytid.v1"), "{offer}");
    }
    for offer in ["chat", "rhytid.v2", "rhytid.v11, RHYTID.V1"] {
        let (status, body) = body_of(*server.connect(view, &[("Sec-WebSocket-Protocol", offer)]).err().unwrap());
        assert_eq!(status, 400, "{offer}");
        assert!(body.contains("unknown_subprotocol") && body.contains("expected rhytid.v1"), "{body}");
    }
    let (head, body) = server.get(view, "");
    assert!(head.starts_with("HTTP/1.1 426"), "{head}");
    assert!(String::from_utf8(body).unwrap().contains("expected a WebSocket handshake"));
}

#[test]
fn what_is_no_handshake_makes_no_room() {
    let server = Server::start();
    assert!(server.get("/v1/rooms/plain/view", "").0.starts_with("HTTP/1.1 426"));
    assert!(server.connect("/v1/rooms/other/view", &[("Sec-WebSocket-Protocol", "chat")]).is_err());
    assert_eq!((server.room("plain"), server.room("other")), (None, None));
    assert_eq!(server.metric("rhytid_rooms"), 0.0);
}

#[test]
fn bad_addresses_are_refused() {
    let server = Server::start();
    let long = format!("/v1/rooms/{}/view", "a".repeat(65));
    for path in ["/v1/rooms/a.b/view", "/v1/rooms/a%20b/publish", "/v1/rooms/%C3%A4/view", long.as_str()] {
        let (status, body) = body_of(*server.connect(path, &[]).err().unwrap());
        assert_eq!(status, 400, "{path}");
        assert!(body.contains("bad_room_name") && body.contains("1 to 64 characters"), "{body}");
    }
    let (status, body) = body_of(*server.connect("/v1/rooms/demo/view?format=xml", &[]).err().unwrap());
    assert!(status == 400 && body.contains("unknown_format"), "{body}");
    let (status, body) = body_of(*server.connect("/v2/rooms/demo/view", &[]).err().unwrap());
    assert!(status == 404 && body.contains("not_found"), "{body}");
}

#[test]
fn pages_of_other_sites_are_kept_out() {
    let server = Server::with(|config| {
        config.access.hosts = vec!["faces.example".into()];
        config.access.origins = vec!["https://studio.example".into()];
    });
    let own = format!("http://{}", server.address);
    let view = "/v1/rooms/demo/view";
    for origin in [own.as_str(), "https://studio.example"] {
        assert!(server.connect(view, &[("Origin", origin)]).is_ok(), "{origin}");
    }
    for origin in ["https://evil.example", "null", "http://127.0.0.1:1", "https://studio.example.evil.example"] {
        let (status, body) = body_of(*server.connect(view, &[("Origin", origin)]).err().unwrap());
        assert_eq!(status, 403, "{origin}");
        assert!(body.contains("forbidden_origin") && body.contains(origin), "{body}");
    }
    let port = server.address.port();
    for (host, status) in [
        (format!("localhost:{port}"), "200"),
        (format!("[::1]:{port}"), "200"),
        ("127.0.0.1".to_owned(), "200"),
        ("faces.example".to_owned(), "200"),
        (format!("rebound.example:{port}"), "403"),
        ("127.0.0.1.evil.example".to_owned(), "403"),
        (String::new(), "403"),
    ] {
        let (head, body) = server.get("/api/rooms", &format!("Host: {host}\r\n"));
        assert!(head.starts_with(&format!("HTTP/1.1 {status}")), "{host}: {head}");
        if status == "403" {
            assert!(String::from_utf8(body).unwrap().contains("forbidden_host"));
        }
    }
}

#[test]
fn elsewhere_than_on_loopback_a_name_must_be_listed() {
    // A page elsewhere can make any name of its own point here, but no address.
    let server = Server::with(|config| {
        config.listen = "0.0.0.0:0".into();
        config.access.insecure = true;
        config.access.hosts = vec!["faces.example".into()];
    });
    let port = server.address.port();
    for (host, status) in [
        (format!("192.168.1.5:{port}"), "200"),
        (format!("[2001:db8::1]:{port}"), "200"),
        (format!("localhost:{port}"), "200"),
        (format!("faces.example:{port}"), "200"),
        (format!("rebound.example:{port}"), "403"),
        ("192.168.1.5.evil.example".to_owned(), "403"),
        (String::new(), "403"),
    ] {
        let (head, body) = server.get("/api/rooms", &format!("Host: {host}\r\n"));
        assert!(head.starts_with(&format!("HTTP/1.1 {status}")), "{host}: {head}");
        assert_eq!(status == "403", String::from_utf8(body).unwrap().contains("forbidden_host"), "{host}");
    }
    let rebound = server.connect("/v1/rooms/demo/view", &[("Host", "rebound.example"), ("Origin", "http://rebound.example")]);
    assert_eq!(body_of(*rebound.err().unwrap()).0, 403);
}

#[test]
fn a_page_of_an_allowed_site_may_read_what_it_gets() {
    let server = Server::with(|config| config.access.origins = vec!["https://studio.example".into()]);
    let url = server.viewer("demo").hello.character.url;
    for path in [url.as_str(), "/api/rooms"] {
        let (head, _) = server.get(path, "Origin: https://studio.example\r\n");
        let head = head.to_lowercase();
        assert!(head.starts_with("http/1.1 200"), "{head}");
        assert!(head.contains("access-control-allow-origin: https://studio.example\r\n"), "{head}");
        // Caches keep the answers to different sites apart.
        assert!(head.contains("vary: origin"), "{head}");
        let (head, _) = server.get(path, &format!("Origin: http://{}\r\n", server.address));
        assert!(head.starts_with("HTTP/1.1 200") && !head.to_lowercase().contains("access-control-allow-origin"), "{head}");
        let (head, _) = server.get(path, "Origin: https://evil.example\r\n");
        assert!(head.starts_with("HTTP/1.1 403") && !head.to_lowercase().contains("access-control-allow-origin"), "{head}");
    }
}

/// Kind of each family in Prometheus's text format, and its samples; panics where the text breaks the format's rules.
fn parse_prometheus(text: &str) -> (BTreeMap<String, String>, Vec<(String, f64)>) {
    let (mut kinds, mut samples) = (BTreeMap::new(), vec![]);
    assert!(text.ends_with('\n'), "the last line ends, too");
    for line in text.lines() {
        if let Some(comment) = line.strip_prefix("# ") {
            let words: Vec<&str> = comment.splitn(3, ' ').collect();
            match words[..] {
                ["HELP", _, _] => {}
                ["TYPE", family, kind] => {
                    assert!(matches!(kind, "counter" | "gauge" | "histogram"), "{line}");
                    assert_eq!(kinds.insert(family.to_owned(), kind.to_owned()), None, "one type a family: {line}");
                }
                _ => panic!("neither HELP nor TYPE: {line}"),
            }
            continue;
        }
        let (series, value) = line.rsplit_once(' ').unwrap_or_else(|| panic!("no value: {line}"));
        let name = series.split('{').next().unwrap();
        assert!(name.bytes().all(|byte| byte.is_ascii_alphanumeric() || byte == b'_'), "{line}");
        assert_eq!(series.contains('{'), series.ends_with("\"}"), "{line}");
        let of_histogram = ["_bucket", "_sum", "_count"].iter().find_map(|end| name.strip_suffix(end));
        let family = of_histogram.filter(|family| kinds.get(*family).is_some_and(|kind| kind == "histogram")).unwrap_or(name);
        assert!(kinds.contains_key(family), "the type comes before its samples: {line}");
        samples.push((series.to_owned(), value.parse().unwrap_or_else(|_| panic!("no number: {line}"))));
    }
    (kinds, samples)
}

#[test]
fn metrics_are_in_prometheus_format_and_in_openmetrics_for_who_asks() {
    let server = Server::start();
    let mut publisher = server.ready_publisher("demo");
    publisher.send("{}");
    publisher.error();
    publisher.frame(0.5, 0.5);
    server.wait_for_room("demo", |room| room.is_some_and(|room| room["frame"]["t"] == 0.5));
    for accept in ["", "Accept: */*\r\n", "Accept: text/plain;version=0.0.4;q=0.5\r\n"] {
        let (head, body) = server.get("/metrics", accept);
        assert!(head.contains("text/plain; version=0.0.4"), "{head}");
        let (kinds, samples) = parse_prometheus(&String::from_utf8(body).unwrap());
        assert_eq!(kinds["rhytid_frames_in_total"], "counter");
        assert_eq!(kinds["rhytid_solve_seconds"], "histogram");
        let value = |series: &str| samples.iter().find(|(name, _)| name == series).unwrap_or_else(|| panic!("no {series}")).1;
        assert_eq!((value("rhytid_frames_in_total"), value("rhytid_publishers"), value("rhytid_solve_seconds_count")), (1.0, 1.0, 1.0));
        assert_eq!(value("rhytid_frames_dropped_total{reason=\"missing_field\"}"), 1.0);
        assert!(value("rhytid_connections") >= 2.0, "the publisher's and this one");
        assert_eq!(value("rhytid_solve_seconds_bucket{le=\"+Inf\"}"), 1.0);
    }
    let (head, body) = server.get("/metrics", "Accept: application/openmetrics-text;version=1.0.0,text/plain;q=0.5\r\n");
    assert!(head.contains("application/openmetrics-text; version=1.0.0"), "{head}");
    let text = String::from_utf8(body).unwrap();
    assert!(text.contains("# TYPE rhytid_frames_in counter\n") && text.ends_with("# EOF\n"), "{text}");
}

#[test]
fn connections_over_the_limit_are_told_in_one_line() {
    let server = Server::with(|config| config.limits.connections = 2);
    let first = server.ready_publisher("demo");
    let second = server.viewer("demo");
    let (head, body) = server.get("/healthz", "");
    assert!(head.starts_with("HTTP/1.1 503"), "{head}");
    let body = String::from_utf8(body).unwrap();
    assert!(body.contains("too_many_connections") && body.contains("the server has 2 connections already"), "{body}");
    let (status, _) = body_of(*server.connect("/v1/rooms/demo/view", &[]).err().unwrap());
    assert_eq!(status, 503);
    // Their places are free once the server has seen that they are gone.
    drop((first, second));
    server.wait_for_metric("rhytid_sessions_ended_total{reason=\"too_many_connections\"}", |count| count >= 2.0);
    server.wait_for_metric("rhytid_connections", |count| count == 1.0);
}

#[test]
fn a_download_that_nobody_reads_ends() {
    let server = Server::with(|config| config.timeouts.write = 0.3);
    let url = server.viewer("demo").hello.character.url;
    let mut deaf = TcpStream::connect(server.address).unwrap();
    deaf.write_all(format!("GET {url} HTTP/1.1\r\nHost: {}\r\n\r\n", server.address).as_bytes()).unwrap();
    // Only the one that asks is left.
    server.wait_for_metric("rhytid_connections", |count| count == 1.0);
    let mut got = vec![];
    // It may be a reset that ends it.
    let _ = deaf.read_to_end(&mut got);
    assert!(got.starts_with(b"HTTP/1.1 200") && got.len() < DEFAULT_CHARACTER_GLB.len(), "{} bytes", got.len());
}
