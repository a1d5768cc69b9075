// Sets rows of a vector to given values.

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

@group(0) @binding(0) var<storage, read> entries: array<ScatterEntry>;
@group(0) @binding(1) var<storage, read_write> vector: array<Packed3>;
@group(0) @binding(2) var<uniform> params: ScatterParams;

@compute @workgroup_size(WORKGROUP)
fn scatter(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let i = global_index(id, groups);
    if (i < params.count) {
        vector[params.first + entries[i].row] = entries[i].value;
    }
}
