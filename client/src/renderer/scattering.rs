//! Separable subsurface scattering: the kernel and the two draws.

use super::fullscreen::{self, filtered_picture};
use super::layouts::uniform;
use super::pipelines::SCENE_FORMAT;
use super::targets::Targets;
use super::timing::Pass;
use super::uniforms;
use super::upload::entry;
use glam::Vec3;

/// Samples of the widest kernel the block holds.
const MAX_SAMPLES: usize = 25;
/// Farthest sample, mm.
const REACH_MM: f32 = 3.0;
/// How fast each colour falls off and how much of it scatters, linear RGB: the values Jimenez and others publish for
/// skin with their 2011 demonstration.
const FALLOFF: Vec3 = Vec3::new(1.0, 0.37, 0.3);
const STRENGTH: Vec3 = Vec3::new(0.48, 0.41, 0.28);
/// Variances in mm² and red weights of d'Eon and Luebke's skin profile, its narrowest Gaussian left out: `STRENGTH`
/// stands for the light that leaves where it came in.
const PROFILE: [(f32, f32); 5] = [(0.0484, 0.100), (0.187, 0.118), (0.567, 0.113), (1.99, 0.358), (7.41, 0.078)];

/// One sample of the kernel.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct KernelSample {
    /// Weights by colour.
    pub weight: Vec3,
    /// Along the direction, mm.
    pub offset_mm: f32,
}

/// The kernel with `count` samples (odd, 3 to 25), its middle first, the others from one end to the other. Weights sum to
/// one by colour (Jimenez and others 2011, as they published it).
pub fn kernel(count: usize) -> Vec<KernelSample> {
    let range = if count > 20 { 3.0 } else { 2.0 };
    let offset = |i: usize| {
        let x = -range + 2.0 * range * i as f32 / (count - 1) as f32;
        x.signum() * x * x / range
    };
    let profile = |r: f32| {
        let scaled = Vec3::splat(r) / (FALLOFF + 0.001);
        let gaussian = |variance: f32| (scaled * scaled / (-2.0 * variance)).exp() / (2.0 * std::f32::consts::PI * variance);
        PROFILE.iter().map(|&(variance, weight)| gaussian(variance) * weight).sum::<Vec3>()
    };
    let mut samples: Vec<KernelSample> = (0..count)
        .map(|i| {
            let before = if i > 0 { (offset(i) - offset(i - 1)).abs() } else { 0.0 };
            let after = if i + 1 < count { (offset(i) - offset(i + 1)).abs() } else { 0.0 };
            KernelSample { weight: profile(offset(i)) * (0.5 * (before + after)), offset_mm: offset(i) }
        })
        .collect();
    let middle = samples.remove(count / 2);
    samples.insert(0, middle);
    let total: Vec3 = samples.iter().map(|sample| sample.weight).sum();
    for sample in &mut samples {
        sample.weight = sample.weight / total * STRENGTH;
    }
    samples[0].weight += Vec3::ONE - STRENGTH;
    samples
}

/// Pipeline and blocks of both draws.
#[derive(Debug)]
pub(super) struct Scattering {
    pipeline: wgpu::RenderPipeline,
    pub layout: wgpu::BindGroupLayout,
    /// Across and up.
    pub blocks: [wgpu::Buffer; 2],
    kernel: Vec<KernelSample>,
}

/// What the draws need to know of the picture.
#[derive(Debug, Clone, Copy)]
pub(super) struct Lens {
    /// Width over height.
    pub aspect: f32,
    /// Vertical field of view, radians.
    pub fovy: f32,
    /// From the camera to where stored depth is zero, metres.
    pub distance: f32,
}

