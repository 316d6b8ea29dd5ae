//! `view`: a window that shows a room's face live.

mod look;
mod painter;
mod panel;
mod rates;
mod switches;
mod window;

pub(crate) use look::{ACCENT, FAINT, TEXT, apply as apply_look};
pub(crate) use painter::Painter;

use crate::asset::{AssetError, CharacterAsset};
use crate::renderer::{RenderError, ViewError, ViewMode};
use crate::spectator::{Spectator, StatusKind, WatchArgs};
use panel::{Rates, Scene};
use rhytid_shared::DEFAULT_CHARACTER_GLB;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::{Duration, Instant};
use switches::Switches;
use window::{Drawn, GpuWindow};
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
    /// What is shown first: beauty, bare, split, influence, influence:POSE, normals or wireframe
    #[arg(long, value_name = "VIEW", default_value = "beauty")]
    pub view: String,
    /// Save a picture of the whole window to this PNG once the face has been live for half a second, then close
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
/// Most pictures a second where the display does not set the pace itself.
const MAX_FPS: u32 = 120;
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
    let mut switches = Switches::new(&asset.character);
    switches.show(ViewMode::parse(&args.view, &asset.character)?);
    let event_loop = EventLoop::<Wake>::with_user_event().build().map_err(|error| WindowError::NoDisplay(plain_words(&error)))?;
    let proxy = event_loop.create_proxy();
    // The event loop is gone only when the window is.
    let wake = move || drop(proxy.send_event(Wake));
    let mut app = App {
        spectator: Spectator::open(args.watch, Arc::clone(&asset.character), wake),
        switches,
        asset,
        gpu: None,
        rates: Rates::default(),
        pictures: 0,
        next_at: Instant::now(),
        is_hidden: false,
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
    switches: Switches,
    /// The character drawn.
    asset: CharacterAsset,
    gpu: Option<GpuWindow>,
    rates: Rates,
    /// Pictures shown.
    pictures: u64,
    /// When the next picture is due.
    next_at: Instant,
    /// Nobody can see the window.
    is_hidden: bool,
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
        self.gpu = Some(GpuWindow::new(event_loop, window, &self.asset)?);
        Ok(())
    }

    fn draw(&mut self) -> Result<(), WindowError> {
        let Some(gpu) = &mut self.gpu else { return Ok(()) };
        let (asset, switches) = (&mut self.asset, &mut self.switches);
        self.spectator.update(|glb| {
            let new = CharacterAsset::from_glb(glb).map_err(|error| error.to_string())?;
            gpu.change_character(&new);
            switches.change_character(&new.character);
            *asset = new;
            Ok(Arc::clone(&asset.character))
        });
        let now = Instant::now();
        let frame = self.spectator.sample(now).clone();
        let status = self.spectator.status(now);
        let link = self.spectator.link_stats();
        self.rates.pictures.note(now, self.pictures);
        self.rates.packets.note(now, link.packets);
        self.rates.bytes.note(now, link.bytes);
        self.live_since = if status.kind == StatusKind::Live { self.live_since.or(Some(now)) } else { None };

        let adapter = gpu.adapter_name().to_owned();
        let scene = Scene {
            character: &asset.character,
            frame: &frame,
            status: &status,
            room: self.spectator.room().as_str(),
            link,
            playout: self.spectator.playout_stats(),
            rates: &self.rates,
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
        let drawn = gpu.draw(&scene, switches)?;
        self.is_hidden = drawn == Drawn::Hidden;
        self.pictures += u64::from(drawn == Drawn::Shown);
        let is_moving = self.spectator.is_moving() || gpu.is_panel_moving() || drawn == Drawn::Again;
        let pause = if is_moving && !self.is_hidden { Duration::from_secs(1) / MAX_FPS } else { AT_REST };
        self.next_at = now + pause;
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
        if !self.is_hidden && !self.spectator.is_moving() {
            self.next_at = Instant::now();
        }
    }

    fn window_event(&mut self, event_loop: &ActiveEventLoop, _: WindowId, event: WindowEvent) {
        let Some(gpu) = &mut self.gpu else { return };
        if gpu.on_event(&event) {
            self.next_at = self.next_at.min(Instant::now() + Duration::from_secs(1) / MAX_FPS);
        }
        match event {
            WindowEvent::CloseRequested => event_loop.exit(),
            WindowEvent::Resized(size) => {
                gpu.resize(size.width, size.height);
                self.next_at = Instant::now();
            }
            WindowEvent::Occluded(is_hidden) => {
                self.is_hidden = is_hidden;
                self.next_at = Instant::now();
            }
            WindowEvent::RedrawRequested => {
                if let Err(error) = self.draw() {
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
