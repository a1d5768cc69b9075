// Triangle hash table on the device; hash.rs says how the passes fit together and what the arrays hold.
// needs boxes.wgsl

struct HashParams {
    // Origin of the cells, then cells per meter.
    origin: vec4<f32>,
    // Bounds of the cloth, then how far boxes are inflated.
    cloth_lo: vec4<f32>,
    cloth_hi: vec4<f32>,
    triangles: u32,
    cloth_triangles: u32,
    // Axis that layers lie along, block of cells of the first layer, number of the last one.
    axis: u32,
    first_block: u32,
    last_layer: u32,
    // Layers that are counted, and chunks of their buckets.
    first_layer: u32,
    layers: u32,
    chunks: u32,
    // Buckets that this dispatch is about, counted from the first of these layers.
    first_bucket: u32,
    buckets: u32,
    padding0: u32,
    padding1: u32,
}

const REACH: f32 = 1048576.0;
const LEVELS: u32 = 11u;
// Values per grid: lowest cell and highest cell that may hold a resident, 1 if there may be some, nothing.
const LEVEL: u32 = 8u;
// Bucket of a cell in a layer that is not counted.
const NOWHERE: u32 = 0xffffffffu;

@group(0) @binding(0) var<storage, read> x_t0: array<Packed3>;
@group(0) @binding(1) var<storage, read> x_t1: array<Packed3>;
@group(0) @binding(2) var<storage, read> faces: array<vec4<u32>>;
@group(0) @binding(3) var<storage, read_write> boxes: array<vec4<u32>>;
@group(0) @binding(4) var<storage, read_write> cells: array<vec4<u32>>;
@group(0) @binding(5) var<storage, read_write> counts: array<atomic<u32>>;
@group(0) @binding(6) var<storage, read> layers: array<vec2<u32>>;
@group(0) @binding(7) var<storage, read> levels: array<u32>;
@group(0) @binding(8) var<storage, read> spans: array<vec2<u32>>;
@group(0) @binding(9) var<storage, read_write> chunks: array<vec4<u32>>;
@group(0) @binding(10) var<storage, read_write> tests: array<u32>;
@group(0) @binding(11) var<storage, read_write> sizes: array<u32>;
@group(0) @binding(12) var<storage, read> starts: array<u32>;
@group(0) @binding(13) var<storage, read_write> cursors: array<atomic<u32>>;
@group(0) @binding(14) var<storage, read_write> entries: array<vec2<u32>>;
@group(0) @binding(15) var<uniform> params: HashParams;

// Cell of the finest grid, 21 bits per axis; far positions share the outermost one. Monotone whatever is rounded.
fn cell_of(x: vec3<f32>) -> vec3<u32> {
    let scaled = clamp((x - params.origin.xyz) * params.origin.w, vec3<f32>(-REACH), vec3<f32>(REACH - 1.0));
    return vec3<u32>(vec3<i32>(floor(scaled)) + vec3<i32>(i32(REACH)));
}

// Two words per cell: 21 bits of x and y, z in what is left.
fn packed_cell(cell: vec3<u32>) -> vec2<u32> {
    return vec2<u32>(cell.x | ((cell.z & 0x3ffu) << 21u), cell.y | ((cell.z >> 10u) << 21u));
}

fn unpacked_cell(words: vec2<u32>) -> vec3<u32> {
    return vec3<u32>(words.x & 0x1fffffu, words.y & 0x1fffffu, (words.x >> 21u) | ((words.y >> 21u) << 10u));
}

// The cell of a coarser grid that holds one of the finest: four times larger per grid.
fn coarser(cell: vec3<u32>, level: u32) -> vec3<u32> {
    return cell >> vec3<u32>(2u * level);
}

// Finest grid in which cells lo..hi are at most two per axis.
fn home_of(lo: vec3<u32>, hi: vec3<u32>) -> u32 {
    for (var level = 0u; level < LEVELS - 1u; level++) {
        if (all(coarser(hi, level) - coarser(lo, level) <= vec3<u32>(1u))) {
            return level;
        }
    }
    return LEVELS - 1u;
}

// Bucket of a cell, counted from the first of the window: blocks of 2 x 2 x 2 cells are hashed into the buckets of their
// layer, the place in the block is kept, so the cells of one triangle never share a bucket. A coarser cell belongs to the
// layer of its lowest finest one.
fn bucket_of(cell: vec3<u32>, level: u32) -> u32 {
    let lowest_block = (cell[params.axis] << (2u * level)) >> 1u;
    let layer = min(max(lowest_block, params.first_block) - params.first_block, params.last_layer);
    if (layer < params.first_layer || layer - params.first_layer >= params.layers) {
        return NOWHERE;
    }
    let of_layer = layers[layer - params.first_layer];
    let block = cell >> vec3<u32>(1u);
    var hash = (block.x * 0x9E3779B1u) ^ (block.y * 0x85EBCA77u) ^ (block.z * 0xC2B2AE3Du) ^ (level * 0x27D4EB2Fu);
    hash = (hash ^ (hash >> 15u)) * 0x2C1B3C6Du;
    let fine_bits = of_layer.y & 0xffu;
    let bits = select(of_layer.y >> 8u, fine_bits, level == 0u);
    let base = of_layer.x + select(8u << fine_bits, 0u, level == 0u);
    let place = (cell.x & 1u) | ((cell.y & 1u) << 1u) | ((cell.z & 1u) << 2u);
    return base + ((hash >> 1u) >> (31u - bits)) * 8u + place;
}

