//! Expression shapes: the device against its twin, and that a face is deformed by shapes or by bones, never by both.

use crate::twins::{Sequence, all_vertices, moving_frame, probe_skinning};
use crate::{Add, Stage};
use anyhow::{Context, ensure};
use glam::{Quat, Vec3, Vec4};
use image::RgbaImage;
use rhytid_client::asset::{Morphs, Vertex};
use rhytid_client::{Camera, CharacterAsset, Deformation, DrawSettings, Headless, RenderFrame, ViewMode, twin};
use rhytid_shared::{ARKIT_NAMES, ArkitShape, Character, NUM_ARKIT_SHAPES};

const SIDE: u32 = 256;

pub fn add(add: &mut Add<'_>) {
    add("morphs::every_shape_alone".into(), Box::new(every_shape_alone));
    add("morphs::all_shapes_at_once_with_bones_and_head".into(), Box::new(all_at_once));
    add("morphs::entries_at_the_ends_of_a_full_texture_are_found".into(), Box::new(full_texture));
    add("morphs::shapes_deform_in_place_of_bones".into(), Box::new(in_place_of_bones));
    add("morphs::frames_without_weights_and_characters_without_shapes_keep_their_bones".into(), Box::new(fallback));
    add("morphs::head_turns_a_face_of_shapes".into(), Box::new(head_turns));
}

fn weights_of(named: &[(&str, f32)]) -> anyhow::Result<[f32; NUM_ARKIT_SHAPES]> {
    let mut weights = [0.0; NUM_ARKIT_SHAPES];
    for &(name, weight) in named {
        weights[ArkitShape::from_name(name).with_context(|| name.to_owned())?.index()] = weight;
    }
    Ok(weights)
}

/// Largest distances of position, normal and tangent between device and twin.
fn compare(stage: &Stage, asset: &CharacterAsset, frame: &RenderFrame, vertices: &[Vertex]) -> anyhow::Result<usize> {
    let weights = frame.shapes.context("a frame with weights")?;
    let palette = asset.palette.model_from_rest(&asset.character, frame);
    let read = |which| probe_skinning(stage, asset, frame, vertices, which);
    let (positions, normals, tangents) = (read(0)?, read(1)?, read(2)?);
    let xyz = |value: [f32; 4]| Vec4::from(value).truncate();
    let mut num_moved = 0;
    for (v, vertex) in vertices.iter().enumerate() {
        let morphed = twin::morph(vertex, &asset.morphs, &weights);
        let twin = twin::deform_morphed(vertex, &morphed, &palette);
        let (position, normal, tangent) = (xyz(positions[v]), xyz(normals[v]), xyz(tangents[v]));
        ensure!(position.distance(twin.position) < 2e-6, "vertex {v} is at {position}, its twin at {}", twin.position);
        // Where a surface is crushed to nothing its direction is a matter of rounding.
        let area = morphed.tangent.cross(morphed.bitangent).length();
        if area > 0.05 {
            ensure!(normal.distance(twin.normal) < 1e-3, "vertex {v} has normal {normal}, its twin {}", twin.normal);
            ensure!(tangent.distance(twin.tangent) < 1e-3, "vertex {v} has tangent {tangent}, its twin {}", twin.tangent);
        }
        num_moved += usize::from(position.distance(twin::deform(vertex, &palette).position) > 1e-4);
    }
    Ok(num_moved)
}

fn every_shape_alone(stage: &Stage) -> anyhow::Result<()> {
    let vertices = all_vertices(stage);
    for shape in 0..NUM_ARKIT_SHAPES {
        let mut weights = [0.0; NUM_ARKIT_SHAPES];
        weights[shape] = 1.0;
        let frame = RenderFrame { shapes: Some(weights), ..RenderFrame::at_rest(&stage.asset.character) };
        let num_moved = compare(stage, &stage.asset, &frame, &vertices).with_context(|| ARKIT_NAMES[shape])?;
        ensure!(num_moved > 100, "{} moves {num_moved} vertices only", ARKIT_NAMES[shape]);
    }
    Ok(())
}

