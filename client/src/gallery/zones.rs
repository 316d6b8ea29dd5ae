//! The figures of Jimenez, Echevarria, Oat, Gutierrez 2011 that show faces: wrinkles in zones, driven by expressions.

use super::Result;
use super::easel::Easel;
use crate::render_cli::PictureError;
use crate::renderer::{DrawSettings, RenderFrame, Studio, ViewMode, WrinkleSystem};
use crate::sheet::{Cell, Content, Row, Sheet};
use crate::view::expressions::{self, ANGER, COMPLEX, DISGUST, Expression, JOY, SURPRISE};
use glam::Vec3;

fn zones_only(settings: DrawSettings) -> DrawSettings {
    DrawSettings { system: WrinkleSystem::Zones, ..settings }
}

/// The face of an expression, and as much of the expression in the zones.
fn whole(easel: &Easel, expression: &Expression) -> Result<RenderFrame> {
    easel.expression(expression.weights, &[(expression.name, 1.0)])
}

/// Names with amounts.
type Amount = (&'static str, f32);

/// Amounts of two expressions, over each other: shapes, then expressions.
fn mixed(a: (&Expression, f32), b: (&Expression, f32)) -> (Vec<Amount>, [Amount; 2]) {
    let of = |(expression, amount): (&Expression, f32)| expression.weights.iter().map(move |&(name, weight)| (name, weight * amount));
    (of((a.0, a.1)).collect::<Vec<_>>().into_iter().chain(of((b.0, b.1)).collect::<Vec<_>>()).collect(), [(a.0.name, a.1), (b.0.name, b.1)])
}

/// Figure 1.1.
pub(super) fn with_and_without(easel: &mut Easel) -> Result<Sheet> {
    const SIZE: [u32; 2] = [560, 560];
    let mut rows = Vec::new();
    for expression in [&SURPRISE, &DISGUST] {
        let frame = whole(easel, expression)?;
        let mut row = Row::default();
        for (view, what) in [(ViewMode::Bare, "without wrinkles"), (ViewMode::Beauty, "with the wrinkles of its zones")] {
            let picture = easel.draw(SIZE, &zones_only(DrawSettings { view, ..easel.face() }), &frame)?;
            row.cells.push(Cell::new(picture, format!("{}, {what}", expression.name)));
        }
        rows.push(row);
    }
    Ok(Sheet { title: "Jimenez et al. 2011, Figure 1.1".into(), subtitle: "the same face without and with wrinkles".into(), rows })
}

/// Figure 1.2.
pub(super) fn complex(easel: &mut Easel) -> Result<Sheet> {
    const SIZE: [u32; 2] = [640, 640];
    // Read from the shapes, half by half: what the tracker of a real face gives.
    let frame = easel.expression(COMPLEX.weights, &[])?;
    let settings = DrawSettings { system: WrinkleSystem::Both, ..easel.face() };
    let mut row = Row::default();
    row.cells.push(Cell::new(easel.draw(SIZE, &settings, &frame)?, "from the front"));
    let mut turned = settings;
    turned.camera.orbit(-0.6, 0.05);
    row.cells.push(Cell::new(easel.draw(SIZE, &turned, &frame)?, "from the character's right"));
    let bars = COMPLEX.weights.iter().map(|&(name, weight)| (name.to_owned(), weight, format!("{weight:.2}"))).collect();
    row.cells.push(Cell { content: Content::Bars { size: [330, SIZE[1]], bars }, caption: "shapes".into(), note: String::new() });
    let subtitle = format!("{} shapes at once", COMPLEX.weights.len());
    Ok(Sheet { title: "Jimenez et al. 2011, Figure 1.2".into(), subtitle, rows: vec![row] })
}

/// Figure 1.5.
pub(super) fn opposed(easel: &mut Easel) -> Result<Sheet> {
    const SIZE: [u32; 2] = [380, 380];
    let (weights, amounts) = mixed((&SURPRISE, 1.0), (&ANGER, 1.0));
    let faces = [
        ("neutral", RenderFrame::at_rest(easel.character())),
        ("surprise", whole(easel, &SURPRISE)?),
        ("anger", whole(easel, &ANGER)?),
        ("surprise and anger: the forehead smooths out", easel.expression(&weights, &amounts)?),
    ];
    let settings = zones_only(easel.face());
    let forehead = zones_only(DrawSettings { view: ViewMode::Normals, ..forehead(easel) });
    let mut rows = vec![Row::default(), Row { heading: "The forehead's normals".into(), cells: Vec::new() }];
    for (name, frame) in &faces {
        rows[0].cells.push(Cell::new(easel.draw(SIZE, &settings, frame)?, *name));
        // Bones at rest, so that nothing but the zones' wrinkles differs.
        let still =
            RenderFrame { zones: frame.zones.clone(), stretched: frame.stretched.clone(), ..RenderFrame::at_rest(easel.character()) };
        let zones = frame.zones.iter().take(4).map(|weight| format!("{weight:.1}")).collect::<Vec<_>>().join("  ");
        rows[1].cells.push(Cell::new(easel.draw([SIZE[0], SIZE[1] / 2], &forehead, &still)?, format!("red, green, blue, brown: {zones}")));
    }
    let subtitle = "positive and negative weights cancel in the forehead".into();
    Ok(Sheet { title: "Jimenez et al. 2011, Figure 1.5".into(), subtitle, rows })
}

fn forehead(easel: &Easel) -> DrawSettings {
    let marks = &easel.character().ibug68;
    let (brows, width) = ((marks[19] + marks[24]) * 0.5, marks[17].distance(marks[26]));
    easel.close_up(brows + 0.25 * width * Vec3::Y, 0.7 * width)
}

fn nose(easel: &Easel) -> DrawSettings {
    let marks = &easel.character().ibug68;
    let width = marks[17].distance(marks[26]);
    easel.close_up(marks[27].lerp(marks[30], 0.25), 0.75 * width)
}

fn chin(easel: &Easel) -> DrawSettings {
    let marks = &easel.character().ibug68;
    let width = marks[17].distance(marks[26]);
    easel.close_up(marks[57].lerp(marks[8], 0.5), 0.7 * width)
}

/// Figure 1.6.
pub(super) fn close_ups(easel: &mut Easel) -> Result<Sheet> {
    const SIZE: [u32; 2] = [480, 480];
    let places = [
        ("Nasalis, disgust", nose(easel), whole(easel, &DISGUST)?),
        ("Frontalis, surprise", forehead(easel), whole(easel, &SURPRISE)?),
        ("Mentalis, sadness", chin(easel), whole(easel, &expressions::SAD)?),
    ];
    let mut rows = vec![Row::default(), Row { heading: "The same without wrinkles".into(), cells: Vec::new() }];
    for (name, settings, frame) in places {
        for (row, view) in rows.iter_mut().zip([ViewMode::Beauty, ViewMode::Bare]) {
            let picture = easel.draw(SIZE, &zones_only(DrawSettings { view, ..settings }), &frame)?;
            row.cells.push(Cell::new(picture, if view == ViewMode::Beauty { name } else { "" }));
        }
    }
    Ok(Sheet { title: "Jimenez et al. 2011, Figure 1.6".into(), subtitle: "zones from near".into(), rows })
}

/// Figure 1.7.
pub(super) fn sequence(easel: &mut Easel) -> Result<Sheet> {
    const SIZE: [u32; 2] = [300, 300];
    // Surprise comes, disgust joins it, surprise goes.
    const STEPS: [[f32; 2]; 12] = [
        [0.0, 0.0],
        [0.25, 0.0],
        [0.5, 0.0],
        [0.75, 0.0],
        [1.0, 0.0],
        [1.0, 0.25],
        [1.0, 0.5],
        [0.9, 0.75],
        [0.7, 1.0],
        [0.45, 1.0],
        [0.2, 1.0],
        [0.0, 1.0],
    ];
    let settings = zones_only(easel.face());
    let mut rows = Vec::new();
    for steps in STEPS.chunks(6) {
        let mut row = Row::default();
        for &[surprise, disgust] in steps {
            let (weights, amounts) = mixed((&SURPRISE, surprise), (&DISGUST, disgust));
            let frame = easel.expression(&weights, &amounts)?;
            let caption = format!("surprise {:.0} %, disgust {:.0} %", 100.0 * surprise, 100.0 * disgust);
            row.cells.push(Cell::new(easel.draw(SIZE, &settings, &frame)?, caption));
        }
        rows.push(row);
    }
    let subtitle = "from neutral to surprise to disgust".into();
    Ok(Sheet { title: "Jimenez et al. 2011, Figure 1.7".into(), subtitle, rows })
}

/// Table 1.1.
pub(super) fn table(easel: &mut Easel) -> Result<Sheet> {
    const SIZE: [u32; 2] = [300, 300];
    let zones = easel.character().zones.clone().ok_or(PictureError::Lacks("wrinkle zones"))?;
    let mut rows = vec![Row::default(), Row::default(), Row { heading: "Weights of the zones".into(), cells: Vec::new() }];
    for expression in &expressions::ALL {
        let frame = whole(easel, expression)?;
        for (row, view) in rows.iter_mut().zip([ViewMode::Bare, ViewMode::Beauty]) {
            let picture = easel.draw(SIZE, &zones_only(DrawSettings { view, ..easel.face() }), &frame)?;
            row.cells.push(Cell::new(picture, if view == ViewMode::Beauty { expression.name } else { "" }));
        }
        let weights = zones.expressions.iter().find(|row| row.name == expression.name).map(|row| row.weights.clone()).unwrap_or_default();
        let bars = zones.list.iter().zip(weights).map(|(zone, weight)| (zone.name.clone(), weight, format!("{weight}"))).collect();
        rows[2].cells.push(Cell { content: Content::Bars { size: [SIZE[0], 190], bars }, caption: String::new(), note: String::new() });
    }
    Ok(Sheet { title: "Jimenez et al. 2011, Table 1.1".into(), subtitle: "without wrinkles and with them".into(), rows })
}

/// Both systems on the same faces.
pub(super) fn both_papers(easel: &mut Easel) -> Result<Sheet> {
    const SIZE: [u32; 2] = [400, 400];
    let mut rows = Vec::new();
    for expression in [SURPRISE, ANGER, DISGUST, expressions::SAD] {
        let frame = whole(easel, &expression)?;
        let mut row = Row { heading: expression.name.into(), cells: Vec::new() };
        let bare = easel.draw(SIZE, &DrawSettings { view: ViewMode::Bare, ..easel.face() }, &frame)?;
        row.cells.push(Cell::new(bare, "without wrinkles"));
        for (system, caption) in [
            (WrinkleSystem::Bones, "bones (Dutreve et al. 2009)"),
            (WrinkleSystem::Zones, "zones (Jimenez et al. 2011)"),
            (WrinkleSystem::Both, "both, one over the other"),
        ] {
            row.cells.push(Cell::new(easel.draw(SIZE, &DrawSettings { system, ..easel.face() }, &frame)?, caption));
        }
        rows.push(row);
    }
    Ok(Sheet { title: "Both papers".into(), subtitle: "the same expressions, each with its wrinkles".into(), rows })
}

/// Seven emotions under each set-up of lights.
pub(super) fn emotions(easel: &mut Easel) -> Result<Sheet> {
    const SIZE: [u32; 2] = [340, 340];
    let mut faces = vec![("neutral", RenderFrame::at_rest(easel.character())), ("smile", easel.expression(JOY.weights, &[("joy", 0.6)])?)];
    for expression in [SURPRISE, ANGER, DISGUST, expressions::FEAR, expressions::SAD] {
        faces.push((expression.name, whole(easel, &expression)?));
    }
    let mut rows = Vec::new();
    for studio in [Studio::Portrait, Studio::Sunset] {
        let mut row = Row { heading: format!("{studio}"), cells: Vec::new() };
        for (name, frame) in &faces {
            let settings = DrawSettings { studio, system: WrinkleSystem::Both, ..easel.face() };
            row.cells.push(Cell::new(easel.draw(SIZE, &settings, frame)?, *name));
        }
        rows.push(row);
    }
    Ok(Sheet { title: "Seven emotions".into(), subtitle: "under two set-ups of light".into(), rows })
}
