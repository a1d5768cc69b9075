// Accelerated descent on the multipliers of impact zones, one workgroup per zone; see solve.rs. A dispatch goes on where
// the one before stopped, with the same bits as one long dispatch.

struct SolveParams {
    zones: u32,
    // At most so many in this dispatch.
    iterations: u32,
}

struct DeviceZone {
    first_vertex: u32,
    vertices: u32,
    first_row: u32,
    rows: u32,
    // Error of a constraint that ends the descent.
    tolerance: f32,
}

struct DeviceVertex {
    inverse_mass: f32,
    // Entries of `gather`: 4 * row + place of the vertex in it.
    first_entry: u32,
    end_entry: u32,
}

// normal . sum(weights * d) >= value; `target` is reserved in WGSL.
struct DeviceRow {
    normal: Packed3,
    value: f32,
    weights: vec4<f32>,
    vertices: vec4<u32>,
    bound: f32,
    pad: Packed3,
}

// Of a row: of the last iterate, of the extrapolated one, of the one being made.
struct Multipliers {
    held: f32,
    tried: f32,
    next: f32,
}

struct DeviceStatus {
    momentum: f32,
    iterations: u32,
    converged: u32,
}

@group(0) @binding(0) var<storage, read> zones: array<DeviceZone>;
@group(0) @binding(1) var<storage, read> vertices: array<DeviceVertex>;
@group(0) @binding(2) var<storage, read> gather: array<u32>;
@group(0) @binding(3) var<storage, read> rows: array<DeviceRow>;
@group(0) @binding(4) var<storage, read_write> multipliers: array<Multipliers>;
@group(0) @binding(5) var<storage, read_write> displacements: array<Packed3>;
@group(0) @binding(6) var<storage, read_write> status: array<DeviceStatus>;
@group(0) @binding(7) var<uniform> params: SolveParams;

const LANES: u32 = 64u;
const IMMOVABLE: u32 = 0xffffffffu;

// Largest change of a row, and the product that says whether the momentum points uphill.
var<workgroup> changes: array<f32, LANES>;
var<workgroup> turns: array<f32, LANES>;
// Uniform over the workgroup.
var<workgroup> shared_status: DeviceStatus;

fn displacement(v: u32, held: bool) -> Packed3 {
    var sum = vec3<f32>(0.0);
    let vertex = vertices[v];
    for (var e = vertex.first_entry; e < vertex.end_entry; e++) {
        let entry = gather[e];
        let row = entry / 4u;
        let multiplier = select(multipliers[row].tried, multipliers[row].held, held);
        sum += rows[row].weights[entry % 4u] * multiplier * unpacked(rows[row].normal);
    }
    return packed(sum * vertex.inverse_mass);
}

// Part of a row's gap that a vertex makes.
fn part(v: u32, weight: f32, normal: vec3<f32>) -> f32 {
    if (v == IMMOVABLE) {
        return 0.0;
    }
    return weight * dot(normal, unpacked(displacements[v]));
}

@compute @workgroup_size(LANES)
fn solve(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let z = group_index(group, groups);
    if (z >= params.zones) {
        return;
    }
    let zone = zones[z];
    if (local == 0u) {
        shared_status = status[z];
    }
    for (var turn = 0u; turn < params.iterations; turn++) {
        let state = workgroupUniformLoad(&shared_status);
        if (state.converged != 0u) {
            break;
        }
        for (var v = local; v < zone.vertices; v += LANES) {
            displacements[zone.first_vertex + v] = displacement(zone.first_vertex + v, false);
        }
        storageBarrier();
        var change = 0.0;
        var uphill = 0.0;
        for (var i = local; i < zone.rows; i += LANES) {
            let r = zone.first_row + i;
            let row = rows[r];
            let normal = unpacked(row.normal);
            let gap = part(row.vertices.x, row.weights.x, normal) + part(row.vertices.y, row.weights.y, normal)
                + part(row.vertices.z, row.weights.z, normal) + part(row.vertices.w, row.weights.w, normal);
            let own = multipliers[r];
            let next = max(own.tried + (row.value - gap) / row.bound, 0.0);
            change = max(change, row.bound * abs(next - own.tried));
            uphill += row.bound * (own.tried - next) * (next - own.held);
            multipliers[r].next = next;
        }
        changes[local] = change;
        turns[local] = uphill;
        workgroupBarrier();
        for (var step = LANES / 2u; step > 0u; step /= 2u) {
            if (local < step) {
                changes[local] = max(changes[local], changes[local + step]);
                turns[local] += turns[local + step];
            }
            workgroupBarrier();
        }
        let dropped = turns[0] > 0.0;
        let following = select(0.5 + sqrt(0.25 + state.momentum * state.momentum), 1.0, dropped);
        let keep = select((state.momentum - 1.0) / following, 0.0, dropped);
        if (local == 0u) {
            shared_status = DeviceStatus(following, state.iterations + 1u, u32(changes[0] <= zone.tolerance));
        }
        for (var i = local; i < zone.rows; i += LANES) {
            let r = zone.first_row + i;
            let own = multipliers[r];
            multipliers[r].tried = own.next + keep * (own.next - own.held);
            multipliers[r].held = own.next;
        }
        storageBarrier();
        workgroupBarrier();
    }
    let ended = workgroupUniformLoad(&shared_status);
    for (var v = local; v < zone.vertices; v += LANES) {
        displacements[zone.first_vertex + v] = displacement(zone.first_vertex + v, true);
    }
    if (local == 0u) {
        status[z] = ended;
    }
}
