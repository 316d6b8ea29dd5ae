//! What stands round the face: status, switches, numbers, coefficients.

use super::look::{self, ACCENT, BAD, FAINT, GOOD, PANEL, TEXT, WARN, WELL};
use super::pages;
use super::switches::{Page, Switches, views};
use crate::link::LinkStats;
use crate::playout::PlayoutStats;
use crate::rate::Rate;
use crate::renderer::{BlendMode, Deformation, RenderFrame, ViewMode};
use crate::spectator::{Status, StatusKind};
use egui::{Align2, Color32, CornerRadius, FontId, Frame, Margin, Pos2, Rect, RichText, Sense, Ui, pos2, vec2};
use rhytid_shared::Character;

/// Width of the panel, points.
const PANEL_WIDTH: f32 = 288.0;
/// Height of a pose's bars, points.
const BARS_HEIGHT: f32 = 24.0;

/// What the panel shows. Changes nothing but the switches.
pub(crate) struct Scene<'a> {
    pub(crate) character: &'a Character,
    /// What is drawn.
    pub(crate) frame: &'a RenderFrame,
    /// What the stream shows.
    pub(crate) streamed: &'a RenderFrame,
    pub(crate) status: &'a Status,
    pub(crate) room: &'a str,
    pub(crate) link: LinkStats,
    pub(crate) playout: PlayoutStats,
    pub(crate) rates: &'a Rates,
    /// The rates' clock.
    pub(crate) since_opened: std::time::Duration,
    /// Bytes of the zones' masks and of their wrinkle map on the device.
    pub(crate) zone_bytes: u64,
    /// What draws.
    pub(crate) adapter: &'a str,
    /// The face's picture; drawn into after the layout is known.
    pub(crate) face: egui::TextureId,
}

/// The rates shown.
#[derive(Debug, Default)]
pub(crate) struct Rates {
    pub(crate) pictures: Rate,
    pub(crate) packets: Rate,
    pub(crate) bytes: Rate,
}

/// Lays everything out and obeys the pointer and the keys. Returns where the face goes, points.
pub(crate) fn show(ui: &mut Ui, scene: &Scene<'_>, switches: &mut Switches) -> Rect {
    ui.input_mut(|input| switches.obey_keys(input, scene.character));
    if switches.has_panel {
        let frame = Frame::new().fill(PANEL).inner_margin(Margin { left: 18, right: 18, top: 16, bottom: 12 });
        egui::Panel::right("panel").exact_size(PANEL_WIDTH).resizable(false).show_separator_line(false).frame(frame).show(ui, |ui| {
            egui::Panel::bottom("keys")
                .show_separator_line(false)
                .frame(Frame::new().inner_margin(Margin { top: 8, ..Margin::ZERO }))
                .show(ui, key_help);
            egui::CentralPanel::no_frame().show(ui, |ui| {
                egui::ScrollArea::vertical().auto_shrink(false).show(ui, |ui| contents(ui, scene, switches));
            });
        });
    }
    egui::CentralPanel::no_frame().show(ui, |ui| face(ui, scene, switches)).inner
}

fn face(ui: &mut Ui, scene: &Scene<'_>, switches: &mut Switches) -> Rect {
    let rect = ui.max_rect();
    let response = ui.interact(rect, ui.scope_id().with("face"), Sense::click_and_drag());
    if response.dragged() {
        switches.drag(response.drag_delta(), rect.height());
    }
    if response.double_clicked() {
        switches.reset_camera(scene.character);
    }
    if response.contains_pointer() {
        let scrolled = ui.input(|input| input.smooth_scroll_delta().y + (input.zoom_delta().ln() * 500.0));
        if scrolled != 0.0 {
            switches.scroll(scrolled);
        }
    }
    let whole = Rect::from_min_max(pos2(0.0, 0.0), pos2(1.0, 1.0));
    ui.painter().image(scene.face, rect, whole, Color32::WHITE);
    if switches.draw.view == ViewMode::Split {
        split_captions(ui, rect);
    }
    if switches.hand.is_on {
        label(ui, rect, ACCENT, "By hand · not the stream");
    } else if scene.status.kind == StatusKind::Live {
        if !switches.has_panel {
            label(ui, rect, GOOD, &format!("{} · room {}", scene.status.headline, scene.room));
        }
    } else {
        banner(ui, rect, scene.status);
    }
    rect
}

