//! The wrinkles of the four reference poses, drawn along the lines their muscles fold the skin in. Lengths are
//! millimetres on a face whose pupils are 60 mm apart; depths and places are tuned by eye on renders.

use super::super::bust::{PoseField, SlopeMap};
use super::atlas::Atlas;
use super::chart::{Chart, Side, arch, spline};
use super::furrow::{Furrows, Stroke};
use super::noise::{Dice, cells, lerp, noise, smoothstep};
use super::slopes;
use anyhow::{Result, bail};
use glam::{Vec2, Vec3};

/// A relief: furrows, and patches of skin that dimple.
pub struct Relief {
    furrows: Furrows,
    dimples: Vec<Dimples>,
}

/// A round patch of orange-peel skin.
struct Dimples {
    centre: Vec3,
    radius: Vec3,
    depth: f32,
    period: f32,
    seed: u32,
}

impl Relief {
    /// Height over a place with this normal, mm.
    pub fn height(&self, place: Vec3, normal: Vec3) -> f32 {
        self.furrows.height(place, normal) + self.dimples.iter().map(|patch| patch.height(place)).sum::<f32>()
    }
}

impl Dimples {
    fn height(&self, place: Vec3) -> f32 {
        let window = smoothstep(1.0, 0.35, ((place - self.centre) / self.radius).length());
        if window <= 0.0 {
            return 0.0;
        }
        let warp = Vec3::new(noise(place / 5.0, self.seed), noise(place / 5.0, self.seed + 1), noise(place / 5.0, self.seed + 2));
        let p = (place + warp * 1.2) / self.period;
        let pit = smoothstep(0.0, 0.62, cells(p, self.seed).first);
        let uneven = 0.7 + 0.5 * noise(place / 8.0, self.seed + 3);
        window * self.depth * uneven * (pit - 0.6)
    }
}

/// Influence below which furrows are no longer carved deeper to make up for it.
const LEAST_INFLUENCE: f32 = 0.45;
/// Slope no fold is steeper than: beyond it light only shows noise.
const STEEPEST: f32 = 1.25;

/// The wrinkle map of a pose. Where the pose's bones have only a part of the skinning weights, so that the map is shown at
/// that part even at the pose itself, the furrows are that much deeper; where they have none, nothing is drawn.
pub fn paint(chart: &Chart, atlas: &Atlas, pose: &PoseField) -> Result<SlopeMap> {
    let mut slopes = slopes_of(atlas, &relief(chart, pose.name)?);
    let gains = atlas.map(|texel| {
        let influence = atlas.between_vertices(texel, &pose.influence);
        smoothstep(0.0, 0.15, influence) / influence.clamp(LEAST_INFLUENCE, 1.0)
    });
    for (slope, gain) in slopes.iter_mut().zip(gains) {
        *slope = slope.zip(gain).map(|(p, gain)| {
            let steepness = gain * Vec2::from_array(p).length();
            p.map(|v| v * gain * (STEEPEST / steepness.max(STEEPEST)))
        });
    }
    slopes::wrinkle_map(atlas.size(), &slopes)
}

/// Slopes of a relief over the atlas.
fn slopes_of(atlas: &Atlas, relief: &Relief) -> Vec<Option<[f32; 2]>> {
    slopes::of_relief(atlas, 0.1, |texel| {
        let normal = texel.normal;
        Some(move |place: Vec3| relief.height(place, normal))
    })
}

/// The relief of a pose by its name.
pub fn relief(chart: &Chart, pose: &str) -> Result<Relief> {
    let mut pen = Pen { chart, strokes: Vec::new(), seed: 0 };
    let mut dimples = Vec::new();
    match pose {
        "stretch" => stretch(&mut pen),
        "compress" => compress(&mut pen),
        "smile" => smile(&mut pen),
        "pucker" => dimples = pucker(&mut pen),
        other => bail!("no wrinkles are known for the pose {other:?}"),
    }
    Ok(Relief { furrows: Furrows::new(chart, &pen.strokes), dimples })
}

