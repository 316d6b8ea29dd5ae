//! Pictures in rows with captions, laid out as one picture.

use crate::renderer::{RenderError, picture_texture, read_back};
use crate::view::{ACCENT, FAINT, Painter, TEXT, apply_look};
use egui::{Align2, Color32, ColorImage, CornerRadius, FontId, Pos2, Rect, Stroke, TextureHandle, TextureOptions, Vec2, pos2, vec2};
use image::RgbaImage;

const GAP: f32 = 8.0;
const MARGIN: f32 = 28.0;
/// Room for the title.
const TITLE: f32 = 52.0;
/// Between a picture and its caption, and between a caption and the next row.
const AIR: f32 = 7.0;
const AFTER_CAPTION: f32 = 14.0;
const BACKGROUND: Color32 = Color32::from_rgb(0x17, 0x18, 0x1b);
const SLATE: Color32 = Color32::from_rgb(0x24, 0x26, 0x2a);
/// Bars of what is taken away.
const NEGATIVE: Color32 = Color32::from_rgb(0x5f, 0x8f, 0xc9);
/// egui hands its textures to the painter through this format, already encoded for the screen.
const FORMAT: wgpu::TextureFormat = wgpu::TextureFormat::Rgba8Unorm;
/// No sheet is larger, pixels a side: what WebGL2 guarantees is half of it, what draws sheets has more.
const MAX_SIDE: f32 = 8192.0;

/// A sheet.
#[derive(Debug, Default)]
pub(crate) struct Sheet {
    /// What it shows.
    pub(crate) title: String,
    /// A little more, behind the title.
    pub(crate) subtitle: String,
    /// From above to below.
    pub(crate) rows: Vec<Row>,
}

/// Cells side by side.
#[derive(Debug, Default)]
pub(crate) struct Row {
    /// A line above the row; none where it is empty.
    pub(crate) heading: String,
    /// From left to right.
    pub(crate) cells: Vec<Cell>,
}

/// A picture with its caption.
#[derive(Debug)]
pub(crate) struct Cell {
    /// The picture.
    pub(crate) content: Content,
    /// What it says below, wrapped to the picture's width; nothing where it is empty.
    pub(crate) caption: String,
    /// A word at the right end of the caption's first line.
    pub(crate) note: String,
}

/// What a cell shows.
#[derive(Debug)]
pub(crate) enum Content {
    /// A picture, as large as it is.
    Picture(RgbaImage),
    /// Lines through points and the points, on a slate.
    Lines {
        /// Width and height of the slate, pixels.
        size: [u32; 2],
        /// Points in pixels from the slate's upper left corner; each line joins its own.
        lines: Vec<Vec<[f32; 2]>>,
    },
    /// Horizontal bars with names and numbers.
    Bars {
        /// Width and height of the slate, pixels.
        size: [u32; 2],
        /// A bar's name, its length from -1 to 1, and what stands at its end.
        bars: Vec<(String, f32, String)>,
    },
}

impl Cell {
    /// A picture with a caption.
    pub(crate) fn new(picture: RgbaImage, caption: impl Into<String>) -> Self {
        Self { content: Content::Picture(picture), caption: caption.into(), note: String::new() }
    }

    fn size(&self) -> Vec2 {
        match &self.content {
            Content::Picture(picture) => vec2(picture.width() as f32, picture.height() as f32),
            Content::Lines { size, .. } | Content::Bars { size, .. } => vec2(size[0] as f32, size[1] as f32),
        }
    }
}

impl Row {
    fn width(&self) -> f32 {
        self.cells.iter().map(|cell| cell.size().x + GAP).sum::<f32>() - GAP
    }
}

impl Sheet {
    /// Draws the sheet on a device.
    pub(crate) fn draw(&self, device: &wgpu::Device, queue: &wgpu::Queue) -> Result<RgbaImage, RenderError> {
        let context = egui::Context::default();
        apply_look(&context);
        let textures: Vec<Vec<Option<TextureHandle>>> =
            self.rows.iter().map(|row| row.cells.iter().map(|cell| texture(&context, cell)).collect()).collect();
        let width = (2.0 * MARGIN + self.rows.iter().map(Row::width).fold(360.0, f32::max)).min(MAX_SIDE);
        let input = egui::RawInput {
            // As high as it may get: how high it is shows when the captions are laid out.
            screen_rect: Some(Rect::from_min_size(Pos2::ZERO, vec2(width, MAX_SIDE))),
            max_texture_side: Some(device.limits().max_texture_dimension_2d as usize),
            ..Default::default()
        };
        let mut bottom = 0.0;
        let output = context.run_ui(input, |ui| bottom = self.lay_out(ui.painter(), &textures, width));
        let size = [width as u32, (bottom + MARGIN).min(MAX_SIDE) as u32];
        paint(device, queue, &context, output, size)
    }

