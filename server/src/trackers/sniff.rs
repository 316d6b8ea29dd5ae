//! Telling the senders on one port apart, by how their datagrams begin.

use super::{Protocol, fmv3, openseeface, osc};

/// The protocol that `bytes` are most likely of; `None` where they are of none.
pub fn sniff(bytes: &[u8]) -> Option<Protocol> {
    if bytes.starts_with(fmv3::MAGIC) {
        return Some(Protocol::Fmv3);
    }
    if osc::looks_like_osc(bytes) {
        return Some(Protocol::Vmc);
    }
    if bytes.first() == Some(&b'{') {
        return Some(Protocol::Vts);
    }
    if looks_like_livelink(bytes) {
        return Some(Protocol::LiveLink);
    }
    if !bytes.is_empty() && bytes.len().is_multiple_of(openseeface::FACE_BYTES) && openseeface::plausible_time(bytes) {
        return Some(Protocol::OpenSeeFace);
    }
    let is_text = |byte: &u8| byte.is_ascii_graphic() || *byte == b' ';
    // A text without a head is one of a face that is lost, or of another dialect.
    let has_marks = bytes.contains(&b'|') && bytes.iter().any(|byte| matches!(byte, b'-' | b'&' | b'#'));
    (has_marks && bytes.iter().all(is_text)).then_some(Protocol::IFacialMocap)
}

/// Version 6, and a length that fits its two names, with a face or without.
fn looks_like_livelink(bytes: &[u8]) -> bool {
    let length = |at: usize| {
        let bytes = bytes.get(at..at + 4)?;
        usize::try_from(i32::from_be_bytes(bytes.try_into().ok()?)).ok().filter(|length| *length <= 256)
    };
    if bytes.first() != Some(&6) {
        return false;
    }
    let Some(id) = length(1) else { return false };
    let Some(subject) = length(5 + id) else { return false };
    let names = id + subject;
    bytes.len() == 25 + names || bytes.len() == 270 + names
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::trackers::{ifacialmocap, livelink, vmc, vts};
    use glam::{Quat, Vec3};

    #[test]
    fn every_protocols_own_datagrams_are_told_apart() {
        let weights = [0.25; 52];
        let packet = livelink::Packet { device: "id", subject: "me", frame: 1, sub_frame: 0.0, rate: [60, 1], values: None };
        let full = livelink::Packet { values: Some([0.0; livelink::NUM_VALUES]), ..packet.clone() };
        let (v1, v2) = (ifacialmocap::Dialect::V1, ifacialmocap::Dialect::V2);
        for (expected, bytes) in [
            (Protocol::LiveLink, packet.write()),
            (Protocol::LiveLink, full.write()),
            (Protocol::OpenSeeFace, openseeface::write(1.7e9, [640.0, 480.0], &[[1.0, 2.0]; 66], 1.0)),
            (Protocol::IFacialMocap, ifacialmocap::write(v1, &weights, Quat::IDENTITY, Vec3::ZERO)),
            (Protocol::IFacialMocap, ifacialmocap::write(v2, &weights, Quat::IDENTITY, Vec3::ZERO)),
            (Protocol::IFacialMocap, ifacialmocap::write_no_face(v1)),
            (Protocol::Vts, vts::write(1, None)),
            (Protocol::Vmc, vmc::write(0.5, Some(&weights), Quat::IDENTITY).remove(0)),
            (Protocol::Fmv3, fmv3::hello(1, 60)),
        ] {
            assert_eq!(sniff(&bytes), Some(expected), "{}", String::from_utf8_lossy(&bytes[..20.min(bytes.len())]));
        }
    }

    #[test]
    fn anything_else_is_of_none() {
        for bytes in [&b""[..], b"hello", b"GET / HTTP/1.1\r\n\r\n", &[6; 100], &[0xff; 1785], b"/abc", b"#bundle", b"a|b"] {
            let expected = (bytes == b"/abc").then_some(Protocol::Vmc);
            assert_eq!(sniff(bytes), expected, "{bytes:?}");
        }
    }
}
