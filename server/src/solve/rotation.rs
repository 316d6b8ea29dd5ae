//! The few rotations the solve needs, in f64 over `libm`: the standard library's trigonometry differs between platforms.

use glam::{DMat3, DQuat, DVec3, Quat, Vec3};

/// Rotation by the vector's length in radians about its direction.
pub(super) fn from_vector(v: DVec3) -> DQuat {
    let angle = v.length();
    // sin(x/2)/x by its series where the quotient loses its bits.
    let factor = if angle < 1e-6 { 0.5 - angle * angle / 48.0 } else { libm::sin(0.5 * angle) / angle };
    DQuat::from_xyzw(v.x * factor, v.y * factor, v.z * factor, libm::cos(0.5 * angle))
}

/// The inverse of [`from_vector`], of length at most π.
pub(super) fn to_vector(q: DQuat) -> DVec3 {
    let q = if q.w < 0.0 { -q } else { q };
    let axis = DVec3::new(q.x, q.y, q.z);
    let sin = axis.length();
    let factor = if sin < 1e-9 { 2.0 } else { 2.0 * libm::atan2(sin, q.w) / sin };
    axis * factor
}

/// The matrix of a unit quaternion.
pub(super) fn to_matrix(q: DQuat) -> DMat3 {
    let (x, y, z, w) = (q.x, q.y, q.z, q.w);
    DMat3::from_cols(
        DVec3::new(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y)),
        DVec3::new(2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x)),
        DVec3::new(2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)),
    )
}

/// The vector turned by the unit quaternion.
pub(super) fn rotate(q: DQuat, v: DVec3) -> DVec3 {
    let axis = DVec3::new(q.x, q.y, q.z);
    let twice = axis.cross(v) * 2.0;
    v + twice * q.w + axis.cross(twice)
}

/// First `pitch` about +X (positive turns +Z towards -Y), then `yaw` about +Y (positive turns +Z towards +X), radians.
pub(super) fn from_pitch_yaw(pitch: f64, yaw: f64) -> DQuat {
    let (sp, cp) = (libm::sin(0.5 * pitch), libm::cos(0.5 * pitch));
    let (sy, cy) = (libm::sin(0.5 * yaw), libm::cos(0.5 * yaw));
    // (0, sy, 0, cy) * (sp, 0, 0, cp)
    DQuat::from_xyzw(cy * sp, sy * cp, -sy * sp, cy * cp)
}

/// Pitch and yaw, as [`from_pitch_yaw`] takes them, that turn the direction `from` into the direction `to` as far as
/// those two can. The pitch is the one nearer to zero.
pub(super) fn pitch_yaw_between(from: DVec3, to: DVec3) -> (f64, f64) {
    let (length_from, length_to) = (from.length(), to.length());
    if length_from < 1e-9 || length_to < 1e-9 {
        return (0.0, 0.0);
    }
    let (from, to) = (from / length_from, to / length_to);
    // Yaw keeps y: y cos p - z sin p = to.y, that is r cos(p + phase) = to.y.
    let r = (from.y * from.y + from.z * from.z).sqrt();
    if r < 1e-9 {
        return (0.0, 0.0);
    }
    let phase = libm::atan2(from.z, from.y);
    let swing = libm::acos((to.y / r).clamp(-1.0, 1.0));
    let pitch =
        [wrap(swing - phase), wrap(-swing - phase)].into_iter().fold(f64::INFINITY, |best, p| if p.abs() < best.abs() { p } else { best });
    let (sin, cos) = (libm::sin(pitch), libm::cos(pitch));
    let z = from.y * sin + from.z * cos;
    let yaw = wrap(libm::atan2(to.x, to.z) - libm::atan2(from.x, z));
    (pitch, yaw)
}

/// Smallest rotation that turns the direction `from` into the direction `to`.
pub(super) fn shortest_arc(from: Vec3, to: Vec3) -> DQuat {
    let (from, to) = (from.as_dvec3(), to.as_dvec3());
    let lengths = from.length() * to.length();
    if lengths < 1e-12 {
        return DQuat::IDENTITY;
    }
    let axis = from.cross(to);
    let w = lengths + from.dot(to);
    let norm = (axis.length_squared() + w * w).sqrt();
    // Opposite directions have no shortest arc; no bone of a face turns half way round.
    if norm < 1e-9 * lengths { DQuat::IDENTITY } else { DQuat::from_xyzw(axis.x / norm, axis.y / norm, axis.z / norm, w / norm) }
}

/// For the wire.
pub(super) fn to_f32(q: DQuat) -> Quat {
    Quat::from_xyzw(q.x as f32, q.y as f32, q.z as f32, q.w as f32)
}

fn wrap(angle: f64) -> f64 {
    use std::f64::consts::{PI, TAU};
    if angle > PI {
        angle - TAU
    } else if angle < -PI {
        angle + TAU
    } else {
        angle
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn vector_and_quaternion_are_inverse() {
        for v in [DVec3::ZERO, DVec3::new(1e-8, 0.0, -1e-9), DVec3::new(0.3, -0.2, 0.9), DVec3::new(0.0, 3.0, 0.0)] {
            assert!((to_vector(from_vector(v)) - v).length() < 1e-12, "{v}");
            assert!((to_vector(-from_vector(v)) - v).length() < 1e-12, "{v}: both signs are one rotation");
        }
    }

    #[test]
    fn matrix_and_quaternion_turn_alike() {
        let q = from_vector(DVec3::new(0.3, -0.2, 0.9));
        let v = DVec3::new(0.1, -0.4, 0.7);
        assert!((to_matrix(q) * v - rotate(q, v)).length() < 1e-12);
    }

    #[test]
    fn positive_pitch_looks_down_and_positive_yaw_to_the_left() {
        let down = rotate(from_pitch_yaw(0.3, 0.0), DVec3::Z);
        assert!(down.y < -0.29 && down.x == 0.0, "{down}");
        let left = rotate(from_pitch_yaw(0.0, 0.3), DVec3::Z);
        assert!(left.x > 0.29 && left.y == 0.0, "{left}");
    }

    #[test]
    fn pitch_and_yaw_are_found_again() {
        let chin = DVec3::new(0.001, -0.08, 0.08);
        for (pitch, yaw) in [(0.0, 0.0), (0.35, 0.0), (0.2, 0.05), (-0.05, -0.08)] {
            let (p, y) = pitch_yaw_between(chin, rotate(from_pitch_yaw(pitch, yaw), chin));
            assert!((p - pitch).abs() < 1e-9 && (y - yaw).abs() < 1e-9, "{pitch} {yaw}: {p} {y}");
        }
    }

    #[test]
    fn shortest_arc_turns_from_into_to() {
        let (from, to) = (Vec3::new(0.0, -0.08, 0.08), Vec3::new(0.01, -0.1, 0.05));
        let turned = rotate(shortest_arc(from, to), from.as_dvec3());
        assert!(turned.normalize().distance(to.as_dvec3().normalize()) < 1e-7);
    }
}
