// Sweeps of the Schwarz preconditioner in the order of colors. colored_cpu.rs has the formulas, colored.rs the tables.
// One workgroup works on one chunk of rows (in `entry_sums`: on one sum). Rows of one color are not coupled, so they
// are updated at once. No result depends on the number of chunks of a rank.
// needs chunk.wgsl

struct ColoredParams {
    rows: u32,
    chunk_rows: u32,
    // Own rows begin here in u.
    u_first: u32,
    // Largest number of colors of a chunk; chunks with fewer colors have empty ranges at the end.
    colors: u32,
    relaxation: f32,
    // First chunk, sum and block of this dispatch, and the number of each.
    first_chunk: u32,
    chunks: u32,
    first_entry: u32,
    entries: u32,
    first_block: u32,
    blocks: u32,
    // Slots of the matrix that are bound.
    first_slot: u32,
    slots: u32,
    // 1: the matrix is in difference form.
    difference: u32,
}

const LANES: u32 = 16u;
const BLOCK: u32 = 9u;
// Sums of a chunk: r.u, r.r, w.u, w.
const SUMS: u32 = 6u;

@group(0) @binding(0) var<storage, read> values: array<f32>;
@group(0) @binding(1) var<storage, read> sources: array<u32>;
@group(0) @binding(2) var<storage, read_write> blocks: array<f32>;
@group(0) @binding(3) var<storage, read> blocks_read: array<f32>;
@group(0) @binding(4) var<storage, read> block_rows: array<u32>;
@group(0) @binding(5) var<storage, read> block_columns: array<u32>;
@group(0) @binding(6) var<storage, read> entry_ends: array<vec2<u32>>;
@group(0) @binding(7) var<storage, read> flags: array<Packed3>;
@group(0) @binding(8) var<storage, read_write> entries: array<f32>;
@group(0) @binding(9) var<storage, read> color_starts: array<u32>;
@group(0) @binding(10) var<storage, read> order: array<u32>;
// Blocks inside the chunk of a row: the first one (the diagonal), the first one of a higher color, the end.
@group(0) @binding(11) var<storage, read> spans: array<Packed3u>;
@group(0) @binding(12) var<storage, read> inverse_diagonal: array<f32>;
@group(0) @binding(13) var<storage, read> correction: array<Packed3>;
@group(0) @binding(14) var<storage, read> r: array<Packed3>;
@group(0) @binding(15) var<storage, read_write> u: array<Packed3>;
@group(0) @binding(16) var<storage, read_write> w: array<Packed3>;
@group(0) @binding(17) var<storage, read> u_read: array<Packed3>;
@group(0) @binding(18) var<storage, read_write> sums: array<f32>;
@group(0) @binding(19) var<uniform> params: ColoredParams;

struct Packed3u {
    x: u32,
    y: u32,
    z: u32,
}

// Copies the blocks of the matrix whose slots are bound.
@compute @workgroup_size(WORKGROUP)
fn take(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let k = global_index(id, groups);
    if (k >= params.blocks) {
        return;
    }
    let source = sources[k];
    // Slots below the first one wrap around and exceed the last one, as does the source of padding.
    let slot = source / LANES - params.first_slot;
    if (slot >= params.slots) {
        return;
    }
    let lane = source % LANES;
    for (var c = 0u; c < BLOCK; c++) {
        blocks[k * BLOCK + c] = values[(slot * BLOCK + c) * LANES + lane];
    }
}

// Two sums of the blocks of rows that are not pinned, nine values each; one workgroup per pair of sums. The first one is
// over columns that are not pinned; in difference form, without the blocks off the diagonal inside the chunk, which
// cancel each other. The second one is over pinned columns.
@compute @workgroup_size(CHUNK_THREADS)
fn entry_sums(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let at = group_index(group, groups);
    var free = array<vec4<f32>, 3>();
    var pinned = array<vec4<f32>, 3>();
    if (at < params.entries) {
        let range = entry_ends[params.first_entry + at];
        for (var k = range.x + local; k < range.y; k += CHUNK_THREADS) {
            let block = k - params.first_block;
            let row = block_rows[block];
            if (flags[params.u_first + row].x == 0.0) {
                continue;
            }
            let v = block * BLOCK;
            let first = vec4<f32>(blocks_read[v], blocks_read[v + 1u], blocks_read[v + 2u], blocks_read[v + 3u]);
            let second = vec4<f32>(blocks_read[v + 4u], blocks_read[v + 5u], blocks_read[v + 6u], blocks_read[v + 7u]);
            let last = vec4<f32>(blocks_read[v + 8u], 0.0, 0.0, 0.0);
            // Columns before the own rows wrap around.
            let column = block_columns[block] - params.u_first;
            let inside = column < params.rows && column / params.chunk_rows == row / params.chunk_rows;
            if (flags[block_columns[block]].x == 0.0) {
                pinned[0] += first;
                pinned[1] += second;
                pinned[2] += last;
            } else if (params.difference == 0u || !inside || column == row) {
                free[0] += first;
                free[1] += second;
                free[2] += last;
            }
        }
    }
    for (var part = 0u; part < 3u; part++) {
        free[part] = chunk_sum(local, free[part]);
        pinned[part] = chunk_sum(local, pinned[part]);
    }
    if (local == 0u && at < params.entries) {
        let to = (params.first_entry + at) * 2u * BLOCK;
        for (var c = 0u; c < BLOCK; c++) {
            entries[to + c] = free[c / 4u][c % 4u];
            entries[to + BLOCK + c] = pinned[c / 4u][c % 4u];
        }
    }
}

