//! What is recorded gives the same bytes again, and what was changed does not.

use crate::fixture::{changed_demo, entries, rewrite, without};
use crate::process::{Process, program};
use crate::server::{Folder, Recorder, run, says, wait_until};
use rhytid_server::feed::Feed;
use rhytid_server::load_character;
use rhytid_server::recording::{Entry, Faces, Recording, Topic, VerifyError, verify};
use serde_json::Value;
use std::path::Path;
use std::process::Stdio;

#[test]
fn a_recorded_session_gives_the_same_bytes_again_and_a_changed_one_names_the_difference() {
    let folder = Folder::new();
    let served = Recorder::into(&folder);
    assert!(served.send(&["--speed", "max"]).status.success());
    assert_eq!(served.metric("rhytid_recordings"), 1.0);
    served.end();
    let path = folder.recording();
    let verified = run(&["verify", path.to_str().unwrap()]);
    assert!(
        verified.status.success() && says(&verified).contains("501 frames of 1 sessions give the recorded bytes"),
        "{}",
        says(&verified)
    );

    // One landmark of one frame is another.
    let (character, _) = load_character(None).unwrap();
    let mut entries = entries(&path);
    let frames: Vec<usize> = (0..entries.len()).filter(|i| matches!(entries[*i].topic, Topic::Text(_))).collect();
    let entry = &mut entries[frames[301]];
    let mut message: Value = serde_json::from_slice(&entry.data).unwrap();
    let t = message["t"].as_f64().unwrap();
    message["landmarks"][21][1] = (message["landmarks"][21][1].as_f64().unwrap() + 3.0).into();
    entry.data = message.to_string().into();
    let changed = folder.path("changed.mcap");
    rewrite(&changed, &entries, &character);
    let Err(VerifyError::Different(difference)) = verify(&mut Recording::open(&changed).unwrap(), &character) else { panic!("it differs") };
    assert!(difference.t == t && difference.seq == 300 && difference.what.contains("bone "), "{difference}");
    assert_ne!(difference.recorded, difference.solved);
    let verified = run(&["verify", changed.to_str().unwrap()]);
    assert!(!verified.status.success() && says(&verified).contains("first difference at t = 12."), "{}", says(&verified));

    // As a feed, too.
    let feed = Feed::open(&path, &character).unwrap();
    assert_eq!(feed.hello.source, "rhytid demo session");
}

#[test]
fn a_room_of_two_slots_gives_the_same_bytes_again() {
    let folder = Folder::new();
    let (camera, phone) = (folder.path("camera.jsonl"), folder.path("phone.jsonl"));
    let camera_slot = serde_json::json!({ "slot": "camera", "priority": 40 });
    changed_demo(&camera, &camera_slot, &[], 0..500);
    // It comes later and leaves earlier: each time the brows are handed over.
    changed_demo(&phone, &serde_json::json!({ "slot": "phone", "priority": 60, "groups": ["brows", "head"] }), &[], 100..260);
    let served = Recorder::into(&folder);
    let send = |path: &Path| {
        let mut command = program(&["send", path.to_str().unwrap(), "--speed", "3", "--to", &served.url()]);
        Process::start(command.stdout(Stdio::null()).stderr(Stdio::null()))
    };
    let mut first = send(&camera);
    wait_until("frames", || served.metric("rhytid_frames_in_total") > 60.0);
    let mut second = send(&phone);
    assert!(first.wait().unwrap().success() && second.wait().unwrap().success());
    served.end();

    let path = folder.recording();
    let (character, _) = load_character(None).unwrap();
    let report = verify(&mut Recording::open(&path).unwrap(), &character).unwrap();
    println!("{report:?}");
    assert!(report.sessions == 2 && report.frames >= 450 && report.not_compared + report.cut == 0, "{report:?}");
    let entries = entries(&path);
    for slot in ["camera", "phone"] {
        let num = entries.iter().filter(|entry| entry.topic == Topic::Text(slot.into())).count();
        assert!(num > 160, "{slot}: {num} messages");
    }
    // The leads' clocks make sessions of their own: camera, phone, camera.
    let mut faces = Faces::new(Recording::open(&path).unwrap());
    let mut sessions = Vec::new();
    while faces.advance().unwrap().is_some() {
        sessions.push(faces.frame().session);
    }
    sessions.dedup();
    assert!(sessions.len() >= 3, "{sessions:?}");

    // Without what the phone sent it comes out otherwise, and so it does in another order.
    let changed = folder.path("changed.mcap");
    let is_phone = |entry: &Entry| matches!(&entry.topic, Topic::Text(slot) if slot == "phone");
    rewrite(&changed, &without(&entries, is_phone), &character);
    assert!(matches!(verify(&mut Recording::open(&changed).unwrap(), &character), Err(VerifyError::Different(_))));

    // Both are published again beside each other.
    let second = Recorder::start(&["serve"]);
    let replayed = run(&["replay", path.to_str().unwrap(), "--server", &second.url(), "--speed", "4"]);
    assert!(replayed.status.success() && says(&replayed).contains("sent 660 frames"), "{}", says(&replayed));
    assert_eq!(second.metric("rhytid_frames_in_total"), 660.0);
}