/// Lines of the resting face: what the poses fold most, barely there.
pub fn permanent(chart: &Chart) -> Furrows {
    let mut strokes = Vec::new();
    for (draw, share) in [(stretch as fn(&mut Pen), 0.10), (compress, 0.09), (smile, 0.14)] {
        let mut pen = Pen { chart, strokes: Vec::new(), seed: 0 };
        draw(&mut pen);
        strokes.extend(pen.strokes.into_iter().map(|stroke| Stroke {
            depth: stroke.depth * share,
            bulge: stroke.bulge * 0.6,
            companions: 0,
            broken: (stroke.broken + 0.3).min(0.9),
            ..stroke
        }));
    }
    let mut pen = Pen { chart, strokes, seed: 900 };
    neck(&mut pen);
    Furrows::new(chart, &pen.strokes)
}

/// Draws strokes from landmarks.
struct Pen<'a> {
    chart: &'a Chart,
    strokes: Vec<Stroke>,
    seed: u32,
}

/// A point relative to a landmark of the left half of the face: index, millimetres away from the middle, and up.
type Mark = (usize, f32, f32);

impl Pen<'_> {
    fn dice(&mut self) -> Dice {
        self.seed += 1;
        Dice::new(self.seed)
    }

    /// Draws a line through marks; `finish` sets what differs from an ordinary furrow.
    fn line(&mut self, side: Side, marks: &[Mark], depth: f32, width: f32, finish: impl FnOnce(&mut Stroke)) {
        let mut dice = self.dice();
        // The halves of a face are never folded alike.
        let path =
            marks.iter().map(|&(index, x, y)| self.chart.at(side, index, (x + 0.7 * dice.signed(), y + 0.7 * dice.signed()))).collect();
        self.path(path, depth * dice.range(0.82, 1.15), width * dice.range(0.9, 1.12), finish);
    }

    fn path(&mut self, path: Vec<Vec2>, depth: f32, width: f32, finish: impl FnOnce(&mut Stroke)) {
        self.seed += 1;
        let mut stroke = Stroke::new(path, depth * self.chart.scale(), width * self.chart.scale(), self.seed);
        finish(&mut stroke);
        self.strokes.push(stroke);
    }
}

/// Frontalis: furrows across the forehead that arch over each brow.
fn stretch(pen: &mut Pen) {
    pen.seed = 100;
    // Height above the brows, from and to as shares of the way to the temples (negative: right), depth, width.
    const ROWS: [(f32, f32, f32, f32, f32); 9] = [
        (8.5, 0.20, 0.95, 0.60, 0.75),
        (9.5, -0.92, -0.26, 0.55, 0.70),
        (15.0, -0.97, 0.98, 1.00, 0.95),
        (22.0, -1.00, 0.60, 1.10, 1.00),
        (23.0, 0.42, 1.00, 0.78, 0.85),
        (30.0, -0.74, 0.96, 1.05, 0.95),
        (29.0, -1.00, -0.60, 0.60, 0.75),
        (38.0, -0.80, 0.76, 0.90, 0.90),
        (45.5, -0.55, 0.66, 0.60, 0.80),
    ];
    let brow = |side: Side| arch(&[22, 23, 24, 25, 26].map(|index| pen.chart.at(side, index, (0.0, 0.0))));
    let brows: Vec<Vec2> = brow(Side::Right).into_iter().rev().chain(brow(Side::Left)).collect();
    let mean = brows.iter().map(|p| p.y).sum::<f32>() / brows.len() as f32;
    let reach = pen.chart.at(Side::Left, 26, (1.0, 0.0)).x;
    let brow_height = |x: f32| brows.iter().min_by(|a, b| (a.x - x).abs().total_cmp(&(b.x - x).abs())).map_or(mean, |p| p.y);
    for (height, from, to, depth, width) in ROWS {
        let mut dice = pen.dice();
        let tilt = dice.signed() * 1.2;
        let count = ((to - from) * 6.0).ceil().max(4.0) as usize;
        let path = (0..=count)
            .map(|i| {
                let x = lerp(from, to, i as f32 / count as f32);
                let flatter = smoothstep(5.0, 50.0, height) * 0.65 + 0.25;
                let level = lerp(brow_height(x * reach), mean, flatter);
                // A dip in the middle where the two halves of the muscle part, a drop towards the temples.
                let dip = -2.6 * smoothstep(0.32, 0.0, x.abs()) - 5.5 * smoothstep(0.7, 1.05, x.abs());
                let y = level + (height + dip + tilt * x + 0.45 * dice.signed()) * pen.chart.scale();
                Vec2::new(x * reach, y)
            })
            .collect();
        pen.path(path, depth, width, |stroke| {
            stroke.shoulder = 3.4;
            stroke.bulge = 0.55;
            stroke.lean = 0.25;
            stroke.broken = 0.5;
            stroke.stray = 0.9;
            stroke.taper = (0.22, 0.22);
            stroke.companions = 5;
        });
    }
    for side in Side::BOTH {
        pen.line(side, &[(42, 3.0, 4.5), (43, 0.0, 5.6), (44, 0.5, 5.8), (45, 1.0, 4.5)], 0.22, 0.5, |s| s.shoulder = 1.6);
        pen.line(side, &[(43, -1.0, 7.8), (44, 0.5, 8.0), (45, 1.5, 6.0)], 0.16, 0.45, |s| s.shoulder = 1.5);
    }
}

