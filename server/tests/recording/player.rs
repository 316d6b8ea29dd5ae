//! Recordings are played, published again, and exported.

use crate::fixture::{resampled, write_packets};
use crate::server::{Folder, Recorder, run, says, wait_until};
use rhytid_server::feed::Feed;
use rhytid_server::load_character;
use rhytid_server::recording::{Faces, Recording, export_csv, export_gltf};
use rhytid_shared::{TrackingData, TrackingFrame};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;
use tokio_tungstenite::tungstenite::Message;

#[test]
fn a_player_stops_seeks_and_goes_on() {
    let folder = Folder::new();
    let (character, _) = load_character(None).unwrap();
    let (hello, frames) = resampled(&character, 25.0);
    let path = folder.path("demo.mcap");
    let shown = write_packets(&path, &character, &hello, &frames);
    let served = Recorder::start(&["replay", path.to_str().unwrap(), "--packets"]);
    let status = || served.json("GET", "/api/rooms/demo/replay", "")["replay"].clone();
    wait_until("it to move", || status()["position"].as_f64().unwrap() > 0.3);
    assert_eq!(status()["playing"], true);
    served.json("POST", "/api/rooms/demo/replay", r#"{"playing":false,"position":12.5}"#);
    wait_until("it to stand", || status()["playing"] == false && status()["position"] == 12.5);
    // What a viewer sees is what was recorded there.
    let watched = folder.path("watched.mcap");
    let recorded = run(&["record", watched.to_str().unwrap(), "--server", &served.url(), "--seconds", "0.5"]);
    assert!(recorded.status.success(), "{}", says(&recorded));
    let mut faces = Faces::new(Recording::open(&watched).unwrap());
    let mut num = 0;
    let expected = &shown[frames.partition_point(|frame| frame.t <= 12.5) - 1];
    while faces.advance().unwrap().is_some() {
        num += 1;
        let worst = faces.frame().points.iter().zip(&expected.points).map(|(a, b)| a.distance(*b)).fold(0.0, f32::max);
        assert!(worst < 0.001, "{worst} m from the recorded face");
    }
    assert!(num >= 5, "a face that stands is sent again: {num}");
    let before = served.json("GET", "/api/rooms", "")["rooms"][0]["session"].as_u64().unwrap();
    served.json("POST", "/api/rooms/demo/replay", r#"{"playing":true,"position":1.0,"speed":4.0}"#);
    // It is told, and does it a moment later.
    wait_until("it to go on", || (3.0..12.0).contains(&status()["position"].as_f64().unwrap()));
    let after = served.json("GET", "/api/rooms", "")["rooms"][0]["session"].as_u64().unwrap();
    assert_eq!(after, before + 1, "a jump begins a session");
    for (body, code) in [(r#"{"speed":0}"#, 400), (r#"{"position":-1}"#, 400), (r#"{"sped":1}"#, 400), (r#"{"file":"../x.mcap"}"#, 403)] {
        assert_eq!(served.request("POST", "/api/rooms/demo/replay", body).0, code, "{body}");
    }
    assert_eq!(served.request("POST", "/api/rooms/other/replay", r#"{"playing":true}"#).0, 409);
    served.json("DELETE", "/api/rooms/demo/replay", "");
    wait_until("the room to be free", || served.json("GET", "/api/rooms", "")["rooms"][0]["publisher"].is_null());
}

/// The one that is replaced learns of it while it has jumps to make.
#[test]
fn a_player_that_is_replaced_leaves_the_room_to_the_new_one() {
    let folder = Folder::new();
    // All of it within a second, with its messages: a jump takes longer than a request for one.
    let first = Recorder::into(&folder);
    assert!(first.send(&["--speed", "max"]).status.success());
    first.end();
    let file = folder.recording().file_name().unwrap().to_str().unwrap().to_owned();
    let served = Recorder::start(&["serve", "--record", folder.shown(), "--record-rooms", "none"]);
    let path = "/api/rooms/demo/replay";
    let is_over = AtomicBool::new(false);
    assert_eq!(served.request("POST", path, &format!(r#"{{"file":"{file}","loop":true}}"#)).0, 200);
    let jump = |from: u32| {
        for k in (from..).step_by(7).take_while(|_| !is_over.load(Ordering::Relaxed)) {
            let (status, _) = served.request("POST", path, &format!(r#"{{"position":0.{:03}}}"#, k % 1000));
            // It may have as many as it can keep in mind, or not be there yet.
            assert!([200, 503, 409].contains(&status), "{status}");
        }
    };
    let replace = || {
        for round in 0..20 {
            let (status, answer) = served.request("POST", path, &format!(r#"{{"file":"{file}","loop":true}}"#));
            if status != 200 {
                return Err(format!("round {round}: {answer}"));
            }
            std::thread::sleep(Duration::from_millis(50));
            let status = &served.json("GET", path, "")["replay"];
            if status["playing"] != true || !status["error"].is_null() {
                return Err(format!("round {round}: {status}"));
            }
        }
        Ok(())
    };
    let replaced = std::thread::scope(|scope| {
        for from in 0..8 {
            scope.spawn(move || jump(from));
        }
        let replaced = replace();
        is_over.store(true, Ordering::Relaxed);
        replaced
    });
    assert_eq!(replaced, Ok(()));
    assert!(served.json("GET", "/api/rooms", "")["rooms"][0]["publisher"].is_object());
}

#[test]
fn a_replay_that_stands_still_leaves_its_room_and_none_is_recorded_unasked() {
    let folder = Folder::new();
    let (character, _) = load_character(None).unwrap();
    let (hello, frames) = resampled(&character, 25.0);
    write_packets(&folder.path("demo.mcap"), &character, &hello, &frames);
    let served = Recorder::start(&["serve", "--record", folder.shown(), "--replay-timeout", "1"]);
    let status = || served.json("GET", "/api/rooms/demo/replay", "")["replay"].clone();
    let end = frames.last().unwrap().t;
    served.json("POST", "/api/rooms/demo/replay", &format!(r#"{{"file":"demo.mcap","from":{}}}"#, end - 2.5));
    wait_until("its end", || status()["playing"] == false);
    assert!(status()["error"].is_null(), "it stands: {}", status());
    assert_eq!(served.metric("rhytid_recordings"), 0.0, "it is a recording already");
    // Whoever uses it keeps it there.
    for _ in 0..3 {
        std::thread::sleep(Duration::from_millis(600));
        served.json("POST", "/api/rooms/demo/replay", &format!(r#"{{"position":{},"playing":false}}"#, end - 1.0));
    }
    wait_until("the room to be free", || served.json("GET", "/api/rooms", "")["rooms"][0]["publisher"].is_null());
    assert!(status()["error"].as_str().unwrap().contains("stood still"), "{}", status());
    assert_eq!(folder.files().len(), 1);
    // Who asks for it gets it.
    served.json("POST", "/api/rooms/demo/replay", r#"{"file":"demo.mcap"}"#);
    served.json("POST", "/api/rooms/demo/record/start", "");
    assert_eq!(served.metric("rhytid_recordings"), 1.0);
}

#[test]
fn a_replay_after_a_performance_is_not_recorded_unasked() {
    let folder = Folder::new();
    let (character, _) = load_character(None).unwrap();
    let (hello, frames) = resampled(&character, 25.0);
    write_packets(&folder.path("played.mcap"), &character, &hello, &frames);
    let served = Recorder::into(&folder);
    let sending = served.keep_sending("1.0");
    wait_until("its recording", || served.metric("rhytid_recordings") == 1.0 && served.metric("rhytid_frames_in_total") > 10.0);
    drop(sending);
    wait_until("its end", || served.json("GET", "/api/rooms", "")["rooms"][0]["publisher"].is_null());
    assert_eq!(served.metric("rhytid_recordings"), 1.0, "who comes back soon is in the same recording");
    served.json("POST", "/api/rooms/demo/replay", r#"{"file":"played.mcap","loop":true}"#);
    wait_until("the performance's end", || served.metric("rhytid_recordings") == 0.0);
    std::thread::sleep(Duration::from_millis(300));
    assert_eq!((served.metric("rhytid_recordings"), folder.files().len()), (0.0, 2));
    // The next performance is recorded again.
    served.json("DELETE", "/api/rooms/demo/replay", "");
    let _sending = served.keep_sending("1.0");
    wait_until("the next recording", || served.metric("rhytid_recordings") == 1.0);
}

#[test]
fn a_player_keeps_to_the_rates_of_publishers() {
    let folder = Folder::new();
    let (character, _) = load_character(None).unwrap();
    let (hello, frames) = resampled(&character, 25.0);
    write_packets(&folder.path("demo.mcap"), &character, &hello, &frames);
    let served = Recorder::start(&["serve", "--record", folder.shown(), "--record-rooms", "none", "--max-fps", "100"]);
    let path = "/api/rooms/demo/replay";
    let room = || served.json("GET", "/api/rooms", "")["rooms"][0].clone();
    // 2,500 faces a second.
    served.json("POST", path, r#"{"file":"demo.mcap","loop":true,"speed":100}"#);
    wait_until("a face", || room()["frame"].is_object());
    let watched = folder.path("watched.mcap");
    let recorded = run(&["record", watched.to_str().unwrap(), "--server", &served.url(), "--seconds", "1"]);
    assert!(recorded.status.success(), "{}", says(&recorded));
    let mut faces = Faces::new(Recording::open(&watched).unwrap());
    let mut num = 0;
    while faces.advance().unwrap().is_some() {
        num += 1;
    }
    assert!((30..150).contains(&num), "{num} faces in a second");
    // A loop of a millisecond, and jumps all the time.
    served.json("POST", path, r#"{"from":0,"to":0.001,"position":0}"#);
    let before = room()["session"].as_u64().unwrap();
    let start = std::time::Instant::now();
    while start.elapsed() < Duration::from_secs(1) {
        assert!([200, 503].contains(&served.request("POST", path, r#"{"position":0}"#).0));
    }
    let num = room()["session"].as_u64().unwrap() - before;
    let most = start.elapsed().as_millis() as u64 / 50 + 2;
    assert!((3..=most).contains(&num), "{num} sessions, {most} at most");
}

#[test]
fn a_player_takes_its_forerunners_place_and_no_publishers() {
    let folder = Folder::new();
    let (character, _) = load_character(None).unwrap();
    let (hello, frames) = resampled(&character, 25.0);
    write_packets(&folder.path("demo.mcap"), &character, &hello, &frames);
    let served = Recorder::start(&["serve", "--record", folder.shown(), "--record-rooms", "none"]);
    let path = "/api/rooms/demo/replay";
    for round in 0..5 {
        // So slow that it looks after its room ten times a second.
        assert_eq!(served.request("POST", path, r#"{"file":"demo.mcap","speed":0.01,"takeover":true}"#).0, 200);
        let mut socket = crate::socket::open(&served.address, "demo/publish", &[], crate::process::PATIENCE).unwrap();
        let hello = r#"{"type":"hello","version":1,"source":"test","fps":60,"takeover":true}"#;
        socket.send(Message::text(hello)).unwrap();
        let Message::Text(ready) = socket.read().unwrap() else { panic!("an answer") };
        assert!(ready.contains("ready"), "{ready}");
        let (status, answer) = served.request("POST", path, r#"{"file":"demo.mcap"}"#);
        assert_eq!(status, 409, "round {round}: {answer}");
        assert!(answer.contains("room_taken"), "{answer}");
    }
}

#[test]
fn a_recording_is_published_again() {
    let folder = Folder::new();
    let first = Recorder::into(&folder);
    assert!(first.send(&["--speed", "max"]).status.success());
    first.end();
    let second = Recorder::start(&["serve"]);
    let path = folder.recording();
    let replayed = run(&["replay", path.to_str().unwrap(), "--server", &second.url(), "--speed", "max"]);
    assert!(replayed.status.success() && says(&replayed).contains("sent 501 frames"), "{}", says(&replayed));
    assert_eq!(second.metric("rhytid_frames_in_total"), 501.0);
}

#[test]
fn exports_hold_what_was_recorded() {
    let folder = Folder::new();
    let (character, glb) = load_character(None).unwrap();
    let (hello, frames) = resampled(&character, 25.0);
    let path = folder.path("demo.mcap");
    let shown = write_packets(&path, &character, &hello, &frames);

    let csv = folder.path("demo.csv");
    let mut out = Vec::new();
    let num = export_csv(&mut Faces::new(Recording::open(&path).unwrap()), [0.0, f64::INFINITY], &mut out).unwrap();
    assert_eq!(num as usize, frames.len());
    assert!(out.starts_with(b"Timecode,BlendShapeCount,EyeBlinkLeft,"));
    let header = out.split(|byte| *byte == b'\n').next().unwrap();
    assert!(header.windows(24).any(|part| part == b"JawForward,JawRight,JawL"), "the order of the app's files");
    std::fs::write(&csv, &out).unwrap();
    let mut feed = Feed::open(&csv, &character).unwrap();
    let (mut frame, mut index) = (TrackingFrame::default(), 0);
    while feed.next_frame(&mut frame).unwrap().is_some() {
        let (TrackingData::Weights { weights, head }, Some(expected)) = (&frame.data, shown[index].shapes) else { panic!("{frame:?}") };
        let worst = weights.iter().zip(expected).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        assert!(expected.iter().all(|weight| (0.0..=1.0).contains(weight)), "{expected:?}");
        assert!(worst <= 0.5 / 255.0 + 1e-6, "{worst}");
        // Exact zeros say that the head is not sent.
        let turned = head.unwrap_or_default().rotation.angle_between(shown[index].head.rotation);
        assert!(turned < 0.0015, "{turned}");
        index += 1;
    }
    assert_eq!(index, frames.len());

    let (file, num) = export_gltf(&mut Faces::new(Recording::open(&path).unwrap()), [2.0, 6.0], &character, &glb).unwrap();
    assert!((98..=102).contains(&num), "{num}");
    let gltf = gltf::Gltf::from_slice(&file).unwrap();
    let names: Vec<_> = gltf.animations().filter_map(|animation| animation.name().map(str::to_owned)).collect();
    assert_eq!(names, ["bones", "shapes"]);
    let blob = gltf.blob.as_deref().unwrap();
    let brow = character.bones.iter().position(|bone| bone.name == "brow_inner_l").unwrap();
    let bones = gltf.animations().next().unwrap();
    let channel = bones
        .channels()
        .find(|channel| {
            channel.target().node().name() == Some(&character.bones[brow].joint)
                && channel.target().property() == gltf::animation::Property::Translation
        })
        .expect("the brow moves");
    let reader = channel.reader(|_| Some(blob));
    let times: Vec<f32> = reader.read_inputs().unwrap().collect();
    assert!(times[0] == 0.0 && (times.last().unwrap() - 4.0).abs() < 0.1, "{:?}", times.last());
    let Some(gltf::animation::util::ReadOutputs::Translations(values)) = reader.read_outputs() else { panic!("translations") };
    let rest = gltf::Gltf::from_slice(&glb).unwrap();
    let node = rest.nodes().find(|node| node.name() == Some(&character.bones[brow].joint)).unwrap();
    let at_rest = glam::Vec3::from(node.transform().decomposed().0);
    // The face that stands there: the one of 2.0 s arrives a little later.
    let first = frames.partition_point(|frame| frame.t < 2.0) - 1;
    for (i, value) in values.enumerate() {
        // Below the head's joint, which turns nothing at rest: what the point does in head space.
        let moved = glam::Vec3::from(value) - at_rest;
        let expected = shown[first + i].points[brow] - character.bones[brow].rest;
        assert!(moved.distance(expected) < 5e-5, "key {i}: {moved} is not {expected}");
    }
    let shapes = gltf.animations().nth(1).unwrap();
    let weights = shapes.channels().find(|channel| channel.target().property() == gltf::animation::Property::MorphTargetWeights).unwrap();
    let Some(gltf::animation::util::ReadOutputs::MorphTargetWeights(weights)) = weights.reader(|_| Some(blob)).read_outputs() else {
        panic!("weights")
    };
    assert_eq!(weights.into_f32().count(), times.len() * 52);
}
