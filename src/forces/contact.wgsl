// Contact elements: one record per contact; contact.rs explains the record, contact_cpu.rs law and friction.

struct ContactElement {
    vertices: vec4<u32>,
    weights: vec4<f32>,
    normal: vec3<f32>,
    distance_m: f32,
    thickness_m: f32,
    stiffness_n_m: f32,
    friction: f32,
    kind: u32,
}

struct ContactParams {
    fall_m: vec3<f32>,
    step_s: f32,
    count: u32,
    stiffness_ratio: f32,
    at_end: u32,
    rows: u32,
}

const NO_VERTEX: u32 = 0xffffffffu;
const STICK_SPEED_M_S: f32 = 4e-5;
const LEAST_GAP: f32 = 0.1;
const SHARING: f32 = 8.0;

@group(0) @binding(0) var<storage, read> elements: array<ContactElement>;
@group(0) @binding(1) var<storage, read> velocities: array<Packed3>;
@group(0) @binding(2) var<storage, read> start_velocities: array<Packed3>;
@group(0) @binding(3) var<storage, read_write> records: array<vec4<f32>>;
@group(0) @binding(4) var<uniform> params: ContactParams;

@compute @workgroup_size(WORKGROUP)
fn contact(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let e = global_index(id, groups);
    if (e >= params.count) {
        return;
    }
    let element = elements[e];
    let dt = params.step_s;
    var u = vec3<f32>(0.0);
    var u_start = vec3<f32>(0.0);
    var cloth = 0.0;
    for (var a = 0u; a < 4u; a++) {
        let v = elements[e].vertices[a];
        if (v != NO_VERTEX) {
            u += unpacked(velocities[v]) * elements[e].weights[a];
            u_start += unpacked(start_velocities[v]) * elements[e].weights[a];
            cloth += select(0.0, elements[e].weights[a], v < params.rows);
        }
    }
    let n = element.normal;
    let un = dot(n, u);
    let h = element.thickness_m;
    let k = element.stiffness_n_m;
    let ratio = params.stiffness_ratio;
    let least = LEAST_GAP * h;
    // The gap at the end of the step if velocities stay, and where the force is linearized.
    let free = element.distance_m + dt * un;
    let b = ratio * h - free;
    let stopped = 0.5 * (sqrt(b * b + 4.0 * ratio * h * h) - b);
    var at_gap = clamp(free, least, h);
    var impact = false;
    if (params.at_end == 0u) {
        let start = clamp(element.distance_m, least, h);
        impact = stopped < start;
        at_gap = min(start, stopped);
    }
    let force = k * h * (h - at_gap) / at_gap;
    let slope = k * (h / at_gap) * (h / at_gap);
    let push = force + slope * (at_gap - free);
    let at = e * 3u;
    let falls = free + cloth * dot(n, params.fall_m);
    if (!(force + slope * (at_gap - falls) > 0.0)) {
        records[at] = vec4<f32>(0.0);
        records[at + 1u] = vec4<f32>(0.0);
        records[at + 2u] = vec4<f32>(0.0);
        return;
    }
    let ut = u - n * un;
    let mass = dt * dt * k / ratio;
    let slip = sqrt(dot(ut, ut));
    let drag = dt * (element.friction * select(max(push, 0.0), force, impact) / max(slip, STICK_SPEED_M_S));
    let before = u_start - n * dot(n, u_start);
    let slides = params.at_end != 0u && slip > max(sqrt(dot(before, before)), STICK_SPEED_M_S);
    let beta = select(drag * min(SHARING * drag / mass, 1.0), 0.0, slides);
    records[at] = element.weights;
    records[at + 1u] = vec4<f32>(n, dt * dt * slope);
    records[at + 2u] = vec4<f32>(beta, n * (dt * push) - ut * drag);
}
