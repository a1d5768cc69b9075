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
    // Lowest and highest height of the sequence; height of the ground; distance of the grid's lines.
    heights: vec4<f32>,
    // x: depth where surfaces begin; y, z, w: unused.
    near: vec4<f32>,
    // x: 0 = swatches, 1 = height, 2 = normal; y: first swatch that always shows its own color.
    coloring: vec4<u32>,
    fronts: array<vec4<f32>, 9>,
    backs: array<vec4<f32>, 9>,
    // Colors of heights, from low to high.
    scale: array<vec4<f32>, 5>,
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

struct Corner {
    @builtin(position) clip: vec4<f32>,
    @location(0) normal: vec3<f32>,
    @location(1) height: f32,
    @location(2) @interpolate(flat) swatch: u32,
}

@vertex
fn surface_corner(
    @location(0) position: vec3<f32>,
    @location(1) normal: vec3<f32>,
    @location(2) swatch: u32,
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
    corner.height = dot(position, look.world_up.xyz);
    corner.swatch = swatch;
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
    let own_color = corner.swatch >= look.coloring.y || look.coloring.x == 0u;
    if !own_color && look.coloring.x == 2u {
        let seen = vec3<f32>(
            dot(normal, look.right.xyz),
            dot(normal, look.up.xyz),
            -dot(normal, look.forward.xyz),
        );
        return vec4<f32>(pow(max(seen * 0.5 + 0.5, vec3<f32>(0.0)), vec3<f32>(2.2)), 1.0);
    }
    var albedo = look.fronts[corner.swatch].xyz;
    if !own_color {
        albedo = height_color((corner.height - look.heights.x) / max(look.heights.y - look.heights.x, 1e-9));
    } else if !front {
        albedo = look.backs[corner.swatch].xyz;
    }
    return vec4<f32>(lit(albedo, normal, -normalize(ray)), 1.0);
}

fn lit(albedo: vec3<f32>, normal: vec3<f32>, view: vec3<f32>) -> vec3<f32> {
    let sky = 0.5 + 0.5 * dot(normal, look.world_up.xyz);
    let toward = dot(normal, look.key_light.xyz);
    let around = 0.5 + 0.5 * toward;
    let key = 0.55 * max(toward, 0.0) + 0.50 * around * around;
    let diffuse = 0.05 + 0.12 * sky + key + 0.16 * max(dot(normal, look.fill_light.xyz), 0.0);
    let halfway = normalize(look.key_light.xyz + view);
    let gloss = 0.07 * pow(max(dot(normal, halfway), 0.0), 18.0);
    let grazing = 1.0 - min(abs(dot(normal, view)), 1.0);
    let rim = 0.10 * grazing * grazing * grazing * grazing;
    return albedo * diffuse + vec3<f32>(gloss) + (albedo * 0.5 + 0.5) * rim;
}

fn height_color(share: f32) -> vec3<f32> {
    let x = clamp(share, 0.0, 1.0) * 4.0;
    let stop = min(u32(x), 3u);
    return mix(look.scale[stop].xyz, look.scale[stop + 1u].xyz, x - f32(stop));
}

// A light gradient, and below the horizon a grid on the ground that fades into the distance.
@fragment
fn background(@builtin(position) position: vec4<f32>) -> @location(0) vec4<f32> {
    let at = place(position);
    let sky = mix(look.sky_top.xyz, look.sky_bottom.xyz, 0.5 * at.y + 0.5);
    let ray = ray_through(at);
    let fall = dot(ray, look.world_up.xyz);
    let above = dot(look.eye.xyz, look.world_up.xyz) - look.heights.z;
    if fall >= -1e-4 || above <= 0.0 {
        return vec4<f32>(sky, 1.0);
    }
    let grid = look.heights.w;
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
    return vec4<f32>(sky * (1.0 - strength), 1.0);
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
