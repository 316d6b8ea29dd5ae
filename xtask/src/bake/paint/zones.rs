//! The wrinkle zones after Jimenez et al. 2011: soft masks by muscle, and one low-resolution map of the wrinkles in them.
//! Lengths are millimetres on a face whose pupils are 60 mm apart; places are tuned by eye on renders.

use super::super::bust::{Encoded, PaintedZones, Region, SlopeMap};
use super::atlas::{Atlas, Texel, fill_gaps};
use super::chart::{Chart, Side, arch};
use super::noise::{lerp, smoothstep};
use super::wrinkles::Relief;
use super::{encode, slopes, wrinkles};
use anyhow::Result;
use glam::{Vec2, Vec3};

/// Texels a side of a mask, as in the paper.
const MASK: usize = 64;
/// Texels a side of the wrinkle map, as in the paper.
const MAP: usize = 256;
/// Slope no fold is steeper than, as in the maps of the poses.
const STEEPEST: f32 = 1.25;
/// How much steeper the low-resolution map is drawn than it comes out of the relief: averaging over a texel of about a
/// millimetre takes that much off the flanks of a furrow, and more off the narrow ones on the nose. Forehead, nose, chin;
/// tuned by eye.
const SHARPEN: [f32; 3] = [1.5, 2.0, 1.5];
/// Share of the resting face's creases that the stretch map takes out.
const SMOOTHED: f32 = 0.85;

/// In the order of the masks' channels, left and right being the character's: frontalis outer left and right, frontalis inner
/// left and right; corrugator and nasalis left and right, procerus, mentalis.
type Shares = [f32; 8];

/// Paints masks and maps. `atlas` is finer than both by whole factors.
pub fn paint(chart: &Chart, atlas: &Atlas) -> Result<PaintedZones> {
    let face = Face::new(chart);
    let shares = atlas.map(|texel| face.shares(texel));
    let masks = mask_codes(&reduced(atlas.size(), MASK, &shares));
    let pngs = [0, 4].map(|first| {
        let rgba: Vec<u8> = masks.iter().flat_map(|texel| [0, 1, 2, 3].map(|c| texel[first + c])).collect();
        encode::png_rgba(MASK, &rgba)
    });
    let [first, second] = pngs;

    let reliefs = ["stretch", "compress", "pucker"].map(|pose| wrinkles::relief(chart, pose));
    let [forehead, nose, chin] = reliefs;
    let folds = [(forehead?, 0..4), (nose?, 4..7), (chin?, 7..8)].map(|(relief, zones)| {
        let slopes = of_relief(atlas, |texel| shares_in(&face, texel, zones.clone()) > 0.0, &relief);
        let weight = |s: &Shares| s[zones.clone()].iter().sum::<f32>() / s.iter().sum::<f32>().max(0.02);
        (slopes, shares.iter().map(|s| s.as_ref().map_or(0.0, weight)).collect::<Vec<_>>())
    });
    let wrinkled: Vec<Option<[f32; 2]>> = (0..shares.len())
        .map(|i| {
            shares[i].as_ref()?;
            let sum = folds
                .iter()
                .zip(SHARPEN)
                .fold(Vec2::ZERO, |sum, ((slopes, weight), sharpen)| sum + Vec2::from(slopes[i].unwrap_or_default()) * weight[i] * sharpen);
            Some(sum.clamp_length_max(STEEPEST).to_array())
        })
        .collect();
    let wrinkled = reduced(atlas.size(), MAP, &wrinkled);

    let lines = wrinkles::permanent(chart);
    let smoothed = slopes::of_relief(atlas, 0.1, |texel| {
        let (normal, lines) = (texel.normal, &lines);
        (shares_in(&face, texel, 0..8) > 0.0).then_some(move |place: Vec3| -SMOOTHED * lines.height(place, normal))
    });
    let smoothed = reduced(atlas.size(), MAP, &smoothed);
    Ok(PaintedZones {
        masks: [first?, second?],
        difference: difference_map(&wrinkled)?,
        map: slope_map(&wrinkled)?,
        stretch: slope_map(&smoothed)?,
    })
}

fn of_relief(atlas: &Atlas, is_inside: impl Fn(&Texel) -> bool + Sync, relief: &Relief) -> Vec<Option<[f32; 2]>> {
    slopes::of_relief(atlas, 0.1, |texel| {
        let normal = texel.normal;
        is_inside(texel).then_some(move |place: Vec3| relief.height(place, normal))
    })
}

fn shares_in(face: &Face, texel: &Texel, zones: std::ops::Range<usize>) -> f32 {
    face.shares(texel)[zones].iter().sum()
}

