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
}

const NO_VERTEX: u32 = 0xffffffffu;
const STICK_SPEED_M_S: f32 = 1e-3;

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
    let predicted = depth - dt * un;
    let at = e * 3u;
    // A depth below zero is a contact that the motion will close.
    if (!(predicted > 0.0)) {
        records[at] = vec4<f32>(0.0);
        records[at + 1u] = vec4<f32>(0.0);
        records[at + 2u] = vec4<f32>(0.0);
        return;
    }
    let k = element.stiffness_n_m;
    let ut = u - n * un;
    let friction = element.friction * (k * max(min(depth, predicted), 0.0));
    let beta = dt * (friction / max(sqrt(dot(ut, ut)), STICK_SPEED_M_S));
    let g = n * (dt * k * predicted) - ut * beta;
    records[at] = element.weights;
    records[at + 1u] = vec4<f32>(n, dt * dt * k);
    records[at + 2u] = vec4<f32>(beta, g);
}
