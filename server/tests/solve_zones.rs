//! Wrinkle zones through the whole solve: from expressions, from weights, from a face's own motion.

mod solve_fixture;

use rhytid_server::solve::{SolveConfig, Solver};
use rhytid_shared::layout::Layout;
use rhytid_shared::limits::MAX_EXPRESSIONS;
use rhytid_shared::packet::{Decoder, Encoder};
use rhytid_shared::view::{JsonFrame, ViewHello};
use rhytid_shared::{FaceFrame, PublishReader, TrackingData, TrackingFrame};
use solve_fixture::{View, character_with_zones, expression, hello, landmark_frame, see, weight_frame};

const RED: usize = 0;
const GREEN: usize = 1;
const BLUE: usize = 2;
const BROWN: usize = 3;

struct Session {
    solver: Solver,
    out: FaceFrame,
    t: f64,
}

impl Session {
    fn new(layout: Option<Layout>) -> Self {
        let character = character_with_zones();
        let out = FaceFrame::at_rest(&character);
        Self { solver: Solver::new(character, &SolveConfig::default(), &hello(layout, None)).expect("a good session"), out, t: 0.0 }
    }

    /// Three calm seconds of landmarks, so that the neutral is known.
    fn calibrated() -> Self {
        let mut session = Self::new(Some(Layout::Ibug68));
        for _ in 0..90 {
            session.landmarks([0.0, 0.0]);
        }
        session
    }

    fn show(&mut self, mut frame: TrackingFrame) -> &FaceFrame {
        self.t += 1.0 / 30.0;
        frame.t = self.t;
        self.solver.solve(&frame, &mut self.out).expect("a good frame");
        &self.out
    }

    /// Brows raised by this much, right and left, metres.
    fn landmarks(&mut self, brow: [f32; 2]) -> &FaceFrame {
        let pivot = character_with_zones().head_pivot;
        self.show(landmark_frame(0.0, see(&expression(brow, 0.0, 0.0, 0.0), pivot, &View::FRONT)))
    }

    fn weights(&mut self, weights: &[(&str, f32)]) -> &FaceFrame {
        self.show(weight_frame(0.0, weights))
    }

    fn expressions(&mut self, amounts: &[(usize, f32)]) -> &FaceFrame {
        let mut frame = TrackingFrame::new(0.0, TrackingData::Bones { points: Vec::new(), head: None });
        let slots = frame.expressions.insert([0.0; MAX_EXPRESSIONS]);
        amounts.iter().for_each(|&(row, amount)| slots[row] = amount);
        self.show(frame)
    }
}

#[track_caller]
fn assert_near(got: &[f32], want: &[f32]) {
    assert_eq!(got.len(), want.len());
    assert!(got.iter().zip(want).all(|(got, want)| (got - want).abs() < 1e-5), "got {got:?}, expected {want:?}");
}