// Sum of block * u over the blocks `first..end` of a row.
fn row_product(first: u32, end: u32) -> vec3<f32> {
    var sum = vec3<f32>(0.0);
    for (var k = first; k < end; k++) {
        let block = k - params.first_block;
        let x = unpacked(u[block_columns[block]]);
        let v = block * BLOCK;
        sum += vec3<f32>(
            blocks_read[v] * x.x + blocks_read[v + 1u] * x.y + blocks_read[v + 2u] * x.z,
            blocks_read[v + 3u] * x.x + blocks_read[v + 4u] * x.y + blocks_read[v + 5u] * x.z,
            blocks_read[v + 6u] * x.x + blocks_read[v + 7u] * x.y + blocks_read[v + 8u] * x.z,
        );
    }
    return sum;
}

// relaxation * inverse_diagonal * v for one row.
fn relaxed(row: u32, v: vec3<f32>) -> vec3<f32> {
    let at = row * 6u;
    let first = vec3<f32>(inverse_diagonal[at], inverse_diagonal[at + 1u], inverse_diagonal[at + 2u]);
    let rest = vec3<f32>(inverse_diagonal[at + 3u], inverse_diagonal[at + 4u], inverse_diagonal[at + 5u]);
    return params.relaxation * symmetric_times(first, rest, v);
}

@compute @workgroup_size(CHUNK_THREADS)
fn sweep(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    // Workgroups beyond the last chunk find empty ranges only.
    let chunk = params.first_chunk + min(group_index(group, groups), params.chunks);
    let idle = chunk >= params.first_chunk + params.chunks;
    let colors = chunk * (params.colors + 1u);
    for (var color = 0u; color < params.colors; color++) {
        if (!idle) {
            for (var i = color_starts[colors + color] + local; i < color_starts[colors + color + 1u]; i += CHUNK_THREADS) {
                let row = order[i];
                let span = spans[i];
                let rest = unpacked(r[row]) - row_product(span.x + 1u, span.y);
                u[params.u_first + row] = packed(relaxed(row, rest));
            }
        }
        storageBarrier();
    }
    for (var turn = 1u; turn < params.colors; turn++) {
        let color = params.colors - 1u - turn;
        if (!idle) {
            for (var i = color_starts[colors + color] + local; i < color_starts[colors + color + 1u]; i += CHUNK_THREADS) {
                let row = order[i];
                let span = spans[i];
                let v = unpacked(u[params.u_first + row]) - relaxed(row, row_product(span.y, span.z));
                u[params.u_first + row] = packed(v);
            }
        }
        storageBarrier();
    }
    var own = vec4<f32>(0.0);
    if (!idle) {
        let rows = chunk_range(chunk, params.chunk_rows, params.rows);
        for (var row = rows.x + local; row < rows.y; row += CHUNK_THREADS) {
            let residual = unpacked(r[row]);
            var z = unpacked(u[params.u_first + row]);
            if (inverse_diagonal[row * 6u] != 0.0) {
                z += unpacked(correction[chunk]);
            }
            u[params.u_first + row] = packed(z);
            own += vec4<f32>(dot(residual, z), dot(residual, residual), 0.0, 0.0);
        }
    }
    let sum = chunk_sum(local, own);
    if (local == 0u && !idle) {
        sums[chunk * SUMS] = sum.x;
        sums[chunk * SUMS + 1u] = sum.y;
    }
}

@compute @workgroup_size(CHUNK_THREADS)
fn product_sums(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let chunk = group_index(group, groups);
    let rows = chunk_range(chunk, params.chunk_rows, params.rows);
    var own = vec4<f32>(0.0);
    for (var row = rows.x + local; row < rows.y; row += CHUNK_THREADS) {
        var product = unpacked(w[row]);
        if (inverse_diagonal[row * 6u] == 0.0) {
            product = vec3<f32>(0.0);
            w[row] = packed(product);
        }
        own += vec4<f32>(dot(product, unpacked(u_read[params.u_first + row])), product);
    }
    let sum = chunk_sum(local, own);
    if (local == 0u && rows.x < rows.y) {
        sums[chunk * SUMS + 2u] = sum.x;
        sums[chunk * SUMS + 3u] = sum.y;
        sums[chunk * SUMS + 4u] = sum.z;
        sums[chunk * SUMS + 5u] = sum.w;
    }
}
