// The tests on the device: boxes of triangles within a bucket, then boxes of the features that the two triangles own, then
// a separating-axis test that drops what is proven apart; pairs.rs says what the arrays hold.
// needs boxes.wgsl

struct PairParams {
    // Buckets of the batch.
    first_bucket: u32,
    buckets: u32,
    // Tests of this dispatch, numbered within the batch.
    first_test: u32,
    end_test: u32,
    // Pairs of triangles that fit, and those that this dispatch looks at.
    pair_room: u32,
    first_pair: u32,
    end_pair: u32,
    candidate_room: u32,
    // 0: boxes only, 1: farther apart than the candidate's reach, 2: than the separation.
    filter_kind: u32,
    pad_m: f32,
    // How much boxes shrink before they are tested with others of the same piece.
    shrink_m: f32,
    separation_m: f32,
}

// Tests per invocation.
const SHARE: u32 = 32u;
const BOXES_ONLY: u32 = 0u;
const BY_PAIR: u32 = 1u;

@group(0) @binding(0) var<storage, read> test_starts: array<u32>;
@group(0) @binding(1) var<storage, read> starts: array<u32>;
@group(0) @binding(2) var<storage, read> counts: array<vec4<u32>>;
@group(0) @binding(3) var<storage, read> entries: array<vec2<u32>>;
@group(0) @binding(4) var<storage, read> boxes: array<vec4<u32>>;
@group(0) @binding(5) var<storage, read_write> pairs: array<vec2<u32>>;
@group(0) @binding(6) var<storage, read_write> found: array<atomic<u32>>;
@group(0) @binding(7) var<storage, read> faces: array<vec4<u32>>;
@group(0) @binding(8) var<storage, read> x_t0: array<Packed3>;
@group(0) @binding(9) var<storage, read> x_t1: array<Packed3>;
@group(0) @binding(10) var<storage, read> reach_m: array<f32>;
@group(0) @binding(11) var<storage, read_write> candidates: array<u32>;
@group(0) @binding(12) var<uniform> params: PairParams;

// Where a test stands: bucket, its load and first entry, the number of the test behind its last; the two entries.
struct Place {
    load: vec4<u32>,
    start: u32,
    end_test: u32,
    row: u32,
    partner: u32,
}

// Tests of the rows before a row of cloth.
fn before_row(row: u32, all: u32) -> u32 {
    return (row * (2u * all - 1u - row)) / 2u;
}

// Finds the bucket of a test, then its row: bisections.
fn locate(test: u32) -> Place {
    var low = 0u;
    var high = params.buckets;
    while (high - low > 1u) {
        let middle = (low + high) / 2u;
        if (test_starts[middle] <= test) {
            low = middle;
        } else {
            high = middle;
        }
    }
    var place: Place;
    place.load = counts[params.first_bucket + low];
    place.start = starts[low];
    place.end_test = test_starts[low + 1u];
    let load = place.load;
    let all = load.x + load.y + load.z + load.w;
    var within = test - test_starts[low];
    let own = before_row(load.x, all);
    if (within >= own) {
        within -= own;
        place.row = load.x + within / load.z;
        place.partner = load.x + load.y + within % load.z;
        return place;
    }
    low = 0u;
    high = load.x;
    while (high - low > 1u) {
        let middle = (low + high) / 2u;
        if (before_row(middle, all) <= within) {
            low = middle;
        } else {
            high = middle;
        }
    }
    place.row = low;
    place.partner = low + 1u + within - before_row(low, all);
    return place;
}

// The next test of the same bucket.
fn advanced(place: Place) -> Place {
    var next = place;
    next.partner++;
    let load = place.load;
    let residents = load.x + load.y;
    let end = select(residents + load.z, residents + load.z + load.w, place.row < load.x);
    if (next.partner >= end) {
        next.row++;
        next.partner = select(residents, next.row + 1u, next.row < load.x);
    }
    return next;
}

fn triangle_box(t: u32) -> Box {
    return Box(bitcast<vec3<f32>>(boxes[2u * t].xyz), bitcast<vec3<f32>>(boxes[2u * t + 1u].xyz));
}