/// Means of the covered texels under each texel of a picture of `to` a side; outside the islands as at the nearest of them.
fn reduced<const N: usize>(from: usize, to: usize, texels: &[Option<[f32; N]>]) -> Vec<[f32; N]> {
    let step = from / to;
    let means: Vec<Option<[f32; N]>> = (0..to * to)
        .map(|i| {
            let (mut sum, mut count) = ([0.0; N], 0.0);
            for k in 0..step * step {
                let (x, y) = (i % to * step + k % step, i / to * step + k / step);
                if let Some(texel) = texels[y * from + x] {
                    (0..N).for_each(|c| sum[c] += texel[c]);
                    count += 1.0;
                }
            }
            (count > 0.0).then(|| sum.map(|value| value / count))
        })
        .collect();
    fill_gaps(to, &means)
}

/// Codes that never sum to more than 255.
fn mask_codes(shares: &[Shares]) -> Vec<[u8; 8]> {
    let code = |shares: &Shares| {
        let mut codes = shares.map(|share| (255.0 * share.clamp(0.0, 1.0) + 0.5) as u8);
        while codes.iter().map(|&code| u32::from(code)).sum::<u32>() > 255 {
            let largest = (0..8).max_by_key(|&z| codes[z]).unwrap_or_default();
            codes[largest] -= 1;
        }
        codes
    };
    shares.iter().map(code).collect()
}

fn slope_map(texels: &[[f32; 2]]) -> Result<SlopeMap> {
    let texels: Vec<Option<[f32; 2]>> = texels.iter().copied().map(Some).collect();
    slopes::wrinkle_map(MAP, &texels)
}

/// Normals less the flat one, `(code - 128) / 127`.
fn difference_map(texels: &[[f32; 2]]) -> Result<Encoded> {
    let difference = |p: &[f32; 2]| Vec3::new(p[0], p[1], 1.0).normalize() - Vec3::Z;
    let rgb: Vec<u8> = texels.iter().flat_map(|p| difference(p).to_array().map(|d| slopes::code(d, 1.0))).collect();
    encode::png(MAP, &rgb)
}

/// Where the muscles are.
struct Face<'a> {
    chart: &'a Chart,
    /// Both brows from the right temple to the left, unrolled, smoothed.
    brows: Vec<Vec2>,
    /// Unrolled x of the outer end of the left brow.
    reach: f32,
    /// Unrolled y of the root of the nose, of where its bridge ends, and of its wings.
    root: f32,
    bridge: f32,
    wings: f32,
    chin: Vec2,
    /// z of the chin's front.
    chin_front: f32,
}

impl<'a> Face<'a> {
    fn new(chart: &'a Chart) -> Self {
        let brow = |side: Side| arch(&[22, 23, 24, 25, 26].map(|index| chart.at(side, index, (0.0, 0.0))));
        let y = |index: usize| chart.landmark(index).y;
        Self {
            chart,
            brows: brow(Side::Right).into_iter().rev().chain(brow(Side::Left)).collect(),
            reach: chart.at(Side::Left, 26, (0.0, 0.0)).x,
            root: y(27),
            bridge: y(28),
            wings: y(33),
            chin: chart.unroll(chart.landmark(57).lerp(chart.landmark(8), 0.64)),
            chin_front: chart.landmark(57).z.max(chart.landmark(8).z),
        }
    }

    fn brow_height(&self, x: f32) -> f32 {
        self.brows.iter().min_by(|a, b| (a.x - x).abs().total_cmp(&(b.x - x).abs())).map_or(0.0, |p| p.y)
    }

