// Plastic stretching: the return map of every triangle, and its damage; plastic_stretch.rs explains it.
// needs element.wgsl

struct PlasticTriangle {
    weights_u: vec2<f32>,
    weights_v: vec2<f32>,
    // Not a vec3: it would be aligned to 16 bytes.
    stretch: array<f32, 3>,
    plastic_strain: f32,
    hinges: array<u32, 3>,
    padding: u32,
}

struct PlasticParams {
    count: u32,
    moves: u32,
}

// Largest principal value of a rest stretch; the smallest one is its inverse.
const STRETCH_MOST: f32 = 3.0;
// Least square of a stretch that is told from none.
const SQUARED_LEAST: f32 = 1e-4;
const NO_HINGE: u32 = 0xffffffffu;

@group(0) @binding(0) var<storage, read> fabrics: array<FabricTable>;
@group(0) @binding(1) var<storage, read> positions: array<Packed3>;
@group(0) @binding(2) var<storage, read> hinge_damage: array<f32>;
@group(0) @binding(3) var<storage, read_write> plastic: array<PlasticTriangle>;
@group(0) @binding(4) var<storage, read_write> elements: array<TriangleElement>;
@group(0) @binding(5) var<uniform> params: PlasticParams;

// Principal values of a symmetric matrix (uu, vv, uv), the larger one first, and the direction of that.
fn principal(m: vec3<f32>) -> vec4<f32> {
    let mean = 0.5 * (m.x + m.y);
    let half = 0.5 * (m.x - m.y);
    let radius = sqrt(half * half + m.z * m.z);
    let wide = select(vec2<f32>(m.z, radius - half), vec2<f32>(half + radius, m.z), half >= 0.0);
    let length2 = dot(wide, wide);
    var d = vec2<f32>(1.0, 0.0);
    if (length2 > 0.0) {
        d = wide / sqrt(length2);
    }
    return vec4<f32>(mean + radius, mean - radius, d);
}

// The symmetric matrix with the principal values `first` along d and `second` across it.
fn of_principal(first: f32, second: f32, d: vec2<f32>) -> vec3<f32> {
    return vec3<f32>(
        first * d.x * d.x + second * d.y * d.y,
        first * d.y * d.y + second * d.x * d.x,
        (first - second) * d.x * d.y,
    );
}

// Strains that are beyond the yield surface, for strains with these sizes; zero if nothing yields.
fn excess_of(sizes: vec2<f32>, yield_strain: f32, hardening: f32, plastic_strain: f32) -> vec2<f32> {
    let larger = max(sizes.x, sizes.y);
    let smaller = min(sizes.x, sizes.y);
    if (larger <= yield_strain + hardening * plastic_strain) {
        return vec2<f32>(0.0);
    }
    var surface = (yield_strain + hardening * (plastic_strain + larger)) / (1.0 + hardening);
    if (smaller > surface) {
        surface = (yield_strain + hardening * (plastic_strain + larger + smaller)) / (1.0 + 2.0 * hardening);
    }
    return max(sizes - surface, vec2<f32>(0.0));
}

@compute @workgroup_size(WORKGROUP)
fn plastic_stretch(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let i = global_index(id, groups);
    if (i >= params.count) {
        return;
    }
    let fabric = elements[i].fabric;
    let yield_strain = fabrics[fabric].yield_strain;
    var damage = 0.0;
    if (yield_strain > 0.0) {
        if (params.moves != 0u) {
            let x0 = unpacked(positions[elements[i].vertices[0]]);
            let d1 = unpacked(positions[elements[i].vertices[1]]) - x0;
            let d2 = unpacked(positions[elements[i].vertices[2]]) - x0;
            let xu = d1 * elements[i].weights_u.x + d2 * elements[i].weights_u.y;
            let xv = d1 * elements[i].weights_v.x + d2 * elements[i].weights_v.y;
            let squared = principal(vec3<f32>(dot(xu, xu), dot(xv, xv), dot(xu, xv)));
            let strains = 0.5 * log(max(squared.xy, vec2<f32>(SQUARED_LEAST)));
            let hardening = fabrics[fabric].hardening;
            let excess = excess_of(abs(strains), yield_strain, hardening, plastic[i].plastic_strain);
            if (excess.x > 0.0 || excess.y > 0.0) {
                let twice = exp(2.0 * sign(strains) * excess);
                let a = of_principal(twice.x, twice.y, squared.zw);
                let u = vec3<f32>(plastic[i].stretch[0], plastic[i].stretch[1], plastic[i].stretch[2]);
                // The rows of A^2 U, then U A^2 U.
                let row0 = vec2<f32>(a.x * u.x + a.z * u.z, a.x * u.z + a.z * u.y);
                let row1 = vec2<f32>(a.z * u.x + a.y * u.z, a.z * u.z + a.y * u.y);
                let m = vec3<f32>(
                    u.x * row0.x + u.z * row1.x,
                    u.z * row0.y + u.y * row1.y,
                    u.x * row0.y + u.z * row1.y,
                );
                let p = principal(m);
                let found = sqrt(max(p.xy, vec2<f32>(0.0)));
                let roots = clamp(found, vec2<f32>(1.0 / STRETCH_MOST), vec2<f32>(STRETCH_MOST));
                let moved = of_principal(roots.x, roots.y, p.zw);
                plastic[i].stretch[0] = moved.x;
                plastic[i].stretch[1] = moved.y;
                plastic[i].stretch[2] = moved.z;
                plastic[i].plastic_strain += excess.x + excess.y;
            }
        }
        let u = vec3<f32>(plastic[i].stretch[0], plastic[i].stretch[1], plastic[i].stretch[2]);
        let inverse = vec3<f32>(u.y, u.x, -u.z) / (u.x * u.y - u.z * u.z);
        let w = plastic[i].weights_u;
        let v = plastic[i].weights_v;
        elements[i].weights_u = w * inverse.x + v * inverse.z;
        elements[i].weights_v = w * inverse.z + v * inverse.y;
        damage = plastic[i].plastic_strain / yield_strain;
    }
    let weakening = fabrics[fabric].weakening;
    if (weakening > 0.0) {
        var of_hinges = 0.0;
        for (var side = 0u; side < 3u; side++) {
            let hinge = plastic[i].hinges[side];
            if (hinge != NO_HINGE) {
                of_hinges = max(of_hinges, hinge_damage[hinge]);
            }
        }
        elements[i].damage = weakening * (damage + of_hinges);
    }
}
