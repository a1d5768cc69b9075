//! Obstacles whose vertices move on their own, as a point cache or the frames of a sequence say.

use std::collections::HashMap;

use serde::{Deserialize, Serialize};

use crate::math::Vec3;

use super::Playback;

/// Positions of all vertices at some times; between them every vertex goes straight.
#[derive(Clone, Debug, PartialEq)]
pub struct Cache {
    /// When the samples are played.
    pub playback: Playback,
    /// Time of every sample within the clip, ascending, seconds.
    pub times_s: Vec<f64>,
    /// The rest positions, then those of every sample, in the coordinates of the scene; meters.
    pub frames: Vec<Vec<Vec3>>,
}

/// A [`Cache`] without its positions.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct CacheHeader {
    pub playback: Playback,
    pub times_s: Vec<f64>,
}

impl Cache {
    /// True if a vertex moves at any time.
    pub fn moving(&self) -> bool {
        let starts = if self.playback.lead_in_s > 0.0 { 0 } else { 1 };
        self.frames[starts..].windows(2).any(|pair| pair[0] != pair[1])
    }

    /// Its metadata.
    pub(super) fn header(&self) -> CacheHeader {
        CacheHeader { playback: self.playback, times_s: self.times_s.clone() }
    }

    /// The positions of all vertices at a time of the run, meters.
    pub fn positions_at(&self, time_s: f64) -> Vec<Vec3> {
        let values: Vec<&[f32]> = self.frames.iter().map(|frame| bytemuck::cast_slice(frame)).collect();
        let mut out = Vec::new();
        self.header().blend(|frame| values[frame], time_s, &mut out);
        bytemuck::cast_slice(&out).to_vec()
    }
}

impl CacheHeader {
    /// Number of frames, that of the rest positions included.
    pub(super) fn frames(&self) -> usize {
        1 + self.times_s.len()
    }

    /// Appends the positions at a time of the run. `values` = all frames, one after the other.
    pub(super) fn positions_at(&self, values: &[f32], time_s: f64, out: &mut Vec<f32>) {
        let length = values.len() / self.frames();
        self.blend(|frame| &values[frame * length..(frame + 1) * length], time_s, out);
    }

    fn blend<'a>(&self, frame: impl Fn(usize) -> &'a [f32], time_s: f64, out: &mut Vec<f32>) {
        let (clip_s, share) = self.playback.at(time_s);
        let (a, b, s) = if share < 1.0 {
            (0, 1, share)
        } else {
            let after = self.times_s.partition_point(|&time| time <= clip_s);
            match (after.checked_sub(1), self.times_s.get(after)) {
                (Some(before), Some(next)) => {
                    let from = self.times_s[before];
                    (after, after + 1, (clip_s - from) / (next - from))
                }
                // Before the first and after the last sample.
                _ => (after.max(1), after.max(1), 0.0),
            }
        };
        if s <= 0.0 {
            return out.extend_from_slice(frame(a));
        }
        let between = |(&a, &b): (&f32, &f32)| (f64::from(a) + s * (f64::from(b) - f64::from(a))) as f32;
        out.extend(frame(a).iter().zip(frame(b)).map(between));
    }

    /// For every vertex the first one that lies at the same place in all frames.
    pub(super) fn alike(&self, values: &[f32], vertices: usize) -> Vec<u32> {
        let mut known: HashMap<Vec<u32>, u32> = HashMap::with_capacity(vertices);
        let place = |vertex: u32| -> Vec<u32> {
            let frame = |frame: usize| &values[3 * (frame * vertices + vertex as usize)..][..3];
            // Adding 0 turns -0 into 0.
            (0..self.frames()).flat_map(|i| frame(i).iter().map(|x| (x + 0.0).to_bits())).collect()
        };
        (0..vertices as u32).map(|vertex| *known.entry(place(vertex)).or_insert(vertex)).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn straight_between_samples_at_any_times() {
        let playback = Playback { start_s: 1.0, rate: 1.0, repeats: false, lead_in_s: 0.5, length_s: 5.0 };
        let frames = [9.0, 1.0, 3.0, 7.0].map(|x| vec![Vec3::splat(x), Vec3::splat(2.0 * x)]).to_vec();
        let cache = Cache { playback, times_s: vec![1.0, 2.0, 5.0], frames };
        for (time_s, x) in [
            (0.0, 9.0),
            (1.25, 5.0),
            (1.5, 1.0),
            (2.5, 1.0),
            (3.0, 2.0),
            (3.5, 3.0),
            (5.0, 5.0),
            (6.5, 7.0),
            (99.0, 7.0),
        ] {
            assert_eq!(cache.positions_at(time_s), [Vec3::splat(x), Vec3::splat(2.0 * x)], "at {time_s} s");
        }
        assert!(cache.moving());
        let still = Cache { frames: vec![vec![Vec3::ONE]; 4], ..cache.clone() };
        assert!(!still.moving());
        let values: Vec<f32> = cache.frames.iter().flatten().flat_map(|p| p.to_array()).collect();
        assert_eq!(cache.header().alike(&values, 2), [0, 1]);
        let doubled = [0.0, 0.0, 0.0, -0.0, 0.0, 0.0];
        let header = CacheHeader { times_s: vec![], ..cache.header() };
        assert_eq!(header.alike(&doubled, 2), [0, 0]);
    }
}
