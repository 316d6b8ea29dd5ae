//! Plain objects for the page's script.

use js_sys::{Float32Array, Object, Reflect};
use rhytid_shared::FaceFrame;
use wasm_bindgen::JsValue;

pub(super) fn number(value: f64) -> JsValue {
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
    pub playout_delay_ms: f64,
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
        for (name, value) in [
            ("fps", self.fps),
            ("packetsPerSecond", self.packets),
            ("bytesPerSecond", self.bytes),
            ("playoutDelayMs", self.playout_delay_ms),
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

/// A frame as arrays.
pub(super) struct FrameOut<'a>(pub &'a FaceFrame);

impl FrameOut<'_> {
    pub fn to_js(&self) -> JsValue {
        let frame = self.0;
        let array = |values: &[f32]| JsValue::from(Float32Array::from(values));
        let object = Object::new();
        set(&object, "t", &number(frame.captured_at_micros as f64 / 1e6));
        set(&object, "seq", &number(f64::from(frame.seq)));
        set(&object, "session", &number(f64::from(frame.session)));
        set(&object, "face", &frame.face.into());
        let points: Vec<f32> = frame.points.iter().flat_map(|point| point.to_array()).collect();
        set(&object, "points", &array(&points));
        set(&object, "influence", &array(&frame.influences));
        set(&object, "zones", &array(&frame.zones));
        set(&object, "shapes", &array(frame.shapes.as_ref().map_or(&[], |shapes| &shapes[..])));
        let head = [frame.head.rotation.to_array().to_vec(), frame.head.position.to_array().to_vec()].concat();
        set(&object, "head", &array(&head));
        object.into()
    }
}
