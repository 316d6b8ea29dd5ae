//! Records at three NATS servers: whichever of them dies, rooms go on; and what happens where there are too few.

use super::nats::Nats;
use super::nats_cluster::{NatsCluster, server_name, wait_long};
use super::nodes::{HELLO, Node};
use super::process::wait_for;
use super::senders::{send, write_feed};
use super::watch::{Watch, num_twice, pause};
use async_nats::jetstream::stream::Info;
use futures_util::TryStreamExt;
use std::time::{Duration, Instant};

const THREE: [&str; 2] = ["--cluster-replicas", "3"];

/// The server is lost that a viewer's node, or the home, has spoken to: so soon the viewer sees the face again.
const BACK_WITHIN: Duration = Duration::from_secs(2);

/// What NATS says of the buckets, the leases' first.
fn buckets(nats: &str) -> Option<[Info; 2]> {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    runtime.block_on(async {
        let servers: Vec<&str> = nats.split(',').collect();
        let mut jetstream = async_nats::jetstream::new(async_nats::connect(servers).await.ok()?);
        jetstream.set_timeout(Duration::from_secs(2));
        let names: Vec<String> = jetstream.stream_names().try_collect().await.ok()?;
        let mut infos = Vec::new();
        for name in names {
            infos.push(jetstream.get_stream(name).await.ok()?.cached_info().clone());
        }
        infos.sort_by_key(|info| !info.config.name.ends_with("_leases"));
        infos.try_into().ok()
    })
}

/// Which server leads the leases, once every server has all of every record.
fn leader_of_leases(nats: &str) -> Option<usize> {
    let buckets = buckets(nats)?;
    let leaders = buckets.map(|bucket| {
        let cluster = bucket.cluster?;
        let is_whole = cluster.replicas.len() == 2 && cluster.replicas.iter().all(|replica| replica.current && !replica.offline);
        cluster.leader.filter(|_| is_whole)
    });
    let [Some(of_leases), Some(_)] = leaders else { return None };
    (0..3).find(|k| server_name(*k) == of_leases)
}

/// Something is kept of a room's slot.
fn is_kept(nats: &str, key: &str) -> bool {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    runtime.block_on(async {
        let kept = async {
            let servers: Vec<&str> = nats.split(',').collect();
            let jetstream = async_nats::jetstream::new(async_nats::connect(servers).await.ok()?);
            let bucket = jetstream.stream_names().try_filter(|name| std::future::ready(name.ends_with("_kept")));
            let bucket = bucket.try_collect::<Vec<_>>().await.ok()?;
            let kept = jetstream.get_key_value(bucket.first()?.strip_prefix("KV_")?).await.ok()?;
            kept.get(key).await.ok()?
        };
        kept.await.is_some()
    })
}

fn is_well(node: &Node) -> bool {
    node.get("/healthz").unwrap() == "ok\n"
}

/// The server that a node has joined through.
fn server_of(node: &Node) -> usize {
    let log = node.log();
    let joined = log.lines().rfind(|line| line.contains("joined the cluster")).unwrap();
    (0..3).find(|k| joined.contains(&server_name(*k))).unwrap()
}

