//! Where the picture is taken from.

use glam::camera::rh::{proj, view};
use glam::{Mat4, Quat, Vec3};
use rhytid_shared::Character;

/// An orbiting perspective camera. World space is the character's model space (metres, +Y up, +Z out of the face).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Camera {
    /// Point looked at, metres.
    pub target: Vec3,
    /// Turn about +Y, radians; positive moves the camera to +X, the character's left.
    pub yaw: f32,
    /// Turn upwards, radians; positive looks down on the face.
    pub pitch: f32,
    /// From the target to the eye, metres.
    pub distance: f32,
    /// Vertical field of view, radians.
    pub fovy: f32,
    /// Nearest it is brought to the target, metres: outside the head, so that no part of it is cut open.
    pub nearest: f32,
}

/// Steepest pitch: the view matrix degenerates at a right angle.
const MAX_PITCH: f32 = 1.5;
/// Farthest the eye may go, metres.
const FARTHEST: f32 = 4.0;
/// Radius of the head about the target in units of the farthest landmark's distance: the back of the head has none.
const HEAD_IN_LANDMARKS: f32 = 1.25;
/// Radians it turns for a drag over the height of the picture.
const ORBIT_PER_HEIGHT: f32 = 3.5;
/// Clip planes, metres: nothing of a bust is nearer or farther than that.
const NEAR: f32 = 0.05;
const FAR: f32 = 6.0;
/// A portrait lens: 85 mm on 36 × 24 mm film, upright, sees 24°.
const PORTRAIT_FOVY: f32 = 0.42;
/// Height of the picture in units of brow to chin: the whole head and the top of the shoulders, the face large enough for
/// a face tracker. Tuned by eye.
const PICTURE_HEIGHT_IN_FACES: f32 = 2.45;

impl Camera {
    /// From the front on the neutral head: the face in the middle, room above it, a hint of shoulders.
    pub fn front(character: &Character) -> Self {
        let marks = &character.ibug68;
        let chin = marks[8];
        let brows = (marks[19] + marks[24]) * 0.5;
        let face_height = (brows.y - chin.y).max(0.01);
        let target = Vec3::new(0.5 * (marks[36].x + marks[45].x), chin.y + 0.62 * face_height, character.head_pivot.z);
        let height = PICTURE_HEIGHT_IN_FACES * face_height;
        let depth_of_face = brows.z - target.z;
        let farthest_mark = marks.iter().map(|mark| mark.distance(target)).fold(0.0, f32::max);
        Self {
            target,
            yaw: 0.0,
            pitch: 0.0,
            distance: depth_of_face + 0.5 * height / (0.5 * PORTRAIT_FOVY).tan(),
            fovy: PORTRAIT_FOVY,
            nearest: NEAR + HEAD_IN_LANDMARKS * farthest_mark,
        }
    }

    /// Turned by a drag of the pointer, right and down, in a picture `height` high in the same unit. The face follows the
    /// pointer: the camera goes the other way.
    pub fn drag(&mut self, [right, down]: [f32; 2], height: f32) {
        let turn = ORBIT_PER_HEIGHT / height.max(1.0);
        self.orbit(-right * turn, down * turn);
    }

    /// Turned about the target, radians; the pitch stops short of the poles.
    pub fn orbit(&mut self, delta_yaw: f32, delta_pitch: f32) {
        self.yaw = (self.yaw + delta_yaw).rem_euclid(std::f32::consts::TAU);
        self.pitch = (self.pitch + delta_pitch).clamp(-MAX_PITCH, MAX_PITCH);
    }

    /// Brought nearer (`factor` < 1) or farther.
    pub fn zoom(&mut self, factor: f32) {
        self.distance = (self.distance * factor).max(self.nearest).min(FARTHEST);
    }

    /// Where the camera stands, world space.
    pub fn eye(&self) -> Vec3 {
        self.target + Quat::from_rotation_y(self.yaw) * Quat::from_rotation_x(-self.pitch) * Vec3::Z * self.distance
    }