impl Scattering {
    pub fn new(device: &wgpu::Device) -> Self {
        let layout = device.create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor {
            label: Some("scatter"),
            entries: &[
                uniform(0, wgpu::ShaderStages::FRAGMENT, size_of::<uniforms::Scatter>()),
                filtered_picture(1),
                filtered_picture(2),
                fullscreen::filtering_sampler(3),
            ],
        });
        let pipeline = fullscreen::pipeline(device, "scatter", rhytid_shaders::SCATTER, "fs_scatter", &layout, SCENE_FORMAT);
        let blocks = ["scatter across", "scatter up"].map(|label| fullscreen::block(device, label, size_of::<uniforms::Scatter>()));
        // A processor that draws pays for each sample; its eleven differ from twenty-five by less than a code.
        let is_software = device.adapter_info().device_type == wgpu::DeviceType::Cpu;
        Self { pipeline, layout, blocks, kernel: kernel(if is_software { 11 } else { 25 }) }
    }

    /// Writes both blocks for light that spreads `scale` times as far as in human skin.
    pub fn write(&self, queue: &wgpu::Queue, lens: Lens, scale: f32) {
        // A length L at depth z covers L / (2 z tan(fovy / 2)) of the picture's height (similar triangles).
        let up = 0.001 * scale * 0.5 / (0.5 * lens.fovy).tan();
        let mut kernel = [[0.0; 4]; MAX_SAMPLES];
        for (to, from) in kernel.iter_mut().zip(&self.kernel) {
            *to = from.weight.extend(from.offset_mm).to_array();
        }
        for (block, uv_per_mm_at_metre) in self.blocks.iter().zip([[up / lens.aspect, 0.0], [0.0, up]]) {
            let scatter = uniforms::Scatter {
                kernel,
                uv_per_mm_at_metre,
                depth_origin: lens.distance,
                // Wholly rejected at twice the kernel's reach (the published rule's distance, free of scale).
                rejection: 0.49 / (0.001 * scale * REACH_MM).max(1e-6),
                num_samples: self.kernel.len() as u32,
                padding: [0; 3],
            };
            queue.write_buffer(block, 0, bytemuck::bytes_of(&scatter));
        }
    }

    /// Records both draws: from the diffuse picture to the scratch one and on to the scattered one.
    pub fn draw(
        &self,
        encoder: &mut wgpu::CommandEncoder,
        targets: &Targets,
        [across, up]: [Option<wgpu::RenderPassTimestampWrites<'_>>; 2],
    ) {
        fullscreen::draw(encoder, Pass::ScatterAcross, &self.pipeline, &targets.scatter_groups[0], &targets.scratch, across);
        fullscreen::draw(encoder, Pass::ScatterUp, &self.pipeline, &targets.scatter_groups[1], &targets.scattered, up);
    }

    /// Groups of both draws.
    pub fn groups(&self, device: &wgpu::Device, pictures: [&wgpu::TextureView; 2], specular: &wgpu::TextureView) -> [wgpu::BindGroup; 2] {
        let sampler = fullscreen::sampler(device);
        [0, 1].map(|way| {
            device.create_bind_group(&wgpu::BindGroupDescriptor {
                label: Some("scatter"),
                layout: &self.layout,
                entries: &[
                    entry(0, self.blocks[way].as_entire_binding()),
                    entry(1, wgpu::BindingResource::TextureView(pictures[way])),
                    entry(2, wgpu::BindingResource::TextureView(specular)),
                    entry(3, wgpu::BindingResource::Sampler(&sampler)),
                ],
            })
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn assert_near(got: Vec3, want: [f32; 3]) {
        assert!((got - Vec3::from(want)).abs().max_element() < 2e-6, "got {got}, expected {want:?}");
    }

    #[test]
    fn kernel_of_eleven_samples_matches_the_worked_numbers() {
        let samples = kernel(11);
        assert_near(samples[0].weight, [0.56047879, 0.6690861, 0.78472778]);
        for (i, offset, weight) in [
            (1, -2.0, [0.00471692, 0.00018477, 0.00005076]),
            (2, -1.28, [0.01928312, 0.00282018, 0.00084214]),
            (3, -0.72, [0.03638996, 0.01309991, 0.00643685]),
            (5, -0.08, [0.07718024, 0.11349124, 0.07938032]),
        ] {
            assert!((samples[i].offset_mm - offset).abs() < 1e-6);
            assert_near(samples[i].weight, weight);
        }
    }

    #[test]
    fn kernels_of_other_sizes_match_the_worked_numbers() {
        assert_near(kernel(17)[0].weight, [0.53634254, 0.62462437, 0.74886695]);
        let samples = kernel(25);
        assert_near(samples[0].weight, [0.53060512, 0.61351444, 0.73960097]);
        for (sample, offset) in samples[1..].iter().zip([-3.0, -2.52083333, -2.08333333]) {
            assert!((sample.offset_mm - offset).abs() < 1e-5);
        }
    }

    #[test]
    fn no_light_is_lost_or_made() {
        for count in [11, 17, 25] {
            let total: Vec3 = kernel(count).iter().map(|sample| sample.weight).sum();
            assert!((total - Vec3::ONE).abs().max_element() < 1e-5, "{count}: {total}");
        }
    }
}