pub fn three_servers() {
    let mut nats = NatsCluster::start(3, 3);
    let url = nats.url();
    let nodes: Vec<Node> = (0..3).map(|_| Node::with(&url, &THREE)).collect();
    for node in &nodes {
        wait_long("all to join", || is_well(node).then_some(()));
    }
    let [a, b, c] = &nodes[..] else { unreachable!() };
    for bucket in wait_long("two buckets", || buckets(&url)) {
        assert_eq!(bucket.config.num_replicas, 3, "{}", bucket.config.name);
    }
    wait_long("three copies of each", || leader_of_leases(&url));

    let folder = tempfile::tempdir().unwrap();
    let feed = write_feed(folder.path(), 300);
    let log = folder.path().join("send.log");
    let mut sender = send(&feed, &[&a.address], "demo", &log);
    let [near, far, other] = [a, b, c].map(|node| Watch::start(&[&node.address], "demo"));
    for watch in [&far, &other] {
        watch.wait_for_more("a face elsewhere");
    }
    for what in ["the server that the home speaks to", "the server that leads the leases", "the server that leads JetStream"] {
        let victim = match what {
            "the server that the home speaks to" => server_of(a),
            "the server that leads the leases" => wait_long("a leader of the leases", || leader_of_leases(&url)),
            _ => wait_long("a leader of JetStream", || nats.leader()),
        };
        nats.servers[victim].kill();
        let killed = Instant::now();
        for watch in [&near, &far, &other] {
            watch.wait_for_more("the face without one server");
        }
        for node in [a, b, c] {
            wait_long("the health to be good again", || is_well(node).then_some(()));
        }
        println!("{what} is killed: all is well after {:?}", killed.elapsed());
        let refused = c.publisher("demo", HELLO).answer();
        assert_eq!(refused["code"], "room_taken", "{refused}");
        wait_long("the neutral face to be kept", || is_kept(&url, "demo.main").then_some(()));
        // Whoever leads next may have to be chosen: until then nobody takes a new lease.
        let fresh = wait_long("a lease of two servers", || {
            let mut fresh = b.publisher(&format!("fresh-{victim}"), HELLO).ready();
            fresh.frame(0.3);
            let is_shared = c.rooms()["rooms"].as_array().unwrap().iter().any(|room| room["name"] == format!("fresh-{victim}"));
            is_shared.then_some(fresh)
        });
        drop(fresh);
        nats.servers[victim].restart();
        wait_long("three copies again", || leader_of_leases(&url));
    }

    // Two of three are no majority.
    let [first, second] = [0, 1];
    nats.servers[first].kill();
    nats.servers[second].kill();
    for node in [a, b, c] {
        let lack =
            wait_long("the health to tell it", || Some(node.get("/healthz").unwrap()).filter(|health| health.starts_with("degraded")));
        assert!(lack.contains("NATS"), "{lack}");
    }
    wait_long("the reason", || c.get("/healthz").unwrap().contains("too few of its servers").then_some(()));
    near.wait_for_more("the face at its own node");
    far.wait_for_more("the face elsewhere, which needs no records");
    let refused = c.publisher("demo", HELLO).answer();
    assert_eq!(refused["code"], "room_taken", "its home can be asked all the same: {refused}");
    let mut alone = b.publisher("alone", HELLO).ready();
    alone.frame(0.3);
    nats.servers[first].restart();
    nats.servers[second].restart();
    for node in [a, b, c] {
        wait_long("all to be well again", || is_well(node).then_some(()));
    }
    // Before that, whoever asks first has it.
    wait_long("the lease of what was opened meanwhile", || {
        b.log().lines().any(|line| line.contains("before all nodes") && line.contains("alone")).then_some(())
    });
    let refused = c.publisher("alone", HELLO).answer();
    assert_eq!(refused["code"], "room_taken", "{refused}");

    assert!(sender.try_wait().unwrap().is_none(), "{}", std::fs::read_to_string(&log).unwrap());
    for (watch, node) in [near, far, other].into_iter().zip(["home", "b", "c"]) {
        let seen = watch.finish();
        let sessions = seen.iter().map(|seen| seen.session).collect::<std::collections::BTreeSet<_>>();
        println!("servers killed: viewer at {node}: the face was gone for {:?} at most", pause(&seen));
        assert_eq!((sessions.len(), num_twice(&seen)), (1, 0), "the room had one home all the time: {sessions:?}");
        assert!(pause(&seen) < BACK_WITHIN, "{node}: {:?}", pause(&seen));
    }
}

/// More copies are asked for than there are servers.
pub fn too_few_servers() {
    let nats = Nats::start();
    let node = Node::with(&nats.url(), &THREE);
    let lack = wait_for("the reason", || Some(node.get("/healthz").unwrap()).filter(|health| health.contains("keeps no records")));
    assert!(lack.contains("replicas") && lack.contains("--cluster-replicas 3") && lack.lines().count() == 1, "{lack}");
    let mut publisher = node.publisher("demo", HELLO).ready();
    publisher.frame(0.3);
    node.viewer("demo").packet();
    let num_told = node.log().lines().filter(|line| line.contains("NATS keeps no records")).count();
    assert_eq!(num_told, 1, "once, and not each time that it tries");

    // Two of three: they have a leader, and still no place for three copies.
    let mut nats = NatsCluster::start(2, 3);
    let node = Node::with(&nats.url(), &THREE);
    let lack = wait_long("the reason", || Some(node.get("/healthz").unwrap()).filter(|health| health.contains("keeps no records")));
    assert!(lack.contains("--cluster-replicas 3"), "{lack}");
    println!("two servers of three: {}", lack.trim());
    nats.start_another();
    wait_long("the third one to make it whole", || is_well(&node).then_some(()));
}
