//! Nodes that die, stop, are restarted or cut off, and NATS that dies: when is the face back?

use super::namespace::{Namespace, ip};
use super::nats::Nats;
use super::nodes::{Cluster, HELLO, Node};
use super::process::{Process, wait_for};
use super::senders::{send, write_feed};
use super::signal::{Signal, signal};
use super::watch::{Watch, num_twice, pause};
use futures_util::TryStreamExt;
use serde_json::Value;
use std::sync::Arc;
use std::time::{Duration, Instant};
use tokio_tungstenite::tungstenite::Message;
use tokio_tungstenite::tungstenite::protocol::frame::coding::CloseCode;

/// A node is lost: so soon its viewers see the face again.
const BACK_WITHIN: Duration = Duration::from_secs(2);

pub fn face_is_back_with_its_neutral_when_its_node_is_killed() {
    let mut cluster = Cluster::start();
    let addresses: Vec<String> = cluster.nodes.iter().map(|node| node.address.clone()).collect();
    let [a, b, c] = &addresses.iter().map(String::as_str).collect::<Vec<_>>()[..] else { unreachable!() };
    let feed = write_feed(cluster.folder.path(), 30);
    let log = cluster.folder.path().join("send.log");
    let watches = [Watch::start(&[b], "demo"), Watch::start(&[c], "demo"), Watch::start(&[a, c], "demo")];
    let mut sender = send(&feed, &[a, b, c], "demo", &log);
    let neutral_before = wait_for("a neutral", || neutral(&cluster.nodes[0], "demo"));
    // The settings of the feed have come, too.
    wait_for("the settings", || {
        // So many may be asked for.
        std::thread::sleep(Duration::from_millis(100));
        (settings(&cluster.nodes[0], "demo")["gains"]["mouth"] == 0.75).then_some(())
    });
    std::thread::sleep(Duration::from_millis(300));
    let session = watches[0].last().expect("it is seen").session;

    cluster.nodes[0].kill();
    for watch in &watches {
        wait_for("the next session", || watch.last().filter(|seen| seen.session > session));
    }
    std::thread::sleep(Duration::from_millis(500));
    let neutral_after = neutral(&cluster.nodes[1], "demo").expect("it is kept");
    assert_eq!((&neutral_after["t"], &neutral_after["num_frames"]), (&neutral_before["t"], &neutral_before["num_frames"]));
    assert_eq!(settings(&cluster.nodes[1], "demo")["gains"]["mouth"], 0.75);
    assert!(sender.try_wait().unwrap().is_none(), "{}", std::fs::read_to_string(&log).unwrap());
    for (watch, node) in watches.into_iter().zip(["b", "c", "a, then c"]) {
        let seen = watch.finish();
        println!("killed: viewer at {node}: the face was gone for {:?}", pause(&seen));
        assert!(pause(&seen) < BACK_WITHIN, "{node}: {:?}", pause(&seen));
    }
}

pub fn stopped_node() {
    let cluster = Cluster::start();
    let [a, b, c] = &cluster.nodes[..] else { unreachable!() };
    let feed = write_feed(cluster.folder.path(), 30);
    let watches = [Watch::start(&[&b.address], "demo"), Watch::start(&[&c.address], "demo")];
    // Stays where it is, with its connection.
    let at_stopped = Watch::start(&[&a.address], "demo");
    let _sender = send(&feed, &[&a.address, &b.address, &c.address], "demo", &cluster.folder.path().join("send.log"));
    wait_for("a neutral", || neutral(a, "demo"));
    for watch in &watches {
        watch.wait_for_more("a face");
    }
    let session = at_stopped.wait_for_more("a face").session;

    signal(&a.process, Signal::STOP);
    for watch in &watches {
        wait_for("the next session", || watch.last().filter(|seen| seen.session > session));
    }
    std::thread::sleep(Duration::from_millis(500));
    signal(&a.process, Signal::CONT);
    wait_for("the new session at the node that goes on", || at_stopped.last().filter(|seen| seen.session > session));
    std::thread::sleep(Duration::from_millis(500));
    assert!(b.room("demo").unwrap()["publisher"]["source"] == "test", "{}", b.rooms());
    for (watch, node) in watches.into_iter().zip(["b", "c"]) {
        let seen = watch.finish();
        println!("stopped: viewer at {node}: the face was gone for {:?}", pause(&seen));
        assert!(pause(&seen) < BACK_WITHIN, "{node}: {:?}", pause(&seen));
        assert_eq!(num_twice(&seen), 0);
    }
    assert_eq!(num_twice(&at_stopped.finish()), 0);
}

