// rhs -= m dv over the own rows.

struct InertiaParams {
    rows: u32,
}

@group(0) @binding(0) var<storage, read> masses: array<f32>;
@group(0) @binding(1) var<storage, read> velocity_changes: array<Packed3>;
@group(0) @binding(2) var<storage, read_write> rhs: array<Packed3>;
@group(0) @binding(3) var<uniform> params: InertiaParams;

@compute @workgroup_size(WORKGROUP)
fn inertia(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let row = global_index(id, groups);
    if (row < params.rows) {
        rhs[row] = packed(unpacked(rhs[row]) - masses[row] * unpacked(velocity_changes[row]));
    }
}