// True if this bucket is the place to report two entries, and their boxes overlap.
fn meets(one: vec2<u32>, other: vec2<u32>) -> bool {
    if (((one.y | other.y) & 7u) != 7u || ((one.y ^ other.y) & 0xfffffff8u) != 0u) {
        return false;
    }
    let a = triangle_box(one.x);
    let b = triangle_box(other.x);
    if (!overlaps(a, b)) {
        return false;
    }
    let same_piece = (boxes[2u * one.x].w >> 6u) == (boxes[2u * other.x].w >> 6u);
    return params.shrink_m == 0.0 || !same_piece || overlaps(shrunk(a, params.shrink_m), b);
}

// Pairs of triangles whose boxes overlap.
@compute @workgroup_size(WORKGROUP)
fn box_tests(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let index = global_index(id, groups);
    if (index >= (params.end_test - params.first_test + SHARE - 1u) / SHARE) {
        return;
    }
    let first = params.first_test + index * SHARE;
    let end = min(first + SHARE, params.end_test);
    var place = locate(first);
    for (var test = first; test < end; test++) {
        let one = entries[place.start + place.row];
        let other = entries[place.start + place.partner];
        if (meets(one, other)) {
            let slot = atomicAdd(&found[0], 1u);
            if (slot < params.pair_room) {
                pairs[slot] = vec2<u32>(one.x, other.x);
            }
        }
        if (test + 1u < end) {
            if (test + 1u < place.end_test) {
                place = advanced(place);
            } else {
                place = locate(test + 1u);
            }
        }
    }
}

fn vertex_box(v: u32) -> Box {
    return inflated(path_box(unpacked(x_t0[v]), unpacked(x_t1[v])), params.pad_m);
}

fn edge_box(edge: vec2<u32>) -> Box {
    let one = path_box(unpacked(x_t0[edge.x]), unpacked(x_t1[edge.x]));
    return inflated(joined(one, path_box(unpacked(x_t0[edge.y]), unpacked(x_t1[edge.y]))), params.pad_m);
}

// Differences of a candidate at both ends of the step; `largest` per component.
struct Hull {
    start: array<vec3<f32>, 4>,
    end: array<vec3<f32>, 4>,
    largest: vec3<f32>,
    separation_m: f32,
}

fn hull_of(v: vec4<u32>, is_edges: bool, separation_m: f32) -> Hull {
    var hull: Hull;
    hull.separation_m = separation_m;
    // Vertex and corners (the last one twice), or the ends of both edges.
    let first = select(vec4<u32>(v.x), vec4<u32>(v.x, v.x, v.y, v.y), is_edges);
    let second = select(v.yzww, vec4<u32>(v.z, v.w, v.z, v.w), is_edges);
    for (var i = 0u; i < 4u; i++) {
        hull.start[i] = unpacked(x_t0[first[i]]) - unpacked(x_t0[second[i]]);
        hull.end[i] = unpacked(x_t1[first[i]]) - unpacked(x_t1[second[i]]);
        hull.largest = max(hull.largest, max(abs(hull.start[i]), abs(hull.end[i])));
    }
    return hull;
}

// True if a direction, either sign, proves the parts more than the separation apart at both ends, so in between too.
//
// Per product with a difference, in roundoffs u = 2^-24 of the sum of absolute products: 1 for the difference, at most 3
// for products and sums in whatever order (contracting only lowers it), 1 for the bound: 24 u leave five times that; where
// candidates have their own reach, 128 u are above what native tests may find with rounded closest points. sqrt may be off
// by 5 units in the last place (10 u) where it is made of a reciprocal root: 32 u. Where the square of the direction may be
// flushed to zero the sum of its components bounds its length. What underflows or is flushed costs less than `underflow`
// times what it is multiplied with. If `size` is finite then no product overflowed; nothing that is no number is compared.
fn splits(d: vec3<f32>, hull: ptr<function, Hull>) -> bool {
    let u = 5.9604644775390625e-8;
    let underflow = 7.523164e-37;
    let sum = abs(d.x) + abs(d.y) + abs(d.z);
    let size = dot(abs(d), (*hull).largest);
    let slack = select(24.0 * u, 128.0 * u, params.filter_kind == BY_PAIR);
    let square = dot(d, d);
    let length = select(sqrt(max(square, 1e-30)) * (1.0 + 32.0 * u), sum, square < 1e-28);
    let bound = size * slack + (*hull).separation_m * length * (1.0 + 8.0 * u) + underflow * (1.0 + sum);
    if (!is_finite(size) || !is_finite(square) || !is_finite(bound)) {
        return false;
    }
    var low = dot(d, (*hull).start[0]);
    var high = low;
    for (var i = 0u; i < 4u; i++) {
        let start = dot(d, (*hull).start[i]);
        let end = dot(d, (*hull).end[i]);
        low = min(low, min(start, end));
        high = max(high, max(start, end));
    }
    return low > bound || high < -bound;
}