pub fn nats_dies() {
    let mut cluster = Cluster::start();
    let feed = write_feed(cluster.folder.path(), 60);
    let (a, b, c) = (&cluster.nodes[0], &cluster.nodes[1], &cluster.nodes[2]);
    let log = cluster.folder.path().join("send.log");
    let mut sender = send(&feed, &[&a.address], "demo", &log);
    let (near, far) = (Watch::start(&[&a.address], "demo"), Watch::start(&[&b.address], "demo"));
    far.wait_for_more("a face elsewhere");
    let health = |node: &Node| node.get("/healthz").expect("it says 200");
    // Once with what it has kept, and once without.
    for keeps in [true, false] {
        cluster.nats.kill();
        for node in [a, b, c] {
            wait_for("the health to tell it", || health(node).starts_with("degraded").then_some(()));
        }
        let mut alone = b.publisher("alone", HELLO).ready();
        alone.frame(0.3);
        near.wait_for_more("the face at its own node");
        std::thread::sleep(Duration::from_secs(1));
        let before = far.last().unwrap().at;
        if !keeps {
            cluster.nats.folder = Arc::new(tempfile::tempdir().unwrap());
        }
        cluster.nats.restart();
        let start = Instant::now();
        for node in [a, b, c] {
            wait_for("all to join again", || (health(node) == "ok\n").then_some(()));
        }
        wait_for("the face elsewhere", || far.last().filter(|seen| seen.at > before));
        println!("nats: all have joined again after {:?}, its data {}", start.elapsed(), if keeps { "kept" } else { "lost" });
        // What was opened in between is the cluster's, too.
        wait_for("the leases", || {
            let log = b.log();
            let num_claimed = log.lines().filter(|line| line.contains("before all nodes") && line.contains("alone")).count();
            (num_claimed >= if keeps { 1 } else { 2 }).then_some(())
        });
        let refused = c.publisher("alone", HELLO).answer();
        assert_eq!(refused["code"], "room_taken", "{refused}");
        alone.socket.close(None).unwrap();
        while alone.socket.read().is_ok() {}
    }
    let refused = c.publisher("demo", HELLO).answer();
    assert_eq!(refused["code"], "room_taken", "{refused}");
    assert!(sender.try_wait().unwrap().is_none(), "{}", std::fs::read_to_string(&log).unwrap());
    let near = near.finish();
    assert!(pause(&near) < Duration::from_millis(700), "the room's own viewer: {:?}", pause(&near));
    let sessions = near.iter().map(|seen| seen.session).collect::<std::collections::BTreeSet<_>>();
    assert_eq!((sessions.len(), num_twice(&near), num_twice(&far.finish())), (1, 0, 0));
}

/// A performer calibrates while NATS is away, and later loses the node.
pub fn neutral_without_nats() {
    let mut nats = Nats::start();
    let url = nats.url();
    let (mut a, b) = (Node::start(&url).ready(), Node::start(&url).ready());
    nats.kill();
    for node in [&a, &b] {
        wait_for("the health to tell it", || node.get("/healthz").unwrap().starts_with("degraded").then_some(()));
    }
    let feed = write_feed(nats.folder.path(), 60);
    let sender = send(&feed, &[&a.address], "demo", &nats.folder.path().join("send.log"));
    let before = wait_for("a neutral", || neutral(&a, "demo"));
    // Longer than NATS may take for any one answer.
    std::thread::sleep(Duration::from_secs(1));
    nats.restart();
    for node in [&a, &b] {
        wait_for("all to join again", || (node.get("/healthz").unwrap() == "ok\n").then_some(()));
    }
    // Two rounds, in which what waits is kept.
    std::thread::sleep(Duration::from_millis(1500));
    a.kill();
    drop(sender);
    assert_neutral_is_kept(&b, &before);
}

/// A node has the neutral face that its lost home came to `before`.
fn assert_neutral_is_kept(node: &Node, before: &Value) {
    let mut again = node.publisher("demo", &HELLO.replace("\"fps\"", "\"takeover\":true,\"keep_neutral\":true,\"fps\""));
    let ready = again.answer();
    assert_eq!(ready["kept_neutral"], true, "{ready}, after {before}");
}

