//! What performers leave with their rooms, on its way to NATS.

use super::wire::Kept;
use super::{Cluster, MOST_KEPT_BYTES, REQUEST_TIMEOUT, ROUND, lock};
use crate::room::Rooms;
use crate::service::stopped;
use async_nats::jetstream::kv::CreateErrorKind;
use futures_util::StreamExt;
use rhytid_shared::RoomName;
use std::collections::{BTreeMap, HashMap};
use std::sync::{Arc, Mutex};
use std::time::Duration;
use tokio::sync::{Notify, watch};
use tokio_tungstenite::tungstenite::Bytes;

/// Records that wait to be kept: one for each slot of a thousand rooms.
const MOST_KEEPING: usize = 8192;
/// Their bytes: thousands of neutrals as they are, or 256 of the largest. As many again may be on their way.
const MOST_KEEPING_BYTES: usize = 64 << 20;
/// How often a record is offered to a NATS that is there and does not take it: for ten seconds, in which its servers may choose who
/// leads them.
const MOST_KEEPING_TRIES: u32 = 20;
/// Records that are sent to be kept at a time.
const KEEPING_AT_ONCE: usize = 16;
/// How long a node that ends waits for NATS to take the rest.
const REST_TIMEOUT: Duration = Duration::from_secs(1);

/// One value to be kept.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Record {
    /// What came before has a smaller one.
    turn: u64,
    key: String,
    text: Bytes,
    /// Only where nothing is kept under its key.
    is_fill: bool,
}

/// What is to be kept in NATS: of each key the newest value only, so that none overtakes another.
#[derive(Default)]
pub(super) struct Keeping {
    waiting: Mutex<Waiting>,
    is_there: Notify,
}

#[derive(Default)]
struct Waiting {
    by_turn: BTreeMap<u64, Record>,
    turns: HashMap<String, u64>,
    num_bytes: usize,
    num_turns: u64,
    /// Some found no place since there was nothing to wait for.
    has_dropped: bool,
}

impl Waiting {
    fn insert(&mut self, record: Record) {
        self.num_bytes += record.text.len();
        self.turns.insert(record.key.clone(), record.turn);
        self.by_turn.insert(record.turn, record);
        while self.by_turn.len() > MOST_KEEPING || self.num_bytes > MOST_KEEPING_BYTES {
            let Some((_, oldest)) = self.by_turn.pop_first() else { break };
            self.turns.remove(&oldest.key);
            self.num_bytes -= oldest.text.len();
            if !std::mem::replace(&mut self.has_dropped, true) {
                tracing::warn!(key = oldest.key, "neutral faces not kept in the cluster: too many wait, the oldest go first");
            }
        }
    }

    fn remove(&mut self, key: &str) {
        if let Some(record) = self.turns.remove(key).and_then(|turn| self.by_turn.remove(&turn)) {
            self.num_bytes -= record.text.len();
        }
    }
}

impl Keeping {
    /// Where there is no place for one more, the oldest goes.
    fn put(&self, key: String, text: Bytes, is_fill: bool) {
        let mut waiting = lock(&self.waiting);
        // What waits is kept whatever there is.
        if is_fill && waiting.turns.contains_key(&key) {
            return;
        }
        waiting.remove(&key);
        waiting.num_turns += 1;
        let turn = waiting.num_turns;
        waiting.insert(Record { turn, key, text, is_fill });
        self.is_there.notify_one();
    }

    /// Puts back what could not be kept, unless there is something newer.
    fn put_back(&self, record: Record) {
        let mut guard = lock(&self.waiting);
        let waiting = &mut *guard;
        match waiting.turns.get(&record.key).and_then(|turn| waiting.by_turn.get_mut(turn)) {
            Some(newer) => newer.is_fill &= record.is_fill,
            None => waiting.insert(record),
        }
        self.is_there.notify_one();
    }

    /// The oldest first.
    fn take_now(&self) -> Vec<Record> {
        let mut waiting = lock(&self.waiting);
        let Waiting { by_turn, num_turns, .. } = std::mem::take(&mut *waiting);
        waiting.num_turns = num_turns;
        by_turn.into_values().collect()
    }

    /// Waits for values to keep.
    async fn wait(&self) {
        while lock(&self.waiting).by_turn.is_empty() {
            self.is_there.notified().await;
        }
    }
}

