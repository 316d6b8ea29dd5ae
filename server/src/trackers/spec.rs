//! What the user says of a port for trackers, and of where to send VMC: `PROTOCOL=ADDRESS,option=value,…`.

use super::Protocol;
use super::fmv3;
use super::ifacialmocap::Dialect;
use rhytid_shared::{ChannelGroup, ChannelGroups, RoomName, Slot};
use serde::Deserialize;
use std::net::{IpAddr, SocketAddr};
use std::str::FromStr;

/// Most phones' addresses that a port takes datagrams from.
const MOST_ALLOWED: usize = 64;

/// Why an option was refused: one sentence.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub struct SpecError(String);

/// Which room a port's performers drive.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum RoomRule {
    /// All of them this one.
    Named(RoomName),
    /// Each the room that is called as the sender calls the performer.
    Subject,
}

/// A port that listens for trackers.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(try_from = "String")]
pub struct ListenSpec {
    /// The protocol; `None` where each datagram shows what it is (`any`).
    pub protocol: Option<Protocol>,
    /// Where to listen; port 0 takes a free one.
    pub address: SocketAddr,
    /// Which room.
    pub room: RoomRule,
    /// The source slot, by default called as the protocol.
    pub slot: Option<RoomName>,
    /// Higher wins, 0 to 100.
    pub priority: u8,
    /// The groups of the face that it may drive.
    pub groups: ChannelGroups,
    /// Where datagrams may come from; empty: anywhere.
    pub allow: Vec<IpAddr>,
    /// The phone that is asked to send.
    pub phone: Option<SocketAddr>,
    /// What a phone of iFacialMocap's family is asked for; `None` for version 3.
    pub dialect: Option<Dialect>,
    /// Left and right of the jaw, and of the mouth, are each other's; `None` for what is usual with the protocol.
    pub swap_jaw: Option<bool>,
    /// See `swap_jaw`.
    pub swap_mouth: Option<bool>,
}

impl ListenSpec {
    /// As it is given, for logs and listings.
    pub fn protocol_name(&self) -> &'static str {
        self.protocol.map_or("any", Protocol::name)
    }
}

impl FromStr for ListenSpec {
    type Err = SpecError;

    fn from_str(text: &str) -> Result<Self, SpecError> {
        const FORM: &str = "expected PROTOCOL=ADDRESS:PORT[,option=value…], e.g. openseeface=127.0.0.1:11573,room=demo";
        let mut parts = text.split(',');
        let (name, address) = parts.next().and_then(|first| first.split_once('=')).ok_or_else(|| SpecError(FORM.into()))?;
        let protocol = match name {
            "any" => None,
            name => Some(Protocol::from_name(name).ok_or_else(|| {
                let known: Vec<_> = Protocol::ALL.iter().map(|protocol| protocol.name()).collect();
                SpecError(format!("protocol is {:?}, expected any, {}", cut(name), known.join(", ")))
            })?),
        };
        let mut spec = Self {
            protocol,
            address: parse("address", address, "an IP address and a port")?,
            room: RoomRule::Named(room_name("demo")?),
            slot: None,
            priority: Slot::PRIORITY,
            groups: ChannelGroups::ALL,
            allow: Vec::new(),
            phone: None,
            dialect: (protocol == Some(Protocol::IFacialMocap)).then_some(Dialect::V2),
            swap_jaw: None,
            swap_mouth: None,
        };
        for part in parts {
            let (key, value) = part.split_once('=').ok_or_else(|| SpecError(format!("{:?} is no option=value; {FORM}", cut(part))))?;
            spec.set(key, value)?;
        }
        if spec.phone.is_some() && !matches!(protocol, Some(Protocol::IFacialMocap | Protocol::Fmv3 | Protocol::Vts)) {
            return Err(SpecError(format!(
                "option phone is for ifacialmocap, fmv3 and vts, not for {name}: its senders start by themselves"
            )));
        }
        if let (Some(phone), true) = (spec.phone, spec.allow.is_empty()) {
            // Who is asked is who may answer.
            spec.allow.push(phone.ip());
        }
        Ok(spec)
    }
}