/// NATS comes back without its data, and later the node is lost.
pub fn neutral_without_data() {
    let mut nats = Nats::start();
    let url = nats.url();
    let (mut a, b) = (Node::start(&url).ready(), Node::start(&url).ready());
    let feed = write_feed(nats.folder.path(), 60);
    let folder = nats.folder.clone();
    let sender = send(&feed, &[&a.address], "demo", &folder.path().join("send.log"));
    let before = wait_for("a neutral", || neutral(&a, "demo"));
    // What comes later would be kept without this.
    wait_for("the settings", || {
        // So many may be asked for.
        std::thread::sleep(Duration::from_millis(100));
        (settings(&a, "demo")["gains"]["mouth"] == 0.75).then_some(())
    });
    std::thread::sleep(Duration::from_millis(300));
    nats.kill();
    for node in [&a, &b] {
        wait_for("the health to tell it", || node.get("/healthz").unwrap().starts_with("degraded").then_some(()));
    }
    nats.folder = Arc::new(tempfile::tempdir().unwrap());
    nats.restart();
    for node in [&a, &b] {
        wait_for("all to join again", || (node.get("/healthz").unwrap() == "ok\n").then_some(()));
    }
    // Two rounds, in which the room is claimed and what it keeps is kept again.
    std::thread::sleep(Duration::from_millis(1500));
    a.kill();
    drop(sender);
    assert_neutral_is_kept(&b, &before);
}

/// Two nodes open one room while NATS is away; the viewer at a third one sees the one that keeps it, and never the other.
pub fn two_homes() {
    let mut cluster = Cluster::start();
    let folder = cluster.folder.clone();
    let feed = write_feed(folder.path(), 60);
    let (a, b, c) = (&cluster.nodes[0], &cluster.nodes[1], &cluster.nodes[2]);
    let _sender = send(&feed, &[&a.address], "demo", &folder.path().join("send.log"));
    let (demo, fresh) = (Watch::start(&[&c.address], "demo"), Watch::start(&[&c.address], "fresh"));
    demo.wait_for_more("a face elsewhere");
    cluster.nats.kill();
    for node in [a, b, c] {
        wait_for("the health to tell it", || node.get("/healthz").unwrap().starts_with("degraded").then_some(()));
    }
    // One room was the first node's before, the other is nobody's.
    let mut second_demo = b.publisher("demo", HELLO).ready();
    let mut two = [a, b].map(|node| node.publisher("fresh", HELLO).ready());
    second_demo.frame(0.3);
    let at_loser = Watch::start(&[&b.address], "demo");
    let false_session = at_loser.wait_for_more("the face of the false home").session;
    two.iter_mut().for_each(|publisher| publisher.frame(0.3));
    cluster.nats.restart();
    let start = Instant::now();
    let has_lost = |node: &Node, room: &str| node.log().lines().any(|line| line.contains("home now") && line.contains(room));
    // They go on sending, so that a loser's packets would be seen.
    wait_for("one home for each room", || {
        second_demo.try_frame(0.4);
        for publisher in &mut two {
            publisher.try_frame(0.4);
        }
        std::thread::sleep(Duration::from_millis(10));
        (has_lost(b, "demo") && (has_lost(a, "fresh") || has_lost(b, "fresh"))).then_some(())
    });
    println!("two homes: each room has one after {:?}", start.elapsed());
    assert!(!has_lost(a, "demo"), "the node that had it before keeps it");
    let kept = usize::from(has_lost(a, "fresh"));
    for loser in [&mut second_demo, &mut two[1 - kept]] {
        let told = loser.last_answer();
        assert_eq!(told["code"], "taken_over", "{told}");
    }
    let before = Instant::now();
    wait_for("the face elsewhere", || {
        two[kept].frame(0.5);
        let is_seen = |watch: &Watch| watch.last().is_some_and(|seen| seen.at > before);
        (is_seen(&demo) && is_seen(&fresh)).then_some(())
    });
    let session = demo.last().expect("it is seen").session;
    assert!(session < false_session, "a viewer of the false home's would take {session} for over");
    wait_for("the face at the false home", || at_loser.last().filter(|seen| seen.session == session));
    at_loser.assert_onward();
    let sessions = demo.finish().iter().map(|seen| seen.session).collect::<std::collections::BTreeSet<_>>();
    assert_eq!(sessions.len(), 1, "the other's packets went nowhere: {sessions:?}");
    let sessions = fresh.finish().iter().map(|seen| seen.session).collect::<std::collections::BTreeSet<_>>();
    assert_eq!(sessions.len(), 1, "the loser's packets went nowhere: {sessions:?}");
}

