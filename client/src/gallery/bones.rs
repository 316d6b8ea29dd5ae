//! The figures of Dutreve, Meyer, Bouakaz 2009: wrinkles that bones' reference poses bring.

use super::Result;
use super::easel::Easel;
use crate::render_cli::{PictureError, StillSide, posed_points};
use crate::renderer::{DrawSettings, RenderFrame, ViewMode, WrinkleSystem};
use crate::sheet::{Cell, Content, Row, Sheet};
use rhytid_server::feed::{Feed, FeedItem};
use rhytid_server::solve::{SolveConfig, Solver};
use rhytid_shared::{Character, FaceFrame, TrackingData, TrackingFrame};
use std::sync::Arc;

/// Frames of the session that Figure 3 shows.
const TRACKED: usize = 8;
/// The iBUG 68 landmarks that one line joins, and whether it closes.
const LINES: [(std::ops::Range<usize>, bool); 9] = [
    (0..17, false),
    (17..22, false),
    (22..27, false),
    (27..31, false),
    (31..36, false),
    (36..42, true),
    (42..48, true),
    (48..60, true),
    (60..68, true),
];

fn bones_only(settings: DrawSettings) -> DrawSettings {
    DrawSettings { system: WrinkleSystem::Bones, ..settings }
}

fn pose_index(character: &Character, name: &str) -> Result<usize> {
    character.poses.iter().position(|pose| pose.name == name).ok_or(PictureError::Lacks("reference pose of raised brows (stretch)"))
}

/// Figure 2.
pub(super) fn reach(easel: &mut Easel) -> Result<Sheet> {
    const SIZE: [u32; 2] = [420, 420];
    let character = Arc::clone(easel.character());
    let pose = pose_index(&character, "stretch")?;
    let bones = ["brow_inner_r", "brow_mid_r"].map(|name| character.bones.iter().position(|bone| bone.name == name));
    let settings = bones_only(DrawSettings { view: ViewMode::Influence(Some(pose)), ..easel.face() });
    let mut row = Row::default();
    for bone in bones {
        let bone = bone.ok_or(PictureError::Lacks("bones of the right brow (brow_inner_r, brow_mid_r)"))?;
        // A bone at its pose shows where it is: what is drawn is its skinning weight.
        let mut frame = RenderFrame::at_rest(&character);
        frame.influences[pose * character.num_bones() + bone] = 1.0;
        row.cells.push(Cell::new(easel.draw(SIZE, &settings, &frame)?, format!("Skinning weights of {}", character.bones[bone].name)));
    }
    let raised: Vec<_> =
        posed_points(&character, "stretch", 1.0, StillSide::Right)?.into_iter().filter(|(bone, _)| bones.contains(&Some(*bone))).collect();
    let frame = easel.posed(raised)?;
    row.cells.push(Cell::new(easel.draw(SIZE, &settings, &frame)?, "Influence of the pose when both bones rise"));
    let beauty = bones_only(easel.face());
    row.cells.push(Cell::new(easel.draw(SIZE, &beauty, &frame)?, "Wrinkles there"));
    Ok(Sheet { title: "Dutreve et al. 2009, Figure 2".into(), subtitle: "skinning weights are the masks".into(), rows: vec![row] })
}

/// Figure 3.
pub(super) fn tracker(easel: &mut Easel) -> Result<Sheet> {
    const SIZE: [u32; 2] = [260, 260];
    let character = Arc::clone(easel.character());
    let path = easel.feed.clone();
    let mut feed = Feed::open(&path, &character)?;
    let mut solver = Solver::new(Arc::clone(&character), &SolveConfig::default(), &feed.hello)?;
    let mut tracked = TrackingFrame::default();
    let mut solved = FaceFrame::at_rest(&character);
    let mut moments: Vec<Moment> = Vec::new();
    while let Some(item) = feed.next_frame(&mut tracked)? {
        if let FeedItem::Command(command) = item {
            solver.command(&command)?;
            continue;
        }
        solver.solve(&tracked, &mut solved).map_err(|source| PictureError::Frame {
            path: path.display().to_string(),
            line: feed.line(),
            source,
        })?;
        if let TrackingData::Landmarks { points, .. } = &tracked.data
            && points.len() == 68
        {
            let points = points.iter().map(|point| [point[0], point[1]]).collect();
            moments.push(Moment { t: tracked.t, points, frame: RenderFrame::from(&solved) });
        }
    }
    let chosen = strongest(&moments, TRACKED);
    let mut rows = Vec::new();
    for chunk in chosen.chunks(TRACKED / 2) {
        let (mut above, mut below) = (Row::default(), Row::default());
        for moment in chunk {
            above.cells.push(Cell { content: drawn(&moment.points, SIZE), caption: String::new(), note: String::new() });
            let picture = easel.draw(SIZE, &bones_only(easel.face()), &moment.frame)?;
            below.cells.push(Cell::new(picture, format!("{:.1} s", moment.t)));
        }
        rows.extend([above, below]);
    }
    Ok(Sheet { title: "Dutreve et al. 2009, Figure 3".into(), subtitle: "tracked landmarks and the face they give".into(), rows })
}

