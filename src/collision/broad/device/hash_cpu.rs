//! Native twin of `hash.wgsl`: plain loops; entries come out in order of their triangles.

use glam::{UVec3, Vec3A};

use super::hash::HashParams;
use super::levels::{LEVELS, REACH, coarser, home_of};
use crate::collision::broad::boxes::Aabb;

/// Box of the path of a vertex.
pub(super) fn path_box(x_t0: &[f32], x_t1: &[f32], v: u32) -> Aabb {
    let (start, end) = (Vec3A::from_slice(&x_t0[3 * v as usize..]), Vec3A::from_slice(&x_t1[3 * v as usize..]));
    Aabb { lo: start.min(end), hi: start.max(end) }
}

fn cell_of(params: &HashParams, x: Vec3A) -> UVec3 {
    let [a, b, c, per_m] = params.origin;
    let scaled = ((x - Vec3A::new(a, b, c)) * per_m).clamp(Vec3A::splat(-REACH), Vec3A::splat(REACH - 1.0));
    UVec3::from_array(scaled.floor().to_array().map(|cell| (cell as i32 + REACH as i32) as u32))
}

fn packed_cell(cell: UVec3) -> [u32; 2] {
    [cell.x | (cell.z & 0x3ff) << 21, cell.y | (cell.z >> 10) << 21]
}

fn unpacked_cell([a, b]: [u32; 2]) -> UVec3 {
    UVec3::new(a & 0x1f_ffff, b & 0x1f_ffff, a >> 21 | (b >> 21) << 10)
}

/// None in a layer that is not counted.
fn bucket_of(params: &HashParams, layers: &[[u32; 2]], cell: UVec3, level: usize) -> Option<usize> {
    let lowest_block = (cell[params.axis as usize] << (2 * level as u32)) >> 1;
    let layer = lowest_block.saturating_sub(params.first_block).min(params.last_layer);
    let [base, bits] = *layers.get(layer.checked_sub(params.first_layer)? as usize)?;
    let block = cell >> 1u32;
    let mut hash = block.x.wrapping_mul(0x9E37_79B1)
        ^ block.y.wrapping_mul(0x85EB_CA77)
        ^ block.z.wrapping_mul(0xC2B2_AE3D)
        ^ (level as u32).wrapping_mul(0x27D4_EB2F);
    hash = (hash ^ (hash >> 15)).wrapping_mul(0x2C1B_3C6D);
    let fine_bits = bits & 0xff;
    let (bits, base) = if level == 0 { (fine_bits, base) } else { (bits >> 8, base + (8 << fine_bits)) };
    let place = (cell.x & 1) | (cell.y & 1) << 1 | (cell.z & 1) << 2;
    Some((base + ((hash >> 1) >> (31 - bits)) * 8 + place) as usize)
}

fn offset_of(k: u32) -> UVec3 {
    UVec3::new(k & 1, k >> 1 & 1, k >> 2)
}

fn tag_of(cell: UVec3, offset: UVec3, level: usize) -> u32 {
    let (second, lowest) = ((cell >> 1u32) & UVec3::ONE, UVec3::ONE - offset);
    lowest.x | lowest.y << 1 | lowest.z << 2 | second.x << 3 | second.y << 4 | second.z << 5 | (level as u32) << 6
}

/// Calls `visit(bucket, tag)` for each cell of a triangle in a grid that is in a layer that is counted.
fn for_each_cell(
    params: &HashParams,
    layers: &[[u32; 2]],
    (lo, hi): (UVec3, UVec3),
    level: usize,
    mut visit: impl FnMut(usize, u32),
) {
    let first = coarser(lo, level);
    let extent = coarser(hi, level) - first;
    for offset in (0..8).map(offset_of).filter(|offset| offset.cmple(extent).all()) {
        let cell = first + offset;
        if let Some(bucket) = bucket_of(params, layers, cell, level) {
            visit(bucket, tag_of(cell, offset, level));
        }
    }
}

fn may_visit(levels: &[[u32; 8]], level: usize, lo: UVec3, hi: UVec3) -> bool {
    let [a, b, c, d, e, f, may_have_residents, _] = levels[level];
    may_have_residents != 0 && lo.cmple(UVec3::new(d, e, f)).all() && UVec3::new(a, b, c).cmple(hi).all()
}

fn has_partner(counts: &[[u32; 4]], bucket: usize, role: usize) -> bool {
    counts[bucket][0] > 0 || (role == 0 && counts[bucket][1] > 0)
}

fn bits([a, b, c]: [f32; 3], w: u32) -> [u32; 4] {
    [a.to_bits(), b.to_bits(), c.to_bits(), w]
}

