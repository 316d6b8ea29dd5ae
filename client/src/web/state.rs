//! Plain objects for the page's script.

use crate::renderer::RenderFrame;
use js_sys::{Float32Array, Object, Reflect};
use rhytid_shared::FaceFrame;
use wasm_bindgen::JsValue;

fn number(value: f64) -> JsValue {
    JsValue::from_f64(value)
}

fn set(object: &Object, name: &str, value: &JsValue) {
    // Setting a property of a fresh plain object cannot fail.
    let _ = Reflect::set(object, &name.into(), value);
}

/// How things stand.
pub(super) struct Stats {
    pub state: &'static str,
    pub fps: f64,
    pub packets: f64,
    pub bytes: f64,
    pub face: bool,
    /// From a packet's arrival to the screen.
    pub latency_ms: f64,
    pub jitter_ms: f64,
    pub draw_ms: f64,
    pub num_garbage: f64,
    pub underruns: f64,
    pub gpu_bytes: f64,
}

impl Stats {
    pub fn to_js(&self) -> JsValue {
        let object = Object::new();
        set(&object, "state", &self.state.into());
        set(&object, "face", &self.face.into());
        for (name, value) in [
            ("fps", self.fps),
            ("packets", self.packets),
            ("bytesPerSecond", self.bytes),
            ("latencyMs", self.latency_ms),
            ("jitterMs", self.jitter_ms),
            ("drawMs", self.draw_ms),
            ("garbage", self.num_garbage),
            ("underruns", self.underruns),
            ("gpuBytes", self.gpu_bytes),
        ] {
            set(&object, name, &number(value));
        }
        object.into()
    }
}

/// A picture's face as arrays; `newest` is the frame that came last.
pub(super) fn frame_to_js(shown: &RenderFrame, newest: Option<&FaceFrame>) -> JsValue {
    let array = |values: &[f32]| JsValue::from(Float32Array::from(values));
    let object = Object::new();
    set(&object, "t", &number(newest.map_or(0.0, |frame| frame.captured_at_micros as f64 / 1e6)));
    set(&object, "seq", &number(newest.map_or(0.0, |frame| f64::from(frame.seq))));
    set(&object, "session", &number(newest.map_or(0.0, |frame| f64::from(frame.session))));
    set(&object, "face", &newest.is_some_and(|frame| frame.face).into());
    let points: Vec<f32> = shown.points.iter().flat_map(|point| point.to_array()).collect();
    set(&object, "bones", &array(&points));
    set(&object, "influence", &array(&shown.influences));
    set(&object, "zones", &array(&shown.zones));
    set(&object, "shapes", &array(shown.shapes.as_ref().map_or(&[], |shapes| &shapes[..])));
    let head = [shown.head.rotation.to_array().to_vec(), shown.head.position.to_array().to_vec()].concat();
    set(&object, "head", &array(&head));
    object.into()
}
