//! The play bar of a room that plays a recording, below the face.

use super::look::{self, FAINT, PANEL, TEXT};
use crate::remote::{Ask, Known, Replay, Word};
use egui::{Frame, Margin, RichText, Ui};
use std::time::Instant;

/// Speeds to choose from.
const SPEEDS: [f64; 6] = [0.1, 0.25, 0.5, 1.0, 2.0, 4.0];
/// What the numbers and switches beside the slider take, points.
const BESIDE_SLIDER: f32 = 300.0;
/// Shortest slider, points.
const LEAST_SLIDER: f32 = 60.0;

/// What the play bar and the record switch have to say.
#[derive(Debug, Clone, PartialEq, Default)]
pub(crate) struct PlayBar {
    /// For the server, in order.
    pub(crate) words: Vec<Word>,
    /// While the slider is held: where it is, and whether the recording played before.
    held: Option<(f64, bool)>,
}

impl PlayBar {
    fn ask(&mut self, ask: Ask) {
        self.words.push(Word::Ask(ask));
    }
}

/// Shows the bar where there is a player.
pub(crate) fn show(ui: &mut Ui, known: &Known, bar: &mut PlayBar) {
    let Some((replay, at)) = &known.replay else {
        bar.held = None;
        return;
    };
    if ui.input(|input| input.key_pressed(egui::Key::Space)) && ui.memory(|memory| memory.focused().is_none()) {
        bar.ask(Ask { playing: Some(!replay.playing), ..Ask::default() });
    }
    let frame = Frame::new().fill(PANEL).inner_margin(Margin::symmetric(16, 9));
    egui::Panel::bottom("replay").show_separator_line(false).frame(frame).show(ui, |ui| contents(ui, replay, *at, bar));
}

fn contents(ui: &mut Ui, replay: &Replay, at: Instant, bar: &mut PlayBar) {
    ui.horizontal(|ui| {
        let (label, hint) = if replay.playing { ("Pause", "Pause (Space)") } else { ("Play", "Play (Space)") };
        if ui.add_sized([56.0, 26.0], look::switch(label, replay.playing)).on_hover_text(hint).clicked() {
            bar.ask(Ask { playing: Some(!replay.playing), ..Ask::default() });
        }
        let mut place = bar.held.map_or_else(|| replay.place(at.elapsed()), |(place, _)| place);
        ui.label(RichText::new(clock(place)).color(TEXT));
        ui.spacing_mut().slider_width = (ui.available_width() - BESIDE_SLIDER + 60.0).max(LEAST_SLIDER);
        let slider = egui::Slider::new(&mut place, replay.from..=replay.to.max(replay.from + 0.01)).show_value(false).trailing_fill(true);
        let response = ui.add(slider).on_hover_text(&replay.file);
        if response.drag_started() {
            bar.held = Some((place, replay.playing));
        }
        if response.changed() {
            // Dragged, it stands still at each place; a click or a key goes on as before.
            let playing = bar.held.is_none() && replay.playing;
            bar.ask(Ask { position: Some(place), playing: Some(playing), ..Ask::default() });
            bar.held = bar.held.map(|(_, was_playing)| (place, was_playing));
        }
        if response.drag_stopped()
            && let Some((place, was_playing)) = bar.held.take()
        {
            bar.ask(Ask { position: Some(place), playing: Some(was_playing), ..Ask::default() });
        }
        ui.label(RichText::new(clock(replay.to)).color(FAINT));
        let shown = replay.speed.map_or_else(|| "max".to_owned(), speed_text);
        egui::ComboBox::from_id_salt("speed").width(58.0).selected_text(shown).show_ui(ui, |ui| {
            for speed in SPEEDS {
                if ui.selectable_label(replay.speed == Some(speed), speed_text(speed)).clicked() {
                    bar.ask(Ask { speed: Some(speed), ..Ask::default() });
                }
            }
        });
        if ui.add_sized([48.0, 26.0], look::switch("Loop", replay.repeats)).on_hover_text("Again and again").clicked() {
            bar.ask(Ask { repeats: Some(!replay.repeats), ..Ask::default() });
        }
    });
}