fn split_captions(ui: &Ui, rect: Rect) {
    let painter = ui.painter();
    let y = rect.top() + 22.0;
    let font = FontId::proportional(12.5);
    painter.text(pos2(rect.center().x - 14.0, y), Align2::RIGHT_CENTER, "with wrinkles", font.clone(), TEXT.gamma_multiply(0.8));
    painter.text(pos2(rect.center().x + 14.0, y), Align2::LEFT_CENTER, "without", font, TEXT.gamma_multiply(0.8));
}

/// A few words on a dark ground in the corner: that all is well where there is no panel to say it, or that this is no stream.
fn label(ui: &Ui, rect: Rect, color: Color32, text: &str) {
    let at = rect.left_top() + vec2(26.0, 26.0);
    let galley = ui.painter().layout_no_wrap(text.to_owned(), FontId::proportional(13.0), TEXT);
    let ground = Rect::from_min_size(at - vec2(12.0, 12.0), vec2(galley.size().x + 38.0, 24.0));
    ui.painter().rect_filled(ground, CornerRadius::same(12), Color32::from_rgba_unmultiplied(0x12, 0x13, 0x15, 0xb0));
    ui.painter().circle_filled(at, 4.0, color);
    ui.painter().galley(at + vec2(12.0, -0.5 * galley.size().y), galley, TEXT);
}

/// What is the matter, large.
fn banner(ui: &Ui, rect: Rect, status: &Status) {
    let painter = ui.painter();
    let width = (rect.width() - 48.0).clamp(80.0, 560.0);
    let headline = painter.layout(status.headline.to_owned(), FontId::proportional(32.0), TEXT, width - 56.0);
    let detail = painter.layout(status.detail.clone(), FontId::proportional(15.0), Color32::from_gray(0xc8), width - 56.0);
    let size = vec2(width, headline.size().y + detail.size().y + 44.0);
    let top_left = pos2(rect.center().x - 0.5 * width, rect.bottom() - size.y - (0.06 * rect.height()).max(12.0));
    let card = Rect::from_min_size(top_left, size);
    painter.rect_filled(card, CornerRadius::same(12), Color32::from_rgba_unmultiplied(0x12, 0x13, 0x15, 0xe0));
    let stripe = Rect::from_min_size(card.left_top() + vec2(16.0, 20.0), vec2(5.0, size.y - 40.0));
    painter.rect_filled(stripe, CornerRadius::same(3), color_of(status.kind));
    let text_at = card.left_top() + vec2(36.0, 18.0);
    let below = text_at + vec2(0.0, headline.size().y + 6.0);
    painter.galley(text_at, headline, TEXT);
    painter.galley(below, detail, TEXT);
}

fn color_of(kind: StatusKind) -> Color32 {
    match kind {
        StatusKind::Live => GOOD,
        StatusKind::FaceLost | StatusKind::Silent => WARN,
        StatusKind::ServerGone | StatusKind::Refused | StatusKind::Unusable => BAD,
        StatusKind::Connecting | StatusKind::Waiting | StatusKind::Idle => Color32::from_gray(0x8c),
    }
}

fn contents(ui: &mut Ui, scene: &Scene<'_>, switches: &mut Switches) {
    ui.label(RichText::new("Rhytid").size(24.0).color(TEXT));
    ui.horizontal(|ui| {
        let (dot, _) = ui.allocate_exact_size(vec2(10.0, 14.0), Sense::hover());
        ui.painter().circle_filled(dot.center() + vec2(0.0, 1.0), 4.5, color_of(scene.status.kind));
        ui.label(RichText::new(scene.status.headline).color(TEXT).strong());
        ui.label(RichText::new(format!("room {}", scene.room)).color(FAINT));
    });

    look::section(ui, "View");
    view_switches(ui, scene.character, switches);

    look::section(ui, "Wrinkles");
    wrinkle_switches(ui, switches);

    look::section(ui, "Page");
    pages::choice(ui, switches);
    match switches.page {
        Page::Face => {
            look::section(ui, "Deformation");
            deformation_switches(ui, scene, switches);
            look::section(ui, "Link");
            numbers(ui, scene);
            look::section(ui, "Reference poses");
            for (k, pose) in scene.character.poses.iter().enumerate() {
                pose_bars(ui, scene, k, &pose.name);
            }
            if scene.character.poses.is_empty() {
                ui.label(RichText::new("This character has none.").color(FAINT));
            }
        }
        Page::Hand => pages::hand(ui, scene, &mut switches.hand),
        Page::Zones => pages::zones(ui, scene, switches),
        Page::Light => pages::light(ui, switches),
        Page::Skin => pages::skin(ui, switches),
    }
}

