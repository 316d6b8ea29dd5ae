//! Furrows: lines drawn on the face that become valleys with soft shoulders.

use super::chart::{Chart, spline};
use super::noise::{Dice, noise, smoothstep};
use glam::{Vec2, Vec3};
use std::collections::HashMap;

/// Distance between the nodes of a furrow, mm.
const SPACING: f32 = 0.6;
/// Edge of a cell of the look-up grid, mm.
const CELL: f32 = 4.0;

/// A furrow as it is drawn. Lengths in mm.
#[derive(Debug, Clone)]
pub struct Stroke {
    /// Points it passes, unrolled.
    pub path: Vec<Vec2>,
    /// Depth of the valley.
    pub depth: f32,
    /// Half width of the valley (where its depth has fallen to about a third).
    pub width: f32,
    /// Distance of the crest of the shoulders from the valley.
    pub shoulder: f32,
    /// Height of the shoulders as a share of the depth.
    pub bulge: f32,
    /// Which shoulder is fuller: 1 the one to the left of the direction of drawing, -1 the other.
    pub lean: f32,
    /// Length of the tapered start and end as shares of the whole.
    pub taper: (f32, f32),
    /// 0 unbroken, 1 falls apart into dashes.
    pub broken: f32,
    /// How far the line strays from its path.
    pub stray: f32,
    /// Fine lines beside it.
    pub companions: usize,
    /// A fold instead of a furrow: the skin on the fuller side of `lean` rolls over the other, `shoulder` away at its
    /// highest, and falls back gently beyond; the other side meets it flat, within about two widths.
    pub is_fold: bool,
    /// Of its irregularities.
    pub seed: u32,
}

impl Stroke {
    /// An ordinary furrow along `path`.
    pub fn new(path: Vec<Vec2>, depth: f32, width: f32, seed: u32) -> Self {
        Self {
            path,
            depth,
            width,
            shoulder: 2.2 + width,
            bulge: 0.45,
            lean: 0.0,
            taper: (0.3, 0.3),
            broken: 0.25,
            stray: 0.8,
            companions: 0,
            is_fold: false,
            seed,
        }
    }
}

#[derive(Debug, Clone, Copy)]
struct Node {
    place: Vec3,
    normal: Vec3,
    depth: f32,
    width: f32,
    shoulder: f32,
    bulge: f32,
    lean: f32,
    /// Of a fold: height of the roll, mm, with the sign of its side; 0 for a furrow.
    roll: f32,
}

/// Furrows on the skin: a height field.
pub struct Furrows {
    lines: Vec<Vec<Node>>,
    grid: HashMap<[i32; 3], Vec<(u32, u32)>>,
}

impl Furrows {
    /// Carves the strokes; parts that miss the skin are left out.
    pub fn new(chart: &Chart, strokes: &[Stroke]) -> Self {
        let mut furrows = Self { lines: Vec::new(), grid: HashMap::new() };
        for stroke in strokes {
            furrows.carve(chart, stroke);
            for companion in companions(stroke) {
                furrows.carve(chart, &companion);
            }
        }
        furrows
    }

    /// Height of the relief over a place with this normal, mm: 0 away from all furrows.
    pub fn height(&self, place: Vec3, normal: Vec3) -> f32 {
        let Some(candidates) = self.grid.get(&cell(place)) else { return 0.0 };
        let mut height = 0.0;
        let mut rest = candidates.as_slice();
        while let Some(&(line, _)) = rest.first() {
            let end = rest.partition_point(|candidate| candidate.0 <= line);
            height += self.line_height(&rest[..end], place, normal);
            rest = &rest[end..];
        }
        height
    }

    fn line_height(&self, segments: &[(u32, u32)], place: Vec3, normal: Vec3) -> f32 {
        let mut best: Option<(f32, f32, &[Node])> = None;
        for &(line, index) in segments {
            let pair = &self.lines[line as usize][index as usize..index as usize + 2];
            let along = pair[1].place - pair[0].place;
            let t = ((place - pair[0].place).dot(along) / along.length_squared()).clamp(0.0, 1.0);
            let distance = (place - pair[0].place - along * t).length_squared();
            if best.is_none_or(|(least, _, _)| distance < least) {
                best = Some((distance, t, pair));
            }
        }
        let Some((distance, t, pair)) = best else { return 0.0 };
        let (a, b) = (pair[0], pair[1]);
        let mix = |of: fn(&Node) -> f32| of(&a) + (of(&b) - of(&a)) * t;
        let direction = b.place - a.place;
        let side = a.normal.cross(direction).dot(place - a.place).signum();
        let (across, shoulder) = (distance.sqrt(), mix(|n| n.shoulder));
        // The far side of a thin fold (a lip, a lid, a nostril) is near in space but faces elsewhere.
        let same_side = smoothstep(-0.1, 0.4, normal.dot(a.normal));
        let roll = mix(|n| n.roll);
        if roll != 0.0 {
            let into_roll = side * roll.signum() * across;
            return same_side * fold(into_roll, mix(|n| n.width), shoulder, mix(|n| n.depth), roll.abs());
        }
        let valley = profile(across, mix(|n| n.width));
        let crest = crest(across, shoulder) * mix(|n| n.bulge) * (1.0 + side * mix(|n| n.lean) * smoothstep(0.0, 1.0, across / shoulder));
        mix(|n| n.depth) * same_side * (crest - valley)
    }

