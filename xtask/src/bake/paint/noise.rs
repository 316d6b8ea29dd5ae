//! Seeded noise over space. Integer hashes and plain arithmetic only, so that every machine paints the same face.

use glam::Vec3;

const PRIME_X: u32 = 0x8da6_b343;
const PRIME_Y: u32 = 0xd816_3841;
const PRIME_Z: u32 = 0xcb1a_b31f;
const PRIME_SEED: u32 = 0x9e37_79b9;

/// A hash of a lattice point, uniform over 32 bits.
pub fn hash(x: i32, y: i32, z: i32, seed: u32) -> u32 {
    let h = (x as u32).wrapping_mul(PRIME_X) ^ (y as u32).wrapping_mul(PRIME_Y) ^ (z as u32).wrapping_mul(PRIME_Z);
    mix(h.wrapping_add(seed.wrapping_mul(PRIME_SEED)))
}

/// Uniform in [0, 1).
pub fn unit(hash: u32) -> f32 {
    (hash >> 8) as f32 * (1.0 / 16_777_216.0)
}

/// A small stream of random numbers for things that are scattered.
pub struct Dice(u32);

impl Dice {
    /// The stream of `seed`.
    pub fn new(seed: u32) -> Self {
        Self(mix(seed.wrapping_add(0x6d2b_79f5)))
    }

    /// Uniform in [0, 1).
    pub fn unit(&mut self) -> f32 {
        self.0 = self.0.wrapping_add(0x9e37_79b9);
        unit(mix(self.0))
    }

    /// Uniform in [low, high).
    pub fn range(&mut self, low: f32, high: f32) -> f32 {
        low + (high - low) * self.unit()
    }

    /// Uniform in [-1, 1).
    pub fn signed(&mut self) -> f32 {
        self.range(-1.0, 1.0)
    }
}

/// Smooth noise with features of about one unit, in [-1, 1] with mean 0 (gradient noise, quintic fade).
#[inline]
pub fn noise(p: Vec3, seed: u32) -> f32 {
    let (x, y, z) = (floor(p.x), floor(p.y), floor(p.z));
    let (fx, fy, fz) = (p.x - x as f32, p.y - y as f32, p.z - z as f32);
    let hx = (x as u32).wrapping_mul(PRIME_X);
    let hy = (y as u32).wrapping_mul(PRIME_Y);
    let hz = (z as u32).wrapping_mul(PRIME_Z);
    let (hx, hy, hz) = ([hx, hx.wrapping_add(PRIME_X)], [hy, hy.wrapping_add(PRIME_Y)], [hz, hz.wrapping_add(PRIME_Z)]);
    let salt = seed.wrapping_mul(PRIME_SEED);
    let (ux, uy, uz) = (quintic(fx), quintic(fy), quintic(fz));
    let mut planes = [0.0; 2];
    for (k, plane) in planes.iter_mut().enumerate() {
        let mut rows = [0.0; 2];
        for (j, row) in rows.iter_mut().enumerate() {
            let mut corners = [0.0; 2];
            for (i, corner) in corners.iter_mut().enumerate() {
                let h = mix((hx[i] ^ hy[j] ^ hz[k]).wrapping_add(salt));
                // Ten bits a component: directions need not be evenly spread, only without a preferred axis.
                let gradient = |shift: u32| ((h >> shift) & 1023) as f32 * (2.0 / 1023.0) - 1.0;
                *corner = gradient(0) * (fx - i as f32) + gradient(10) * (fy - j as f32) + gradient(20) * (fz - k as f32);
            }
            *row = lerp(corners[0], corners[1], ux);
        }
        *plane = lerp(rows[0], rows[1], uy);
    }
    1.3 * lerp(planes[0], planes[1], uz)
}

fn quintic(f: f32) -> f32 {
    f * f * f * (f * (f * 6.0 - 15.0) + 10.0)
}

/// Largest integer not above `x`; `f32::floor` is a call where the processor's baseline lacks the instruction.
#[inline]
fn floor(x: f32) -> i32 {
    let towards_zero = x as i32;
    towards_zero - i32::from((towards_zero as f32) > x)
}

/// Sum of `octaves` of [`noise`], each twice as fine and half as strong.
pub fn fractal(p: Vec3, octaves: u32, seed: u32) -> f32 {
    let (mut sum, mut strength, mut p) = (0.0, 1.0, p);
    for octave in 0..octaves {
        sum += strength * noise(p, seed.wrapping_add(octave * 7919));
        strength *= 0.5;
        p = p * 2.03 + Vec3::splat(17.3);
    }
    sum
}

