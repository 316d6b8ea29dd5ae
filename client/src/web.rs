//! The browser's client: one canvas that shows one room's face. The page's script owns sockets, controls and the clock; what
//! comes over the socket goes in here, pictures come out. Everything between is what the window does, too.

mod canvas;
mod state;

use crate::asset::CharacterAsset;
use crate::playout::{Playout, PlayoutState};
use crate::rate::Rate;
use crate::renderer::{BlendMode, Camera, Deformation, DrawSettings, RenderFrame, Studio, ViewMode, WrinkleSystem};
use canvas::Canvas;
use rhytid_shared::FaceFrame;
use rhytid_shared::packet::{Decoder, PacketLayout};
use rhytid_shared::view::{PROTOCOL_VERSION, ViewHello, ViewMessage};
use sha2::{Digest, Sha256};
use state::{Stats, frame_to_js};
use std::time::Duration;
use wasm_bindgen::prelude::*;

/// Longest time that is believed of a page's clock, milliseconds (285 years).
const MAX_MS: f64 = 9e12;

/// A canvas that shows a room's face.
#[wasm_bindgen]
pub struct Viewer {
    canvas: Canvas,
    scene: Option<Scene>,
    arriving: Option<Arriving>,
    hello: Option<ViewHello>,
    decoder: Option<(Decoder, FaceFrame)>,
    /// The socket is there.
    is_linked: bool,
    packets: Rate,
    bytes: Rate,
    pictures: Rate,
    /// Packets that could not be read.
    num_garbage: u64,
    /// What the last picture took to record and submit, milliseconds.
    draw_ms: f64,
    /// The page's clock when it was last heard of, milliseconds.
    now_ms: f64,
    newest: Option<FaceFrame>,
    is_transparent: bool,
}

/// A character whose pictures are still to be decoded.
struct Arriving {
    glb: Vec<u8>,
    sha256: String,
    asset: CharacterAsset,
}

/// What hangs on the character.
struct Scene {
    playout: Playout,
    /// What the last picture shows.
    shown: RenderFrame,
    settings: DrawSettings,
    sha256: String,
    /// Something but the face has changed since the last picture.
    is_stale: bool,
}

#[wasm_bindgen(start)]
fn start() {
    std::panic::set_hook(Box::new(|info| web_sys::console::error_1(&info.to_string().into())));
}

fn error(message: impl std::fmt::Display) -> JsError {
    JsError::new(&message.to_string())
}

fn moment(now_ms: f64) -> Duration {
    Duration::from_secs_f64(if now_ms.is_finite() { now_ms.clamp(0.0, MAX_MS) } else { 0.0 } / 1000.0)
}

#[wasm_bindgen]
impl Viewer {
    /// Opens `canvas` for drawing. Of `options`, `backend` is `auto` (where it is missing), `webgpu` or `webgl`; with a true
    /// `transparent` the page shows through where no head is.
    pub async fn start(canvas: web_sys::HtmlCanvasElement, options: JsValue) -> Result<Viewer, JsError> {
        let option = |name: &str| js_sys::Reflect::get(&options, &name.into()).ok().filter(|value| !value.is_undefined());
        let backend = option("backend").and_then(|backend| backend.as_string()).unwrap_or_else(|| "auto".into());
        let transparent = option("transparent").is_some_and(|transparent| transparent.is_truthy());
        let canvas = Canvas::open(canvas, &backend, transparent).await.map_err(error)?;
        Ok(Self {
            canvas,
            scene: None,
            arriving: None,
            hello: None,
            decoder: None,
            is_linked: false,
            packets: Rate::default(),
            bytes: Rate::default(),
            pictures: Rate::default(),
            num_garbage: 0,
            draw_ms: 0.0,
            now_ms: 0.0,
            newest: None,
            is_transparent: transparent,
        })
    }

    /// `WebGPU` or `WebGL2`.
    pub fn backend(&self) -> String {
        self.canvas.backend().to_owned()
    }

    /// What draws, in the driver's words.
    pub fn adapter(&self) -> String {
        self.canvas.adapter().to_owned()
    }

    /// Why nothing can be drawn any more, or nothing: the page must open another viewer then.
    pub fn failure(&self) -> Option<String> {
        self.canvas.failure()
    }