fn view_switches(ui: &mut Ui, character: &Character, switches: &mut Switches) {
    let width = (ui.available_width() - 2.0 * ui.spacing().item_spacing.x) / 3.0;
    let is_on = |view: ViewMode, on: ViewMode| std::mem::discriminant(&view) == std::mem::discriminant(&on);
    for row in views(switches.pose).chunks(3) {
        ui.horizontal(|ui| {
            for &(view, name) in row {
                if ui.add_sized([width, 28.0], look::switch(name, is_on(view, switches.draw.view))).clicked() {
                    switches.choose_view(view, character);
                }
            }
        });
    }
    if let ViewMode::Influence(shown) = switches.draw.view {
        ui.horizontal_wrapped(|ui| {
            let of_one = character.poses.iter().enumerate().map(|(k, pose)| (Some(k), pose.name.as_str()));
            for (pose, name) in std::iter::once((None, "all poses")).chain(of_one) {
                if ui.add(look::switch(name, shown == pose).small()).clicked() {
                    switches.choose_pose(pose);
                }
            }
        });
    }
}

fn wrinkle_switches(ui: &mut Ui, switches: &mut Switches) {
    let label = if switches.draw.wrinkles { "On" } else { "Off" };
    let modes = [
        (BlendMode::PartialDerivatives, "Sum", "Sum of partial derivatives (Jimenez et al. 2011)"),
        (BlendMode::Simple, "Mean", "Mean of whole normals (Dutreve et al. 2009, 5.3)"),
        (BlendMode::Printed, "Printed", "The formula as Dutreve et al. 2009 print it, with a rest term"),
    ];
    let width = (ui.available_width() - 3.0 * ui.spacing().item_spacing.x) / 4.0;
    ui.horizontal(|ui| {
        if ui.add_sized([width, 28.0], look::switch(label, switches.draw.wrinkles)).on_hover_text("Wrinkles on or off").clicked() {
            switches.draw.wrinkles = !switches.draw.wrinkles;
        }
        for (mode, name, hint) in modes {
            if ui.add_sized([width, 28.0], look::switch(name, switches.draw.blend == mode)).on_hover_text(hint).clicked() {
                switches.draw.blend = mode;
            }
        }
    });
}

fn deformation_switches(ui: &mut Ui, scene: &Scene<'_>, switches: &mut Switches) {
    let choices = [
        (Deformation::Bones, "Bones", "Bones move the face (Dutreve et al. 2009)"),
        (Deformation::Shapes, "Shapes", "The mesh's own expression shapes move the face, by weights that come with the frames"),
    ];
    let width = (ui.available_width() - ui.spacing().item_spacing.x) / 2.0;
    ui.horizontal(|ui| {
        for (deform, name, hint) in choices {
            if ui.add_sized([width, 28.0], look::switch(name, switches.draw.deform == deform)).on_hover_text(hint).clicked() {
                switches.draw.deform = deform;
            }
        }
    });
    if !scene.character.shapes.is_empty() {
        let mut is_shown = switches.draw.view == ViewMode::ShapeDeltas;
        let hint = "The face of its shapes, and how far they move it: red is 12 mm";
        if ui.checkbox(&mut is_shown, "Show how far shapes move it").on_hover_text(hint).changed() {
            switches.show(if is_shown { ViewMode::ShapeDeltas } else { ViewMode::Beauty });
        }
    }
    let problem = match switches.draw.deform {
        Deformation::Shapes if scene.character.shapes.is_empty() => "This character has no shapes: bones move it.",
        Deformation::Shapes if scene.frame.shapes.is_none() => "No weights come with the frames: bones move the face.",
        _ => return,
    };
    ui.label(RichText::new(problem).small().color(FAINT));
}