struct Moment {
    t: f64,
    points: Vec<[f32; 2]>,
    frame: RenderFrame,
}

/// Of each of `count` equal parts the moment of the strongest wrinkles.
fn strongest(moments: &[Moment], count: usize) -> Vec<&Moment> {
    let strength = |moment: &Moment| moment.frame.influences.iter().sum::<f32>();
    (0..count.min(moments.len()))
        .filter_map(|part| {
            let part = &moments[part * moments.len() / count..(part + 1) * moments.len() / count];
            part.iter().max_by(|a, b| strength(a).total_cmp(&strength(b)))
        })
        .collect()
}

/// Landmarks fitted into a slate.
fn drawn(points: &[[f32; 2]], size: [u32; 2]) -> Content {
    let side = size[0].min(size[1]) as f32;
    let (mut low, mut high) = ([f32::INFINITY; 2], [f32::NEG_INFINITY; 2]);
    for point in points {
        for axis in 0..2 {
            (low[axis], high[axis]) = (low[axis].min(point[axis]), high[axis].max(point[axis]));
        }
    }
    let scale = 0.82 * side / (high[0] - low[0]).max(high[1] - low[1]).max(1.0);
    let place =
        |&index: &usize| [0, 1].map(|axis| 0.5 * size[axis] as f32 + (points[index][axis] - 0.5 * (low[axis] + high[axis])) * scale);
    let lines = LINES.iter().map(|(range, is_closed)| {
        let mut indices: Vec<usize> = range.clone().collect();
        indices.extend(is_closed.then_some(range.start));
        indices.iter().map(place).collect()
    });
    Content::Lines { size, lines: lines.collect() }
}

/// Figure 4, with the character's other poses.
pub(super) fn poses(easel: &mut Easel) -> Result<Sheet> {
    const SIZE: [u32; 2] = [270, 270];
    let character = Arc::clone(easel.character());
    let mut faces = vec![("neutral".to_owned(), RenderFrame::at_rest(&character))];
    for pose in &character.poses {
        faces.push((pose.name.clone(), easel.posed(posed_points(&character, &pose.name, 1.0, StillSide::Both)?)?));
    }
    // Two poses in one area, as in the paper's last column: the inner brows rise, the outer ones do not.
    let inner = |(bone, _): &(usize, glam::Vec3)| character.bones[*bone].name.starts_with("brow_inner");
    let mut points: Vec<_> =
        posed_points(&character, "compress", 0.8, StillSide::Both)?.into_iter().filter(|moved| !inner(moved)).collect();
    points.extend(posed_points(&character, "stretch", 0.8, StillSide::Both)?.into_iter().filter(inner));
    faces.push(("inner brows of stretch, all else of compress".into(), easel.posed(points)?));
    let mut rows = vec![Row::default(), Row::default(), Row::default()];
    for (name, frame) in &faces {
        for (row, view) in rows.iter_mut().zip([ViewMode::Bare, ViewMode::Influence(None), ViewMode::Beauty]) {
            let picture = easel.draw(SIZE, &bones_only(DrawSettings { view, ..easel.face() }), frame)?;
            row.cells.push(Cell::new(picture, if view == ViewMode::Beauty { name.as_str() } else { "" }));
        }
    }
    let subtitle = "without wrinkles; influence of the poses, each in its hue; with wrinkles".into();
    Ok(Sheet { title: "Dutreve et al. 2009, Figure 4".into(), subtitle, rows })
}

/// Figure 5.
pub(super) fn halves(easel: &mut Easel) -> Result<Sheet> {
    const SIZE: [u32; 2] = [420, 420];
    let character = Arc::clone(easel.character());
    let pose = pose_index(&character, "stretch")?;
    let right = easel.posed(posed_points(&character, "stretch", 1.0, StillSide::Right)?)?;
    let whole = easel.posed(posed_points(&character, "stretch", 1.0, StillSide::Both)?)?;
    let faces = [("neutral", RenderFrame::at_rest(&character)), ("the right brow raised", right), ("both brows raised", whole)];
    let mut rows = vec![Row::default(), Row::default()];
    for (name, frame) in &faces {
        for (row, view) in rows.iter_mut().zip([ViewMode::Influence(Some(pose)), ViewMode::Beauty]) {
            let picture = easel.draw(SIZE, &bones_only(DrawSettings { view, ..easel.face() }), frame)?;
            row.cells.push(Cell::new(picture, if view == ViewMode::Beauty { *name } else { "" }));
        }
    }
    Ok(Sheet { title: "Dutreve et al. 2009, Figure 5".into(), subtitle: "the character's right is on the left".into(), rows })
}
