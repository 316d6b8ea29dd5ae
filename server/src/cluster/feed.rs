//! What a node's viewers watch that has its home elsewhere: one subscription a room, for as long as somebody watches.

use super::wire::{StateHead, split};
use super::{Cluster, REQUEST_TIMEOUT};
use crate::room::{Fed, Room, Rooms};
use futures_util::StreamExt;
use rhytid_shared::RoomName;
use std::collections::HashMap;
use std::sync::{Arc, Weak};
use std::time::{Duration, Instant};
use tokio::task::JoinHandle;
use tokio_tungstenite::tungstenite::Bytes;

/// How often rooms are looked through, whatever is heard of them.
const ROUND: Duration = Duration::from_secs(1);
/// A key packet is asked for at most this often.
const ASK_SPACING: Duration = Duration::from_millis(100);

/// Keeps the subscriptions what the viewers want.
pub(super) async fn run(cluster: Arc<Cluster>, rooms: Weak<Rooms>) {
    let mut feeds: HashMap<RoomName, JoinHandle<()>> = HashMap::new();
    let mut interest = cluster.interest.subscribe();
    loop {
        // Only an end of the service makes it fail; then the task is stopped anyway.
        let _ = tokio::time::timeout(ROUND, interest.changed()).await;
        let Some(rooms) = rooms.upgrade() else { return };
        let watched = rooms.watched();
        feeds.retain(|room, feed| {
            let is_wanted = watched.iter().any(|known| known.name == *room) && !cluster.is_home(room) && !feed.is_finished();
            if !is_wanted {
                feed.abort();
            }
            is_wanted
        });
        for room in watched {
            if !cluster.is_home(&room.name) && !feeds.contains_key(&room.name) {
                feeds.insert(room.name.clone(), tokio::spawn(feed(cluster.clone(), room)));
            }
        }
    }
}

async fn feed(cluster: Arc<Cluster>, room: Arc<Room>) {
    let Ok(mut packets) = cluster.client.subscribe(cluster.packets_of(&room.name)).await else { return };
    let mut homes = cluster.homes.subscribe();
    homes.mark_changed();
    let mut asked = (None, 0);
    let mut asked_at: Option<Instant> = None;
    loop {
        let needs_key = tokio::select! {
            message = packets.next() => match message {
                Some(message) => take(&room, &message.payload) == Fed::NeedsKey,
                None => return,
            },
            changed = homes.changed() => {
                if changed.is_err() {
                    return;
                }
                // After the subscription, so that nothing lies between what is asked for and what comes; and again when the home
                // or the connection is another.
                let asks = (cluster.home_elsewhere(&room.name), cluster.connection());
                let is_new = asks.0.is_some() && asks != asked;
                asked = asks;
                if is_new {
                    asked_at = None;
                }
                is_new
            }
        };
        if needs_key && asked_at.is_none_or(|at| at.elapsed() >= ASK_SPACING) {
            asked_at = Some(Instant::now());
            ask(&cluster, &room).await;
        }
    }
}

fn take(room: &Room, message: &Bytes) -> Fed {
    match StateHead::read(message) {
        Some((head, packet)) => room.feed(head, packet),
        None => Fed::Old,
    }
}

/// Asks the room's home for its newest state.
async fn ask(cluster: &Cluster, room: &Room) {
    let Some(home) = cluster.home_elsewhere(&room.name) else { return };
    let subject = cluster.subject(&format!("node.{home}.state"));
    let request = cluster.client.request(subject, room.name.as_str().to_owned().into());
    if let Ok(Ok(answer)) = tokio::time::timeout(REQUEST_TIMEOUT, request).await {
        for message in split(answer.payload) {
            take(room, &message);
        }
    }
}
