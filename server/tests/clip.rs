//! Animation clips as feeds.

#![allow(clippy::unwrap_used, reason = "helpers of tests fail like tests")]

mod clip_fixture;

use clip_fixture::with_clip;
use glam::{Quat, Vec3};
use rhytid_server::Clip;
use rhytid_server::feed::{Feed, FeedItem};
use rhytid_shared::{TrackingData, TrackingFrame};
use std::io::{BufRead, Read};

#[test]
fn a_clip_becomes_bones_frames_without_the_heads_motion() {
    let (glb, character) = with_clip();
    let clip = Clip::open(&glb, &character, "nod").unwrap();
    let mut feed = Feed::new(clip.reader(), "clip".into(), &character).unwrap();
    assert_eq!((feed.hello.source.as_str(), feed.hello.fps), ("clip nod", Some(60.0)));
    let (mut frame, mut num_frames) = (TrackingFrame::default(), 0);
    while feed.next_frame(&mut frame).unwrap() == Some(FeedItem::Frame) {
        let TrackingData::Bones { points, head } = &frame.data else { panic!("not bones") };
        let u = num_frames as f32 / 60.0;
        assert!((frame.t - f64::from(u)).abs() < 1e-6);
        for &(bone, point) in points {
            let lift = if bone == 0 { 0.008 * u } else { 0.0 };
            let wanted = character.bones[bone].rest + Vec3::new(0.0, lift, 0.0);
            assert!(point.distance(wanted) < 2e-6, "{} is at {point}, expected {wanted} at {u}", character.bones[bone].name);
        }
        let head = head.expect("the head moves");
        assert!(head.rotation.angle_between(Quat::from_rotation_y(0.4 * u)) < 2e-3);
        assert!(head.position.distance(Vec3::new(0.02 * u, 0.0, 0.0)) < 1e-5, "{}", head.position);
        num_frames += 1;
    }
    assert_eq!(num_frames, 61);
}

#[test]
fn a_clip_is_written_as_it_is_read() {
    let (glb, character) = with_clip();
    let clip = Clip::open(&glb, &character, "nod").unwrap();
    let mut text = String::new();
    clip.reader().read_to_string(&mut text).unwrap();
    assert_eq!((text.len() as u64, text.lines().count()), (clip.num_bytes(), 1 + 61));
    let mut reader = clip.reader();
    reader.read_line(&mut String::new()).unwrap();
    assert!(reader.fill_buf().unwrap().len() < 8192, "one line at a time");
}

#[test]
fn what_is_no_clip_is_refused() {
    let (mut glb, character) = with_clip();
    let error = Clip::open(&glb, &character, "run").unwrap_err().to_string();
    assert_eq!(error, "there is no clip called \"run\" in this character; it has nod");
    // An accessor that reaches past the end of its view.
    let at = glb.windows(8).position(|eight| eight == b"\"count\":").map(|first| first + 8).unwrap();
    let last = glb.windows(9).rposition(|nine| nine == b"\"count\":2").unwrap() + 8;
    assert!(last > at);
    glb[last] = b'9';
    let error = Clip::open(&glb, &character, "nod").unwrap_err().to_string();
    assert!(error.contains("reaches past the end"), "{error}");
}
