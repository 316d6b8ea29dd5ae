//! The guided fit over real sockets: by the publisher itself, and by somebody who speaks for a tracker.

use super::harness::{Client, Server, Viewer};
use rhytid_server::{Guide, LiveFit, SendOptions, SendSource, fit_live, send};
use rhytid_shared::trust::Trust;
use rhytid_shared::{ARKIT_NAMES, FitStep, Profile, ProfileChoice, RoomName, Settings};
use serde_json::{Value, json};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

/// A person whose faces go half as far as the character's; pulls the mouth to the side that the tracker calls the other.
fn weights(step: &str) -> Value {
    match step {
        "brows_up" => json!({"browInnerUp": 0.5, "browOuterUpLeft": 0.5, "browOuterUpRight": 0.5}),
        "frown" => json!({"browDownLeft": 0.5, "browDownRight": 0.5}),
        "smile" => json!({"mouthSmileLeft": 0.5, "mouthSmileRight": 0.5}),
        "pucker" => json!({"mouthPucker": 0.5}),
        "jaw_open" => json!({"jawOpen": 0.5}),
        "blink" => json!({"eyeBlinkLeft": 0.5, "eyeBlinkRight": 0.5}),
        "mouth_left" => json!({"mouthRight": 0.5}),
        _ => json!({}),
    }
}

struct Sender {
    publisher: Client,
    t: f64,
}

impl Sender {
    fn new(server: &Server, hello: &Value) -> (Self, Value) {
        let mut publisher = server.publisher("demo");
        publisher.send(&hello.to_string());
        let ready: Value = serde_json::from_str(&publisher.text()).unwrap();
        assert_eq!(ready["type"], "ready", "{ready}");
        (Self { publisher, t: 0.0 }, ready)
    }

    fn hold(&mut self, step: &str, seconds: f64) {
        for _ in 0..(seconds * 30.0) as usize {
            self.publisher.send(&json!({"type": "frame", "t": self.t, "weights": weights(step)}).to_string());
            self.t += 1.0 / 30.0;
        }
    }

    /// The next answer that is not of a calibration, or of frames that come faster than a tracker's.
    fn answer(&mut self) -> Value {
        loop {
            let answer: Value = serde_json::from_str(&self.publisher.text()).unwrap();
            if answer["type"] != "calibrated" && answer["code"] != "too_fast" {
                return answer;
            }
        }
    }

    fn measure(&mut self, step: &str, face: &str) -> Value {
        self.hold(face, 1.0);
        self.publisher.send(&json!({"type": "fit", "step": step, "seconds": 1.0}).to_string());
        self.hold(face, 1.2);
        self.answer()
    }
}

fn shape(viewer: &Viewer, name: &str) -> f32 {
    viewer.frame.shapes.expect("weights travel")[ARKIT_NAMES.iter().position(|known| *known == name).unwrap()]
}

fn watch_until(viewer: &mut Viewer, is_so: impl Fn(&Viewer) -> bool) {
    for _ in 0..2000 {
        assert!(viewer.next_packet());
        if is_so(viewer) {
            return;
        }
    }
    panic!("the face stays as it is");
}