#[test]
fn zones_follow_what_a_publisher_says_of_expressions() {
    let character = character_with_zones();
    let (mut reader, mut frame) = (PublishReader::new(&character), TrackingFrame::default());
    reader.read(r#"{"type":"hello","version":1}"#, &mut frame).expect("a good hello");
    let mut solver = Solver::new(character.clone(), &SolveConfig::default(), &hello(None, None)).expect("a good session");
    let mut out = FaceFrame::at_rest(&character);
    let (mut encoder, mut decoder) = (Encoder::new(&*character), Decoder::new(&*character));
    let view = ViewHello::new("demo", &character, String::new()).character;
    assert_eq!(view.zones[..3], ["red", "green", "blue"]);
    for (text, zones, stretched) in [
        (r#"{"type":"frame","t":1,"expressions":{"surprise":1,"anger":1}}"#, [0.2, 0.2, 0.0, 0.0, 0.8, 0.8, 1.0, 0.0], [0.0; 8]),
        (
            r#"{"type":"frame","t":2,"expressions":{"anger":1},"bones":{}}"#,
            [0.0, 0.0, 0.0, 0.0, 0.8, 0.8, 1.0, 0.0],
            [0.6, 0.6, 0.8, 0.8, 0.0, 0.0, 0.0, 0.0],
        ),
        (r#"{"type":"frame","t":3,"expressions":{"joy":1,"surprise":1}}"#, [1.0, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0], [0.0; 8]),
        (r#"{"type":"frame","t":4,"expressions":{}}"#, [0.0; 8], [0.0; 8]),
    ] {
        reader.read(text, &mut frame).expect("a good frame");
        solver.solve(&frame, &mut out).expect("a good frame");
        assert_near(&out.zones, &zones);
        assert_near(&out.stretched, &stretched);
        let mut packet = Vec::new();
        encoder.encode(&out, &mut packet);
        let mut got = FaceFrame::at_rest(&character);
        decoder.decode(&packet, &mut got).expect("a good packet");
        let json = JsonFrame::new(&got, &view);
        for (got, want) in json.zones.iter().chain(&json.stretched).zip(zones.iter().chain(&stretched)) {
            assert!((got - want).abs() <= 0.5 / 255.0 + 1e-6, "{got} was {want}");
        }
    }
}

#[test]
fn one_raised_brow_wrinkles_its_own_half() {
    let mut session = Session::calibrated();
    assert!(session.landmarks([0.0, 0.0]).zones.iter().all(|zone| *zone < 0.02), "{:?}", session.out.zones);
    for _ in 0..30 {
        session.landmarks([0.0, 0.009]);
    }
    let zones = session.out.zones.clone();
    assert!(zones[RED] > 0.6 && zones[BLUE] > 0.6, "{zones:?}");
    assert!(zones[GREEN] < 0.05 && zones[BROWN] < 0.05, "{zones:?}");
    for _ in 0..30 {
        session.landmarks([0.009, 0.0]);
    }
    let mirrored = &session.out.zones;
    assert!(mirrored[GREEN] > 0.6 && mirrored[BROWN] > 0.6 && mirrored[RED] < 0.05 && mirrored[BLUE] < 0.05, "{mirrored:?}");
}

#[test]
fn one_raised_brow_wrinkles_its_own_half_from_weights_too() {
    let mut session = Session::new(None);
    for _ in 0..60 {
        session.weights(&[("browOuterUpLeft", 1.0), ("eyeWideLeft", 1.0)]);
    }
    let zones = &session.out.zones;
    assert!((zones[RED] - 0.4).abs() < 0.01 && (zones[BLUE] - 0.4).abs() < 0.01, "{zones:?}");
    assert!(zones[GREEN] == 0.0 && zones[BROWN] == 0.0, "{zones:?}");
}

#[test]
fn lowered_brows_stretch_the_forehead() {
    let mut session = Session::calibrated();
    for _ in 0..30 {
        session.landmarks([-0.007, -0.007]);
    }
    assert!(session.out.stretched[BLUE] > 0.3 && session.out.stretched[BROWN] > 0.3, "{:?}", session.out.stretched);
    assert!(session.out.zones[BLUE] == 0.0);
}

#[test]
fn zones_of_a_lost_face_are_held_and_eased_like_its_bones() {
    let sources: [fn(&mut Session); 3] = [
        |session| {
            session.landmarks([0.009, 0.009]);
        },
        |session| {
            session.weights(&[("browInnerUp", 1.0), ("browOuterUpLeft", 1.0), ("eyeWideLeft", 1.0), ("jawOpen", 1.0)]);
        },
        |session| {
            session.expressions(&[(1, 1.0)]);
        },
    ];
    for (source, show) in sources.into_iter().enumerate() {
        let mut session = Session::calibrated();
        for _ in 0..60 {
            show(&mut session);
        }
        let seen = session.out.zones[RED];
        assert!(seen > 0.5, "source {source}: {seen}");
        let mut last = seen;
        for frame in 0..40 {
            let now = session.show(TrackingFrame::default()).zones[RED];
            assert!(now <= last + 1e-6 && last - now < 0.15, "source {source}, frame {frame}: {last} then {now}");
            if frame < 6 {
                assert_eq!(now, seen, "held");
            }
            last = now;
        }
        assert_eq!(last, 0.0, "source {source}");
        for frame in 0..30 {
            show(&mut session);
            let now = session.out.zones[RED];
            assert!((now - last).abs() < 0.25, "source {source} comes back, frame {frame}: {last} then {now}");
            last = now;
        }
        assert!((last - seen).abs() < 0.05, "source {source}: {last} was {seen}");
    }
}

#[test]
fn zones_do_not_jump_where_another_source_takes_over() {
    let mut session = Session::calibrated();
    for _ in 0..60 {
        session.landmarks([0.009, 0.009]);
    }
    let mut last = session.out.zones[RED];
    assert!(last > 0.5);
    for frame in 0..40 {
        let now = session.weights(&[]).zones[RED];
        assert!((now - last).abs() < 0.15, "frame {frame}: {last} then {now}");
        last = now;
    }
    assert_eq!(last, 0.0);
}

#[test]
fn amounts_that_make_no_sense_are_refused_and_change_nothing() {
    let mut session = Session::new(None);
    session.expressions(&[(0, 0.5)]);
    let before = session.out.clone();
    for amount in [f32::NAN, f32::INFINITY, -0.1, 1.3] {
        let mut frame = weight_frame(9.0, &[("jawOpen", 1.0)]);
        frame.expressions = Some([amount; MAX_EXPRESSIONS]);
        let error = session.solver.solve(&frame, &mut session.out).expect_err("refused");
        assert!(error.to_string().contains("expressions[0] is"), "{error}");
        assert_eq!(session.out, before);
    }
}
