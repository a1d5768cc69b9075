// Rows of a vector that other ranks read, packed into a message; see gather.rs.

struct GatherParams {
    count: u32,
    // Own rows begin here in the vector.
    first: u32,
    // Vectors in the message, and which one this is.
    planes: u32,
    plane: u32,
}

@group(0) @binding(0) var<storage, read> rows: array<u32>;
@group(0) @binding(1) var<storage, read> vector: array<Packed3>;
@group(0) @binding(2) var<storage, read_write> message: array<Packed3>;
@group(0) @binding(3) var<uniform> params: GatherParams;

@compute @workgroup_size(WORKGROUP)
fn gather(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let i = global_index(id, groups);
    if (i < params.count) {
        message[i * params.planes + params.plane] = vector[params.first + rows[i]];
    }
}