    fn carve(&mut self, chart: &Chart, stroke: &Stroke) {
        let path = spline(&stroke.path, 24);
        let length: f32 = path.windows(2).map(|pair| (pair[1] - pair[0]).length()).sum();
        let num_nodes = (length / SPACING).ceil().max(4.0) as usize;
        let mut run: Vec<Node> = Vec::new();
        for i in 0..=num_nodes {
            let share = i as f32 / num_nodes as f32;
            let (on_path, across) = walk(&path, share * length);
            let s = share * length;
            let wave = |period: f32, salt: u32| noise(Vec3::new(s / period, 0.37, 11.3), stroke.seed.wrapping_mul(31).wrapping_add(salt));
            let stray = stroke.stray * (wave(17.0, 1) + 0.45 * wave(6.0, 2) + 0.2 * wave(2.3, 3));
            let Some((place, normal)) = chart.skin(on_path + across * stray) else {
                self.push_line(std::mem::take(&mut run));
                continue;
            };
            let taper = smoothstep(0.0, stroke.taper.0.max(1e-3), share) * smoothstep(1.0, 1.0 - stroke.taper.1.max(1e-3), share);
            let gaps = 1.0 - stroke.broken * smoothstep(0.1, 0.75, 0.5 + 0.7 * wave(11.0, 4) + 0.3 * wave(4.0, 5));
            let uneven = (1.0 + 0.3 * wave(8.0, 6) + 0.15 * wave(2.5, 7)).max(0.2);
            let thin = 0.55 + 0.45 * taper;
            if stroke.is_fold {
                // One clear line and a roll as smooth as flesh: unevenness of a furrow would look like a scar here.
                run.push(Node {
                    place,
                    normal,
                    depth: stroke.depth * taper * gaps * (1.0 + 0.14 * wave(13.0, 6)),
                    width: stroke.width * (1.0 + 0.15 * wave(10.0, 8)),
                    shoulder: stroke.shoulder * (0.7 + 0.3 * taper) * (1.0 + 0.12 * wave(26.0, 9)),
                    bulge: stroke.bulge,
                    lean: stroke.lean,
                    roll: stroke.depth * stroke.bulge * taper.max(1e-3) * (1.0 + 0.15 * wave(30.0, 10)) * stroke.lean.signum(),
                });
                continue;
            }
            run.push(Node {
                place,
                normal,
                roll: 0.0,
                depth: stroke.depth * taper * gaps * uneven,
                width: stroke.width * thin * (1.0 + 0.25 * wave(6.0, 8)),
                shoulder: stroke.shoulder * (0.75 + 0.25 * taper) * (1.0 + 0.25 * wave(14.0, 9)),
                bulge: stroke.bulge * (1.0 + 0.4 * wave(12.0, 10)),
                lean: (stroke.lean + 0.35 * wave(20.0, 11)).clamp(-0.9, 0.9),
            });
        }
        self.push_line(run);
    }

    fn push_line(&mut self, nodes: Vec<Node>) {
        if nodes.len() < 2 {
            return;
        }
        let line = self.lines.len() as u32;
        for (index, pair) in nodes.windows(2).enumerate() {
            let reach = Vec3::splat(pair.iter().map(reach).fold(0.0, f32::max));
            let low = cell(pair[0].place.min(pair[1].place) - reach);
            let high = cell(pair[0].place.max(pair[1].place) + reach);
            for z in low[2]..=high[2] {
                for y in low[1]..=high[1] {
                    for x in low[0]..=high[0] {
                        self.grid.entry([x, y, z]).or_default().push((line, index as u32));
                    }
                }
            }
        }
        self.lines.push(nodes);
    }
}

/// The valley: 1 in the middle, falling like a crease, 0 from four widths on.
fn profile(across: f32, width: f32) -> f32 {
    let t = across / width;
    let rounded = (t * t + 0.2).sqrt() - 0.447_213_6;
    libm::expf(-1.35 * rounded) * smoothstep(4.0, 2.5, t)
}