#[test]
fn a_publisher_is_fitted_and_its_profile_outlives_the_session_and_the_server() {
    let folder = tempfile::tempdir().unwrap();
    let start = || Server::with(|config| config.profiles = Some(folder.path().to_owned()));
    let hello = json!({"type": "hello", "version": 1, "source": "headset"});
    let server = start();
    let (mut sender, ready) = Sender::new(&server, &hello);
    assert!(ready.get("profile").is_none());
    assert_eq!(sender.measure("neutral", "neutral")["step"], "neutral");
    // Somebody who does nothing is asked again, and has time to.
    let refused = sender.measure("smile", "neutral");
    assert_eq!((&refused["type"], &refused["code"]), (&json!("error"), &json!("fit_too_little")));
    for step in FitStep::ALL.into_iter().skip(1).map(FitStep::name) {
        let answer = sender.measure(step, step);
        assert_eq!((&answer["type"], &answer["step"], &answer["done"]), (&json!("fit"), &json!(step), &json!(true)), "{answer}");
        assert!(answer["frames"].as_u64() > Some(25) && answer["note"].as_str().unwrap().contains("50 %"), "{answer}");
    }
    sender.publisher.send(r#"{"type":"fit","step":"finish","name":"ada"}"#);
    let answer = sender.answer();
    assert_eq!((&answer["kept"], &answer["offers"]["swap_mouth"]), (&json!(true), &json!(true)), "{answer}");
    let profile = answer["profile"].clone();
    assert_eq!(profile["ranges"]["smile"], 2.0);
    // What is agreed to is part of the profile.
    sender.publisher.send(r#"{"type":"settings","swap_mouth":true,"gains":{"head":0.5}}"#);
    assert_eq!(sender.answer()["swap_mouth"], true);
    let mut viewer = server.viewer("demo");
    sender.hold("mouth_left", 1.0);
    watch_until(&mut viewer, |viewer| shape(viewer, "mouthLeft") > 0.97 && shape(viewer, "mouthRight") == 0.0);
    drop((sender, viewer));
    server.wait_for_room("demo", |room| room.is_some_and(|room| room["publisher"].is_null()));
    drop(server);

    let server = start();
    let (_, listed) = server.get("/api/profiles", "");
    let listed: Value = serde_json::from_slice(&listed).unwrap();
    assert_eq!(listed["profiles"], json!([{"name": "ada", "source": "headset", "measured": "weights"}]));
    let (mut sender, ready) = Sender::new(&server, &hello);
    assert_eq!(ready["profile"], "ada", "chosen by its source");
    let mut viewer = server.viewer("demo");
    sender.hold("mouth_left", 1.0);
    watch_until(&mut viewer, |viewer| shape(viewer, "mouthLeft") > 0.97);
    // By hand, in a message and in a hello; one that is not there is said.
    sender.publisher.send(r#"{"type":"profile","profile":"ben"}"#);
    assert_eq!(sender.answer()["code"], "unknown_profile");
    let mut plain = profile;
    plain["ranges"] = json!({});
    sender.publisher.send(&json!({"type": "profile", "profile": plain}).to_string());
    assert_eq!(sender.answer()["kept"], false);
    sender.hold("smile", 1.0);
    watch_until(&mut viewer, |viewer| (shape(viewer, "mouthSmileLeft") - 0.5).abs() < 0.01);
    let mut other = server.publisher("other");
    other.send(r#"{"type":"hello","version":1,"profile":"ben"}"#);
    assert_eq!(other.error().0, "unknown_profile");
    let mut broken = server.publisher("other");
    broken.send(r#"{"type":"hello","version":1,"profile":{"rhytid_profile":7,"measured":"weights"}}"#);
    let (code, message) = broken.error();
    assert!(code == "bad_profile" && message.contains("rhytid_profile is 7"), "{code}: {message}");
}

/// A person at a command line who does what is asked.
struct Obedient {
    face: Arc<Mutex<&'static str>>,
    told: Vec<String>,
}

impl Guide for Obedient {
    fn ask(&mut self, step: FitStep, _at: usize, _of: usize, _ready: Duration, _hold: Duration) {
        *self.face.lock().unwrap() = step.name();
    }
    fn tell(&mut self, text: &str) {
        self.told.push(text.into());
    }
    fn agrees(&mut self, offers: &Settings) -> bool {
        assert_eq!(offers.swap_mouth, Some(true));
        true
    }
}

fn block_on<T>(future: impl Future<Output = T>) -> T {
    tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap().block_on(future)
}

#[test]
fn somebody_else_fits_a_source_at_the_command_line_and_the_profile_is_sent_along() {
    let server = Server::start();
    let live = LiveFit {
        to: format!("ws://{}", server.address),
        room: "demo".into(),
        slot: "main".into(),
        name: Some("cleo".into()),
        ready: Duration::from_millis(400),
        hold: Duration::from_millis(400),
        trust: Trust::Public,
        token: None,
    };
    let (face, is_over) = (Arc::new(Mutex::new("neutral")), Arc::new(AtomicBool::new(false)));
    let mut guide = Obedient { face: face.clone(), told: Vec::new() };
    let error = block_on(fit_live(&live, &mut guide)).unwrap_err().to_string();
    assert!(error.contains("room demo has no source in the slot \"main\""), "{error}");

    let (mut sender, _) = Sender::new(&server, &json!({"type": "hello", "version": 1, "source": "phone"}));
    let sending = std::thread::spawn({
        let is_over = is_over.clone();
        move || {
            while !is_over.load(Ordering::Relaxed) {
                let face = *face.lock().unwrap();
                sender.hold(face, 0.04);
                std::thread::sleep(Duration::from_millis(33));
            }
        }
    });
    let profile = block_on(fit_live(&live, &mut guide)).unwrap();
    is_over.store(true, Ordering::Relaxed);
    sending.join().unwrap();
    assert!(guide.told.iter().any(|told| told.starts_with("smile: ")), "{:?}", guide.told);
    assert_eq!((profile.name.as_str(), profile.settings.swap_mouth), ("cleo", Some(true)));
    assert!((profile.ranges.jaw_open - 2.0).abs() < 0.1, "{:?}", profile.ranges);

    let mut text = String::from("{\"type\":\"hello\",\"version\":1,\"source\":\"phone\"}\n");
    for i in 0..30 {
        text += &json!({"type": "frame", "t": f64::from(i) / 30.0, "weights": weights("mouth_left")}).to_string();
        text.push('\n');
    }
    let profile = Profile::from_json(&serde_json::to_string(&profile).unwrap()).unwrap();
    let mut viewer = server.viewer("demo");
    let mut options = SendOptions {
        source: SendSource::Text(text, "test feed".into()),
        to: live.to,
        room: "demo".into(),
        speed: 1.0,
        repeats: false,
        takeover: true,
        binary: false,
        profile: Some(ProfileChoice::Given(Box::new(profile))),
        timeout: Duration::from_secs(10),
        trust: Trust::Public,
        token: None,
    };
    block_on(send(&options, &indicatif::ProgressBar::hidden(), std::future::pending())).unwrap();
    watch_until(&mut viewer, |viewer| shape(viewer, "mouthLeft") > 0.9);
    // This server keeps none.
    options.profile = Some(ProfileChoice::Named(RoomName::new("cleo").unwrap()));
    let error = block_on(send(&options, &indicatif::ProgressBar::hidden(), std::future::pending())).unwrap_err().to_string();
    assert!(error.contains("which this server does not keep"), "{error}");
}

#[test]
fn a_control_socket_has_its_limits() {
    let server = Server::start();
    let mut control = server.connect("/v1/rooms/demo/control?slot=phone", &[]).unwrap();
    for (text, code) in [
        (r#"{"type":"recentre"}"#, "no_source"),
        (r#"{"type":"frame","t":1,"face":false}"#, "unknown_type"),
        (r#"{"type":"fit","step":"grin"}"#, "out_of_range"),
        (r#"{"type":"fit","step":"smile","seconds":60}"#, "out_of_range"),
        ("nonsense", "malformed_json"),
        (r#"{"type":"settings","gains":{"brows":9}}"#, "out_of_range"),
    ] {
        control.send(text);
        assert_eq!(control.error().0, code, "{text}");
    }
    let (mut sender, _) = Sender::new(&server, &json!({"type": "hello", "version": 1, "slot": "phone"}));
    control.send(r#"{"type":"recentre"}"#);
    assert_eq!(control.error().0, "no_face");
    sender.hold("neutral", 0.2);
    server.wait_for_metric("rhytid_frames_in_total", |count| count == 6.0);
    control.send(r#"{"type":"recentre"}"#);
    assert_eq!(control.text(), r#"{"type":"recentred"}"#);
    control.send(r#"{"type":"settings","smoothing":{"mouth":2}}"#);
    let answer: Value = serde_json::from_str(&control.text()).unwrap();
    assert_eq!((&answer["type"], &answer["smoothing"]["mouth"]), (&json!("settings"), &json!(2.0)));
    control.send(r#"{"type":"calibrate"}"#);
    assert_eq!(control.text(), r#"{"type":"calibrating"}"#);
    // A step nobody makes frames for waits; the next one takes its place. Not more than thirty commands a second.
    std::thread::sleep(Duration::from_millis(200));
    control.send(r#"{"type":"fit","step":"smile","seconds":0.2}"#);
    control.send(r#"{"type":"fit","step":"blink","seconds":0.2}"#);
    assert_eq!(control.error().0, "fit_replaced");
    drop(sender);
    assert_eq!(control.error().0, "no_source");
}