/// A node starts while NATS is away and opens a room that lives; when NATS is back, it is there before the room's home is.
pub fn late_node() {
    let mut nats = Nats::start();
    let a = Node::start(&nats.url()).ready();
    let mut publisher = a.publisher("demo", HELLO).ready();
    nats.kill();
    let late = Node::start(&nats.url());
    let mut other = late.publisher("demo", HELLO).ready();
    signal(&a.process, Signal::STOP);
    nats.restart();
    wait_for("the late node's joining", || (late.get("/healthz").unwrap() == "ok\n").then_some(()));
    // Some rounds in which it asks who does not answer.
    std::thread::sleep(Duration::from_millis(1200));
    signal(&a.process, Signal::CONT);
    let told = other.last_answer();
    assert_eq!(told["code"], "taken_over", "{told}");
    publisher.frame(0.3);
    let mut viewer = late.viewer("demo");
    publisher.frame(0.4);
    viewer.packet();
    assert!(!a.log().contains("another node is the room's home now"));
}

/// A node ends while it asks for a room whose home does not answer.
pub fn leaves_while_it_asks() {
    let mut cluster = Cluster::start();
    let _first = cluster.nodes[0].publisher("demo", HELLO).ready();
    signal(&cluster.nodes[0].process, Signal::STOP);
    let mut waiting = cluster.nodes[1].publisher("demo", HELLO);
    // It asks for two seconds.
    std::thread::sleep(Duration::from_millis(500));
    signal(&cluster.nodes[1].process, Signal::TERM);
    // Clients come back, or go on to the next node, after this code, and stay away after an error.
    let (told, code) = waiting.ending();
    assert_eq!((&told, code), (&Value::Null, Some(CloseCode::Away)), "it is not let in any more");
    assert!(cluster.nodes[1].process.wait().unwrap().success());
    assert!(!cluster.nodes[1].log().contains("home of a room"), "it takes no room that it cannot have");
    signal(&cluster.nodes[0].process, Signal::CONT);
}

/// A publisher says its hello to a node that is giving its rooms back.
pub fn comes_while_it_ends() {
    let nats = Nats::start();
    let mut node = Node::start(&nats.url()).ready();
    let _first = node.publisher("demo", HELLO).ready();
    let mut second = node.silent_publisher("other");
    // Giving the first one's room back takes as long as NATS may take.
    signal(&nats.process, Signal::STOP);
    signal(&node.process, Signal::TERM);
    wait_for("its ending", || node.log().contains("shutting down").then_some(()));
    second.socket.send(Message::text(HELLO)).unwrap();
    let (told, code) = second.ending();
    assert_eq!((&told, code), (&Value::Null, Some(CloseCode::Away)), "it is told to come back");
    assert!(node.process.wait().unwrap().success());
    signal(&nats.process, Signal::CONT);
}

/// A lease vanishes from NATS while its home lives.
pub fn lost_lease() {
    let cluster = Cluster::start();
    let [a, b, _] = &cluster.nodes[..] else { unreachable!() };
    let mut publisher = a.publisher("demo", HELLO).ready();
    let num_claimed = || a.log().lines().filter(|line| line.contains("home of a room") && line.contains("demo")).count();
    wait_for("the lease", || (num_claimed() == 1).then_some(()));
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    runtime.block_on(async {
        let jetstream = async_nats::jetstream::new(async_nats::connect(cluster.nats.url()).await.unwrap());
        let bucket = jetstream.stream_names().try_filter(|name| std::future::ready(name.ends_with("_leases")));
        let [bucket] = &bucket.try_collect::<Vec<_>>().await.unwrap()[..] else { panic!("one bucket of leases") };
        let leases = jetstream.get_key_value(bucket.strip_prefix("KV_").unwrap()).await.unwrap();
        leases.purge("demo").await.unwrap();
    });
    wait_for("another claim", || (num_claimed() == 2).then_some(()));
    let refused = b.publisher("demo", HELLO).answer();
    assert_eq!(refused["code"], "room_taken", "{refused}");
    publisher.frame(0.3);
    let mut viewer = b.viewer("demo");
    publisher.frame(0.4);
    viewer.packet();
}

