//! One entry for each parser of what comes from outside, as fuzzers want it: any bytes in, and a panic where the parser lets through
//! what it must not. The trackers' own are in `trackers::fuzz`.

use crate::config::ServerConfig;
use crate::feed::{Feed, FeedItem};
use crate::pipeline::Pipeline;
use crate::solve::SolveConfig;
use crate::token::{Checker, Role};
use crate::trackers::fuzz::{TARGETS as TRACKERS, Target, datagrams};
use crate::trackers::spec::{ListenSpec, VmcOutSpec};
use rhytid_shared::packet::{Decoder, PacketLayout};
use rhytid_shared::view::ViewMessage;
use rhytid_shared::{Character, DEFAULT_CHARACTER_GLB, Profile, PublishMessage, PublishReader, RoomName, TrackingData, TrackingFrame};
use std::sync::{Arc, LazyLock};

/// All entries but those of `trackers::fuzz`, each with what its corpus is called.
const OWN: [Target; 11] = [
    ("publish", publish_target),
    ("publish_binary", publish_binary_target),
    ("feed", feed_target),
    ("command", command_target),
    ("profile", profile_target),
    ("packets", packets_target),
    ("hello", hello_target),
    ("character", character_target),
    ("config", config_target),
    ("spec", spec_target),
    ("token", token_target),
];

/// Every entry there is.
pub fn targets() -> impl Iterator<Item = Target> {
    TRACKERS.into_iter().chain(OWN)
}

/// Frames of one input that are read: a session's first ones, with the search for the neutral face begun.
const MOST_FRAMES: usize = 40;

static CHARACTER: LazyLock<Arc<Character>> =
    LazyLock::new(|| Arc::new(Character::from_glb(DEFAULT_CHARACTER_GLB).expect("the built-in character is whole")));

/// A publisher's text messages, one a line: what is taken is finite, and an error is one line and leaves the frame as it was.
pub fn publish_target(bytes: &[u8]) {
    let mut reader = PublishReader::new(&CHARACTER);
    let (mut frame, mut last_t) = (TrackingFrame::default(), f64::NEG_INFINITY);
    for line in String::from_utf8_lossy(bytes).lines().take(MOST_FRAMES) {
        let before = frame.t;
        match reader.read(line, &mut frame) {
            Ok(PublishMessage::Frame) => {
                check_frame(&frame);
                assert!(frame.t > last_t, "{} after {last_t}", frame.t);
                last_t = frame.t;
            }
            Ok(_) => {}
            Err(error) => {
                assert!(!error.message.is_empty() && !error.message.contains('\n'), "{error:?}");
                assert!(frame.t.to_bits() == before.to_bits(), "an error changes nothing");
            }
        }
    }
}

/// A publisher's binary messages (see `trackers::fuzz::datagrams`) behind a hello that names the layout of a webcam's tracker.
pub fn publish_binary_target(bytes: &[u8]) {
    let mut reader = PublishReader::new(&CHARACTER);
    let mut frame = TrackingFrame::default();
    let hello = r#"{"type":"hello","version":1,"layout":"mediapipe478","image":[640,480]}"#;
    reader.read(hello, &mut frame).expect("the hello is sound");
    for message in datagrams(bytes).take(MOST_FRAMES) {
        if reader.read_binary(message, &mut frame).is_ok() {
            check_frame(&frame);
            let TrackingData::Landmarks { points, .. } = &frame.data else { panic!("{frame:?}") };
            assert_eq!(points.len(), 478);
        }
    }
}

fn check_frame(frame: &TrackingFrame) {
    assert!(frame.t.is_finite(), "{frame:?}");
    if let TrackingData::Landmarks { points, .. } = &frame.data {
        assert!(points.iter().flatten().all(|value| value.is_finite()), "{frame:?}");
    }
}