    /// Lays everything out and gives the lower end of it.
    fn lay_out(&self, painter: &egui::Painter, textures: &[Vec<Option<TextureHandle>>], width: f32) -> f32 {
        painter.rect_filled(Rect::from_min_size(Pos2::ZERO, vec2(width, MAX_SIDE)), CornerRadius::ZERO, BACKGROUND);
        let name = painter.text(pos2(MARGIN, MARGIN), Align2::LEFT_TOP, &self.title, FontId::proportional(26.0), TEXT);
        let room = width - MARGIN - name.right() - 14.0;
        let subtitle = painter.layout(self.subtitle.clone(), FontId::proportional(15.0), FAINT, f32::INFINITY);
        let mut top = MARGIN + TITLE;
        if subtitle.size().x <= room {
            painter.galley(pos2(name.right() + 14.0, name.bottom() - 4.0 - subtitle.size().y), subtitle, FAINT);
        } else {
            let subtitle = painter.layout(self.subtitle.clone(), FontId::proportional(15.0), FAINT, width - 2.0 * MARGIN);
            let height = subtitle.size().y;
            painter.galley(pos2(MARGIN, name.bottom() + 4.0), subtitle, FAINT);
            top = name.bottom() + 4.0 + height + 2.0 * AIR;
        }
        for (row, textures) in self.rows.iter().zip(textures) {
            if !row.heading.is_empty() {
                let heading = painter.text(pos2(MARGIN, top), Align2::LEFT_TOP, &row.heading, FontId::proportional(16.0), FAINT);
                top = heading.bottom() + AIR;
            }
            top = row.lay_out(painter, textures, top);
        }
        top
    }
}

impl Row {
    fn lay_out(&self, painter: &egui::Painter, textures: &[Option<TextureHandle>], top: f32) -> f32 {
        let height = self.cells.iter().map(|cell| cell.size().y).fold(0.0, f32::max);
        let mut left = MARGIN;
        let mut lowest = top + height;
        for (cell, texture) in self.cells.iter().zip(textures) {
            let at = Rect::from_min_size(pos2(left, top), cell.size());
            match (&cell.content, texture) {
                (_, Some(texture)) => {
                    painter.image(texture.id(), at, Rect::from_min_max(pos2(0.0, 0.0), pos2(1.0, 1.0)), Color32::WHITE);
                }
                (Content::Lines { lines, .. }, None) => draw_lines(painter, at, lines),
                (Content::Bars { bars, .. }, None) => draw_bars(painter, at, bars),
                (Content::Picture(_), None) => {}
            }
            let text = FontId::proportional(14.0);
            let below = pos2(left + 2.0, top + height + AIR);
            let mut room = at.width() - 4.0;
            if !cell.note.is_empty() {
                let note = painter.text(pos2(at.right() - 2.0, below.y), Align2::RIGHT_TOP, &cell.note, FontId::proportional(14.0), ACCENT);
                room -= note.width() + GAP;
                lowest = lowest.max(note.bottom() + AFTER_CAPTION);
            }
            if !cell.caption.is_empty() {
                let galley = painter.layout(cell.caption.clone(), text, TEXT, room);
                lowest = lowest.max(below.y + galley.size().y + AFTER_CAPTION);
                painter.galley(below, galley, TEXT);
            }
            left = at.right() + GAP;
        }
        if lowest > top + height { lowest } else { lowest + GAP / 2.0 }
    }
}

fn texture(context: &egui::Context, cell: &Cell) -> Option<TextureHandle> {
    let Content::Picture(picture) = &cell.content else { return None };
    let size = [picture.width() as usize, picture.height() as usize];
    Some(context.load_texture("cell", ColorImage::from_rgba_unmultiplied(size, picture.as_raw()), TextureOptions::LINEAR))
}

fn draw_lines(painter: &egui::Painter, at: Rect, lines: &[Vec<[f32; 2]>]) {
    painter.rect_filled(at, CornerRadius::ZERO, SLATE);
    for line in lines {
        let points: Vec<Pos2> = line.iter().map(|&[x, y]| at.min + vec2(x, y)).collect();
        painter.line(points.clone(), Stroke::new(1.2, FAINT));
        for point in points {
            painter.circle_filled(point, 2.4, ACCENT);
        }
    }
}

fn draw_bars(painter: &egui::Painter, at: Rect, bars: &[(String, f32, String)]) {
    painter.rect_filled(at, CornerRadius::ZERO, SLATE);
    let step = (at.height() - 2.0 * GAP) / bars.len().max(1) as f32;
    let font = FontId::proportional((0.55 * step).clamp(9.0, 14.0));
    for (i, (name, length, end)) in bars.iter().enumerate() {
        let y = at.top() + GAP + (i as f32 + 0.5) * step;
        painter.text(pos2(at.left() + GAP, y), Align2::LEFT_CENTER, name, font.clone(), TEXT);
        painter.text(pos2(at.right() - GAP, y), Align2::RIGHT_CENTER, end, font.clone(), TEXT);
        let (left, right) = (at.left() + 0.46 * at.width(), at.right() - 0.16 * at.width());
        let bar = Rect::from_min_max(pos2(left, y - 0.28 * step), pos2(left + (right - left) * length.abs().min(1.0), y + 0.28 * step));
        painter.rect_filled(bar, CornerRadius::same(2), if *length < 0.0 { NEGATIVE } else { ACCENT });
    }
}

fn paint(
    device: &wgpu::Device,
    queue: &wgpu::Queue,
    context: &egui::Context,
    mut output: egui::FullOutput,
    size: [u32; 2],
) -> Result<RgbaImage, RenderError> {
    let texture = picture_texture(device, "sheet", size, FORMAT, wgpu::TextureUsages::COPY_SRC);
    let view = texture.create_view(&wgpu::TextureViewDescriptor::default());
    let mut painter = Painter::new(device, FORMAT);
    painter.upload(device, queue, &mut output.textures_delta);
    let primitives = context.tessellate(output.shapes, output.pixels_per_point);
    let mut encoder = device.create_command_encoder(&wgpu::CommandEncoderDescriptor { label: Some("sheet") });
    painter.paint(device, queue, &mut encoder, &view, size, output.pixels_per_point, &primitives);
    let sheet = read_back(device, queue, encoder, &texture, size)?;
    painter.free(output.textures_delta);
    Ok(sheet)
}