fn all_at_once(stage: &Stage) -> anyhow::Result<()> {
    let mut sequence = Sequence(52);
    let weights = [(); NUM_ARKIT_SHAPES].map(|()| sequence.next(0.05, 1.0));
    let frame = RenderFrame { shapes: Some(weights), ..moving_frame(stage)? };
    let num_moved = compare(stage, &stage.asset, &frame, &all_vertices(stage))?;
    ensure!(num_moved > 10_000, "{num_moved} vertices moved");
    Ok(())
}

/// The first vertices of the character with their entries at the beginning, across rows and at the very end of the largest
/// texture.
fn full_texture(stage: &Stage) -> anyhow::Result<()> {
    use rhytid_client::asset::{ENTRIES_PER_ROW, MAX_ENTRIES, TEXELS_PER_ENTRY};
    let mut texels = vec![Default::default(); MAX_ENTRIES * TEXELS_PER_ENTRY];
    let moved: Vec<Vertex> = all_vertices(stage).into_iter().filter(|vertex| vertex.morphs[1] > 4).take(3).collect();
    let vertices: Vec<Vertex> = moved
        .iter()
        .zip([0, ENTRIES_PER_ROW - 2, MAX_ENTRIES - moved[2].morphs[1] as usize])
        .map(|(vertex, first)| {
            let [old, count] = vertex.morphs.map(|value| value as usize * TEXELS_PER_ENTRY);
            let new = first * TEXELS_PER_ENTRY;
            texels[new..new + count].copy_from_slice(&stage.asset.morphs.texels[old..old + count]);
            Vertex { morphs: [first as u32, vertex.morphs[1]], ..*vertex }
        })
        .collect();
    let asset = CharacterAsset {
        character: stage.asset.character.clone(),
        primitives: Vec::new(),
        palette: stage.asset.palette.clone(),
        morphs: Morphs { texels },
        wrinkles: None,
        blood: None,
        zones: None,
    };
    let frame = RenderFrame { shapes: Some([0.7; NUM_ARKIT_SHAPES]), ..RenderFrame::at_rest(&asset.character) };
    let num_moved = compare(stage, &asset, &frame, &vertices)?;
    ensure!(num_moved == 3, "{num_moved} of 3 vertices moved");
    Ok(())
}

fn draw_view(
    headless: &mut Headless,
    character: &Character,
    (deform, view): (Deformation, ViewMode),
    frame: &RenderFrame,
) -> anyhow::Result<RgbaImage> {
    let mut camera = Camera::front(character);
    camera.zoom(0.62);
    Ok(headless.render([SIDE, SIDE], &DrawSettings { deform, view, ..DrawSettings::new(camera) }, frame)?)
}

fn draw(headless: &mut Headless, character: &Character, deform: Deformation, frame: &RenderFrame) -> anyhow::Result<RgbaImage> {
    draw_view(headless, character, (deform, ViewMode::Beauty), frame)
}

fn num_different(a: &RgbaImage, b: &RgbaImage) -> usize {
    a.pixels().zip(b.pixels()).filter(|(a, b)| a.0.iter().zip(b.0).any(|(a, b)| a.abs_diff(b) > 3)).count()
}

