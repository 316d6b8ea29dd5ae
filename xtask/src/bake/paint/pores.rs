//! The relief of the resting skin: pores, the net of fine creases, lip folds, faint lines, stubs of hair.

use super::super::bust::SlopeMap;
use super::atlas::{Atlas, Texel};
use super::features::{Features, Marks};
use super::furrow::Furrows;
use super::hairs::Hairs;
use super::noise::{cells, fractal, lerp, noise, smoothstep};
use super::{encode, slopes};
use anyhow::Result;
use glam::Vec3;

/// Height of a hair over the skin as the map shows it, mm.
const HAIR_HEIGHT: f32 = 0.03;

/// What the pattern is like at one place.
struct Grain {
    /// Distance between pores, mm.
    period: f32,
    /// Depth of pores, mm.
    pore: f32,
    /// Depth of the creases between them, mm.
    crease: f32,
    /// Direction along which pores are drawn out, with their elongation.
    pull: Vec3,
    /// Depth of the upright folds of the lips, mm.
    fold: f32,
    /// Height of soft unevenness, mm.
    lumps: f32,
    /// Under dense hair, where pores do not show.
    is_hidden: bool,
}

/// Paints the base slope map.
pub fn paint(atlas: &Atlas, features: &Features, hairs: &Hairs, lines: &Furrows) -> Result<SlopeMap> {
    let size = atlas.size();
    let mut heights = atlas.map(|texel| {
        let marks = features.marks(texel);
        let outside = 1.0 - marks.mouth.max(marks.socket);
        outside * grain(features, texel, &marks).height(texel.place) + lines.height(texel.place, texel.normal)
    });
    for (height, cover) in heights.iter_mut().zip(&hairs.cover) {
        *height = height.map(|h| h + HAIR_HEIGHT * cover);
    }
    let slopes = slopes::of_heights(atlas, &heights);
    let scale = slopes::scale_for(&slopes, 1e-3);
    let image = encode::jpeg(size, &slopes::encode_map(size, &slopes, scale, false), 78)?;
    Ok(SlopeMap { image, scale })
}

fn grain(features: &Features, texel: &Texel, marks: &Marks) -> Grain {
    let chart = features.chart;
    let coarse = (marks.nose_tip + 0.55 * marks.cheek + 0.4 * marks.forehead + 0.35 * marks.chin).min(1.0);
    let delicate = (marks.upper_lid + marks.under_eye + marks.waterline).min(1.0);
    let bare = 1.0 - marks.lip;
    let beside = texel.place - chart.landmark(30);
    // Skin of the cheeks is drawn down and outward, that of the neck across.
    let pull = Vec3::new(0.5 * beside.x.signum(), -1.0, -0.3).lerp(Vec3::X, marks.neck).normalize();
    let pull = (pull - texel.normal * texel.normal.dot(pull)).normalize_or(texel.tangent);
    Grain {
        period: lerp(lerp(0.95, 1.25, coarse), 0.75, delicate),
        pore: bare * lerp(lerp(0.030, 0.085, coarse), 0.008, delicate) * (1.0 - 0.7 * marks.hair) * (1.0 - 0.6 * marks.ear),
        crease: bare * lerp(0.028, 0.030, delicate) * (1.0 - 0.5 * marks.ear),
        pull: pull * lerp(0.30, 0.12, coarse),
        fold: 0.07 * marks.lip,
        lumps: bare * lerp(0.045, 0.075, marks.chin.max(marks.neck * 0.6)),
        is_hidden: marks.hair > 0.98,
    }
}

impl Grain {
    fn height(&self, p: Vec3) -> f32 {
        let lumps = self.lumps * fractal(p / 2.6, 2, 206);
        if self.is_hidden {
            return lumps;
        }
        let stretched = p - self.pull * p.dot(self.pull) / self.pull.length();
        let pores = cells(stretched / self.period, 201);
        let radius = lerp(0.20, 0.40, (pores.id & 255) as f32 / 255.0);
        let pit = smoothstep(radius * 1.5, 0.0, pores.first) * smoothstep(0.1, 1.0, ((pores.id >> 8) & 255) as f32 / 255.0);
        let warp = Vec3::new(noise(p / 1.7, 202), noise(p / 1.7, 203), noise(p / 1.7, 204)) * 0.35;
        let net = cells((stretched + warp) / (self.period * 0.78), 205);
        let crease = smoothstep(0.22, 0.0, net.second - net.first);
        let mut height = -self.pore * pit - self.crease * crease + lumps;
        if self.fold > 0.0 {
            let fold = noise(Vec3::new((p.x + 0.7 * noise(p / 2.6, 207)) / 0.95, p.y / 8.0, 0.5), 208);
            let fine = noise(Vec3::new((p.x + 0.4 * noise(p / 1.3, 209)) / 0.45, p.y / 4.0, 1.5), 210);
            height -= self.fold * (smoothstep(0.0, 0.6, fold) + 0.4 * fine);
        }
        height
    }
}
