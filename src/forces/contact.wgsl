// Contact elements: one record per contact; contact.rs explains the record, contact_cpu.rs the friction.

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
    step_s: f32,
    count: u32,
    stiffness_ratio: f32,
    padding: f32,
}

const NO_VERTEX: u32 = 0xffffffffu;
const STICK_SPEED_M_S: f32 = 1e-3;
const FACET_SLOPE: f32 = 0.1;
const RELEASE_STEPS: f32 = 10.0;
const SHARING: f32 = 8.0;

@group(0) @binding(0) var<storage, read> elements: array<ContactElement>;
@group(0) @binding(1) var<storage, read> velocities: array<Packed3>;
@group(0) @binding(2) var<storage, read_write> records: array<vec4<f32>>;
@group(0) @binding(3) var<uniform> params: ContactParams;

@compute @workgroup_size(WORKGROUP)
fn contact(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let e = global_index(id, groups);
    if (e >= params.count) {
        return;
    }
    let element = elements[e];
    let dt = params.step_s;
    var u = vec3<f32>(0.0);
    for (var a = 0u; a < 4u; a++) {
        let v = elements[e].vertices[a];
        if (v != NO_VERTEX) {
            u += unpacked(velocities[v]) * elements[e].weights[a];
        }
    }
    let n = element.normal;
    let un = dot(n, u);
    let depth = element.thickness_m - element.distance_m;
    let release = RELEASE_STEPS * dt;
    let at = e * 3u;
    // A depth below zero is a contact that the motion will close.
    if (!(depth - dt * un > 0.0)) {
        records[at] = vec4<f32>(0.0);
        records[at + 1u] = vec4<f32>(0.0);
        records[at + 2u] = vec4<f32>(0.0);
        return;
    }
    let k = element.stiffness_n_m;
    let ut = u - n * un;
    let mass = dt * dt * k / params.stiffness_ratio;
    let before = depth + dt * un;
    let slip = sqrt(dot(ut, ut));
    var normal_force = mass * ((min(depth, 0.0) - dt * un) / (dt * dt));
    if (before > 0.0) {
        let parting = max(un, 0.0) + min(un + FACET_SLOPE * slip, 0.0);
        normal_force = k * max(before - release * parting, 0.0);
    }
    let drag = dt * (element.friction * normal_force / max(slip, STICK_SPEED_M_S));
    let beta = drag * min(SHARING * drag / mass, 1.0);
    let g = n * (dt * k * (select(RELEASE_STEPS, 1.0, depth > 0.0) * depth - release * un)) - ut * drag;
    records[at] = element.weights;
    records[at + 1u] = vec4<f32>(n, dt * release * k);
    records[at + 2u] = vec4<f32>(beta, g);
}
