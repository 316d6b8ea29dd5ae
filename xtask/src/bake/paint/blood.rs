//! Blood under the skin, and where it comes and goes as the face moves. Contracted muscles and pressed skin lose blood, what
//! is drawn together around them fills; a smile flushes the cheeks, anger the brow. Amounts are optical densities along
//! haemoglobin's direction, after the in-vivo measurements of Jimenez, Scully and others 2010 in kind, by eye in measure.

use super::super::bust::{BloodMap, BloodMaps, Bust};
use super::atlas::{Atlas, Texel, fill_gaps};
use super::chart::Side;
use super::encode;
use super::features::{Features, Marks};
use super::noise::{bell, fractal, lerp, smoothstep};
use super::skin;
use anyhow::{Result, bail};
use glam::Vec2;

/// Texels a side of the maps.
const SIDE: usize = 64;
/// Samples a texel and axis: lips are a few texels high.
const SAMPLES: usize = 4;
/// Haemoglobin of an ordinary place, and of lips, which hold so much more as their colour says.
const SKIN_BLOOD: f32 = 0.40;
const LIP_BLOOD: f32 = 1.60;
/// Most a place can hold.
const MOST: f32 = 2.0;
/// What the codes of the changes reach.
const SPREAD: f32 = 1.0;
const SHIFT: f32 = 0.30;
/// Standard deviation of the mean all round, texels.
const BLUR: f32 = 2.0;

/// Paints the blood at rest and the change of each pose.
pub fn paint(bust: &Bust, features: &Features) -> Result<BloodMaps> {
    let atlas = Atlas::new(bust, SIDE * SAMPLES);
    let middle = features.chart.middle(&[27, 30, 33, 8]).x;
    let at_rest =
        averaged(&fill_gaps(SIDE * SAMPLES, &atlas.map(|texel| [amount(features, texel), smoothstep(-9.0, 9.0, texel.place.x - middle)])));
    let amounts: Vec<f32> = at_rest.iter().map(|texel| texel[0]).collect();
    let share = |value: f32| (value.clamp(0.0, 1.0) * 255.0 + 0.5) as u8;
    let base: Vec<u8> = at_rest
        .iter()
        .zip(blurred(&amounts))
        .flat_map(|(&[amount, left], mean)| [share(amount / MOST), share(mean / MOST), share(left)])
        .collect();
    let changes = bust.poses.iter().map(|pose| {
        let change = change_of(pose.name)?;
        let texels = atlas.map(|texel| {
            let marks = features.marks(texel);
            // Under hair, in the mouth and in the pocket of the lids nothing shows.
            let seen = (1.0 - marks.hair) * (1.0 - marks.mouth) * (1.0 - marks.socket) * (1.0 - 0.5 * marks.brow);
            // Vessels are not evenly strewn.
            let uneven = 1.0 + 0.22 * fractal(texel.place / 9.0, 2, 501);
            let shift = change(&Place { features, marks, texel }) * seen * uneven;
            // More blood shows the vessels' pattern, less evens it out.
            [2.0 * shift, shift]
        });
        let signed = |value: f32| (value.clamp(-1.0, 1.0) * 127.0 + 128.5) as u8;
        let rgb: Vec<u8> = averaged(&fill_gaps(SIDE * SAMPLES, &texels))
            .iter()
            .flat_map(|&[spread, shift]| [signed(spread / SPREAD), signed(shift / SHIFT), 128])
            .collect();
        Ok(BloodMap { pose: pose.name, image: encode::png(SIDE, &rgb)?, spread: SPREAD, shift: SHIFT })
    });
    Ok(BloodMaps { base: encode::png(SIDE, &base)?, most: MOST, changes: changes.collect::<Result<_>>()? })
}

fn amount(features: &Features, texel: &Texel) -> f32 {
    let marks = features.marks(texel);
    lerp(SKIN_BLOOD + skin::blood(features, texel.place, &marks), LIP_BLOOD, marks.lip).clamp(0.0, MOST)
}

/// A place on the skin, seen by the one who draws.
struct Place<'a> {
    features: &'a Features<'a>,
    marks: Marks,
    texel: &'a Texel,
}

impl Place<'_> {
    /// A soft patch about a point relative to a landmark of the left half, or its mirror image: millimetres away from the middle
    /// and up, and its radii.
    fn patch(&self, index: usize, offset: (f32, f32), radius: (f32, f32)) -> f32 {
        let chart = self.features.chart;
        let side = if self.texel.place.x >= 0.0 { Side::Left } else { Side::Right };
        let away = chart.unroll(self.texel.place) - chart.at(side, index, offset);
        bell((away / (Vec2::new(radius.0, radius.1) * chart.scale())).length(), 1.0) * chart.front(self.texel.place)
    }
}

