//@ import frame, counters
// Exclusive prefix sum, step 1 of 3: the sum of every chunk of 1024 counts.
//
// The sums are integers, so the result does not depend on the order. One workgroup per chunk, 16 consecutive
// counts per thread. `values` [n], n = counters[which.x]; `sums` [chunks + 1].
// Twin: a running sum (core/tests).

@group(0) @binding(0) var<uniform> which: vec4<u32>;
@group(0) @binding(1) var<storage, read> counters: array<u32>;
@group(0) @binding(2) var<storage, read> values: array<u32>;
@group(0) @binding(3) var<storage, read_write> sums: array<u32>;

var<workgroup> sh_sums: array<u32, 64>;

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
        @builtin(local_invocation_index) lane: u32) {
    let chunk = folded(group, groups);
    let n = counters[which.x];
    let first = chunk * SCAN_CHUNK + lane * 16u;
    let last = min(first + 16u, n);
    var sum = 0u;
    for (var i = first; i < last; i++) {
        sum += values[i];
    }
    sh_sums[lane] = sum;
    workgroupBarrier();
    if lane == 0u && chunk < groups_for(n, SCAN_CHUNK) {
        var total = 0u;
        for (var i = 0u; i < 64u; i++) {
            total += sh_sums[i];
        }
        sums[chunk] = total;
    }
}
