//! Other programs' trackers over real UDP sockets: their faces reach viewers, and what is wrong is counted and does nothing.

#![allow(clippy::unwrap_used, reason = "helpers of tests fail like tests")]

#[allow(dead_code, reason = "the service's tests use the rest of it")]
#[path = "service/harness.rs"]
mod harness;

use glam::Quat;
use harness::{Server, Viewer};
use rhytid_server::trackers::{fmv3, ifacialmocap, livelink, openseeface, vmc, vts};
use rhytid_server::{FakeKind, FakeOptions, ListenSpec, SendOptions, SendSource, fake, send};
use rhytid_shared::trust::Trust;
use rhytid_shared::{ArkitShape, NUM_ARKIT_SHAPES};
use std::net::{SocketAddr, UdpSocket};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, mpsc};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};
use tokio::sync::oneshot;

fn listening(specs: &[&str]) -> Server {
    Server::with(|config| config.listen_udp = specs.iter().map(|spec| spec.parse::<ListenSpec>().unwrap()).collect())
}

/// The address of the server's `index`-th port for trackers.
fn port(server: &Server, index: usize) -> SocketAddr {
    let (_, body) = server.get("/api/trackers", "");
    let list: serde_json::Value = serde_json::from_slice(&body).unwrap();
    list["ports"][index]["address"].as_str().unwrap().parse().unwrap()
}

fn socket() -> UdpSocket {
    let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
    socket.set_read_timeout(Some(Duration::from_secs(10))).unwrap();
    socket
}

fn index(name: &str) -> usize {
    ArkitShape::from_name(name).unwrap().index()
}

/// A feed of weights whose jaw opens and shuts, on the disk.
fn weights_feed(folder: &tempfile::TempDir) -> PathBuf {
    let mut text = String::from("{\"type\":\"hello\",\"version\":1,\"source\":\"test\"}\n");
    for i in 0..3000 {
        let t = f64::from(i) / 50.0;
        let jaw = 0.5 - 0.5 * (t * 6.0).cos();
        text += &format!("{{\"type\":\"frame\",\"t\":{t},\"weights\":{{\"jawOpen\":{jaw},\"browInnerUp\":0.5,\"eyeLookDownLeft\":0.2}},");
        text += "\"head\":{\"rotation\":[0.1,0,0,0.995],\"position\":[0,0,0]}}\n";
    }
    let path = folder.path().join("jaw.jsonl");
    std::fs::write(&path, text).unwrap();
    path
}

fn landmarks_feed() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/assets/demo.ibug68.jsonl")
}

/// A fake sender in a thread; it stops on drop.
struct Fake {
    address: SocketAddr,
    stop: Option<oneshot::Sender<()>>,
    thread: Option<JoinHandle<()>>,
}

impl Fake {
    fn start(kind: FakeKind, feed: PathBuf, to: Option<SocketAddr>) -> Self {
        let options =
            FakeOptions { kind, feed, to, bind: "127.0.0.1:0".parse().unwrap(), subject: "Tess".into(), speed: 1.0, repeats: true };
        let (stop, stopped) = oneshot::channel::<()>();
        let (bound, address) = mpsc::channel();
        let thread = std::thread::spawn(move || {
            let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
            let stopped = async { drop(stopped.await) };
            runtime.block_on(fake(&options, |address| bound.send(address).unwrap(), stopped)).unwrap();
        });
        Self { address: address.recv().unwrap(), stop: Some(stop), thread: Some(thread) }
    }
}

impl Drop for Fake {
    fn drop(&mut self) {
        drop(self.stop.take());
        if let Some(thread) = self.thread.take()
            && !std::thread::panicking()
        {
            thread.join().unwrap();
        }
    }
}

/// Waits until the face has moved by `least` metres between its farthest places.
fn wait_until_it_moves(viewer: &mut Viewer, least: f32) {
    let start = Instant::now();
    let mut first: Option<Vec<glam::Vec3>> = None;
    while start.elapsed() < Duration::from_secs(15) {
        assert!(viewer.next_packet());
        if !viewer.frame.face {
            continue;
        }
        let first = first.get_or_insert_with(|| viewer.frame.points.clone());
        let moved = first.iter().zip(&viewer.frame.points).map(|(a, b)| a.distance(*b)).fold(0.0, f32::max);
        if moved > least {
            return;
        }
    }
    panic!("the face does not move");
}