impl ListenSpec {
    fn set(&mut self, key: &str, value: &str) -> Result<(), SpecError> {
        match key {
            "room" if value == "subject" => self.room = RoomRule::Subject,
            "room" => self.room = RoomRule::Named(room_name(value)?),
            "slot" => self.slot = Some(room_name(value)?),
            "priority" => {
                let priority = parse("option priority", value, "0 to 100")?;
                if priority > 100 {
                    return Err(SpecError(format!("option priority is {priority}, expected 0 to 100")));
                }
                self.priority = priority;
            }
            "groups" => {
                self.groups = ChannelGroups::NONE;
                for group in value.split('+') {
                    let known = ChannelGroup::from_name(group).ok_or_else(|| {
                        let all = ChannelGroup::ALL.map(ChannelGroup::name).join(", ");
                        SpecError(format!("option groups has {:?}, expected some of {all} with + between them", cut(group)))
                    })?;
                    self.groups = self.groups.with(known);
                }
            }
            "allow" => {
                if self.allow.len() == MOST_ALLOWED {
                    return Err(SpecError(format!("more than {MOST_ALLOWED} options allow")));
                }
                self.allow.push(parse("option allow", value, "an IP address")?);
            }
            "phone" => self.phone = Some(parse("option phone", value, "the phone's IP address and port")?),
            "version" if matches!(self.protocol, Some(Protocol::IFacialMocap)) => {
                self.dialect = match value {
                    "1" => Some(Dialect::V1),
                    "2" => Some(Dialect::V2),
                    "3" => None,
                    "facemotion3d" => Some(Dialect::Facemotion3d),
                    _ => return Err(SpecError(format!("option version is {:?}, expected 1, 2, 3 or facemotion3d", cut(value)))),
                }
            }
            "swap_jaw" => self.swap_jaw = Some(parse("option swap_jaw", value, "true or false")?),
            "swap_mouth" => self.swap_mouth = Some(parse("option swap_mouth", value, "true or false")?),
            _ => {
                return Err(SpecError(format!(
                    "option {:?} is not known to {}, expected room, allow, phone, version, swap_jaw or swap_mouth",
                    cut(key),
                    self.protocol_name()
                )));
            }
        }
        Ok(())
    }

    /// The slot of a performer whose datagrams are of this protocol.
    pub(super) fn slot_of(&self, protocol: Protocol) -> Slot {
        let name = self.slot.as_ref().map_or_else(|| protocol.name().to_owned(), ToString::to_string);
        Slot { name, priority: self.priority, groups: self.groups }
    }

    /// True where [`fmv3::hello`] is what the phone is asked with.
    pub(super) fn asks_fmv3(&self) -> bool {
        match self.protocol {
            Some(Protocol::Fmv3) => true,
            Some(Protocol::IFacialMocap) => self.dialect.is_none(),
            _ => false,
        }
    }

    /// Longest datagram that is read, bytes.
    pub(super) fn largest_datagram(&self) -> usize {
        let any = || Protocol::ALL.iter().map(|protocol| protocol.largest_datagram()).max().unwrap_or(0);
        self.protocol.map_or_else(any, |protocol| protocol.largest_datagram().max(fmv3::LARGEST_DATAGRAM))
    }
}

impl TryFrom<String> for ListenSpec {
    type Error = SpecError;

    fn try_from(text: String) -> Result<Self, SpecError> {
        text.parse()
    }
}

/// Where a room's face is sent as VMC.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
#[serde(try_from = "String")]
pub struct VmcOutSpec {
    /// The program that takes it.
    pub address: SocketAddr,
    /// The room it shows.
    pub room: RoomName,
}

impl FromStr for VmcOutSpec {
    type Err = SpecError;

