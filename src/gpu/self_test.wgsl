// Probes what kernels rely on and what some drivers get wrong; see self_test.rs.

struct SelfTestParams {
    turns: u32,
    zero: f32,
}

@group(0) @binding(0) var<storage, read_write> out: array<u32>;
@group(0) @binding(1) var<uniform> params: SelfTestParams;

// A generator of [Numerical Recipes, Sec. 7.1]; no compiler can replace the loop.
fn turned(turns: u32) -> u32 {
    var x = 1u;
    for (var i = 0u; i < turns; i++) {
        x = x * 1664525u + 1013904223u;
    }
    return x;
}

// One workgroup per probe: invocations that run side by side may share a driver's count of loop turns.
@compute @workgroup_size(WORKGROUP)
fn self_test(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    if (local != 0u) {
        return;
    }
    let probe = group_index(group, groups);
    if (probe == 0u) {
        out[0] = turned(params.turns);
    } else if (probe == 1u) {
        out[1] = turned(params.turns + 10000u);
    } else {
        let nan = bitcast<f32>(0x7fc00000u | u32(params.zero));
        out[2] = select(0u, 1u, is_finite(nan));
        out[3] = select(0u, 1u, is_finite(params.zero));
        out[4] = select(0u, 1u, nan != nan);
    }
}
