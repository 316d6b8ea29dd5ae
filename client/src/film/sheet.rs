//! The contact sheet: the film's strongest moments, with wrinkles and without.

use super::{Crew, FilmError, Moment};
use crate::renderer::{ViewMode, read_back};
use crate::view::{ACCENT, FAINT, Painter, TEXT, apply_look};
use egui::{Align2, Color32, ColorImage, CornerRadius, FontId, Pos2, Rect, TextureHandle, TextureOptions, pos2, vec2};
use image::RgbaImage;
use rhytid_shared::Character;

/// Moments in a row; there are two such pairs of rows.
const COLUMNS: usize = 5;
const PAIRS: usize = 2;
/// Side of a picture, pixels.
const CELL: f32 = 280.0;
const GAP: f32 = 8.0;
const MARGIN: f32 = 28.0;
/// Room for the title, and for the line under each pair.
const TITLE: f32 = 52.0;
const CAPTION: f32 = 36.0;
const BACKGROUND: Color32 = Color32::from_rgb(0x17, 0x18, 0x1b);
/// egui hands its textures to the painter through this format, already encoded for the screen.
const FORMAT: wgpu::TextureFormat = wgpu::TextureFormat::Rgba8Unorm;

/// Draws `moments` again where they are strongest, each with wrinkles and below without.
pub(super) fn contact_sheet(crew: &mut Crew, moments: &[Moment], title: &str) -> Result<RgbaImage, FilmError> {
    let chosen = choose(moments, COLUMNS * PAIRS);
    let context = egui::Context::default();
    apply_look(&context);
    let side = CELL as u32;
    let mut cells = Vec::with_capacity(chosen.len());
    for moment in chosen {
        let mut texture = |name: &str, view| -> Result<TextureHandle, FilmError> {
            let picture = crew.draw(&moment.frame, view, [side, side])?;
            let picture = ColorImage::from_rgba_unmultiplied([side as usize; 2], picture.as_raw());
            Ok(context.load_texture(name, picture, TextureOptions::LINEAR))
        };
        let pictures = [texture("with wrinkles", ViewMode::Beauty)?, texture("without", ViewMode::Bare)?];
        cells.push(Cell { pictures, time: moment.at.as_secs_f64(), strongest: strongest(moment, &crew.character) });
    }

    let pairs = cells.len().div_ceil(COLUMNS).max(1) as f32;
    let width = 2.0 * MARGIN + COLUMNS as f32 * (CELL + GAP) - GAP;
    let height = 2.0 * MARGIN + TITLE + pairs * (2.0 * CELL + GAP + CAPTION);
    let size = [width as u32, height as u32];
    let input = egui::RawInput { screen_rect: Some(Rect::from_min_size(Pos2::ZERO, vec2(width, height))), ..Default::default() };
    let output = context.run_ui(input, |ui| lay_out(ui.painter(), &cells, title, vec2(width, height)));
    paint(crew, &context, output, size)
}

struct Cell {
    pictures: [TextureHandle; 2],
    /// Seconds since the film began.
    time: f64,
    /// The reference pose that shows most, and how much.
    strongest: Option<(String, f32)>,
}

/// Of each of `count` equal parts of the film the moment whose wrinkles are strongest.
fn choose(moments: &[Moment], count: usize) -> Vec<&Moment> {
    let strength = |moment: &Moment| moment.frame.influences.iter().sum::<f32>();
    let parts = count.min(moments.len());
    (0..parts)
        .filter_map(|part| {
            let range = part * moments.len() / parts..(part + 1) * moments.len() / parts;
            moments[range].iter().max_by(|a, b| strength(a).total_cmp(&strength(b)))
        })
        .collect()
}

fn strongest(moment: &Moment, character: &Character) -> Option<(String, f32)> {
    let rows = moment.frame.influences.chunks(character.num_bones().max(1));
    let most = rows.map(|row| row.iter().copied().fold(0.0, f32::max));
    let (pose, most) = character.poses.iter().zip(most).max_by(|(_, a), (_, b)| a.total_cmp(b))?;
    (most >= 0.05).then(|| (pose.name.clone(), most))
}

