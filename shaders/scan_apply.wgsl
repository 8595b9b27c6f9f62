//@ import frame, counters
// Exclusive prefix sum, step 3 of 3: replaces `values` by its exclusive prefix sum, in place.
//
// One workgroup per chunk, 16 consecutive counts per thread. The total stays in `sums[chunks]`.

@group(0) @binding(0) var<uniform> which: vec4<u32>;
@group(0) @binding(1) var<storage, read> counters: array<u32>;
@group(0) @binding(2) var<storage, read_write> values: array<u32>;
@group(0) @binding(3) var<storage, read> sums: array<u32>;

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
    if first < last {
        var before = sums[chunk];
        for (var i = 0u; i < lane; i++) {
            before += sh_sums[i];
        }
        for (var i = first; i < last; i++) {
            let value = values[i];
            values[i] = before;
            before += value;
        }
    }
}
