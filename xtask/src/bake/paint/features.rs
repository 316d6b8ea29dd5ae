//! Where the parts of a face are: soft masks by place on the skin, relative to the landmarks.

use super::super::brows;
use super::super::bust::{Bust, Eyeball, Region};
use super::atlas::Texel;
use super::chart::{Chart, Side, spline};
use super::noise::{bell, fractal, lerp, noise, smoothstep};
use glam::{Vec2, Vec3};

/// Curves and centres the masks are measured from: unrolled millimetres, the brows' millimetres seen from the front.
pub struct Features<'a> {
    /// The face they belong to.
    pub chart: &'a Chart,
    eyes: [Eyeball; 2],
    lips: Vec<Vec2>,
    mouth_line: Vec<Vec2>,
    brows: [Vec<Vec2>; 2],
    hairline: Vec<Vec2>,
    brow_height: f32,
}

/// How much a place belongs to each part, 0 to 1 each.
#[derive(Debug, Clone, Copy, Default)]
pub struct Marks {
    /// Red of the lips.
    pub lip: f32,
    /// The rim of the lips, where red and skin meet.
    pub lip_rim: f32,
    /// Between the lips, where they touch.
    pub lip_gap: f32,
    /// Round the corners of the mouth, inside and out.
    pub lip_corner: f32,
    /// Upper lid up to its crease.
    pub upper_lid: f32,
    /// Hollow under the eye.
    pub under_eye: f32,
    /// Root of the lashes.
    pub lash_line: f32,
    /// Edge of the lid that touches the eye.
    pub waterline: f32,
    /// Inner corner of the eye.
    pub eye_corner: f32,
    /// Apple of the cheek.
    pub cheek: f32,
    /// Tip, wings and bridge of the nose.
    pub nose: f32,
    /// Tip and wings only.
    pub nose_tip: f32,
    /// Forehead.
    pub forehead: f32,
    /// Chin.
    pub chin: f32,
    /// Where a beard grows.
    pub beard: f32,
    /// Outer ear.
    pub ear: f32,
    /// Neck and below.
    pub neck: f32,
    /// Density of the hair of the head.
    pub hair: f32,
    /// Density of the brow.
    pub brow: f32,
    /// Mouth cavity.
    pub mouth: f32,
    /// Behind the lids.
    pub socket: f32,
}

impl<'a> Features<'a> {
    /// Finds the parts.
    pub fn new(chart: &'a Chart, bust: &Bust) -> Self {
        let unrolled = |index: usize| chart.unroll(chart.landmark(index));
        let closed = |indices: &[usize]| {
            let points: Vec<Vec2> = indices.iter().chain(&indices[..1]).map(|&i| unrolled(i)).collect();
            spline(&points, 8)
        };
        let brow = |side: Side| (0..=32).map(|i| brows::line(i as f32 / 32.0) * 1000.0 * Vec2::new(side.sign(), 1.0)).collect();
        let brow_height = chart.middle(&[19, 20, 23, 24]).y;
        Self {
            chart,
            eyes: bust.eyes,
            lips: closed(&[48, 49, 50, 51, 52, 53, 54, 55, 56, 57, 58, 59]),
            mouth_line: spline(
                &[(48, 48), (61, 67), (62, 66), (63, 65), (54, 54)].map(|(up, low)| (unrolled(up) + unrolled(low)) / 2.0),
                8,
            ),
            brows: Side::BOTH.map(brow),
            hairline: HAIRLINE.map(|(x, y)| Vec2::new(x, brow_height + y * chart.scale())).to_vec(),
            brow_height,
        }
    }

