// The vector work of a PCG iteration; vector_cpu.rs has the formulas. One workgroup per chunk of rows, so that a
// chunk's sums do not depend on the number of chunks of the rank. Each invocation sums its rows, then the workgroup
// adds in a fixed order.
// needs chunk.wgsl

struct VectorParams {
    rows: u32,
    chunk_rows: u32,
    // Own rows begin here in u.
    u_first: u32,
    alpha: f32,
    beta: f32,
}

// Sums of a chunk: r.u, r.r, w.u.
const SUMS: u32 = 3u;

@group(0) @binding(0) var<storage, read> b: array<Packed3>;
@group(0) @binding(1) var<storage, read> w: array<Packed3>;
@group(0) @binding(2) var<storage, read> inverse_diagonal: array<f32>;
@group(0) @binding(3) var<storage, read_write> u: array<Packed3>;
@group(0) @binding(4) var<storage, read_write> p: array<Packed3>;
@group(0) @binding(5) var<storage, read_write> s: array<Packed3>;
@group(0) @binding(6) var<storage, read_write> x: array<Packed3>;
@group(0) @binding(7) var<storage, read_write> r: array<Packed3>;
@group(0) @binding(8) var<storage, read> u_read: array<Packed3>;
@group(0) @binding(9) var<storage, read_write> sums: array<f32>;
@group(0) @binding(10) var<uniform> params: VectorParams;

// inverse_diagonal * r for one row. Sets r to 0 on a pinned row, which has a zero inverse.
fn precondition(row: u32, residual: ptr<function, vec3<f32>>) -> vec3<f32> {
    let at = row * 6u;
    let first = vec3<f32>(inverse_diagonal[at], inverse_diagonal[at + 1u], inverse_diagonal[at + 2u]);
    let rest = vec3<f32>(inverse_diagonal[at + 3u], inverse_diagonal[at + 4u], inverse_diagonal[at + 5u]);
    if (first.x == 0.0) {
        *residual = vec3<f32>(0.0);
    }
    return symmetric_times(first, rest, *residual);
}

@compute @workgroup_size(CHUNK_THREADS)
fn start(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let chunk = group_index(group, groups);
    let rows = chunk_range(chunk, params.chunk_rows, params.rows);
    var own = vec4<f32>(0.0);
    for (var row = rows.x + local; row < rows.y; row += CHUNK_THREADS) {
        var residual = unpacked(b[row]) - unpacked(w[row]);
        let z = precondition(row, &residual);
        r[row] = packed(residual);
        u[params.u_first + row] = packed(z);
        own += vec4<f32>(dot(residual, z), dot(residual, residual), 0.0, 0.0);
    }
    let sum = chunk_sum(local, own);
    if (local == 0u && rows.x < rows.y) {
        sums[chunk * SUMS] = sum.x;
        sums[chunk * SUMS + 1u] = sum.y;
    }
}

@compute @workgroup_size(CHUNK_THREADS)
fn dot_product(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let chunk = group_index(group, groups);
    let rows = chunk_range(chunk, params.chunk_rows, params.rows);
    var own = vec4<f32>(0.0);
    for (var row = rows.x + local; row < rows.y; row += CHUNK_THREADS) {
        own.x += dot(unpacked(w[row]), unpacked(u_read[params.u_first + row]));
    }
    let sum = chunk_sum(local, own);
    if (local == 0u && rows.x < rows.y) {
        sums[chunk * SUMS + 2u] = sum.x;
    }
}

@compute @workgroup_size(CHUNK_THREADS)
fn update(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let chunk = group_index(group, groups);
    let rows = chunk_range(chunk, params.chunk_rows, params.rows);
    var own = vec4<f32>(0.0);
    for (var row = rows.x + local; row < rows.y; row += CHUNK_THREADS) {
        let direction = unpacked(u[params.u_first + row]) + params.beta * unpacked(p[row]);
        let image = unpacked(w[row]) + params.beta * unpacked(s[row]);
        p[row] = packed(direction);
        s[row] = packed(image);
        x[row] = packed(unpacked(x[row]) + params.alpha * direction);
        var residual = unpacked(r[row]) - params.alpha * image;
        let z = precondition(row, &residual);
        r[row] = packed(residual);
        u[params.u_first + row] = packed(z);
        own += vec4<f32>(dot(residual, z), dot(residual, residual), 0.0, 0.0);
    }
    let sum = chunk_sum(local, own);
    if (local == 0u && rows.x < rows.y) {
        sums[chunk * SUMS] = sum.x;
        sums[chunk * SUMS + 1u] = sum.y;
    }
}