/// Corrugator, procerus, nasalis: glabella, root and sides of the nose.
fn compress(pen: &mut Pen) {
    pen.seed = 300;
    // The two long frown lines are never equal, and a third one stands between.
    pen.line(Side::Left, &[(22, -4.6, -11.0), (22, -3.6, -3.0), (22, -2.8, 4.0), (22, -2.0, 10.0)], 0.85, 0.95, frown);
    pen.line(Side::Right, &[(22, -4.0, -9.0), (22, -3.4, -2.0), (22, -2.6, 3.0), (22, -1.6, 8.0)], 0.72, 0.9, frown);
    pen.line(Side::Right, &[(22, -8.4, -3.0), (22, -8.2, 3.0), (22, -7.4, 10.0)], 0.42, 0.65, frown);
    for side in Side::BOTH {
        // Skin gathered over the inner brow.
        pen.line(side, &[(22, 2.5, 3.5), (22, 5.0, 8.0), (23, -3.0, 11.0)], 0.38, 0.8, |s| s.shoulder = 3.4);
        pen.line(side, &[(23, -2.0, 5.0), (23, 1.0, 8.5), (23, 6.0, 11.0)], 0.24, 0.75, |s| s.shoulder = 3.0);
        // The brow pressed down over the lid.
        pen.line(side, &[(42, 0.0, 4.5), (42, 6.0, 7.0), (43, 2.0, 7.0), (44, 2.0, 6.5)], 0.32, 0.75, |s| s.lean = 0.4);
        // Bunny lines.
        pen.line(side, &[(27, 4.0, -3.0), (27, 8.5, -6.5), (27, 12.5, -11.0)], 0.55, 0.7, bunny);
        pen.line(side, &[(28, 2.2, 5.0), (28, 7.0, 0.5), (28, 11.5, -4.5), (28, 14.5, -9.0)], 0.62, 0.75, bunny);
        pen.line(side, &[(28, 3.0, -1.0), (28, 7.5, -5.5), (28, 11.0, -10.0)], 0.42, 0.65, bunny);
        // Pinch below the inner corner of the eye.
        pen.line(side, &[(42, -1.0, -4.0), (42, 4.0, -8.5), (47, 0.0, -8.0)], 0.42, 0.8, |s| s.companions = 3);
        pen.line(side, &[(42, -2.5, -8.0), (42, 2.5, -13.0), (47, -1.0, -13.0)], 0.34, 0.8, |s| s.companions = 2);
        // The raised wing: its crease, and the fold that starts there.
        pen.line(side, &[(35, 0.0, 15.5), (35, 6.0, 12.0), (35, 8.0, 5.0), (35, 6.0, -1.0)], 0.42, 0.8, |s| {
            s.lean = -0.4;
            s.shoulder = 3.0;
            s.broken = 0.1;
        });
        pen.line(side, &[(35, 5.0, 12.0), (35, 11.0, 5.0), (35, 16.0, -3.0), (54, 9.0, 7.0)], 0.6, 1.5, |s| {
            s.is_fold = true;
            s.lean = side.sign();
            s.shoulder = 5.0;
            s.taper = (0.2, 0.6);
        });
    }
    for (height, depth, half) in [(2.6, 0.34, 8.0), (-1.2, 0.28, 7.0), (-4.6, 0.18, 6.0)] {
        let mut dice = pen.dice();
        let (left, right) = (half * dice.range(0.8, 1.15), half * dice.range(0.8, 1.15));
        let points = [(-right, 0.6), (-right * 0.4, -0.2), (0.0, -0.8), (left * 0.45, 0.1), (left, 1.0)];
        let path = points.map(|(x, y)| pen.chart.at(Side::Left, 27, (x, y + height + 0.5 * dice.signed())));
        pen.path(path.to_vec(), depth, 0.8, |s| {
            s.shoulder = 2.3;
            s.broken = 0.15;
            s.stray = 0.5;
            s.companions = 2;
        });
    }
}

