// v += dv, x += dt v over the own rows.

struct AdvanceParams {
    rows: u32,
    // Own rows begin here in the local vectors.
    first: u32,
    step_s: f32,
}

@group(0) @binding(0) var<storage, read> velocity_changes: array<Packed3>;
@group(0) @binding(1) var<storage, read_write> velocities: array<Packed3>;
@group(0) @binding(2) var<storage, read_write> positions: array<Packed3>;
@group(0) @binding(3) var<uniform> params: AdvanceParams;

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
