//! One entry for each parser, as fuzzers want it: any bytes in, and a panic where the parser lets through what it must not.

use super::{Refusal, Seen, Sight, fmv3, ifacialmocap, livelink, livelink_csv, openseeface, openseeface_csv, sniff, vmc, vts};
use std::io::Read;

/// A parser's entry, and what its corpus is called.
pub type Target = (&'static str, fn(&[u8]));

/// All of them.
pub const TARGETS: [Target; 9] = [
    ("openseeface", openseeface_target),
    ("livelink", livelink_target),
    ("ifacialmocap", ifacialmocap_target),
    ("fmv3", fmv3_target),
    ("vmc", vmc_target),
    ("vts", vts_target),
    ("livelink_csv", livelink_csv_target),
    ("openseeface_csv", openseeface_csv_target),
    ("sniff", sniff_target),
];

/// OpenSeeFace's datagrams.
pub fn openseeface_target(bytes: &[u8]) {
    check(openseeface::parse(bytes));
}

/// Live Link Face's datagrams. What is taken is written again as it was.
pub fn livelink_target(bytes: &[u8]) {
    check(livelink::parse(bytes).map(|seen| vec![seen]));
    if let Ok(packet) = livelink::Packet::read(bytes) {
        assert_eq!(packet.write(), bytes);
    }
}

/// The text of iFacialMocap and Facemotion3d.
pub fn ifacialmocap_target(bytes: &[u8]) {
    check(ifacialmocap::parse(bytes).map(|seen| vec![seen]));
    ifacialmocap::read_hello(bytes);
}

/// Datagrams of FMV3 (see [`datagrams`]), to a receiver that has a stream and to one that has none; and to a sender.
pub fn fmv3_target(bytes: &[u8]) {
    let mut running = fmv3::Receiver::new(7);
    let mut sender = fmv3::Sender::new(99);
    for part in sender.schema() {
        running.take(&part, 0.0).expect("a sender's own schema is taken");
    }
    for (num, datagram) in datagrams(bytes).enumerate() {
        let now = num as f64 / 30.0;
        for receiver in [&mut running, &mut fmv3::Receiver::new(7)] {
            check(receiver.take(datagram, now).map(|output| output.seen.into_iter().collect()));
            receiver.due(now);
        }
        sender.take(datagram);
    }
}

/// Datagrams of VMC (see [`datagrams`]), to one reader.
pub fn vmc_target(bytes: &[u8]) {
    let mut reader = vmc::Reader::default();
    for datagram in datagrams(bytes) {
        check(reader.take(datagram).map(|seen| seen.into_iter().collect()));
    }
}

/// The phone data of VTube Studio.
pub fn vts_target(bytes: &[u8]) {
    check(vts::parse(bytes).map(|seen| vec![seen]));
    vts::read_request(bytes);
}

/// Recordings of Live Link Face. What comes out is a feed.
pub fn livelink_csv_target(bytes: &[u8]) {
    feed_of(livelink_csv::LiveLinkCsv::new(bytes));
}

/// OpenSeeFace's logs: what is taken is a feed that every server takes.
pub fn openseeface_csv_target(bytes: &[u8]) {
    feed_of(openseeface_csv::OpenSeeFaceCsv::new(bytes));
}

fn feed_of(mut lines: impl Read) {
    let mut text = String::new();
    if lines.read_to_string(&mut text).is_err() {
        return;
    }
    let mut feed = crate::feed::Feed::new_for_any_character(text.as_bytes(), "recording".into()).expect("a recording gives a feed");
    let mut frame = rhytid_shared::TrackingFrame::default();
    while feed.next_frame(&mut frame).expect("a recording gives sound frames").is_some() {}
}

/// Telling protocols apart, and the parser that is chosen.
pub fn sniff_target(bytes: &[u8]) {
    use super::Protocol;
    let one = |seen: Seen| vec![seen];
    match sniff::sniff(bytes) {
        None => {}
        Some(Protocol::OpenSeeFace) => check(openseeface::parse(bytes)),
        Some(Protocol::LiveLink) => check(livelink::parse(bytes).map(one)),
        Some(Protocol::IFacialMocap) => check(ifacialmocap::parse(bytes).map(one)),
        Some(Protocol::Vts) => check(vts::parse(bytes).map(one)),
        Some(Protocol::Vmc) => check(vmc::Reader::default().take(bytes).map(|seen| seen.into_iter().collect())),
        Some(Protocol::Fmv3) => check(fmv3::Receiver::new(7).take(bytes, 0.0).map(|output| output.seen.into_iter().collect())),
    }
}

/// Takes datagrams from one input: each begins with its length, u16 little-endian; the last may be shorter than it says.
pub fn datagrams(mut bytes: &[u8]) -> impl Iterator<Item = &[u8]> {
    std::iter::from_fn(move || {
        let (length, rest) = bytes.split_first_chunk::<2>()?;
        let (datagram, behind) = rest.split_at(usize::from(u16::from_le_bytes(*length)).min(rest.len()));
        bytes = behind;
        Some(datagram)
    })
}

/// The opposite of [`datagrams`].
pub fn join<'a>(datagrams: impl IntoIterator<Item = &'a [u8]>) -> Vec<u8> {
    let mut bytes = Vec::new();
    for datagram in datagrams {
        bytes.extend((datagram.len().min(usize::from(u16::MAX)) as u16).to_le_bytes());
        bytes.extend(datagram.iter().take(usize::from(u16::MAX)));
    }
    bytes
}

/// What every parser promises of what it takes.
fn check(result: Result<Vec<Seen>, Refusal>) {
    for seen in result.iter().flatten() {
        assert!(seen.time.is_none_or(f64::is_finite), "{seen:?}");
        match &seen.sight {
            Sight::NoFace => {}
            Sight::Landmarks { points, confidence, image } => {
                assert_eq!((points.len(), confidence.len()), (openseeface::NUM_POINTS, openseeface::NUM_POINTS));
                assert!(points.iter().flatten().chain(image).all(|value| value.abs() <= 1e5), "{seen:?}");
                assert!(confidence.iter().all(|value| (0.0..=1.0).contains(value)), "{seen:?}");
            }
            Sight::Weights(face) => {
                assert!(face.weights.iter().all(|weight| (0.0..=1.2).contains(weight)), "{seen:?}");
                assert!(face.head_rotation.is_none_or(|rotation| (rotation.length() - 1.0).abs() < 1e-3), "{seen:?}");
                assert!(face.head_position.is_none_or(|place| place.abs().max_element() <= 100.0), "{seen:?}");
            }
        }
    }
}