#[test]
fn binary_frames_give_the_same_bytes_again() {
    let folder = Folder::new();
    let served = Recorder::into(&folder);
    assert!(served.send(&["--speed", "max", "--binary"]).status.success());
    served.end();
    let path = folder.recording();
    let entries = entries(&path);
    let binary: Vec<&Entry> = entries.iter().filter(|entry| entry.topic == Topic::Binary("main".into())).collect();
    assert_eq!(binary.len(), 501, "as bytes");
    assert!(binary.iter().all(|entry| entry.data[0] == 1 && entry.data.len() == 28 + 68 * 4), "as they were sent");
    let (character, _) = load_character(None).unwrap();
    let report = verify(&mut Recording::open(&path).unwrap(), &character).unwrap();
    assert_eq!((report.frames, report.sessions, report.not_compared), (501, 1, 0));
    // One point of one frame is another.
    let mut other = entries.clone();
    let frame = other.iter_mut().filter(|entry| matches!(entry.topic, Topic::Binary(_))).nth(300).unwrap();
    frame.data[28 + 21 * 4 + 3] ^= 0x10;
    let changed = folder.path("changed.mcap");
    rewrite(&changed, &other, &character);
    let Err(VerifyError::Different(difference)) = verify(&mut Recording::open(&changed).unwrap(), &character) else { panic!("it differs") };
    assert_eq!(difference.seq, 300, "{difference}");
    // As a feed they are text.
    let second = Recorder::start(&["serve"]);
    let replayed = run(&["replay", path.to_str().unwrap(), "--server", &second.url(), "--speed", "max"]);
    assert!(replayed.status.success() && says(&replayed).contains("sent 501 frames"), "{}", says(&replayed));
}

#[test]
fn settings_changed_in_the_middle_give_the_same_bytes_again() {
    let folder = Folder::new();
    let feed = folder.path("feed.jsonl");
    let settings = r#"{"type":"settings","mirror":true,"gains":{"brows":1.7},"smoothing":{"mouth":2.5}}"#;
    let others = [(150, settings), (250, r#"{"type":"recentre"}"#), (350, r#"{"type":"calibrate"}"#)];
    changed_demo(&feed, &serde_json::json!({ "settings": { "gains": { "mouth": 0.8 } } }), &others, 0..501);
    let served = Recorder::into(&folder);
    let sent = run(&["send", feed.to_str().unwrap(), "--speed", "max", "--to", &served.url()]);
    assert!(sent.status.success(), "{}", says(&sent));
    served.end();
    let path = folder.recording();
    let (character, _) = load_character(None).unwrap();
    let report = verify(&mut Recording::open(&path).unwrap(), &character).unwrap();
    assert_eq!((report.frames, report.not_compared), (501, 0));
    let entries = entries(&path);
    for (_, other) in others {
        assert!(entries.iter().any(|entry| entry.data == other.as_bytes()), "{other} stands there as it was sent");
    }
    let changed = folder.path("changed.mcap");
    for (before, other) in others {
        rewrite(&changed, &without(&entries, |entry| entry.data == other.as_bytes()), &character);
        let Err(VerifyError::Different(difference)) = verify(&mut Recording::open(&changed).unwrap(), &character) else {
            panic!("without {other} it differs")
        };
        assert!((before..before + 30).contains(&(difference.seq as usize)), "without {other}: {difference}");
    }
}