    /// First half of making the character of a `.glb` the one that is drawn: all but its pictures. Where a hello has come it must
    /// be the one that names. What draws is being compiled when this returns; let the browser do something of its own then.
    #[wasm_bindgen(js_name = beginCharacter)]
    pub fn begin_character(&mut self, glb: Vec<u8>) -> Result<(), JsError> {
        let sha256: String = Sha256::digest(&glb).iter().map(|byte| format!("{byte:02x}")).collect();
        if let Some(hello) = &self.hello
            && hello.character.sha256 != sha256
        {
            return Err(error(format!("the character that came has SHA-256 {sha256}, the server names {}", hello.character.sha256)));
        }
        let asset = CharacterAsset::outline(&glb).map_err(error)?;
        // Whoever sees a face already goes on seeing it till the next one is there.
        if self.scene.is_none() {
            let settings = DrawSettings { is_transparent: self.is_transparent, ..DrawSettings::new(Camera::front(&asset.character)) };
            self.canvas.upload(&asset);
            self.canvas.rehearse(&settings, &RenderFrame::at_rest(&asset.character));
        }
        self.arriving = Some(Arriving { glb, sha256, asset });
        Ok(())
    }

    /// The second half: pictures are decoded, and the character is drawn from now on.
    #[wasm_bindgen(js_name = finishCharacter)]
    pub fn finish_character(&mut self) -> Result<(), JsError> {
        let Some(Arriving { glb, sha256, mut asset }) = self.arriving.take() else { return Err(error("no character has begun to come")) };
        asset.fill(&glb).map_err(error)?;
        let character = &asset.character;
        let mut settings = DrawSettings::new(Camera::front(character));
        settings.is_transparent = self.is_transparent;
        let playout = Playout::new(character);
        self.canvas.upload(&asset);
        self.scene = Some(Scene { playout, shown: RenderFrame::at_rest(character), settings, sha256, is_stale: true });
        Ok(())
    }

    /// True where the character that the hello named is there already.
    #[wasm_bindgen(js_name = hasCharacter)]
    pub fn has_character(&self) -> bool {
        match (&self.scene, &self.hello) {
            (Some(scene), Some(hello)) => scene.sha256 == hello.character.sha256,
            _ => false,
        }
    }

    /// Takes a view socket's first message.
    pub fn hello(&mut self, text: &str) -> Result<(), JsError> {
        let Ok(ViewMessage::Hello(hello)) = serde_json::from_str(text) else {
            return Err(error("the server's first message is no hello"));
        };
        if hello.version != PROTOCOL_VERSION {
            return Err(error(format!("the server speaks version {}, this page version {PROTOCOL_VERSION}", hello.version)));
        }
        let layout =
            PacketLayout::try_from(&hello.character).map_err(|problem| error(format!("the server's hello is wrong: {problem}")))?;
        let frame = layout.frame_at_rest();
        self.decoder = Some((Decoder::new(layout), frame));
        if let Some(scene) = &mut self.scene {
            scene.playout.reconnected(moment(self.now_ms));
        }
        self.hello = Some(hello);
        self.is_linked = true;
        Ok(())
    }

    /// Takes a packet. False where it makes no sense; nothing else is lost by that.
    pub fn packet(&mut self, bytes: &[u8], now_ms: f64) -> bool {
        self.now_ms = now_ms;
        self.packets.add(moment(now_ms), 1.0);
        self.bytes.add(moment(now_ms), bytes.len() as f64);
        let Some((decoder, frame)) = &mut self.decoder else { return false };
        if decoder.decode(bytes, frame).is_err() {
            self.num_garbage += 1;
            return false;
        }
        if let Some(scene) = &mut self.scene {
            scene.playout.push(frame, moment(now_ms));
        }
        self.newest = Some(frame.clone());
        true
    }

    /// The socket is gone; the face is held, then eased to rest.
    #[wasm_bindgen(js_name = linkLost)]
    pub fn link_lost(&mut self) {
        self.is_linked = false;
        self.decoder = None;
    }

    /// The canvas has another size, device pixels.
    pub fn resize(&mut self, width: u32, height: u32) {
        self.canvas.resize(width, height);
        self.touch();
    }

    /// Draws the face at `now_ms`, on the same clock as packets' arrivals, where there is something new to show.
    pub fn draw(&mut self, now_ms: f64) -> Result<bool, JsError> {
        self.now_ms = now_ms;
        let Some(scene) = &mut self.scene else { return Ok(false) };
        let now = moment(now_ms);
        scene.shown.clone_from(scene.playout.sample(now));
        if !scene.playout.is_moving() && !scene.is_stale {
            return Ok(false);
        }
        let before = js_sys::Date::now();
        if !self.canvas.draw(&scene.settings, &scene.shown).map_err(error)? {
            return Ok(false);
        }
        scene.is_stale = false;
        self.draw_ms = js_sys::Date::now() - before;
        self.pictures.add(moment(now_ms), 1.0);
        Ok(true)
    }

    /// Turns the camera by a drag, device pixels.
    pub fn orbit(&mut self, dx: f32, dy: f32) {
        let height = self.canvas.height() as f32;
        self.change(|settings| settings.camera.drag([dx, dy], height));
    }

