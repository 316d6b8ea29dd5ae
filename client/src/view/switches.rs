//! What the person before the window has chosen.

use super::hand::Hand;
use crate::renderer::{BlendMode, Camera, Deformation, DrawSettings, Studio, ViewMode, WrinkleSystem};
use egui::{Key, Modifiers};
use rhytid_shared::Character;

/// The state of all switches.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Switches {
    /// What is drawn and how.
    pub(crate) draw: DrawSettings,
    /// The pose the influence view shows, all where `None`; kept while another view is on.
    pub(crate) pose: Option<usize>,
    /// The face by hand.
    pub(crate) hand: Hand,
    /// What the lower part of the panel shows.
    pub(crate) page: Page,
    /// The panel is there.
    pub(crate) has_panel: bool,
    /// The window fills the screen.
    pub(crate) is_full_screen: bool,
    /// The window shall close.
    pub(crate) is_quitting: bool,
}

/// Pages of the panel.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Page {
    /// Numbers of the link and bars of the reference poses.
    Face,
    /// The face by hand.
    Hand,
    /// Wrinkle zones.
    Zones,
    /// Lights and the picture.
    Light,
    /// How skin takes light.
    Skin,
}

impl Page {
    /// In the order of the switches.
    pub(crate) const ALL: [(Self, &'static str); 5] =
        [(Self::Face, "Face"), (Self::Hand, "Hand"), (Self::Zones, "Zones"), (Self::Light, "Light"), (Self::Skin, "Skin")];
}

/// Share by which one notch (50 points) of the wheel brings the camera nearer.
const ZOOM_PER_POINT: f32 = 0.002;

/// The views that have a key of their own, in the order of the keys 1 to 6.
pub(crate) fn views(pose: Option<usize>) -> [(ViewMode, &'static str); 6] {
    [
        (ViewMode::Beauty, "Beauty"),
        (ViewMode::Bare, "Bare"),
        (ViewMode::Split, "Split"),
        (ViewMode::Influence(pose), "Influence"),
        (ViewMode::Normals, "Normals"),
        (ViewMode::Wireframe, "Wireframe"),
    ]
}

impl Switches {
    pub(crate) fn new(character: &Character) -> Self {
        Self {
            draw: DrawSettings::new(Camera::front(character)),
            pose: None,
            hand: Hand::default(),
            page: Page::Face,
            has_panel: true,
            is_full_screen: false,
            is_quitting: false,
        }
    }

    /// Obeys the keys of this frame.
    pub(crate) fn obey_keys(&mut self, input: &mut egui::InputState, character: &Character) {
        let mut pressed = |key| input.consume_key(Modifiers::NONE, key);
        for (key, at) in [(Key::Num1, 0), (Key::Num2, 1), (Key::Num3, 2), (Key::Num4, 3), (Key::Num5, 4), (Key::Num6, 5)] {
            if pressed(key) {
                self.choose_view(views(self.pose)[at].0, character);
            }
        }
        if pressed(Key::W) {
            self.draw.wrinkles = !self.draw.wrinkles;
        }
        if pressed(Key::B) {
            let at = BlendMode::ALL.iter().position(|&mode| mode == self.draw.blend).unwrap_or(0);
            self.draw.blend = BlendMode::ALL[(at + 1) % BlendMode::ALL.len()];
        }
        if pressed(Key::D) {
            self.draw.deform = match self.draw.deform {
                Deformation::Bones => Deformation::Shapes,
                Deformation::Shapes => Deformation::Bones,
            };
        }
        if pressed(Key::L) {
            let at = Studio::ALL.iter().position(|&studio| studio == self.draw.studio).unwrap_or(0);
            self.draw.studio = Studio::ALL[(at + 1) % Studio::ALL.len()];
        }
        if pressed(Key::Z) {
            let at = WrinkleSystem::ALL.iter().position(|&system| system == self.draw.system).unwrap_or(0);
            self.draw.system = WrinkleSystem::ALL[(at + 1) % WrinkleSystem::ALL.len()];
        }
        if pressed(Key::E) {
            self.hand.is_on = !self.hand.is_on;
        }
        if pressed(Key::P) {
            let at = Page::ALL.iter().position(|(page, _)| *page == self.page).unwrap_or(0);
            self.page = Page::ALL[(at + 1) % Page::ALL.len()].0;
        }
        if pressed(Key::H) {
            self.has_panel = !self.has_panel;
        }
        if pressed(Key::F) {
            self.is_full_screen = !self.is_full_screen;
        }
        if pressed(Key::R) {
            self.reset_camera(character);
        }
        if pressed(Key::Escape) {
            self.is_quitting = true;
        }
    }

    /// Shows `view`; the influence view chosen again goes on to the next pose.
    pub(crate) fn choose_view(&mut self, view: ViewMode, character: &Character) {
        if matches!((view, self.draw.view), (ViewMode::Influence(_), ViewMode::Influence(_))) {
            let next = self.pose.map_or(0, |pose| pose + 1);
            self.choose_pose((next < character.num_poses()).then_some(next));
        } else {
            self.show(view);
        }
    }

    /// Shows `view`.
    pub(crate) fn show(&mut self, view: ViewMode) {
        self.draw.view = view;
        if let ViewMode::Influence(pose) = view {
            self.pose = pose;
        }
    }

    /// Shows the influence of one pose, or of all.
    pub(crate) fn choose_pose(&mut self, pose: Option<usize>) {
        self.show(ViewMode::Influence(pose));
    }

    /// Turns the camera by a drag of `points` in a picture `height` points high.
    pub(crate) fn drag(&mut self, points: egui::Vec2, height: f32) {
        self.draw.camera.drag([points.x, points.y], height);
    }

    /// Brings the camera nearer (`points` > 0) or farther.
    pub(crate) fn scroll(&mut self, points: f32) {
        self.draw.camera.zoom((-points * ZOOM_PER_POINT).exp());
    }

    pub(crate) fn reset_camera(&mut self, character: &Character) {
        self.draw.camera = Camera::front(character);
    }

    /// Keeps what fits another character.
    pub(crate) fn change_character(&mut self, character: &Character) {
        self.reset_camera(character);
        if self.pose.is_some_and(|pose| pose >= character.num_poses()) {
            self.pose = None;
        }
        match self.draw.view {
            ViewMode::Influence(_) => self.draw.view = ViewMode::Influence(self.pose),
            ViewMode::Masks(_) if character.num_zones() == 0 => self.draw.view = ViewMode::Beauty,
            ViewMode::Masks(_) => self.draw.view = ViewMode::Masks(None),
            ViewMode::ShapeDeltas if character.shapes.is_empty() => self.draw.view = ViewMode::Beauty,
            _ => {}
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use egui::{Event, RawInput};
    use rhytid_shared::DEFAULT_CHARACTER_GLB;

    struct Desk {
        character: Character,
        switches: Switches,
    }

    impl Desk {
        fn new() -> Self {
            let character = Character::from_glb(DEFAULT_CHARACTER_GLB).unwrap();
            Self { switches: Switches::new(&character), character }
        }

        fn press(&mut self, key: Key) -> &Switches {
            let event = Event::Key { key, physical_key: None, pressed: true, repeat: false, modifiers: Modifiers::NONE };
            let context = egui::Context::default();
            let mut output = context.run_ui(RawInput { events: vec![event], ..RawInput::default() }, |ui| {
                ui.input_mut(|input| self.switches.obey_keys(input, &self.character));
            });
            output.textures_delta.clear();
            &self.switches
        }
    }

    #[test]
    fn keys_one_to_six_choose_the_views_in_their_order() {
        let mut desk = Desk::new();
        let keys = [Key::Num6, Key::Num5, Key::Num4, Key::Num3, Key::Num2, Key::Num1];
        let views: Vec<ViewMode> = keys.iter().map(|&key| desk.press(key).draw.view).collect();
        let expected =
            [ViewMode::Wireframe, ViewMode::Normals, ViewMode::Influence(None), ViewMode::Split, ViewMode::Bare, ViewMode::Beauty];
        assert_eq!(views, expected);
    }

    #[test]
    fn influence_pressed_again_goes_through_the_poses_and_back_to_all() {
        let mut desk = Desk::new();
        desk.press(Key::Num4);
        for k in 0..desk.character.num_poses() {
            assert_eq!(desk.press(Key::Num4).draw.view, ViewMode::Influence(Some(k)));
        }
        assert_eq!(desk.press(Key::Num4).draw.view, ViewMode::Influence(None));
        // The pose is kept while another view is on.
        desk.press(Key::Num4);
        desk.press(Key::Num1);
        assert_eq!(desk.press(Key::Num4).draw.view, ViewMode::Influence(Some(0)));
    }

    #[test]
    fn letters_switch_what_they_say_and_nothing_else() {
        let mut desk = Desk::new();
        let before = desk.switches.clone();
        assert!(!desk.press(Key::W).draw.wrinkles);
        assert!(!desk.press(Key::H).has_panel);
        assert!(desk.press(Key::F).is_full_screen);
        for mode in [1, 2, 0].map(|at| BlendMode::ALL[at]) {
            assert_eq!(desk.press(Key::B).draw.blend, mode);
        }
        assert_eq!(desk.press(Key::D).draw.deform, Deformation::Shapes);
        assert_eq!(desk.press(Key::L).draw.studio, Studio::Sunset);
        assert_eq!(desk.press(Key::Z).draw.system, WrinkleSystem::Bones);
        assert_eq!(desk.press(Key::P).page, Page::Hand);
        assert!(desk.press(Key::E).hand.is_on);
        for key in [Key::W, Key::D, Key::H, Key::F, Key::L, Key::E, Key::Z, Key::Z, Key::Z, Key::P, Key::P, Key::P, Key::P] {
            desk.press(key);
        }
        assert_eq!(desk.switches, before, "pressed again they switch back");
        assert!(desk.press(Key::Escape).is_quitting);
    }

    #[test]
    fn face_follows_the_pointer_and_the_wheel_and_r_brings_it_back() {
        let mut desk = Desk::new();
        let front = desk.switches.draw.camera;
        desk.switches.drag(egui::vec2(50.0, 0.0), 500.0);
        // Dragged to the right the face turns to its own left: the camera goes to its right, -X.
        assert!(desk.switches.draw.camera.eye().x < front.eye().x - 0.01);
        desk.switches.drag(egui::vec2(0.0, 50.0), 500.0);
        assert!(desk.switches.draw.camera.eye().y > front.eye().y + 0.01, "dragged down it shows its crown");
        desk.switches.scroll(100.0);
        assert!(desk.switches.draw.camera.distance < front.distance * 0.9);
        desk.switches.scroll(-200.0);
        assert!(desk.switches.draw.camera.distance > front.distance * 1.1);
        assert_eq!(desk.press(Key::R).draw.camera, front);
    }

    #[test]
    fn pose_that_another_character_lacks_is_shown_no_more() {
        let mut desk = Desk::new();
        desk.switches.choose_pose(Some(desk.character.num_poses() - 1));
        desk.character.poses.truncate(1);
        desk.switches.change_character(&desk.character);
        assert_eq!(desk.switches.draw.view, ViewMode::Influence(None));
    }
}