fn frown(stroke: &mut Stroke) {
    stroke.shoulder = 3.2;
    stroke.bulge = 0.6;
    stroke.stray = 0.7;
    stroke.broken = 0.12;
    stroke.companions = 3;
}

fn bunny(stroke: &mut Stroke) {
    stroke.shoulder = 2.0;
    stroke.bulge = 0.5;
    stroke.stray = 0.5;
    stroke.broken = 0.15;
    stroke.companions = 2;
}

/// Zygomaticus and orbicularis oculi: nasolabial folds, parentheses, crow's feet, lower lids.
fn smile(pen: &mut Pen) {
    pen.seed = 500;
    for side in Side::BOTH {
        let outward = side.sign();
        // From beside the wing of the nose round the corner of the mouth, the cheek rolling over the lip.
        let line = [(35, 5.5, 9.5), (35, 10.5, 3.0), (35, 15.0, -5.5), (54, 10.5, 6.5), (54, 11.5, -1.5), (54, 9.5, -9.5)];
        pen.line(side, &line, 1.5, 1.7, |s| {
            s.is_fold = true;
            s.lean = outward;
            s.shoulder = 5.6;
            s.bulge = 0.55;
            s.taper = (0.14, 0.5);
            s.broken = 0.18;
            s.stray = 0.5;
        });
        // A second, short one where the cheek is pushed up against itself.
        pen.line(side, &[(54, 19.5, 5.0), (54, 21.0, -2.0), (54, 19.5, -10.0)], 0.42, 1.3, |s| {
            s.is_fold = true;
            s.lean = outward;
            s.shoulder = 4.2;
            s.bulge = 0.4;
            s.taper = (0.45, 0.5);
        });
        pen.line(side, &[(54, 2.2, 3.0), (54, 3.6, -1.0), (54, 3.0, -6.0)], 0.40, 0.85, |s| s.shoulder = 2.6);
        crows_feet(pen, side);
        // Lower lid: soft arcs below the eye.
        pen.line(side, &[(42, 3.0, -3.0), (47, 0.0, -3.6), (46, 0.0, -3.6), (45, 2.0, -3.0)], 0.30, 0.5, |s| s.shoulder = 1.8);
        pen.line(side, &[(42, 4.0, -6.5), (47, 0.0, -7.0), (46, 1.0, -7.0), (45, 4.0, -6.0)], 0.42, 0.7, |s| {
            s.shoulder = 2.6;
            s.companions = 4;
        });
        pen.line(side, &[(42, 1.0, -10.5), (47, 0.0, -12.0), (46, 2.0, -12.0), (45, 7.0, -9.0)], 0.36, 0.9, |s| {
            s.shoulder = 3.2;
            s.companions = 3;
        });
    }
}

