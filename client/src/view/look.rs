//! Colours and shapes of the panel. Tuned by eye: a dark neutral that leaves the face the brightest thing in the window,
//! and one warm accent.

use egui::{Color32, CornerRadius, FontFamily, FontId, Stroke, TextStyle, Theme, vec2};

/// Behind the panel.
pub(crate) const PANEL: Color32 = Color32::from_rgb(0x17, 0x18, 0x1b);
/// Behind a group of switches, and the empty part of a bar.
pub(crate) const WELL: Color32 = Color32::from_rgb(0x24, 0x26, 0x2a);
/// Behind a switch under the pointer.
const WELL_HOVERED: Color32 = Color32::from_rgb(0x30, 0x33, 0x38);
/// Text to read.
pub(crate) const TEXT: Color32 = Color32::from_rgb(0xec, 0xe9, 0xe4);
/// Text to overlook.
pub(crate) const FAINT: Color32 = Color32::from_rgb(0x93, 0x91, 0x8c);
/// What is switched on, and how strong wrinkles show.
pub(crate) const ACCENT: Color32 = Color32::from_rgb(0xe9, 0xa1, 0x78);
/// Text on the accent.
const ON_ACCENT: Color32 = Color32::from_rgb(0x22, 0x16, 0x0f);
/// All is well.
pub(crate) const GOOD: Color32 = Color32::from_rgb(0x6f, 0xc2, 0x8b);
/// Something is missing but may come back.
pub(crate) const WARN: Color32 = Color32::from_rgb(0xf0, 0xbd, 0x4e);
/// Something is wrong.
pub(crate) const BAD: Color32 = Color32::from_rgb(0xee, 0x6a, 0x5f);

/// A switch that is one of several or on by itself.
pub(crate) fn switch(label: impl Into<String>, is_on: bool) -> egui::Button<'static> {
    let text = egui::RichText::new(label.into()).color(if is_on { ON_ACCENT } else { TEXT });
    let button = egui::Button::new(text).corner_radius(CornerRadius::same(6));
    if is_on { button.fill(ACCENT) } else { button }
}

/// A heading of a part of the panel.
pub(crate) fn section(ui: &mut egui::Ui, title: &str) {
    ui.add_space(14.0);
    ui.label(egui::RichText::new(title.to_uppercase()).size(11.0).extra_letter_spacing(1.2).color(FAINT));
    ui.add_space(4.0);
}

/// Gives `ctx` its look.
pub(crate) fn apply(ctx: &egui::Context) {
    ctx.set_theme(Theme::Dark);
    ctx.all_styles_mut(|style| {
        style.spacing.item_spacing = vec2(6.0, 6.0);
        style.spacing.button_padding = vec2(4.0, 5.0);
        style.interaction.selectable_labels = false;
        style.animation_time = 0.1;
        for (text_style, size) in [(TextStyle::Body, 13.5), (TextStyle::Button, 13.0), (TextStyle::Small, 11.5), (TextStyle::Heading, 22.0)]
        {
            style.text_styles.insert(text_style, FontId::new(size, FontFamily::Proportional));
        }
        let visuals = &mut style.visuals;
        visuals.panel_fill = PANEL;
        visuals.window_fill = PANEL;
        visuals.override_text_color = Some(TEXT);
        visuals.weak_text_color = Some(FAINT);
        visuals.selection.bg_fill = ACCENT;
        visuals.selection.stroke = Stroke::new(1.0, ON_ACCENT);
        let widgets = &mut visuals.widgets;
        for (widget, fill) in [(&mut widgets.inactive, WELL), (&mut widgets.hovered, WELL_HOVERED), (&mut widgets.active, WELL_HOVERED)] {
            widget.bg_fill = fill;
            widget.weak_bg_fill = fill;
            widget.bg_stroke = Stroke::NONE;
            widget.corner_radius = CornerRadius::same(6);
            widget.expansion = 0.0;
        }
    });
}
