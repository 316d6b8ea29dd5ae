//! Feeds sent as other programs' trackers would send them, so that every protocol can be tried without a phone.

use super::{fmv3, ifacialmocap, livelink, openseeface, vmc, vts};
use crate::feed::{Feed, FeedError, FeedItem};
use crate::pipeline::Pipeline;
use crate::solve::{SolveConfig, SolveError};
use glam::{Quat, Vec3};
use rhytid_shared::layout::{IBUG_FROM_MEDIAPIPE, IBUG_FROM_OPENSEEFACE, Layout};
use rhytid_shared::{Character, NUM_ARKIT_SHAPES, TrackingData, TrackingFrame};
use std::future::Future;
use std::net::SocketAddr;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::{Duration, SystemTime, UNIX_EPOCH};
use tokio::net::UdpSocket;
use tokio::time::Instant;

/// What a fake sender calls its phone.
const DEVICE: &str = "00000000-FA4E-4FA4-8FA4-000000000000";
/// Live Link Face's rate, frames a second.
const LIVELINK_RATE: f64 = 60.0;
/// How often a schema is sent until it is known.
const SCHEMA_INTERVAL: Duration = Duration::from_secs(1);
/// Confidence of every landmark.
const CONFIDENCE: f32 = 0.9;

/// Why nothing could be faked.
#[derive(Debug, thiserror::Error)]
pub enum FakeError {
    /// The feed is broken.
    #[error(transparent)]
    Feed(#[from] FeedError),
    /// The feed's landmarks cannot be solved.
    #[error(transparent)]
    Solve(#[from] SolveError),
    /// The socket.
    #[error("cannot use UDP port {address}: {source}")]
    Socket {
        /// Which.
        address: SocketAddr,
        /// What the system said.
        source: std::io::Error,
    },
    /// The feed does not hold what the protocol carries.
    #[error("{0}")]
    Content(String),
}

/// Which sender is played.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum FakeKind {
    /// OpenSeeFace (of a feed of landmarks).
    #[value(name = "openseeface")]
    OpenSeeFace,
    /// Live Link Face.
    #[value(name = "livelink")]
    LiveLink,
    /// iFacialMocap, text version 1.
    #[value(name = "ifacialmocap")]
    IFacialMocap,
    /// iFacialMocap, text version 2.
    #[value(name = "ifacialmocap2")]
    IFacialMocap2,
    /// Facemotion3d, text.
    #[value(name = "facemotion3d")]
    Facemotion3d,
    /// Version 3 of both.
    #[value(name = "fmv3")]
    Fmv3,
    /// VMC.
    #[value(name = "vmc")]
    Vmc,
    /// VTube Studio's phone app.
    #[value(name = "vts")]
    Vts,
}

/// What to play, and to whom.
#[derive(Debug, Clone)]
pub struct FakeOptions {
    /// The sender.
    pub kind: FakeKind,
    /// The feed.
    pub feed: PathBuf,
    /// Who gets it. Without, it goes to whoever asks for it in the protocol's own way.
    pub to: Option<SocketAddr>,
    /// Where to send from, and to be asked at.
    pub bind: SocketAddr,
    /// What the performer is called, where the protocol says.
    pub subject: String,
    /// Feed seconds a second; infinite for as fast as possible.
    pub speed: f64,
    /// Play it again and again, on one clock.
    pub repeats: bool,
}

/// Plays a feed until its end or until `stop` is done. Gives the frames sent; `bound` learns where it sends from.
pub async fn fake(options: &FakeOptions, bound: impl FnOnce(SocketAddr), stop: impl Future<Output = ()>) -> Result<u64, FakeError> {
    let asks_nobody = matches!(options.kind, FakeKind::OpenSeeFace | FakeKind::LiveLink | FakeKind::Vmc);
    if asks_nobody && options.to.is_none() {
        return Err(FakeError::Content("nobody asks this sender to start, expected --to IP:PORT".into()));
    }
    let problem = |source| FakeError::Socket { address: options.bind, source };
    let socket = UdpSocket::bind(options.bind).await.map_err(problem)?;
    bound(socket.local_addr().map_err(problem)?);
    let mut actor = Actor::new(options, socket);
    tokio::pin!(stop);
    let mut offset = 0.0;
    loop {
        let mut scenes = Scenes::open(options)?;
        let mut last = 0.0;
        let mut first = None;
        while let Some((t, scene)) = scenes.next()? {
            // All rounds on one clock, a frame apart.
            let t = t - *first.get_or_insert(t) + offset;
            last = t;
            tokio::select! {
                () = &mut stop => return Ok(actor.num_frames),
                played = actor.play(t, &scene) => played?,
            }
        }
        offset = last + 0.04;
        if !options.repeats || first.is_none() {
            return Ok(actor.num_frames);
        }
    }
}

/// What a frame shows.
struct Scene {
    /// Weights, head and its place; nothing where nobody is there.
    face: Option<(Box<[f32; NUM_ARKIT_SHAPES]>, Quat, Vec3)>,
    landmarks: Option<Box<[[f32; 2]; openseeface::NUM_POINTS]>>,
    image: [f32; 2],
}

/// A feed as scenes: landmarks are solved for the weights of protocols that have weights.
struct Scenes {
    feed: Feed,
    frame: TrackingFrame,
    pipeline: Pipeline,
    wants_landmarks: bool,
}

impl Scenes {
    fn open(options: &FakeOptions) -> Result<Self, FakeError> {
        let character = Character::from_glb(rhytid_shared::DEFAULT_CHARACTER_GLB).expect("the built-in character is sound");
        let character = Arc::new(character);
        let feed = Feed::open(&options.feed, &character)?;
        let pipeline = Pipeline::new(character, &SolveConfig::default(), &feed.hello, 1)?;
        Ok(Self { feed, frame: TrackingFrame::default(), pipeline, wants_landmarks: options.kind == FakeKind::OpenSeeFace })
    }