/// A frame whose bones say one thing and whose weights another.
fn in_place_of_bones(stage: &Stage) -> anyhow::Result<()> {
    let character = &stage.asset.character;
    let rest = RenderFrame::at_rest(character);
    let smile = RenderFrame { shapes: Some(weights_of(&[("mouthSmileLeft", 1.0), ("mouthSmileRight", 1.0)])?), ..rest.clone() };
    let mut both = RenderFrame { shapes: smile.shapes, ..moving_frame(stage)? };
    both.head = rest.head;
    // What wrinkles is the influences, whatever deforms.
    both.influences.fill(0.0);
    let mut headless = stage.headless()?;
    // Normals tell the shape; the light in mouth and eyes follows the frame's lips and gaze.
    let mut normals = |deform, frame: &RenderFrame| draw_view(&mut headless, character, (deform, ViewMode::Normals), frame);
    let (of_shapes, none) = (normals(Deformation::Shapes, &smile)?, normals(Deformation::Bones, &smile)?);
    let of_bones = normals(Deformation::Bones, &RenderFrame { shapes: None, ..both.clone() })?;
    ensure!(num_different(&of_shapes, &none) > 500, "the smile shows in {} pixels", num_different(&of_shapes, &none));
    ensure!(num_different(&of_bones, &none) > 500, "the bones show in {} pixels", num_different(&of_bones, &none));
    ensure!(normals(Deformation::Bones, &both)? == of_bones, "weights change a face of bones");
    ensure!(normals(Deformation::Shapes, &both)? == of_shapes, "bones change a face of shapes");

    let mut wrinkled = smile.clone();
    wrinkled.influences.fill(1.0);
    let count = num_different(
        &draw(&mut headless, character, Deformation::Shapes, &wrinkled)?,
        &draw(&mut headless, character, Deformation::Shapes, &smile)?,
    );
    ensure!(count > 200, "a face of shapes wrinkles in {count} pixels");
    Ok(())
}

fn fallback(stage: &Stage) -> anyhow::Result<()> {
    let character = &stage.asset.character;
    let frame = RenderFrame { shapes: None, ..moving_frame(stage)? };
    {
        let mut headless = stage.headless()?;
        let asked = draw(&mut headless, character, Deformation::Shapes, &frame)?;
        ensure!(asked == draw(&mut headless, character, Deformation::Bones, &frame)?, "a frame without weights is another face");
    }
    let plain = stage.variant(|asset| {
        asset.morphs = Morphs::default();
        asset.primitives.iter_mut().flat_map(|primitive| &mut primitive.vertices).for_each(|vertex| vertex.morphs = [0; 2]);
    })?;
    let mut plain = plain.headless()?;
    let frame = RenderFrame { shapes: Some([1.0; NUM_ARKIT_SHAPES]), ..frame };
    let asked = draw(&mut plain, character, Deformation::Shapes, &frame)?;
    ensure!(asked == draw(&mut plain, character, Deformation::Bones, &frame)?, "a character without shapes is another face");
    Ok(())
}

fn head_turns(stage: &Stage) -> anyhow::Result<()> {
    let character = &stage.asset.character;
    let mut frame = RenderFrame { shapes: Some(weights_of(&[("jawOpen", 0.6)])?), ..RenderFrame::at_rest(character) };
    let straight = stage.asset.palette.model_from_unposed(character, &frame);
    ensure!(straight.iter().all(|matrix| matrix.abs_diff_eq(glam::Affine3A::IDENTITY, 1e-6)), "something moves at rest");
    frame.head.rotation = Quat::from_rotation_y(0.4);
    let turned = stage.asset.palette.model_from_unposed(character, &frame);
    let nose = character.ibug68[30];
    let moved = turned.iter().map(|matrix| matrix.transform_point3(nose)).filter(|at| at.distance(nose) > 0.01).count();
    ensure!(moved >= character.num_bones() / 2, "{moved} joints carry the nose along");
    ensure!(turned.iter().any(|matrix| matrix.transform_point3(Vec3::ZERO) == Vec3::ZERO), "the bust stays");
    let mut headless = stage.headless()?;
    let a = draw(&mut headless, character, Deformation::Shapes, &frame)?;
    frame.head.rotation = Quat::IDENTITY;
    let count = num_different(&a, &draw(&mut headless, character, Deformation::Shapes, &frame)?);
    ensure!(count > 5000, "the head's turn changes {count} pixels");
    Ok(())
}