/// A feed file, solved and encoded: every packet can be decoded, and nothing in it is out of its range.
pub fn feed_target(bytes: &[u8]) {
    let Ok(mut feed) = Feed::new(bytes, "fuzz".into(), &CHARACTER) else { return };
    let Ok(mut pipeline) = Pipeline::new(CHARACTER.clone(), &SolveConfig::default(), &feed.hello, 1) else { return };
    let mut decoder = Decoder::new(&**CHARACTER);
    let mut seen = decoder.layout().frame_at_rest();
    let (mut frame, mut packet) = (TrackingFrame::default(), Vec::new());
    for _ in 0..MOST_FRAMES {
        match feed.next_frame(&mut frame) {
            Ok(Some(FeedItem::Frame)) if pipeline.frame(&frame, &mut packet).is_ok() => {
                decoder.decode(&packet, &mut seen).expect("the encoder's own packets can be decoded");
                assert!(seen.points.iter().all(|point| point.is_finite() && point.length() < 1.0), "{seen:?}");
            }
            Ok(Some(_)) => {}
            Ok(None) | Err(_) => return,
        }
    }
}

/// A message of a control socket.
pub fn command_target(bytes: &[u8]) {
    if let Err(error) = PublishReader::read_command(&String::from_utf8_lossy(bytes)) {
        assert!(!error.message.is_empty() && !error.message.contains('\n'), "{error:?}");
    }
}

/// A performer's profile. What is taken reads the same when it has been written.
pub fn profile_target(bytes: &[u8]) {
    if let Ok(profile) = Profile::from_json(&String::from_utf8_lossy(bytes)) {
        let written = serde_json::to_string(&profile).expect("plain data can be written");
        let again = Profile::from_json(&written).expect("what was taken is taken again");
        assert_eq!(serde_json::to_string(&again).expect("plain data can be written"), written);
    }
}

/// Packets (see `trackers::fuzz::datagrams`), to one viewer.
pub fn packets_target(bytes: &[u8]) {
    let mut decoder = Decoder::new(&**CHARACTER);
    let mut frame = decoder.layout().frame_at_rest();
    for packet in datagrams(bytes).take(MOST_FRAMES) {
        if decoder.decode(packet, &mut frame).is_ok() {
            assert_eq!(frame.points.len(), CHARACTER.bones.len());
            assert!(frame.points.iter().all(|point| point.is_finite()), "{frame:?}");
        }
    }
}

/// A view socket's text messages, and what a viewer makes of the hello.
pub fn hello_target(bytes: &[u8]) {
    if let Ok(ViewMessage::Hello(hello)) = serde_json::from_slice(bytes)
        && let Ok(layout) = PacketLayout::try_from(&hello.character)
    {
        let frame = Decoder::new(layout).layout().frame_at_rest();
        assert_eq!(frame.points.len(), hello.character.bones.len());
    }
}

/// A character's file. An error is one line.
pub fn character_target(bytes: &[u8]) {
    match Character::from_glb(bytes) {
        Ok(character) => assert!(character.bones.iter().all(|bone| bone.rest.is_finite())),
        Err(error) => assert!(error.to_string().lines().count() == 1, "{error}"),
    }
}

/// A configuration file.
pub fn config_target(bytes: &[u8]) {
    let result = ServerConfig::from_toml(&String::from_utf8_lossy(bytes), "fuzz").and_then(|config| config.validate());
    if let Err(error) = result {
        assert!(error.to_string().lines().count() == 1, "{error}");
    }
}

/// Ports of trackers and receivers of VMC, as they are given on the command line, and names of rooms.
pub fn spec_target(bytes: &[u8]) {
    let text = String::from_utf8_lossy(bytes);
    if let Err(error) = text.parse::<ListenSpec>() {
        assert!(!error.to_string().is_empty());
    }
    let _ = text.parse::<VmcOutSpec>();
    if let Ok(name) = RoomName::new(&text) {
        assert!((1..=64).contains(&name.as_str().len()) && name.as_str() == text);
    }
}

/// A token, to a server whose key nobody has: none of them opens anything.
pub fn token_target(bytes: &[u8]) {
    static CHECKER: LazyLock<Checker> = LazyLock::new(Checker::with_unknown_key);
    if let Ok(claims) = CHECKER.check(&String::from_utf8_lossy(bytes)) {
        panic!("{claims:?} was signed by nobody and is {:?}", claims.allow(Role::View, None));
    }
}