fn source(server: &Server, room: &str) -> String {
    server.room(room).unwrap()["publisher"]["source"].as_str().unwrap_or_default().to_owned()
}

#[test]
fn senders_that_start_by_themselves_drive_the_face() {
    let folder = tempfile::tempdir().unwrap();
    for (protocol, kind, expected) in [
        ("livelink", FakeKind::LiveLink, "livelink: Tess (127.0.0.1)"),
        ("openseeface", FakeKind::OpenSeeFace, "openseeface: face 0 (127.0.0.1)"),
        ("vmc", FakeKind::Vmc, "vmc (127.0.0.1)"),
        ("vts", FakeKind::Vts, "vts (127.0.0.1)"),
        ("ifacialmocap", FakeKind::IFacialMocap, "ifacialmocap (127.0.0.1)"),
        ("ifacialmocap", FakeKind::Fmv3, "fmv3 (127.0.0.1)"),
    ] {
        for port_of in [protocol, "any"] {
            let server = listening(&[&format!("{port_of}=127.0.0.1:0,room=stage")]);
            let mut viewer = server.viewer("stage");
            let feed = if kind == FakeKind::OpenSeeFace { landmarks_feed() } else { weights_feed(&folder) };
            let sender = Fake::start(kind, feed, Some(port(&server, 0)));
            wait_until_it_moves(&mut viewer, 0.002);
            assert_eq!(source(&server, "stage"), expected);
            let name = expected.split([':', ' ']).next().unwrap();
            assert!(server.metric(&format!("rhytid_tracker_frames_total{{protocol=\"{name}\"}}")) > 1.0);
            assert_eq!(server.metric(&format!("rhytid_tracker_dropped_total{{protocol=\"{name}\"")), 0.0, "{port_of}");
            if kind != FakeKind::OpenSeeFace {
                let [x, ..] = viewer.frame.head.rotation.to_array();
                assert!((x - 0.1).abs() < 0.02, "{name}: the head bows: {x}");
            }
            drop(sender);
        }
    }
}

#[test]
fn phones_are_asked_and_drive_the_face() {
    let folder = tempfile::tempdir().unwrap();
    let feed = weights_feed(&folder);
    for (kind, spec, expected) in [
        (FakeKind::IFacialMocap, "ifacialmocap=127.0.0.1:0,version=1", "ifacialmocap"),
        (FakeKind::IFacialMocap2, "ifacialmocap=127.0.0.1:0", "ifacialmocap"),
        (FakeKind::Facemotion3d, "ifacialmocap=127.0.0.1:0,version=facemotion3d", "ifacialmocap"),
        (FakeKind::Fmv3, "ifacialmocap=127.0.0.1:0,version=3", "fmv3"),
        (FakeKind::Fmv3, "fmv3=127.0.0.1:0", "fmv3"),
        (FakeKind::Vts, "vts=127.0.0.1:0", "vts"),
    ] {
        let phone = Fake::start(kind, feed.clone(), None);
        let server = listening(&[&format!("{spec},phone={},room=phone", phone.address)]);
        let mut viewer = server.viewer("phone");
        wait_until_it_moves(&mut viewer, 0.002);
        assert_eq!(source(&server, "phone"), format!("{expected} (127.0.0.1)"), "{spec}");
    }
}

/// A phone of Live Link Face's, by hand.
struct Phone {
    socket: UdpSocket,
    to: SocketAddr,
    frame: i32,
}

impl Phone {
    fn new(to: SocketAddr) -> Self {
        Self { socket: socket(), to, frame: 1000 }
    }

    fn datagram(&self, frame: i32, weights: Option<&[f32; NUM_ARKIT_SHAPES]>) -> Vec<u8> {
        let values = weights.map(|weights| livelink::values(weights, Quat::IDENTITY));
        livelink::Packet { device: "phone", subject: "Tess", frame, sub_frame: 0.0, rate: [60, 1], values }.write()
    }

    fn send(&mut self, frame: i32, weights: Option<&[f32; NUM_ARKIT_SHAPES]>) {
        self.socket.send_to(&self.datagram(frame, weights), self.to).unwrap();
    }

