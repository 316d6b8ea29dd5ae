//! What wrinkles cost, those of bones, of zones and both: frames with them and without drawn in turn, the median of the
//! paired ratios. Where a processor draws, its time is counted rather than the clock's: others on the machine change it little.

use rhytid_client::render_cli::{StillSide, posed_points, solve_one};
use rhytid_client::renderer::{Pass, WrinkleSystem};
use rhytid_client::{Camera, CharacterAsset, DrawSettings, Headless, RenderFrame, ViewMode};
use rhytid_shared::{DEFAULT_CHARACTER_GLB, TrackingData};
use std::time::Instant;

/// Pairs measured; the first few warm up caches and compile shaders.
const PAIRS: usize = 16;
const WARM_UP: usize = 2;
const SIZE: [u32; 2] = [512, 512];
/// Pictures a measurement: Linux counts hundredths of a second.
const DRAWN: usize = 3;

fn main() -> anyhow::Result<()> {
    let asset = CharacterAsset::from_glb(DEFAULT_CHARACTER_GLB)?;
    let mut headless = Headless::new(&asset)?;
    let mut camera = Camera::front(&asset.character);
    // The face fills the picture: the dearest case.
    camera.zoom(0.6);
    let pose = asset.character.poses.first().map(|pose| pose.name.clone()).unwrap_or_default();
    let points = posed_points(&asset.character, &pose, 1.0, StillSide::Both)?;
    let frame = RenderFrame::from(&solve_one(&asset.character, TrackingData::Bones { points, head: None })?);
    let is_software = headless.adapter().device_type == wgpu::DeviceType::Cpu;
    let start = Instant::now();
    let now = || processor_seconds().filter(|_| is_software).unwrap_or_else(|| start.elapsed().as_secs_f64());
    println!("adapter  {}, {} x {}, {PAIRS} pairs", headless.adapter().name, SIZE[0], SIZE[1]);
    for system in [WrinkleSystem::Bones, WrinkleSystem::Zones, WrinkleSystem::Both] {
        let with = DrawSettings { system, ..DrawSettings::new(camera) };
        let without = DrawSettings { view: ViewMode::Bare, ..with };
        let [mut whole, mut scene] = [Vec::new(), Vec::new()];
        for pair in 0..PAIRS + WARM_UP {
            // Who goes first alternates, so that a drift of the machine favours neither.
            let order = if pair % 2 == 0 { [&with, &without] } else { [&without, &with] };
            let mut times = Vec::new();
            for settings in order {
                let begun = now();
                for _ in 0..DRAWN {
                    headless.draw_only(SIZE, settings, &frame)?;
                }
                let took = now() - begun;
                let passes = headless.pass_times(SIZE, settings, &frame)?;
                times.push([took, passes.map_or(f64::NAN, |passes| passes[Pass::Scene as usize])]);
            }
            if pair % 2 == 1 {
                times.swap(0, 1);
            }
            if pair >= WARM_UP {
                whole.push(times[0][0] / times[1][0]);
                scene.push(times[0][1] / times[1][1]);
            }
        }
        println!(
            "{:>6}   whole picture {:.3}, scene pass alone {:.3} (with over without, median)",
            system,
            median(&mut whole),
            median(&mut scene)
        );
    }
    println!("zones    {} bytes of masks and map; all on the device {:.1} MB", headless.zone_bytes(), headless.gpu_bytes() as f64 / 1e6);
    Ok(())
}

fn median(values: &mut [f64]) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

/// Seconds that all threads of this process have computed; `None` where the system does not tell as Linux does.
fn processor_seconds() -> Option<f64> {
    let stat = std::fs::read_to_string("/proc/self/stat").ok()?;
    // The name of the program, in brackets, may hold spaces. After it the state is the first field, the user's time the twelfth.
    let fields: Vec<&str> = stat.rsplit_once(')')?.1.split_whitespace().collect();
    let ticks = |at: usize| fields.get(at)?.parse::<f64>().ok();
    Some((ticks(11)? + ticks(12)?) / 100.0)
}
