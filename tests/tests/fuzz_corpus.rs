//! Every parser of what comes from outside on a fixed corpus, and on mutations of it that are the same in every run. Longer runs are
//! cargo-fuzz's, see `tests/fuzz/Cargo.toml`; what those find goes into the corpus.

#[path = "../../shared/tests/small/mod.rs"]
#[allow(dead_code, clippy::unwrap_used, reason = "the character's own tests use the rest, and it is their file")]
mod small;

use glam::{Quat, Vec3};
use rhytid_server::fuzz::targets;
use rhytid_server::pipeline::Pipeline;
use rhytid_server::solve::SolveConfig;
use rhytid_server::trackers::fuzz::join;
use rhytid_server::trackers::{fmv3, ifacialmocap, livelink, openseeface, vmc, vts};
use rhytid_shared::view::{ViewHello, ViewMessage};
use rhytid_shared::{Character, DEFAULT_CHARACTER_GLB, PublishHello, TrackingData, TrackingFrame, encode_landmarks};
use small::Glb;
use std::panic::catch_unwind;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

/// Mutations of each target, if time is not up before.
const NUM_MUTATIONS: u32 = 20_000;
/// For each target: slow machines try fewer.
const PATIENCE: Duration = Duration::from_secs(6);
/// Longest input, bytes: a datagram.
const LONGEST: usize = 65_536;

fn corpus(target: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("fuzz/corpus").join(target)
}

/// The corpus of a target, by name.
fn inputs(target: &str) -> Vec<(String, Vec<u8>)> {
    let folder = std::fs::read_dir(corpus(target)).unwrap_or_else(|error| panic!("{target} has a corpus: {error}"));
    let mut inputs: Vec<_> = folder
        .map(|entry| {
            let path = entry.expect("the folder can be read").path();
            let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
            (name, std::fs::read(&path).expect("the file can be read"))
        })
        .collect();
    inputs.sort();
    inputs
}

fn run(target: fn(&[u8]), name: &str, bytes: &[u8]) {
    if catch_unwind(|| target(bytes)).is_err() {
        let hex: String = bytes.iter().take(400).map(|byte| format!("{byte:02x}")).collect();
        panic!("{name} panicked on {} bytes: {hex}", bytes.len());
    }
}

#[test]
fn the_corpus_breaks_no_parser() {
    for (name, target) in targets() {
        let inputs = inputs(name);
        assert!(inputs.len() >= 3, "{name} has {} inputs", inputs.len());
        for (file, bytes) in &inputs {
            run(target, &format!("{name} on {file}"), bytes);
        }
    }
}

#[test]
fn mutations_of_the_corpus_break_no_parser() {
    for (name, target) in targets() {
        let inputs: Vec<_> = inputs(name).into_iter().map(|(_, bytes)| bytes).collect();
        let mut random = Random(0x9e37_79b9_7f4a_7c15);
        let start = Instant::now();
        let mut done = 0;
        while done < NUM_MUTATIONS && (done < 1000 || start.elapsed() < PATIENCE) {
            let bytes = random.mutated(&inputs);
            run(target, name, &bytes);
            done += 1;
        }
        assert!(done >= 1000);
    }
}

/// Marsaglia's xorshift64*: the same numbers everywhere.
struct Random(u64);

impl Random {
    fn next(&mut self) -> u64 {
        self.0 ^= self.0 >> 12;
        self.0 ^= self.0 << 25;
        self.0 ^= self.0 >> 27;
        self.0.wrapping_mul(0x2545_f491_4f6c_dd1d)
    }

    fn below(&mut self, end: usize) -> usize {
        (self.next() >> 16) as usize % end.max(1)
    }

