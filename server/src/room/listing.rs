//! Rooms as `/api/rooms` lists them.

use super::{Neutral, Publisher, Room, Rooms, lock};
use crate::cluster::Kept;
use crate::recording::RecorderStatus;
use rhytid_shared::ChannelGroups;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::sync::Arc;

/// A room as `/api/rooms` lists it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct RoomListing {
    pub name: String,
    pub viewers: usize,
    /// Publishers the room has had.
    session: u32,
    /// The one of the highest priority.
    publisher: Option<PublisherListing>,
    sources: Vec<SourceListing>,
    frame: Option<FrameListing>,
    /// The neutral face that the room keeps.
    neutral: Option<NeutralListing>,
    /// The recording being made of it, or the last one where that has failed.
    recording: Option<RecorderStatus>,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct PublisherListing {
    source: String,
    seconds: f64,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct SourceListing {
    slot: String,
    source: String,
    priority: u8,
    groups: Vec<String>,
    /// It has shown a face in the last half second.
    live: bool,
    /// The groups it drives now.
    drives: Vec<String>,
    seconds: f64,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct FrameListing {
    seq: u32,
    t: f64,
    face: bool,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct NeutralListing {
    /// The session that came to it, and the time on its sender's clock, seconds.
    session: u32,
    t: f64,
    /// Frames it is the median of.
    num_frames: usize,
    /// The publisher asked for it.
    requested: bool,
}

/// A room of the cluster as `/api/rooms` lists it.
#[derive(Debug, Serialize)]
pub(crate) struct ClusterListing {
    #[serde(flatten)]
    room: RoomListing,
    /// Its home, or one where somebody watches.
    node: String,
    /// Viewers by node, where there are any.
    nodes: BTreeMap<String, usize>,
}

impl Rooms {
    /// All rooms, by name.
    pub fn list(&self) -> Vec<RoomListing> {
        let rooms: Vec<Arc<Room>> = lock(&self.by_name).values().cloned().collect();
        rooms.iter().map(|room| room.listing()).collect()
    }
}

impl RoomListing {
    /// Its node needs its packets.
    pub fn is_wanted(&self) -> bool {
        self.viewers > 0 || self.recording.as_ref().is_some_and(|recording| recording.error.is_none())
    }
}

impl Room {
    /// Who publishes to it and who watches.
    pub fn listing(&self) -> RoomListing {
        let state = lock(&self.state);
        let now = self.now();
        let first = state.publishers.iter().max_by_key(|publisher| (publisher.claim.slot.priority, publisher.session));
        let newest_neutral = state.neutrals.values().max_by_key(|neutral| neutral.session);
        RoomListing {
            name: self.name.to_string(),
            viewers: state.num_viewers,
            session: state.num_sessions,
            publisher: first.map(|publisher| PublisherListing {
                source: publisher.claim.source.clone(),
                seconds: publisher.since.elapsed().as_secs_f64(),
            }),
            sources: state
                .publishers
                .iter()
                .map(|Publisher { session, claim, since, .. }| {
                    let (live, drives) = state.mixer.state_of(*session, now);
                    SourceListing {
                        slot: claim.slot.name.clone(),
                        source: claim.source.clone(),
                        priority: claim.slot.priority,
                        groups: names_of(claim.slot.groups),
                        live,
                        drives: names_of(drives),
                        seconds: since.elapsed().as_secs_f64(),
                    }
                })
                .collect(),
            frame: state.shown.map(|(seq, micros, face)| FrameListing { seq, t: micros as f64 / 1e6, face }),
            neutral: newest_neutral.map(|Neutral { session, kept: Kept { calibration, .. } }| NeutralListing {
                session: *session,
                t: calibration.t,
                num_frames: calibration.num_frames,
                requested: calibration.requested,
            }),
            recording: state.recording.as_ref().map(|sink| sink.status()),
        }
    }
}

fn names_of(groups: ChannelGroups) -> Vec<String> {
    groups.iter().map(|group| group.name().to_owned()).collect()
}

/// All nodes' listings in one, by name: the room as its home tells of it, viewers summed up.
pub(crate) fn merge(node: &str, own: Vec<RoomListing>, elsewhere: Vec<(String, RoomListing)>) -> Vec<ClusterListing> {
    let mut by_name: BTreeMap<String, ClusterListing> = BTreeMap::new();
    for (node, room) in own.into_iter().map(|room| (node.to_owned(), room)).chain(elsewhere) {
        let viewers = room.viewers;
        let listed = by_name.entry(room.name.clone()).or_insert_with(|| ClusterListing {
            room: room.clone(),
            node: node.clone(),
            nodes: BTreeMap::new(),
        });
        if listed.room.publisher.is_none() && room.publisher.is_some() {
            (listed.room, listed.node) = (room, node.clone());
        }
        if viewers > 0 {
            listed.nodes.insert(node, viewers);
        }
        listed.room.viewers = listed.nodes.values().sum();
    }
    by_name.into_values().collect()
}