impl Cluster {
    /// What the cluster keeps of a room's slot.
    pub(super) async fn kept(&self, room: &RoomName, slot: &str) -> Option<Kept> {
        let buckets = self.buckets.get()?;
        let bytes = tokio::time::timeout(REQUEST_TIMEOUT, buckets.kept.get(format!("{room}.{slot}"))).await.ok()?.ok()??;
        serde_json::from_slice(&bytes).ok()
    }

    /// Keeps what a room keeps of a slot, for whichever node its publisher comes to next.
    pub fn keep(&self, room: &RoomName, slot: &str, kept: &Kept) {
        self.put(room, slot, kept, false);
    }

    /// Keeps it where the cluster keeps nothing of that slot.
    pub(super) fn fill(&self, room: &RoomName, slot: &str, kept: &Kept) {
        self.put(room, slot, kept, true);
    }

    fn put(&self, room: &RoomName, slot: &str, kept: &Kept, is_fill: bool) {
        let text = serde_json::to_vec(kept).expect("plain data can be written");
        if text.len() > MOST_KEPT_BYTES as usize {
            tracing::warn!(%room, slot, bytes = text.len(), "neutral face not kept in the cluster: it is too large");
        } else {
            self.keeping.put(format!("{room}.{slot}"), text.into(), is_fill);
        }
    }

    /// Keeps again what a room keeps whose home this node is: NATS may have come back without its data, and forgets what is older than
    /// a day. Where this node has not been the home `all_along`, another may have kept something newer for a slot that nobody has here.
    pub(super) fn keep_again(&self, rooms: &Rooms, room: &RoomName, all_along: bool) {
        rooms.each_kept(room, |slot, kept, is_taken| self.put(room, slot, kept, !(all_along || is_taken)));
    }

    /// Keeps what there is to keep until the service ends. What NATS does not take is tried again, unless something newer has come.
    pub(super) async fn keep_all(self: Arc<Self>, mut shutdown: watch::Receiver<bool>) {
        let mut tries: HashMap<String, u32> = HashMap::new();
        loop {
            let taken = tokio::select! {
                taken = self.take_to_keep() => taken,
                () = stopped(&mut shutdown) => return,
            };
            let refused = tokio::select! {
                refused = self.keep_these(taken.clone()) => refused,
                () = stopped(&mut shutdown) => {
                    // With the rest, and in no case behind it. What is kept by now is kept twice.
                    taken.into_iter().for_each(|record| self.keeping.put_back(record));
                    return;
                }
            };
            tries.retain(|key, _| refused.iter().any(|(refused, _)| refused.key == *key));
            for (record, problem) in refused {
                let num_tries = tries.entry(record.key.clone()).or_default();
                // Without NATS it waits for as long as that takes.
                *num_tries += u32::from(self.problem().is_none());
                if *num_tries >= MOST_KEEPING_TRIES {
                    tracing::warn!(key = record.key, problem, "neutral face not kept in the cluster");
                    tries.remove(&record.key);
                } else {
                    tracing::debug!(key = record.key, problem, "neutral face not kept in the cluster yet");
                    self.keeping.put_back(record);
                }
            }
            if !tries.is_empty() {
                tokio::select! {
                    () = tokio::time::sleep(ROUND) => {}
                    () = stopped(&mut shutdown) => return,
                }
            }
        }
    }

    /// Waits for values to keep and for NATS: until then they stay where newer ones take their places.
    async fn take_to_keep(&self) -> Vec<Record> {
        loop {
            self.keeping.wait().await;
            if self.problem().is_none() {
                return self.keeping.take_now();
            }
            tokio::time::sleep(ROUND).await;
        }
    }

    /// Keeps what publishers have left in the last moment.
    pub async fn keep_rest(&self) {
        let keeper = lock(&self.keeper).take();
        let keeping = async {
            // It has been told to end. Beside it, an older value could be written behind a newer one of the same key.
            if let Some(keeper) = keeper {
                let _ = keeper.await;
            }
            self.keep_these(self.keeping.take_now()).await
        };
        // Without NATS each would wait for its own time.
        match tokio::time::timeout(REST_TIMEOUT, keeping).await {
            Ok(refused) => {
                for (record, problem) in refused {
                    tracing::warn!(key = record.key, problem, "neutral face not kept in the cluster");
                }
            }
            Err(_) => tracing::warn!("not all neutral faces kept in the cluster: NATS takes too long"),
        }
    }

