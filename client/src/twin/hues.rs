//! Twins of the false colours in `hues.wgsl`.

use glam::Vec3;

/// Twin of `hue_of`: the hue of number `i` of many, display values.
pub fn hue_of(i: usize) -> Vec3 {
    let turn = (i as f32 * 0.618_034 + 0.02).fract();
    let channel = |shift: f32| 0.15 + 0.8 * (((turn + shift).fract() * 6.0 - 3.0).abs() - 1.0).clamp(0.0, 1.0);
    Vec3::new(channel(0.0), channel(2.0 / 3.0), channel(1.0 / 3.0))
}

/// Twin of `heat`: blue over green to red from 0 to 1, display values.
pub fn heat(value: f32) -> Vec3 {
    let x = value.clamp(0.0, 1.0);
    Vec3::new(2.0 * x - 0.6, 1.15 - (2.4 * x - 1.2).abs(), 1.1 - 2.4 * x).clamp(Vec3::ZERO, Vec3::ONE)
}

/// Twin of `over_grey`: `cover` of a colour over the grey of a surface that faces the camera by the cosine `facing`.
pub fn over_grey(facing: f32, colour: Vec3, cover: f32) -> Vec3 {
    let grey = 0.18 + 0.52 * facing.clamp(0.0, 1.0);
    Vec3::splat(grey).lerp(colour * (0.45 + 0.55 * grey / 0.7), cover.clamp(0.0, 1.0))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn neighbours_differ_and_heat_rises_from_blue_to_red() {
        for i in 0..64 {
            assert!(hue_of(i).distance(hue_of(i + 1)) > 0.4, "{i}");
        }
        let [cold, hot] = [heat(0.0), heat(1.0)];
        assert!(cold.z > 0.9 && cold.x == 0.0 && hot.x == 1.0 && hot.z == 0.0);
        assert_eq!(over_grey(1.0, hot, 0.0), Vec3::splat(0.7));
    }
}