    /// The next frame, of a face whose left side of the mouth is given.
    fn next(&mut self, mouth_left: f32) {
        self.frame += 1;
        let mut weights = [0.0; NUM_ARKIT_SHAPES];
        weights[index("mouthLeft")] = mouth_left;
        self.send(self.frame, Some(&weights));
    }
}

#[test]
fn late_and_doubled_datagrams_are_dropped_and_a_clock_that_begins_anew_is_a_new_session() {
    let server = listening(&["livelink=127.0.0.1:0,room=demo"]);
    let mut phone = Phone::new(port(&server, 0));
    let frames = "rhytid_tracker_frames_total{protocol=\"livelink\"}";
    let dropped = |reason: &str| format!("rhytid_tracker_dropped_total{{protocol=\"livelink\",reason=\"{reason}\"}}");
    for _ in 0..10 {
        phone.next(0.0);
    }
    server.wait_for_metric(frames, |count| count == 10.0);
    let face = [0.0; NUM_ARKIT_SHAPES];
    phone.send(phone.frame, Some(&face));
    phone.send(phone.frame - 2, Some(&face));
    server.wait_for_metric(&dropped("duplicate"), |count| count == 1.0);
    server.wait_for_metric(&dropped("late"), |count| count == 1.0);
    phone.send(phone.frame + 9, None);
    server.wait_for_room("demo", |room| room.is_some_and(|room| room["frame"]["face"] == false));
    assert_eq!(server.room("demo").unwrap()["session"], 1);
    // A second later, as apps do not start faster: sessions begin no oftener.
    std::thread::sleep(Duration::from_millis(1000));
    for frame in 0..10 {
        phone.send(frame, Some(&face));
    }
    server.wait_for_room("demo", |room| room.is_some_and(|room| room["session"] == 2 && room["frame"]["face"] == true));
    assert_eq!(server.room("demo").unwrap()["publisher"]["source"], "livelink: Tess (127.0.0.1)");
}

#[test]
fn sides_of_the_mouth_are_swapped_where_the_protocol_has_them_so() {
    let server = listening(&["livelink=127.0.0.1:0,room=usual", "livelink=127.0.0.1:0,room=kept,swap_mouth=false"]);
    for (port_index, room, side) in [(0, "usual", "mouthRight"), (1, "kept", "mouthLeft")] {
        let mut viewer = server.viewer(room);
        let mut phone = Phone::new(port(&server, port_index));
        phone.next(0.75);
        assert!(viewer.next_packet());
        let shapes = viewer.frame.shapes.expect("weights come along");
        assert!((shapes[index(side)] - 0.75).abs() < 0.01, "{room}: {shapes:?}");
    }
}

#[test]
fn performers_get_rooms_called_as_they_are() {
    let server = listening(&["livelink=127.0.0.1:0,room=subject"]);
    let mut phone = Phone::new(port(&server, 0));
    phone.next(0.1);
    server.wait_for_room("Tess", |room| room.is_some_and(|room| room["publisher"]["source"] == "livelink: Tess (127.0.0.1)"));
    let start = Instant::now();
    loop {
        let (_, body) = server.get("/api/trackers", "");
        let list: serde_json::Value = serde_json::from_slice(&body).unwrap();
        let performer = &list["ports"][0]["performers"][0];
        if !performer.is_null() {
            assert_eq!(
                (&performer["room"], &performer["session"], &list["ports"][0]["protocol"]),
                (&"Tess".into(), &1.into(), &"livelink".into())
            );
            break;
        }
        assert!(start.elapsed() < Duration::from_secs(5), "the performer is listed");
        std::thread::sleep(Duration::from_millis(50));
    }
}

#[test]
fn a_port_of_ipv6_answers_phones_of_both_kinds() {
    let folder = tempfile::tempdir().unwrap();
    let feed = weights_feed(&folder);
    let Ok(probe) = UdpSocket::bind("[::]:0") else { return };
    drop(probe);
    let phone = Fake::start(FakeKind::Fmv3, feed, None);
    let server = listening(&[&format!("fmv3=[::]:0,phone={},room=phone", phone.address)]);
    let mut viewer = server.viewer("phone");
    wait_until_it_moves(&mut viewer, 0.002);
}