/// Distances to the nearest two of the points strewn one per unit cell, and the nearest point's own hash.
pub struct Cell {
    /// Distance to the nearest point.
    pub first: f32,
    /// Distance to the second nearest.
    pub second: f32,
    /// Hash of the nearest point.
    pub id: u32,
}

/// Cellular noise (Worley 1996).
#[inline]
pub fn cells(p: Vec3, seed: u32) -> Cell {
    let (x, y, z) = (floor(p.x), floor(p.y), floor(p.z));
    let (fx, fy, fz) = (p.x - x as f32, p.y - y as f32, p.z - z as f32);
    let salt = seed.wrapping_mul(PRIME_SEED);
    let (mut first, mut second, mut id) = (f32::MAX, f32::MAX, 0);
    for dz in -1..=1 {
        let hz = ((z + dz) as u32).wrapping_mul(PRIME_Z);
        for dy in -1..=1 {
            let hyz = hz ^ ((y + dy) as u32).wrapping_mul(PRIME_Y);
            for dx in -1..=1 {
                let h = mix((hyz ^ ((x + dx) as u32).wrapping_mul(PRIME_X)).wrapping_add(salt));
                let jitter = |shift: u32| ((h >> shift) & 1023) as f32 * (1.0 / 1023.0);
                let (ax, ay, az) = (dx as f32 + jitter(0) - fx, dy as f32 + jitter(10) - fy, dz as f32 + jitter(20) - fz);
                let distance = ax * ax + ay * ay + az * az;
                if distance < first {
                    second = first;
                    first = distance;
                    id = h;
                } else if distance < second {
                    second = distance;
                }
            }
        }
    }
    Cell { first: first.sqrt(), second: second.sqrt(), id: mix(id) }
}

/// 0 below `low`, 1 above `high`, smooth between; falls where `low > high`.
#[inline]
pub fn smoothstep(low: f32, high: f32, x: f32) -> f32 {
    let t = ((x - low) / (high - low)).clamp(0.0, 1.0);
    t * t * (3.0 - 2.0 * t)
}

/// `a` at 0, `b` at 1.
#[inline]
pub fn lerp(a: f32, b: f32, t: f32) -> f32 {
    a + (b - a) * t
}

/// A bell of height 1 at 0; 0.37 at `x = width`.
pub fn bell(x: f32, width: f32) -> f32 {
    let t = x / width;
    libm::expf(-t * t)
}

#[inline]
fn mix(mut h: u32) -> u32 {
    h ^= h >> 16;
    h = h.wrapping_mul(0x7feb_352d);
    h ^= h >> 15;
    h = h.wrapping_mul(0x846c_a68b);
    h ^ (h >> 16)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn noise_is_the_same_everywhere() {
        // Frozen on purpose: another hash would be another face.
        let p = Vec3::new(1.25, -3.5, 7.75);
        let bits = [noise(p, 1).to_bits(), fractal(p, 4, 2).to_bits(), cells(p, 3).first.to_bits(), cells(p, 3).id];
        assert_eq!(bits, FROZEN);
    }

    const FROZEN: [u32; 4] = [1_055_990_305, 3_189_837_306, 1_054_093_285, 2_752_450_960];

    #[test]
    fn noise_has_no_bias_and_stays_in_range() {
        let (mut sum, mut most) = (0.0, 0.0f32);
        for i in 0..20_000 {
            let mut dice = Dice::new(i);
            let value = noise(Vec3::new(dice.signed(), dice.signed(), dice.signed()) * 50.0, 5);
            sum += f64::from(value);
            most = most.max(value.abs());
        }
        assert!((sum / 20_000.0).abs() < 0.01, "mean {}", sum / 20_000.0);
        assert!(most <= 1.0 && most > 0.5, "largest {most}");
    }

    #[test]
    fn nearest_cell_point_is_nearer_than_the_second() {
        for i in 0..1000 {
            let mut dice = Dice::new(i);
            let cell = cells(Vec3::new(dice.signed(), dice.signed(), dice.signed()) * 9.0, 4);
            assert!(cell.first <= cell.second && cell.first < 1.8);
        }
    }
}