fn numbers(ui: &mut Ui, scene: &Scene<'_>) {
    let millis = |time: std::time::Duration| format!("{:.0} ms", time.as_secs_f64() * 1e3);
    let (link, playout, rates, now) = (&scene.link, &scene.playout, scene.rates, scene.since_opened);
    // Half the way there and back, and what playout adds; the sender's own clock cannot be compared with ours.
    let latency = link.round_trip.map_or_else(|| "–".into(), |way| millis(way / 2 + playout.delay));
    let packets = format!("Frame packets received a second; the sender makes one every {}", millis(playout.send_interval));
    let delay =
        format!("Playout delay: how much later than possible the face is shown, so that it moves evenly; {} frames wait", playout.buffered);
    let jitter = format!("95 % of packets are late by no more than this; {} times none was there in time", playout.underruns);
    let numbers = [
        ("Pictures", a_second(rates.pictures.per_second(now)), "Pictures drawn a second"),
        ("Latency", latency, "Server to screen: half a round trip and the playout delay"),
        ("Packets", a_second(rates.packets.per_second(now)), &packets),
        ("Delay", millis(playout.delay), &delay),
        ("Bytes", bytes_a_second(rates.bytes.per_second(now)), "Payload of frame packets a second"),
        ("Jitter", millis(playout.jitter), &jitter),
    ];
    let gap = 20.0;
    let width = (ui.available_width() - gap) / 2.0;
    for pair in numbers.chunks(2) {
        ui.horizontal(|ui| {
            ui.spacing_mut().item_spacing.x = gap;
            for (name, value, hint) in pair {
                let (rect, response) = ui.allocate_exact_size(vec2(width, 17.0), Sense::hover());
                let font = FontId::proportional(13.0);
                ui.painter().text(rect.left_center(), Align2::LEFT_CENTER, name, font.clone(), FAINT);
                ui.painter().text(rect.right_center(), Align2::RIGHT_CENTER, value, font, TEXT);
                response.on_hover_text(*hint);
            }
        });
    }
    let skipped = playout.late + playout.duplicates + playout.misfits + link.garbage + link.overflowed;
    let skipped = if skipped == 0 { String::new() } else { format!("{skipped} packets skipped · ") };
    let connects = if link.connects <= 1 { String::new() } else { format!("{} connections · ", link.connects) };
    ui.label(RichText::new(format!("{skipped}{connects}{}", scene.adapter)).small().color(FAINT));
}

fn a_second(rate: f64) -> String {
    if rate < 9.95 { format!("{rate:.1} /s") } else { format!("{rate:.0} /s") }
}

fn bytes_a_second(rate: f64) -> String {
    if rate < 10_000.0 { format!("{rate:.0} B/s") } else { format!("{:.1} kB/s", rate / 1e3) }
}

/// One pose: its name, how strong it is at most, and one bar a bone.
fn pose_bars(ui: &mut Ui, scene: &Scene<'_>, k: usize, name: &str) {
    let num_bones = scene.character.num_bones();
    let row = scene.frame.influences.get(k * num_bones..(k + 1) * num_bones).unwrap_or_default();
    let most = row.iter().copied().fold(0.0, f32::max);
    ui.horizontal(|ui| {
        ui.label(RichText::new(name).color(TEXT));
        ui.with_layout(egui::Layout::right_to_left(egui::Align::Center), |ui| {
            ui.label(RichText::new(format!("{:.0} %", 100.0 * most)).color(if most > 0.05 { ACCENT } else { FAINT }));
        });
    });
    let (rect, response) = ui.allocate_exact_size(vec2(ui.available_width(), BARS_HEIGHT), Sense::hover());
    ui.painter().rect_filled(rect, CornerRadius::same(5), WELL);
    let inner = rect.shrink2(vec2(6.0, 5.0));
    let step = inner.width() / num_bones.max(1) as f32;
    let bar_of = |i: usize, value: f32| {
        let left = inner.left() + step * i as f32;
        Rect::from_min_max(
            pos2(left, inner.bottom() - (value * inner.height()).max(1.0)),
            pos2(left + (step - 1.5).max(1.0), inner.bottom()),
        )
    };
    for (i, &value) in row.iter().enumerate() {
        // Bones that this pose does not move are marked by nothing at all.
        if scene.character.poses[k].points[i] != scene.character.bones[i].rest {
            let color = if value > 0.0 { ACCENT } else { FAINT.gamma_multiply(0.6) };
            ui.painter().rect_filled(bar_of(i, value), CornerRadius::same(1), color);
        }
    }
    if let Some(Pos2 { x, .. }) = response.hover_pos() {
        let i = (((x - inner.left()) / step).max(0.0) as usize).min(num_bones.saturating_sub(1));
        if let (Some(bone), Some(value)) = (scene.character.bones.get(i), row.get(i)) {
            response.on_hover_text_at_pointer(format!("{}  {:.0} %", bone.name, 100.0 * value));
        }
    }
    ui.add_space(2.0);
}

fn key_help(ui: &mut Ui) {
    let text = "1–6 view   W wrinkles   Z whose   B blend\nD deform   E by hand   L light   P page   H panel\nF full screen   R camera   Esc quit\nDrag to turn, wheel to zoom";
    ui.label(RichText::new(text).small().color(FAINT));
}