    fn from_str(text: &str) -> Result<Self, SpecError> {
        let mut parts = text.split(',');
        let address = parse("address", parts.next().unwrap_or_default(), "an IP address and a port, e.g. 127.0.0.1:39539,room=demo")?;
        let mut spec = Self { address, room: room_name("demo")? };
        for part in parts {
            match part.split_once('=') {
                Some(("room", room)) => spec.room = room_name(room)?,
                _ => return Err(SpecError(format!("{:?} is no option, expected room=NAME", cut(part)))),
            }
        }
        Ok(spec)
    }
}

impl TryFrom<String> for VmcOutSpec {
    type Error = SpecError;

    fn try_from(text: String) -> Result<Self, SpecError> {
        text.parse()
    }
}

fn parse<T: FromStr>(what: &str, text: &str, expected: &str) -> Result<T, SpecError> {
    text.trim().parse().map_err(|_| SpecError(format!("{what} is {:?}, expected {expected}", cut(text))))
}

fn room_name(text: &str) -> Result<RoomName, SpecError> {
    RoomName::new(text).map_err(|error| SpecError(error.to_string()))
}

fn cut(text: &str) -> String {
    text.chars().take(40).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn options_are_read() {
        let spec: ListenSpec = "openseeface=127.0.0.1:11573,room=demo".parse().unwrap();
        assert_eq!((spec.protocol, spec.address.port(), spec.allow.len()), (Some(Protocol::OpenSeeFace), 11573, 0));
        let spec: ListenSpec =
            "ifacialmocap=0.0.0.0:49983,phone=192.0.2.7:49983,room=subject,slot=phone,priority=70,groups=mouth+head,version=3,swap_jaw=true"
                .parse()
                .unwrap();
        assert_eq!((spec.room.clone(), spec.slot_of(Protocol::Fmv3)), {
            let groups = ChannelGroups::NONE.with(ChannelGroup::Mouth).with(ChannelGroup::Head);
            (RoomRule::Subject, Slot { name: "phone".into(), priority: 70, groups })
        });
        assert_eq!(spec.allow, ["192.0.2.7".parse::<IpAddr>().unwrap()], "only the phone that is asked may answer");
        assert!(spec.asks_fmv3() && spec.swap_jaw == Some(true) && spec.swap_mouth.is_none());
        assert_eq!("any=[::1]:9".parse::<ListenSpec>().unwrap().protocol, None);
        let plain = Slot { name: "vts".into(), ..Slot::default() };
        assert_eq!("any=[::1]:9".parse::<ListenSpec>().unwrap().slot_of(Protocol::Vts), plain);
        let out: VmcOutSpec = "127.0.0.1:39539,room=stage".parse().unwrap();
        assert_eq!((out.address.port(), out.room.as_str()), (39539, "stage"));
    }

    #[test]
    fn what_is_wrong_is_named() {
        for (text, expected) in [
            ("", "expected PROTOCOL=ADDRESS:PORT"),
            ("kinect=127.0.0.1:1", "protocol is \"kinect\", expected any, openseeface, livelink"),
            ("livelink=localhost", "address is \"localhost\", expected an IP address and a port"),
            ("livelink=127.0.0.1:1,room=a b", "room name \"a b\" is not"),
            ("livelink=127.0.0.1:1,phone=127.0.0.1:1", "option phone is for"),
            ("livelink=127.0.0.1:1,version=3", "option \"version\" is not known to livelink"),
            ("livelink=127.0.0.1:1,x", "\"x\" is no option=value"),
        ] {
            let error = text.parse::<ListenSpec>().unwrap_err().to_string();
            assert!(error.starts_with(expected), "{error} / {expected}");
        }
        assert!("localhost".parse::<VmcOutSpec>().unwrap_err().to_string().contains("expected an IP address"));
        assert!("127.0.0.1:1,x=1".parse::<VmcOutSpec>().unwrap_err().to_string().contains("expected room=NAME"));
    }
}
