//! The real program watching a small server over real sockets: the window under a virtual display, the film without one,
//! and what is said where one of them is impossible. What a machine lacks shows as ignored.

#![allow(clippy::result_large_err, reason = "tungstenite's callbacks are declared so")]

use libtest_mimic::{Arguments, Failed, Trial};
use rhytid_shared::packet::Encoder;
use rhytid_shared::view::{SUBPROTOCOL, ViewHello, ViewMessage};
use rhytid_shared::{Character, DEFAULT_CHARACTER_GLB, FaceFrame};
use std::net::{TcpListener, TcpStream};
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::time::{Duration, Instant};
use tungstenite::Message;
use tungstenite::handshake::server::{ErrorResponse, Request, Response};
use tungstenite::http::{HeaderValue, StatusCode};

fn main() {
    let has_adapter = has_adapter();
    let has_display = has_adapter && has_xvfb();
    let trial = |name: &str, can_run: bool, test: fn() -> Result<(), Failed>| Trial::test(name, test).with_ignored_flag(!can_run);
    let trials = vec![
        trial("window_shows_the_live_face_beside_its_panel", has_display, window_shows_the_live_face_beside_its_panel),
        trial("window_without_a_display_names_the_other_ways", cfg!(target_os = "linux"), window_without_a_display_names_the_other_ways),
        trial("film_records_the_session_and_ends_with_it", has_adapter, film_records_the_session_and_ends_with_it),
        trial("film_of_a_server_that_refuses_says_why", has_adapter, film_of_a_server_that_refuses_says_why),
        // Direct3D exists on Windows only.
        trial("film_without_an_adapter_says_what_to_install", !cfg!(windows), film_without_an_adapter_says_what_to_install),
        trial("wrong_addresses_and_rooms_are_refused", true, wrong_addresses_and_rooms_are_refused),
    ];
    libtest_mimic::run(&Arguments::from_args(), trials).exit();
}

fn has_adapter() -> bool {
    let instance = wgpu::Instance::new(wgpu::InstanceDescriptor::new_without_display_handle_from_env());
    pollster::block_on(wgpu::util::initialize_adapter_from_env_or_default(&instance, None)).is_ok()
}

fn has_xvfb() -> bool {
    std::env::var_os("PATH").is_some_and(|path| std::env::split_paths(&path).any(|folder| folder.join("xvfb-run").is_file()))
}

const CLIENT: &str = env!("CARGO_BIN_EXE_rhytid-client");

/// A folder of this test's own, emptied.
fn folder(name: &str) -> PathBuf {
    let path = Path::new(env!("CARGO_TARGET_TMPDIR")).join(name);
    let _ = std::fs::remove_dir_all(&path);
    std::fs::create_dir_all(&path).expect("the build's own folder can be written");
    path
}

/// Serves one viewer: a hello, then `seconds` of a face that raises its brows once a second, then silence.
fn serve_one_viewer(seconds: u64) -> String {
    let listener = TcpListener::bind("127.0.0.1:0").expect("loopback has a free port");
    let address = format!("ws://{}", listener.local_addr().expect("it is bound"));
    std::thread::spawn(move || {
        let (stream, _) = listener.accept().expect("the viewer comes");
        serve(stream, seconds);
    });
    address
}

fn serve(stream: TcpStream, seconds: u64) {
    let character = Character::from_glb(DEFAULT_CHARACTER_GLB).expect("the default character is whole");
    let accept = |_: &Request, mut response: Response| {
        response.headers_mut().insert("Sec-WebSocket-Protocol", HeaderValue::from_static(SUBPROTOCOL));
        Ok::<_, ErrorResponse>(response)
    };
    let mut socket = tungstenite::accept_hdr(stream, accept).expect("the viewer speaks WebSocket");
    let hello = ViewMessage::Hello(ViewHello::new("demo", &character, "/characters/default.glb".into()));
    socket.send(Message::text(serde_json::to_string(&hello).expect("a hello is JSON"))).expect("the viewer listens");

    let mut encoder = Encoder::new(&character);
    let rest = FaceFrame::at_rest(&character);
    let pose = &character.poses[0];
    let started_at = Instant::now();
    for seq in 0.. {
        let t = started_at.elapsed();
        if t > Duration::from_secs(seconds) {
            break;
        }
        let mut frame = rest.clone();
        (frame.seq, frame.captured_at_micros) = (seq, t.as_micros() as u64);
        let amount = 0.5 - 0.5 * (std::f32::consts::TAU * t.as_secs_f32()).cos();
        for (i, point) in frame.points.iter_mut().enumerate() {
            *point = point.lerp(pose.points[i], amount);
            frame.influences[i] = if pose.points[i] == rest.points[i] { 0.0 } else { amount };
        }
        let mut packet = Vec::new();
        encoder.encode(&frame, &mut packet);
        if socket.send(Message::binary(packet)).is_err() {
            return;
        }
        std::thread::sleep(Duration::from_millis(40));
    }
    // Silent, but there: answers pings until the viewer leaves.
    while socket.read().is_ok() {}
}

