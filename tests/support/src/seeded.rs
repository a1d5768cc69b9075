//! Numbers for seeded tests, the same for the same seed on every machine: SplitMix64 [Steele et al. 2014]. Not for
//! cryptography, and not equidistributed in more than one dimension.

use loomtree::math::Vec3;

/// A sequence that its seed determines.
pub struct Seeded(u64);

impl Seeded {
    /// Starts the sequence of `seed`.
    pub fn new(seed: u64) -> Seeded {
        Seeded(seed)
    }

    /// The next 64 bits.
    pub fn bits64(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    /// The upper half of the next 64 bits.
    pub fn bits(&mut self) -> u32 {
        (self.bits64() >> 32) as u32
    }

    /// A number in `0..limit`.
    pub fn below(&mut self, limit: u32) -> u32 {
        ((u64::from(self.bits()) * u64::from(limit)) >> 32) as u32
    }

    /// A number in `low..high`.
    pub fn uniform(&mut self, low: f32, high: f32) -> f32 {
        low + (high - low) * (self.bits() >> 8) as f32 / (1u32 << 24) as f32
    }

    /// A number in `-1..1`, a multiple of 2^-23.
    pub fn signed(&mut self) -> f32 {
        self.uniform(-1.0, 1.0)
    }

    /// Three numbers in `-1..1`.
    pub fn vector(&mut self) -> Vec3 {
        Vec3::new(self.signed(), self.signed(), self.signed())
    }
}
