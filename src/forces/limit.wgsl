// What strain limits add to a triangle; fiber.rs explains it.

// Green strain beyond the limit from which on the slope of a fiber's stress does not grow.
const LIMIT_BEND: f32 = 0.0025;
// The matrix has at least this part of the largest slope of a fiber's stress.
const LIMIT_SLOPE_LEAST: f32 = 0.3;

struct Limit {
    // Second Piola stress uu, vv, uv, N/m: that of the state, or that of the end of the step.
    stress: vec3<f32>,
    // Stiffness along `direction`, N/m.
    fiber: f32,
    // Unit vector in material space.
    direction: vec2<f32>,
    // The stress of the fiber is that of this time before the end of the step, seconds.
    ahead_s: f32,
    // Stiffness of warp, weft and a quarter of that of shear, N/m.
    plain: vec3<f32>,
    // `plain` times the time before the end of the step that its stress is of, N s/m.
    plain_ahead: vec3<f32>,
}

// A stretch that no cloth reaches, as in element.rs.
const FREE: f32 = 1e6;

// What FabricTable in element.rs says of limits.
struct LimitTable {
    // Least and largest stretch.
    every: vec2<f32>,
    warp: vec2<f32>,
    weft: vec2<f32>,
    shear: f32,
    stiffness: f32,
}

fn has_fibers(table: LimitTable) -> bool {
    return table.stiffness > 0.0 && table.every.y < FREE;
}

// Stress of a fiber at the Green strain `beyond` its limit, and the slope that the matrix has.
fn fiber_law(stiffness: f32, beyond: f32) -> vec2<f32> {
    let bent = min(abs(beyond), LIMIT_BEND);
    let stress = sign(beyond) * stiffness * (bent / LIMIT_BEND) * (abs(beyond) - 0.5 * bent);
    let slope = stiffness * clamp(abs(beyond) / LIMIT_BEND, LIMIT_SLOPE_LEAST, 1.0);
    return vec2<f32>(stress, select(0.0, slope, beyond != 0.0));
}

fn beyond_of(value: f32, least: f32, most: f32) -> f32 {
    return 0.5 * (max(value - most, 0.0) + min(value - least, 0.0));
}

// Law at `now`, or at `ahead` if nothing is beyond now; its slope a second time where it is that of now.
fn law_of(stiffness: f32, now: f32, ahead: f32) -> vec3<f32> {
    if (now != 0.0) {
        let law = fiber_law(stiffness, now);
        return vec3<f32>(law, law.y);
    }
    return vec3<f32>(fiber_law(stiffness, ahead), 0.0);
}

// Limits of warp, weft and shear.
fn limit_by_direction(
    table: LimitTable,
    xu: vec3<f32>,
    xv: vec3<f32>,
    wu: vec3<f32>,
    wv: vec3<f32>,
    ahead_s: f32,
) -> Limit {
    let k = table.stiffness;
    let uu = dot(xu, xu);
    let vv = dot(xv, xv);
    let uv = dot(xu, xv);
    let warp2 = table.warp * table.warp;
    let weft2 = table.weft * table.weft;
    // The stretch of the threads counts as what it is now.
    let most = table.shear * sqrt(uu * vv);
    let uu_ahead = uu + 2.0 * ahead_s * dot(xu, wu);
    let vv_ahead = vv + 2.0 * ahead_s * dot(xv, wv);
    let uv_ahead = uv + ahead_s * (dot(xu, wv) + dot(xv, wu));
    let of_warp = law_of(k, beyond_of(uu, warp2.x, warp2.y), beyond_of(uu_ahead, warp2.x, warp2.y));
    let of_weft = law_of(k, beyond_of(vv, weft2.x, weft2.y), beyond_of(vv_ahead, weft2.x, weft2.y));
    let of_shear = law_of(k, beyond_of(uv, -most, most), beyond_of(uv_ahead, -most, most));
    var found = no_limit();
    found.stress = vec3<f32>(of_warp.x, of_weft.x, 0.5 * of_shear.x);
    found.plain = vec3<f32>(of_warp.y, of_weft.y, 0.25 * of_shear.y);
    found.plain_ahead = vec3<f32>(of_warp.z, of_weft.z, 0.25 * of_shear.z) * ahead_s;
    return found;
}

fn no_limit() -> Limit {
    return Limit(vec3<f32>(0.0), 0.0, vec2<f32>(1.0, 0.0), 0.0, vec3<f32>(0.0), vec3<f32>(0.0));
}

// Mean and half the difference of the squares of x_u and x_v, their product, and the radius of Mohr's circle.
fn squares_of(uu: f32, vv: f32, uv: f32) -> vec4<f32> {
    let half = 0.5 * (uu - vv);
    return vec4<f32>(0.5 * (uu + vv), half, uv, sqrt(half * half + uv * uv));
}

// The limits of a triangle with the deformation x_u, x_v and its rate w_u, w_v, `ahead_s` after the state.
fn limit_of(
    table: LimitTable,
    xu: vec3<f32>,
    xv: vec3<f32>,
    wu: vec3<f32>,
    wv: vec3<f32>,
    ahead_s: f32,
) -> Limit {
    if (!has_fibers(table)) {
        return limit_by_direction(table, xu, xv, wu, wv, ahead_s);
    }
    let least = table.every.x * table.every.x;
    let most = table.every.y * table.every.y;
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
    var stiffness = 0.0;
    for (var i = 0u; i < 2u; i++) {
        let s = select(squared.y, squared.x, i == 0u);
        let d = select(vec2<f32>(-first.y, first.x), first, i == 0u);
        if (s > most || s < least) {
            beyond += 1u;
            let e = 0.5 * (s - select(least, most, s > most));
            let law = fiber_law(table.stiffness, e);
            stiffness = max(stiffness, law.y);
            found.stress += law.x * vec3<f32>(d.x * d.x, d.y * d.y, d.x * d.y);
            found.direction = d;
        }
    }
    if (beyond == 2u) {
        found.plain = vec3<f32>(stiffness, stiffness, 0.5 * stiffness);
        found.plain_ahead = found.plain * found.ahead_s;
    } else {
        found.fiber = stiffness;
    }
    return found;
}
