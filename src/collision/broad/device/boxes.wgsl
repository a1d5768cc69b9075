// Swept, inflated boxes on the device: the arithmetic of broad/boxes.rs, operation by operation. Adding and subtracting are
// rounded correctly in WGSL and SLACK is a power of two, so bounds have the bits of the native ones but where numbers are
// subnormal; flushing those is monotone too, so boxes that must meet still do.

// Relative widening of every bound.
const BOX_SLACK: f32 = 4.76837158203125e-7;

struct Box {
    lo: vec3<f32>,
    hi: vec3<f32>,
}

// Box of a straight path.
fn path_box(start: vec3<f32>, end: vec3<f32>) -> Box {
    return Box(min(start, end), max(start, end));
}

fn joined(a: Box, b: Box) -> Box {
    return Box(min(a.lo, b.lo), max(a.hi, b.hi));
}

fn inflated(path: Box, pad_m: f32) -> Box {
    let lo = path.lo - vec3<f32>(pad_m);
    let hi = path.hi + vec3<f32>(pad_m);
    return Box(lo - abs(lo) * BOX_SLACK, hi + abs(hi) * BOX_SLACK);
}

// Moves every bound inward. The box may become inverted (lo > hi).
fn shrunk(a: Box, by: f32) -> Box {
    return Box(a.lo + vec3<f32>(by), a.hi - vec3<f32>(by));
}

// Touching boxes overlap.
fn overlaps(a: Box, b: Box) -> bool {
    return all(a.lo <= b.hi) && all(b.lo <= a.hi);
}
