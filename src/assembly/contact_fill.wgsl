// What contacts add to the touched rows; contact_fill.rs says where it goes. Record of a contact (forces/contact.rs):
// weights[4]; normal, alpha; beta, g. Its block of corners (a, b): w_a w_b (alpha n n' + beta (I - n n')).

struct ContactFillParams {
    // Touched rows.
    rows: u32,
    // Records that are bound.
    first_record: u32,
    records: u32,
    // 1: nothing was added yet.
    first_pass: u32,
    // Lanes of this dispatch, and the slots of the Value Table that are bound.
    first_lane: u32,
    lanes: u32,
    first_slot: u32,
    // First block of a lane that this dispatch fills, and turns of SHARE blocks.
    first_block: u32,
    block_turns: u32,
    padding0: u32,
    padding1: u32,
    padding2: u32,
}

const LANES: u32 = 16u;
const BLOCK: u32 = 9u;
// Invocations per lane.
const SHARE: u32 = 4u;
// Values per touched row: symmetric diagonal block, right-hand side.
const SUMS: u32 = 9u;
const NO_CORNER: u32 = 4u;

@group(0) @binding(0) var<storage, read> offsets: array<u32>;
@group(0) @binding(1) var<storage, read> entries: array<u32>;
@group(0) @binding(2) var<storage, read> positions: array<vec2<u32>>;
@group(0) @binding(3) var<storage, read> records: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read_write> sums: array<f32>;
@group(0) @binding(5) var<storage, read> lanes: array<vec4<u32>>;
@group(0) @binding(6) var<storage, read> slice_offsets: array<u32>;
@group(0) @binding(7) var<storage, read_write> values: array<f32>;
@group(0) @binding(8) var<uniform> params: ContactFillParams;

@compute @workgroup_size(WORKGROUP)
fn contact_sums(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let row = global_index(id, groups);
    if (row >= params.rows) {
        return;
    }
    var sum = array<f32, SUMS>();
    if (params.first_pass == 0u) {
        for (var c = 0u; c < SUMS; c++) {
            sum[c] = sums[row * SUMS + c];
        }
    }
    for (var i = offsets[row]; i < offsets[row + 1u]; i++) {
        let e = (entries[i] >> 2u) - params.first_record;
        if (e >= params.records) {
            continue;
        }
        let w = records[e * 3u][entries[i] & 3u];
        let n = records[e * 3u + 1u];
        let g = records[e * 3u + 2u];
        let s = w * w;
        let p = n.xyz * (s * (n.w - g.x));
        let identity = s * g.x;
        sum[0] += p.x * n.x + identity;
        sum[1] += p.x * n.y;
        sum[2] += p.x * n.z;
        sum[3] += p.y * n.y + identity;
        sum[4] += p.y * n.z;
        sum[5] += p.z * n.z + identity;
        sum[6] += w * g.y;
        sum[7] += w * g.z;
        sum[8] += w * g.w;
    }
    for (var c = 0u; c < SUMS; c++) {
        sums[row * SUMS + c] = sum[c];
    }
}

// Corner whose position is k, or NO_CORNER.
fn corner_at(words: vec2<u32>, k: u32) -> u32 {
    let found = vec4<u32>(words.x & 0xffffu, words.x >> 16u, words.y & 0xffffu, words.y >> 16u) == vec4<u32>(k);
    let late = select(select(NO_CORNER, 3u, found.w), 2u, found.z);
    return select(select(late, 1u, found.y), 0u, found.x);
}

@compute @workgroup_size(WORKGROUP)
fn contact_blocks(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let index = global_index(id, groups);
    if (index / SHARE >= params.lanes) {
        return;
    }
    let i = params.first_lane + index / SHARE;
    let start = slice_offsets[i / LANES];
    let width = slice_offsets[i / LANES + 1u] - start;
    let lane = lanes[i];
    var k = params.first_block + index % SHARE;
    for (var turn = 0u; turn < params.block_turns; turn++) {
        if (k >= width) {
            return;
        }
        let at = (start + k - params.first_slot) * BLOCK * LANES + i % LANES;
        var block = array<f32, BLOCK>();
        if (k < lane.w) {
            if (params.first_pass == 0u) {
                for (var c = 0u; c < BLOCK; c++) {
                    block[c] = values[at + c * LANES];
                }
            }
            for (var j = offsets[lane.x]; j < offsets[lane.x + 1u]; j++) {
                let corner = corner_at(positions[j], lane.z + k);
                let e = (entries[j] >> 2u) - params.first_record;
                if (corner == NO_CORNER || e >= params.records) {
                    continue;
                }
                let s = records[e * 3u][entries[j] & 3u] * records[e * 3u][corner];
                let n = records[e * 3u + 1u];
                let beta = records[e * 3u + 2u].x;
                let p = n.xyz * (s * (n.w - beta));
                for (var c = 0u; c < BLOCK; c++) {
                    block[c] += p[min(c / 3u, c % 3u)] * n[max(c / 3u, c % 3u)];
                }
                block[0] += s * beta;
                block[4] += s * beta;
                block[8] += s * beta;
            }
        }
        for (var c = 0u; c < BLOCK; c++) {
            values[at + c * LANES] = block[c];
        }
        k += SHARE;
    }
}