    fn next(&mut self) -> Result<Option<(f64, Scene)>, FakeError> {
        loop {
            match self.feed.next_frame(&mut self.frame)? {
                None => return Ok(None),
                Some(FeedItem::Command(command)) => self.pipeline.command(&command)?,
                Some(FeedItem::Frame) => return Ok(Some((self.frame.t, self.scene()?))),
            }
        }
    }

    fn scene(&mut self) -> Result<Scene, FakeError> {
        let image = self.feed.hello.image.unwrap_or([640.0, 480.0]);
        let mut scene = Scene { face: None, landmarks: None, image };
        match &self.frame.data {
            TrackingData::NoFace => {}
            TrackingData::Landmarks { points, .. } if self.wants_landmarks => {
                let layout = self.feed.hello.layout.as_ref();
                let landmarks = layout.and_then(|layout| openseeface_points(layout, points));
                scene.landmarks =
                    Some(landmarks.ok_or_else(|| FakeError::Content("the feed's own layout has no OpenSeeFace points".into()))?);
            }
            _ if self.wants_landmarks => return Err(FakeError::Content("openseeface sends landmarks, and this feed has none".into())),
            TrackingData::Weights { weights, head } => {
                let head = head.unwrap_or_default();
                scene.face = Some((weights.clone(), head.rotation, head.position));
            }
            TrackingData::Landmarks { .. } | TrackingData::Bones { .. } => {
                self.pipeline.solve(&self.frame)?;
                let face = self.pipeline.face();
                let weights =
                    face.shapes.ok_or_else(|| FakeError::Content("the feed has bones, from which no weights can be told".into()))?;
                scene.face = Some((Box::new(weights), face.head.rotation, face.head.position));
            }
        }
        Ok(scene)
    }
}

/// A frame's points in OpenSeeFace's order.
fn openseeface_points(layout: &Layout, points: &[[f32; 3]]) -> Option<Box<[[f32; 2]; openseeface::NUM_POINTS]>> {
    let ibug = |index: usize| match layout {
        Layout::Ibug68 => Some(index),
        Layout::Mediapipe478 => Some(IBUG_FROM_MEDIAPIPE[index]),
        Layout::OpenSeeFace66 => Some(IBUG_FROM_OPENSEEFACE[index]),
        Layout::Named(_) => None,
    };
    let mut sent = Box::new([[0.0; 2]; openseeface::NUM_POINTS]);
    for (index, &to) in IBUG_FROM_OPENSEEFACE.iter().enumerate() {
        // The outer corners of the mouth stand for none of their own.
        if index != 48 && index != 54 {
            let [x, y, _] = *points.get(ibug(index)?)?;
            sent[to] = [x, y];
        }
    }
    Some(sent)
}

/// The sender: where it sends to, and its side of the handshake.
struct Actor<'a> {
    options: &'a FakeOptions,
    socket: UdpSocket,
    to: Option<SocketAddr>,
    /// When nobody is asking any more.
    until: Option<Instant>,
    dialect: ifacialmocap::Dialect,
    fmv3: fmv3::Sender,
    last_schema: Option<Instant>,
    /// When the first frame went out.
    start: Option<(Instant, f64)>,
    unix: f64,
    num_frames: u64,
}

