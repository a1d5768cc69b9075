// Pictures of triangle meshes: perspective, nearest surface, two-sided shading, a background with a ground grid.
// Every pixel has 2x2 samples, shaded one by one in linear light; `resolve` averages them and encodes sRGB.
// twin ../output/picture/shade.rs

struct DrawLook {
    eye: vec4<f32>,
    right: vec4<f32>,
    up: vec4<f32>,
    forward: vec4<f32>,
    world_up: vec4<f32>,
    key_light: vec4<f32>,
    fill_light: vec4<f32>,
    sky_top: vec4<f32>,
    sky_bottom: vec4<f32>,
    // Half the width and height of the picture at distance 1; samples per row and rows of samples.
    half_and_samples: vec4<f32>,
    // Height of the ground; distance of its grid's lines; 1 = there is a ground; 1 = cloth shows its direction.
    ground: vec4<f32>,
    // x: depth where surfaces begin; y: a texel of a light's map, meters; z: 1 = there are maps.
    near: vec4<f32>,
    // Column and row of a point in a light's map, and its height towards the light: with its coordinates and 1.
    light_columns: array<vec4<f32>, 64>,
    light_rows: array<vec4<f32>, 64>,
    light_heights: array<vec4<f32>, 64>,
}

struct DrawTile {
    // Clip coordinates of the tile from those of the whole picture.
    clip_scale: vec2<f32>,
    clip_shift: vec2<f32>,
    // First sample of the tile, right and down.
    first: vec2<f32>,
    pad: vec2<f32>,
}

@group(0) @binding(0) var<uniform> look: DrawLook;
@group(0) @binding(1) var<uniform> tile: DrawTile;
@group(0) @binding(2) var samples: texture_2d<f32>;
@group(0) @binding(3) var<storage, read> maps: array<f32>;

const LIGHTS: u32 = 64u;
const LIGHTS_OF_KEY: u32 = 24u;
const LIGHT_SIDE: u32 = 384u;

struct Corner {
    @builtin(position) clip: vec4<f32>,
    @location(0) normal: vec3<f32>,
    @location(1) point: vec3<f32>,
    @location(2) front: vec3<f32>,
    @location(3) back: vec3<f32>,
    @location(4) @interpolate(flat) cloth: u32,
}

@vertex
fn surface_corner(
    @location(0) position: vec3<f32>,
    @location(1) normal: vec3<f32>,
    @location(2) front: vec3<f32>,
    @location(3) back: vec3<f32>,
    @location(4) cloth: u32,
) -> Corner {
    let p = position - look.eye.xyz;
    let depth = dot(p, look.forward.xyz);
    let x = dot(p, look.right.xyz) / look.half_and_samples.x;
    let y = dot(p, look.up.xyz) / look.half_and_samples.y;
    let clip = vec2<f32>(x, y) * tile.clip_scale + depth * tile.clip_shift;
    var corner: Corner;
    // z / w = near / depth: the nearest surface has the largest value, and floats are finest far away.
    corner.clip = vec4<f32>(clip, look.near.x, depth);
    corner.normal = normal;
    corner.point = position;
    corner.front = front;
    corner.back = back;
    corner.cloth = cloth;
    return corner;
}

// A triangle that covers the whole target, at the far end.
@vertex
fn screen_corner(@builtin(vertex_index) index: u32) -> @builtin(position) vec4<f32> {
    return vec4<f32>(f32(index & 1u) * 4.0 - 1.0, f32(index >> 1u) * 4.0 - 1.0, 0.0, 1.0);
}

// Place in the picture, right and down from -1 to 1.
fn place(position: vec4<f32>) -> vec2<f32> {
    return 2.0 * (position.xy + tile.first) / look.half_and_samples.zw - 1.0;
}

// Direction (depth 1) of the ray through a place of the picture.
fn ray_through(at: vec2<f32>) -> vec3<f32> {
    let half = look.half_and_samples.xy;
    return look.forward.xyz + look.right.xyz * (at.x * half.x) - look.up.xyz * (at.y * half.y);
}

@fragment
fn surface(corner: Corner, @builtin(front_facing) front: bool) -> @location(0) vec4<f32> {
    let ray = ray_through(place(corner.clip));
    var normal = look.world_up.xyz;
    let length = length(corner.normal);
    if length > 0.0 {
        normal = corner.normal / length;
    }
    if !front {
        normal = -normal;
    }
    if corner.cloth == 1u && look.ground.w == 1.0 {
        let seen = vec3<f32>(
            dot(normal, look.right.xyz),
            dot(normal, look.up.xyz),
            -dot(normal, look.forward.xyz),
        );
        return vec4<f32>(pow(max(seen * 0.5 + 0.5, vec3<f32>(0.0)), vec3<f32>(2.2)), 1.0);
    }
    var albedo = corner.front;
    if !front {
        albedo = corner.back;
    }
    let light = light_reaching(corner.point, normal);
    return vec4<f32>(lit(albedo, normal, -normalize(ray), light), 1.0);
}

