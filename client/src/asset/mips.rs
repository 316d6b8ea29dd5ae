//! Mip chains made on the CPU, each kind of texel averaged by its meaning.

use image::RgbaImage;
use std::sync::LazyLock;

/// What the texels of a map mean: decides how four of them become one.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Texels {
    /// sRGB-encoded RGB with linear alpha: light is averaged, weighted by alpha. 4 bytes.
    AlbedoSrgb,
    /// Partial derivatives in red and green: the mean of slopes is the slope of the mean surface. 2 bytes.
    Slopes,
    /// Linear values in red and green (occlusion, roughness). 2 bytes.
    Linear2,
    /// Four linear values (masks, differences of normals, occlusion with roughness and intensity). 4 bytes.
    Linear4,
}

impl Texels {
    /// Bytes a texel.
    pub fn size(self) -> usize {
        match self {
            Self::AlbedoSrgb | Self::Linear4 => 4,
            Self::Slopes | Self::Linear2 => 2,
        }
    }
}

/// A map with all its smaller versions down to 1 × 1.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct MipChain {
    /// Width and height of the largest.
    pub size: [u32; 2],
    /// What a texel means.
    pub texels: Texels,
    /// Levels, the largest first, rows tightly packed.
    pub levels: Vec<Vec<u8>>,
}

impl MipChain {
    /// The chain of a picture; kinds of two bytes take its red and green.
    pub fn new(image: &RgbaImage, texels: Texels) -> Self {
        let base = match texels {
            Texels::AlbedoSrgb | Texels::Linear4 => image.as_raw().clone(),
            Texels::Slopes | Texels::Linear2 => image.as_raw().as_chunks::<4>().0.iter().flat_map(|&[r, g, _, _]| [r, g]).collect(),
        };
        Self::from_texels([image.width(), image.height()], texels, base)
    }

    /// The chain of texels already in their layout; `base` holds `width * height * texels.size()` bytes.
    pub fn from_texels(size: [u32; 2], texels: Texels, base: Vec<u8>) -> Self {
        let mut levels = vec![base];
        let mut of = size;
        while of != [1, 1] {
            let next = [(of[0] / 2).max(1), (of[1] / 2).max(1)];
            let level = halve(&levels[levels.len() - 1], of, next, texels);
            levels.push(level);
            of = next;
        }
        Self { size, texels, levels }
    }

    /// One colour everywhere.
    pub fn uniform(size: [u32; 2], texels: Texels, texel: &[u8]) -> Self {
        Self::from_texels(size, texels, texel.repeat((size[0] * size[1]) as usize))
    }

    /// Bytes of all levels.
    pub fn num_bytes(&self) -> usize {
        self.levels.iter().map(Vec::len).sum()
    }
}

fn halve(from: &[u8], size: [u32; 2], to: [u32; 2], texels: Texels) -> Vec<u8> {
    match texels {
        Texels::Slopes | Texels::Linear2 => halve_by(from, size, to, quarters::<2>),
        Texels::Linear4 => halve_by(from, size, to, quarters::<4>),
        Texels::AlbedoSrgb => halve_by(from, size, to, |four| SRGB.mean(four)),
    }
}

/// `mean` makes one texel of four: the upper two, then the lower two. A side of one texel counts it twice; of another odd side the last
/// row or column is left out.
fn halve_by<const N: usize>(
    from: &[u8],
    [width, height]: [u32; 2],
    [to_width, to_height]: [u32; 2],
    mean: impl Fn([[u8; N]; 4]) -> [u8; N],
) -> Vec<u8> {
    let [width, height, to_width, to_height] = [width, height, to_width, to_height].map(|side| side as usize);
    let from = from.as_chunks::<N>().0;
    let mut to = Vec::with_capacity(to_width * to_height * N);
    for y in 0..to_height {
        let row = |dy: usize| &from[(2 * y + dy).min(height - 1) * width..][..width];
        let (upper, lower) = (row(0), row(1));
        if width == 1 {
            to.extend(mean([upper[0], upper[0], lower[0], lower[0]]));
        }
        for (upper, lower) in upper.as_chunks::<2>().0.iter().zip(lower.as_chunks::<2>().0) {
            to.extend(mean([upper[0], upper[1], lower[0], lower[1]]));
        }
    }
    to
}