impl<'a> Actor<'a> {
    fn new(options: &'a FakeOptions, socket: UdpSocket) -> Self {
        let unix = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0.0, |since| since.as_secs_f64());
        Self {
            options,
            socket,
            to: options.to,
            until: None,
            dialect: match options.kind {
                FakeKind::IFacialMocap => ifacialmocap::Dialect::V1,
                FakeKind::Facemotion3d => ifacialmocap::Dialect::Facemotion3d,
                _ => ifacialmocap::Dialect::V2,
            },
            fmv3: fmv3::Sender::new(unix.to_bits()),
            last_schema: None,
            start: None,
            unix,
            num_frames: 0,
        }
    }

    /// Sends a scene in its time, and answers meanwhile. May be dropped at any await.
    async fn play(&mut self, t: f64, scene: &Scene) -> Result<(), FakeError> {
        let mut buffer = [0; 2048];
        loop {
            let now = Instant::now();
            let is_ready = self.is_ready(now);
            if self.options.kind == FakeKind::Fmv3
                && let (Some(to), false) = (self.to, self.fmv3.is_known())
                && self.last_schema.is_none_or(|last| now - last >= SCHEMA_INTERVAL)
            {
                self.last_schema = Some(now);
                self.send(to, self.fmv3.schema()).await;
            }
            let due = if is_ready {
                let (start, t0) = *self.start.get_or_insert((now, t));
                // At infinite speed every frame is due at once.
                start + Duration::from_secs_f64(((t - t0) / self.options.speed).clamp(0.0, 1e9))
            } else {
                now + SCHEMA_INTERVAL / 10
            };
            tokio::select! {
                biased;
                received = self.socket.recv_from(&mut buffer) => {
                    // A port that nobody listens on says so here; the next frame may find somebody.
                    if let Ok((length, from)) = received {
                        self.hear(&buffer[..length], from).await;
                    }
                }
                () = tokio::time::sleep_until(due) => if is_ready { break },
            }
        }
        let Some(to) = self.to else { return Ok(()) };
        let datagrams = self.datagrams(t, scene);
        self.num_frames += u64::from(!datagrams.is_empty());
        self.send(to, datagrams).await;
        Ok(())
    }

    fn is_ready(&self, now: Instant) -> bool {
        self.to.is_some() && self.until.is_none_or(|until| now < until) && (self.options.kind != FakeKind::Fmv3 || self.fmv3.is_known())
    }

    async fn send(&self, to: SocketAddr, datagrams: Vec<Vec<u8>>) {
        for bytes in datagrams {
            if let Err(error) = self.socket.send_to(&bytes, to).await {
                tracing::debug!(%to, %error, "cannot send");
            }
        }
    }

    /// Takes what the other side asks for.
    async fn hear(&mut self, bytes: &[u8], from: SocketAddr) {
        match self.options.kind {
            FakeKind::IFacialMocap | FakeKind::IFacialMocap2 | FakeKind::Facemotion3d => {
                if let Some(dialect) = ifacialmocap::read_hello(bytes) {
                    (self.dialect, self.to) = (dialect, Some(from));
                }
            }
            FakeKind::Vts => {
                if let Some((ports, seconds)) = vts::read_request(bytes) {
                    self.to = ports.first().map(|port| SocketAddr::new(from.ip(), *port));
                    self.until = Some(Instant::now() + Duration::from_secs_f64(seconds));
                }
            }
            FakeKind::Fmv3 => {
                let answers = self.fmv3.take(bytes);
                self.to = Some(from);
                self.send(from, answers).await;
            }
            FakeKind::OpenSeeFace | FakeKind::LiveLink | FakeKind::Vmc => {}
        }
    }

    /// One frame in the protocol's words.
    fn datagrams(&mut self, t: f64, scene: &Scene) -> Vec<Vec<u8>> {
        let face = scene.face.as_ref().map(|(weights, head, place)| (&**weights, *head, *place));
        match self.options.kind {
            FakeKind::OpenSeeFace => {
                scene.landmarks.iter().map(|points| openseeface::write(self.unix + t, scene.image, points, CONFIDENCE)).collect()
            }
            FakeKind::LiveLink => {
                // A clock that does not pass midnight while anybody watches.
                let frame = 36_000.0 * LIVELINK_RATE + t * LIVELINK_RATE;
                let packet = livelink::Packet {
                    device: DEVICE,
                    subject: &self.options.subject,
                    frame: frame.floor() as i32,
                    sub_frame: (frame.fract() as f32).min(0.999),
                    rate: [LIVELINK_RATE as i32, 1],
                    values: face.map(|(weights, head, _)| livelink::values(weights, head)),
                };
                vec![packet.write()]
            }
            FakeKind::IFacialMocap | FakeKind::IFacialMocap2 | FakeKind::Facemotion3d => {
                let written = match face {
                    Some((weights, head, place)) => ifacialmocap::write(self.dialect, weights, head, place),
                    None => ifacialmocap::write_no_face(self.dialect),
                };
                vec![written]
            }
            FakeKind::Fmv3 => self.fmv3.frame(face),
            FakeKind::Vmc => face.map_or_else(Vec::new, |(weights, head, _)| vmc::write(t as f32, Some(weights), head)),
            FakeKind::Vts => vec![vts::write(((self.unix + t) * 1000.0) as u64, face)],
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn points_of_every_layout_come_in_openseefaces_order() {
        let points: Vec<[f32; 3]> = (0..478).map(|i| [i as f32, 0.0, 0.0]).collect();
        let at = |layout: Layout, index: usize| openseeface_points(&layout, &points).unwrap()[index][0] as usize;
        assert_eq!([at(Layout::Ibug68, 47), at(Layout::Ibug68, 48), at(Layout::Ibug68, 58), at(Layout::Ibug68, 65)], [47, 49, 60, 67]);
        assert_eq!(at(Layout::Mediapipe478, 0), 127);
        assert!((0..66).all(|index| at(Layout::OpenSeeFace66, index) == index));
        assert!(openseeface_points(&Layout::Named(vec![]), &points).is_none());
    }
}
