// Stretch and air elements: one triangle record per triangle; stretch.rs explains the record, stretch_cpu.rs the
// physics.
// needs element.wgsl
// needs limit.wgsl

@group(0) @binding(0) var<storage, read> fabrics: array<FabricTable>;
@group(0) @binding(1) var<storage, read> elements: array<TriangleElement>;
@group(0) @binding(2) var<storage, read> positions: array<Packed3>;
@group(0) @binding(3) var<storage, read> velocities: array<Packed3>;
@group(0) @binding(4) var<storage, read_write> records: array<vec4<f32>>;
@group(0) @binding(5) var<uniform> params: StepParams;

// Stiffness (warp, cross, weft, shear; N/m) at the Green strain, clamped so that it is positive semidefinite.
fn stretch_stiffness(fabric: u32, uu: f32, vv: f32, uv: f32) -> vec4<f32> {
    let mean = uu + vv;
    let half = uu - vv;
    let radius = sqrt(half * half + 4.0 * uv * uv);
    let stretch = sqrt(max(1.0 + (mean + radius), 0.0)) - 1.0;
    let weight = clamp(stretch * 6.0, 0.0, 1.0);
    let angle = 0.5 * angle_of(abs(2.0 * uv), half);
    let position = clamp(angle * 2.5464791, 0.0, 4.0);
    let row = min(u32(position), 3u);
    let along = position - f32(row);
    let strained = fabrics[fabric].stretching[1u + row] * (1.0 - along) + fabrics[fabric].stretching[2u + row] * along;
    let k = fabrics[fabric].stretching[0] * (1.0 - weight) + strained * weight;
    let warp = max(k.x, 0.0);
    let weft = max(k.z, 0.0);
    let bound = 0.99 * sqrt(warp * weft);
    return vec4<f32>(warp, clamp(k.y, -bound, bound), weft, max(k.w, 0.0));
}

// Positive semidefinite part of [[uu, uv], [uv, vv]].
fn positive_part(uu: f32, uv: f32, vv: f32) -> vec3<f32> {
    let mean = 0.5 * (uu + vv);
    let half = 0.5 * (uu - vv);
    let radius = sqrt(half * half + uv * uv);
    let largest = mean + radius;
    let smallest = mean - radius;
    if (smallest >= 0.0) {
        return vec3<f32>(uu, uv, vv);
    }
    if (largest <= 0.0) {
        return vec3<f32>(0.0);
    }
    return vec3<f32>(uu - smallest, uv, vv - smallest) * (largest / (2.0 * radius));
}

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
fn stretch(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let e = global_index(id, groups);
    if (e >= params.count) {
        return;
    }
    let element = elements[e];
    let x0 = unpacked(positions[element.vertices[0]]);
    let d1 = unpacked(positions[element.vertices[1]]) - x0;
    let d2 = unpacked(positions[element.vertices[2]]) - x0;
    let v0 = unpacked(velocities[element.vertices[0]]);
    let v1 = unpacked(velocities[element.vertices[1]]);
    let v2 = unpacked(velocities[element.vertices[2]]);
    let dt = params.step_s;
    let area = element.area_m2;
    let damping = fabrics[element.fabric].damping_s;

    let xu = d1 * element.weights_u.x + d2 * element.weights_u.y;
    let xv = d1 * element.weights_v.x + d2 * element.weights_v.y;
    let uu = 0.5 * (dot(xu, xu) - 1.0);
    let vv = 0.5 * (dot(xv, xv) - 1.0);
    let uv = 0.5 * dot(xu, xv);
    let k = stretch_stiffness(element.fabric, uu, vv, uv) / (1.0 + element.damage) * element.stiffness;
    let warp = k.x;
    let cross_stiffness = k.y;
    let weft = k.z;
    let shear = k.w;
    var suu = warp * uu + cross_stiffness * vv;
    var svv = weft * vv + cross_stiffness * uu;
    var suv = 0.5 * shear * uv;
    let wu = (v1 - v0) * element.weights_u.x + (v2 - v0) * element.weights_u.y;
    let wv = (v1 - v0) * element.weights_v.x + (v2 - v0) * element.weights_v.y;
    // K w of a limit counts as far as its stress is not that of the end of the step, and it has no damping.
    var limits = vec3<f32>(0.0);
    var limits_ahead = vec3<f32>(0.0);
    if (fabrics[element.fabric].limit_stiffness > 0.0) {
        let found = limit_of(limits_of_fabric(element.fabric), xu, xv, wu, wv, params.ahead_s);
        suu += found.stress.x * element.stiffness;
        svv += found.stress.y * element.stiffness;
        suv += found.stress.z * element.stiffness;
        limits = found.plain * element.stiffness;
        limits_ahead = found.plain_ahead * element.stiffness;
    }
    let p = positive_part(suu, suv, svv);

    // K w: rate of the stress gradient along the velocity, for dt K v and the damping force.
    let quarter = 0.25 * shear;
    let shear_rate = quarter * (dot(xv, wu) + dot(xu, wv));
    let ku = xu * (warp * dot(xu, wu) + cross_stiffness * dot(xv, wv)) + xv * shear_rate + wu * p.x + wv * p.y;
    let kv = xv * (weft * dot(xv, wv) + cross_stiffness * dot(xu, wu)) + xu * shear_rate + wv * p.z + wu * p.y;
    let rate = params.ahead_s + damping;
    var pu = (xu * suu + xv * suv + ku * rate) * area;
    var pv = (xu * suv + xv * svv + kv * rate) * area;
    let limit_shear = limits_ahead.z * (dot(xv, wu) + dot(xu, wv));
    pu += (xu * (limits_ahead.x * dot(xu, wu)) + xv * limit_shear) * area;
    pv += (xv * (limits_ahead.y * dot(xv, wv)) + xu * limit_shear) * area;

    // Air: pressure and tangential drag, each corner a third.
    let normal = cross(xu, xv);
    let length2 = dot(normal, normal);
    var n = vec3<f32>(0.0);
    if (length2 > 0.0) {
        n = normal / sqrt(length2);
    }
    let relative = params.wind - (v0 + v1 + v2) * (1.0 / 3.0);
    let vn = dot(relative, n);
    let tangential = relative - n * vn;
    let air = (n * (params.air_density * abs(vn) * vn) + tangential * params.air_drag) * (area * (1.0 / 3.0))
        + normal * (element.pressure_pa * area * (1.0 / 3.0));
    let air_normal = dt * area * 2.0 * params.air_density * abs(vn) * (1.0 / 9.0);
    let air_tangent = dt * area * params.air_drag * (1.0 / 9.0);

    let h = dt * (dt + damping) * area;
    let at = e * 6u;
    records[at] = vec4<f32>(xu, h * (warp + limits.x));
    records[at + 1u] = vec4<f32>(xv, h * cross_stiffness);
    records[at + 2u] = vec4<f32>(h * (weft + limits.y), h * (quarter + limits.z), h * p.x, h * p.y);
    records[at + 3u] = vec4<f32>(h * p.z, air_normal, air_tangent, air.x);
    records[at + 4u] = vec4<f32>(pu, air.y);
    records[at + 5u] = vec4<f32>(pv, air.z);
}
