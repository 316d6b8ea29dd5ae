//! What a picture costs: milliseconds a pass on the device, draw calls and bytes, at three sizes; and what wrinkles cost
//! inside the whole renderer. Medians over pictures drawn in turn.

use rhytid_client::render_cli::{StillSide, posed_points, solve_one};
use rhytid_client::renderer::Pass;
use rhytid_client::{Camera, CharacterAsset, DrawSettings, Headless, RenderFrame, ViewMode};
use rhytid_shared::{DEFAULT_CHARACTER_GLB, TrackingData};

const SIZES: [[u32; 2]; 3] = [[640, 640], [1280, 720], [1920, 1080]];
/// Pictures of each kind and size; the first compiles pipelines.
const PICTURES: usize = 7;

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
    println!("adapter {}", headless.adapter().name);
    for size in SIZES {
        let (mut passes, mut ratios) = (Vec::new(), Vec::new());
        for i in 0..=PICTURES {
            let Some(with) = headless.pass_times(size, &beauty, &frame)? else {
                println!("the adapter gives no time stamps");
                return Ok(());
            };
            let num_draws = headless.num_draws();
            let Some(without) = headless.pass_times(size, &bare, &frame)? else { return Ok(()) };
            if i == 0 {
                println!("\n{} x {}: {num_draws} draw calls, {:.1} MB", size[0], size[1], headless.gpu_bytes() as f64 / 1e6);
                continue;
            }
            ratios.push(with.iter().sum::<f64>() / without.iter().sum::<f64>());
            passes.push(with);
        }
        for (p, pass) in Pass::ALL.into_iter().enumerate() {
            println!("{:>15} {:8.2} ms", pass.name(), median(passes.iter().map(|times| times[p])));
        }
        println!("{:>15} {:8.2} ms", "all", median(passes.iter().map(|times| times.iter().sum())));
        println!("{:>15} {:8.3}", "with / without", median(ratios.iter().copied()));
    }
    Ok(())
}

fn median(values: impl Iterator<Item = f64>) -> f64 {
    let mut values: Vec<f64> = values.collect();
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}
