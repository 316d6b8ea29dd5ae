//! `view`: a window that shows a room's face live.

pub(crate) mod expressions;
mod hand;
mod look;
mod pages;
mod painter;
mod panel;
mod play_bar;
mod switches;
mod window;

pub(crate) use look::{ACCENT, FAINT, TEXT, apply as apply_look};
pub(crate) use painter::Painter;

use crate::asset::{AssetError, CharacterAsset};
use crate::remote::Remote;
use crate::renderer::{Deformation, RenderError, ViewError, ViewMode};
use crate::spectator::{Spectator, StatusKind, WatchArgs};
use hand::HandFace;
use panel::{Rates, Scene};
use rhytid_shared::{Character, DEFAULT_CHARACTER_GLB};
use std::borrow::Cow;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::{Duration, Instant};
use switches::{Page, Switches};
use window::{Canvas, GpuWindow};
use winit::application::ApplicationHandler;
use winit::dpi::LogicalSize;
use winit::event::WindowEvent;
use winit::event_loop::{ActiveEventLoop, ControlFlow, EventLoop};
use winit::window::{Window, WindowId};

/// What `view` is asked to do.
#[derive(Debug, Clone, clap::Args)]
pub struct ViewArgs {
    /// Whom to watch.
    #[command(flatten)]
    pub watch: WatchArgs,
    /// What is shown first: beauty, bare, split, influence, influence:POSE, normals, wireframe, a part of the light, masks,
    /// bone-masks or shape-deltas
    #[arg(long, value_name = "VIEW", default_value = "beauty")]
    pub view: String,
    /// Start with the sliders that pose the face in place of the stream; needs no server
    #[arg(long)]
    pub by_hand: bool,
    /// Save a picture of the whole window to this PNG once the face has been live, or by hand, for half a second, then close
    #[arg(long, value_name = "FILE.png")]
    pub screenshot: Option<PathBuf>,
}

