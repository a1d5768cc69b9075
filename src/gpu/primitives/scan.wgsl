// Exclusive scan of u32 in blocks; see scan.rs for how the levels fit together.

struct ScanParams {
    // Items of `values`.
    count_in: u32,
    // Items of `sums`; those past `count_in` are as if their value were 0.
    count_out: u32,
    // Number of the first block of this window.
    first_block: u32,
}

@group(0) @binding(0) var<storage, read> values: array<u32>;
@group(0) @binding(1) var<storage, read_write> sums: array<u32>;
@group(0) @binding(2) var<storage, read_write> totals: array<u32>;
@group(0) @binding(3) var<storage, read> offsets: array<u32>;
@group(0) @binding(4) var<uniform> params: ScanParams;

const SCAN_THREADS: u32 = 256u;
const PER_THREAD: u32 = 8u;

var<workgroup> shared_sums: array<u32, SCAN_THREADS>;

// Sum of the values of all lower invocations of the workgroup.
fn scan_workgroup(local: u32, own: u32) -> u32 {
    shared_sums[local] = own;
    workgroupBarrier();
    for (var step = 1u; step < SCAN_THREADS; step *= 2u) {
        var before = 0u;
        if (local >= step) {
            before = shared_sums[local - step];
        }
        workgroupBarrier();
        shared_sums[local] += before;
        workgroupBarrier();
    }
    return shared_sums[local] - own;
}

// Each workgroup scans its block of SCAN_THREADS * PER_THREAD items and notes what the block sums up to.
@compute @workgroup_size(SCAN_THREADS)
fn scan_blocks(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let block = group_index(group, groups);
    let first = (block * SCAN_THREADS + local) * PER_THREAD;
    var before: array<u32, PER_THREAD>;
    var own = 0u;
    for (var k = 0u; k < PER_THREAD; k++) {
        before[k] = own;
        if (first + k < params.count_in) {
            own += values[first + k];
        }
    }
    let lower = scan_workgroup(local, own);
    for (var k = 0u; k < PER_THREAD; k++) {
        if (first + k < params.count_out) {
            sums[first + k] = lower + before[k];
        }
    }
    if (local == SCAN_THREADS - 1u && block * SCAN_THREADS * PER_THREAD < params.count_out) {
        totals[params.first_block + block] = lower + own;
    }
}

// Adds to each block what all lower blocks sum up to.
@compute @workgroup_size(SCAN_THREADS)
fn add_offsets(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let block = group_index(group, groups);
    let offset = offsets[params.first_block + block];
    // Neighboring invocations take neighboring items here, as nothing depends on who takes which.
    for (var k = 0u; k < PER_THREAD; k++) {
        let i = (block * PER_THREAD + k) * SCAN_THREADS + local;
        if (i < params.count_out) {
            sums[i] += offset;
        }
    }
}