    /// One of `inputs` with a few changes.
    fn mutated(&mut self, inputs: &[Vec<u8>]) -> Vec<u8> {
        let mut bytes = inputs[self.below(inputs.len())].clone();
        for _ in 0..=self.below(4) {
            let at = self.below(bytes.len() + 1);
            match self.below(8) {
                0 => bytes.truncate(at),
                1 => {
                    let byte = self.next() as u8;
                    bytes.insert(at, byte);
                }
                2 if at < bytes.len() => {
                    bytes.remove(at);
                }
                3 => {
                    let other = &inputs[self.below(inputs.len())];
                    let from = self.below(other.len() + 1);
                    bytes.truncate(at);
                    bytes.extend(&other[from..]);
                }
                // Numbers at which lengths and floats break.
                4 => {
                    let numbers: [&[u8]; 8] = [
                        &[0xff; 4],
                        &[0; 4],
                        &[0x7f, 0xff, 0xff, 0xff],
                        &[0xff, 0xff, 0xff, 0x7f],
                        &[0x7f, 0xc0, 0, 0],
                        &[0, 0, 0xc0, 0x7f],
                        b"1e99",
                        b"[[[[",
                    ];
                    let number = numbers[self.below(numbers.len())];
                    for (to, from) in bytes.iter_mut().skip(at).zip(number) {
                        *to = *from;
                    }
                }
                5 => {
                    let end = (at + self.below(64)).min(bytes.len());
                    let piece = bytes[at..end].to_vec();
                    let times = self.below(40);
                    bytes.splice(at..at, piece.repeat(times));
                }
                _ if at < bytes.len() => bytes[at] ^= 1 << self.below(8),
                _ => {}
            }
        }
        bytes.truncate(LONGEST);
        bytes
    }
}

/// The corpus is what this writes, and what fuzzing has found; `RHYTID_UPDATE_CORPUS=1` writes it.
#[test]
fn the_seeds_are_in_the_corpus() {
    let weights: [f32; 52] = std::array::from_fn(|i| i as f32 / 60.0);
    let (head, place) = (Quat::from_xyzw(0.1, -0.2, 0.05, 0.97).normalize(), Vec3::new(0.01, -0.05, -0.6));
    let face = Some((&weights, head, place));
    let packet = livelink::Packet { device: "A", subject: "B", frame: 1, sub_frame: 0.5, rate: [60, 1], values: None };
    let with_face = livelink::Packet { values: Some(livelink::values(&weights, head)), ..packet.clone() };
    let points = std::array::from_fn(|i| [200.0 + i as f32, 300.0 - i as f32]);
    let one = openseeface::write(1.7e9, [640.0, 480.0], &points, 0.9);
    let text = |dialect| ifacialmocap::write(dialect, &weights, head, place);
    let mut phone = fmv3::Sender::new(99);
    let stream: Vec<Vec<u8>> = phone.schema().into_iter().chain(phone.frame(face)).chain(phone.frame(None)).collect();
    let bundles = vmc::write(0.5, Some(&weights), head);
    let joy =
        b"#bundle\0\0\0\0\0\0\0\0\x01\0\0\0\x20/VMC/Ext/Blend/Val\0\0,sf\0Joy\0\x3f\0\0\0\0\0\0\x1c/VMC/Ext/Blend/Apply\0\0\0\0,\0\0\0";
    let row = |frame: u32| format!("13:13:04:{frame}.652,61,0.25,0.5,0.1,-0.2,0.05\n");
    let recording = format!("Timecode,BlendShapeCount,JawOpen,EyeBlinkLeft,HeadYaw,HeadPitch,HeadRoll\n{}{}", row(31), row(33));
    let joined = |datagrams: &[Vec<u8>]| join(datagrams.iter().map(Vec::as_slice));
    let seeds: Vec<(&str, &str, Vec<u8>)> = vec![
        ("openseeface", "face", one.clone()),
        ("openseeface", "two_faces", [one.clone(), one.clone()].concat()),
        ("openseeface", "cut", one[..1000].to_vec()),
        ("livelink", "no_face", packet.write()),
        ("livelink", "face", with_face.write()),
        ("livelink", "cut", with_face.write()[..100].to_vec()),
        ("ifacialmocap", "v1", text(ifacialmocap::Dialect::V1)),
        ("ifacialmocap", "v2", text(ifacialmocap::Dialect::V2)),
        ("ifacialmocap", "facemotion3d", text(ifacialmocap::Dialect::Facemotion3d)),
        ("ifacialmocap", "no_face", ifacialmocap::write_no_face(ifacialmocap::Dialect::V1)),
        ("ifacialmocap", "hello", ifacialmocap::hello(ifacialmocap::Dialect::V2)),
        ("fmv3", "stream", joined(&stream)),
        ("fmv3", "frames", joined(&stream[stream.len() - 2..])),
        ("fmv3", "hello", joined(&[fmv3::hello(1, 60)])),
        ("vmc", "face", joined(&bundles)),
        ("vmc", "joy", join([&joy[..]])),
        ("vmc", "message", join([&joy[20..52]])),
        ("vts", "face", vts::write(2500, face)),
        ("vts", "no_face", vts::write(2500, None)),
        ("vts", "request", vts::request(21412)),
        ("livelink_csv", "recording", recording.clone().into_bytes()),
        ("livelink_csv", "windows", recording.replace('\n', "\r\n").into_bytes()),
        ("livelink_csv", "header", recording.lines().next().unwrap_or_default().into()),
        ("sniff", "livelink", with_face.write()),
        ("sniff", "openseeface", one),
        ("sniff", "ifacialmocap", text(ifacialmocap::Dialect::V1)),
        ("sniff", "fmv3", stream[0].clone()),
        ("sniff", "vmc", joy.to_vec()),
        ("sniff", "vts", vts::write(2500, face)),
    ];
    let seeds = seeds.into_iter().chain(own_seeds());
    let updates = std::env::var_os("RHYTID_UPDATE_CORPUS").is_some();
    for (target, name, bytes) in seeds {
        let path = corpus(target).join(name);
        if updates {
            std::fs::create_dir_all(corpus(target)).expect("the corpus can be written");
            std::fs::write(&path, &bytes).expect("the corpus can be written");
        }
        // Its bytes may differ: machines round angles differently.
        let kept = std::fs::read(&path).unwrap_or_else(|error| panic!("{}: {error}; RHYTID_UPDATE_CORPUS=1 writes it", path.display()));
        assert!(!kept.is_empty() && !bytes.is_empty(), "{} is empty", path.display());
    }
}

