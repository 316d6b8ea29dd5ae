//! The lights of a set-up: a soft key that makes furrows readable, a fill, two rims, and what lies all round.

use super::uniforms::Light;
use glam::camera::rh::{proj, view};
use glam::{Mat4, Vec3, Vec4};

/// A set-up of lights.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Hash)]
pub enum Studio {
    /// Key from above on the character's right, fill opposite, two rims: a portrait.
    #[default]
    Portrait,
    /// A low warm key from behind on the character's left, a cool sky in front: ears and nostrils glow.
    Sunset,
}

/// A light far away: direction towards it (any length), linear RGB, strength.
type Lamp = ([f32; 3], [f32; 3], f32);

/// A panel of the room: direction of its middle (any length), cosines of the angles at which it has faded to nothing and
/// stands in full, linear RGB.
struct Panel {
    direction: [f32; 3],
    edge: [f32; 2],
    radiance: [f32; 3],
}

/// All of a set-up. Tuned by eye on the default character.
struct Plan {
    /// Key, fill, two rims.
    lamps: [Lamp; 4],
    /// Radiance from above, from all sides and from below, linear RGB: a white surface lit by it alone is this bright.
    sky: [f32; 3],
    wall: [f32; 3],
    ground: [f32; 3],
    panels: &'static [Panel],
    /// The lamp that eyes mirror, one that stands in front of them, and how much brighter than its light its box is.
    mirrored: (u32, f32),
}

const PORTRAIT: Plan = Plan {
    mirrored: (0, 14.0),
    lamps: [
        ([-0.56, 0.66, 0.70], [1.0, 0.965, 0.92], 2.10),
        ([0.70, 0.12, 0.70], [0.88, 0.94, 1.0], 0.42),
        ([0.88, 0.35, -0.72], [0.90, 0.95, 1.0], 0.70),
        ([-0.90, 0.30, -0.80], [1.0, 0.93, 0.86], 0.45),
    ],
    sky: [0.20, 0.21, 0.235],
    wall: [0.135, 0.135, 0.145],
    ground: [0.105, 0.090, 0.082],
    panels: &[
        Panel { direction: [0.0, 1.0, 0.35], edge: [0.55, 0.85], radiance: [0.55, 0.56, 0.60] },
        Panel { direction: [1.0, 0.25, 0.35], edge: [0.80, 0.95], radiance: [0.50, 0.55, 0.62] },
        Panel { direction: [-1.0, 0.20, 0.10], edge: [0.84, 0.96], radiance: [0.55, 0.50, 0.46] },
    ],
};

const SUNSET: Plan = Plan {
    mirrored: (1, 36.0),
    lamps: [
        ([0.62, 0.30, -0.80], [1.0, 0.74, 0.48], 2.4),
        ([-0.70, 0.35, 0.60], [0.66, 0.78, 1.0], 0.80),
        ([-0.90, 0.10, -0.50], [1.0, 0.66, 0.46], 0.55),
        ([0.20, 0.95, -0.30], [0.80, 0.88, 1.0], 0.35),
    ],
    sky: [0.21, 0.26, 0.35],
    wall: [0.20, 0.19, 0.21],
    ground: [0.14, 0.105, 0.085],
    panels: &[
        Panel { direction: [-0.5, 0.6, 0.7], edge: [0.55, 0.90], radiance: [0.42, 0.52, 0.70] },
        Panel { direction: [0.9, 0.05, -0.3], edge: [0.75, 0.97], radiance: [0.95, 0.55, 0.28] },
    ],
};

impl Studio {
    /// Every set-up.
    pub const ALL: [Self; 2] = [Self::Portrait, Self::Sunset];