/// Box, cells and home of every triangle; residents per bucket.
#[expect(clippy::too_many_arguments, reason = "buffers in the order of the shader's bindings")]
pub(super) fn count_residents(
    params: &HashParams,
    x_t0: &[f32],
    x_t1: &[f32],
    faces: &[[u32; 4]],
    boxes: &mut [[u32; 4]],
    cells: &mut [[u32; 4]],
    counts: &mut [[u32; 4]],
    layers: &[[u32; 2]],
) {
    let vector = |[a, b, c, _]: [f32; 4]| Vec3A::new(a, b, c);
    let cloth = Aabb { lo: vector(params.cloth_lo), hi: vector(params.cloth_hi) };
    for (t, &[a, b, c, owned]) in faces[..params.triangles as usize].iter().enumerate() {
        let path = [a, b, c].map(|v| path_box(x_t0, x_t1, v));
        let mut own = path[0].join(path[1]).join(path[2]).inflated(Vec3A::splat(params.cloth_lo[3]));
        let role = usize::from(t >= params.cloth_triangles as usize);
        if role == 1 {
            if !own.overlaps(&cloth) {
                (boxes[2 * t], boxes[2 * t + 1], cells[t]) = ([0; 4], [0; 4], [0; 4]);
                continue;
            }
            own = own.clip(&cloth);
        }
        let (lo, hi) = (cell_of(params, own.lo), cell_of(params, own.hi));
        let level = home_of(lo, hi);
        boxes[2 * t] = bits(own.lo.to_array(), owned);
        boxes[2 * t + 1] = bits(own.hi.to_array(), level as u32 + 1);
        let ([a, b], [c, d]) = (packed_cell(lo), packed_cell(hi));
        cells[t] = [a, b, c, d];
        for_each_cell(params, layers, (lo, hi), level, |bucket, _| counts[bucket][role] += 1);
    }
}

/// Calls `visit(level, cells, role)` for the home of a triangle and the grids that it visits.
fn for_each_level(
    params: &HashParams,
    boxes: &[[u32; 4]],
    cells: &[[u32; 4]],
    levels: &[[u32; 8]],
    t: usize,
    mut visit: impl FnMut(usize, (UVec3, UVec3), usize),
) {
    let home = boxes[2 * t + 1][3] as usize;
    if home == 0 {
        return;
    }
    let [a, b, c, d] = cells[t];
    let (lo, hi) = (unpacked_cell([a, b]), unpacked_cell([c, d]));
    let role = usize::from(t >= params.cloth_triangles as usize);
    for level in home - 1..LEVELS {
        if level == home - 1 || may_visit(levels, level, lo, hi) {
            visit(level, (lo, hi), role);
        }
    }
}

/// Visitors per bucket of the coarser grids.
pub(super) fn count_visitors(
    params: &HashParams,
    boxes: &[[u32; 4]],
    cells: &[[u32; 4]],
    counts: &mut [[u32; 4]],
    layers: &[[u32; 2]],
    levels: &[[u32; 8]],
) {
    for t in 0..params.triangles as usize {
        let home = boxes[2 * t + 1][3] as usize;
        for_each_level(params, boxes, cells, levels, t, |level, cells, role| {
            if level >= home {
                for_each_cell(params, layers, cells, level, |bucket, _| {
                    if has_partner(counts, bucket, role) {
                        counts[bucket][2 + role] += 1;
                    }
                });
            }
        });
    }
}

fn tests_of(load: [u32; 4]) -> u64 {
    let [cloth, obstacles, visiting_cloth, visiting_obstacles] = load.map(u64::from);
    let own = cloth * cloth.saturating_sub(1) / 2;
    own + cloth * (obstacles + visiting_cloth + visiting_obstacles) + obstacles * visiting_cloth
}

fn size_of(load: [u32; 4]) -> u32 {
    load.iter().sum()
}

/// Tests (two words), entries and busy buckets of every chunk.
pub(super) fn chunk_loads(params: &HashParams, counts: &[[u32; 4]], spans: &[[u32; 2]], chunks: &mut [[u32; 4]]) {
    for (chunk, &[start, end]) in chunks.iter_mut().zip(&spans[..params.chunks as usize]) {
        let loads = &counts[start as usize..end as usize];
        let busy = || loads.iter().filter(|load| tests_of(**load) > 0);
        let tests: u64 = busy().map(|load| tests_of(*load)).sum();
        let size = busy().map(|load| size_of(*load)).sum();
        *chunk = [tests as u32, (tests >> 32) as u32, size, busy().count() as u32];
    }
}

/// Tests and entries of every bucket of a batch.
pub(super) fn bucket_loads(params: &HashParams, counts: &[[u32; 4]], tests: &mut [u32], sizes: &mut [u32]) {
    for (i, load) in counts[params.first_bucket as usize..][..params.buckets as usize].iter().enumerate() {
        tests[i] = tests_of(*load) as u32;
        sizes[i] = if tests[i] == 0 { 0 } else { size_of(*load) };
    }
}

/// The entries of a batch.
#[expect(clippy::too_many_arguments, reason = "buffers in the order of the shader's bindings")]
pub(super) fn fill(
    params: &HashParams,
    boxes: &[[u32; 4]],
    cells: &[[u32; 4]],
    counts: &[[u32; 4]],
    layers: &[[u32; 2]],
    levels: &[[u32; 8]],
    starts: &[u32],
    cursors: &mut [[u32; 4]],
    entries: &mut [[u32; 2]],
) {
    let mut put = |bucket: usize, class: usize, entry: [u32; 2]| {
        let i = bucket.wrapping_sub(params.first_bucket as usize);
        if i >= params.buckets as usize || starts[i] == starts[i + 1] {
            return;
        }
        let lower: u32 = counts[bucket][..class].iter().sum();
        entries[(starts[i] + lower + cursors[i][class]) as usize] = entry;
        cursors[i][class] += 1;
    };
    for t in 0..params.triangles as usize {
        let home = boxes[2 * t + 1][3] as usize;
        for_each_level(params, boxes, cells, levels, t, |level, cells, role| {
            for_each_cell(params, layers, cells, level, |bucket, tag| {
                if level < home {
                    put(bucket, role, [t as u32, tag]);
                } else if has_partner(counts, bucket, role) {
                    put(bucket, 2 + role, [t as u32, tag]);
                }
            });
        });
    }
}
