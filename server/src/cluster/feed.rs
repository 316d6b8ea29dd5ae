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
/// A room of which nothing comes is asked for this often.
const QUIET: Duration = Duration::from_secs(1);
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
            let is_wanted = watched.contains_key(room) && !cluster.is_home(room) && !feed.is_finished();
            if !is_wanted {
                feed.abort();
            }
            is_wanted
        });
        for (name, room) in watched {
            if !feeds.contains_key(&name) && !cluster.is_home(&name) {
                feeds.insert(name, tokio::spawn(feed(cluster.clone(), room)));
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
    let mut quiet_at = tokio::time::Instant::now() + QUIET;
    loop {
        let needs_key = tokio::select! {
            message = packets.next() => match message {
                Some(message) => {
                    quiet_at = tokio::time::Instant::now() + QUIET;
                    take(&room, &message.payload) == Fed::NeedsKey
                }
                None => return,
            },
            // Nothing is published, or the home does not know that somebody watches here, or what came last was lost.
            () = tokio::time::sleep_until(quiet_at) => {
                quiet_at = tokio::time::Instant::now() + QUIET;
                true
            }
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

#[cfg(test)]
mod tests {
    use super::super::{Outbound, Outlet};
    use super::*;
    use crate::metrics::Metrics;
    use crate::recording::{RecordConfig, Recorder};
    use crate::room::{Others, Publishing, RoomError, SlotClaim};
    use rhytid_shared::packet::{Decoder, PacketLayout};
    use rhytid_shared::view::ViewHello;
    use rhytid_shared::{Character, FaceFrame, Resume};
    use tokio::sync::{mpsc, watch};

    /// A node's rooms, and what leaves them for other nodes.
    fn node() -> (Arc<Rooms>, mpsc::Receiver<Outbound>, PacketLayout) {
        node_that_tells(watch::Sender::new(()))
    }

    fn node_that_tells(interest: watch::Sender<()>) -> (Arc<Rooms>, mpsc::Receiver<Outbound>, PacketLayout) {
        let character = Arc::new(Character::from_glb(rhytid_shared::DEFAULT_CHARACTER_GLB).unwrap());
        let (outlet, outbound) = mpsc::channel(64);
        let others = Others { outlet: Outlet { prefix: String::new(), outbound: outlet }, interest };
        let layout = PacketLayout::from(&*character);
        let metrics = Arc::new(Metrics::new());
        let recorder = Recorder::new(RecordConfig::default(), &character, metrics.clone(), mpsc::channel(1).0);
        (Arc::new(Rooms::new(character, 4, 4, metrics, Arc::new(recorder), Some(others))), outbound, layout)
    }

    fn name() -> RoomName {
        RoomName::new("demo").unwrap()
    }

    fn publish(rooms: &Rooms, layout: &PacketLayout, count: u32) -> Publishing {
        let (place, _evicted) =
            rooms.claim(&name(), SlotClaim { takeover: true, ..SlotClaim::default() }, mpsc::channel(1).0, |_| Vec::new()).unwrap();
        for seq in 0..count {
            let captured_at_micros = 40_000 * u64::from(seq);
            let frame = FaceFrame { session: place.session, seq, captured_at_micros, face: true, ..layout.frame_at_rest() };
            place.publish(&frame, None);
        }
        place
    }

    fn sent(outbound: &mut mpsc::Receiver<Outbound>) -> Vec<(StateHead, Bytes)> {
        std::iter::from_fn(|| outbound.try_recv().ok()).map(|sent| StateHead::read(&sent.message).unwrap()).collect()
    }

    #[test]
    fn what_comes_twice_late_or_under_an_older_epoch_is_not_shown() {
        let (home, mut outbound, layout) = node();
        home.lead(&name(), 7, true, 0).unwrap();
        let _first = publish(&home, &layout, 3);
        let packets = sent(&mut outbound);
        home.lead(&name(), 8, true, 1000).unwrap();
        let _second = publish(&home, &layout, 1);
        let newer = sent(&mut outbound);

        let (other, ..) = node();
        let viewing = other.join(&name()).unwrap();
        let feed = |(head, packet): &(StateHead, Bytes)| viewing.room.feed(*head, packet.clone());
        assert_eq!(feed(&packets[1]), Fed::NeedsKey, "a delta before its key packet");
        assert_eq!((feed(&packets[0]), feed(&packets[2])), (Fed::Taken, Fed::Taken));
        assert_eq!((feed(&packets[2]), feed(&packets[1])), (Fed::Old, Fed::Old), "twice, and late");
        assert_eq!(feed(&newer[0]), Fed::Taken);
        let late = StateHead { index: 1_000_000, key_index: 1_000_000, ..packets[0].0 };
        assert_eq!(viewing.room.feed(late, packets[0].1.clone()), Fed::Old, "from a home that does not know that it is none");
    }

    #[test]
    fn nothing_leaves_under_an_epoch_that_others_do_not_know() {
        let (home, mut outbound, layout) = node();
        home.lead(&name(), 7, false, 0).unwrap();
        let place = publish(&home, &layout, 2);
        assert!(sent(&mut outbound).is_empty());
        home.lead(&name(), 8, true, 0).unwrap();
        assert!(place.publish(&FaceFrame { session: place.session, seq: 2, ..layout.frame_at_rest() }, None));
        assert_eq!(sent(&mut outbound)[0].0.epoch, 8);
    }

    #[test]
    fn interest_changes_with_the_first_viewer_and_the_last() {
        let told = watch::Sender::new(());
        let mut interest = told.subscribe();
        let (rooms, ..) = node_that_tells(told);
        let mut has_changed = || {
            let has_changed = interest.has_changed().unwrap();
            interest.mark_unchanged();
            has_changed
        };
        let first = rooms.join(&name()).unwrap();
        assert!(has_changed());
        let second = rooms.join(&name()).unwrap();
        drop(first);
        assert!(!has_changed());
        assert_eq!(rooms.watched().len(), 1);
        drop(second);
        assert!(has_changed());
        assert!(rooms.watched().is_empty());
    }

    #[test]
    fn room_is_not_swept_before_its_lease_is_given_back() {
        let (rooms, ..) = node();
        rooms.lead(&name(), 7, true, 5).unwrap();
        rooms.sweep(Duration::ZERO);
        assert_eq!(rooms.num_sessions(&name()), 5);
        assert!(rooms.give_up(&name()));
        rooms.sweep(Duration::ZERO);
        assert!(rooms.find(&name()).is_none());
    }

    #[test]
    fn node_that_was_no_home_does_not_shut_out_the_one_that_is() {
        let (home, mut outbound, layout) = node();
        home.lead(&name(), 9, true, 0).unwrap();
        let _first = publish(&home, &layout, 1);
        let false_packet = sent(&mut outbound).remove(0);
        home.lead(&name(), 7, true, 1000).unwrap();
        let _second = publish(&home, &layout, 1);
        let packet = sent(&mut outbound).remove(0);

        let (other, ..) = node();
        let viewing = other.join(&name()).unwrap();
        assert_eq!(viewing.room.feed(false_packet.0, false_packet.1), Fed::Taken);
        assert_eq!(viewing.room.feed(packet.0, packet.1.clone()), Fed::Old);
        other.follow(&name(), 7);
        assert_eq!(viewing.room.feed(packet.0, packet.1), Fed::Taken);
    }

    #[test]
    fn what_cannot_be_read_goes_no_further_and_ends_nobody() {
        let (home, mut outbound, layout) = node();
        home.lead(&name(), 7, true, 0).unwrap();
        let _place = publish(&home, &layout, 2);
        let packets = sent(&mut outbound);
        let (other, ..) = node();
        let viewing = other.join(&name()).unwrap();
        let room = &viewing.room;
        assert_eq!(room.feed(packets[0].0, Bytes::from_static(b"\x10nonsense")), Fed::Broken);
        assert!(viewing.slot.borrow().is_none());
        assert_eq!(room.feed(packets[0].0, packets[0].1.clone()), Fed::Taken, "what is whole is taken all the same");
        // A delta that says it is a key packet.
        let head = StateHead { index: 9, key_index: 9, ..packets[1].0 };
        assert_eq!(room.feed(head, packets[1].1.clone()), Fed::Broken);
        let character = Character::from_glb(rhytid_shared::DEFAULT_CHARACTER_GLB).unwrap();
        let latest = viewing.slot.borrow().clone().unwrap();
        let text = latest.json(&layout, &ViewHello::new("", &character, String::new()).character).payload();
        assert!(str::from_utf8(text).unwrap().contains("\"seq\":0"));
    }

    #[test]
    fn fresh_home_does_not_tell_what_it_was_told_as_its_own() {
        let (home, mut outbound, layout) = node();
        home.lead(&name(), 7, true, 0).unwrap();
        let _place = publish(&home, &layout, 2);
        let (next, ..) = node();
        let viewing = next.join(&name()).unwrap();
        for (head, packet) in sent(&mut outbound) {
            viewing.room.feed(head, packet);
        }
        assert!(next.newest(&name()).is_empty(), "it is not the home");
        next.lead(&name(), 8, true, 1000).unwrap();
        assert!(next.newest(&name()).is_empty(), "nothing was published here yet");
        let place = publish(&next, &layout, 2);
        assert!(place.session > 1000);
        let newest = next.newest(&name());
        let (mut decoder, mut frame) = (Decoder::new(layout.clone()), layout.frame_at_rest());
        for message in &newest {
            let (head, packet) = StateHead::read(message).unwrap();
            assert_eq!(head.epoch, 8);
            decoder.decode(&packet, &mut frame).unwrap();
        }
        assert_eq!((frame.session, frame.seq), (place.session, 1));
    }

    #[test]
    fn who_comes_back_takes_its_own_session_over_and_no_other() {
        let (rooms, _outbound, layout) = node();
        let claim = |resume| rooms.claim(&name(), SlotClaim { resume, ..SlotClaim::default() }, mpsc::channel(1).0, |_| Vec::new());
        assert_eq!(claim(None).err(), Some(RoomError::Elsewhere), "the room's home is not here");
        rooms.lead(&name(), 7, true, 0).unwrap();
        let first = publish(&rooms, &layout, 1);
        let named = |session, key: Option<&str>| Some(Resume { session, key: key.map(str::to_owned) });
        let own = first.key.clone();
        for (session, key) in [(first.session + 1, None), (first.session + 1, Some(&*own)), (first.session, Some("a stranger's"))] {
            assert_eq!(claim(named(session, key)).err(), Some(RoomError::Taken), "{session} {key:?}");
            assert!(!rooms.is_free_for(&name(), named(session, key).as_ref()));
        }
        assert!(!rooms.is_free_for(&name(), None) && rooms.is_free_for(&name(), named(first.session, Some(&own)).as_ref()));
        let (second, _evicted) = claim(named(first.session, Some(&own))).unwrap();
        assert_ne!(second.key, own);
        // An older client does not know its key; in a cluster no other session has had its number.
        let before = second.session;
        let (second, _evicted) = claim(named(before, None)).unwrap();
        assert!(second.session > first.session);
        // One that is not the home any more has no publishers.
        rooms.evict(&name(), Some(8));
        assert!(rooms.slots(&name()).is_empty());
        assert!(!second.publish(&layout.frame_at_rest(), None), "its frames go nowhere");
    }
}