    /// What a texel shows.
    pub fn marks(&self, texel: &Texel) -> Marks {
        let place = texel.place;
        let at = self.chart.unroll(place);
        let mirrored = Vec2::new(at.x.abs(), at.y);
        let front = self.chart.front(place);
        let scale = self.chart.scale();
        let mut marks = Marks {
            ear: texel.share(Region::Ear),
            mouth: texel.share(Region::Mouth),
            socket: texel.share(Region::Socket),
            hair: self.hair(place, at) * (1.0 - smoothstep(0.0, 0.6, texel.share(Region::Ear))),
            ..Marks::default()
        };
        let chin = self.chart.landmark(8);
        marks.neck = smoothstep(chin.y - 4.0, chin.y - 26.0, place.y).max(smoothstep(0.0, -60.0, place.y) * (1.0 - front));
        if front <= 0.0 {
            return marks;
        }
        let side = if place.x >= 0.0 { Side::Left } else { Side::Right };
        let blob = |index: usize, offset: (f32, f32), radius: (f32, f32)| {
            let away = (at - self.chart.at(side, index, offset)) / (Vec2::new(radius.0, radius.1) * scale);
            bell(away.length(), 1.0)
        };
        let near = |index: usize, radius: f32| bell((place - self.chart.landmark(index)).length(), radius * scale);

        self.mark_lips(&mut marks, at, place);
        self.mark_eye(&mut marks, texel, side);
        marks.under_eye = blob(46, (-2.0, -6.0), (15.0, 6.5)).max(0.8 * blob(42, (1.0, -5.0), (7.0, 6.0)));
        marks.cheek = blob(46, (5.0, -22.0), (19.0, 15.0));
        marks.nose_tip = near(30, 11.0).max(near(31, 7.5)).max(near(35, 7.5));
        marks.nose = marks.nose_tip.max(near(29, 10.0)).max(0.8 * near(28, 9.0)).max(0.5 * near(27, 8.0));
        marks.chin = bell((place - self.chart.landmark(57).lerp(chin, 0.6)).length(), 17.0 * scale);
        marks.forehead = smoothstep(self.brow_height + 2.0, self.brow_height + 16.0, place.y) * smoothstep(75.0, 55.0, mirrored.x);
        marks.beard = self.beard(at, place) * (1.0 - marks.lip);
        marks.brow = self.brow(place, side);
        marks
    }

    /// Where along the brow a place is, 0 at the nose to 1, and the brow's direction there, seen from the front.
    pub fn along_brow(&self, place: Vec3, side: Side) -> (f32, Vec2) {
        let (_, share, direction) = nearest(&self.brows[usize::from(side == Side::Right)], place.truncate());
        (share, direction)
    }

    fn mark_lips(&self, marks: &mut Marks, at: Vec2, place: Vec3) {
        let corner = if place.x >= 0.0 { 64 } else { 60 };
        marks.lip_corner = smoothstep(9.0, 3.0, (place - self.chart.landmark(corner)).length());
        let mouth = self.chart.middle(&[48, 54, 62, 66]);
        if (at - self.chart.unroll(mouth)).length() > 55.0 || marks.mouth > 0.99 {
            return;
        }
        let wobble = 0.35 * noise(place / 2.2, 41) + 0.2 * noise(place / 0.9, 42);
        let (distance, _, _) = nearest(&self.lips, at);
        let inside = if contains(&self.lips, at) { distance } else { -distance } + wobble;
        marks.lip = smoothstep(-0.9, 0.9, inside) * (1.0 - marks.mouth);
        marks.lip_rim = bell(inside + 0.9, 1.4) * (1.0 - marks.mouth);
        let (gap, _, _) = nearest(&self.mouth_line, at);
        marks.lip_gap = smoothstep(2.6, 0.3, gap).max(marks.mouth);
    }

    fn mark_eye(&self, marks: &mut Marks, texel: &Texel, side: Side) {
        let eye = self.eyes[usize::from(side == Side::Right)];
        let from_centre = texel.place - eye.centre * 1000.0;
        let above_ball = from_centre.length() - eye.radius * 1000.0;
        let (inner, outer) = if side == Side::Left { (42, 45) } else { (39, 36) };
        let (inner, outer) = (self.chart.landmark(inner), self.chart.landmark(outer));
        let across = (texel.place - inner).dot(outer - inner) / (outer - inner).length_squared();
        let within = smoothstep(-0.22, 0.0, across) * smoothstep(1.07, 0.97, across);
        let ahead = smoothstep(0.15, 0.35, from_centre.z / from_centre.length());
        let level = lerp(inner.y, outer.y, across.clamp(0.0, 1.0));
        let is_upper = smoothstep(-1.0, 1.5, texel.place.y - level);
        marks.waterline = smoothstep(1.5, 0.5, above_ball) * within * ahead;
        marks.lash_line = smoothstep(3.0, 1.6, above_ball)
            * smoothstep(0.2, 1.1, above_ball)
            * within
            * ahead
            * lerp(0.28, smoothstep(1.0, 0.78, across), is_upper)
            * (1.0 - marks.socket);
        marks.upper_lid = texel.share(Region::Eyelid) * is_upper;
        marks.eye_corner = bell((texel.place - inner).length(), 2.8);
    }

    fn hair(&self, place: Vec3, at: Vec2) -> f32 {
        let mirrored = Vec2::new(at.x.abs(), at.y);
        let (distance, _, _) = nearest(&self.hairline, mirrored);
        let line = height_at(&self.hairline, mirrored.x);
        let inside = if mirrored.y > line { distance } else { -distance };
        let ragged = inside + 3.0 * fractal(place / 14.0, 2, 51) + 1.8 * noise(place / 3.5, 52);
        // Cut shorter round the ears and down to the nape.
        smoothstep(-3.5, lerp(8.5, 19.0, smoothstep(80.0, 105.0, mirrored.x)), ragged)
    }