/// The record switch, where the server keeps recordings.
pub(crate) fn record(ui: &mut Ui, known: &Known, bar: &mut PlayBar) {
    if !known.is_enabled {
        return;
    }
    look::section(ui, "Recording");
    let running = known.take.as_ref().filter(|take| take.error.is_none());
    ui.horizontal(|ui| {
        let label = if running.is_some() { "Stop" } else { "Record" };
        let hint = "What publishers send and what viewers get, into a file on the server";
        if ui.add_sized([70.0, 26.0], look::switch(label, running.is_some())).on_hover_text(hint).clicked() {
            bar.words.push(Word::Record(running.is_none()));
        }
        if let Some(take) = running {
            ui.label(RichText::new(format!("{}   {:.0} kB", clock(take.seconds), take.bytes as f64 / 1e3)).color(FAINT));
        }
    });
    let failed = known.take.as_ref().and_then(|take| take.error.as_ref()).or(known.problem.as_ref());
    if let Some(problem) = failed {
        ui.label(RichText::new(problem).small().color(look::WARN));
    }
}

fn speed_text(speed: f64) -> String {
    format!("{speed} ×")
}

/// Minutes and seconds with tenths.
fn clock(seconds: f64) -> String {
    let tenths = (seconds.max(0.0) * 10.0).round() as u64;
    format!("{}:{:02}.{}", tenths / 600, tenths / 10 % 60, tenths % 10)
}

#[cfg(test)]
mod tests {
    use super::*;
    use egui::{Event, PointerButton, Pos2, RawInput, Rect, pos2, vec2};

    /// A window without a screen.
    struct Stage {
        context: egui::Context,
        known: Known,
        bar: PlayBar,
    }

    impl Stage {
        fn new(playing: bool) -> Self {
            let text = format!(r#"{{"file":"a.mcap","position":5,"playing":{playing},"speed":1,"loop":false,"from":0,"to":20}}"#);
            let replay = serde_json::from_str(&text).unwrap();
            let known = Known { replay: Some((replay, Instant::now())), ..Known::default() };
            Self { context: egui::Context::default(), known, bar: PlayBar::default() }
        }

        /// Lays out one picture; gives what was said in it.
        fn show(&mut self, events: Vec<Event>) -> Vec<Word> {
            let screen_rect = Some(Rect::from_min_size(Pos2::ZERO, vec2(900.0, 500.0)));
            let input = RawInput { screen_rect, events, ..RawInput::default() };
            let (known, bar) = (&self.known, &mut self.bar);
            // There is nothing to draw with.
            self.context.run_ui(input, |ui| show(ui, known, bar)).textures_delta.clear();
            std::mem::take(&mut self.bar.words)
        }

        fn pointer(&mut self, at: Pos2, pressed: Option<bool>) -> Vec<Word> {
            let mut events = vec![Event::PointerMoved(at)];
            events.extend(pressed.map(|pressed| Event::PointerButton {
                pos: at,
                button: PointerButton::Primary,
                pressed,
                modifiers: egui::Modifiers::NONE,
            }));
            self.show(events)
        }
    }

    #[test]
    fn times_are_minutes_and_seconds() {
        assert_eq!([0.0, 59.96, 75.26, -3.0].map(clock), ["0:00.0", "1:00.0", "1:15.3", "0:00.0"]);
    }

    #[test]
    fn dragging_shows_each_place_and_goes_on_where_it_played() {
        for was_playing in [false, true] {
            let mut stage = Stage::new(was_playing);
            stage.show(Vec::new());
            stage.show(Vec::new());
            // In the middle of the slider, wherever it is laid out.
            let y = 500.0 - 9.0 - 13.0;
            stage.pointer(pos2(400.0, y), None);
            let mut words = stage.pointer(pos2(400.0, y), Some(true));
            for x in [420.0, 440.0, 460.0] {
                words.extend(stage.pointer(pos2(x, y), None));
            }
            let last = stage.pointer(pos2(460.0, y), Some(false));
            let places: Vec<f64> = words
                .iter()
                .map(|word| match word {
                    Word::Ask(Ask { position: Some(place), playing: Some(false), .. }) => *place,
                    other => panic!("{other:?} while it is held"),
                })
                .collect();
            assert!(places.len() >= 3 && places.is_sorted() && places[0] > 1.0, "{places:?}");
            let [.., Word::Ask(Ask { position: Some(place), playing, .. })] = last[..] else { panic!("{last:?}") };
            assert_eq!((Some(place), playing), (places.last().copied(), Some(was_playing)));
        }
    }

    #[test]
    fn the_space_bar_plays_and_pauses() {
        let key =
            |pressed| Event::Key { key: egui::Key::Space, physical_key: None, pressed, repeat: false, modifiers: egui::Modifiers::NONE };
        let mut stage = Stage::new(true);
        stage.show(Vec::new());
        let words = stage.show(vec![key(true)]);
        assert_eq!(words, [Word::Ask(Ask { playing: Some(false), ..Ask::default() })]);
        stage.known.replay = None;
        assert_eq!(stage.show(vec![key(true)]), [], "nothing plays");
    }
}