#[test]
fn a_room_that_is_taken_is_waited_for_and_a_silent_app_gives_way_to_its_successor() {
    let server = listening(&["vmc=127.0.0.1:0,room=demo,slot=main"]);
    let face = |socket: &UdpSocket| {
        for bundle in vmc::write(20_000.0, Some(&[0.3; NUM_ARKIT_SHAPES]), Quat::IDENTITY) {
            socket.send_to(&bundle, port(&server, 0)).unwrap();
        }
    };
    let first = server.ready_publisher("demo");
    let app = socket();
    face(&app);
    server.wait_for_metric("rhytid_tracker_dropped_total{protocol=\"vmc\",reason=\"room_taken\"}", |count| count >= 1.0);
    drop(first);
    server.wait_for_room("demo", |room| room.is_some_and(|room| room["publisher"].is_null()));
    std::thread::sleep(Duration::from_millis(1100));
    face(&app);
    server.wait_for_room("demo", |room| room.is_some_and(|room| room["session"] == 2 && !room["publisher"].is_null()));
    // The same program again, on another port of its own.
    let again = socket();
    let start = Instant::now();
    while server.room("demo").unwrap()["session"] == 2 {
        assert!(start.elapsed() < Duration::from_secs(10), "the silent one keeps the room");
        std::thread::sleep(Duration::from_millis(200));
        face(&again);
    }
    assert!(start.elapsed() > Duration::from_millis(500), "nobody is pushed aside who was heard just now");
}

#[test]
fn silent_performers_leave_and_strangers_are_not_listened_to() {
    let server = Server::with(|config| {
        config.listen_udp =
            vec!["livelink=127.0.0.1:0,room=demo".parse().unwrap(), "livelink=127.0.0.1:0,allow=192.0.2.1,room=shut".parse().unwrap()];
        config.timeouts.publisher_idle = 0.5;
    });
    let mut phone = Phone::new(port(&server, 0));
    phone.next(0.1);
    server.wait_for_room("demo", |room| room.is_some_and(|room| !room["publisher"].is_null()));
    server.wait_for_room("demo", |room| room.is_some_and(|room| room["publisher"].is_null()));
    let mut stranger = Phone::new(port(&server, 1));
    stranger.next(0.1);
    server.wait_for_metric("rhytid_tracker_dropped_total{protocol=\"livelink\",reason=\"not_allowed\"}", |count| count == 1.0);
    assert!(server.room("shut").is_none());
}

#[test]
fn a_crowd_and_a_flood_are_held_off() {
    let server = Server::with(|config| {
        config.listen_udp = vec!["livelink=127.0.0.1:0,room=subject".parse().unwrap()];
        config.limits.frames_per_second = 50;
    });
    let to = port(&server, 0);
    let socket = socket();
    let person = |num: i32, frame: i32| {
        let (device, subject) = (format!("phone {num}"), format!("Person{num}"));
        let values = Some(livelink::values(&[0.1; NUM_ARKIT_SHAPES], Quat::IDENTITY));
        let packet = livelink::Packet { device: &device, subject: &subject, frame, sub_frame: 0.0, rate: [60, 1], values };
        socket.send_to(&packet.write(), to).unwrap();
    };
    // Sessions begin one after the other, which takes a moment for so many.
    for frame in 1..40 {
        for num in 0..20 {
            person(num, frame);
            std::thread::sleep(Duration::from_millis(2));
        }
        std::thread::sleep(Duration::from_millis(40));
    }
    let dropped = |reason: &str| format!("rhytid_tracker_dropped_total{{protocol=\"livelink\",reason=\"{reason}\"}}");
    server.wait_for_metric(&dropped("too_many_performers"), |count| count == 4.0 * 39.0);
    assert!(server.metric(&dropped("too_many_sessions")) > 0.0);
    assert!(server.room("Person15").is_some() && server.room("Person16").is_none());
    let frames_before = server.metric("rhytid_tracker_frames_total{protocol=\"livelink\"}");
    for frame in 100..400 {
        person(0, frame);
        std::thread::sleep(Duration::from_micros(200));
    }
    server.wait_for_metric(&dropped("too_fast"), |count| count > 100.0);
    let frames = server.metric("rhytid_tracker_frames_total{protocol=\"livelink\"}") - frames_before;
    assert!((1.0..150.0).contains(&frames), "{frames}");
}

