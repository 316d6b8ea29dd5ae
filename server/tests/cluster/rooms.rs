//! One room before all nodes: who sees it, and who publishes to it.

use super::http;
use super::nats::{Nats, free_port};
use super::nodes::{Cluster, HELLO, Node, RawViewer};
use super::process::wait_for;
use super::senders::{fake, write_feed};
use super::watch::Watch;
use rhytid_shared::packet::{Decoder, PacketLayout};
use serde_json::{Value, json};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::{Duration, Instant};

pub fn viewers_at_all_nodes_get_the_same_packets() {
    let cluster = Cluster::start();
    let [a, b, c] = &cluster.nodes[..] else { unreachable!() };
    let mut publisher = a.publisher("demo", HELLO).ready();
    let mut viewers = [a.viewer("demo"), b.viewer("demo"), c.viewer("demo")];
    // Until the subscriptions stand: the first packets that all have.
    publisher.frame(0.0);
    viewers.iter_mut().for_each(|viewer| drop(viewer.packet()));
    for k in 1..200 {
        publisher.frame(f64::from(k % 50) / 50.0);
        let [first, second, third] = viewers.each_mut().map(RawViewer::packet);
        assert_eq!((&first, &first), (&second, &third), "packet {k}");
    }
    let room = wait_for("the listing of the whole cluster", || {
        let room = c.room("demo")?;
        (room["viewers"] == 3 && room["publisher"]["source"] == "test").then_some(room)
    });
    assert_eq!(room["nodes"].as_object().unwrap().len(), 3, "{room}");
    assert_eq!(c.rooms()["nodes"].as_object().unwrap().len(), 3);
    // Nobody hears what nobody watches there.
    let unwatched = a.publisher("other", HELLO).ready();
    drop(unwatched);
    assert!(!b.log().contains("panicked"));
}

pub fn late_viewer_elsewhere_gets_the_newest_face_at_once() {
    let cluster = Cluster::start();
    let [a, b, _] = &cluster.nodes[..] else { unreachable!() };
    let mut publisher = a.publisher("demo", HELLO).ready();
    for k in 0..90 {
        publisher.frame(f64::from(k) / 90.0);
    }
    let mut near = a.viewer("demo");
    let layout = PacketLayout::try_from(&near.hello.character).unwrap();
    let newest = |viewer: &mut RawViewer| {
        let (mut decoder, mut frame) = (Decoder::new(layout.clone()), layout.frame_at_rest());
        while frame.seq < 89 {
            decoder.decode(&viewer.packet(), &mut frame).unwrap();
        }
        frame
    };
    let expected = newest(&mut near);
    // Nothing more is sent: what comes is what the room's home had.
    let start = Instant::now();
    let got = newest(&mut b.viewer("demo"));
    assert_eq!(got, expected);
    assert!(start.elapsed() < Duration::from_secs(1), "{:?}", start.elapsed());
}