/// Why there is no window, or no more.
#[derive(Debug, thiserror::Error)]
pub enum WindowError {
    /// No display to open a window on.
    #[error(
        "no display for a window ({0}); without one, `film` records the live face and `render` draws a feed file, or run this under `xvfb-run -a`"
    )]
    NoDisplay(String),
    /// The system opens no window.
    #[error("the window cannot be opened: {0}")]
    Window(String),
    /// The window cannot be drawn into.
    #[error("the window cannot be drawn into: {0}")]
    Surface(String),
    /// The device went away again and again.
    #[error("the GPU device was lost again within {} s", LEAST_DEVICE_LIFE.as_secs())]
    DeviceLost,
    /// No adapter, no device, or a picture that does not come back.
    #[error(transparent)]
    Render(#[from] RenderError),
    /// The character cannot be drawn.
    #[error(transparent)]
    Asset(#[from] AssetError),
    /// The view is unknown.
    #[error(transparent)]
    View(#[from] ViewError),
    /// The screenshot cannot be written.
    #[error("screenshot {path:?} cannot be written: {source}")]
    Write {
        /// Where to.
        path: PathBuf,
        /// Why not.
        source: image::ImageError,
    },
    /// No live face came for the screenshot.
    #[error("no screenshot: no live face within {} s ({status})", SCREENSHOT_PATIENCE.as_secs())]
    NeverLive {
        /// How things stood at the end.
        status: String,
    },
}

/// Size of the window when it opens, points.
const WINDOW_SIZE: [f64; 2] = [1120.0, 760.0];
/// Smallest window that has room for the panel and a face, points.
const LEAST_WINDOW_SIZE: [f64; 2] = [480.0, 320.0];
/// Most pictures a second where the display does not set the pace itself: some drivers, and displays that are none, do not
/// wait for it.
const MAX_FPS: f64 = 120.0;
/// How much faster than the display the window may draw: the display sets the pace, this only bounds it where it does not.
const FASTER_THAN_DISPLAY: f64 = 1.5;
/// A device that is lost again sooner than this will be lost for ever.
const LEAST_DEVICE_LIFE: Duration = Duration::from_secs(5);
/// How often a window in which nothing moves is drawn, for the numbers and the seconds that count down.
const AT_REST: Duration = Duration::from_millis(250);
/// How long the face must have been live before it is photographed: longer than the blend from rest.
const LIVE_BEFORE_SCREENSHOT: Duration = Duration::from_millis(500);
/// How long a screenshot waits for a live face.
const SCREENSHOT_PATIENCE: Duration = Duration::from_secs(30);

/// The link's thread has something new.
#[derive(Debug)]
struct Wake;

/// Opens the window and shows the room until it is closed.
///
/// Until the server names another character the default one is drawn.
pub fn run(args: ViewArgs) -> Result<(), WindowError> {
    let asset = CharacterAsset::from_glb(DEFAULT_CHARACTER_GLB)?;
    let character = Arc::clone(&asset.character);
    let mut switches = Switches::new(&character);
    switches.show(ViewMode::parse(&args.view, &character)?);
    if args.by_hand {
        switches.hand.is_on = true;
        switches.page = Page::Hand;
    }
    let event_loop = EventLoop::<Wake>::with_user_event().build().map_err(|error| WindowError::NoDisplay(plain_words(&error)))?;
    let proxy = event_loop.create_proxy();
    // The event loop is gone only when the window is.
    let wake = move || drop(proxy.send_event(Wake));
    let token = args.watch.token.clone().token();
    // Recordings stay with the node that made them: the first one is asked.
    let remote = Remote::open(args.watch.servers.first(), &args.watch.room, &args.watch.trust, token, wake.clone());
    let mut app = App {
        remote,
        spectator: Spectator::open(args.watch, Arc::clone(&character), wake),
        switches,
        hand_face: HandFace::default(),
        character,
        glb: Cow::Borrowed(DEFAULT_CHARACTER_GLB),
        asset: Some(asset),
        gpu: None,
        device_since: Instant::now(),
        rates: Rates::default(),
        pictures: 0,
        next_at: Instant::now(),
        is_occluded: false,
        is_surface_hidden: false,
        opened_at: Instant::now(),
        live_since: None,
        screenshot: args.screenshot,
        failure: None,
    };
    event_loop.run_app(&mut app).map_err(|error| WindowError::Window(error.to_string()))?;
    app.failure.map_or(Ok(()), Err)
}

/// winit's message without the place in its source.
fn plain_words(error: &winit::error::EventLoopError) -> String {
    let text = error.to_string();
    match text.split_once(": ") {
        Some((place, words)) if place.starts_with("os error at ") => words.trim_end_matches('.').to_owned(),
        _ => text,
    }
}

struct App {
    spectator: Spectator,
    /// Of the room's player, where it has one.
    remote: Remote,
    switches: Switches,
    hand_face: HandFace,
    /// The character drawn.
    character: Arc<Character>,
    /// Its file: a device that is lost takes the decoded character with it, which is ten times as large.
    glb: Cow<'static, [u8]>,
    /// The decoded character, until there is a device to upload it to.
    asset: Option<CharacterAsset>,
    gpu: Option<GpuWindow>,
    /// When the device was opened.
    device_since: Instant,
    rates: Rates,
    /// Pictures shown.
    pictures: u64,
    /// When the next picture is due.
    next_at: Instant,
    /// The system says that nobody can see the window.
    is_occluded: bool,
    /// The surface gave nothing to draw into, as nobody can see it.
    is_surface_hidden: bool,
    opened_at: Instant,
    live_since: Option<Instant>,
    screenshot: Option<PathBuf>,
    failure: Option<WindowError>,
}

impl App {
    fn open(&mut self, event_loop: &ActiveEventLoop) -> Result<(), WindowError> {
        let attributes = Window::default_attributes()
            .with_title(format!("Rhytid · {}", self.spectator.room()))
            .with_inner_size(LogicalSize::new(WINDOW_SIZE[0], WINDOW_SIZE[1]))
            .with_min_inner_size(LogicalSize::new(LEAST_WINDOW_SIZE[0], LEAST_WINDOW_SIZE[1]));
        let window = event_loop.create_window(attributes).map_err(|error| WindowError::Window(error.to_string()))?;
        self.open_device(event_loop, Arc::new(window))
    }

    fn open_device(&mut self, event_loop: &ActiveEventLoop, window: Arc<Window>) -> Result<(), WindowError> {
        let asset = match self.asset.take() {
            Some(asset) => asset,
            None => CharacterAsset::from_glb(&self.glb)?,
        };
        self.gpu = Some(GpuWindow::new(event_loop, window, &asset)?);
        self.device_since = Instant::now();
        Ok(())
    }

    /// Everything on the device anew, in the same window.
    fn reopen_device(&mut self, event_loop: &ActiveEventLoop) -> Result<(), WindowError> {
        if self.device_since.elapsed() < LEAST_DEVICE_LIFE {
            return Err(WindowError::DeviceLost);
        }
        match self.gpu.take() {
            Some(gpu) => self.open_device(event_loop, gpu.into_window()),
            None => Ok(()),
        }
    }

    /// Nobody can see the window, whoever says so.
    fn is_hidden(&self) -> bool {
        self.is_occluded || self.is_surface_hidden
    }

    /// Shortest time between two pictures.
    fn pace(&self) -> Duration {
        let display = self.gpu.as_ref().and_then(|gpu| gpu.window().current_monitor()?.refresh_rate_millihertz());
        let most = display.map_or(MAX_FPS, |millihertz| MAX_FPS.max(FASTER_THAN_DISPLAY * f64::from(millihertz) / 1e3));
        Duration::from_secs_f64(1.0 / most)
    }

    fn draw(&mut self, event_loop: &ActiveEventLoop) -> Result<(), WindowError> {
        let begun_at = Instant::now();
        let Some(gpu) = &mut self.gpu else { return Ok(()) };
        let canvas = gpu.acquire()?;
        if let Canvas::DeviceLost = canvas {
            self.next_at = begun_at;
            return self.reopen_device(event_loop);
        }
        // After the wait for the canvas: what is shown shall be as new as can be.
        let now = Instant::now();
        let (character, switches, file) = (&mut self.character, &mut self.switches, &mut self.glb);
        self.spectator.update(|glb| {
            let new = CharacterAsset::from_glb(&glb).map_err(|error| error.to_string())?;
            gpu.change_character(&new);
            switches.change_character(&new.character);
            *file = Cow::Owned(glb);
            *character = Arc::clone(&new.character);
            Ok(new.character)
        });
        let streamed = self.spectator.sample(now).clone();
        let hand = switches.hand.clone();
        let is_by_hand = hand.is_on;
        let by_hand = is_by_hand.then(|| self.hand_face.frame(character, &hand));
        let frame = by_hand.as_ref().unwrap_or(&streamed);
        if is_by_hand && cfg!(not(feature = "embedded")) {
            switches.draw.deform = Deformation::Shapes;
        }
        let status = self.spectator.status(now);
        let link = self.spectator.link_stats();
        let since_opened = now.saturating_duration_since(self.opened_at);
        self.rates.pictures.note(since_opened, self.pictures as f64);
        self.rates.packets.note(since_opened, link.packets as f64);
        self.rates.bytes.note(since_opened, link.bytes as f64);
        self.live_since = if status.kind == StatusKind::Live || is_by_hand { self.live_since.or(Some(now)) } else { None };

        let adapter = gpu.adapter_name().to_owned();
        let known = self.remote.known();
        let scene = Scene {
            character,
            known: &known,
            frame,
            streamed: &streamed,
            status: &status,
            room: self.spectator.room().as_str(),
            link,
            playout: self.spectator.playout_stats(),
            rates: &self.rates,
            since_opened,
            zone_bytes: gpu.zone_bytes(),
            adapter: &adapter,
            face: gpu.face_id(),
        };
        if self.screenshot.is_some() && self.live_since.is_some_and(|since| now - since >= LIVE_BEFORE_SCREENSHOT) {
            let picture = gpu.screenshot(&scene, switches)?;
            let path = self.screenshot.take().unwrap_or_default();
            switches.is_quitting = true;
            return picture.save(&path).map_err(|source| WindowError::Write { path, source });
        }
        if self.screenshot.is_some() && now - self.opened_at > SCREENSHOT_PATIENCE {
            return Err(WindowError::NeverLive { status: format!("{}: {}", status.headline, status.detail) });
        }
        self.is_surface_hidden = matches!(canvas, Canvas::Hidden);
        // The stream goes on, but nothing of it shows while the face is posed by hand.
        let mut is_moving = self.spectator.is_moving() && !is_by_hand;
        if let Canvas::Ready(canvas) = canvas {
            gpu.draw(canvas, &scene, switches);
            self.pictures += 1;
            // What the sliders were moved to while this picture was laid out shows in the next one.
            is_moving |= gpu.is_panel_moving() || switches.hand != hand;
            switches.play_bar.words.drain(..).for_each(|word| self.remote.say(word));
        } else {
            is_moving = true;
        }
        let pause = if is_moving && !self.is_hidden() { self.pace() } else { AT_REST };
        self.next_at = begun_at + pause;
        Ok(())
    }

    fn fail(&mut self, error: WindowError, event_loop: &ActiveEventLoop) {
        self.failure.get_or_insert(error);
        event_loop.exit();
    }
}

impl ApplicationHandler<Wake> for App {
    fn resumed(&mut self, event_loop: &ActiveEventLoop) {
        if self.gpu.is_none()
            && let Err(error) = self.open(event_loop)
        {
            self.fail(error, event_loop);
        }
    }

    fn user_event(&mut self, _: &ActiveEventLoop, Wake: Wake) {
        // While the face moves it is drawn anyway; a window at rest wakes up.
        if !self.is_hidden() && !self.spectator.is_moving() {
            self.next_at = Instant::now();
        }
    }

    fn window_event(&mut self, event_loop: &ActiveEventLoop, _: WindowId, event: WindowEvent) {
        let Some(gpu) = &mut self.gpu else { return };
        if gpu.on_event(&event) {
            self.next_at = self.next_at.min(Instant::now() + Duration::from_secs_f64(1.0 / MAX_FPS));
        }
        match event {
            WindowEvent::CloseRequested => event_loop.exit(),
            WindowEvent::Resized(size) => {
                gpu.resize(size.width, size.height);
                self.next_at = Instant::now();
            }
            WindowEvent::Occluded(is_occluded) => {
                self.is_occluded = is_occluded;
                self.next_at = Instant::now();
            }
            WindowEvent::RedrawRequested => {
                if let Err(error) = self.draw(event_loop) {
                    self.fail(error, event_loop);
                }
                if self.switches.is_quitting {
                    event_loop.exit();
                }
            }
            _ => {}
        }
    }

    fn about_to_wait(&mut self, event_loop: &ActiveEventLoop) {
        if let Some(gpu) = &self.gpu
            && Instant::now() >= self.next_at
        {
            gpu.window().request_redraw();
            // Where the system draws nothing (a minimised window), ask again later instead of at once.
            self.next_at = Instant::now() + AT_REST;
        }
        event_loop.set_control_flow(ControlFlow::WaitUntil(self.next_at));
    }
}
