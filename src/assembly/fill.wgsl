// Value filling and right-hand side of a rank's rows. fill.rs describes the tables, fill_cpu.rs the formulas. Sixteen
// invocations share a row: each gathers the contributions to some of its blocks, in ascending element order, triangles
// before hinges.
// needs ../forces/element.wgsl

struct FillPass {
    gravity: vec3<f32>,
    step_s: f32,
    rows: u32,
    // Slots of the Value Table that are bound.
    first_slot: u32,
    slots: u32,
    // First block of a row that this dispatch fills, and the number of passes over sixteen blocks.
    first_block: u32,
    block_turns: u32,
    // Elements whose records are bound.
    first_triangle: u32,
    triangles: u32,
    first_hinge: u32,
    hinges: u32,
    // FIRST_PASS: no earlier dispatch has added to the blocks. LAST_PASS: no later one will.
    passes: u32,
    // 1: contact_slots and contact_sums are bound.
    contacts: u32,
    padding0: u32,
}

const FIRST_PASS: u32 = 1u;
const LAST_PASS: u32 = 2u;
const LANES: u32 = 16u;
const BLOCK: u32 = 9u;
// Invocations per row.
const SHARE: u32 = 16u;
const NO_BLOCK: u32 = 0xffffffffu;
const NO_SLOT: u32 = 0xffffffffu;
// Values per row with contacts: symmetric diagonal block, right-hand side.
const SUMS: u32 = 9u;

@group(0) @binding(0) var<storage, read> row_offsets: array<u32>;
@group(0) @binding(1) var<storage, read> block_address: array<u32>;
@group(0) @binding(2) var<storage, read> triangle_offsets: array<u32>;
@group(0) @binding(3) var<storage, read> triangle_entries: array<u32>;
@group(0) @binding(4) var<storage, read> triangle_positions: array<vec2<u32>>;
@group(0) @binding(5) var<storage, read> hinge_offsets: array<u32>;
@group(0) @binding(6) var<storage, read> hinge_entries: array<u32>;
@group(0) @binding(7) var<storage, read> hinge_positions: array<vec2<u32>>;
@group(0) @binding(8) var<storage, read> elements: array<TriangleElement>;
@group(0) @binding(9) var<storage, read> triangle_records: array<vec4<f32>>;
@group(0) @binding(10) var<storage, read> hinge_records: array<vec4<f32>>;
@group(0) @binding(11) var<storage, read> masses: array<f32>;
@group(0) @binding(12) var<storage, read> pinned: array<f32>;
@group(0) @binding(13) var<storage, read> contact_slots: array<u32>;
@group(0) @binding(14) var<storage, read> contact_sums: array<f32>;
@group(0) @binding(15) var<storage, read_write> values: array<f32>;
@group(0) @binding(16) var<storage, read_write> rhs: array<Packed3>;
@group(0) @binding(17) var<storage, read_write> inverse_diagonal: array<f32>;
@group(0) @binding(18) var<uniform> params: FillPass;

// Positions of the four corners of a contribution in its row.
fn unpacked_positions(words: vec2<u32>) -> vec4<u32> {
    return vec4<u32>(words.x & 0xffffu, words.x >> 16u, words.y & 0xffffu, words.y >> 16u);
}

// left right', by columns.
fn outer(left: vec3<f32>, right: vec3<f32>) -> mat3x3<f32> {
    return mat3x3<f32>(left * right.x, left * right.y, left * right.z);
}

fn corner_weights(e: u32, corner: u32) -> vec2<f32> {
    let u = elements[e].weights_u;
    let v = elements[e].weights_v;
    if (corner == 0u) {
        return vec2<f32>(-(u.x + u.y), -(v.x + v.y));
    }
    return select(vec2<f32>(u.x, v.x), vec2<f32>(u.y, v.y), corner == 2u);
}

// Force of triangle e (its index among the bound ones) on its corner a.
fn triangle_force(e: u32, a: u32) -> vec3<f32> {
    let r3 = triangle_records[e * 6u + 3u];
    let r4 = triangle_records[e * 6u + 4u];
    let r5 = triangle_records[e * 6u + 5u];
    let w = corner_weights(e, a);
    return vec3<f32>(r3.w, r4.w, r5.w) - (r4.xyz * w.x + r5.xyz * w.y);
}