fn crows_feet(pen: &mut Pen, side: Side) {
    let count = if side == Side::Left { 6 } else { 7 };
    for i in 0..count {
        let mut dice = pen.dice();
        let share = i as f32 / (count - 1) as f32;
        let angle = lerp(0.72, -0.85, share) + 0.07 * dice.signed();
        let (near, far) = (dice.range(5.5, 8.5), dice.range(17.0, 26.0) - 5.0 * (share - 0.45).abs());
        // They bend away from the line through the corner: upper ones up, lower ones down along the cheek.
        let bend = lerp(0.16, -0.32, share);
        let point = |radius: f32, turn: f32| -> Mark {
            let (sin, cos) = libm::sincosf(angle + turn);
            (45, radius * cos, radius * sin - 0.5)
        };
        let depth = lerp(0.50, 0.85, (1.0 - (share - 0.5).abs() * 2.0).max(0.0));
        let marks = [point(near, 0.0), point(lerp(near, far, 0.5), bend * 0.35), point(far, bend)];
        pen.line(side, &marks, depth, 0.68, |s| {
            s.shoulder = 2.1;
            s.bulge = 0.5;
            s.taper = (0.3, 0.55);
            s.stray = 0.6;
            s.broken = 0.2;
            s.companions = 2;
        });
    }
}

/// Orbicularis oris and mentalis: lines round the lips, a dimpled chin. Returns the chin's dimples.
fn pucker(pen: &mut Pen) -> Vec<Dimples> {
    pen.seed = 700;
    let chart = pen.chart;
    let contour = |indices: &[usize]| spline(&indices.iter().map(|&i| chart.unroll(chart.landmark(i))).collect::<Vec<_>>(), 10);
    let lips = [(contour(&[48, 49, 50, 51, 52, 53, 54]), 1.0), (contour(&[48, 59, 58, 57, 56, 55, 54]), -1.0)];
    let centre = chart.unroll(chart.middle(&[48, 54, 62, 66]));
    let scale = chart.scale();
    for (border, up) in &lips {
        // On the skin: a fan of lines towards the mouth. On the red: finer and more of them.
        for (count, inward, outward, depth, width) in [(13, 1.5, 8.0, 0.28, 0.66), (21, 3.6, 1.0, 0.30, 0.5)] {
            for i in 0..count {
                let mut dice = pen.dice();
                let share = (i as f32 + 0.5 + 0.35 * dice.signed()) / count as f32;
                let at = border[((share * (border.len() - 1) as f32) as usize).min(border.len() - 1)];
                let from_centre = at - centre;
                let direction = Vec2::new(from_centre.x * 0.75, up * 13.0 * scale).normalize();
                let side_fade = smoothstep(0.0, 0.12, share) * smoothstep(1.0, 0.88, share);
                let reach = outward * dice.range(0.6, 1.25) * lerp(0.6, 1.0, side_fade) * scale;
                let start = at - direction * inward * dice.range(0.8, 1.2) * scale;
                let end = at + direction * reach;
                let sway = direction.perp() * dice.signed() * 0.8 * scale;
                let depth = depth * dice.range(0.55, 1.2) * lerp(0.45, 1.0, side_fade);
                pen.path(vec![start, start.lerp(end, 0.5) + sway, end], depth, width, |s| {
                    s.shoulder = 1.7;
                    s.bulge = 0.55;
                    s.stray = 0.35;
                    s.broken = 0.1;
                    s.taper = (0.25, 0.5);
                    s.companions = 1;
                });
            }
        }
    }
    pen.line(Side::Left, &[(48, 6.0, -13.0), (57, -8.0, -9.0), (57, 0.0, -8.0), (57, 8.0, -9.0), (54, -6.0, -13.0)], 0.32, 1.3, |s| {
        s.shoulder = 4.0;
        s.broken = 0.1;
        s.companions = 3;
    });
    for side in Side::BOTH {
        pen.line(side, &[(54, 1.5, 2.5), (54, 4.0, -2.0), (54, 3.5, -8.0)], 0.6, 0.9, |s| s.shoulder = 2.8);
        pen.line(side, &[(54, 4.5, 6.0), (54, 7.5, 0.0), (54, 7.0, -8.0)], 0.35, 0.9, |s| s.shoulder = 3.0);
    }
    let chin = chart.unroll(chart.landmark(57).lerp(chart.landmark(8), 0.62));
    let Some((centre, _)) = chart.skin(chin) else { return Vec::new() };
    let patch = |period: f32, depth: f32, seed: u32| Dimples { centre, radius: Vec3::new(19.0, 14.0, 18.0) * scale, depth, period, seed };
    vec![patch(5.2 * scale, 0.62, 771), patch(2.8 * scale, 0.20, 781)]
}