fn quarters<const N: usize>(four: [[u8; N]; 4]) -> [u8; N] {
    std::array::from_fn(|channel| quarter(four.iter().map(|texel| u32::from(texel[channel])).sum()))
}

/// A fourth of the sum of four codes. Halves go to the even code: always up would tilt a surface by an eighth of a code a
/// level, and as code 128 is even and flat, opposite slopes stay opposite.
fn quarter(sum: u32) -> u8 {
    let (down, left_over) = (sum / 4, sum % 4);
    (down + u32::from(left_over == 3 || (left_over == 2 && down % 2 == 1))) as u8
}

static SRGB: LazyLock<Srgb> = LazyLock::new(Srgb::new);

/// The sRGB curve as tables: a power for each texel is what an albedo map's chain would take longest for.
struct Srgb {
    /// Light of a code.
    linear: [f32; 256],
    /// Least light that becomes a code, and for the last code's sake one that none reaches.
    least: [f32; 257],
    /// The code of the least light of each of `BINS` equal shares of it.
    code: Vec<u8>,
}

impl Srgb {
    /// Enough that no share holds more than a few codes.
    const BINS: usize = 2048;

    fn new() -> Self {
        let linear_of = |encoded: f32| if encoded <= 0.04045 { encoded / 12.92 } else { ((encoded + 0.055) / 1.055).powf(2.4) };
        let least = std::array::from_fn(|code| match code {
            0 => 0.0,
            256 => f32::INFINITY,
            code => linear_of((code as f32 - 0.5) / 255.0),
        });
        let code_of = |light: f32| (least.partition_point(|least| *least <= light) - 1) as u8;
        Self {
            linear: std::array::from_fn(|code| linear_of(code as f32 / 255.0)),
            code: (0..=Self::BINS).map(|bin| code_of(bin as f32 / Self::BINS as f32)).collect(),
            least,
        }
    }

    /// The nearest code; light above 1 is white.
    fn encode(&self, light: f32) -> u8 {
        let mut code = self.code[((light * Self::BINS as f32) as usize).min(Self::BINS)];
        while light >= self.least[usize::from(code) + 1] {
            code += 1;
        }
        code
    }

    /// Mean light, weighted by alpha where there is any.
    fn mean(&self, four: [[u8; 4]; 4]) -> [u8; 4] {
        let alphas = four.map(|texel| f32::from(texel[3]));
        let alpha: f32 = alphas.iter().sum();
        let (shares, whole) = if alpha > 0.0 { (alphas, alpha) } else { ([1.0; 4], 4.0) };
        let light = |channel: usize| {
            let sum: f32 = four.iter().zip(shares).map(|(texel, share)| self.linear[usize::from(texel[channel])] * share).sum();
            self.encode(sum / whole)
        };
        [light(0), light(1), light(2), (alpha / 4.0 + 0.5) as u8]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn chain_ends_at_one_texel_and_keeps_flat_slopes_flat() {
        let chain = MipChain::uniform([8, 2], Texels::Slopes, &[128, 128]);
        assert_eq!(chain.levels.iter().map(Vec::len).collect::<Vec<_>>(), [32, 8, 4, 2]);
        assert!(chain.levels.iter().flatten().all(|&code| code == 128));
    }

    #[test]
    fn slopes_average_as_slopes() {
        // Two opposite slopes side by side are a flat surface from afar.
        let chain = MipChain::from_texels([2, 1], Texels::Slopes, vec![128 + 100, 128, 128 - 100, 128 + 40]);
        assert_eq!(chain.levels[1], [128, 148]);
    }

    /// Pseudo-random codes 1 to 255, red and green.
    fn rough_texels(num_texels: usize) -> Vec<u8> {
        let mut state = 1_u32;
        let mut next = || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (1 + (state >> 8) % 255) as u8
        };
        (0..num_texels * 2).map(|_| next()).collect()
    }

