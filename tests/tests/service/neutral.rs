//! The neutral face that a room keeps for a publisher that comes back.

use super::harness::{Client, Server, Viewer};
use rhytid_shared::view::JsonFrame;
use serde_json::{Value, json};

/// A publisher with this hello, and whether it starts from the neutral that the room has kept.
fn publisher(server: &Server, hello: &Value) -> (Client, bool) {
    let mut publisher = server.publisher("demo");
    publisher.send(&hello.to_string());
    let ready: Value = serde_json::from_str(&publisher.text()).unwrap();
    assert_eq!(ready["type"], "ready", "{ready}");
    (publisher, ready["kept_neutral"].as_bool().unwrap())
}

/// Publishes a message and takes the frame it becomes.
fn see(publisher: &mut Client, viewer: &mut Viewer, message: &Value) -> JsonFrame {
    publisher.send(&message.to_string());
    viewer.next_json()
}

fn leave(server: &Server, publisher: Client) {
    drop(publisher);
    server.wait_for_room("demo", |room| room.is_some_and(|room| room["publisher"].is_null()));
}

fn strongest(frame: &JsonFrame) -> f32 {
    frame.influence.iter().flatten().fold(0.0, |most, influence| most.max(*influence))
}

#[test]
fn a_sender_of_weights_that_comes_back_starts_from_its_neutral() {
    let server = Server::start();
    let mut viewer = server.json_viewer("demo");
    let hello = json!({"type": "hello", "version": 1, "source": "phone"});
    let mut keeping = hello.clone();
    keeping["keep_neutral"] = true.into();
    // A face that never quite rests.
    let neutral =
        |t: f64| json!({"type": "frame", "t": t, "weights": {"browInnerUp": 0.4, "browOuterUpLeft": 0.4, "browOuterUpRight": 0.4}});

    // There is nothing to be kept yet.
    let (mut first, is_kept) = publisher(&server, &keeping);
    assert!(!is_kept);
    let as_sent = strongest(&see(&mut first, &mut viewer, &neutral(7.0)));
    assert!(as_sent > 0.1, "{as_sent}");
    assert_eq!(server.room("demo").unwrap()["neutral"], Value::Null);
    first.send(r#"{"type":"calibrate"}"#);
    assert!(first.text().contains("calibrated"));
    let listed = json!({"session": 1, "t": 7.0, "num_frames": 1, "requested": true});
    assert_eq!(server.room("demo").unwrap()["neutral"], listed);
    leave(&server, first);
    assert_eq!(server.room("demo").unwrap()["neutral"], listed);

    // As before, unless it asks for it.
    for (hello, is_neutral) in [(&hello, false), (&keeping, true), (&keeping, true)] {
        let (mut back, is_kept) = publisher(&server, hello);
        assert_eq!(is_kept, is_neutral);
        let frame = see(&mut back, &mut viewer, &neutral(1.0));
        assert_eq!(frame.seq, 0);
        let influence = strongest(&frame);
        assert!(if is_neutral { influence < 0.01 } else { (influence - as_sent).abs() < 0.01 }, "{hello}: {influence}");
        leave(&server, back);
        assert_eq!(server.room("demo").unwrap()["neutral"], listed, "the first session came to it, not this one");
    }

    // It is nobody else's.
    keeping["source"] = "another phone".into();
    assert!(!publisher(&server, &keeping).1);
}

/// Frame `i` of the built-in session, at `t` instead of its own time.
fn landmarks(lines: &[&str], i: usize, t: f64) -> Value {
    let mut frame: Value = serde_json::from_str(lines[1 + i]).unwrap();
    frame["t"] = t.into();
    frame
}

#[test]
fn a_tracker_that_comes_back_with_another_face_is_not_taken_for_neutral() {
    let lines: Vec<&str> = include_str!("../../../shared/assets/demo.ibug68.jsonl").lines().collect();
    let hello: Value = serde_json::from_str(lines[0]).unwrap();
    let server = Server::start();
    let mut viewer = server.json_viewer("demo");
    let (mut first, _) = publisher(&server, &hello);
    for i in 0..500 {
        see(&mut first, &mut viewer, &landmarks(&lines, i, i as f64 * 0.04));
    }
    leave(&server, first);
    let listed = server.room("demo").unwrap()["neutral"].clone();
    assert!(listed["session"] == 1 && listed["requested"] == false && listed["num_frames"].as_u64() > Some(1), "{listed}");
    assert!(listed["t"].as_f64() > Some(6.0), "what was found later in the session is kept: {listed}");

    // Six frames of raised brows, then a quarter of a second of the neutral face.
    for keeps in [false, true] {
        let mut hello = hello.clone();
        hello["keep_neutral"] = keeps.into();
        let (mut back, is_kept) = publisher(&server, &hello);
        assert_eq!(is_kept, keeps);
        let frames: Vec<f32> = (195..201)
            .chain(452..458)
            .enumerate()
            .map(|(i, of)| strongest(&see(&mut back, &mut viewer, &landmarks(&lines, of, i as f64 * 0.04))))
            .collect();
        if keeps {
            assert!(frames[0] > 0.5, "the brows are raised at once: {frames:?}");
            assert!(frames[11] < 0.2, "the neutral face is at rest: {frames:?}");
        } else {
            assert!(frames[0] < 0.01, "raised brows are taken for neutral: {frames:?}");
            assert!(frames[11] > 0.5, "the neutral face is taken for another: {frames:?}");
        }
        leave(&server, back);
    }
}