// Sum of the air blocks of triangle e over its corners: 3 ((normal - tangent) n n' + tangent I), symmetric bit for bit.
fn air_sum(e: u32) -> mat3x3<f32> {
    let r3 = triangle_records[e * 6u + 3u];
    let normal = cross(triangle_records[e * 6u].xyz, triangle_records[e * 6u + 1u].xyz);
    let n = normal * (1.0 / max(sqrt(dot(normal, normal)), 1e-30));
    let scaled = n * (3.0 * (r3.y - r3.z));
    let tangent = 3.0 * r3.z;
    let xy = scaled.x * n.y;
    let xz = scaled.x * n.z;
    let yz = scaled.y * n.z;
    return mat3x3<f32>(
        scaled.x * n.x + tangent, xy, xz,
        xy, scaled.y * n.y + tangent, yz,
        xz, yz, scaled.z * n.z + tangent,
    );
}

// Block (a, b) of triangle e.
fn triangle_block(e: u32, a: u32, b: u32) -> mat3x3<f32> {
    let r0 = triangle_records[e * 6u];
    let r1 = triangle_records[e * 6u + 1u];
    let r2 = triangle_records[e * 6u + 2u];
    let r3 = triangle_records[e * 6u + 3u];
    let xu = r0.xyz;
    let xv = r1.xyz;
    let warp = r0.w;
    let cross_stiffness = r1.w;
    let weft = r2.x;
    let shear = r2.y;
    let normal = cross(xu, xv);
    let n = normal * (1.0 / max(sqrt(dot(normal, normal)), 1e-30));
    let wa = corner_weights(e, a);
    let wb = corner_weights(e, b);
    let uu = wa.x * wb.x;
    let uv = wa.x * wb.y;
    let vu = wa.y * wb.x;
    let vv = wa.y * wb.y;
    let left = xu * (uu * warp + vv * shear) + xv * (uv * shear + vu * cross_stiffness);
    let right = xu * (uv * cross_stiffness + vu * shear) + xv * (uu * shear + vv * weft);
    let identity = uu * r2.z + (uv + vu) * r2.w + vv * r3.x + r3.z;
    var block = outer(left, xu) + outer(right, xv) + outer(n * (r3.y - r3.z), n);
    block[0].x += identity;
    block[1].y += identity;
    block[2].z += identity;
    return block;
}

// Corner at position k, or NO_BLOCK.
fn corner_at(positions: vec4<u32>, k: u32) -> u32 {
    let hit = positions == vec4<u32>(k);
    let late = select(select(NO_BLOCK, 3u, hit.w), 2u, hit.z);
    return select(select(late, 1u, hit.y), 0u, hit.x);
}

// Inverse of a symmetric positive definite block as xx, xy, xz, yy, yz, zz, or zeros for a pinned row.
fn store_inverse(row: u32, m: mat3x3<f32>) {
    let a = cross(m[1], m[2]);
    let b = cross(m[2], m[0]);
    let c = cross(m[0], m[1]);
    let scale = select(1.0 / dot(m[2], c), 0.0, pinned[row] < 0.0);
    let at = row * 6u;
    inverse_diagonal[at] = a.x * scale;
    inverse_diagonal[at + 1u] = b.x * scale;
    inverse_diagonal[at + 2u] = c.x * scale;
    inverse_diagonal[at + 3u] = b.y * scale;
    inverse_diagonal[at + 4u] = c.y * scale;
    inverse_diagonal[at + 5u] = c.z * scale;
}

// Slot of the sums of a row's contacts, or NO_SLOT.
fn contact_sums_of(row: u32) -> u32 {
    if (params.contacts == 0u) {
        return NO_SLOT;
    }
    let slot = contact_slots[row];
    return select(slot * SUMS, NO_SLOT, slot == NO_SLOT);
}

fn fill_force(row: u32) {
    var force = unpacked(rhs[row]);
    if ((params.passes & FIRST_PASS) != 0u) {
        force = params.gravity * masses[row];
    }
    for (var i = triangle_offsets[row]; i < triangle_offsets[row + 1u]; i++) {
        let e = (triangle_entries[i] >> 2u) - params.first_triangle;
        if (e < params.triangles) {
            force += triangle_force(e, triangle_entries[i] & 3u);
        }
    }
    for (var i = hinge_offsets[row]; i < hinge_offsets[row + 1u]; i++) {
        let e = (hinge_entries[i] >> 2u) - params.first_hinge;
        if (e < params.hinges) {
            force -= hinge_records[e * 4u + (hinge_entries[i] & 3u)].xyz * hinge_records[e * 4u + 1u].w;
        }
    }
    if ((params.passes & LAST_PASS) != 0u) {
        force *= params.step_s;
        let at = contact_sums_of(row);
        if (at != NO_SLOT) {
            force += vec3<f32>(contact_sums[at + 6u], contact_sums[at + 7u], contact_sums[at + 8u]);
        }
    }
    rhs[row] = packed(force);
}