/// The shoulders: 1 at `shoulder`, 0 in the valley and from `2.4 shoulder` on.
fn crest(across: f32, shoulder: f32) -> f32 {
    let t = across / shoulder;
    if t < 1.0 { smoothstep(0.0, 1.0, t) } else { smoothstep(2.4, 1.0, t) }
}

/// A fold across its line: `into_roll` is the distance, negative on the flat side. `-depth` on the line, `roll` where the
/// skin is fullest, 0 far away. Both sides meet in an edge: that is the line one sees.
fn fold(into_roll: f32, width: f32, shoulder: f32, depth: f32, roll: f32) -> f32 {
    if into_roll <= 0.0 {
        let t = -into_roll / width;
        return -depth * libm::expf(-t) * smoothstep(FOLD_FLAT, 0.6 * FOLD_FLAT, t);
    }
    let t = into_roll / shoulder;
    if t < 1.0 { (depth + roll) * (1.0 - libm::powf(1.0 - t, 2.2)) - depth } else { roll * smoothstep(FOLD_ROLL, 1.0, t) }
}

/// Where a fold ends on either side, in widths and in shoulders.
const FOLD_FLAT: f32 = 5.0;
const FOLD_ROLL: f32 = 3.2;

fn reach(node: &Node) -> f32 {
    let (shoulders, widths) = if node.roll == 0.0 { (2.4, 4.0) } else { (FOLD_ROLL, FOLD_FLAT) };
    (shoulders * node.shoulder).max(widths * node.width)
}

fn cell(place: Vec3) -> [i32; 3] {
    (place / CELL).floor().to_array().map(|v| v as i32)
}

/// The point `s` millimetres along the path and the unit vector to its left.
fn walk(path: &[Vec2], mut s: f32) -> (Vec2, Vec2) {
    let mut at = (path[0], Vec2::X);
    for pair in path.windows(2) {
        let step = pair[1] - pair[0];
        let length = step.length();
        if length <= 0.0 {
            continue;
        }
        let direction = step / length;
        at = (pair[0] + direction * s.min(length), direction.perp());
        if s <= length {
            break;
        }
        s -= length;
    }
    at
}

/// Fine lines that accompany a furrow: beside a part of it, at a small angle to it.
fn companions(stroke: &Stroke) -> Vec<Stroke> {
    let mut dice = Dice::new(stroke.seed ^ 0x51ed_270b);
    let path = spline(&stroke.path, 12);
    let length: f32 = path.windows(2).map(|pair| (pair[1] - pair[0]).length()).sum();
    (0..stroke.companions)
        .map(|i| {
            let span = dice.range(0.2, 0.5);
            let start = dice.range(0.05, 0.95 - span);
            let side = if dice.unit() < 0.5 { -1.0 } else { 1.0 };
            let (from, to) = (dice.range(0.4, 1.3) * stroke.shoulder * side, dice.range(0.1, 1.4) * stroke.shoulder * side);
            let point = |share: f32, offset: f32| {
                let (point, across) = walk(&path, (start + span * share) * length);
                point + across * offset
            };
            let depth = stroke.depth * dice.range(0.2, 0.45);
            let width = (stroke.width * dice.range(0.45, 0.7)).max(0.35);
            Stroke {
                path: vec![point(0.0, from), point(0.5, (from + to) / 2.0), point(1.0, to)],
                depth,
                width,
                shoulder: 1.0 + width,
                bulge: 0.3,
                lean: 0.0,
                taper: (0.45, 0.45),
                broken: 0.5,
                stray: stroke.stray * 0.7,
                companions: 0,
                is_fold: false,
                seed: stroke.seed.wrapping_mul(977).wrapping_add(i as u32 + 1),
            }
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_fold_rolls_high_over_one_side_and_meets_the_other_flat() {
        let height = |into_roll: f32| fold(into_roll, 1.7, 5.6, 1.5, 0.8);
        assert!((height(0.0) + 1.5).abs() < 1e-6 && (height(5.6) - 0.8).abs() < 1e-5);
        assert!((0..400).all(|i| height(-0.05 * i as f32) <= 0.0), "no welt on the flat side");
        assert_eq!((height(-9.0), height(18.0)), (0.0, 0.0));
        // Without a step, and nowhere steeper than the line itself.
        let slope = |at: f32| (height(at + 0.01) - height(at)) / 0.01;
        assert!((-900..1800).map(|i| slope(0.01 * i as f32).abs()).all(|slope| slope < 0.95));
    }
}
