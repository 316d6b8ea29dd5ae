//! Between two frames.

use crate::renderer::RenderFrame;
use rhytid_shared::NUM_ARKIT_SHAPES;

/// Writes `a + u (b - a)` into `out`, everything with the same `u` in `[0, 1]`: linear for points and coefficients (which
/// keeps coefficients in `[0, 1]`), normalised linear with the sign fixed for rotations. `a`, `b` and `out` are frames of
/// one character; expression weights that only one of them has fade from or to 0.
pub(super) fn mix(a: &RenderFrame, b: &RenderFrame, u: f32, out: &mut RenderFrame) {
    for ((out, a), b) in out.points.iter_mut().zip(&a.points).zip(&b.points) {
        *out = a.lerp(*b, u);
    }
    for ((out, a), b) in out.rotations.iter_mut().zip(&a.rotations).zip(&b.rotations) {
        // glam's quaternion `lerp` turns the shorter way and normalises.
        *out = a.lerp(*b, u);
    }
    for ((out, a), b) in out.influences.iter_mut().zip(&a.influences).zip(&b.influences) {
        *out = lerp(*a, *b, u);
    }
    for ((out, a), b) in out.zones.iter_mut().zip(&a.zones).zip(&b.zones) {
        *out = lerp(*a, *b, u);
    }
    for ((out, a), b) in out.stretched.iter_mut().zip(&a.stretched).zip(&b.stretched) {
        *out = lerp(*a, *b, u);
    }
    out.head.rotation = a.head.rotation.lerp(b.head.rotation, u);
    out.head.position = a.head.position.lerp(b.head.position, u);
    out.shapes = match (&a.shapes, &b.shapes) {
        (None, None) => None,
        (a, b) => {
            let none = [0.0; NUM_ARKIT_SHAPES];
            let (a, b) = (a.as_ref().unwrap_or(&none), b.as_ref().unwrap_or(&none));
            Some(std::array::from_fn(|k| lerp(a[k], b[k], u)))
        }
    };
}

fn lerp(a: f32, b: f32, u: f32) -> f32 {
    // This form gives a at 0 and b at 1 exactly, and stays within [0, 1] where both are.
    (1.0 - u) * a + u * b
}
