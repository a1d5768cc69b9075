// Elements and fabrics as element.rs declares them, and what both element kernels share.

struct TriangleElement {
    vertices: array<u32, 3>,
    fabric: u32,
    weights_u: vec2<f32>,
    weights_v: vec2<f32>,
    area_m2: f32,
    damage: f32,
    pressure_pa: f32,
    stiffness: f32,
}

struct HingeElement {
    vertices: vec4<u32>,
    shape: f32,
    curvature_from_angle: f32,
    rest_angle: f32,
    plastic_curvature: f32,
    bias: vec2<f32>,
    fabric: vec2<u32>,
}

struct FabricTable {
    stretching: array<vec4<f32>, 6>,
    bending: array<f32, 15>,
    damping_s: f32,
    yield_curvature: f32,
    hardening: f32,
    weakening: f32,
    // Not a vec2: it would be aligned to 8 bytes.
    strain_limit: array<f32, 2>,
    warp_limit: array<f32, 2>,
    weft_limit: array<f32, 2>,
    shear_limit: f32,
    limit_stiffness: f32,
    yield_strain: f32,
}

struct StepParams {
    step_s: f32,
    air_density: f32,
    air_drag: f32,
    count: u32,
    wind: vec3<f32>,
    // See StepParams::ahead_s in element.rs.
    ahead_s: f32,
}

// atan2 within 2e-7; WGSL's own may be off by 4096 units in the last place. Range reduction to tan(pi/8), then the
// Chebyshev interpolation of atan(x)/x in x^2.
fn angle_of(y: f32, x: f32) -> f32 {
    let large = max(abs(x), abs(y));
    let small = min(abs(x), abs(y));
    if (large == 0.0) {
        return 0.0;
    }
    var t = small / large;
    var base = 0.0;
    if (t > 0.41421356) {
        t = (small - large) / (small + large);
        base = 0.78539816;
    }
    let z = t * t;
    var angle = base + t * (0.99999998 + z * (-0.33332786 + z * (0.19974082 + z * (-0.13848490 + z * 0.079762918))));
    if (abs(y) > abs(x)) {
        angle = 1.57079633 - angle;
    }
    if (x < 0.0) {
        angle = 3.14159265 - angle;
    }
    return select(angle, -angle, y < 0.0);
}