// Mass, the spring of a soft pin, and the diagonal block of the contacts of a row.
fn mass_and_contacts(row: u32) -> mat3x3<f32> {
    let mass = masses[row] + max(pinned[row], 0.0);
    var block = mat3x3<f32>(mass, 0.0, 0.0, 0.0, mass, 0.0, 0.0, 0.0, mass);
    let sums = contact_sums_of(row);
    if (sums != NO_SLOT) {
        let xy = contact_sums[sums + 1u];
        let xz = contact_sums[sums + 2u];
        let yz = contact_sums[sums + 4u];
        block += mat3x3<f32>(
            contact_sums[sums], xy, xz,
            xy, contact_sums[sums + 3u], yz,
            xz, yz, contact_sums[sums + 5u],
        );
    }
    return block;
}

fn keep_air(row: u32, m: mat3x3<f32>) {
    let at = row * 6u;
    inverse_diagonal[at] = m[0].x;
    inverse_diagonal[at + 1u] = m[0].y;
    inverse_diagonal[at + 2u] = m[0].z;
    inverse_diagonal[at + 3u] = m[1].y;
    inverse_diagonal[at + 4u] = m[1].z;
    inverse_diagonal[at + 5u] = m[2].z;
}

fn kept_air(row: u32) -> mat3x3<f32> {
    let at = row * 6u;
    let xy = inverse_diagonal[at + 1u];
    let xz = inverse_diagonal[at + 2u];
    let yz = inverse_diagonal[at + 4u];
    return mat3x3<f32>(
        inverse_diagonal[at], xy, xz,
        xy, inverse_diagonal[at + 3u], yz,
        xz, yz, inverse_diagonal[at + 5u],
    );
}

fn fill_block(row: u32, k: u32) {
    let address = block_address[row_offsets[row] + k];
    let slot = address / LANES - params.first_slot;
    if (slot >= params.slots) {
        return;
    }
    let at = slot * BLOCK * LANES + address % LANES;
    var block = mat3x3<f32>();
    if ((params.passes & FIRST_PASS) == 0u) {
        for (var c = 0u; c < BLOCK; c++) {
            block[c % 3u][c / 3u] = values[at + c * LANES];
        }
    }
    var diagonal = false;
    // The part of the diagonal block that is stored. Between passes its air is kept where the inverse goes.
    var absolute = mat3x3<f32>();
    for (var i = triangle_offsets[row]; i < triangle_offsets[row + 1u]; i++) {
        // A triangle does not have a fourth corner.
        let corner = corner_at(vec4<u32>(unpacked_positions(triangle_positions[i]).xyz, NO_BLOCK), k);
        let entry = triangle_entries[i];
        if (corner != NO_BLOCK) {
            if (corner == (entry & 3u) && !diagonal) {
                diagonal = true;
                if ((params.passes & FIRST_PASS) == 0u) {
                    absolute = kept_air(row);
                }
            }
            let e = (entry >> 2u) - params.first_triangle;
            if (e < params.triangles) {
                block += triangle_block(e, entry & 3u, corner);
                if (diagonal) {
                    absolute += air_sum(e);
                }
            }
        }
    }
    for (var i = hinge_offsets[row]; i < hinge_offsets[row + 1u]; i++) {
        let corner = corner_at(unpacked_positions(hinge_positions[i]), k);
        let e = (hinge_entries[i] >> 2u) - params.first_hinge;
        if (corner != NO_BLOCK && e < params.hinges) {
            let scaled = hinge_records[e * 4u + (hinge_entries[i] & 3u)].xyz * hinge_records[e * 4u].w;
            block += outer(scaled, hinge_records[e * 4u + corner].xyz);
        }
    }
    if (diagonal) {
        if ((params.passes & LAST_PASS) == 0u) {
            keep_air(row, absolute);
        } else {
            let added = mass_and_contacts(row);
            store_inverse(row, block + added);
            block = absolute + added;
        }
    }
    for (var c = 0u; c < BLOCK; c++) {
        values[at + c * LANES] = block[c % 3u][c / 3u];
    }
}

@compute @workgroup_size(WORKGROUP)
fn fill(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let index = global_index(id, groups);
    let row = index / SHARE;
    if (row >= params.rows) {
        return;
    }
    if (index % SHARE == 0u && params.first_block == 0u && params.first_slot == 0u) {
        fill_force(row);
    }
    let length = row_offsets[row + 1u] - row_offsets[row];
    var k = params.first_block + index % SHARE;
    for (var turn = 0u; turn < params.block_turns; turn++) {
        if (k < length) {
            fill_block(row, k);
        }
        k += SHARE;
    }
}
