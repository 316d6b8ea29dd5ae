//! Twin of the blood in `skin.wgsl`.

use glam::Vec3;

/// Optical density a unit of haemoglobin adds to red, green and blue (the direction of Tsumura's separation of skin images
/// into melanin and haemoglobin, 1999).
pub const HAEMOGLOBIN: Vec3 = Vec3::new(0.2988, 0.6838, 0.6657);

/// Twin of `with_blood`: linear RGB of skin that holds `change` more haemoglobin.
pub fn with_blood(albedo: Vec3, change: f32) -> Vec3 {
    albedo * (HAEMOGLOBIN * -change).exp()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn more_blood_matches_the_worked_numbers() {
        let flushed = with_blood(Vec3::new(0.55, 0.35, 0.27), 0.3);
        assert!((flushed - Vec3::new(0.50284314, 0.28508665, 0.22112142)).abs().max_element() < 1e-7, "{flushed}");
        assert_eq!(with_blood(flushed, 0.0), flushed);
    }
}
