//! Properties of pictures that hold whatever the character looks like.

use crate::golden::{Face, Shot, draw};
use crate::{Add, Stage};
use anyhow::ensure;
use image::RgbaImage;
use rhytid_client::render_cli::{StillSide, solve_one};
use rhytid_client::{BlendMode, Camera, DrawSettings, RenderFrame};
use rhytid_shared::TrackingData;

const SIDE: u32 = 256;
const BEAUTY: Shot = Shot { face: Face::Rest, view: "beauty", blend: BlendMode::PartialDerivatives };

pub fn add(add: &mut Add<'_>) {
    add("properties::same_frame_gives_the_same_picture".into(), Box::new(same_frame_gives_the_same_picture));
    add("properties::rest_has_no_wrinkles".into(), Box::new(rest_has_no_wrinkles));
    add("properties::raising_the_right_brow_changes_the_left_of_the_picture".into(), Box::new(raising_the_right_brow));
    add("properties::switched_off_wrinkles_are_those_of_the_bare_view".into(), Box::new(wrinkles_switched_off));
    add("properties::head_to_the_characters_left_goes_right_in_the_picture".into(), Box::new(head_moves));
    add("properties::device_bytes_are_counted".into(), Box::new(device_bytes_are_counted));
}

/// Pixels that differ by more than `codes` in a channel, left and right of the middle.
fn different(a: &RgbaImage, b: &RgbaImage, codes: u8) -> [usize; 2] {
    let mut count = [0; 2];
    for (x, y, pixel) in a.enumerate_pixels() {
        let other = b.get_pixel(x, y);
        if pixel.0.iter().zip(other.0).any(|(a, b)| a.abs_diff(b) > codes) {
            count[usize::from(x >= a.width() / 2)] += 1;
        }
    }
    count
}

fn same_frame_gives_the_same_picture(stage: &Stage) -> anyhow::Result<()> {
    let shot = Shot { face: Face::Pose("stretch", 1.0, StillSide::Both), ..BEAUTY };
    let first = draw(stage, &shot, SIDE)?;
    draw(stage, &BEAUTY, SIDE)?;
    ensure!(first == draw(stage, &shot, SIDE)?, "two drawings of one frame differ");
    Ok(())
}

fn rest_has_no_wrinkles(stage: &Stage) -> anyhow::Result<()> {
    let count = different(&draw(stage, &BEAUTY, SIDE)?, &draw(stage, &Shot { view: "bare", ..BEAUTY }, SIDE)?, 2);
    ensure!(count == [0, 0], "beauty and bare differ at rest in {count:?} pixels");
    let posed = Shot { face: Face::Pose("stretch", 1.0, StillSide::Both), ..BEAUTY };
    let count = different(&draw(stage, &posed, SIDE)?, &draw(stage, &Shot { view: "bare", ..posed }, SIDE)?, 2);
    ensure!(count[0] > 200 && count[1] > 200, "the stretched forehead shows wrinkles in {count:?} pixels only");
    Ok(())
}

/// The character's right is on the left of a picture from the front.
fn raising_the_right_brow(stage: &Stage) -> anyhow::Result<()> {
    let raised = Shot { face: Face::Pose("stretch", 1.0, StillSide::Right), ..BEAUTY };
    let wrinkles = different(&draw(stage, &raised, SIDE)?, &draw(stage, &Shot { view: "bare", ..raised }, SIDE)?, 3);
    ensure!(wrinkles[0] > 150, "wrinkles in {wrinkles:?} pixels left and right of the middle");
    ensure!(wrinkles[1] * 8 < wrinkles[0], "wrinkles in {wrinkles:?} pixels left and right of the middle");
    Ok(())
}

fn wrinkles_switched_off(stage: &Stage) -> anyhow::Result<()> {
    let character = &stage.asset.character;
    let shot = Shot { face: Face::Pose("stretch", 1.0, StillSide::Both), ..BEAUTY };
    let bare = draw(stage, &Shot { view: "bare", ..shot.clone() }, SIDE)?;
    let points = rhytid_client::render_cli::posed_points(character, "stretch", 1.0, StillSide::Both)?;
    let frame = RenderFrame::from(&solve_one(character, TrackingData::Bones { points, head: None })?);
    let mut camera = Camera::front(character);
    camera.zoom(0.62);
    let settings = DrawSettings { wrinkles: false, ..DrawSettings::new(camera) };
    let mut headless = stage.headless.lock().map_err(|_| anyhow::anyhow!("another test broke the renderer"))?;
    let off = headless.render([SIDE, SIDE], &settings, &frame)?;
    let count = different(&off, &bare, 2);
    ensure!(count == [0, 0], "{count:?} pixels differ");
    Ok(())
}

fn head_moves(stage: &Stage) -> anyhow::Result<()> {
    let character = &stage.asset.character;
    let mut frame = RenderFrame::at_rest(character);
    frame.head.position.x = 0.05;
    let settings = DrawSettings::new(Camera::front(character));
    let mut headless = stage.headless.lock().map_err(|_| anyhow::anyhow!("another test broke the renderer"))?;
    let rest = headless.render([SIDE, SIDE], &settings, &RenderFrame::at_rest(character))?;
    let moved = headless.render([SIDE, SIDE], &settings, &frame)?;
    // Light in the upper half, where there is nothing but the head and the dark wall.
    let centre = |picture: &RgbaImage| {
        let weigh =
            |(x, y, pixel): (u32, u32, &image::Rgba<u8>)| if y < SIDE / 2 && pixel[0] > 110 { (f64::from(x), 1.0) } else { (0.0, 0.0) };
        let (sum, count) = picture.enumerate_pixels().map(weigh).fold((0.0, 0.0), |(a, b), (x, n)| (a + x, b + n));
        sum / f64::max(count, 1.0)
    };
    let shift = centre(&moved) - centre(&rest);
    ensure!(shift > 10.0, "the head moved {shift:.1} pixels to the right");
    Ok(())
}

fn device_bytes_are_counted(stage: &Stage) -> anyhow::Result<()> {
    let headless = stage.headless.lock().map_err(|_| anyhow::anyhow!("another test broke the renderer"))?;
    let vertices = stage.asset.num_vertices() * size_of::<rhytid_client::asset::Vertex>();
    let wrinkles: usize = stage.asset.wrinkles.iter().flat_map(|maps| &maps.layers).map(|layer| layer.num_bytes()).sum();
    let counted = headless.gpu_bytes();
    ensure!(
        counted > (vertices + wrinkles) as u64,
        "{counted} bytes counted, vertices and wrinkle maps alone take {}",
        vertices + wrinkles
    );
    Ok(())
}
