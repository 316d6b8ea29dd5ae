//! Pages of the panel: wrinkle zones, light, skin.

use super::look::{self, ACCENT, FAINT, TEXT, WELL};
use super::panel::Scene;
use super::switches::{Page, Switches};
use crate::renderer::{DrawSettings, SkinSettings, Studio, Term, ViewMode, WrinkleSystem, ZoneBlend};
use egui::{CornerRadius, RichText, Sense, Slider, Ui, vec2};
use std::ops::RangeInclusive;

/// Which page is shown.
pub(super) fn choice(ui: &mut Ui, switches: &mut Switches) {
    row(ui, &Page::ALL, |page| page == switches.page).into_iter().for_each(|page| switches.page = page);
}

/// Whose wrinkles are drawn, how the zones' are blended, and how strongly each zone shows.
pub(super) fn zones(ui: &mut Ui, scene: &Scene<'_>, switches: &mut Switches) {
    look::section(ui, "Whose wrinkles");
    let systems =
        [(WrinkleSystem::Own, "Own"), (WrinkleSystem::Bones, "Bones"), (WrinkleSystem::Zones, "Zones"), (WrinkleSystem::Both, "Both")];
    row(ui, &systems, |system| system == switches.draw.system).into_iter().for_each(|system| switches.draw.system = system);
    look::section(ui, "Blend of zones");
    let blends = [(ZoneBlend::PartialDerivatives, "Sum"), (ZoneBlend::Difference, "Difference"), (ZoneBlend::TwoMaps, "Two maps")];
    row(ui, &blends, |blend| blend == switches.draw.zone_blend).into_iter().for_each(|blend| switches.draw.zone_blend = blend);
    look::section(ui, "Zone weights");
    let Some(zones) = &scene.character.zones else {
        ui.label(RichText::new("This character has no zones.").color(FAINT));
        return;
    };
    for (z, zone) in zones.list.iter().enumerate() {
        let value = |weights: &[f32]| weights.get(z).copied().unwrap_or_default();
        bar(ui, &zone.name, value(&scene.frame.zones) - value(&scene.frame.stretched));
    }
    ui.label(RichText::new(format!("Masks and map take {:.1} KiB", scene.zone_bytes as f64 / 1024.0)).small().color(FAINT));
}

/// The set-up of lights and what becomes of the light.
pub(super) fn light(ui: &mut Ui, switches: &mut Switches) {
    look::section(ui, "Set-up");
    let studios = [(Studio::Portrait, "Portrait"), (Studio::Sunset, "Sunset")];
    row(ui, &studios, |studio| studio == switches.draw.studio).into_iter().for_each(|studio| switches.draw.studio = studio);
    let draw = &mut switches.draw;
    let mut degrees = draw.key_turn.to_degrees();
    slider(ui, "Key turned, °", &mut degrees, -180.0..=180.0);
    draw.key_turn = degrees.to_radians();
    look::section(ui, "Picture");
    slider(ui, "Exposure", &mut draw.exposure, 0.25..=4.0);
    slider(ui, "Grain", &mut draw.grain, 0.0..=0.06);
    ui.checkbox(&mut draw.is_smoothed, "Smooth edges");
    if ui.button("Reset").clicked() {
        let fresh = DrawSettings::new(draw.camera);
        (draw.studio, draw.key_turn, draw.exposure) = (fresh.studio, fresh.key_turn, fresh.exposure);
        (draw.grain, draw.is_smoothed) = (fresh.grain, fresh.is_smoothed);
    }
}

/// How skin takes light, and each part of the light by itself.
pub(super) fn skin(ui: &mut Ui, switches: &mut Switches) {
    look::section(ui, "Skin");
    let skin = &mut switches.draw.skin;
    slider(ui, "Scattering", &mut skin.scattering, 0.0..=3.0);
    slider(ui, "Shines through", &mut skin.translucency, 0.0..=3.0);
    slider(ui, "Gloss", &mut skin.gloss, 0.0..=3.0);
    slider(ui, "Roughness", &mut skin.roughness, 0.5..=1.6);
    if ui.button("Reset").clicked() {
        *skin = SkinSettings::default();
    }
    look::section(ui, "One part of the light");
    let terms = [
        (ViewMode::Beauty, "All"),
        (ViewMode::Term(Term::Diffuse), "Diffuse"),
        (ViewMode::Term(Term::Specular), "Highlights"),
        (ViewMode::Term(Term::Scattering), "Scattered"),
        (ViewMode::Term(Term::Translucency), "Through"),
    ];
    for terms in terms.chunks(3) {
        row(ui, terms, |view| view == switches.draw.view).into_iter().for_each(|view| switches.show(view));
    }
}

/// A row of switches as wide as the panel; gives what was clicked.
fn row<T: Copy>(ui: &mut Ui, choices: &[(T, &str)], is_on: impl Fn(T) -> bool) -> Option<T> {
    let count = choices.len() as f32;
    let width = (ui.available_width() - (count - 1.0) * ui.spacing().item_spacing.x) / count;
    let mut clicked = None;
    ui.horizontal(|ui| {
        for &(choice, name) in choices {
            if ui.add_sized([width, 28.0], look::switch(name, is_on(choice))).clicked() {
                clicked = Some(choice);
            }
        }
    });
    clicked
}

fn slider(ui: &mut Ui, name: &str, value: &mut f32, range: RangeInclusive<f32>) {
    ui.horizontal(|ui| {
        let (rect, _) = ui.allocate_exact_size(vec2(96.0, 18.0), Sense::hover());
        ui.painter().text(rect.left_center(), egui::Align2::LEFT_CENTER, name, egui::FontId::proportional(13.0), FAINT);
        ui.spacing_mut().slider_width = (ui.available_width() - 52.0).max(40.0);
        ui.add(Slider::new(value, range).max_decimals(2));
    });
}

/// A value from -1 to 1 as a bar from the middle.
fn bar(ui: &mut Ui, name: &str, value: f32) {
    ui.horizontal(|ui| {
        let (label, _) = ui.allocate_exact_size(vec2(72.0, 16.0), Sense::hover());
        ui.painter().text(label.left_center(), egui::Align2::LEFT_CENTER, name, egui::FontId::proportional(13.0), TEXT);
        let (rect, _) = ui.allocate_exact_size(vec2(ui.available_width(), 12.0), Sense::hover());
        ui.painter().rect_filled(rect, CornerRadius::same(4), WELL);
        let middle = rect.center().x;
        let end = middle + 0.5 * rect.width() * value.clamp(-1.0, 1.0);
        let filled = egui::Rect::from_min_max(egui::pos2(middle.min(end), rect.top()), egui::pos2(middle.max(end), rect.bottom()));
        ui.painter().rect_filled(filled, CornerRadius::same(4), ACCENT);
    });
}