fn stderr(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

fn window_shows_the_live_face_beside_its_panel() -> Result<(), Failed> {
    let shot = folder("window").join("window.png");
    let output = Command::new("xvfb-run")
        .args(["-a", "-s", "-screen 0 1280x800x24", CLIENT, "view", &serve_one_viewer(60), "--screenshot"])
        .arg(&shot)
        .env_remove("WAYLAND_DISPLAY")
        .env_remove("WAYLAND_SOCKET")
        .output()?;
    if !output.status.success() {
        return Err(format!("{}: {}", output.status, stderr(&output)).into());
    }
    let picture = image::open(&shot)?.to_rgb8();
    let (width, height) = picture.dimensions();
    let mean = |x: u32, y: u32, side: u32| {
        let pixels = (0..side * side).map(|at| picture.get_pixel(x + at % side, y + at / side).0);
        pixels.fold([0.0; 3], |sum, pixel| [0, 1, 2].map(|c| sum[c] + f64::from(pixel[c]) / f64::from(side * side)))
    };
    // Between the panel's edge and its text nothing is painted but its own colour.
    assert_eq!(picture.get_pixel(width - 4, height / 2).0, [0x17, 0x18, 0x1b], "the panel stands on the right");
    let face = mean((width - 288) / 2 - 20, height / 2 - 20, 40);
    assert!(face[0] > 70.0 && face[0] > face[2] * 1.1, "skin in the middle of the rest: {face:?}");
    let corner = mean(4, 4, 20);
    assert!(face[0] - corner[0] > 30.0, "the face stands out from {corner:?}");
    Ok(())
}

fn window_without_a_display_names_the_other_ways() -> Result<(), Failed> {
    let output =
        Command::new(CLIENT).arg("view").env_remove("DISPLAY").env_remove("WAYLAND_DISPLAY").env_remove("WAYLAND_SOCKET").output()?;
    let said = stderr(&output);
    assert!(!output.status.success());
    assert!(said.starts_with("error: no display for a window") && said.contains("`film`") && said.contains("`render`"), "{said}");
    assert_eq!(said.trim_end().lines().count(), 1, "{said}");
    Ok(())
}

fn film_records_the_session_and_ends_with_it() -> Result<(), Failed> {
    let out = folder("film");
    let output =
        Command::new(CLIENT).args(["film", &serve_one_viewer(3), "--size", "96x96", "--seconds", "60", "--out"]).arg(&out).output()?;
    if !output.status.success() {
        return Err(format!("{}: {}", output.status, stderr(&output)).into());
    }
    let said = String::from_utf8_lossy(&output.stdout).into_owned();
    for name in ["face.gif", "contact-sheet.png"] {
        let path = out.join(name);
        assert!(said.contains(&path.display().to_string()), "{said}");
        assert!(path.is_file(), "{name}");
    }
    let decoder = image::codecs::gif::GifDecoder::new(std::io::BufReader::new(std::fs::File::open(out.join("face.gif"))?))?;
    let frames = image::AnimationDecoder::into_frames(decoder).collect_frames()?;
    let millis: u32 = frames.iter().map(|frame| frame.delay().numer_denom_ms()).map(|(n, d)| n / d).sum();
    // Three seconds, and the easing to neutral after them.
    assert!((2500..8000).contains(&millis), "{millis} ms");
    assert!(frames.len() > 3, "{} pictures", frames.len());
    let first = frames[0].buffer();
    assert!(frames.iter().any(|frame| frame.buffer() != first), "the face moves");
    let sheet = image::open(out.join("contact-sheet.png"))?;
    assert!(sheet.width() > 1000 && sheet.height() > 600);
    Ok(())
}

fn film_of_a_server_that_refuses_says_why() -> Result<(), Failed> {
    let listener = TcpListener::bind("127.0.0.1:0")?;
    let address = format!("ws://{}", listener.local_addr()?);
    std::thread::spawn(move || {
        let (stream, _) = listener.accept().expect("the viewer comes");
        let refuse = |_: &Request, _: Response| {
            let mut response = ErrorResponse::new(None);
            *response.status_mut() = StatusCode::FORBIDDEN;
            Err(response)
        };
        drop(tungstenite::accept_hdr(stream, refuse));
    });
    let output = Command::new(CLIENT).args(["film", &address, "--size", "64x64", "--out"]).arg(folder("refused")).output()?;
    let said = stderr(&output);
    assert!(!output.status.success());
    assert!(said.contains("no live face came: Refused: 403 Forbidden"), "{said}");
    Ok(())
}

fn film_without_an_adapter_says_what_to_install() -> Result<(), Failed> {
    let output = Command::new(CLIENT).args(["film", "--out"]).arg(folder("adapter")).env("WGPU_BACKEND", "dx12").output()?;
    let said = stderr(&output);
    assert!(!output.status.success());
    assert!(said.contains("no GPU adapter found") && said.contains("mesa-vulkan-drivers"), "{said}");
    Ok(())
}

fn wrong_addresses_and_rooms_are_refused() -> Result<(), Failed> {
    for (args, expected) in [
        (["view", "http://127.0.0.1:7878", "--room", "demo"], "is not ws://HOST[:PORT]"),
        (["view", "wss://127.0.0.1:7878", "--trust", "no/such.pem"], "expected a SHA-256 fingerprint or a readable PEM file"),
        (["view", "ws://127.0.0.1:7878", "--room", "a b"], "is not 1 to 64 characters"),
    ] {
        let output = Command::new(CLIENT).args(args).output()?;
        let said = stderr(&output);
        assert_eq!(output.status.code(), Some(2), "{said}");
        assert!(said.contains(expected), "{said}");
    }
    Ok(())
}
