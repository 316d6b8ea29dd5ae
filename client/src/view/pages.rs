//! Pages of the panel: the face by hand, wrinkle zones, light, skin.

use super::hand::{Hand, REGIONS, other_side};
use super::look::{self, ACCENT, FAINT, TEXT, WELL};
use super::panel::Scene;
use super::switches::{Page, Switches};
use crate::renderer::{DrawSettings, SkinSettings, Studio, Term, ViewMode, WrinkleSystem, ZoneBlend};
use egui::{CornerRadius, RichText, Sense, Slider, Ui, vec2};
use rhytid_shared::ARKIT_NAMES;
use std::ops::RangeInclusive;

/// Which page is shown.
pub(super) fn choice(ui: &mut Ui, switches: &mut Switches) {
    row(ui, &Page::ALL, |page| page == switches.page).into_iter().for_each(|page| switches.page = page);
}

/// Sliders that pose the face in place of the stream: expressions, reference poses, and every shape by the part of the face.
pub(super) fn hand(ui: &mut Ui, scene: &Scene<'_>, hand: &mut Hand) {
    look::section(ui, "Who moves the face");
    row(ui, &[(false, "Live stream"), (true, "By hand")], |is_on| is_on == hand.is_on).into_iter().for_each(|is_on| hand.is_on = is_on);
    let note = match (hand.is_on, cfg!(feature = "embedded")) {
        (false, _) => "A slider that is moved takes over. Nobody but this window sees it.",
        (true, true) => "The stream goes on but is not shown. Nobody but this window sees this face.",
        (true, false) => "Built without the server's solve: shapes move the face, bones and wrinkles stay at rest.",
    };
    ui.label(RichText::new(note).small().color(FAINT));
    let before = hand.clone();
    let mut is_mirrored = hand.is_mirrored;
    match row(ui, &[(0, "Reset"), (1, "Random"), (2, "As live")], |_| false) {
        Some(0) => hand.reset(),
        Some(1) => hand.randomise(),
        Some(_) => scene.streamed.shapes.iter().for_each(|weights| hand.take(weights)),
        None => {}
    }
    if ui.checkbox(&mut is_mirrored, "Both sides alike").changed() {
        hand.mirror(is_mirrored);
    }
    if let Some(zones) = scene.character.zones.as_ref().filter(|zones| !zones.expressions.is_empty()) {
        look::section(ui, "Expressions");
        for (row, amount) in zones.expressions.iter().zip(&mut hand.expressions) {
            slider(ui, &row.name, amount, 0.0..=1.0);
        }
    }
    if cfg!(feature = "embedded") && !scene.character.poses.is_empty() {
        look::section(ui, "Reference poses");
        for (pose, amount) in scene.character.poses.iter().zip(&mut hand.poses) {
            slider(ui, &pose.name, amount, 0.0..=1.0);
        }
    }
    for region in REGIONS {
        look::section(ui, region.name);
        for shape in region.shapes() {
            let other = other_side(shape).filter(|_| hand.is_mirrored);
            if other.is_some_and(|other| other < shape) {
                continue;
            }
            let mut weight = hand.weights[shape];
            slider(ui, &shape_label(ARKIT_NAMES[shape], other.is_some()), &mut weight, 0.0..=1.0);
            if weight != hand.weights[shape] {
                hand.set(shape, weight);
            }
        }
    }
    let is_moved = (&before.weights, &before.expressions, &before.poses) != (&hand.weights, &hand.expressions, &hand.poses);
    hand.is_on |= is_moved;
}

/// A shape's name in words, without the part of the face it stands under: `mouthSmileLeft` is "smile L", or "smile" for both
/// sides.
fn shape_label(name: &str, is_both: bool) -> String {
    let name = if is_both { name.trim_end_matches("Left").trim_end_matches("Right") } else { name };
    let mut words = String::new();
    for letter in name.chars() {
        if letter.is_uppercase() {
            words.push(' ');
        }
        words.extend(letter.to_lowercase());
    }
    let words = match words.split_once(' ') {
        // What stands alone under its part of the face, or among shapes of another, keeps its name.
        Some((part, rest)) if !matches!(part, "nose" | "cheek" | "tongue") => rest.to_owned(),
        _ => words,
    };
    match (words.strip_suffix(" left"), words.strip_suffix(" right")) {
        (Some(words), _) => format!("{words} L"),
        (_, Some(words)) => format!("{words} R"),
        _ => words,
    }
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
    look::section(ui, "Masks");
    let mut views = vec![(ViewMode::Beauty, "None"), (ViewMode::BoneMasks, "Bones")];
    if scene.character.zones.is_some() {
        views.insert(1, (ViewMode::Masks(None), "Zones"));
    }
    let is_on = |view: ViewMode| std::mem::discriminant(&view) == std::mem::discriminant(&switches.draw.view);
    row(ui, &views, is_on).into_iter().for_each(|view| switches.show(view));
    if let (ViewMode::Masks(shown), Some(zones)) = (switches.draw.view, &scene.character.zones) {
        ui.horizontal_wrapped(|ui| {
            let of_one = zones.list.iter().enumerate().map(|(z, zone)| (Some(z), zone.name.as_str()));
            for (zone, name) in std::iter::once((None, "all zones")).chain(of_one) {
                if ui.add(look::switch(name, shown == zone).small()).clicked() {
                    switches.show(ViewMode::Masks(zone));
                }
            }
        });
    }
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
    slider(ui, "Blood", &mut skin.blood, 0.0..=3.0);
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
        (ViewMode::Term(Term::Blood), "Blood"),
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shapes_are_called_by_what_they_do() {
        assert_eq!(shape_label("mouthSmileLeft", false), "smile L");
        assert_eq!(shape_label("mouthSmileLeft", true), "smile");
        assert_eq!(shape_label("browInnerUp", false), "inner up");
        assert_eq!(shape_label("noseSneerRight", true), "nose sneer");
        assert_eq!(shape_label("jawLeft", false), "left");
        let labels: std::collections::BTreeSet<_> =
            REGIONS.iter().flat_map(|region| region.shapes().map(|shape| (region.name, shape_label(ARKIT_NAMES[shape], false)))).collect();
        assert_eq!(labels.len(), rhytid_shared::NUM_ARKIT_SHAPES, "no two sliders of a part of the face are called the same");
    }
}