fn lay_out(painter: &egui::Painter, cells: &[Cell], title: &str, size: egui::Vec2) {
    painter.rect_filled(Rect::from_min_size(Pos2::ZERO, size), CornerRadius::ZERO, BACKGROUND);
    let name = painter.text(pos2(MARGIN, MARGIN), Align2::LEFT_TOP, "Rhytid", FontId::proportional(26.0), TEXT);
    painter.text(pos2(name.right() + 14.0, name.bottom() - 4.0), Align2::LEFT_BOTTOM, title, FontId::proportional(15.0), FAINT);
    let legend = "above with wrinkles, below without";
    painter.text(pos2(size.x - MARGIN, name.bottom() - 4.0), Align2::RIGHT_BOTTOM, legend, FontId::proportional(15.0), FAINT);
    for (i, cell) in cells.iter().enumerate() {
        let left = MARGIN + (i % COLUMNS) as f32 * (CELL + GAP);
        let top = MARGIN + TITLE + (i / COLUMNS) as f32 * (2.0 * CELL + GAP + CAPTION);
        for (row, picture) in cell.pictures.iter().enumerate() {
            let at = Rect::from_min_size(pos2(left, top + row as f32 * (CELL + GAP / 2.0)), vec2(CELL, CELL));
            painter.image(picture.id(), at, Rect::from_min_max(pos2(0.0, 0.0), pos2(1.0, 1.0)), Color32::WHITE);
        }
        let y = top + 2.0 * CELL + GAP / 2.0 + 7.0;
        painter.text(pos2(left + 2.0, y), Align2::LEFT_TOP, format!("{:.1} s", cell.time), FontId::proportional(14.0), TEXT);
        if let Some((pose, most)) = &cell.strongest {
            let text = format!("{pose} {:.0} %", 100.0 * most);
            painter.text(pos2(left + CELL - 2.0, y), Align2::RIGHT_TOP, text, FontId::proportional(14.0), ACCENT);
        }
    }
}

fn paint(crew: &Crew, context: &egui::Context, mut output: egui::FullOutput, size: [u32; 2]) -> Result<RgbaImage, FilmError> {
    let (device, queue) = crew.headless.device();
    let texture = device.create_texture(&wgpu::TextureDescriptor {
        label: Some("contact sheet"),
        size: wgpu::Extent3d { width: size[0], height: size[1], depth_or_array_layers: 1 },
        mip_level_count: 1,
        sample_count: 1,
        dimension: wgpu::TextureDimension::D2,
        format: FORMAT,
        usage: wgpu::TextureUsages::RENDER_ATTACHMENT | wgpu::TextureUsages::COPY_SRC,
        view_formats: &[],
    });
    let view = texture.create_view(&wgpu::TextureViewDescriptor::default());
    let mut painter = Painter::new(device, FORMAT);
    painter.upload(device, queue, &mut output.textures_delta);
    let primitives = context.tessellate(output.shapes, output.pixels_per_point);
    let mut encoder = device.create_command_encoder(&wgpu::CommandEncoderDescriptor { label: Some("contact sheet") });
    painter.paint(device, queue, &mut encoder, &view, size, output.pixels_per_point, &primitives);
    let sheet = read_back(device, queue, encoder, &texture, size)?;
    painter.free(output.textures_delta);
    Ok(sheet)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::renderer::RenderFrame;
    use std::time::Duration;

    fn moment(k: u64, influence: f32) -> Moment {
        let frame = RenderFrame {
            points: Vec::new(),
            rotations: Vec::new(),
            influences: vec![influence],
            zones: Vec::new(),
            stretched: Vec::new(),
            shapes: None,
            head: Default::default(),
        };
        Moment { at: Duration::from_secs(k), frame }
    }

    #[test]
    fn strongest_moment_of_each_part_is_chosen_in_order() {
        let moments: Vec<Moment> = [0.1, 0.9, 0.2, 0.3, 0.0, 0.0, 0.5, 0.4].iter().zip(0..).map(|(&x, k)| moment(k, x)).collect();
        let at = |chosen: Vec<&Moment>| chosen.iter().map(|moment| moment.at.as_secs()).collect::<Vec<_>>();
        assert_eq!(at(choose(&moments, 2)), [1, 6]);
        assert_eq!(at(choose(&moments, 20)), [0, 1, 2, 3, 4, 5, 6, 7]);
        assert!(choose(&[], 20).is_empty());
    }
}