    /// Brings the camera nearer (`factor` above 1) or farther.
    pub fn zoom(&mut self, factor: f32) {
        if factor.is_finite() && factor > 0.0 {
            self.change(|settings| settings.camera.zoom(1.0 / factor));
        }
    }

    /// Back to the front.
    #[wasm_bindgen(js_name = resetCamera)]
    pub fn reset_camera(&mut self) {
        let Some(character) = self.canvas.character() else { return };
        let camera = Camera::front(&character);
        self.change(|settings| settings.camera = camera);
    }

    /// Names of all views of the character.
    pub fn views(&self) -> Vec<String> {
        self.canvas
            .character()
            .map(|character| ViewMode::all(&character).into_iter().map(|view| view.name(&character)).collect())
            .unwrap_or_default()
    }

    /// Shows a view by its name.
    #[wasm_bindgen(js_name = setView)]
    pub fn set_view(&mut self, name: &str) -> Result<(), JsError> {
        let Some(character) = self.canvas.character() else { return Err(error("there is no character yet")) };
        let view = ViewMode::parse(name, &character).map_err(error)?;
        self.change(|settings| settings.view = view);
        Ok(())
    }

    /// Sets `wrinkles` (own, bones, zones, both, off), `light` (portrait, sunset), `deform` (bones, shapes), `blend` (pd, simple,
    /// printed), or `smooth` (on, off).
    #[wasm_bindgen(js_name = setSwitch)]
    pub fn set_switch(&mut self, name: &str, value: &str) -> Result<(), JsError> {
        match (name, value) {
            ("wrinkles", "off") => self.change(|settings| settings.wrinkles = false),
            ("wrinkles", _) => {
                let system: WrinkleSystem = value.parse().map_err(error)?;
                self.change(|settings| (settings.wrinkles, settings.system) = (true, system));
            }
            ("light", _) => {
                let studio: Studio = value.parse().map_err(error)?;
                self.change(|settings| settings.studio = studio);
            }
            ("deform", _) => {
                let deform: Deformation = value.parse().map_err(error)?;
                self.change(|settings| settings.deform = deform);
            }
            ("blend", _) => {
                let blend: BlendMode = value.parse().map_err(error)?;
                self.change(|settings| settings.blend = blend);
            }
            ("smooth", "on" | "off") => self.change(|settings| settings.is_smoothed = value == "on"),
            _ => {
                return Err(error(format!(
                    "switch {name:?} with value {value:?} is unknown, expected wrinkles, light, deform, blend or smooth"
                )));
            }
        }
        Ok(())
    }

    /// How things stand: `state`, rates a second, times in milliseconds.
    pub fn stats(&mut self) -> JsValue {
        let now_ms = self.now_ms;
        let playout = self.scene.as_ref().map(|scene| (scene.playout.state(), scene.playout.stats()));
        let state = match playout.map(|(state, _)| state) {
            _ if !self.is_linked => "offline",
            None | Some(PlayoutState::Waiting) => "waiting",
            Some(PlayoutState::Live) => "live",
            Some(PlayoutState::FaceLost) => "lost",
            Some(PlayoutState::Silent) => "silent",
            Some(PlayoutState::Idle) => "idle",
        };
        let stats = playout.map(|(_, stats)| stats).unwrap_or_default();
        Stats {
            state,
            fps: self.pictures.per_second(moment(now_ms)),
            packets: self.packets.per_second(moment(now_ms)),
            bytes: self.bytes.per_second(moment(now_ms)),
            face: self.newest.as_ref().is_some_and(|frame| frame.face),
            latency_ms: stats.delay.as_secs_f64() * 1e3,
            jitter_ms: stats.jitter.as_secs_f64() * 1e3,
            draw_ms: self.draw_ms,
            num_garbage: self.num_garbage as f64,
            underruns: stats.underruns as f64,
            gpu_bytes: self.canvas.gpu_bytes() as f64,
        }
        .to_js()
    }

    /// What the last picture shows, for plots: `t`, `seq`, `session` and `face` of the newest frame that came, and arrays `bones`
    /// (points, metres, head space), `influence` (pose-major), `zones`, `shapes` (empty where there are none) and `head` (rotation
    /// x, y, z, w and position). `null` before there is a character.
    pub fn frame(&self) -> JsValue {
        self.scene.as_ref().map_or(JsValue::NULL, |scene| frame_to_js(&scene.shown, self.newest.as_ref()))
    }
}

impl Viewer {
    fn change(&mut self, change: impl FnOnce(&mut DrawSettings)) {
        if let Some(scene) = &mut self.scene {
            change(&mut scene.settings);
        }
        self.touch();
    }

    fn touch(&mut self) {
        if let Some(scene) = &mut self.scene {
            scene.is_stale = true;
        }
    }
}
