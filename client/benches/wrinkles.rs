//! What wrinkles cost: frames with them and without drawn in turn, the median of the paired ratios. Paired, it repeats
//! within a few percent even on software Vulkan, where single times wander.

use rhytid_client::render_cli::{StillSide, posed_points, solve_one};
use rhytid_client::{Camera, CharacterAsset, DrawSettings, Headless, RenderFrame, ViewMode};
use rhytid_shared::{DEFAULT_CHARACTER_GLB, TrackingData};
use std::time::{Duration, Instant};

/// Pairs measured; the first few warm up caches and compile shaders.
const PAIRS: usize = 60;
const WARM_UP: usize = 4;
const SIZE: [u32; 2] = [512, 512];

fn main() -> anyhow::Result<()> {
    let asset = CharacterAsset::from_glb(DEFAULT_CHARACTER_GLB)?;
    let mut headless = Headless::new(&asset)?;
    let mut camera = Camera::front(&asset.character);
    // The face fills the picture: the dearest case.
    camera.zoom(0.6);
    let beauty = DrawSettings::new(camera);
    let bare = DrawSettings { view: ViewMode::Bare, ..beauty };
    let pose = asset.character.poses.first().map(|pose| pose.name.clone()).unwrap_or_default();
    let points = posed_points(&asset.character, &pose, 1.0, StillSide::Both)?;
    let frame = RenderFrame::from(&solve_one(&asset.character, TrackingData::Bones { points, head: None })?);

    let mut time = |settings: &DrawSettings| -> anyhow::Result<Duration> {
        let begun = Instant::now();
        headless.draw_only(SIZE, settings, &frame)?;
        Ok(begun.elapsed())
    };
    let (mut ratios, mut on_times, mut off_times) = (Vec::new(), Vec::new(), Vec::new());
    for pair in 0..PAIRS + WARM_UP {
        // Who goes first alternates, so that a drift of the machine favours neither.
        let (on, off) = if pair % 2 == 0 {
            let on = time(&beauty)?;
            (on, time(&bare)?)
        } else {
            let off = time(&bare)?;
            (time(&beauty)?, off)
        };
        if pair >= WARM_UP {
            ratios.push(on.as_secs_f64() / off.as_secs_f64());
            on_times.push(on.as_secs_f64() * 1e3);
            off_times.push(off.as_secs_f64() * 1e3);
        }
    }
    println!("adapter                    {}", headless.adapter().name);
    println!("picture                    {} x {}, {} wrinkle maps", SIZE[0], SIZE[1], asset.character.num_poses());
    println!("with wrinkles, median      {:.2} ms", median(&mut on_times));
    println!("without, median            {:.2} ms", median(&mut off_times));
    println!("median of {PAIRS} paired ratios {:.3}", median(&mut ratios));
    println!("on the device              {:.1} MB", headless.gpu_bytes() as f64 / 1e6);
    Ok(())
}

fn median(values: &mut [f64]) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}
