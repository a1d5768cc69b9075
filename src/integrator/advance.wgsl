// v += dv, x += dt v over the own rows; and rows set to given values.

struct AdvanceParams {
    rows: u32,
    // Own rows begin here in the local vectors.
    first: u32,
    step_s: f32,
}

struct ScatterParams {
    count: u32,
    // Own rows begin here in the vector.
    first: u32,
}

// Row and value.
struct ScatterEntry {
    row: u32,
    value: Packed3,
}

@group(0) @binding(0) var<storage, read> velocity_changes: array<Packed3>;
@group(0) @binding(1) var<storage, read_write> velocities: array<Packed3>;
@group(0) @binding(2) var<storage, read_write> positions: array<Packed3>;
@group(0) @binding(3) var<uniform> params: AdvanceParams;

@group(0) @binding(4) var<storage, read> entries: array<ScatterEntry>;
@group(0) @binding(5) var<storage, read_write> vector: array<Packed3>;
@group(0) @binding(6) var<uniform> scatter_params: ScatterParams;

@compute @workgroup_size(WORKGROUP)
fn advance(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let row = global_index(id, groups);
    if (row < params.rows) {
        let local = params.first + row;
        let velocity = unpacked(velocities[local]) + unpacked(velocity_changes[row]);
        velocities[local] = packed(velocity);
        positions[local] = packed(unpacked(positions[local]) + params.step_s * velocity);
    }
}

@compute @workgroup_size(WORKGROUP)
fn scatter(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let i = global_index(id, groups);
    if (i < scatter_params.count) {
        vector[scatter_params.first + entries[i].row] = entries[i].value;
    }
}
