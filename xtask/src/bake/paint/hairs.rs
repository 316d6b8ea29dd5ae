//! Short hairs: strokes along the skin, drawn in the atlas.

use super::atlas::Atlas;
use super::chart::Side;
use super::features::Features;
use super::noise::{Dice, hash, lerp, noise, smoothstep};
use glam::{Vec2, Vec3};

/// What hairs leave on the skin, one value a texel of the atlas.
pub struct Hairs {
    /// How much of the texel is covered by hair, 0 to 1.
    pub cover: Vec<f32>,
    /// Lightness of that hair, about 1.
    pub tone: Vec<f32>,
}

/// One kind of hair.
struct Kind {
    /// Strokes a square millimetre where it is densest.
    density: f32,
    /// Length, mm.
    length: (f32, f32),
    /// Half width, mm.
    half_width: f32,
    /// How much a stroke covers.
    strength: f32,
}

const HEAD: Kind = Kind { density: 3.2, length: (2.4, 5.0), half_width: 0.095, strength: 0.95 };
const BROW: Kind = Kind { density: 3.4, length: (3.0, 6.0), half_width: 0.09, strength: 0.62 };
const STUBBLE: Kind = Kind { density: 1.1, length: (0.3, 0.8), half_width: 0.075, strength: 0.25 };

/// Draws all hairs.
pub fn draw(atlas: &Atlas, features: &Features) -> Hairs {
    let size = atlas.size();
    let densities = atlas.map(|texel| {
        let marks = features.marks(texel);
        [marks.hair, marks.brow, marks.beard]
    });
    let mut hairs = Hairs { cover: vec![0.0; size * size], tone: vec![1.0; size * size] };
    let whorl = whorl(features);
    for index in 0..size * size {
        let Some([hair, brow, beard]) = densities[index] else { continue };
        if hair + brow + beard <= 0.0 {
            continue;
        }
        let (x, y) = (index % size, index / size);
        let Some((texel, steps)) = atlas.texel_with_steps(x, y) else { continue };
        let area = steps[0].cross(steps[1]).length();
        let side = if texel.place.x >= 0.0 { Side::Left } else { Side::Right };
        for (salt, kind, density) in [(1, &HEAD, hair), (2, &BROW, brow), (3, &STUBBLE, beard)] {
            let mut dice = Dice::new(hash(x as i32, y as i32, salt, 83));
            // A stroke more in that share of texels which the fraction asks for.
            let wanted = kind.density * density * area;
            let count = wanted as usize + usize::from(dice.unit() < wanted.fract());
            for _ in 0..count {
                let flow = match salt {
                    1 => head_flow(texel.place, texel.normal, whorl),
                    2 => brow_flow(features, texel.place, side),
                    _ => Vec3::new(0.25 * dice.signed(), -1.0, 0.0),
                };
                let flow = flow + Vec3::new(dice.signed(), dice.signed(), dice.signed()) * 0.22;
                let along = (flow - texel.normal * texel.normal.dot(flow)).normalize_or(texel.tangent);
                let length = dice.range(kind.length.0, kind.length.1) * lerp(0.6, 1.0, density);
                let Some(step) = in_texels(along, steps) else { continue };
                // Begun anywhere along its length: strokes end at seams, and no side of one shall be the barer.
                let start = Vec2::new(x as f32 + dice.unit(), y as f32 + dice.unit()) - step * length * dice.unit();
                let stroke = Stroke {
                    start,
                    run: step * length,
                    half_width: kind.half_width / area.sqrt().max(1e-4),
                    strength: kind.strength * dice.range(0.6, 1.0),
                    tone: 0.75 + 0.6 * dice.unit() * dice.unit(),
                };
                hairs.draw(atlas, &stroke);
            }
        }
    }
    hairs
}

/// A hair in the atlas, in texels.
struct Stroke {
    start: Vec2,
    run: Vec2,
    half_width: f32,
    strength: f32,
    tone: f32,
}

impl Hairs {
    fn draw(&mut self, atlas: &Atlas, stroke: &Stroke) {
        let size = atlas.size();
        let Stroke { start, run, half_width, strength, tone } = *stroke;
        let num_steps = (run.length() * 1.5).ceil().clamp(1.0, 200.0) as usize;
        // Where a hair is narrower than a texel it covers that much less of it.
        let (spread, share) = (half_width.max(0.5), (2.0 * half_width).min(1.0));
        // Strokes overlap themselves from step to step, so the larger cover counts; between strokes some adds up, all the
        // more where a texel holds many hairs.
        let adding = lerp(0.55, 0.16, share);
        for i in 0..=num_steps {
            let t = i as f32 / num_steps as f32;
            let p = start + run * t;
            let thin = smoothstep(1.0, 0.7, t) * 0.6 + 0.4;
            let reach = spread.ceil() as i32;
            for dy in -reach..=reach {
                for dx in -reach..=reach {
                    let (x, y) = (p.x.floor() as i32 + dx, p.y.floor() as i32 + dy);
                    if !(0..size as i32).contains(&x) || !(0..size as i32).contains(&y) || !atlas.is_covered(x as usize, y as usize) {
                        continue;
                    }
                    let away = (Vec2::new(x as f32 + 0.5, y as f32 + 0.5) - p).length();
                    let cover = strength * share * thin * smoothstep(spread + 0.5, spread - 0.5, away);
                    let index = y as usize * size + x as usize;
                    if cover > 0.0 {
                        let old = self.cover[index];
                        self.cover[index] = old.max(cover).max(1.0 - (1.0 - old) * (1.0 - adding * cover));
                        self.tone[index] = lerp(self.tone[index], tone, cover);
                    }
                }
            }
        }
    }
}

/// The crown, mm: behind and a little to the right of the top of the head.
fn whorl(features: &Features) -> Vec3 {
    let ears = features.chart.middle(&[0, 16]);
    let brows = features.chart.middle(&[19, 24]);
    ears + Vec3::new(-9.0, (brows.y - ears.y) + 92.0, -52.0) * features.chart.scale()
}

/// Away from the crown, turning about it.
fn head_flow(place: Vec3, normal: Vec3, whorl: Vec3) -> Vec3 {
    let away = place - whorl;
    let outward = (away - normal * normal.dot(away)).normalize_or(Vec3::Z);
    let turn = lerp(1.1, 0.25, smoothstep(5.0, 60.0, away.length()));
    let cowlick = 0.45 * noise(place / 28.0, 87);
    outward + normal.cross(outward) * (turn + cowlick)
}

/// Upward at the inner end, then outward along the brow.
fn brow_flow(features: &Features, place: Vec3, side: Side) -> Vec3 {
    let (share, direction) = features.along_brow(place, side);
    let outward = Vec3::new(direction.x, direction.y, -0.5);
    let up = lerp(1.5, -0.12, smoothstep(0.0, 0.45, share));
    outward + Vec3::Y * up
}

/// A direction along the skin, mm, as texels.
fn in_texels(along: Vec3, [x, y]: [Vec3; 2]) -> Option<Vec2> {
    let (xx, xy, yy) = (x.dot(x), x.dot(y), y.dot(y));
    let determinant = xx * yy - xy * xy;
    if determinant <= 1e-12 {
        return None;
    }
    let (ax, ay) = (along.dot(x), along.dot(y));
    Some(Vec2::new(ax * yy - ay * xy, ay * xx - ax * xy) / determinant)
}
