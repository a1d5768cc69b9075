// Functions shared by the kernels that give each chunk of rows one workgroup.

const CHUNK_THREADS: u32 = 128u;
// Partial sums of the workgroup that are added last.
const SUM_GROUPS: u32 = 8u;

var<workgroup> partial: array<vec4<f32>, CHUNK_THREADS>;
var<workgroup> group_sums: array<vec4<f32>, SUM_GROUPS>;

// Sum over the workgroup, for its first invocation, in a fixed order. It has two barriers and not one per level of a
// binary tree, because software drivers switch between all invocations at each barrier. Calls may follow each other
// directly: `partial` is last read before the second barrier, and `group_sums` before the first barrier of the next
// call.
fn chunk_sum(local: u32, own: vec4<f32>) -> vec4<f32> {
    partial[local] = own;
    workgroupBarrier();
    var sum = vec4<f32>(0.0);
    if (local < SUM_GROUPS) {
        for (var i = local; i < CHUNK_THREADS; i += SUM_GROUPS) {
            sum += partial[i];
        }
        group_sums[local] = sum;
    }
    workgroupBarrier();
    sum = vec4<f32>(0.0);
    if (local == 0u) {
        for (var i = 0u; i < SUM_GROUPS; i++) {
            sum += group_sums[i];
        }
    }
    return sum;
}

// Chunk of `chunk_rows` rows out of `rows`: its first row and its end.
fn chunk_range(chunk: u32, chunk_rows: u32, rows: u32) -> vec2<u32> {
    let first = min(chunk * chunk_rows, rows);
    return vec2<u32>(first, min(first + chunk_rows, rows));
}

// Product of a symmetric block (first row; yy, yz, zz) with v.
fn symmetric_times(first: vec3<f32>, rest: vec3<f32>, v: vec3<f32>) -> vec3<f32> {
    return vec3<f32>(
        first.x * v.x + first.y * v.y + first.z * v.z,
        first.y * v.x + rest.x * v.y + rest.y * v.z,
        first.z * v.x + rest.y * v.y + rest.z * v.z,
    );
}
