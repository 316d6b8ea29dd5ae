//! The contact sheet: the film's strongest moments, with wrinkles and without.

use super::{Crew, FilmError, Moment};
use crate::renderer::ViewMode;
use crate::sheet::{Cell, Content, Row, Sheet};
use image::RgbaImage;
use rhytid_shared::Character;

/// Moments in a row; there are two such pairs of rows.
const COLUMNS: usize = 5;
const PAIRS: usize = 2;
/// Side of a picture, pixels.
const CELL: u32 = 280;

/// Draws `moments` again where they are strongest, each with wrinkles and below without.
pub(super) fn contact_sheet(crew: &mut Crew, moments: &[Moment], title: &str) -> Result<RgbaImage, FilmError> {
    let mut rows = Vec::new();
    for moments in choose(moments, COLUMNS * PAIRS).chunks(COLUMNS) {
        let (mut with, mut without) = (Row::default(), Row::default());
        for moment in moments {
            with.cells.push(Cell::new(crew.draw(&moment.frame, ViewMode::Beauty, [CELL, CELL])?, ""));
            let strongest = strongest(moment, &crew.character).map(|(pose, most)| format!("{pose} {:.0} %", 100.0 * most));
            without.cells.push(Cell {
                content: Content::Picture(crew.draw(&moment.frame, ViewMode::Bare, [CELL, CELL])?),
                caption: format!("{:.1} s", moment.at.as_secs_f64()),
                note: strongest.unwrap_or_default(),
            });
        }
        rows.extend([with, without]);
    }
    let sheet = Sheet { title: "Rhytid".into(), subtitle: format!("{title}: above with wrinkles, below without"), rows };
    let (device, queue) = crew.headless.device();
    Ok(sheet.draw(device, queue)?)
}

/// Of each of `count` equal parts of the film the moment whose wrinkles are strongest.
fn choose(moments: &[Moment], count: usize) -> Vec<&Moment> {
    let strength = |moment: &Moment| moment.frame.influences.iter().sum::<f32>();
    let parts = count.min(moments.len());
    (0..parts)
        .filter_map(|part| {
            let range = part * moments.len() / parts..(part + 1) * moments.len() / parts;
            moments[range].iter().max_by(|a, b| strength(a).total_cmp(&strength(b)))
        })
        .collect()
}

fn strongest(moment: &Moment, character: &Character) -> Option<(String, f32)> {
    let rows = moment.frame.influences.chunks(character.num_bones().max(1));
    let most = rows.map(|row| row.iter().copied().fold(0.0, f32::max));
    let (pose, most) = character.poses.iter().zip(most).max_by(|(_, a), (_, b)| a.total_cmp(b))?;
    (most >= 0.05).then(|| (pose.name.clone(), most))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::renderer::RenderFrame;
    use std::time::Duration;

    fn moment(k: u64, influence: f32) -> Moment {
        let frame = RenderFrame {
            points: Vec::new(),
            rotations: Vec::new(),
            influences: vec![influence],
            zones: Vec::new(),
            stretched: Vec::new(),
            shapes: None,
            head: Default::default(),
        };
        Moment { at: Duration::from_secs(k), frame }
    }

    #[test]
    fn strongest_moment_of_each_part_is_chosen_in_order() {
        let moments: Vec<Moment> = [0.1, 0.9, 0.2, 0.3, 0.0, 0.0, 0.5, 0.4].iter().zip(0..).map(|(&x, k)| moment(k, x)).collect();
        let at = |chosen: Vec<&Moment>| chosen.iter().map(|moment| moment.at.as_secs()).collect::<Vec<_>>();
        assert_eq!(at(choose(&moments, 2)), [1, 6]);
        assert_eq!(at(choose(&moments, 20)), [0, 1, 2, 3, 4, 5, 6, 7]);
        assert!(choose(&[], 20).is_empty());
    }
}
