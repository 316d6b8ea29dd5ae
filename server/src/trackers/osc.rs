//! Open Sound Control: bundles are taken apart here, within bounds; the messages in them are read by the crate `rosc`.
//!
//! `rosc` reads bundles within bundles, and arrays within arrays, by recursion without a limit, so that one datagram can overflow
//! the stack: what reaches it here is one message without arrays.

use super::Refusal;
use rosc::{OscMessage, OscPacket};

/// Most messages in a datagram: a body and a face of other programs take some 130.
const MAX_MESSAGES: usize = 1024;
/// Most arguments of a message: the longest of VMC has 14.
const MAX_ARGUMENTS: usize = 32;
/// Deepest bundle within a bundle.
const MAX_DEPTH: usize = 4;

const BUNDLE: &[u8] = b"#bundle\0";

/// True where `bytes` begin as a message or a bundle does.
pub fn looks_like_osc(bytes: &[u8]) -> bool {
    bytes.len().is_multiple_of(4) && (bytes.starts_with(BUNDLE) || bytes.first() == Some(&b'/'))
}

/// Gives each message of a datagram to `take`, in its order.
pub fn messages(bytes: &[u8], mut take: impl FnMut(OscMessage) -> Result<(), Refusal>) -> Result<(), Refusal> {
    // What is still to be read, the next last: element and depth.
    let mut pending = vec![(bytes, 0)];
    let mut num_messages = 0;
    while let Some((element, depth)) = pending.pop() {
        if !element.len().is_multiple_of(4) {
            return Err(Refusal::WrongLength);
        }
        if let Some(content) = element.strip_prefix(BUNDLE) {
            if depth > MAX_DEPTH {
                return Err(Refusal::WrongCount);
            }
            let first = pending.len();
            let mut rest = content.get(8..).ok_or(Refusal::Truncated)?;
            while let Some((size, behind)) = rest.split_first_chunk::<4>() {
                let size = u32::from_be_bytes(*size) as usize;
                let (element, behind) = behind.split_at_checked(size).ok_or(Refusal::Truncated)?;
                pending.push((element, depth + 1));
                if pending.len() > MAX_MESSAGES {
                    return Err(Refusal::WrongCount);
                }
                rest = behind;
            }
            if !rest.is_empty() {
                return Err(Refusal::Truncated);
            }
            pending[first..].reverse();
            continue;
        }
        num_messages += 1;
        if num_messages > MAX_MESSAGES {
            return Err(Refusal::WrongCount);
        }
        take(message(element)?)?;
    }
    Ok(())
}

fn message(bytes: &[u8]) -> Result<OscMessage, Refusal> {
    if bytes.is_empty() {
        return Err(Refusal::Truncated);
    }
    // Messages of old senders without type tags have no arguments for anybody.
    let address_end = bytes.iter().position(|byte| *byte == 0).ok_or(Refusal::Truncated)?;
    let tags = bytes.get((address_end / 4 + 1) * 4..).unwrap_or_default();
    let tags = &tags[..tags.iter().position(|byte| *byte == 0).unwrap_or(tags.len())];
    if tags.len() > MAX_ARGUMENTS + 1 || tags.contains(&b'[') {
        return Err(Refusal::WrongCount);
    }
    match rosc::decoder::decode_udp(bytes) {
        Ok((_, OscPacket::Message(message))) => Ok(message),
        Ok(_) | Err(_) => Err(Refusal::Malformed),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rosc::{OscBundle, OscTime, OscType, encoder};

    fn note(address: &str) -> OscPacket {
        OscPacket::Message(OscMessage { addr: address.into(), args: vec![OscType::Float(0.5)] })
    }

    fn bundle(content: Vec<OscPacket>) -> OscPacket {
        OscPacket::Bundle(OscBundle { timetag: OscTime { seconds: 0, fractional: 1 }, content })
    }

    fn read(bytes: &[u8]) -> Result<Vec<String>, Refusal> {
        let mut found = Vec::new();
        messages(bytes, |message| {
            found.push(message.addr);
            Ok(())
        })?;
        Ok(found)
    }

    #[test]
    fn messages_come_in_their_order() {
        let packet = bundle(vec![note("/a"), bundle(vec![note("/b"), note("/c")]), note("/d")]);
        assert_eq!(read(&encoder::encode(&packet).unwrap()).unwrap(), ["/a", "/b", "/c", "/d"]);
        assert_eq!(read(&encoder::encode(&note("/e")).unwrap()).unwrap(), ["/e"]);
    }

    #[test]
    fn a_tower_of_bundles_or_arrays_is_refused_before_it_falls() {
        let mut bytes = encoder::encode(&note("/a")).unwrap();
        for _ in 0..3000 {
            bytes = [BUNDLE, &[0; 8], &(bytes.len() as u32).to_be_bytes(), &bytes].concat();
        }
        assert_eq!(read(&bytes), Err(Refusal::WrongCount));
        let mut bytes = b"/a\0\0,".to_vec();
        bytes.extend(vec![b'['; 30_000]);
        bytes.extend(vec![b']'; 30_000]);
        bytes.resize((bytes.len() / 4 + 1) * 4, 0);
        assert_eq!(read(&bytes), Err(Refusal::WrongCount));
        let crowd = bundle((0..2000).map(|_| note("/a")).collect());
        assert_eq!(read(&encoder::encode(&crowd).unwrap()), Err(Refusal::WrongCount));
    }

    #[test]
    fn what_is_cut_is_refused() {
        let whole = encoder::encode(&bundle(vec![note("/a"), note("/bb")])).unwrap();
        let boundary = [16, 16 + 4 + 12];
        for cut in 0..whole.len() {
            assert_eq!(read(&whole[..cut]).is_ok(), boundary.contains(&cut), "{cut}");
        }
    }
}