// Offset number k of the (up to eight) cells of a triangle.
fn offset_of(k: u32) -> vec3<u32> {
    return vec3<u32>(k & 1u, (k >> 1u) & 1u, k >> 2u);
}

// Bits 0-2: whether the cell is the lowest along x, y, z; 3-5: second lowest bits of the cell; from 6: the grid.
fn tag_of(cell: vec3<u32>, offset: vec3<u32>, level: u32) -> u32 {
    let second = (cell >> vec3<u32>(1u)) & vec3<u32>(1u);
    let lowest = vec3<u32>(1u) - offset;
    return lowest.x | (lowest.y << 1u) | (lowest.z << 2u) | (second.x << 3u) | (second.y << 4u) | (second.z << 5u)
        | (level << 6u);
}

// True if a grid may have residents, and cells lo..hi of the finest grid overlap their bounds.
fn may_visit(level: u32, lo: vec3<u32>, hi: vec3<u32>) -> bool {
    let at = level * LEVEL;
    let all_lo = vec3<u32>(levels[at], levels[at + 1u], levels[at + 2u]);
    let all_hi = vec3<u32>(levels[at + 3u], levels[at + 4u], levels[at + 5u]);
    return levels[at + 6u] != 0u && all(lo <= all_hi) && all(all_lo <= hi);
}

// True if a bucket has a resident that a visitor (of cloth: role 0) is to be tested with.
fn has_partner(bucket: u32, role: u32) -> bool {
    if (bucket == NOWHERE) {
        return false;
    }
    return atomicLoad(&counts[4u * bucket]) > 0u || (role == 0u && atomicLoad(&counts[4u * bucket + 1u]) > 0u);
}

// Box, cells and home of every triangle; residents per bucket.
@compute @workgroup_size(WORKGROUP)
fn count_residents(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let t = global_index(id, groups);
    if (t >= params.triangles) {
        return;
    }
    let face = faces[t];
    var path = path_box(unpacked(x_t0[face.x]), unpacked(x_t1[face.x]));
    path = joined(path, path_box(unpacked(x_t0[face.y]), unpacked(x_t1[face.y])));
    path = joined(path, path_box(unpacked(x_t0[face.z]), unpacked(x_t1[face.z])));
    var own = inflated(path, params.cloth_lo.w);
    let role = select(0u, 1u, t >= params.cloth_triangles);
    if (role == 1u) {
        let cloth = Box(params.cloth_lo.xyz, params.cloth_hi.xyz);
        if (!overlaps(own, cloth)) {
            boxes[2u * t] = vec4<u32>(0u);
            boxes[2u * t + 1u] = vec4<u32>(0u);
            cells[t] = vec4<u32>(0u);
            return;
        }
        own = Box(max(own.lo, cloth.lo), min(own.hi, cloth.hi));
    }
    let lo = cell_of(own.lo);
    let hi = cell_of(own.hi);
    let level = home_of(lo, hi);
    boxes[2u * t] = vec4<u32>(bitcast<vec3<u32>>(own.lo), face.w);
    boxes[2u * t + 1u] = vec4<u32>(bitcast<vec3<u32>>(own.hi), level + 1u);
    cells[t] = vec4<u32>(packed_cell(lo), packed_cell(hi));
    let first = coarser(lo, level);
    let extent = coarser(hi, level) - first;
    for (var k = 0u; k < 8u; k++) {
        let offset = offset_of(k);
        let bucket = bucket_of(first + offset, level);
        if (all(offset <= extent) && bucket != NOWHERE) {
            atomicAdd(&counts[4u * bucket + role], 1u);
        }
    }
}

// Visitors per bucket of the coarser grids.
@compute @workgroup_size(WORKGROUP)
fn count_visitors(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let t = global_index(id, groups);
    if (t >= params.triangles || boxes[2u * t + 1u].w == 0u) {
        return;
    }
    let lo = unpacked_cell(cells[t].xy);
    let hi = unpacked_cell(cells[t].zw);
    let role = select(0u, 1u, t >= params.cloth_triangles);
    for (var level = boxes[2u * t + 1u].w; level < LEVELS; level++) {
        if (!may_visit(level, lo, hi)) {
            continue;
        }
        let first = coarser(lo, level);
        let extent = coarser(hi, level) - first;
        for (var k = 0u; k < 8u; k++) {
            let offset = offset_of(k);
            let bucket = bucket_of(first + offset, level);
            if (all(offset <= extent) && has_partner(bucket, role)) {
                atomicAdd(&counts[4u * bucket + 2u + role], 1u);
            }
        }
    }
}

