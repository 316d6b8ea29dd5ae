//! Entries for fuzzers: any bytes in, and a panic where what reads recordings lets through what it must not.

use super::reader::scan;
use super::{Faces, RecordedFeed, Recording, RecordingWriter, SessionEvent, Topic, export_csv, verify};
use crate::recording::format::VERSION;
use crate::trackers::fuzz::datagrams;
use rhytid_shared::Character;
use rhytid_shared::limits::MAX_HEAD_TRAVEL;
use rhytid_shared::packet::PacketLayout;
use rhytid_shared::view::ViewHello;
use std::io::{Cursor, Read};
use std::sync::Arc;

/// Faces of one input that are read.
const MOST_FACES: usize = 200;
/// Messages of one input.
const MOST_MESSAGES: usize = 60;
/// When recordings of messages begin, ns.
const BEGIN: u64 = 1_700_000_000_000_000_000;

/// A recording's file: its faces, its feeds, and whether it can be solved again. Checksums of chunks count for nothing here, so that
/// what is behind them is read as well.
pub(crate) fn file(bytes: &[u8], character: &Arc<Character>) {
    let mut bytes = bytes.to_vec();
    let length = bytes.len() as u64;
    let places = scan(&mut Cursor::new(&bytes), length).map(|(places, _)| places).unwrap_or_default();
    for place in places {
        // Behind the record's head, two times and the length: the checksum, 0 for none.
        let at = place.offset as usize + 9 + 24;
        if let Some(checksum) = bytes.get_mut(at..at + 4) {
            checksum.fill(0);
        }
    }
    read(bytes, character);
}

/// A whole file of a recording of `character` with the messages in `bytes` (see `trackers::fuzz::datagrams`): each begins with its
/// channel and the ms since the one before.
pub(crate) fn messages(bytes: &[u8], character: &Arc<Character>) {
    let mut file = Vec::new();
    let mut writer = RecordingWriter::to(&mut file, PacketLayout::from(&**character)).expect("memory can be written");
    let hello = ViewHello::new("fuzz", character, String::new()).character;
    let (room, server) = ("fuzz".into(), "fuzz".into());
    let begin = SessionEvent::Recording { version: VERSION, room, server, character: Box::new(hello), clock: BEGIN };
    writer.event(BEGIN, &begin).expect("memory can be written");
    let mut at = BEGIN;
    for message in datagrams(bytes).take(MOST_MESSAGES) {
        let [channel, millis, data @ ..] = message else { continue };
        at += u64::from(*millis) * 1_000_000;
        let topic = topic(*channel);
        writer.message(&topic, at, None, data).expect("memory can be written");
    }
    writer.finish().expect("memory can be written");
    read(file, character);
}

/// The channel of a number.
fn topic(number: u8) -> Topic {
    let slot = if number < 8 { "main" } else { "other" }.to_owned();
    match number % 8 {
        0 => Topic::Session,
        1 => Topic::Packets,
        2 | 3 => Topic::Text(slot),
        4 => Topic::Binary(slot),
        5 | 6 => Topic::Control(slot),
        _ => Topic::Refused(slot),
    }
}

fn read(bytes: Vec<u8>, character: &Arc<Character>) {
    let open = || Recording::from_bytes(bytes.clone(), "fuzz".into());
    match open() {
        Ok(recording) => faces(recording),
        Err(error) => return assert!(error.to_string().lines().count() == 1, "{error}"),
    }
    let again = || open().expect("it was opened before");
    let _ = export_csv(&mut Faces::new(again()), [0.0, 2.0], &mut std::io::sink());
    if let Ok(sessions) = RecordedFeed::sessions(&mut again(), [0.0, f64::INFINITY]) {
        for session in sessions.iter().take(3) {
            if let Ok(Ok(feed)) = RecordedFeed::session(again(), session.index, [0.0, f64::INFINITY]) {
                let _ = std::io::copy(&mut feed.take(1 << 20), &mut std::io::sink());
            }
        }
    }
    if let Err(error) = verify(&mut again(), character) {
        assert!(error.to_string().lines().count() == 1, "{error}");
    }
}

fn faces(recording: Recording) {
    let seconds = recording.seconds();
    assert!(seconds.is_finite() && seconds >= 0.0);
    let num_points = recording.character().bones.len();
    let mut faces = Faces::new(recording);
    let mut last = 0.0;
    for _ in 0..MOST_FACES {
        let Ok(Some(moment)) = faces.advance() else { break };
        assert!(moment.smooth >= last && moment.at >= 0.0, "{moment:?} after {last}");
        last = moment.smooth;
        let face = faces.frame();
        assert_eq!(face.points.len(), num_points);
        assert!(face.points.iter().all(|point| point.is_finite()), "{face:?}");
        assert!(face.head.position.abs().max_element() <= MAX_HEAD_TRAVEL * 1.01, "{face:?}");
    }
    for to in [seconds * 0.5, 0.0, seconds * 2.0] {
        let _ = faces.seek(to);
    }
}