/// What goes over the sockets, and what is read from files.
fn own_seeds() -> Vec<(&'static str, &'static str, Vec<u8>)> {
    let character = Arc::new(Character::from_glb(DEFAULT_CHARACTER_GLB).expect("the built-in character is whole"));
    let weights = r#"{"type":"hello","version":1,"source":"fuzz","fps":30,"slot":"phone","priority":60,"groups":["brows","head"],"settings":{"mirror":true}}
{"type":"frame","t":0,"weights":{"jawOpen":0.5,"browInnerUp":1e0},"expressions":{"surprise":0.8}}
{"type":"frame","t":0.04,"weights":{},"head":{"rotation":[0,0.1,0,0.99],"position":[0.01,0,-0.5]}}
{"type":"calibrate"}
{"type":"settings","gains":{"brows":1.5},"smoothing":{"mouth":0.5},"swap_jaw":true}
{"type":"frame","t":0.08,"face":false}
"#;
    let points: Vec<String> = (0..68).map(|i| format!("[{},{}]", 100 + 7 * (i % 17), 120 + 9 * (i / 17))).collect();
    let landmarks = format!(
        "{{\"type\":\"hello\",\"version\":1,\"layout\":\"ibug68\",\"image\":[400,300],\"focal\":500}}\n\
         {{\"type\":\"frame\",\"t\":0.1,\"landmarks\":[{0}]}}\n{{\"type\":\"frame\",\"t\":0.2,\"landmarks\":[{0}]}}\n{{\"type\":\"recentre\"}}\n",
        points.join(",")
    );
    let bones = format!(
        "{{\"type\":\"hello\",\"version\":1}}\n{{\"type\":\"frame\",\"t\":0,\"bones\":{{\"{}\":[0.01,0.05,0.1]}}}}\n",
        character.bones[0].name
    );
    let mesh: Vec<[f32; 3]> = (0..478).map(|i| [(i % 22) as f32 * 9.0 + 200.0, (i / 22) as f32 * 11.0 + 100.0, (i % 5) as f32]).collect();
    let binary = |with_confidence: bool| {
        let (mut one, mut all) = (Vec::new(), Vec::new());
        for k in 0..3 {
            let confidence = if with_confidence { vec![0.9; 478] } else { Vec::new() };
            encode_landmarks(0.04 * f64::from(k), &mesh, &confidence, &mut one).expect("the mesh is sound");
            all.push(one.clone());
        }
        join(all.iter().map(Vec::as_slice))
    };
    let mut pipeline =
        Pipeline::new(character.clone(), &SolveConfig::default(), &PublishHello::default(), 1).expect("the default hello is sound");
    let (mut packet, mut packets) = (Vec::new(), Vec::new());
    for k in 0..12_u8 {
        let weights = Box::new(std::array::from_fn(|i| f32::from((k as usize + i).is_multiple_of(7)) * 0.6));
        let frame = TrackingFrame::new(f64::from(k) * 0.04, TrackingData::Weights { weights, head: None });
        pipeline.frame(&frame, &mut packet).expect("the frame is sound");
        packets.push(packet.clone());
    }
    let hello = ViewMessage::Hello(ViewHello::new("demo", &character, "/characters/default.glb".into()));
    let glb = |glb: Glb| glb.to_bytes();
    let config = "listen = \"127.0.0.1:0\"\nlisten_udp = [\"livelink=127.0.0.1:11111,room=demo,allow=192.0.2.1\"]\n[limits]\nrooms = 3\n\
                  [timeouts]\nhello = 0.5\n[access]\nhosts = [\"a.example\"]\n[solve]\nestimate_weights = false\n";
    let profile = r#"{"rhytid_profile":1,"name":"ada","source":"webcam","ranges":{"smile":1.2},"settings":{"gains":{"mouth":1.5}}}"#;
    let spec = "ifacialmocap=0.0.0.0:49983,phone=192.168.1.20:49983,room=demo,version=3,slot=phone,priority=60,groups=brows+mouth";
    // Signed with a key that was thrown away.
    let token = "eyJ0eXAiOiJKV1QiLCJhbGciOiJIUzI1NiJ9.eyJyb2xlIjoidmlldyIsInJvb21zIjpbIioiXSwiZXhwIjo0MDAwMDAwMDAwfQ.AAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAA";
    vec![
        ("publish", "weights", weights.into()),
        ("publish", "landmarks", landmarks.clone().into()),
        ("publish", "bones", bones.clone().into()),
        ("publish_binary", "points", binary(false)),
        ("publish_binary", "confidence", binary(true)),
        ("publish_binary", "cut", binary(false)[..1500].into()),
        ("feed", "weights", weights.into()),
        ("feed", "landmarks", landmarks.into()),
        ("feed", "bones", bones.into()),
        ("command", "settings", br#"{"type":"settings","mirror":true,"gains":{"brows":1.5},"smoothing":{"head":0}}"#.into()),
        ("command", "fit", br#"{"type":"fit","step":"smile","seconds":1.5}"#.into()),
        ("command", "profile", format!(r#"{{"type":"profile","profile":{profile}}}"#).into()),
        ("command", "line_break", br#"{"type":"profile","profile":{"rhytid_profile":1,"r\nges":{}}}"#.into()),
        ("profile", "ada", profile.into()),
        ("profile", "least", br#"{"rhytid_profile":1}"#.into()),
        ("profile", "other_version", br#"{"rhytid_profile":2,"neutral":{}}"#.into()),
        ("packets", "session", join(packets.iter().map(Vec::as_slice))),
        ("packets", "key", join([packets[0].as_slice()])),
        ("packets", "delta_alone", join([packets[5].as_slice()])),
        ("hello", "default", serde_json::to_vec(&hello).expect("plain data can be written")),
        ("hello", "error", br#"{"type":"error","code":"idle","message":"no pong"}"#.into()),
        (
            "hello",
            "no_bones",
            br#"{"type":"hello","version":1,"room":"a","character":{"name":"","url":"","sha256":"","bones":[],"poses":[],"groups":[]}}"#
                .into(),
        ),
        ("character", "small", glb(Glb::small_character())),
        ("character", "zones", glb(Glb::small_character().with_zones())),
        ("character", "colour", glb(Glb::small_character().with_colour())),
        ("config", "some", config.into()),
        ("config", "unknown_field", b"[limits]\nroms = 3\n".into()),
        ("config", "wrong_type", b"listen = 3\n".into()),
        ("spec", "phone", spec.into()),
        ("spec", "any", b"any=0.0.0.0:11111,room=subject,swap_mouth=true".into()),
        ("spec", "vmc_out", b"127.0.0.1:39539,room=demo".into()),
        ("token", "foreign", token.into()),
        ("token", "unsigned", b"eyJhbGciOiJub25lIn0.eyJyb2xlIjoiYWRtaW4iLCJyb29tcyI6WyIqIl0sImV4cCI6NDAwMDAwMDAwMH0.".into()),
        ("token", "cut", token[..80].into()),
    ]
}
