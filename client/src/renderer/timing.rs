//! How long each pass takes on the device.

/// Passes in the order they are recorded.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Pass {
    /// Shadow map and depth along the key light.
    Shadow,
    /// The character and what lies behind it.
    Scene,
    /// Scattering, first direction.
    ScatterAcross,
    /// Scattering, second direction.
    ScatterUp,
    /// Highlights, tone map.
    Tone,
    /// Smoothed edges, encoding.
    Present,
}

impl Pass {
    /// All of them.
    pub const ALL: [Self; 6] = [Self::Shadow, Self::Scene, Self::ScatterAcross, Self::ScatterUp, Self::Tone, Self::Present];

    /// Shown to people and in captures.
    pub fn name(self) -> &'static str {
        match self {
            Self::Shadow => "shadow",
            Self::Scene => "scene",
            Self::ScatterAcross => "scatter across",
            Self::ScatterUp => "scatter up",
            Self::Tone => "tone",
            Self::Present => "present",
        }
    }
}

/// Two time stamps a pass.
#[derive(Debug)]
pub struct PassTimer {
    set: wgpu::QuerySet,
    resolved: wgpu::Buffer,
    /// Nanoseconds a tick.
    period: f32,
}

/// Stamps of all passes.
const NUM_STAMPS: u32 = 2 * Pass::ALL.len() as u32;
const NUM_BYTES: u64 = 8 * NUM_STAMPS as u64;

impl PassTimer {
    /// `None` where the device has no time stamps.
    pub fn new(device: &wgpu::Device, queue: &wgpu::Queue) -> Option<Self> {
        device.features().contains(wgpu::Features::TIMESTAMP_QUERY).then(|| Self {
            set: device.create_query_set(&wgpu::QuerySetDescriptor {
                label: Some("pass times"),
                ty: wgpu::QueryType::Timestamp,
                count: NUM_STAMPS,
            }),
            resolved: device.create_buffer(&wgpu::BufferDescriptor {
                label: Some("pass times"),
                size: NUM_BYTES,
                usage: wgpu::BufferUsages::QUERY_RESOLVE | wgpu::BufferUsages::COPY_SRC,
                mapped_at_creation: false,
            }),
            period: queue.get_timestamp_period(),
        })
    }

    /// For the pass' descriptor.
    pub fn writes(&self, pass: Pass) -> wgpu::RenderPassTimestampWrites<'_> {
        let first = 2 * pass as u32;
        wgpu::RenderPassTimestampWrites {
            query_set: &self.set,
            beginning_of_pass_write_index: Some(first),
            end_of_pass_write_index: Some(first + 1),
        }
    }

    /// Records the way of the stamps into a buffer that can be mapped.
    pub fn resolve(&self, device: &wgpu::Device, encoder: &mut wgpu::CommandEncoder) -> wgpu::Buffer {
        let buffer = device.create_buffer(&wgpu::BufferDescriptor {
            label: Some("pass times, read back"),
            size: NUM_BYTES,
            usage: wgpu::BufferUsages::COPY_DST | wgpu::BufferUsages::MAP_READ,
            mapped_at_creation: false,
        });
        encoder.resolve_query_set(&self.set, 0..NUM_STAMPS, &self.resolved, 0);
        encoder.copy_buffer_to_buffer(&self.resolved, 0, &buffer, 0, NUM_BYTES);
        buffer
    }

    /// Milliseconds of each pass from what was read back; 0 for passes that were left out.
    pub fn milliseconds(&self, stamps: &[u64]) -> [f64; Pass::ALL.len()] {
        std::array::from_fn(|pass| {
            let ticks = stamps[2 * pass + 1].saturating_sub(stamps[2 * pass]);
            ticks as f64 * f64::from(self.period) * 1e-6
        })
    }
}