    #[test]
    fn any_uniform_slope_stays_what_it_is_down_to_one_texel() {
        for code in 0..=255 {
            let chain = MipChain::uniform([16, 4], Texels::Slopes, &[code, 255 - code]);
            assert!(chain.levels.iter().all(|level| level.as_chunks::<2>().0.iter().all(|texel| *texel == [code, 255 - code])), "{code}");
        }
    }

    #[test]
    fn opposite_slopes_stay_opposite_down_to_one_texel() {
        let texels = rough_texels(64 * 64);
        let opposite = texels.iter().map(|code| (256 - u32::from(*code)) as u8).collect();
        let chains = [texels, opposite].map(|base| MipChain::from_texels([64, 64], Texels::Slopes, base));
        for (level, opposite) in chains[0].levels.iter().zip(&chains[1].levels) {
            assert!(level.iter().zip(opposite).all(|(a, b)| u32::from(*a) + u32::from(*b) == 256), "{} bytes", level.len());
        }
    }

    /// Steep slopes, and slopes of a code or two, where rounding is most of what there is.
    #[test]
    fn slopes_of_mean_zero_keep_it() {
        for shallow in [1.0, 0.02] {
            // Each texel and, scattered elsewhere, its opposite: the mean is exactly 128.
            let half: Vec<u8> =
                rough_texels(512 * 256).iter().map(|code| (128.0 + (f32::from(*code) - 128.0) * shallow).round() as u8).collect();
            let opposite = (0..half.len()).map(|i| (256 - u32::from(half[i * 40_503 % half.len()])) as u8);
            let chain = MipChain::from_texels([512, 512], Texels::Slopes, half.iter().copied().chain(opposite).collect());
            // With fewer texels than that the mean of what rounding leaves of each is no longer small.
            for level in chain.levels.iter().filter(|level| level.len() >= 2 * 64 * 64) {
                let mean = level.iter().map(|code| f64::from(*code)).sum::<f64>() / level.len() as f64;
                assert!((mean - 128.0).abs() < 0.02, "mean {mean} of a level of {} bytes", level.len());
            }
        }
    }

    #[test]
    fn albedo_averages_light_not_codes() {
        let chain = MipChain::from_texels([2, 1], Texels::AlbedoSrgb, vec![0, 0, 0, 255, 255, 255, 255, 255]);
        assert_eq!(chain.levels[1], [188, 188, 188, 255]);
    }

    #[test]
    fn every_code_survives_the_tables_of_srgb_and_light_between_two_goes_to_the_nearer() {
        let encoded = |light: f32| if light <= 0.003_130_8 { light * 12.92 } else { 1.055 * light.powf(1.0 / 2.4) - 0.055 };
        for code in 0..=255 {
            assert_eq!(SRGB.encode(SRGB.linear[usize::from(code)]), code);
        }
        for i in 0..=100_000 {
            let light = i as f32 / 100_000.0;
            let (got, exact) = (f32::from(SRGB.encode(light)), encoded(light) * 255.0);
            assert!((got - exact).abs() < 0.501, "{light} becomes {got}, {exact} expected");
        }
        assert_eq!(SRGB.encode(1.5), 255);
    }

    #[test]
    fn odd_edges_count_no_texel_of_another_row() {
        let chain = MipChain::from_texels([3, 1], Texels::Linear2, vec![10, 20, 30, 40, 250, 250]);
        assert_eq!(chain.levels[1], [20, 30]);
        let chain = MipChain::from_texels([1, 3], Texels::Linear2, vec![10, 20, 30, 40, 250, 250]);
        assert_eq!(chain.levels[1], [20, 30]);
    }

    #[test]
    fn clear_texels_do_not_stain_their_neighbours() {
        let chain = MipChain::from_texels([2, 1], Texels::AlbedoSrgb, vec![255, 0, 255, 0, 40, 30, 20, 255]);
        assert_eq!(chain.levels[1], [40, 30, 20, 128]);
    }
}
