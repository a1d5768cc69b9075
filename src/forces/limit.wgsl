// What strain limits add to a triangle; fiber.rs explains it.

// Green strain beyond the limit from which on the slope of a fiber's stress does not grow.
const LIMIT_BEND: f32 = 0.0025;

struct Limit {
    // Second Piola stress uu, vv, uv, N/m: that of the state, or that of the end of the step.
    stress: vec3<f32>,
    // Stiffness along `direction`, N/m.
    fiber: f32,
    // Unit vector in material space.
    direction: vec2<f32>,
    // Stiffness in every direction, N/m.
    isotropic: f32,
    // The stress is that of this time before the end of the step, seconds.
    ahead_s: f32,
}

fn no_limit() -> Limit {
    return Limit(vec3<f32>(0.0), 0.0, vec2<f32>(1.0, 0.0), 0.0, 0.0);
}

// Mean and half the difference of the squares of x_u and x_v, their product, and the radius of Mohr's circle.
fn squares_of(uu: f32, vv: f32, uv: f32) -> vec4<f32> {
    let half = 0.5 * (uu - vv);
    return vec4<f32>(0.5 * (uu + vv), half, uv, sqrt(half * half + uv * uv));
}

// The limits (least and largest stretch) of a triangle with the deformation x_u, x_v and its rate w_u, w_v, `ahead_s`
// after the state.
fn limit_of(
    limits: vec2<f32>,
    limit_stiffness: f32,
    xu: vec3<f32>,
    xv: vec3<f32>,
    wu: vec3<f32>,
    wv: vec3<f32>,
    ahead_s: f32,
) -> Limit {
    let least = limits.x * limits.x;
    let most = limits.y * limits.y;
    let product = dot(xu, xv);
    var at = squares_of(dot(xu, xu), dot(xv, xv), product);
    var found = no_limit();
    found.ahead_s = ahead_s;
    if (at.x + at.w <= most && at.x - at.w >= least) {
        // To first order: with the square of the rate, a triangle that turns would seem to stretch.
        let uu = dot(xu, xu) + 2.0 * ahead_s * dot(xu, wu);
        let vv = dot(xv, xv) + 2.0 * ahead_s * dot(xv, wv);
        at = squares_of(uu, vv, product + ahead_s * (dot(xu, wv) + dot(xv, wu)));
        found.ahead_s = 0.0;
        if (at.x + at.w <= most && at.x - at.w >= least) {
            return found;
        }
    }
    let half = at.y;
    let uv = at.z;
    let radius = at.w;
    let squared = vec2<f32>(at.x + radius, at.x - radius);
    let wide = select(vec2<f32>(uv, radius - half), vec2<f32>(half + radius, uv), half >= 0.0);
    let length2 = dot(wide, wide);
    var first = vec2<f32>(1.0, 0.0);
    if (length2 > 0.0) {
        first = wide / sqrt(length2);
    }
    var beyond = 0u;
    for (var i = 0u; i < 2u; i++) {
        let s = select(squared.y, squared.x, i == 0u);
        let d = select(vec2<f32>(-first.y, first.x), first, i == 0u);
        if (s > most || s < least) {
            beyond += 1u;
            let e = 0.5 * (s - select(least, most, s > most));
            let bent = min(abs(e), LIMIT_BEND);
            let stress = sign(e) * limit_stiffness * (bent / LIMIT_BEND) * (abs(e) - 0.5 * bent);
            found.stress += stress * vec3<f32>(d.x * d.x, d.y * d.y, d.x * d.y);
            found.direction = d;
        }
    }
    found.fiber = select(limit_stiffness, 0.0, beyond == 2u);
    found.isotropic = select(0.0, limit_stiffness, beyond == 2u);
    return found;
}
