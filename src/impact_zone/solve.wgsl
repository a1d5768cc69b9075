// Descent on the multipliers of impact zones, one workgroup per zone; see solve.rs. A dispatch goes on where the one before
// stopped, with the same bits as one long dispatch.

struct SolveParams {
    zones: u32,
    // At most so many sweeps in this dispatch.
    iterations: u32,
}

struct DeviceZone {
    first_vertex: u32,
    vertices: u32,
    first_row: u32,
    rows: u32,
    // Entries of `colors`: the first row of each color, and the end of the last one.
    first_color: u32,
    colors: u32,
    // Change of a gap that ends the descent.
    tolerance: f32,
}

// normal . sum(weights * d) >= value; `target` is reserved in WGSL.
struct DeviceRow {
    normal: Packed3,
    value: f32,
    weights: vec4<f32>,
    vertices: vec4<u32>,
    yielding: f32,
    pad: Packed3,
}

// Of a row: as it stands, after the sweep before, and whether it takes part in sweeps over the acting rows.
struct Multipliers {
    now: f32,
    held: f32,
    working: u32,
}

// Of a vertex: what belongs to the multipliers.
struct Displacements {
    now: Packed3,
    held: Packed3,
}

struct DeviceStatus {
    momentum: f32,
    // Sweeps over the acting rows until the next one over all.
    inner: u32,
    iterations: u32,
    converged: u32,
}

@group(0) @binding(0) var<storage, read> zones: array<DeviceZone>;
@group(0) @binding(1) var<storage, read> inverse_masses: array<f32>;
@group(0) @binding(2) var<storage, read> rows: array<DeviceRow>;
@group(0) @binding(3) var<storage, read> colors: array<u32>;
@group(0) @binding(4) var<storage, read_write> multipliers: array<Multipliers>;
@group(0) @binding(5) var<storage, read_write> displacements: array<Displacements>;
@group(0) @binding(6) var<storage, read_write> status: array<DeviceStatus>;
@group(0) @binding(7) var<uniform> params: SolveParams;

const LANES: u32 = 64u;
const IMMOVABLE: u32 = 0xffffffffu;
const MOST_INNER: u32 = 20u;

// Largest change of a gap, and the product that says whether the extrapolation pointed uphill.
var<workgroup> changes: array<f32, LANES>;
var<workgroup> turns: array<f32, LANES>;
// Uniform over the workgroup.
var<workgroup> shared_status: DeviceStatus;

// Part of a row's gap that a vertex makes.
fn part(v: u32, weight: f32, normal: vec3<f32>) -> f32 {
    if (v == IMMOVABLE) {
        return 0.0;
    }
    return weight * dot(normal, unpacked(displacements[v].now));
}

fn move_along(v: u32, by: f32, normal: vec3<f32>) {
    if (v == IMMOVABLE) {
        return;
    }
    displacements[v].now = packed(unpacked(displacements[v].now) + by * inverse_masses[v] * normal);
}

// Gives a row the multiplier that closes its gap. Returns the change of the gap and the row's part of the turn.
fn close_gap(r: u32) -> vec2<f32> {
    let row = rows[r];
    let normal = unpacked(row.normal);
    let gap = part(row.vertices.x, row.weights.x, normal) + part(row.vertices.y, row.weights.y, normal)
        + part(row.vertices.z, row.weights.z, normal) + part(row.vertices.w, row.weights.w, normal);
    let own = multipliers[r];
    if (own.now == 0.0 && gap >= row.value) {
        return vec2<f32>(0.0);
    }
    let next = max(own.now + (row.value - gap) / row.yielding, 0.0);
    let by = next - own.now;
    multipliers[r].now = next;
    move_along(row.vertices.x, by * row.weights.x, normal);
    move_along(row.vertices.y, by * row.weights.y, normal);
    move_along(row.vertices.z, by * row.weights.z, normal);
    move_along(row.vertices.w, by * row.weights.w, normal);
    return row.yielding * vec2<f32>(abs(by), -by * (next - own.held));
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
        let over_all = state.inner == 0u;
        var change = 0.0;
        var uphill = 0.0;
        for (var c = 0u; c < zone.colors; c++) {
            let end = colors[zone.first_color + c + 1u];
            for (var r = colors[zone.first_color + c] + local; r < end; r += LANES) {
                if (over_all || multipliers[r].working != 0u) {
                    let changed = close_gap(r);
                    change = max(change, changed.x);
                    uphill += changed.y;
                }
            }
            storageBarrier();
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
        let inner = select(state.inner - 1u, 0u, changes[0] <= 0.5 * zone.tolerance);
        let dropped = turns[0] > 0.0;
        let following = select(0.5 + sqrt(0.25 + state.momentum * state.momentum), 1.0, dropped);
        let keep = select((state.momentum - 1.0) / following, 0.0, over_all || dropped || inner == 0u);
        if (local == 0u) {
            let made = state.iterations + 1u;
            if (over_all) {
                shared_status = DeviceStatus(1.0, MOST_INNER, made, u32(changes[0] <= zone.tolerance));
            } else {
                shared_status = DeviceStatus(following, inner, made, 0u);
            }
        }
        for (var r = zone.first_row + local; r < zone.first_row + zone.rows; r += LANES) {
            let own = multipliers[r];
            let working = select(own.working, u32(own.now > 0.0), over_all);
            multipliers[r] = Multipliers(own.now + keep * (own.now - own.held), own.now, working);
        }
        for (var v = zone.first_vertex + local; v < zone.first_vertex + zone.vertices; v += LANES) {
            let now = unpacked(displacements[v].now);
            let held = unpacked(displacements[v].held);
            displacements[v] = Displacements(packed(now + keep * (now - held)), packed(now));
        }
        storageBarrier();
        workgroupBarrier();
    }
    let ended = workgroupUniformLoad(&shared_status);
    if (local == 0u) {
        status[z] = ended;
    }
}