#[test]
fn hostile_datagrams_are_counted_and_nothing_else_happens() {
    let names = ["livelink", "openseeface", "ifacialmocap", "fmv3", "vmc", "vts", "any"];
    let specs: Vec<String> = names.iter().map(|name| format!("{name}=127.0.0.1:0,room=demo")).collect();
    let server = listening(&specs.iter().map(String::as_str).collect::<Vec<_>>());
    let mut phone = Phone::new(port(&server, 0));
    phone.next(0.5);
    server.wait_for_room("demo", |room| room.is_some_and(|room| !room["frame"].is_null()));
    let before = server.room("demo").unwrap();

    let weights = [0.25; NUM_ARKIT_SHAPES];
    let tower = (0..3000).fold(b"/a\0\0,\0\0\0".to_vec(), |inner, _| {
        [&b"#bundle\0\0\0\0\0\0\0\0\x01"[..], &(inner.len() as u32).to_be_bytes(), &inner].concat()
    });
    let mut arrays = b"/a\0\0,".to_vec();
    arrays.extend(b"[".repeat(5000));
    arrays.extend(b"]".repeat(5003));
    arrays.push(0);
    let good: [Vec<u8>; 6] = [
        phone.datagram(5000, Some(&weights)),
        openseeface::write(1.7e9, [640.0, 480.0], &[[1.0, 2.0]; openseeface::NUM_POINTS], 1.0),
        ifacialmocap::write(ifacialmocap::Dialect::V1, &weights, Quat::IDENTITY, glam::Vec3::ZERO),
        fmv3::Sender::new(9).frame(None).remove(0),
        vmc::write(0.5, Some(&weights), Quat::IDENTITY).remove(0),
        vts::write(5000, Some((&weights, Quat::IDENTITY, glam::Vec3::ZERO))),
    ];
    let socket = socket();
    let mut random = 1u64;
    for (i, name) in names.iter().enumerate() {
        let to = port(&server, i);
        let mut hostile: Vec<Vec<u8>> = vec![
            Vec::new(),
            vec![0],
            vec![0xff; 1785],
            vec![0; 65_507],
            b"[".repeat(60_000),
            tower[tower.len() - 60_000..].to_vec(),
            tower[..16_380].to_vec(),
            arrays.clone(),
            b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n".to_vec(),
        ];
        if let Some(good) = good.get(i) {
            // Cut in the middle of a field, and too long.
            hostile.push(good[..good.len() / 2 + 1].to_vec());
            hostile.push([&good[..], &vec![b'{'; 65_507 - good.len()][..]].concat());
        }
        for _ in 0..20 {
            random = random.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            let length = (random >> 33) as usize % 3000 + 1;
            hostile.push((0..length).map(|at| (random >> (at % 8 * 7)) as u8 ^ at as u8).collect());
        }
        let count = hostile.len();
        let total = |metric: &str| -> f64 {
            let (_, body) = server.get("/metrics", "");
            let text = String::from_utf8(body).unwrap();
            text.lines().filter(|line| line.starts_with(metric)).filter_map(|line| line.rsplit(' ').next()?.parse::<f64>().ok()).sum()
        };
        let dropped_before = total("rhytid_tracker_dropped_total{");
        for (i, datagram) in hostile.iter().enumerate() {
            socket.send_to(datagram, to).unwrap();
            // One after the other: the kernel's own buffer, which holds three of the largest, must not be what drops them.
            let start = Instant::now();
            while total("rhytid_tracker_dropped_total{") - dropped_before < (i + 1) as f64 && start.elapsed() < Duration::from_secs(5) {
                std::thread::sleep(Duration::from_millis(1));
            }
        }
        assert_eq!(total("rhytid_tracker_dropped_total{") - dropped_before, count as f64, "{name}: every one is counted");
    }
    let after = server.room("demo").unwrap();
    assert_eq!((&after["session"], &after["frame"]), (&before["session"], &before["frame"]), "the face is as it was");
    phone.next(0.5);
    server.wait_for_room("demo", |room| room.is_some_and(|room| room["frame"]["seq"] == 1));
}

