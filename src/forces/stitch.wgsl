// Threads of seams: three records like those of hinges per thread; stitch.rs explains them.
// needs element.wgsl

struct StitchElement {
    vertices: vec2<u32>,
    stiffness_n_m: f32,
    first_m: f32,
}

struct StitchParams {
    step_s: f32,
    ahead_s: f32,
    count: u32,
    closed: f32,
    closing_1_s: f32,
    last_m: f32,
    damping_s: f32,
    firmness: f32,
}

@group(0) @binding(0) var<storage, read> elements: array<StitchElement>;
@group(0) @binding(1) var<storage, read> positions: array<Packed3>;
@group(0) @binding(2) var<storage, read> velocities: array<Packed3>;
@group(0) @binding(3) var<storage, read_write> records: array<vec4<f32>>;
@group(0) @binding(4) var<uniform> params: StitchParams;

@compute @workgroup_size(WORKGROUP)
fn stitch(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let i = global_index(id, groups);
    if (i >= params.count) {
        return;
    }
    let element = elements[i];
    let x = unpacked(positions[element.vertices.x]) - unpacked(positions[element.vertices.y]);
    let w = unpacked(velocities[element.vertices.x]) - unpacked(velocities[element.vertices.y]);
    let length = length(x);
    let way = max(element.first_m - params.last_m, 0.0);
    let rest = element.first_m - way * params.closed;
    let rest_rate = -way * params.closing_1_s;
    var n = vec3<f32>(1.0, 0.0, 0.0);
    var across = 1.0;
    if (length > 0.0) {
        n = x / length;
        across = max(1.0 - rest / length, 0.0);
    }
    let rate = dot(w, n);
    let firm = element.stiffness_n_m * params.firmness;
    let pull = (length - rest) + params.ahead_s * rate;
    let taut = select(0.0, firm, pull > 0.0);
    let damper = select(0.0, firm * params.damping_s, pull > 0.0 || rate < rest_rate);
    let moment = taut * pull + damper * (rate - rest_rate);
    let axis = select(vec3<f32>(0.0, 1.0, 0.0), vec3<f32>(1.0, 0.0, 0.0), abs(n.x) < 0.6);
    let t = normalize(cross(n, axis));
    let b = cross(n, t);
    let along = params.step_s * (params.step_s * taut + damper);
    let lag = params.ahead_s + params.damping_s;
    let kt = taut * across;
    let aside = params.step_s * (params.step_s + params.damping_s) * kt;
    let at = i * 12u;
    records[at] = vec4<f32>(n, along);
    records[at + 1u] = vec4<f32>(-n, moment);
    records[at + 2u] = vec4<f32>(0.0);
    records[at + 3u] = vec4<f32>(0.0);
    records[at + 4u] = vec4<f32>(t, aside);
    records[at + 5u] = vec4<f32>(-t, kt * lag * dot(w, t));
    records[at + 6u] = vec4<f32>(0.0);
    records[at + 7u] = vec4<f32>(0.0);
    records[at + 8u] = vec4<f32>(b, aside);
    records[at + 9u] = vec4<f32>(-b, kt * lag * dot(w, b));
    records[at + 10u] = vec4<f32>(0.0);
    records[at + 11u] = vec4<f32>(0.0);
}
