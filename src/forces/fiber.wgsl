// Fibers of strain limits: one record like that of a hinge per triangle; fiber.rs explains it.
// needs element.wgsl
// needs limit.wgsl

@group(0) @binding(0) var<storage, read> fabrics: array<FabricTable>;
@group(0) @binding(1) var<storage, read> elements: array<TriangleElement>;
@group(0) @binding(2) var<storage, read> positions: array<Packed3>;
@group(0) @binding(3) var<storage, read> velocities: array<Packed3>;
@group(0) @binding(4) var<storage, read_write> records: array<vec4<f32>>;
@group(0) @binding(5) var<uniform> params: StepParams;

// What a fabric says of limits.
fn limits_of_fabric(fabric: u32) -> LimitTable {
    return LimitTable(
        vec2<f32>(fabrics[fabric].strain_limit[0], fabrics[fabric].strain_limit[1]),
        vec2<f32>(fabrics[fabric].warp_limit[0], fabrics[fabric].warp_limit[1]),
        vec2<f32>(fabrics[fabric].weft_limit[0], fabrics[fabric].weft_limit[1]),
        fabrics[fabric].shear_limit,
        fabrics[fabric].limit_stiffness,
    );
}

@compute @workgroup_size(WORKGROUP)
fn fiber(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let e = global_index(id, groups);
    if (e >= params.count) {
        return;
    }
    let element = elements[e];
    var found = no_limit();
    let x0 = unpacked(positions[element.vertices[0]]);
    let d1 = unpacked(positions[element.vertices[1]]) - x0;
    let d2 = unpacked(positions[element.vertices[2]]) - x0;
    let v0 = unpacked(velocities[element.vertices[0]]);
    let w1 = unpacked(velocities[element.vertices[1]]) - v0;
    let w2 = unpacked(velocities[element.vertices[2]]) - v0;
    let wu = w1 * element.weights_u.x + w2 * element.weights_u.y;
    let wv = w1 * element.weights_v.x + w2 * element.weights_v.y;
    let xu = d1 * element.weights_u.x + d2 * element.weights_u.y;
    let xv = d1 * element.weights_v.x + d2 * element.weights_v.y;
    let table = limits_of_fabric(element.fabric);
    if (has_fibers(table)) {
        found = limit_of(table, xu, xv, wu, wv, params.ahead_s);
    }
    let stiffness = found.fiber * element.stiffness * element.area_m2;
    let d = found.direction * select(0.0, 1.0, found.fiber > 0.0);
    let f = xu * d.x + xv * d.y;
    let w = wu * d.x + wv * d.y;
    let g1 = element.weights_u.x * d.x + element.weights_v.x * d.y;
    let g2 = element.weights_u.y * d.x + element.weights_v.y * d.y;
    let at = e * 4u;
    records[at] = vec4<f32>(f * -(g1 + g2), params.step_s * params.step_s * stiffness);
    records[at + 1u] = vec4<f32>(f * g1, found.ahead_s * stiffness * dot(f, w));
    records[at + 2u] = vec4<f32>(f * g2, 0.0);
    records[at + 3u] = vec4<f32>(0.0);
}
