//! What partial derivatives save over differences of normals.

use super::Result;
use super::easel::Easel;
use crate::renderer::{DrawSettings, RenderFrame, ViewMode, WrinkleSystem, ZoneBlend};
use crate::sheet::{Cell, Content, Row, Sheet};
use crate::view::expressions::SURPRISE;
use glam::Vec3;
use std::time::Instant;

/// Pairs measured, and pairs before them that warm up caches and compile shaders.
const PAIRS: usize = 41;
const WARM_UP: usize = 3;
const SIZE: [u32; 2] = [512, 512];

/// Draws with both in turn and shows the median of the paired ratios.
pub(super) fn derivatives_against_differences(easel: &mut Easel) -> Result<Sheet> {
    // Stretched skin is a map of its own, which differences do without: the paper compares one map with one map.
    let mut easel = easel.variant(|asset| asset.zones.iter_mut().for_each(|zones| zones.stretch_scale = 0.0))?;
    let frame = easel.expression(SURPRISE.weights, &[("surprise", 1.0)])?;
    // The forehead fills the picture: every fragment is wrinkled.
    let marks = &easel.character().ibug68;
    let (brows, width) = ((marks[19] + marks[24]) * 0.5, marks[17].distance(marks[26]));
    let settings = DrawSettings { system: WrinkleSystem::Zones, ..easel.close_up(brows + 0.25 * width * Vec3::Y, 0.6 * width) };
    let mut row = Row::default();
    for (blend, caption) in [(ZoneBlend::PartialDerivatives, "partial derivatives"), (ZoneBlend::Difference, "differences")] {
        row.cells.push(Cell::new(easel.draw([420, 420], &DrawSettings { zone_blend: blend, ..settings }, &frame)?, caption));
    }
    let mut bars = Vec::new();
    for (view, what) in [(ViewMode::Normals, "normals only"), (ViewMode::Beauty, "whole skin renderer")] {
        let (ratio, times) = compare(&mut easel, &DrawSettings { view, ..settings }, &frame)?;
        bars.push((format!("{what}: derivatives"), times[0] / times[0].max(times[1]), format!("{:.1} ms", times[0])));
        bars.push((format!("{what}: differences"), times[1] / times[0].max(times[1]), format!("{:.1} ms", times[1])));
        bars.push(("  median of the paired ratios".into(), 0.0, format!("{ratio:.3} ×")));
    }
    bars.push(("the paper, GeForce 8600 GT".into(), 0.0, "1.12 ×".into()));
    bars.push(("the paper, GeForce 9800 GTX+, 295 GTX".into(), 0.0, "1.00 ×".into()));
    row.cells.push(Cell {
        content: Content::Bars { size: [620, 420], bars },
        caption: format!("{} × {} pixels on {}, {PAIRS} pairs drawn in turn", SIZE[0], SIZE[1], easel.headless().adapter().name),
        note: String::new(),
    });
    let subtitle = "partial derivatives against differences of normals".into();
    Ok(Sheet { title: "Jimenez et al. 2011, 1.2.1".into(), subtitle, rows: vec![row] })
}

/// Median ratio of differences to derivatives, and the median times of derivatives and differences, milliseconds.
fn compare(easel: &mut Easel, settings: &DrawSettings, frame: &RenderFrame) -> Result<(f32, [f32; 2])> {
    let blends = [ZoneBlend::PartialDerivatives, ZoneBlend::Difference];
    let (mut ratios, mut times) = (Vec::new(), [Vec::new(), Vec::new()]);
    for pair in 0..PAIRS + WARM_UP {
        let mut milliseconds = [0.0; 2];
        // Who goes first alternates, so that a drift of the machine favours neither.
        for k in [pair % 2, 1 - pair % 2] {
            let begun = Instant::now();
            easel.headless().draw_only(SIZE, &DrawSettings { zone_blend: blends[k], ..*settings }, frame)?;
            milliseconds[k] = 1e3 * begun.elapsed().as_secs_f32();
        }
        if pair >= WARM_UP {
            ratios.push(milliseconds[1] / milliseconds[0]);
            (0..2).for_each(|k| times[k].push(milliseconds[k]));
        }
    }
    Ok((median(ratios), times.map(median)))
}

fn median(mut values: Vec<f32>) -> f32 {
    values.sort_by(f32::total_cmp);
    values[values.len() / 2]
}
