// Streams an array: the yardstick that other kernels are measured against; see bandwidth.rs.

struct BandwidthParams {
    count: u32,
    threads: u32,
    turns: u32,
}

@group(0) @binding(0) var<storage, read> from_words: array<vec4<u32>>;
@group(0) @binding(1) var<storage, read_write> to_words: array<vec4<u32>>;
@group(0) @binding(2) var<uniform> params: BandwidthParams;

@compute @workgroup_size(WORKGROUP)
fn copy_words(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let i = global_index(id, groups);
    if (i < params.count) {
        to_words[i] = from_words[i];
    }
}

// Every invocation reads `turns` items, `threads` apart, and writes what they combine to.
@compute @workgroup_size(WORKGROUP)
fn read_words(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let first = global_index(id, groups);
    if (first >= params.threads) {
        return;
    }
    var combined = vec4<u32>(0u);
    for (var turn = 0u; turn < params.turns; turn++) {
        let i = first + turn * params.threads;
        if (i < params.count) {
            combined ^= from_words[i];
        }
    }
    to_words[first] = combined;
}
