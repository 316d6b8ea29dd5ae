//! Several sources on one face.

use super::harness::{Client, Server, Viewer};
use rhytid_shared::FaceFrame;
use serde_json::{Value, json};
use std::time::{Duration, Instant};

fn source(server: &Server, hello: &Value) -> Client {
    let mut publisher = server.publisher("demo");
    publisher.send(&hello.to_string());
    let ready: Value = serde_json::from_str(&publisher.text()).unwrap();
    assert_eq!(ready["type"], "ready", "{ready}");
    publisher
}

/// How far the bone is above its rest, metres.
fn height(viewer: &Viewer, face: &FaceFrame, bone: &str) -> f32 {
    let bone = viewer.hello.character.bones.iter().position(|known| known.name == bone).expect("the character has it");
    face.points[bone].y - viewer.at_rest.points[bone].y
}

#[test]
fn the_phone_drives_the_brows_until_it_stops_and_the_webcam_takes_over_smoothly() {
    let server = Server::start();
    let mut viewer = server.viewer("demo");
    let brow = viewer.hello.character.bones.iter().map(|bone| bone.name.clone()).find(|name| name.contains("brow")).unwrap();
    let mut phone =
        source(&server, &json!({"type": "hello", "version": 1, "source": "phone", "slot": "phone", "priority": 60, "groups": ["brows"]}));
    let mut webcam = source(&server, &json!({"type": "hello", "version": 1, "source": "webcam", "slot": "webcam"}));
    // A third is refused the slot of another.
    let mut third = server.publisher("demo");
    third.send(&json!({"type": "hello", "version": 1, "slot": "phone"}).to_string());
    assert_eq!(third.error().0, "slot_taken");

    let start = Instant::now();
    let (mut steepest, mut heights, mut last): (f32, Vec<(f64, f32)>, Option<FaceFrame>) = (0.0, Vec::new(), None);
    let mut listed = [None, None, None];
    let mut is_listed = |at: usize| {
        if listed[at].is_none() {
            listed[at] = Some(server.room("demo").unwrap()["sources"].clone());
        }
    };
    viewer.client.socket.get_ref().set_read_timeout(Some(Duration::from_millis(5))).unwrap();
    loop {
        let t = start.elapsed().as_secs_f64();
        if t > 5.5 {
            break;
        }
        let brows = |height: f64| json!({"browInnerUp": height, "browOuterUpLeft": height, "browOuterUpRight": height, "jawOpen": 0.3});
        webcam.send(&json!({"type": "frame", "t": t, "weights": brows(0.1)}).to_string());
        if !(1.5..3.5).contains(&t) {
            phone.send(&json!({"type": "frame", "t": t, "weights": brows(0.9)}).to_string());
        }
        match t {
            1.3..1.5 => is_listed(0),
            3.0..3.5 => is_listed(1),
            5.0.. => is_listed(2),
            _ => {}
        }
        while viewer.try_packet() {
            if let Some(last) = &last {
                let step = viewer.frame.points.iter().zip(&last.points).map(|(a, b)| a.distance(*b)).fold(0.0, f32::max);
                // The first moments are the filters' own.
                if t > 1.0 {
                    steepest = steepest.max(step);
                }
            }
            heights.push((t, height(&viewer, &viewer.frame, &brow)));
            last = Some(viewer.frame.clone());
        }
        std::thread::sleep(Duration::from_millis(15));
    }
    let mean = |from: f64, to: f64| {
        let some: Vec<f32> = heights.iter().filter(|(t, _)| (from..to).contains(t)).map(|(_, height)| *height).collect();
        assert!(!some.is_empty(), "packets come between {from} and {to}");
        some.iter().sum::<f32>() / some.len() as f32
    };
    let (with, without, again) = (mean(1.0, 1.4), mean(2.8, 3.4), mean(4.6, 5.5));
    assert!(with > 4.0 * without.abs() && (with - again).abs() < 0.1 * with, "{with} {without} {again}");
    assert!(steepest < 0.003, "{steepest} m between two packets");
    let drives = |at: usize, slot: &str| {
        let list = listed[at].as_ref().unwrap();
        list.as_array().unwrap().iter().find(|source| source["slot"] == slot).unwrap()["drives"].clone()
    };
    assert_eq!(drives(0, "phone"), json!(["brows"]));
    assert_eq!(drives(0, "webcam"), json!(["lids", "gaze", "mouth", "head"]));
    assert_eq!(drives(1, "phone"), json!([]));
    assert_eq!(drives(1, "webcam"), json!(["brows", "lids", "gaze", "mouth", "head"]));
    assert_eq!(drives(2, "phone"), json!(["brows"]));
}