    /// How much of wrinkles `wavelength` metres apart is drawn in a picture `height` pixels high: all of them where one
    /// covers four pixels, none below two, where they could not be told apart.
    pub fn wrinkle_fade(&self, wavelength: f32, height: u32) -> f32 {
        let metres_per_pixel = 2.0 * self.distance * (0.5 * self.fovy).tan() / height as f32;
        let t = ((wavelength / metres_per_pixel - 2.0) / 2.0).clamp(0.0, 1.0);
        t * t * (3.0 - 2.0 * t)
    }

    /// World to clip space (depth 0 at the near plane, 1 at the far plane).
    pub fn clip_from_world(&self, aspect: f32) -> Mat4 {
        let view_from_world = view::look_at_mat4(self.eye(), self.target, Vec3::Y);
        proj::directx::perspective(self.fovy, aspect, NEAR, FAR) * view_from_world
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn camera() -> Camera {
        Camera { target: Vec3::new(0.0, 1.5, 0.0), yaw: 0.0, pitch: 0.0, distance: 1.0, fovy: 0.4, nearest: 0.2 }
    }

    #[test]
    fn characters_left_is_on_the_right_of_a_frontal_picture() {
        let clip = camera().clip_from_world(1.0) * Vec3::new(0.05, 1.5, 0.0).extend(1.0);
        assert!(clip.x / clip.w > 0.1, "{clip}");
    }

    #[test]
    fn positive_yaw_goes_to_the_characters_left_and_positive_pitch_up() {
        let mut camera = camera();
        camera.orbit(0.5, 0.25);
        let eye = camera.eye();
        assert!(eye.x > 0.4 && eye.y > 1.7 && eye.z > 0.5, "{eye}");
        assert!((eye.distance(camera.target) - 1.0).abs() < 1e-6);
    }

    #[test]
    fn wrinkles_fade_where_they_cover_few_pixels() {
        for (distance, expected) in [(2.0, 1.0), (4.0, 0.51721784), (6.0, 0.00017484)] {
            let camera = Camera { distance, fovy: 30.0_f32.to_radians(), ..camera() };
            let fade = camera.wrinkle_fade(0.006, 1080);
            assert!((fade - expected).abs() < 2e-5, "{distance} m: {fade}");
        }
    }

    #[test]
    fn eye_stays_outside_the_head_from_every_side() {
        let asset = crate::CharacterAsset::from_glb(rhytid_shared::DEFAULT_CHARACTER_GLB).expect("the built-in character is whole");
        let mut camera = Camera::front(&asset.character);
        camera.zoom(1e-6);
        let chin = asset.character.ibug68[8].y;
        let vertices = asset.primitives.iter().flat_map(|primitive| &primitive.vertices).map(|vertex| Vec3::from(vertex.position));
        let head = vertices.filter(|at| at.y > chin).map(|at| at.distance(camera.target)).fold(0.0, f32::max);
        assert!(camera.distance >= head + NEAR, "{} m away, the head reaches {head} m", camera.distance);
        assert!(camera.distance < 1.6 * head + NEAR, "{} m away, the head reaches only {head} m", camera.distance);
        for _ in 0..3 {
            camera.zoom(0.5);
            assert_eq!(camera.distance, camera.nearest);
        }
        camera.zoom(1e6);
        assert_eq!(camera.distance, FARTHEST);
    }

    #[test]
    fn face_follows_a_drag() {
        let mut camera = camera();
        camera.drag([10.0, 0.0], 100.0);
        // Seen from its right, the face has turned to the right of the picture.
        assert!(camera.eye().x < 0.0, "{}", camera.eye());
    }

    #[test]
    fn orbit_never_reaches_a_pole() {
        let mut camera = camera();
        camera.orbit(0.0, 100.0);
        assert!(camera.clip_from_world(1.0).is_finite());
        assert!(camera.eye().z > 0.0);
    }
}
