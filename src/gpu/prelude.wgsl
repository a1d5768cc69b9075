// Put in front of every kernel. What is here holds on every adapter, software ones too.
//
// Rules for kernels:
// - No invocation runs more than 60,000 loop turns, counted over all its loops, nested ones included: some software
//   drivers end loops silently after 65,535. Split the work over invocations or dispatches instead.
// - A buffer's length is a parameter. arrayLength() of an empty array is not 0, because no empty buffer can be bound.
// - Never test for NaN with x != x: WGSL lets the compiler assume there are none. Use is_finite.
// - Writes out of range vanish without an error: a kernel that appends checks its room and reports what it needed.

// Invocations per workgroup of kernels that do not need another number.
const WORKGROUP: u32 = 128u;

// Number of this workgroup; large dispatches are spread over x and y.
fn group_index(group: vec3<u32>, groups: vec3<u32>) -> u32 {
    return group.x + group.y * groups.x;
}

// Number of this invocation, in kernels with @workgroup_size(WORKGROUP). May exceed the number asked for.
fn global_index(id: vec3<u32>, groups: vec3<u32>) -> u32 {
    return id.x + id.y * groups.x * WORKGROUP;
}

// False for infinities and NaN.
fn is_finite(x: f32) -> bool {
    return (bitcast<u32>(x) & 0x7f800000u) != 0x7f800000u;
}

// A vec3<f32> of 12 bytes: a vec3<f32> in a buffer would take 16.
struct Packed3 {
    x: f32,
    y: f32,
    z: f32,
}

fn unpacked(v: Packed3) -> vec3<f32> {
    return vec3<f32>(v.x, v.y, v.z);
}

fn packed(v: vec3<f32>) -> Packed3 {
    return Packed3(v.x, v.y, v.z);
}