// Light of the sky (x) and of the main light (y) that reaches a point of a surface.
fn light_reaching(point: vec3<f32>, normal: vec3<f32>) -> vec2<f32> {
    let lit_from = vec4<f32>(point + normal * look.near.y, 1.0);
    var sky = 0.0;
    var key = 0.0;
    for (var light = 0u; light < LIGHTS; light++) {
        let cosine = dot(normal, look.light_heights[light].xyz);
        if cosine > 0.0 {
            let share = cosine * open(light, lit_from);
            if light < LIGHTS_OF_KEY {
                key += share;
            } else {
                sky += share;
            }
        }
    }
    return vec2<f32>(2.0 * sky / f32(LIGHTS - LIGHTS_OF_KEY), key / f32(LIGHTS_OF_KEY));
}

// Share of a light that reaches a point: blended over the four texels around it.
fn open(light: u32, point: vec4<f32>) -> f32 {
    if look.near.z != 1.0 {
        return 1.0;
    }
    let column = dot(look.light_columns[light], point) - 0.5;
    let row = dot(look.light_rows[light], point) - 0.5;
    let last = f32(LIGHT_SIDE - 1u);
    if !(column >= 0.0 && row >= 0.0 && column < last && row < last) {
        return 1.0;
    }
    let left = floor(column);
    let top = floor(row);
    let first = (light * LIGHT_SIDE + u32(top)) * LIGHT_SIDE + u32(left);
    let height = dot(look.light_heights[light], point) + 0.5 * look.near.y;
    let upper = mix(above(first, height), above(first + 1u, height), column - left);
    let lower = mix(above(first + LIGHT_SIDE, height), above(first + LIGHT_SIDE + 1u, height), column - left);
    return mix(upper, lower, row - top);
}

fn above(texel: u32, height: f32) -> f32 {
    return clamp(1.0 + (height - maps[texel]) / look.near.y, 0.0, 1.0);
}

fn lit(albedo: vec3<f32>, normal: vec3<f32>, view: vec3<f32>, light: vec2<f32>) -> vec3<f32> {
    let level = dot(normal, look.world_up.xyz);
    let toward = dot(normal, look.key_light.xyz);
    let around = 0.5 + 0.5 * toward;
    let open_sky = 0.25 + 0.75 * min(light.x / max(0.5 + 0.5 * level, 0.05), 1.0);
    let fill = 0.14 * max(dot(normal, look.fill_light.xyz), 0.0);
    let bounced = 0.10 * (0.5 - 0.5 * level);
    let diffuse = 0.04 + 0.31 * light.x + 0.66 * light.y + (0.26 * around * around + fill + bounced) * open_sky;
    let reached = min(light.y / max(toward, 0.05), 1.0);
    let halfway = normalize(look.key_light.xyz + view);
    let gloss = 0.06 * pow(max(dot(normal, halfway), 0.0), 18.0) * reached;
    let grazing = 1.0 - min(abs(dot(normal, view)), 1.0);
    let rim = 0.10 * grazing * grazing * grazing * grazing * open_sky;
    return albedo * diffuse + vec3<f32>(gloss) + (albedo * 0.5 + 0.5) * rim;
}

// Brightness of the ground where this light reaches it, of the brightness in the open.
fn ground_light(light: vec2<f32>) -> f32 {
    let open_sky = min(light.x, 1.0);
    let open_key = min(light.y / max(dot(look.world_up.xyz, look.key_light.xyz), 0.05), 1.0);
    return 0.30 + 0.42 * open_sky + 0.28 * open_key;
}

// A light gradient, and below the horizon a grid on the ground that fades into the distance.
@fragment
fn background(@builtin(position) position: vec4<f32>) -> @location(0) vec4<f32> {
    let at = place(position);
    let sky = mix(look.sky_top.xyz, look.sky_bottom.xyz, 0.5 * at.y + 0.5);
    let ray = ray_through(at);
    let fall = dot(ray, look.world_up.xyz);
    let above = dot(look.eye.xyz, look.world_up.xyz) - look.ground.x;
    if look.ground.z != 1.0 || fall >= -1e-4 || above <= 0.0 {
        return vec4<f32>(sky, 1.0);
    }
    let grid = look.ground.y;
    let distance = -above / fall;
    let point = look.eye.xyz + ray * distance;
    let line = 4.0 * distance * look.half_and_samples.x / look.half_and_samples.z;
    let crowded = line / grid * max(distance / above, 1.0);
    let fade = max(1.0 - 2.0 * crowded, 0.0);
    var ground = point.xz;
    if look.world_up.z == 1.0 {
        ground = point.xy;
    }
    let off = abs(ground / grid - floor(ground / grid + 0.5)) * grid;
    var strength = 0.0;
    if min(off.x, off.y) < 0.5 * line {
        strength = 0.25 * fade;
    }
    return vec4<f32>(sky * (1.0 - strength) * ground_light(light_reaching(point, look.world_up.xyz)), 1.0);
}

@fragment
fn resolve(@builtin(position) position: vec4<f32>) -> @location(0) vec4<f32> {
    let first = vec2<i32>(position.xy) * 2;
    var sum = vec4<f32>(0.0);
    for (var i = 0; i < 4; i++) {
        sum += textureLoad(samples, first + vec2<i32>(i & 1, i >> 1), 0);
    }
    return 0.25 * sum;
}