type Change = fn(&Place<'_>) -> f32;

fn change_of(pose: &str) -> Result<Change> {
    Ok(match pose {
        "stretch" => stretch,
        "compress" => compress,
        "smile" => smile,
        "pucker" => pucker,
        other => bail!("nobody knows what blood does in the pose {other:?}"),
    })
}

/// The forehead's skin is folded by the muscle under it: pale, but for a little colour over the brows, where it is bunched.
fn stretch(at: &Place<'_>) -> f32 {
    let brows = at.patch(24, (0.0, 4.0), (17.0, 6.0));
    -0.15 * at.marks.forehead + 0.13 * brows + 0.07 * at.patch(22, (-6.0, 4.0), (9.0, 8.0)) - 0.05 * at.marks.upper_lid
}

/// Anger: the glabella and all above the eyes flush, cheeks and nose a little; the heads of the brows and the sides of the nose
/// are pressed pale.
fn compress(at: &Place<'_>) -> f32 {
    let glabella = at.patch(27, (0.0, 9.0), (14.0, 16.0));
    let pressed = at.patch(22, (4.0, 3.0), (6.0, 5.0)).max(0.7 * at.patch(31, (10.0, 9.0), (4.0, 6.0)));
    0.24 * glabella
        + 0.08 * at.marks.forehead * smoothstep(-60.0, 0.0, -(at.texel.place.x.abs()))
        + 0.07 * at.marks.cheek
        + 0.07 * at.marks.nose
        - 0.11 * pressed * (1.0 - 0.6 * glabella)
}

/// Cheeks are pushed up and flush, the folds beside the mouth take colour on their inner side and lose it on the crest; lips
/// stretch and pale.
fn smile(at: &Place<'_>) -> f32 {
    let cheeks = at.patch(46, (4.0, -20.0), (17.0, 13.0));
    let fold = at.patch(54, (6.0, 16.0), (4.5, 13.0));
    let crest = at.patch(54, (14.0, 14.0), (4.5, 14.0));
    0.24 * cheeks + 0.06 * at.marks.nose_tip + 0.07 * fold - 0.10 * crest * (1.0 - cheeks) - 0.20 * at.marks.lip - 0.06 * at.marks.chin
}

/// Lips are pressed full inside and pale at their rim, the ring of muscle round them and the chin pale.
fn pucker(at: &Place<'_>) -> f32 {
    let inside = at.marks.lip * at.marks.lip_gap;
    let round = at.patch(51, (0.0, 6.0), (20.0, 7.0)).max(at.patch(57, (0.0, -5.0), (18.0, 6.0)));
    0.24 * inside
        - 0.20 * at.marks.lip_rim * (1.0 - at.marks.lip_gap)
        - 0.09 * round * (1.0 - at.marks.lip)
        - 0.17 * at.marks.chin * (1.0 - at.marks.lip)
}

/// Mean of each texel's samples.
fn averaged<const N: usize>(samples: &[[f32; N]]) -> Vec<[f32; N]> {
    (0..SIDE * SIDE)
        .map(|i| {
            let (x, y) = (i % SIDE * SAMPLES, i / SIDE * SAMPLES);
            let mut sum = [0.0; N];
            for at in (0..SAMPLES * SAMPLES).map(|k| (y + k / SAMPLES) * SIDE * SAMPLES + x + k % SAMPLES) {
                sum.iter_mut().zip(samples[at]).for_each(|(sum, value)| *sum += value / (SAMPLES * SAMPLES) as f32);
            }
            sum
        })
        .collect()
}

/// Gaussian blur, held at the border.
fn blurred(values: &[f32]) -> Vec<f32> {
    let reach = (3.0 * BLUR) as isize;
    let pass = |values: &[f32], step: [isize; 2]| -> Vec<f32> {
        (0..(SIDE * SIDE) as isize)
            .map(|i| {
                let (x, y) = (i % SIDE as isize, i / SIDE as isize);
                let (mut sum, mut total) = (0.0, 0.0);
                for k in -reach..=reach {
                    let weight = bell(k as f32, BLUR * std::f32::consts::SQRT_2);
                    let held = |v: isize| v.clamp(0, SIDE as isize - 1);
                    sum += weight * values[(held(y + k * step[1]) * SIDE as isize + held(x + k * step[0])) as usize];
                    total += weight;
                }
                sum / total
            })
            .collect()
    };
    pass(&pass(values, [1, 0]), [0, 1])
}

#[cfg(test)]
mod tests {
    use super::super::chart::Chart;
    use super::super::sample::head;
    use super::*;

    /// Mean shift of a pose about a landmark of the left half, optical density.
    fn shift(pose: &str, index: usize, offset: (f32, f32)) -> f32 {
        let bust = head();
        let chart = Chart::new(&bust);
        let features = Features::new(&chart, &bust);
        let atlas = Atlas::new(&bust, 256);
        let change = change_of(pose).expect("a known pose");
        let middle = chart.at(Side::Left, index, offset);
        let all: Vec<f32> = atlas
            .map(|texel| {
                let is_near = (chart.unroll(texel.place) - middle).length() < 5.0 && chart.front(texel.place) > 0.5;
                is_near.then(|| change(&Place { features: &features, marks: features.marks(texel), texel }))
            })
            .into_iter()
            .flatten()
            .flatten()
            .collect();
        all.iter().sum::<f32>() / all.len() as f32
    }

    #[test]
    fn blood_goes_where_faces_flush_and_pale() {
        assert!(shift("smile", 46, (4.0, -20.0)) > 0.15);
        assert!(shift("compress", 27, (0.0, 10.0)) > 0.12);
        let forehead = shift("stretch", 22, (-4.0, 32.0));
        assert!(forehead < -0.10, "{forehead}");
        assert!(shift("pucker", 8, (0.0, 6.0)) < -0.05);
        assert!(change_of("surprise").is_err());
    }

    #[test]
    fn blur_keeps_the_mean_and_an_even_field() {
        let mut values = vec![0.0; SIDE * SIDE];
        values[32 * SIDE + 32] = 1.0;
        let sum: f32 = blurred(&values).iter().sum();
        assert!((sum - 1.0).abs() < 1e-3, "{sum}");
        assert!(blurred(&vec![0.5; SIDE * SIDE]).iter().all(|v| (v - 0.5).abs() < 1e-5));
    }

    #[test]
    fn averages_are_of_a_texel_s_own_samples() {
        let mut samples = vec![[0.0]; SIDE * SIDE * SAMPLES * SAMPLES];
        samples[..SAMPLES].iter_mut().for_each(|sample| *sample = [1.0]);
        assert_eq!(averaged(&samples)[0], [1.0 / SAMPLES as f32]);
        assert_eq!(averaged(&samples)[1], [0.0]);
    }
}