// True if one of the directions of elementary/lanes.rs proves a candidate apart.
fn proven_apart(v: vec4<u32>, is_edges: bool, same_piece: bool) -> bool {
    if (params.filter_kind == BOXES_ONLY) {
        return false;
    }
    var separation_m = params.separation_m;
    if (params.filter_kind == BY_PAIR && same_piece) {
        separation_m = reach_m[v.x];
        if (is_edges) {
            separation_m = min(min(separation_m, reach_m[v.y]), min(reach_m[v.z], reach_m[v.w]));
        }
    }
    var hull = hull_of(v, is_edges, separation_m);
    let one = select(hull.start[0] - hull.start[1], hull.start[2] - hull.start[0], is_edges);
    let other = select(hull.start[1] - hull.start[2], hull.start[0] - hull.start[1], is_edges);
    let normal = cross(one, other);
    if (splits(normal, &hull) || splits(cross(one, normal), &hull) || splits(cross(other, normal), &hull)) {
        return true;
    }
    if (is_edges) {
        return splits(cross(one, cross(hull.start[0], one)), &hull) || splits(one, &hull);
    }
    return splits(cross(hull.start[2] - hull.start[0], normal), &hull);
}

fn report(v: vec4<u32>, kind: u32) {
    let slot = atomicAdd(&found[1], 1u);
    if (slot < params.candidate_room) {
        candidates[5u * slot] = v.x;
        candidates[5u * slot + 1u] = v.y;
        candidates[5u * slot + 2u] = v.z;
        candidates[5u * slot + 3u] = v.w;
        candidates[5u * slot + 4u] = kind;
    }
}

fn sorted_edge(face: vec4<u32>, k: u32) -> vec2<u32> {
    let from_corner = face[k];
    let to_corner = face[(k + 1u) % 3u];
    return vec2<u32>(min(from_corner, to_corner), max(from_corner, to_corner));
}

// Vertices that one triangle owns against the other.
fn vertices_to_face(one: vec4<u32>, other: vec4<u32>, face_box: Box, same_piece: bool) {
    for (var k = 0u; k < 3u; k++) {
        let v = one[k];
        if (((one.w >> k) & 1u) == 0u || any(other.xyz == vec3<u32>(v)) || !overlaps(vertex_box(v), face_box)) {
            continue;
        }
        let candidate = vec4<u32>(v, other.xyz);
        if (!proven_apart(candidate, false, same_piece)) {
            report(candidate, 0u);
        }
    }
}

// Edges that two triangles own against each other.
fn edges_to_edges(one: vec4<u32>, other: vec4<u32>, other_box: Box, by: f32, same_piece: bool) {
    for (var k = 0u; k < 3u; k++) {
        let a = sorted_edge(one, k);
        let a_box = edge_box(a);
        if (((one.w >> (3u + k)) & 1u) == 0u || !overlaps(a_box, other_box)) {
            continue;
        }
        for (var l = 0u; l < 3u; l++) {
            let b = sorted_edge(other, l);
            if (((other.w >> (3u + l)) & 1u) == 0u || any(a == b) || any(a == b.yx)
                || !overlaps(shrunk(a_box, by), edge_box(b))) {
                continue;
            }
            let a_first = a.x < b.x || (a.x == b.x && a.y < b.y);
            let candidate = select(vec4<u32>(b, a), vec4<u32>(a, b), a_first);
            if (!proven_apart(candidate, true, same_piece)) {
                report(candidate, 1u);
            }
        }
    }
}

// Candidates of the pairs of triangles that were found.
@compute @workgroup_size(WORKGROUP)
fn feature_pairs(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let index = global_index(id, groups);
    if (index >= params.end_pair - params.first_pair) {
        return;
    }
    let pair = pairs[params.first_pair + index];
    let one = faces[pair.x];
    let other = faces[pair.y];
    let same_piece = (one.w >> 6u) == (other.w >> 6u);
    let by = select(0.0, params.shrink_m, same_piece);
    let one_box = shrunk(triangle_box(pair.x), by);
    let other_box = shrunk(triangle_box(pair.y), by);
    vertices_to_face(one, other, other_box, same_piece);
    vertices_to_face(other, one, one_box, same_piece);
    edges_to_edges(one, other, other_box, by, same_piece);
}