pub fn room_has_one_publisher_in_the_whole_cluster() {
    let cluster = Cluster::start();
    let [a, b, c] = &cluster.nodes[..] else { unreachable!() };
    let mut first = a.publisher("demo", HELLO).ready();
    let refused = b.publisher("demo", HELLO).answer();
    assert_eq!((&refused["type"], &refused["code"]), (&json!("error"), &json!("room_taken")), "{refused}");
    let elsewhere = HELLO.replace('}', r#","slot":"phone"}"#);
    let refused = b.publisher("demo", &elsewhere).answer();
    assert_eq!(refused["code"], "room_elsewhere", "{refused}");
    assert!(refused["message"].as_str().unwrap().contains(&a.address), "{refused}");
    let mut viewer = c.viewer("demo");
    first.frame(0.2);
    let before = viewer.packet();
    let mut second = b.publisher("demo", &HELLO.replace('}', r#","takeover":true}"#)).ready();
    let told = first.answer();
    assert_eq!(told["code"], "taken_over", "{told}");
    second.frame(0.7);
    let after = viewer.packet();
    let session = |packet: &[u8]| u32::from_le_bytes(packet[1..5].try_into().unwrap());
    assert!(session(&after) > session(&before), "{} after {}", session(&after), session(&before));
    // One who leaves gives the room back.
    second.socket.close(None).unwrap();
    while second.socket.read().is_ok() {}
    a.publisher("demo", HELLO).ready();
}

pub fn unwatched_elsewhere() {
    let monitor = free_port().to_string();
    let nats = Nats::with(&["-m", &monitor]);
    let [a, b] = [0, 1].map(|_| Node::start(&nats.url()).ready());
    let num_messages = || {
        let (_, body) = http::ask(&format!("127.0.0.1:{monitor}"), "GET", "/varz", &[], "").unwrap();
        serde_json::from_str::<Value>(&body).unwrap()["in_msgs"].as_u64().unwrap()
    };
    let mut publisher = a.publisher("demo", HELLO).ready();
    let (num_frames, is_over) = (AtomicU64::new(0), AtomicBool::new(false));
    // Messages to NATS, and frames, while the publisher sends so many more.
    let sent_with = |num_more: u64| {
        let before = (num_messages(), num_frames.load(Ordering::SeqCst));
        wait_for("the frames", || (num_frames.load(Ordering::SeqCst) >= before.1 + num_more).then_some(()));
        let frames = num_frames.load(Ordering::SeqCst) - before.1;
        (num_messages() - before.0, frames)
    };
    std::thread::scope(|scope| {
        scope.spawn(|| {
            while !is_over.load(Ordering::SeqCst) {
                publisher.frame(0.5);
                num_frames.fetch_add(1, Ordering::SeqCst);
                std::thread::sleep(Duration::from_millis(16));
            }
        });
        let _over = Over(&is_over);
        // A fresh home does not know yet who watches.
        std::thread::sleep(Duration::from_secs(4));
        let (num_sent, num_frames) = sent_with(120);
        assert!(num_sent < num_frames / 2, "{num_sent} messages for {num_frames} frames that nobody watches elsewhere");
        let watch = Watch::start(&[&b.address], "demo");
        watch.wait_for_more("the face elsewhere");
        let start = Instant::now();
        // Longer than what one question is good for.
        while start.elapsed() < Duration::from_secs(5) {
            let (num_sent, num_frames) = sent_with(60);
            // One may be on its way.
            assert!(num_sent + 3 >= num_frames, "{num_sent} messages for {num_frames} frames, after {:?}", start.elapsed());
            watch.wait_for_more("the face elsewhere");
        }
        watch.finish();
    });
}

/// Ends a thread, also where the test fails.
struct Over<'a>(&'a AtomicBool);

impl Drop for Over<'_> {
    fn drop(&mut self) {
        self.0.store(true, Ordering::SeqCst);
    }
}

pub fn hello_that_leads_to_nothing() {
    let nats = Nats::start();
    let a = Node::start(&nats.url()).ready();
    let full = Node::with(&nats.url(), &["--max-rooms", "1"]).ready();
    let mut first = a.publisher("demo", HELLO).ready();
    let more = |fields: &str| HELLO.replace('}', &format!(r#","takeover":true,{fields}}}"#));
    let refused = full.publisher("demo", &more(r#""profile":"nope""#)).answer();
    assert_eq!(refused["code"], "unknown_profile", "{refused}");
    let refused = full.publisher("demo", &more(r#""layout":"ibug68","image":[1,1],"focal":1e9"#)).answer();
    assert_eq!(refused["type"], "error", "{refused}");
    let _other = full.publisher("other", HELLO).ready();
    let refused = full.publisher("demo", &more(r#""slot":"main""#)).answer();
    assert_eq!(refused["code"], "too_many_rooms", "{refused}");
    let mut viewer = a.viewer("demo");
    first.frame(0.3);
    viewer.packet();
    assert_eq!(a.room("demo").unwrap()["publisher"]["source"], "test");
}

pub fn tracker_over_udp() {
    let nats = Nats::start();
    let (feed, port) = (write_feed(nats.folder.path(), 20), free_port());
    let a = Node::with(&nats.url(), &["--listen-udp", &format!("livelink=127.0.0.1:{port},room=demo")]).ready();
    let b = Node::start(&nats.url()).ready();
    let phone = fake(&feed, port);
    let watch = Watch::start(&[&b.address], "demo");
    watch.wait_for_more("a phone's face at another node");
    let refused = b.publisher("demo", HELLO).answer();
    assert_eq!(refused["code"], "room_elsewhere", "{refused}");
    // A room that is another node's is not the phone's.
    drop(phone);
    let mut publisher = b.publisher("demo", &HELLO.replace('}', r#","takeover":true}"#)).ready();
    let _phone = fake(&feed, port);
    wait_for("the phone's refusal", || {
        let metrics = a.get("/metrics")?;
        metrics.lines().any(|line| line.contains("room_elsewhere") && !line.ends_with(" 0")).then_some(())
    });
    publisher.frame(0.3);
    assert_eq!(a.room("demo").unwrap()["publisher"]["source"], "test");
    watch.finish();
}