pub fn rolling_restart() {
    let mut cluster = Cluster::start();
    let addresses: Vec<String> = cluster.nodes.iter().map(|node| node.address.clone()).collect();
    let from = |k: usize| (0..3).map(|i| addresses[(k + i) % 3].as_str()).collect::<Vec<_>>();
    let feed = write_feed(cluster.folder.path(), 60);
    let folder = cluster.folder.clone();
    let log = |k: usize| folder.path().join(format!("send-{k}.log"));
    let mut senders: Vec<Process> = (0..6).map(|k| send(&feed, &from(k), &format!("room-{k}"), &log(k))).collect();
    let watches: Vec<Watch> = (0..18).map(|k| Watch::start(&from(k / 6), &format!("room-{}", k % 6))).collect();
    for watch in &watches {
        watch.wait_for_more("a face");
    }
    for k in 0..3 {
        signal(&cluster.nodes[k].process, Signal::TERM);
        let status = cluster.nodes[k].process.wait().unwrap();
        assert!(status.success(), "{status}");
        cluster.nodes[k] = Node::with(&cluster.nats.url(), &["--listen", &addresses[k]]).ready();
        std::thread::sleep(Duration::from_millis(500));
        for watch in &watches {
            watch.wait_for_more("a face after a restart");
        }
    }
    for (k, sender) in senders.iter_mut().enumerate() {
        assert!(sender.try_wait().unwrap().is_none(), "{}", std::fs::read_to_string(log(k)).unwrap());
    }
    let pauses: Vec<Duration> = watches.into_iter().map(|watch| pause(&watch.finish())).collect();
    println!("rolling restart: 6 rooms, 18 viewers, longest pause {:?}", pauses.iter().max().unwrap());
    assert!(pauses.iter().all(|pause| *pause < BACK_WITHIN), "{pauses:?}");
}

pub fn cut_link() {
    let namespace = Namespace::make().expect("it was possible before");
    let [(to_nats, nats_address, _), (_, _, node_address)] = &namespace.cables;
    let nats = Nats::with(&["-a", nats_address]);
    let folder = nats.folder.path();
    let url = format!("nats://{nats_address}:{}", nats.port);
    let b = Node::start(&url).ready();
    let inside = Node::inside(&namespace.name, &url, node_address).ready();
    let feed = write_feed(folder, 60);
    let log = folder.join("send.log");
    let mut sender = send(&feed, &[&inside.address], "demo", &log);
    let (near, far) = (Watch::start(&[&inside.address], "demo"), Watch::start(&[&b.address], "demo"));
    far.wait_for_more("a face elsewhere");
    assert!(ip(&format!("link set {to_nats} down")));
    wait_for("the health to tell it", || inside.get("/healthz").unwrap().starts_with("degraded").then_some(()));
    near.wait_for_more("the face at its own node");
    let before = far.last().unwrap().at;
    assert!(ip(&format!("link set {to_nats} up")));
    let start = Instant::now();
    wait_for("it to join again", || (inside.get("/healthz").unwrap() == "ok\n").then_some(()));
    wait_for("the face elsewhere", || far.last().filter(|seen| seen.at > before));
    println!("cut link: joined again after {:?}", start.elapsed());
    assert!(sender.try_wait().unwrap().is_none(), "{}", std::fs::read_to_string(&log).unwrap());
    let near = near.finish();
    assert!(pause(&near) < Duration::from_millis(700), "the room's own viewer: {:?}", pause(&near));
    assert_eq!((num_twice(&near), num_twice(&far.finish())), (0, 0));
}

/// What a room's home says of the settings in use.
fn settings(node: &Node, room: &str) -> Value {
    let mut socket = node.socket(&format!("{room}/control"));
    socket.send(Message::text(r#"{"type":"settings"}"#)).unwrap();
    loop {
        match socket.read().unwrap() {
            Message::Text(text) => return serde_json::from_str(&text).unwrap(),
            Message::Close(frame) => panic!("{frame:?}"),
            _ => {}
        }
    }
}

fn neutral(node: &Node, room: &str) -> Option<Value> {
    Some(node.room(room)?["neutral"].clone()).filter(|neutral| !neutral.is_null())
}
