//! A NATS that is slow, that another version has been at, or in which somebody else writes.

use super::nats::Nats;
use super::nodes::{HELLO, Node};
use super::process::wait_for;
use async_nats::jetstream;
use futures_util::{StreamExt, TryStreamExt};
use serde_json::{Value, json};
use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use std::sync::mpsc;
use std::time::{Duration, Instant};

/// The names of the buckets, the leases' last.
async fn buckets(jetstream: &jetstream::Context) -> Vec<String> {
    let mut names: Vec<String> = jetstream.stream_names().try_collect().await.unwrap();
    names.sort();
    names
}

fn is_listed(node: &Node, room: &str) -> bool {
    node.room(room).is_some()
}

/// Records, answers and listings that no node has written.
pub fn nobodys_messages() {
    let nats = Nats::start();
    let a = Node::start(&nats.url()).ready();
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build().unwrap();
    let client = runtime.block_on(async_nats::connect(nats.url())).unwrap();
    let _guard = runtime.enter();
    let jetstream = jetstream::new(client.clone());
    let names = runtime.block_on(buckets(&jetstream));
    let bucket = names[1].strip_prefix("KV_").unwrap();
    let prefix = bucket.strip_suffix("_leases").unwrap().replace('_', ".");
    let lease = |epoch: u64| json!({ "node": "feigned", "address": "nowhere", "epoch": epoch, "sessions": 1 }).to_string();
    let questions = runtime.block_on(async {
        let leases = jetstream.get_key_value(bucket).await.unwrap();
        leases.put("far", lease(u64::MAX).into()).await.unwrap();
        leases.put("junk", "junk".into()).await.unwrap();
        leases.put("asked", lease(1).into()).await.unwrap();
        client.subscribe(format!("{prefix}.node.feigned.enter")).await.unwrap()
    });
    for room in ["far", "junk"] {
        drop(a.publisher(room, HELLO).ready());
    }
    let answering = client.clone();
    runtime.spawn(questions.for_each(move |question| {
        let client = answering.clone();
        async move { client.publish(question.reply.unwrap(), "yes".into()).await.unwrap() }
    }));
    let start = Instant::now();
    drop(a.publisher("asked", HELLO).ready());
    assert!(start.elapsed() > Duration::from_millis(1500), "as if its home had said nothing: {:?}", start.elapsed());

    let room = |name: String| {
        json!({ "name": name, "viewers": 0, "session": 0, "publisher": null, "sources": [], "frame": null, "neutral": null,
            "recording": null })
    };
    let tell = |node: &str, name: &str, num_rooms: usize| {
        let rooms: Vec<Value> = (0..num_rooms).map(|k| room(format!("{name}-{k}"))).collect();
        let told = json!({ "node": node, "address": "nowhere", "part": 0, "of": 1, "rooms": rooms }).to_string();
        runtime.block_on(async {
            client.publish(format!("{prefix}.listing"), told.into()).await.unwrap();
            client.flush().await.unwrap();
        });
    };
    tell("feigned", "endless", 201);
    tell(&"f".repeat(65), "nameless", 1);
    // Behind the others.
    tell("feigned", "sound", 1);
    wait_for("a listing", || is_listed(&a, "sound-0").then_some(()));
    assert!(!is_listed(&a, "endless-0") && !is_listed(&a, "nameless-0"), "{}", a.rooms());
}

/// Buckets that are there with other bounds.
pub fn other_bounds() {
    let nats = Nats::start();
    let _a = Node::start(&nats.url()).ready();
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    let jetstream = runtime.block_on(async { jetstream::new(async_nats::connect(nats.url()).await.unwrap()) });
    let bounds = || {
        runtime.block_on(async {
            let mut bounds = Vec::new();
            for name in buckets(&jetstream).await {
                bounds.push(jetstream.get_stream(name).await.unwrap().cached_info().config.max_bytes);
            }
            bounds
        })
    };
    let before = bounds();
    assert!(before.iter().sum::<i64>() <= 40 << 20, "NATS sets it aside for ever: {before:?}");
    runtime.block_on(async {
        for name in buckets(&jetstream).await {
            let config = jetstream.get_stream(name).await.unwrap().cached_info().config.clone();
            jetstream.update_stream(jetstream::stream::Config { max_bytes: 256 << 20, ..config }).await.unwrap();
        }
    });
    assert_ne!(bounds(), before);
    let _b = Node::start(&nats.url()).ready();
    assert_eq!(bounds(), before);
}

/// A way to a NATS on which every message takes `delay`; gives its port.
fn slow_way(to: u16, delay: Duration) -> u16 {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let port = listener.local_addr().unwrap().port();
    std::thread::spawn(move || {
        for near in listener.incoming().flatten() {
            let Ok(far) = TcpStream::connect(("127.0.0.1", to)) else { continue };
            for stream in [&near, &far] {
                stream.set_nodelay(true).unwrap();
            }
            pass(near.try_clone().unwrap(), far.try_clone().unwrap(), delay);
            pass(far, near, delay);
        }
    });
    port
}

/// Passes bytes on, each `delay` after it has come.
fn pass(mut from: TcpStream, mut to: TcpStream, delay: Duration) {
    let (sender, waiting) = mpsc::channel::<(Instant, Vec<u8>)>();
    std::thread::spawn(move || {
        let mut bytes = [0; 1 << 16];
        while let Ok(length @ 1..) = from.read(&mut bytes) {
            let _ = sender.send((Instant::now() + delay, bytes[..length].to_vec()));
        }
    });
    std::thread::spawn(move || {
        for (due, bytes) in waiting {
            std::thread::sleep(due.saturating_duration_since(Instant::now()));
            if to.write_all(&bytes).is_err() {
                break;
            }
        }
    });
}

/// One node's NATS answers later than others' does.
pub fn slow_nats() {
    let nats = Nats::start();
    let a = Node::start(&nats.url()).ready();
    let port = slow_way(nats.port, Duration::from_millis(200));
    let b = Node::start(&format!("nats://127.0.0.1:{port}")).ready();
    let _first = a.publisher("demo", HELLO).ready();
    let refused = b.publisher("demo", HELLO).answer();
    assert_eq!(refused["code"], "room_taken", "{refused}");
    let _second = b.publisher("fresh", HELLO).ready();
    let refused = a.publisher("fresh", HELLO).answer();
    assert_eq!(refused["code"], "room_taken", "{refused}");
    assert!(!b.log().contains("no lease to be had"), "it has waited for one");
}