#[test]
fn a_rooms_face_goes_out_as_vmc() {
    let app = socket();
    let to = app.local_addr().unwrap();
    let server = Server::with(|config| config.vmc_out = vec![format!("{to},room=stage").parse().unwrap()]);
    let mut publisher = server.ready_publisher("stage");
    let sender = std::thread::spawn(move || {
        for i in 0..200 {
            publisher.send(&format!(
                r#"{{"type":"frame","t":{},"weights":{{"jawOpen":0.5,"eyeLookDownLeft":0.5,"eyeLookDownRight":0.5}},"head":{{"rotation":[0,0.2,0,0.98],"position":[0,0,0]}}}}"#,
                f64::from(i) / 50.0
            ));
            std::thread::sleep(Duration::from_millis(10));
        }
    });
    let mut reader = vmc::Reader::default();
    let mut buffer = [0; 4096];
    let mut last = None;
    for _ in 0..60 {
        let (length, _) = app.recv_from(&mut buffer).expect("faces come");
        assert!(length <= 1500);
        last = reader.take(&buffer[..length]).expect("what goes out can come in").or(last);
    }
    let last = last.expect("a face is complete");
    assert!(last.time.is_some_and(|time| time < 5.0), "seconds of the session: {:?}", last.time);
    let rhytid_server::trackers::Sight::Weights(face) = last.sight else { panic!("weights") };
    assert!((face.weights[index("jawOpen")] - 0.5).abs() < 0.02 && (face.weights[index("eyeLookDownLeft")] - 0.5).abs() < 0.02);
    let expected = Quat::from_xyzw(0.0, 0.2, 0.0, 0.98).normalize();
    assert!(face.head_rotation.unwrap().abs_diff_eq(expected, 0.01), "{:?}", face.head_rotation);
    sender.join().unwrap();
    assert!(server.metric("rhytid_vmc_frames_out_total") > 20.0);
}

