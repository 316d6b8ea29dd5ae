//! Properties of pictures that hold whatever the character looks like.

use crate::golden::{Face, Lens, REST, SIDE, Shot, camera, draw};
use crate::read_back::read_back;
use crate::{Add, Stage};
use anyhow::ensure;
use image::RgbaImage;
use rhytid_client::render_cli::{StillSide, posed_points, solve_one};
use rhytid_client::renderer::picture_texture;
use rhytid_client::{Camera, DrawSettings, RenderFrame, Renderer, ViewMode};
use rhytid_shared::TrackingData;
use rhytid_shared::limits::MAX_POSES;
use std::sync::Arc;

const BEAUTY: Shot = REST;

pub fn add(add: &mut Add<'_>) {
    add("properties::same_frame_gives_the_same_picture".into(), Box::new(same_frame_gives_the_same_picture));
    add("properties::rest_has_no_wrinkles".into(), Box::new(rest_has_no_wrinkles));
    add("properties::raising_the_right_brow_changes_the_left_of_the_picture".into(), Box::new(raising_the_right_brow));
    add("properties::switched_off_wrinkles_are_those_of_the_bare_view".into(), Box::new(wrinkles_switched_off));
    add("properties::head_to_the_characters_left_goes_right_in_the_picture".into(), Box::new(head_moves));
    add("properties::one_sided_influences_wrinkle_mirrored_halves".into(), Box::new(one_sided_influences));
    add("properties::poses_beyond_the_fourth_wrinkle_as_the_first_four".into(), Box::new(poses_beyond_the_fourth));
    add("properties::targets_with_and_without_srgb_encoding_hold_the_same_picture".into(), Box::new(targets_encode_alike));
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

/// How far two pictures are apart left and right of the middle: sums of squared differences over all channels.
fn apart(a: &RgbaImage, b: &RgbaImage) -> [f64; 2] {
    let mut sums = [0.0; 2];
    for ((x, _, a), b) in a.enumerate_pixels().zip(b.pixels()) {
        sums[usize::from(x >= SIDE / 2)] += (0..3).map(|channel| (f64::from(a[channel]) - f64::from(b[channel])).powi(2)).sum::<f64>();
    }
    sums
}

/// Figure 5 of Dutreve et al. 2009: half a forehead wrinkles without any mask map. The character's right is on the left of
/// a picture from the front. The skinning weights of the inner brow reach a little over the middle, and so do its wrinkles.
fn raising_the_right_brow(stage: &Stage) -> anyhow::Result<()> {
    let raised = |side| -> anyhow::Result<_> {
        let raised = Shot { face: Face::Pose("stretch", 1.0, side), ..BEAUTY };
        let (with, without) = (draw(stage, &raised, SIDE)?, draw(stage, &Shot { view: "bare", ..raised }, SIDE)?);
        Ok((apart(&with, &without), different(&with, &without, 3)))
    };
    let ((energy, count), (of_both, _)) = (raised(StillSide::Right)?, raised(StillSide::Both)?);
    let what = format!("energy {energy:.0?} in {count:?} pixels left and right of the middle; {of_both:.0?} where both brows rise");
    ensure!(count[0] > 500 && energy[0] > 0.5 * of_both[0] && of_both[1] > 0.3 * of_both[0], "too little wrinkles: {what}");
    ensure!(energy[1] < 0.02 * energy[0] && count[1] * 50 < count[0], "the other half wrinkles: {what}");
    Ok(())
}

fn wrinkles_switched_off(stage: &Stage) -> anyhow::Result<()> {
    let character = &stage.asset.character;
    let shot = Shot { face: Face::Pose("stretch", 1.0, StillSide::Both), ..BEAUTY };
    let bare = draw(stage, &Shot { view: "bare", ..shot.clone() }, SIDE)?;
    let points = posed_points(character, "stretch", 1.0, StillSide::Both)?;
    let frame = RenderFrame::from(&solve_one(character, TrackingData::Bones { points, head: None })?);
    let settings = DrawSettings { wrinkles: false, ..DrawSettings::new(camera(character, Lens::Face)) };
    let mut headless = stage.headless()?;
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
    let mut headless = stage.headless()?;
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

/// How much the wrinkles turn normals, left and right of the picture's middle: sums of squared differences to the same
/// face without them.
fn slope_energy(stage: &Stage, frame: &RenderFrame) -> anyhow::Result<[f64; 2]> {
    let settings = DrawSettings { view: ViewMode::Normals, ..DrawSettings::new(camera(&stage.asset.character, Lens::Face)) };
    let without = RenderFrame { influences: vec![0.0; frame.influences.len()], ..frame.clone() };
    let mut headless = stage.headless()?;
    let [with, without] = [frame, &without].map(|frame| headless.render([SIDE, SIDE], &settings, frame));
    let (with, without) = (with?, without?);
    Ok(apart(&with, &without))
}

/// For each pose: its influences on the character's right alone, then mirrored. Bones stay at rest, so that nothing but
/// the wrinkles differs. A map may differ from left to right as skin does, not in how strongly it wrinkles.
fn one_sided_influences(stage: &Stage) -> anyhow::Result<()> {
    let character = &*stage.asset.character;
    let num_bones = character.num_bones();
    let middle = 0.5 * (character.ibug68[36].x + character.ibug68[45].x);
    for (k, pose) in character.poses.iter().enumerate() {
        let on_side = |sign: f32| {
            let mut frame = RenderFrame::at_rest(character);
            for (i, bone) in character.bones.iter().enumerate() {
                // Bones in the middle belong to neither side.
                let is_there = (bone.rest.x - middle) * sign > 0.002 && pose.points[i] != bone.rest;
                frame.influences[k * num_bones + i] = f32::from(u8::from(is_there));
            }
            slope_energy(stage, &frame)
        };
        let (of_right, of_left) = (on_side(-1.0)?, on_side(1.0)?);
        let what = format!("{}: energy {of_right:.0?} of the right side's influences, {of_left:.0?} of the left's", pose.name);
        // The character's right is on the left of the picture.
        ensure!(of_right[0] > 2000.0 && of_right[0] > 4.0 * of_right[1], "{what}");
        ensure!((of_right[0] / of_left[1]).ln().abs() < 0.4, "{what}");
    }
    Ok(())
}

/// Twice the poses, the second half the first in reverse: influences in the second half draw the same face.
fn poses_beyond_the_fourth(stage: &Stage) -> anyhow::Result<()> {
    let character = &*stage.asset.character;
    let (num_bones, num_poses) = (character.num_bones(), character.num_poses());
    ensure!(num_poses * 2 > 4 && num_poses * 2 <= MAX_POSES, "{num_poses} poses twice over do not test the second vector");
    let twice = stage.variant(|asset| {
        let mut doubled = (*asset.character).clone();
        doubled.poses.extend(character.poses.iter().rev().cloned());
        for (number, pose) in doubled.poses[num_poses..].iter_mut().enumerate() {
            pose.name = format!("again {number}");
        }
        asset.character = Arc::new(doubled);
        if let Some(wrinkles) = &mut asset.wrinkles {
            wrinkles.layers.extend(wrinkles.layers.clone().into_iter().rev());
            wrinkles.scales.extend(wrinkles.scales.clone().into_iter().rev());
            wrinkles.contains_neutral.extend(wrinkles.contains_neutral.clone().into_iter().rev());
        }
    })?;
    // Unlike in every pose and bone.
    let influences: Vec<f32> = (0..num_poses * num_bones).map(|at| 0.2 + 0.6 * ((at * 7 % 11) as f32 / 10.0)).collect();
    let zeros = vec![0.0; influences.len()];
    let reversed: Vec<f32> = influences.chunks(num_bones).rev().flatten().copied().collect();
    let frame = |influences: Vec<f32>| RenderFrame { influences, ..RenderFrame::at_rest(character) };
    let first = frame([influences.clone(), zeros.clone()].concat());
    let second = frame([zeros.clone(), reversed].concat());
    let swapped = frame([zeros, influences].concat());
    for view in [ViewMode::Normals, ViewMode::Influence(None)] {
        let of = |frame: &RenderFrame, view| -> anyhow::Result<RgbaImage> {
            let settings = DrawSettings { view, ..DrawSettings::new(camera(character, Lens::Face)) };
            Ok(twice.headless()?.render([SIDE, SIDE], &settings, frame)?)
        };
        // The heat map has a hue of its own for each pose: there one pose alone is compared.
        let (view, view_again) = match view {
            ViewMode::Influence(_) => (ViewMode::Influence(Some(1)), ViewMode::Influence(Some(2 * num_poses - 2))),
            view => (view, view),
        };
        let (first, second, swapped) = (of(&first, view)?, of(&second, view_again)?, of(&swapped, view_again)?);
        let count = different(&first, &second, 1);
        ensure!(count == [0, 0], "{count:?} pixels differ in {view:?}");
        let count = different(&first, &swapped, 4);
        ensure!(count[0] + count[1] > 1000, "other influences change {count:?} pixels only in {view:?}");
    }
    Ok(())
}

/// What the shader encodes where the target does not is what the hardware encodes where it does.
fn targets_encode_alike(stage: &Stage) -> anyhow::Result<()> {
    let headless = stage.headless()?;
    let (device, queue) = headless.device();
    let points = posed_points(&stage.asset.character, "stretch", 1.0, StillSide::Both)?;
    let frame = RenderFrame::from(&solve_one(&stage.asset.character, TrackingData::Bones { points, head: None })?);
    // Lit light is encoded; normals are display values already, which an encoding target must be given decoded.
    for view in [ViewMode::Beauty, ViewMode::Normals, ViewMode::Split] {
        let settings = DrawSettings { view, ..DrawSettings::new(camera(&stage.asset.character, Lens::Face)) };
        let draw = |format: wgpu::TextureFormat| {
            let mut renderer = Renderer::new(device, queue, headless.pool(), &stage.asset, format);
            let target = picture_texture(device, "test picture", [SIDE; 2], format, wgpu::TextureUsages::COPY_SRC);
            let mut encoder = device.create_command_encoder(&wgpu::CommandEncoderDescriptor { label: Some("test picture") });
            let seen = target.create_view(&wgpu::TextureViewDescriptor::default());
            renderer.draw(device, queue, &mut encoder, &seen, [SIDE, SIDE], &settings, &frame, None);
            read_back(device, queue, encoder, &target)
        };
        let (encoding, plain) = (draw(wgpu::TextureFormat::Rgba8UnormSrgb)?, draw(wgpu::TextureFormat::Rgba8Unorm)?);
        let most = encoding.iter().zip(&plain).map(|(a, b)| a.abs_diff(*b)).max();
        ensure!(most.is_some_and(|most| most <= 1), "the two differ by {most:?} codes in {view:?}");
        ensure!(encoding.iter().any(|code| (64..192).contains(code)), "{view:?} has no middle tones, where encodings differ");
    }
    Ok(())
}

fn device_bytes_are_counted(stage: &Stage) -> anyhow::Result<()> {
    let headless = stage.headless()?;
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