    /// Its name on command lines.
    pub fn name(self) -> &'static str {
        match self {
            Self::Portrait => "portrait",
            Self::Sunset => "sunset",
        }
    }

    fn plan(self) -> &'static Plan {
        match self {
            Self::Portrait => &PORTRAIT,
            Self::Sunset => &SUNSET,
        }
    }

    /// Unit vector towards the key light, world space; `turn` radians about +Y.
    fn towards_key(self, turn: f32) -> Vec3 {
        glam::Quat::from_rotation_y(turn) * Vec3::from(self.plan().lamps[0].0).normalize()
    }

    /// The four lights, the key first and turned by `key_turn` radians about +Y.
    pub fn lights(self, key_turn: f32) -> [Light; 4] {
        let mut lights = self.plan().lamps.map(|(direction, colour, strength)| {
            let towards = Vec3::from(direction).normalize();
            Light { direction: towards.extend(0.0).to_array(), radiance: (Vec3::from(colour) * strength).extend(0.0).to_array() }
        });
        lights[0].direction = self.towards_key(key_turn).extend(0.0).to_array();
        lights
    }

    /// Index of the light that wet, sharp mirrors show as a soft box, and how much brighter than its light that is.
    pub fn mirrored(self) -> (u32, f32) {
        self.plan().mirrored
    }

    /// Light that comes from `direction` (unit), the lamps left out; linear RGB.
    pub fn radiance(self, direction: Vec3) -> Vec3 {
        let plan = self.plan();
        let (sky, wall, ground) = (Vec3::from(plan.sky), Vec3::from(plan.wall), Vec3::from(plan.ground));
        let up = direction.y;
        let room = if up > 0.0 { wall.lerp(sky, smoothstep(0.0, 0.8, up)) } else { wall.lerp(ground, smoothstep(0.0, 0.5, -up)) };
        plan.panels.iter().fold(room, |light, panel| {
            let share = smoothstep(panel.edge[0], panel.edge[1], direction.dot(Vec3::from(panel.direction).normalize()));
            light + Vec3::from(panel.radiance) * share
        })
    }

    /// What the key light sees: a sphere of `radius` metres round `centre` fills its shadow map.
    pub fn shadow_from_world(self, key_turn: f32, centre: Vec3, radius: f32) -> Mat4 {
        let view_from_world = view::look_at_mat4(centre + self.towards_key(key_turn) * radius * 2.0, centre, Vec3::Y);
        proj::directx::orthographic(-radius, radius, -radius, radius, radius * 0.5, radius * 3.5) * view_from_world
    }

    /// Row whose product with (world, 1) is the way in metres from the plane through `centre` along the key light.
    pub fn light_depth(self, key_turn: f32, centre: Vec3) -> Vec4 {
        let away = -self.towards_key(key_turn);
        away.extend(-away.dot(centre))
    }
}

impl std::fmt::Display for Studio {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.name())
    }
}

/// A set-up's name was none of [`Studio::ALL`].
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("light {0:?} is unknown, expected one of: portrait, sunset")]
pub struct StudioError(String);

impl std::str::FromStr for Studio {
    type Err = StudioError;

    fn from_str(text: &str) -> Result<Self, StudioError> {
        Self::ALL.into_iter().find(|studio| studio.name() == text).ok_or_else(|| StudioError(text.to_owned()))
    }
}

fn smoothstep(from: f32, to: f32, x: f32) -> f32 {
    let t = ((x - from) / (to - from)).clamp(0.0, 1.0);
    t * t * (3.0 - 2.0 * t)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shadow_map_holds_the_whole_sphere() {
        let (centre, radius) = (Vec3::new(0.1, 1.5, -0.2), 0.3);
        for studio in Studio::ALL {
            let shadow_from_world = studio.shadow_from_world(0.4, centre, radius);
            for direction in [Vec3::X, Vec3::NEG_X, Vec3::Y, Vec3::NEG_Y, Vec3::Z, Vec3::NEG_Z] {
                let clip = shadow_from_world.project_point3(centre + direction * radius);
                assert!(clip.x.abs() <= 1.001 && clip.y.abs() <= 1.001 && (0.0..=1.0).contains(&clip.z), "{clip}");
            }
        }
    }

    #[test]
    fn light_depth_grows_by_a_metre_a_metre_away_from_the_key() {
        let centre = Vec3::new(0.1, 1.5, -0.2);
        let row = Studio::Sunset.light_depth(0.3, centre);
        let away = -Studio::Sunset.towards_key(0.3);
        assert!(row.dot(centre.extend(1.0)).abs() < 1e-6);
        assert!((row.dot((centre + away * 0.07).extend(1.0)) - 0.07).abs() < 1e-6);
    }
}