/// Sends frames of a webcam, jaw open and brows down, until it is dropped.
struct Webcam {
    is_over: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Webcam {
    fn start(server: &Server) -> Self {
        let mut publisher = server.publisher("demo");
        publisher.send(r#"{"type":"hello","version":1,"source":"webcam","slot":"webcam"}"#);
        assert!(publisher.text().contains("ready"));
        let is_over = Arc::new(AtomicBool::new(false));
        let thread = std::thread::spawn({
            let is_over = is_over.clone();
            move || {
                let start = Instant::now();
                while !is_over.load(Ordering::Relaxed) {
                    let t = start.elapsed().as_secs_f64();
                    publisher
                        .send(&format!(r#"{{"type":"frame","t":{t},"weights":{{"jawOpen":0.8,"browDownLeft":0.5,"browDownRight":0.5}}}}"#));
                    std::thread::sleep(Duration::from_millis(25));
                }
            }
        });
        Self { is_over, thread: Some(thread) }
    }
}

impl Drop for Webcam {
    fn drop(&mut self) {
        self.is_over.store(true, Ordering::Relaxed);
        self.thread.take().map(JoinHandle::join);
    }
}

fn wait_for_weights(viewer: &mut Viewer, wanted: &[(&str, std::ops::Range<f32>)]) {
    let start = Instant::now();
    while start.elapsed() < Duration::from_secs(10) {
        assert!(viewer.next_packet());
        let weights = viewer.frame.shapes.unwrap();
        if wanted.iter().all(|(name, range)| range.contains(&weights[index(name)])) {
            return;
        }
    }
    let seen: Vec<_> = wanted.iter().map(|(name, _)| (name, viewer.frame.shapes.unwrap()[index(name)])).collect();
    panic!("{seen:?}, expected {wanted:?}");
}

#[test]
fn a_phones_datagrams_and_a_webcams_socket_share_a_face_by_the_rule() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("brows.jsonl");
    let mut text = String::from("{\"type\":\"hello\",\"version\":1,\"source\":\"test\"}\n");
    for i in 0..1200 {
        text += &format!("{{\"type\":\"frame\",\"t\":{},\"weights\":{{\"browInnerUp\":0.9}}}}\n", f64::from(i) / 60.0);
    }
    std::fs::write(&path, text).unwrap();
    let server = listening(&["livelink=127.0.0.1:0,room=demo,slot=phone,priority=60,groups=brows"]);
    let mut viewer = server.viewer("demo");
    let webcam = Webcam::start(&server);
    wait_for_weights(&mut viewer, &[("browDownLeft", 0.45..0.55), ("jawOpen", 0.75..0.85)]);
    let phone = Fake::start(FakeKind::LiveLink, path.clone(), Some(port(&server, 0)));
    wait_for_weights(&mut viewer, &[("browInnerUp", 0.85..0.95), ("browDownLeft", 0.0..0.01), ("jawOpen", 0.75..0.85)]);
    let sources = server.room("demo").unwrap()["sources"].clone();
    let drives = |slot: &str| sources.as_array().unwrap().iter().find(|source| source["slot"] == slot).unwrap()["drives"].clone();
    assert_eq!(drives("phone"), serde_json::json!(["brows"]));
    assert_eq!(drives("webcam"), serde_json::json!(["lids", "gaze", "mouth", "head"]));
    // It cannot speak for itself: somebody else does.
    let mut control = server.connect("/v1/rooms/demo/control?slot=phone", &[]).unwrap();
    control.send(r#"{"type":"settings","gains":{"brows":0.5}}"#);
    assert!(control.text().contains(r#""brows":0.5"#));
    wait_for_weights(&mut viewer, &[("browInnerUp", 0.4..0.5), ("jawOpen", 0.75..0.85)]);
    // The phone stops: brows from the webcam. It stops, too: brows from the phone alone.
    drop(phone);
    wait_for_weights(&mut viewer, &[("browInnerUp", 0.0..0.01), ("browDownLeft", 0.45..0.55), ("jawOpen", 0.75..0.85)]);
    drop(webcam);
    let _phone = Fake::start(FakeKind::LiveLink, path, Some(port(&server, 0)));
    wait_for_weights(&mut viewer, &[("browInnerUp", 0.4..0.95), ("browDownLeft", 0.0..0.01)]);
}

#[test]
fn of_two_at_the_same_priority_the_later_takes_over() {
    let server = listening(&["openseeface=127.0.0.1:0,room=demo"]);
    let mut viewer = server.viewer("demo");
    let _webcam = Webcam::start(&server);
    wait_for_weights(&mut viewer, &[("jawOpen", 0.75..0.85)]);
    let fake = Fake::start(FakeKind::OpenSeeFace, landmarks_feed(), Some(port(&server, 0)));
    let all = serde_json::json!(["brows", "lids", "gaze", "mouth", "head"]);
    let drives = |slot: &'static str| {
        let all = all.clone();
        move |room: Option<&serde_json::Value>| {
            let sources = room.and_then(|room| room["sources"].as_array().cloned()).unwrap_or_default();
            sources.iter().any(|source| source["slot"] == slot && source["drives"] == all)
        }
    };
    server.wait_for_room("demo", drives("openseeface"));
    drop(fake);
    server.wait_for_room("demo", drives("webcam"));
}

#[test]
fn a_recording_of_live_link_face_is_a_feed() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("take_cal.csv");
    let mut text = String::from("Timecode,BlendShapeCount,JawOpen,MouthLeft,HeadYaw,HeadPitch,HeadRoll\n");
    for frame in 0..60 {
        text += &format!("10:00:01:{frame:02}.000,61,{},0.5,0.0,0.1,0.0\n", f64::from(frame) / 100.0);
    }
    std::fs::write(&path, text).unwrap();
    let server = Server::start();
    let mut viewer = server.viewer("demo");
    let options = SendOptions {
        source: SendSource::File(path),
        to: format!("ws://{}", server.address),
        room: "demo".into(),
        speed: 2.0,
        repeats: false,
        takeover: false,
        binary: false,
        profile: None,
        timeout: Duration::from_secs(10),
        trust: Trust::Public,
        token: None,
    };
    let sender = std::thread::spawn(move || {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        runtime.block_on(send(&options, &indicatif::ProgressBar::hidden(), std::future::pending()))
    });
    wait_until_it_moves(&mut viewer, 0.001);
    assert_eq!(sender.join().unwrap().unwrap().frames, 60);
    assert_eq!(server.metric("rhytid_frames_in_total"), 60.0);
}