    /// How much of a place belongs to each zone; 1 in all at most.
    fn shares(&self, texel: &Texel) -> Shares {
        let outer_skin = smoothstep(0.5, 0.0, texel.share(Region::Mouth) + texel.share(Region::Socket)) * self.chart.front(texel.place);
        if outer_skin <= 0.0 {
            return [0.0; 8];
        }
        let at = self.chart.unroll(texel.place);
        let scale = self.chart.scale();
        let (x, across) = (at.x / scale, at.x.abs() / self.reach);
        let height = (at.y - self.brow_height(at.x)) / scale;
        let left = smoothstep(-7.0, 7.0, x);

        // Frontalis: from just over the brows to the hair; the two parts meet over the arch of the brow.
        let foot = lerp(9.0, 2.0, smoothstep(8.0, 26.0, x.abs()));
        let forehead = smoothstep(foot - 4.0, foot + 4.0, height) * smoothstep(56.0, 47.0, height) * smoothstep(1.22, 0.96, across);
        let outer = smoothstep(0.24, 0.56, across);

        // Corrugator, procerus, nasalis: between the brows and down the sides of the nose.
        let eyes = smoothstep(self.root + 8.0 * scale, self.root, at.y);
        let half = lerp(lerp(24.0, 17.0, eyes), 23.0, smoothstep(self.bridge, self.wings, at.y));
        let over_wings = smoothstep(self.wings - 9.0 * scale, self.wings + 1.0 * scale, at.y);
        let nose = smoothstep(half + 5.0, half - 5.0, x.abs()) * over_wings * smoothstep(19.0, 9.0, height) * (1.0 - forehead);
        let middle = smoothstep(12.0, 5.0, x.abs()) * smoothstep(self.bridge, self.root - 3.0 * scale, at.y);
        let nose_left = smoothstep(-3.5, 3.5, x);

        let chin = smoothstep(1.2, 0.6, ((at - self.chin) / (Vec2::new(22.0, 15.5) * scale)).length());
        // Skin under the jaw lies at the chin's height, too.
        let chin = chin * smoothstep(24.0 * scale, 12.0 * scale, self.chin_front - texel.place.z);
        [
            forehead * outer * left,
            forehead * outer * (1.0 - left),
            forehead * (1.0 - outer) * left,
            forehead * (1.0 - outer) * (1.0 - left),
            nose * (1.0 - middle) * nose_left,
            nose * (1.0 - middle) * (1.0 - nose_left),
            nose * middle,
            chin,
        ]
        .map(|share| share * outer_skin)
    }
}

#[cfg(test)]
mod tests {
    use super::super::sample::head;
    use super::*;

    /// Mean place of each zone, millimetres, weighted by its mask.
    fn centres(chart: &Chart, atlas: &Atlas) -> [Vec3; 8] {
        let face = Face::new(chart);
        let mut sums = [(Vec3::ZERO, 0.0); 8];
        for (place, shares) in atlas.map(|texel| (texel.place, face.shares(texel))).into_iter().flatten() {
            assert!(shares.iter().all(|share| (0.0..=1.0).contains(share)) && shares.iter().sum::<f32>() <= 1.0 + 1e-5, "{shares:?}");
            for (sum, share) in sums.iter_mut().zip(shares) {
                *sum = (sum.0 + place * share, sum.1 + share);
            }
        }
        sums.map(|(sum, total)| sum / total)
    }

    #[test]
    fn zones_lie_over_their_muscles_and_left_is_left() {
        let bust = head();
        let chart = Chart::new(&bust);
        let [red, green, blue, brown, cyan, magenta, orange, gray] = centres(&chart, &Atlas::new(&bust, 256));
        for (left, right) in [(red, green), (blue, brown), (cyan, magenta)] {
            assert!(left.x > 5.0 && right.x < -5.0, "{left} {right}");
            assert!((left.x + right.x).abs() < 3.0 && (left.y - right.y).abs() < 3.0, "{left} {right}");
        }
        // The sample face: brows at y 34, eyes 20, wings of the nose -24, mouth -45, chin -86.
        assert!(red.x > blue.x + 15.0 && red.y > 40.0 && blue.y > 45.0);
        assert!((-15.0..35.0).contains(&cyan.y) && orange.x.abs() < 2.0 && (10.0..40.0).contains(&orange.y));
        assert!(gray.x.abs() < 2.0 && (-85.0..-58.0).contains(&gray.y));
    }

    #[test]
    fn masks_and_maps_are_the_same_every_time_and_wrinkles_stay_in_the_zones() {
        let bust = head();
        let (chart, atlas) = (Chart::new(&bust), Atlas::new(&bust, 512));
        let first = paint(&chart, &atlas).expect("painted");
        let again = paint(&chart, &atlas).expect("painted");
        assert!(first.map.image.bytes == again.map.image.bytes && first.masks[1].bytes == again.masks[1].bytes);
        let masks = [0, 1].map(|m| image::load_from_memory(&first.masks[m].bytes).expect("a PNG").to_rgba8());
        let map = image::load_from_memory(&first.map.image.bytes).expect("a PNG").to_rgb8();
        assert_eq!((masks[0].dimensions(), map.dimensions()), ((64, 64), (256, 256)));
        let mut energy = [0.0_f64; 2];
        for (x, y, texel) in map.enumerate_pixels() {
            let sum: u32 = masks.iter().flat_map(|mask| mask.get_pixel(x / 4, y / 4).0).map(u32::from).sum();
            assert!(sum <= 255);
            energy[usize::from(sum > 0)] += [0, 1].map(|c| (f64::from(texel.0[c]) - 128.0).powi(2)).iter().sum::<f64>();
        }
        assert!(energy[1] > 1e4 && energy[0] < 0.01 * energy[1], "{energy:?}");
    }
}
