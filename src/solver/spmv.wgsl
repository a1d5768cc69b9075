// Sparse matrix-vector product of slices of a sliced block-ELL matrix: one invocation per row. Neighboring lanes read
// neighboring words. Each row adds its blocks in stored order, so its lane does not change its bits. In difference form
// a block off the diagonal multiplies x_j - x_i.

struct SpmvParams {
    first_slice: u32,
    // Lanes to multiply: 16 per slice.
    lanes: u32,
    // First slot of the columns and values that are bound.
    first_slot: u32,
    // 1: add to y.
    accumulate: u32,
    // 1: difference form.
    difference: u32,
    // Position of row 0 in own_x.
    own_start: u32,
    // Column of the diagonal block of row 0.
    diagonal: u32,
    padding: u32,
}

const LANES: u32 = 16u;
const BLOCK: u32 = 9u;
const NO_ROW: u32 = 0xffffffffu;

@group(0) @binding(0) var<storage, read> row_of_lane: array<u32>;
@group(0) @binding(1) var<storage, read> slice_offsets: array<u32>;
@group(0) @binding(2) var<storage, read> columns: array<u32>;
@group(0) @binding(3) var<storage, read> values: array<f32>;
@group(0) @binding(4) var<storage, read> x: array<Packed3>;
@group(0) @binding(5) var<storage, read> own_x: array<Packed3>;
@group(0) @binding(6) var<storage, read_write> y: array<Packed3>;
@group(0) @binding(7) var<uniform> params: SpmvParams;

@compute @workgroup_size(WORKGROUP)
fn spmv(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let i = global_index(id, groups);
    if (i >= params.lanes) {
        return;
    }
    let slice = params.first_slice + i / LANES;
    let lane = i % LANES;
    let row = row_of_lane[slice * LANES + lane];
    if (row == NO_ROW) {
        return;
    }
    var sum = vec3<f32>(0.0);
    if (params.accumulate != 0u) {
        sum = unpacked(y[row]);
    }
    var own = vec3<f32>(0.0);
    if (params.difference != 0u) {
        own = unpacked(own_x[params.own_start + row]);
    }
    let end = slice_offsets[slice + 1u] - params.first_slot;
    for (var slot = slice_offsets[slice] - params.first_slot; slot < end; slot++) {
        let column = columns[slot * LANES + lane];
        let v = unpacked(x[column]) - select(own, vec3<f32>(0.0), column == params.diagonal + row);
        let at = slot * BLOCK * LANES + lane;
        sum.x += values[at] * v.x;
        sum.x += values[at + LANES] * v.y;
        sum.x += values[at + 2u * LANES] * v.z;
        sum.y += values[at + 3u * LANES] * v.x;
        sum.y += values[at + 4u * LANES] * v.y;
        sum.y += values[at + 5u * LANES] * v.z;
        sum.z += values[at + 6u * LANES] * v.x;
        sum.z += values[at + 7u * LANES] * v.y;
        sum.z += values[at + 8u * LANES] * v.z;
    }
    y[row] = packed(sum);
}