    /// Done with all of them, so that the next value of any key comes behind them. Gives those that were not taken, and why.
    async fn keep_these(&self, taken: Vec<Record>) -> Vec<(Record, String)> {
        let Some(buckets) = self.buckets.get() else {
            return taken.into_iter().map(|record| (record, "there is no bucket yet".to_owned())).collect();
        };
        let puts = taken.into_iter().map(async |record| {
            let (key, text) = (&record.key, record.text.clone());
            let putting = async {
                if !record.is_fill {
                    return buckets.kept.put(key, text).await.map(drop).map_err(|error| error.to_string());
                }
                match buckets.kept.create(key, text).await {
                    Err(error) if error.kind() != CreateErrorKind::AlreadyExists => Err(error.to_string()),
                    _ => Ok(()),
                }
            };
            let put = tokio::time::timeout(REQUEST_TIMEOUT, putting).await;
            let problem = put.unwrap_or_else(|_| Err("no answer".to_owned())).err()?;
            Some((record, problem))
        });
        let puts = futures_util::stream::iter(puts).buffer_unordered(KEEPING_AT_ONCE);
        puts.filter_map(std::future::ready).collect().await
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn taken(keeping: &Keeping) -> Vec<(String, Bytes, bool)> {
        keeping.take_now().into_iter().map(|record| (record.key, record.text, record.is_fill)).collect()
    }

    fn put(keeping: &Keeping, key: &str, text: &'static str) {
        keeping.put(key.into(), text.into(), false);
    }

    #[tokio::test]
    async fn newest_of_each_key_is_kept() {
        let keeping = Keeping::default();
        for (key, text) in [("a", "1"), ("b", "2"), ("a", "3")] {
            put(&keeping, key, text);
        }
        keeping.wait().await;
        let first = keeping.take_now();
        assert_eq!(first.iter().map(|record| &*record.text).collect::<Vec<_>>(), [b"2", b"3"]);
        put(&keeping, "a", "4");
        first.into_iter().for_each(|record| keeping.put_back(record));
        assert_eq!(taken(&keeping), [("b".into(), "2".into(), false), ("a".into(), "4".into(), false)]);
    }

    #[test]
    fn fill_takes_no_newer_value_away() {
        let keeping = Keeping::default();
        put(&keeping, "a", "1");
        keeping.put("a".into(), "fill".into(), true);
        assert_eq!(taken(&keeping), [("a".into(), "1".into(), false)]);
        keeping.put("a".into(), "fill".into(), true);
        put(&keeping, "a", "2");
        let refused = keeping.take_now().remove(0);
        assert!(!refused.is_fill);
        keeping.put("a".into(), "3".into(), true);
        keeping.put_back(refused);
        assert_eq!(taken(&keeping), [("a".into(), "3".into(), false)], "the newer text, whatever there is");
    }

    #[test]
    fn oldest_makes_room() {
        let keeping = Keeping::default();
        (0..=MOST_KEEPING).for_each(|k| put(&keeping, &k.to_string(), ""));
        let all = keeping.take_now();
        assert_eq!((all.len(), &*all[0].key), (MOST_KEEPING, "1"));
        let large = Bytes::from(vec![0; MOST_KEPT_BYTES as usize]);
        (0..300).for_each(|k| keeping.put(k.to_string(), large.clone(), false));
        put(&keeping, "299", "small again");
        let all = keeping.take_now();
        assert_eq!((all.len(), &*all[0].key), (MOST_KEEPING_BYTES / large.len(), "44"));
        // What comes back is older than all of them.
        (300..600).for_each(|k| keeping.put(k.to_string(), large.clone(), false));
        all.into_iter().for_each(|record| keeping.put_back(record));
        let num_bytes = keeping.take_now().iter().map(|record| record.text.len()).sum::<usize>();
        assert_eq!(num_bytes, MOST_KEEPING_BYTES);
        assert_eq!(lock(&keeping.waiting).num_bytes, 0);
    }
}