/// Rings of the neck.
fn neck(pen: &mut Pen) {
    for (below, depth) in [(32.0, 0.22), (49.0, 0.26)] {
        let mut dice = pen.dice();
        let path = (-4..=4)
            .map(|i| {
                let x = i as f32 / 4.0;
                pen.chart.at(Side::Left, 8, (x * 62.0, -below + 9.0 * x * x + dice.signed()))
            })
            .collect();
        pen.path(path, depth, 0.9, |s| {
            s.stray = 1.5;
            s.broken = 0.6;
            s.companions = 4;
        });
    }
}

#[cfg(test)]
mod tests {
    use super::super::sample::head;
    use super::*;

    /// Share of a pose's slope energy where `inside` says so (place in mm).
    fn energy_share(pose: &str, inside: impl Fn(Vec3) -> bool) -> f64 {
        let bust = head();
        let chart = Chart::new(&bust);
        let atlas = Atlas::new(&bust, 256);
        let slopes = slopes_of(&atlas, &relief(&chart, pose).expect("a known pose"));
        let (mut within, mut all) = (0.0, 0.0);
        for (i, slope) in slopes.iter().enumerate() {
            let (Some(p), Some(texel)) = (slope, atlas.texel(i % 256, i / 256)) else { continue };
            let energy = f64::from(p[0] * p[0] + p[1] * p[1]);
            all += energy;
            within += if inside(texel.place) { energy } else { 0.0 };
        }
        assert!(all > 1.0, "{pose} draws nothing");
        within / all
    }

    #[test]
    fn each_pose_folds_the_skin_over_its_muscles_and_nowhere_else() {
        // The sample face: brows at y 34, eyes 20, nose -24, mouth -45, chin -86.
        let shares = [
            ("stretch", energy_share("stretch", |p| p.y > 34.0)),
            ("compress", energy_share("compress", |p| p.y > -45.0 && p.y < 60.0 && p.x.abs() < 45.0)),
            ("smile", energy_share("smile", |p| p.y < 30.0 && p.x.abs() > 12.0)),
            ("pucker", energy_share("pucker", |p| p.y < -24.0 && p.x.abs() < 42.0)),
        ];
        for (pose, share) in shares {
            assert!(share > 0.9, "{pose}: {share}");
        }
    }

    #[test]
    fn both_halves_are_folded_but_not_alike() {
        for pose in ["stretch", "compress", "smile", "pucker"] {
            let left = energy_share(pose, |p| p.x > 0.0);
            assert!((0.35..0.65).contains(&left) && (left - 0.5).abs() > 1e-3, "{pose}: {left}");
        }
    }

    #[test]
    fn skin_without_furrows_is_exactly_flat() {
        let bust = head();
        let chart = Chart::new(&bust);
        let relief = relief(&chart, "stretch").expect("a known pose");
        assert_eq!(relief.height(Vec3::new(0.0, -86.0, 80.0), Vec3::Z), 0.0);
    }

    #[test]
    fn maps_are_flat_where_no_bone_of_the_pose_reaches_and_the_same_every_time() {
        let bust = head();
        let (chart, atlas) = (Chart::new(&bust), Atlas::new(&bust, 256));
        let influence = bust.positions.iter().map(|p| if p.x > 0.0 { 1.0 } else { 0.0 }).collect();
        let pose = PoseField { name: "stretch", influence };
        let first = paint(&chart, &atlas, &pose).expect("painted");
        assert!(first.image.bytes == paint(&chart, &atlas, &pose).expect("painted").image.bytes);
        let picture = image::load_from_memory(&first.image.bytes).expect("a PNG").to_rgb8();
        let is_flat = |x: u32, y: u32| picture.get_pixel(x, y).0 == [128, 128, 255];
        assert!((0..256).all(|y| (0..120).all(|x| is_flat(x, y))), "the right half has no influence");
        assert!((0..256).any(|y| (136..256).any(|x| !is_flat(x, y))));
    }

    #[test]
    fn a_pose_nobody_drew_is_an_error() {
        let bust = head();
        assert!(relief(&Chart::new(&bust), "surprise").is_err());
    }
}
