//! Characters on one device hold what they have in common once.

use crate::Add;
use crate::golden::{Lens, camera};
use anyhow::{Context, ensure};
use rhytid_client::renderer::{AdapterChoice, WrinkleSystem};
use rhytid_client::{CharacterAsset, DrawSettings, Headless, RenderFrame};
use rhytid_shared::DEFAULT_CHARACTER_GLB;
use serde_json::{Value, json};

const SIDE: u32 = 128;

pub fn add(add: &mut Add<'_>) {
    add("sharing::characters_of_one_layout_have_their_maps_once".into(), Box::new(|_| of_one_layout()));
}

/// The default character's file with another JSON chunk; its buffer, and so every map in it, stays.
fn edited(edit: impl FnOnce(&mut Value)) -> anyhow::Result<Vec<u8>> {
    let file = DEFAULT_CHARACTER_GLB;
    let length = file.get(12..16).and_then(|bytes| bytes.try_into().ok()).map(u32::from_le_bytes).context("a header")? as usize;
    let (json_chunk, rest) = file[20..].split_at(length);
    let mut json: Value = serde_json::from_slice(json_chunk)?;
    edit(&mut json);
    let mut chunk = serde_json::to_vec(&json)?;
    chunk.resize(chunk.len().next_multiple_of(4), b' ');
    let mut bytes = file[..8].to_vec();
    bytes.extend(((20 + chunk.len() + rest.len()) as u32).to_le_bytes());
    bytes.extend((chunk.len() as u32).to_le_bytes());
    bytes.extend(&file[16..20]);
    bytes.extend(chunk);
    bytes.extend(rest);
    Ok(bytes)
}

/// Another person of the same layout: wrinkles elsewhere when surprised, other brows, and skin without pores.
fn another() -> anyhow::Result<CharacterAsset> {
    let bytes = edited(|json| {
        let face = &mut json["extensions"]["RHYTID_face"];
        face["name"] = json!("Another");
        for expression in face["zones"]["expressions"].as_array_mut().into_iter().flatten() {
            expression["weights"] = json!([0.0, 0.0, 0.0, 0.0, 0.5, 0.5, 0.5, 0.5]);
        }
        for material in json["materials"].as_array_mut().into_iter().flatten() {
            if material["name"] == "skin" {
                material.as_object_mut().map(|skin| skin.remove("normalTexture"));
            } else if material["name"] == "brow" {
                material["pbrMetallicRoughness"]["baseColorFactor"] = json!([0.6, 0.3, 0.1, 1.0]);
            }
        }
    })?;
    Ok(CharacterAsset::from_glb(&bytes)?)
}

fn of_one_layout() -> anyhow::Result<()> {
    let (first_asset, second_asset) = (CharacterAsset::from_glb(DEFAULT_CHARACTER_GLB)?, another()?);
    ensure!(first_asset.character.zones != second_asset.character.zones, "the characters shall differ in their zones");
    let wrinkle_bytes: usize = first_asset.wrinkles.iter().flat_map(|maps| &maps.layers).map(|layer| layer.num_bytes()).sum();
    let first = Headless::on(&first_asset, AdapterChoice::Software)?;
    let pool = first.pool().clone();
    let (num_alone, bytes_alone) = (pool.num_maps(), pool.bytes());
    ensure!(bytes_alone <= first.gpu_bytes() && first.shared_bytes() == 0, "nobody shares with one character");

    // All but the pores, whose place one flat texel takes; the materials without a map of slopes have that already.
    let mut second = first.beside(&second_asset);
    ensure!(pool.num_maps() == num_alone, "{} maps with two characters, {num_alone} with one", pool.num_maps());
    ensure!(pool.bytes() == bytes_alone, "{} bytes with two characters, {bytes_alone} with one", pool.bytes());
    let shared = second.shared_bytes();
    ensure!(shared == first.shared_bytes() && shared < bytes_alone, "{shared} and {} bytes shared", first.shared_bytes());
    ensure!(
        shared > wrinkle_bytes as u64 + second.zone_bytes(),
        "{shared} bytes shared, wrinkles alone take {wrinkle_bytes} and zones {}",
        second.zone_bytes()
    );

    // What is shared draws like what is one's own.
    let settings = DrawSettings { system: WrinkleSystem::Both, ..DrawSettings::new(camera(&first_asset.character, Lens::Face)) };
    let frame = RenderFrame::at_rest(&second_asset.character);
    let beside = second.render([SIDE; 2], &settings, &frame)?;
    let alone = Headless::on(&second_asset, AdapterChoice::Software)?.render([SIDE; 2], &settings, &frame)?;
    ensure!(beside == alone, "a character beside another looks otherwise than alone");

    drop(first);
    ensure!(second.shared_bytes() == 0, "the last who has a map shares it with nobody");
    let (num_left, bytes_left) = (pool.num_maps(), pool.bytes());
    ensure!(num_left == num_alone - 1 && bytes_left == shared, "{num_left} maps of {bytes_left} bytes are left");
    // A third that comes now finds the maps of the second, and makes the one that went.
    let mut third = second.beside(&first_asset);
    ensure!(pool.bytes() == bytes_alone, "{} bytes, {bytes_alone} before", pool.bytes());
    drop(second);
    let again = third.render([SIDE; 2], &settings, &frame)?;
    let first_alone = Headless::on(&first_asset, AdapterChoice::Software)?.render([SIDE; 2], &settings, &frame)?;
    ensure!(again == first_alone && again != alone, "the first character does not come back as it was");
    let device = third.device().0.clone();
    let before = wrinkle_maps_allocated(&device)?;
    drop(third);
    ensure!(pool.num_maps() == 0 && pool.bytes() == 0, "{} maps outlive their characters", pool.num_maps());
    let after = wrinkle_maps_allocated(&device)?;
    ensure!(before == Some(1) && after == Some(0), "the device has {before:?} wrinkle maps, then {after:?}");
    Ok(())
}

/// How many textures of wrinkle maps the device has memory for; `None` where it does not tell.
fn wrinkle_maps_allocated(device: &wgpu::Device) -> anyhow::Result<Option<usize>> {
    device.poll(wgpu::PollType::wait_indefinitely())?;
    let report = device.generate_allocator_report();
    Ok(report.map(|report| report.allocations.iter().filter(|allocation| allocation.name == "wrinkle maps").count()))
}