    fn beard(&self, at: Vec2, place: Vec3) -> f32 {
        let mouth = self.chart.middle(&[48, 54]);
        let away = at - self.chart.unroll(Vec3::new(0.0, mouth.y - 12.0, self.chart.landmark(57).z));
        let jaw = smoothstep(1.15, 0.8, (away / Vec2::new(88.0, 40.0)).length());
        // The cheek stays free above a line from the ear to the corner of the mouth.
        let line = self.chart.landmark(33).y - 2.0 - 16.0 * smoothstep(20.0, 42.0, at.x.abs()) + 14.0 * smoothstep(60.0, 105.0, at.x.abs());
        let uneven = 0.8 + 0.3 * noise(place / 9.0, 61);
        jaw * smoothstep(line + 2.0, line - 7.0, at.y) * uneven.clamp(0.0, 1.0)
    }

    /// The band the brow's own hairs stand in, a little wider. Seen from the front, as they are.
    fn brow(&self, place: Vec3, side: Side) -> f32 {
        let curve = &self.brows[usize::from(side == Side::Right)];
        let at = place.truncate();
        if (at - curve[curve.len() / 2]).length() > 45.0 {
            return 0.0;
        }
        let (distance, share, _) = nearest(curve, at);
        let half = brows::half_height(share) * 1000.0;
        smoothstep(half + 1.4, half - 1.4, distance)
    }
}

/// Lower edge of the hair on the left half: unrolled x, and height over the brows. From the middle of the forehead over
/// the temple, the sideburn and the ear to the nape. Tuned by eye.
const HAIRLINE: [(f32, f32); 17] = [
    (0.0, 53.0),
    (20.0, 54.5),
    (36.0, 58.0),
    (50.0, 58.5),
    (62.0, 51.0),
    (74.0, 39.0),
    (83.0, 25.0),
    (90.0, 11.0),
    (95.0, -2.0),
    (99.0, -18.0),
    (101.0, -37.0),
    (137.0, -43.0),
    (143.0, -16.0),
    (150.0, -48.0),
    (165.0, -70.0),
    (205.0, -84.0),
    (252.0, -88.0),
];

/// Distance to a curve, share of its length at the nearest point, unit direction there.
fn nearest(curve: &[Vec2], at: Vec2) -> (f32, f32, Vec2) {
    let mut best = (f32::MAX, 0.0, Vec2::X);
    let spans = (curve.len() - 1) as f32;
    for (i, pair) in curve.windows(2).enumerate() {
        let along = pair[1] - pair[0];
        let squared = along.length_squared();
        if squared <= 0.0 {
            continue;
        }
        let t = ((at - pair[0]).dot(along) / squared).clamp(0.0, 1.0);
        let distance = (at - pair[0] - along * t).length_squared();
        if distance < best.0 {
            best = (distance, (i as f32 + t) / spans, along / squared.sqrt());
        }
    }
    (best.0.sqrt(), best.1, best.2)
}

fn contains(polygon: &[Vec2], at: Vec2) -> bool {
    let crossings = polygon.windows(2).filter(|pair| {
        let (a, b) = (pair[0], pair[1]);
        (a.y > at.y) != (b.y > at.y) && at.x < a.x + (at.y - a.y) / (b.y - a.y) * (b.x - a.x)
    });
    crossings.count() % 2 == 1
}

/// Height of a curve that runs from left to right.
fn height_at(curve: &[Vec2], x: f32) -> f32 {
    let pair = curve.windows(2).find(|pair| x <= pair[1].x).unwrap_or(&curve[curve.len() - 2..]);
    lerp(pair[0].y, pair[1].y, ((x - pair[0].x) / (pair[1].x - pair[0].x)).clamp(0.0, 1.0))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn points_inside_a_polygon_are_told_from_those_outside() {
        let square = [Vec2::ZERO, Vec2::X, Vec2::ONE, Vec2::Y, Vec2::ZERO];
        assert!(contains(&square, Vec2::splat(0.5)) && !contains(&square, Vec2::new(1.5, 0.5)) && !contains(&square, Vec2::new(0.5, -0.5)));
        let (distance, share, _) = nearest(&square, Vec2::new(0.5, -0.5));
        assert_eq!((distance, share), (0.5, 0.125));
    }
}