// Numbers of 64 bits as (low, high).
fn wide_sum(a: vec2<u32>, b: vec2<u32>) -> vec2<u32> {
    let low = a.x + b.x;
    return vec2<u32>(low, a.y + b.y + select(0u, 1u, low < a.x));
}

fn wide_product(a: u32, b: u32) -> vec2<u32> {
    let low = (a & 0xffffu) * (b & 0xffffu);
    let one = (a & 0xffffu) * (b >> 16u);
    let other = (a >> 16u) * (b & 0xffffu);
    let middle = (low >> 16u) + (one & 0xffffu) + (other & 0xffffu);
    let high = (a >> 16u) * (b >> 16u) + (one >> 16u) + (other >> 16u) + (middle >> 16u);
    return vec2<u32>((low & 0xffffu) | (middle << 16u), high);
}

// Resident cloth, resident obstacles, visiting cloth, visiting obstacles.
fn load_of(bucket: u32) -> vec4<u32> {
    let at = 4u * bucket;
    return vec4<u32>(
        atomicLoad(&counts[at]), atomicLoad(&counts[at + 1u]), atomicLoad(&counts[at + 2u]), atomicLoad(&counts[at + 3u]));
}

// Pairs to test: all with at least one resident and at least one cloth triangle.
fn tests_of(load: vec4<u32>) -> vec2<u32> {
    let twice = wide_product(load.x, max(load.x, 1u) - 1u);
    let own = vec2<u32>((twice.x >> 1u) | (twice.y << 31u), twice.y >> 1u);
    return wide_sum(wide_sum(own, wide_product(load.x, load.y + load.z + load.w)), wide_product(load.y, load.z));
}

// Tests (two words), entries and busy buckets of every chunk of buckets.
@compute @workgroup_size(WORKGROUP)
fn chunk_loads(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let chunk = global_index(id, groups);
    if (chunk >= params.chunks) {
        return;
    }
    var sum = vec2<u32>(0u);
    var size = 0u;
    var busy = 0u;
    for (var bucket = spans[chunk].x; bucket < spans[chunk].y; bucket++) {
        let load = load_of(bucket);
        let own = tests_of(load);
        if (any(own != vec2<u32>(0u))) {
            sum = wide_sum(sum, own);
            size += load.x + load.y + load.z + load.w;
            busy++;
        }
    }
    chunks[chunk] = vec4<u32>(sum, size, busy);
}

// Tests and entries of every bucket of a batch; the host made sure that tests fit 31 bits.
@compute @workgroup_size(WORKGROUP)
fn bucket_loads(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let i = global_index(id, groups);
    if (i >= params.buckets) {
        return;
    }
    let load = load_of(params.first_bucket + i);
    tests[i] = tests_of(load).x;
    sizes[i] = select(load.x + load.y + load.z + load.w, 0u, tests[i] == 0u);
}

// Writes an entry into a bucket of the batch, behind those of lower classes.
fn put(bucket: u32, kind: u32, entry: vec2<u32>) {
    let i = bucket - params.first_bucket;
    if (bucket == NOWHERE || i >= params.buckets) {
        return;
    }
    if (starts[i] == starts[i + 1u]) {
        return;
    }
    let load = load_of(bucket);
    var slot = starts[i] + atomicAdd(&cursors[4u * i + kind], 1u);
    for (var lower = 0u; lower < kind; lower++) {
        slot += load[lower];
    }
    entries[slot] = entry;
}

// The entries of a batch.
@compute @workgroup_size(WORKGROUP)
fn fill(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let t = global_index(id, groups);
    if (t >= params.triangles || boxes[2u * t + 1u].w == 0u) {
        return;
    }
    let lo = unpacked_cell(cells[t].xy);
    let hi = unpacked_cell(cells[t].zw);
    let role = select(0u, 1u, t >= params.cloth_triangles);
    let home = boxes[2u * t + 1u].w - 1u;
    for (var level = home; level < LEVELS; level++) {
        if (level > home && !may_visit(level, lo, hi)) {
            continue;
        }
        let first = coarser(lo, level);
        let extent = coarser(hi, level) - first;
        for (var k = 0u; k < 8u; k++) {
            let offset = offset_of(k);
            if (any(offset > extent)) {
                continue;
            }
            let cell = first + offset;
            let bucket = bucket_of(cell, level);
            let entry = vec2<u32>(t, tag_of(cell, offset, level));
            if (level == home) {
                put(bucket, role, entry);
            } else if (has_partner(bucket, role)) {
                put(bucket, 2u + role, entry);
            }
        }
    }
}
